"""Errors of this package: one clear line, meant for the user."""

from __future__ import annotations

import contextlib
import os


class NnError(Exception):
    """Something the user can mend. `str(error)` is one line that says what was found and what is allowed."""


class ConfigError(NnError):
    """A configuration that cannot become a model.

    Args:
        path: Where in the configuration, such as ``encoding.nested[1].n_bins``.
        message: What was found and what is allowed.
        file: That the configuration was read from, if it was.
    """

    def __init__(self, path: str, message: str, file: str | os.PathLike | None = None):
        self.path, self.message, self.file = path, message, file
        super().__init__(": ".join(str(part) for part in (file, path, message) if part))


@contextlib.contextmanager
def of_file(file: str | os.PathLike | None):
    """Adds the name of the file, unless it is None, to errors in a configuration."""
    try:
        yield
    except ConfigError as error:
        if file is None or error.file is not None:
            raise
        raise ConfigError(error.path, error.message, file) from None
