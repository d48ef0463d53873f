"""A wavefront path tracer on NVIDIA Warp."""

from __future__ import annotations

import warp as _wp

_wp.config.quiet = True  # the command has its own line for compilation

from wavefront.errors import SceneError, WavefrontError  # noqa: E402
from wavefront.renderer import Renderer  # noqa: E402
from wavefront.scene import Scene, load_scene  # noqa: E402

__all__ = ["Renderer", "Scene", "SceneError", "WavefrontError", "load_scene"]
__version__ = "0.1.0"
