"""Mitsuba emitters to records. Defaults and conventions are those of Mitsuba 3.9."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wavefront.light.sky import sun_position
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
            "sunsky": self._sunsky,
            "sun": self._sunsky,
            "sky": self._sunsky,
        }
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

    def _sunsky(self, plugin):
        """Mitsuba 3's `sunsky`, and `sunsky`, `sun` and `sky` of 0.x, whose zenith is +Y instead of +Z.

        Files of 0.x that were ported to Mitsuba 3 have its zenith; those that were not are told by keys of old.
        """
        old = plugin.type != "sunsky" or any(plugin.has(key) for key in _OLD_SKY)
        matrix = world_matrix(plugin)
        sizes = np.linalg.svd(matrix[:3, :3], compute_uv=False)
        if sizes[0] - sizes[2] > 1e-4 * sizes[0]:
            raise plugin.get("to_world").error("a sky can be rotated; found different scales or a shear")
        matrix = matrix[:3, :3] / sizes[0]
        up = matrix @ ((0.0, 1.0, 0.0) if old else (0.0, 0.0, 1.0))
        to_sun = self._to_sun(plugin, matrix, old)
        if not to_sun @ up > 0.0:
            zenith = "+Y, as in Mitsuba 0.x" if old else "+Z, as in Mitsuba 3"
            raise plugin.error(f"{plugin.label()}: the sun is below the horizon (the zenith is local {zenith})")
        turbidity = plugin.number("turbidity", 3.0)
        if not 2.0 <= turbidity <= 10.0:
            raise plugin.get("turbidity").error(f"turbidity must be from 2 to 10; found {turbidity:g}")
        if plugin.number("stretch", 1.0) != 1.0:
            raise plugin.get("stretch").error("a stretched sky is not supported")
        if plugin.boolean("extend"):
            raise plugin.get("extend").error("a sky below the horizon is not supported")
        plugin.ignore("albedo", "complex_sun", "resolution")
        self.warn(
            f"{plugin.where()}: {plugin.label()} is rendered with our own sky (Preetham et al. 1999, no ground "
            "albedo); tools.convert --bake-emitters takes Mitsuba's"
        )
        scale = plugin.number("scale", 1.0)
        return description.SunSky(
            direction=_vector(-to_sun),
            up=_vector(up),
            turbidity=turbidity,
            sky_scale=0.0 if plugin.type == "sun" else self._scale(plugin, "sky_scale", scale),
            sun_scale=0.0 if plugin.type == "sky" else self._scale(plugin, "sun_scale", scale),
            sun_angle=self._sun_angle(plugin),
        )

    def _scale(self, plugin, name, default):
        value = plugin.number(name, default)
        if value < 0.0:
            raise (plugin.get(name) or plugin.get("scale")).error(f"{name} must be at least 0; found {value:g}")
        return value

    def _sun_angle(self, plugin):
        factor = plugin.number("sun_radius_scale", 1.0)
        aperture = plugin.number("sun_aperture", _SUN_APERTURE * factor)
        if not 0.0 < aperture < 180.0:
            raise plugin.error(f"the aperture of the sun must be above 0 and below 180 degrees; found {aperture:g}")
        return 0.5 * aperture

    def _to_sun(self, plugin, matrix, old):
        """Unit vector in the world's axes, from a direction or from a place and a time."""
        if plugin.has("sun_direction"):
            clash = next((key for key in _SUN_TIME if plugin.has(key)), None)
            if clash is not None:
                raise plugin.get(clash).error(f"{plugin.label()} has either sun_direction or {clash}")
            to_sun = np.array(plugin.vector("sun_direction", (0.0, 0.0, 1.0)))
            if not np.linalg.norm(to_sun) > 0.0:
                raise plugin.get("sun_direction").error("the direction is zero")
            return to_sun / np.linalg.norm(to_sun)
        date = [plugin.integer(key, default) for key, default in (("year", 2010), ("month", 7), ("day", 10))]
        hours, minutes, seconds = (
            plugin.number(key, default) for key, default in (("hour", 15.0), ("minute", 0.0), ("second", 0.0))
        )
        try:
            when = datetime.datetime(*date) + datetime.timedelta(hours=hours, minutes=minutes, seconds=seconds)
        except (ValueError, OverflowError) as error:
            raise plugin.error(f"{plugin.label()}: not a date and time: {error}") from None
        place = (plugin.number(key, value) for key, value in zip(_SUN_TIME[:3], (35.6894, 139.6917, 9.0), strict=True))
        east, north, up = sun_position(when, *place)
        return matrix @ ((east, up, -north) if old else (-north, -east, up))


_SUN_TIME = ("latitude", "longitude", "timezone", "year", "month", "day", "hour", "minute", "second")
_OLD_SKY = ("sun_radius_scale", "stretch", "resolution", "scale", "extend")  # keys that Mitsuba 3 does not have
_SUN_APERTURE = 0.5358  # degrees


def _vector(values):
    return tuple(float(value) for value in values)
