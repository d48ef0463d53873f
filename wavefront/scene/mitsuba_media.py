"""Mitsuba media to records: homogeneous ones that absorb and do not scatter. Defaults are those of Mitsuba 3.9."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from wavefront.errors import SceneError
from wavefront.scene import description
from wavefront.scene.mitsuba_materials import colour_value
from wavefront.scene.mitsuba_xml import Document, Plugin

_CONSTANT = ("constvolume", "uniform")


@dataclass
class Media:
    """Converts media of a document; those at the top level with an id become named records.

    Attributes:
        document: Where they come from.
        warn: Called with a line of text for what does not change the image.
        used: Named media that something refers to, by id.
        found: Whether anything has a medium.
    """

    document: Document
    warn: Callable[[str], object]
    used: dict[str, description.Medium] = field(default_factory=dict)
    found: bool = False

    def __post_init__(self):
        top = (plugin for _, plugin in self.document.scene.children if isinstance(plugin, Plugin))
        self.named = {plugin.id: plugin for plugin in top if plugin.id and plugin.tag == "medium"}

    def of(self, plugin: Plugin, *names: str) -> dict[str, str | description.Medium]:
        """The media that a plugin holds, by the name it gives them; any name will do where `names` is empty.

        Raises:
            SceneError: With file and line: a kind, a property, a value or a name that is not supported.
        """
        result = {}
        for name, child in plugin.resolved():
            if child.tag != "medium":
                continue
            if names and name not in names:
                raise child.error(f"a medium of {plugin.label()} is named {' or '.join(names)}; found {name!r}")
            plugin.ignore(name)
            result[name] = self._medium(child)
        self.found |= bool(result)
        return result

    def records(self) -> list[description.Medium]:
        """The named records, in file order; what is wrong with one that nothing refers to is a warning."""
        for name, plugin in self.named.items():
            if name not in self.used:
                try:
                    self._medium(plugin)
                except SceneError as error:
                    self.warn(f"{plugin.where()}: medium {name!r} is left out, nothing uses it: {error.message}")
        return [self.used[name] for name in self.named if name in self.used]

    def _medium(self, plugin):
        if self.named.get(plugin.id) is not plugin:
            return self._convert(plugin)
        if plugin.id not in self.used:
            record = self._convert(plugin)
            record.name = plugin.id
            self.used[plugin.id] = record
        return plugin.id

    def _convert(self, plugin):
        if plugin.type != "homogeneous":
            raise plugin.error(f"{plugin.label()} is not supported; supported: homogeneous")
        plugin.ignore("sample_emitters", "has_spectral_extinction")  # how it is sampled
        separate = plugin.has("sigma_a") or plugin.has("sigma_s")
        if separate and (plugin.has("sigma_t") or plugin.has("albedo")):
            raise plugin.error(f"{plugin.label()} has either sigma_t and albedo, or sigma_a and sigma_s")
        if separate:
            absorption, name = self._value(plugin, "sigma_a", 0.0), "sigma_s"
            scattering = self._value(plugin, "sigma_s", 0.0)
        else:
            absorption, name = self._value(plugin, "sigma_t", 1.0), "albedo"
            scattering = self._value(plugin, "albedo", 0.75, limit=1.0)
        if scattering not in (0.0, [0.0, 0.0, 0.0]):
            where = plugin.get(name) or plugin.child(name)
            found = " (its default)" if where is None else ""
            raise (where or plugin).error(
                f"{plugin.label()} scatters: {name} is {scattering}{found}; allowed: 0, a medium that absorbs alone"
            )
        scale = plugin.number("scale", 1.0)
        if scale < 0.0:
            raise plugin.get("scale").error(f"scale must be at least 0; found {scale:g}")
        plugin.ignore(*(name for name, child in plugin.resolved() if child.tag == "phase"))  # nothing scatters
        plugin.finish("phase")
        return description.Homogeneous(sigma_a=absorption, scale=scale)

    def _value(self, plugin, name, default, limit=None):
        element, volume = plugin.get(name), plugin.child(name)
        if volume is not None:
            if volume.type not in _CONSTANT:
                raise volume.error(f"{volume.label()} is not supported in a medium; supported: {', '.join(_CONSTANT)}")
            element = volume.get("value")
            if element is None:
                raise volume.error(f"{volume.label()} needs a value")
            volume.finish()
        return default if element is None else colour_value(element, limit)
