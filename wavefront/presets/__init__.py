"""Presets: settings chosen from measured frontiers of time against error, as ``NAME.json`` in this folder.

A preset changes settings of a scene: what it names replaces what the scene says, and what is said otherwise (options of
the command, overrides) replaces the preset. Its ``origin`` says where it was measured: commit, machine, scenes,
figures. `tools.trade --check-presets` measures again.
"""

from __future__ import annotations

import json
from pathlib import Path

import msgspec

from wavefront.errors import WavefrontError
from wavefront.scene import description
from wavefront.scene.lookup import value_at

NAMES = ("draft", "balanced", "reference")  # from fast to accurate
FOLDER = Path(__file__).resolve().parent


class Preset(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """A preset.

    Attributes:
        name: One of `NAMES`.
        description: In one line.
        settings: Values by key of the scene.
        biased_by: Those of these keys that change the expected image; none: the image converges to that of the scene.
        origin: Where it was measured.
    """

    name: str
    description: str
    settings: dict[str, str | int | float | bool | None]
    biased_by: list[str]
    origin: dict

    @property
    def overrides(self) -> list[str]:
        """The settings, as `wavefront.load_scene` takes them."""
        return [f"{key}={json.dumps(value)}" for key, value in self.settings.items()]

    def account(self, scene: description.Scene, timed: bool = False) -> dict:
        """What a render says of its preset: ``name``, ``settings``, ``overridden`` (keys that have other values in the
        render), and ``biased_by``, of those that have not.

        Args:
            scene: As it is rendered.
            timed: The render has a time and no number of samples.
        """
        overridden = [
            key
            for key, value in self.settings.items()
            if value_at(scene, key) != value or (timed and key == "integrator.spp")
        ]
        return {
            "name": self.name,
            "settings": self.settings,
            "overridden": overridden,
            "biased_by": [key for key in self.biased_by if key not in overridden],
        }


def preset_path(name: str) -> Path:
    """The file of a preset.

    Raises:
        WavefrontError: There is no such preset.
    """
    if name not in NAMES:
        raise WavefrontError(f"unknown preset {name!r}; allowed: {', '.join(NAMES)}")
    return FOLDER / f"{name}.json"


def load_preset(name: str) -> Preset:
    """Reads a preset.

    Raises:
        WavefrontError: There is no such preset.
    """
    return msgspec.json.decode(preset_path(name).read_bytes(), type=Preset)
