"""Mitsuba emitters to records. Defaults and conventions are those of Mitsuba 3.9."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wavefront.scene import description
from wavefront.scene.mitsuba_materials import Materials
from wavefront.scene.mitsuba_xml import Document, Plugin, rows, world_matrix


@dataclass
class Emitters:
    """Converts emitters of a document.

    Attributes:
        document: Where they come from.
        warn: Called with a line of text for what does not change the image.
        materials: Converts colours and textures.
    """

    document: Document
    warn: Callable[[str], object]
    materials: Materials

    def emitter(self, plugin: Plugin) -> description.Emitter:
        """The record of an emitter at the top level.

        Raises:
            SceneError: With file and line: a kind, a property or a value that is not supported.
        """
        kinds = {"constant": self._constant, "envmap": self._envmap}
        if plugin.type not in kinds:
            if plugin.type == "area":
                raise plugin.error(f"{plugin.label()} belongs inside a shape")
            raise plugin.error(f"{plugin.label()} is not supported; supported: area, {', '.join(kinds)}")
        plugin.ignore("sampling_weight")
        record = kinds[plugin.type](plugin)
        record.name = plugin.id
        plugin.finish()
        return record

    def area(self, plugin: Plugin) -> description.Area:
        """The record of an emitter inside a shape. Raises SceneError as `emitter` does."""
        if plugin.type != "area":
            raise plugin.error(f"{plugin.label()} is not supported inside a shape; supported: area")
        record = description.Area(radiance=self.materials.colour(plugin, "radiance", 1.0, emitted=True))
        plugin.ignore("sampling_weight")
        plugin.finish("texture")
        return record

    def _colour(self, plugin, name):
        value = self.materials.colour(plugin, name, 1.0, emitted=True)
        if not isinstance(value, (float, list)):
            raise plugin.error(f"{name} of {plugin.label()} must be a colour, not a texture")
        return value

    def _constant(self, plugin):
        return description.Constant(radiance=self._colour(plugin, "radiance"))

    def _envmap(self, plugin):
        element = plugin.get("filename")
        if element is None:
            raise plugin.error(f"{plugin.label()} needs a filename")
        file = self.document.find(plugin.string("filename", ""), element)
        scale = plugin.number("scale", 1.0)
        if scale < 0.0:
            raise plugin.get("scale").error(f"scale must be at least 0; found {scale:g}")
        plugin.ignore("mis_compensation", "cache")  # how it is sampled and stored
        matrix = world_matrix(plugin)
        sizes = np.linalg.svd(matrix[:3, :3], compute_uv=False)
        if sizes[0] - sizes[2] > 1e-4 * sizes[0]:
            raise plugin.get("to_world").error("an environment map can be rotated; found different scales or a shear")
        matrix[:3, 3] = 0.0
        to_world = [] if np.array_equal(matrix, np.eye(4)) else rows(matrix)
        return description.Envmap(file=str(file), scale=scale, to_world=to_world)
