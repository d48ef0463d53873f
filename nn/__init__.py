"""Encodings, fused networks, losses and optimisers. Knows nothing of rendering."""

from __future__ import annotations

import warp as _wp

if _wp.config.log_level == _wp.LOG_INFO:  # one line per kernel is for those who ask for it
    _wp.config.log_level = _wp.LOG_WARNING

from nn.errors import ConfigError, NnError
from nn.model import Model

__all__ = ["ConfigError", "Model", "NnError"]
