"""Errors meant for the user: one clear line, no traceback."""

from __future__ import annotations


class WavefrontError(Exception):
    """Something the user can mend. `str(error)` is one line that says what was found and what is allowed."""


class SceneError(WavefrontError):
    """A scene that cannot be rendered.

    Args:
        message: What was found and what is allowed.
        file: The file it was found in.
        path: Where in the file: a record path such as ``bsdfs[2].alpha``, or ``line 12``.
    """

    def __init__(self, message: str, file: object = None, path: str = ""):
        self.message, self.file, self.path = message, file, path
        super().__init__(": ".join(str(part) for part in (file, path, message) if part))
