"""Errors of this package: one clear line, meant for the user."""

from __future__ import annotations


class NnError(Exception):
    """Something the user can mend. `str(error)` is one line that says what was found and what is allowed."""


class ConfigError(NnError):
    """A configuration that cannot become a model.

    Args:
        path: Where in the configuration, such as ``encoding.nested[1].n_bins``.
        message: What was found and what is allowed.
    """

    def __init__(self, path: str, message: str):
        self.path, self.message = path, message
        super().__init__(f"{path}: {message}" if path else message)
