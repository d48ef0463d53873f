"""A wavefront path tracer on NVIDIA Warp."""

from __future__ import annotations

import warp as _wp

if _wp.config.log_level == _wp.LOG_INFO:  # one line per kernel is for those who ask for it
    _wp.config.log_level = _wp.LOG_WARNING

from wavefront.errors import SceneError, WavefrontError
from wavefront.renderer import Renderer
from wavefront.scene import Scene, load_scene

__all__ = ["Renderer", "Scene", "SceneError", "WavefrontError", "load_scene"]
__version__ = "0.1.0"
