"""Which guides there are: methods, and presets of their settings.

A preset is a file ``presets/NAME.json``: a method, the values of its settings, and where each of them is from. A method
is one entry of `METHODS`; its settings are a `msgspec.Struct` that knows what is in range. Methods are imported when a
guide of theirs is made, and not before.
"""

from __future__ import annotations

import difflib
import importlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import msgspec

from wavefront.errors import SceneError
from wavefront.guide import Guide
from wavefront.scene import description
from wavefront.scene.explain import explain, format_path
from wavefront.scene.lookup import shown

FOLDER = Path(__file__).resolve().parent / "presets"
WHERE = "integrator.guide"  # of the choice, in a scene

# Of each method: its module, the class of its settings, and the class of its guide.
METHODS = {"npm": ("guiding.npm", "NpmSettings", "NpmGuide")}


class Preset(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A preset.

    Attributes:
        method: A key of `METHODS`.
        description: In one line.
        settings: Values by name; those that are missing have the default of the method.
        sources: Where each of them is from.
    """

    method: str
    description: str
    settings: dict[str, Any]
    sources: dict[str, Literal["paper", "authors' code", "ours"]]


def preset_names() -> list[str]:
    """The names of all presets, sorted."""
    return sorted(path.stem for path in FOLDER.glob("*.json"))


def load_preset(name: str, where: str = WHERE) -> Preset:
    """Reads a preset.

    Args:
        where: The place of the choice, for the message.

    Raises:
        SceneError: There is no such preset.
    """
    names = preset_names()
    if name not in names:
        close = difflib.get_close_matches(name, names, n=1)
        hint = f"; did you mean {shown(close[0])}?" if close else ";"
        raise SceneError(f"unknown preset {shown(name)}{hint} allowed: {', '.join(names)}", path=f"{where}.preset")
    return msgspec.json.decode((FOLDER / f"{name}.json").read_bytes(), type=Preset)


def guide_settings(
    preset: str, settings: Mapping[str, Any] | None = None, where: str = WHERE
) -> tuple[str, msgspec.Struct]:
    """The method of a preset, and its settings with changes. Arguments and errors are those of `make_guide`."""
    chosen = load_preset(preset, where)
    module, kind, _ = METHODS[chosen.method]
    kind = getattr(importlib.import_module(module), kind)
    values, written = dict(chosen.settings), {}
    for key, value in (settings or {}).items():
        prefix, dot, name = key.rpartition(".")
        if dot and prefix != chosen.method:
            raise SceneError(
                f"{shown(key)} is no setting of {preset}; allowed: a name, or {chosen.method}. and a name",
                path=f"{where}.settings",
            )
        place = f"{where}.settings.{key}"
        if name in written:
            raise SceneError(f"is given twice, as {shown(written[name])} too", path=place)
        if isinstance(value, float) and not math.isfinite(value):
            raise SceneError(f"expected a finite number; found {value}", path=place)
        values[name], written[name] = value, key
    try:
        return chosen.method, msgspec.convert(values, kind)
    except (msgspec.ValidationError, ValueError, OverflowError) as error:
        steps, message, _ = explain(values, error, kind)
    if steps:
        steps[0] = written.get(steps[0], steps[0])
    raise SceneError(message, path=format_path([f"{where}.settings", *steps]))


def make_guide(preset: str, settings: Mapping[str, Any] | None = None, where: str = WHERE, seed: int = 0) -> Guide:
    """A guide.

    Args:
        preset: One of `preset_names`.
        settings: Values in place of those of the preset, by name; ``npm.n_lobes`` is ``n_lobes`` of the method npm.
        where: The place of the choice, for messages.
        seed: Of what the method initialises at random.

    Raises:
        SceneError: An unknown preset or setting, or a value that is not allowed: the place, what was found, and what is
            allowed.
    """
    method, values = guide_settings(preset, settings, where)
    module, _, guide = METHODS[method]
    return getattr(importlib.import_module(module), guide)(values, seed=seed)


def _choice(scene: description.Scene) -> tuple[str, dict[str, Any]] | None:
    """The preset that a scene names and all changes of its settings; None for a scene without a guide."""
    choice = scene.integrator.guide
    if choice is None:
        return None
    shares = {name: getattr(choice, name) for name in ("train_share", "bsdf_share")}
    given = {name: value for name, value in shares.items() if value is not None}
    return choice.preset, {k: v for k, v in choice.settings.items() if k.rpartition(".")[2] not in given} | given


def plain_settings(scene: description.Scene) -> dict[str, Any] | None:
    """The guide that a scene names as plain values: ``method``, and ``settings``, all of them; None if it names none.

    Raises:
        SceneError: As of `make_guide`.
    """
    choice = _choice(scene)
    if choice is None:
        return None
    method, settings = guide_settings(*choice)
    return {"method": method, "settings": msgspec.to_builtins(settings)}


def guide_of(scene: description.Scene, seed: int = 0) -> Guide | None:
    """The guide that a scene names, for ``Renderer(scene, guide=guide_of(scene))``; None if it names none.

    Raises:
        SceneError: As of `make_guide`.
    """
    choice = _choice(scene)
    return None if choice is None else make_guide(*choice, seed=seed)
