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
        kinds = {
            "constant": self._constant,
            "envmap": self._envmap,
            "directional": self._directional,
            "point": self._point,
            "spot": self._spot,
        }
        if plugin.type not in kinds:
            if plugin.type == "area":
                raise plugin.error(f"{plugin.label()} belongs inside a shape")
            raise plugin.error(f"{plugin.label()} is not supported; supported: area, {', '.join(kinds)}")
        plugin.ignore("sampling_weight")
        record = kinds[plugin.type](plugin)
        record.name = plugin.id
        # which medium its light comes through is said by the surfaces around
        plugin.ignore(*(name for name, child in plugin.resolved() if child.tag == "medium"))
        plugin.finish("medium")
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

    def _directional(self, plugin):
        if plugin.has("direction"):
            if plugin.has("to_world"):
                raise plugin.error(f"{plugin.label()} has either direction or to_world")
            direction = np.array(plugin.vector("direction", (0.0, 0.0, 1.0)))
            if not np.linalg.norm(direction) > 0.0:
                raise plugin.get("direction").error("the direction is zero")
        else:
            direction = world_matrix(plugin)[:3, 2]
        return description.Directional(direction=_vector(direction), irradiance=self._colour(plugin, "irradiance"))

    def _point(self, plugin):
        if plugin.has("position"):
            if plugin.has("to_world"):
                raise plugin.error(f"{plugin.label()} has either position or to_world")
            position = plugin.vector("position", (0.0, 0.0, 0.0))
        else:
            position = world_matrix(plugin)[:3, 3]
        return description.Point(position=_vector(position), intensity=self._colour(plugin, "intensity"))

    def _spot(self, plugin):
        matrix = world_matrix(plugin)
        cutoff = plugin.number("cutoff_angle", 20.0)
        if not 0.0 < cutoff <= 180.0:
            raise plugin.get("cutoff_angle").error(f"cutoff_angle must be above 0 and at most 180; found {cutoff:g}")
        beam = plugin.number("beam_width", 0.75 * cutoff)
        if not 0.0 <= beam <= cutoff:
            raise plugin.get("beam_width").error(f"beam_width must be from 0 to cutoff_angle; found {beam:g}")
        sizes = np.linalg.svd(matrix[:3, :3], compute_uv=False)
        if sizes[0] - sizes[2] > 1e-4 * sizes[0]:
            raise plugin.get("to_world").error("a spot light cannot be scaled differently along its axes or sheared")
        return description.Spot(
            position=_vector(matrix[:3, 3]),
            direction=_vector(matrix[:3, 2]),
            intensity=self._colour(plugin, "intensity"),
            cutoff_angle=cutoff,
            beam_width=beam,
        )


def _vector(values):
    return tuple(float(value) for value in values)
