"""Scenes: typed records, readers, validation."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from wavefront.errors import SceneError
from wavefront.scene import json_format
from wavefront.scene.description import Scene
from wavefront.scene.validate import validate

SUFFIXES = (".json", ".xml", ".gltf", ".glb")

__all__ = ["SUFFIXES", "Scene", "load_scene", "validate"]


def load_scene(
    path: str | os.PathLike,
    overrides: Sequence[str] = (),
    parameters: Mapping[str, str] | None = None,
    warn: Callable[[str], object] | None = None,
) -> Scene:
    """Reads a scene file: our JSON format, Mitsuba's XML, or glTF.

    Args:
        path: A ``.json``, ``.xml``, ``.gltf`` or ``.glb`` file.
        overrides: Changes such as ``integrator.max_depth=6``, see `json_format.load`.
        parameters: Values for the ``$name`` parameters of a Mitsuba scene; ``camera`` and ``scene`` of a glTF file.
        warn: Called with each warning, a line of text.

    Raises:
        SceneError: The file, or one that it refers to, is missing or not valid.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if path.is_dir():
        raise SceneError(f"is a directory; expected a file, {', '.join(SUFFIXES)}", path)
    if suffix not in SUFFIXES:
        raise SceneError(f"unknown scene format {suffix!r}; allowed: {', '.join(SUFFIXES)}", path)
    if not path.exists():
        raise SceneError("file not found", path)
    if suffix == ".json":
        if parameters:
            raise SceneError(f"parameters are for Mitsuba and glTF scenes; found {', '.join(parameters)}", path)
        return json_format.load(path, overrides, warn)
    from wavefront.scene import gltf, mitsuba  # only when needed: most scenes are JSON

    importer = mitsuba if suffix == ".xml" else gltf
    scene = importer.load(path, warn=warn or (lambda message: None), parameters=parameters)
    if overrides:
        scene = json_format.with_overrides(scene, overrides, path)
    validate(scene, path, warn)
    return scene
