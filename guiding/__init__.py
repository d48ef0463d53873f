"""Path guiding methods. They see the renderer through `wavefront.guide` only."""

from guiding.registry import guide_of, make_guide, plain_settings, preset_names

__all__ = ["guide_of", "make_guide", "plain_settings", "preset_names"]
