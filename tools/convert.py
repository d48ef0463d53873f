"""Converts a scene to our JSON format: ``python -m tools.convert scene.xml out.json``.

Meshes are written as binary PLY to ``<out>_meshes/`` and textures are copied (out of a glTF file, too) to
``<out>_textures/``, both beside the JSON file, which refers to them by relative path. Everything is written under
temporary names first, and the JSON file is put in place last, so that an error leaves nothing half-written.
"""

from __future__ import annotations

import argparse
import os
import secrets
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from wavefront.errors import SceneError, WavefrontError
from wavefront.scene import description, json_format, load_scene, meshes
from wavefront.scene.gltf_images import embedded_image
from wavefront.scene.images import replacing
from wavefront.scene.lookup import walk


def convert(scene: description.Scene, out: str | os.PathLike) -> None:
    """Writes `scene` (file paths absolute) as JSON with its meshes and textures beside it. `scene` is not changed.

    Raises:
        WavefrontError: A mesh or texture is missing or not readable, or the output cannot be written.
    """
    out = Path(out)
    names = {kind: f"{out.stem}_{kind}" for kind in ("meshes", "textures")}
    mark = secrets.token_hex(4)
    staged = {kind: out.parent / f".{name}.{mark}.tmp" for kind, name in names.items()}
    scene = json_format.checked(scene)  # a copy
    try:
        _write_meshes(scene, staged["meshes"], out.parent / names["meshes"])
        _copy_textures(scene, staged["textures"], out.parent / names["textures"])
        with replacing(out) as temporary:
            temporary.write_text(json_format.dumps(scene, out.parent), encoding="utf-8")
            for kind, folder in staged.items():
                _replace_folder(folder, out.parent / names[kind], mark)
    except OSError as error:
        raise WavefrontError(f"{error.filename or out}: cannot be written: {error.strerror or error}") from None
    finally:
        meshes.clear_cache()
        for folder in staged.values():
            shutil.rmtree(folder, ignore_errors=True)


def _write_meshes(scene, folder, final):
    """Writes every mesh that comes from a file as PLY in its own space, broken triangles too; shapes that share a file
    share the PLY."""
    written: dict[tuple, tuple[Path, bool]] = {}
    taken: set[str] = set()
    for where, shape in walk(scene):
        if not isinstance(shape, description.Mesh) or shape.file is None:
            continue
        key = (shape.file, repr(shape.part), shape.face_normals, shape.flip_v)
        if key not in written:
            folder.mkdir(exist_ok=True)
            name = _free_name(Path(shape.file).stem, ".ply", taken)
            plain = description.Mesh(
                file=shape.file, part=shape.part, face_normals=shape.face_normals, flip_v=shape.flip_v
            )
            mesh = meshes.own_space(plain, where)
            meshes.write_ply(folder / name, mesh)
            written[key] = final / name, mesh.normals is not None
        path, has_normals = written[key]
        shape.file, shape.part, shape.flip_v = str(path), None, None
        # computed normals stay with the reader: they depend on to_world, under which angles change
        shape.smooth_normals = shape.smooth_normals and not has_normals


def _copy_textures(scene, folder, final):
    copied: dict[tuple, Path] = {}
    taken: set[str] = set()
    for path, record in walk(scene):
        if not isinstance(record, (description.Bitmap, description.Envmap)):
            continue
        source, image = Path(record.file), getattr(record, "image", None)
        if (source, image) not in copied:
            folder.mkdir(exist_ok=True)
            if image is not None:
                data, suffix = embedded_image(record.file, image, f"{path}.file")
                name = _free_name(f"{source.stem}_{image}", suffix, taken)
                (folder / name).write_bytes(data)
            else:
                name = _free_name(source.stem, source.suffix, taken)
                try:
                    shutil.copyfile(source, folder / name)
                except FileNotFoundError:
                    raise SceneError(f"{source}: file not found", path=f"{path}.file") from None
            copied[source, image] = final / name
        record.file = str(copied[source, image])
        if image is not None:
            record.image = None


def _free_name(stem, suffix, taken):
    """A file name that is not in `taken`, also where upper and lower case are the same; adds it there."""
    name, number = stem + suffix, 1
    while name.lower() in taken:
        number += 1
        name = f"{stem}_{number}{suffix}"
    taken.add(name.lower())
    return name


def _replace_folder(new, final, mark):
    """Puts the folder `new`, if there is one, in the place of `final`."""
    if not new.exists():
        return
    old = final.with_name(f".{final.name}.{mark}.old")
    if final.exists():
        os.replace(final, old)
    os.replace(new, final)
    shutil.rmtree(old, ignore_errors=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code: 0, or 2 after an error, of which one line is printed."""
    parser = argparse.ArgumentParser(prog="python -m tools.convert", description=__doc__.split("\n\n")[0])
    parser.add_argument("scene", help="the scene to convert: Mitsuba XML, glTF, or our JSON")
    parser.add_argument("out", help="the JSON file to write")
    parser.add_argument("-D", dest="parameters", action="append", default=[], metavar="NAME=VALUE",
                        help="a value for $NAME of a Mitsuba scene; camera or scene of a glTF file")  # fmt: skip
    parser.add_argument("--bake-emitters", action="store_true",
                        help="let Mitsuba bake a sunsky to an environment map and a sun")  # fmt: skip
    parser.add_argument("--quiet", action="store_true", help="print no warnings")
    options = parser.parse_args(arguments)
    try:
        if Path(options.out).suffix.lower() != ".json":
            raise WavefrontError(f"{options.out}: the output must end in .json")
        bad = next((text for text in options.parameters if "=" not in text), None)
        if bad is not None:
            raise WavefrontError(f"-D {bad}: expected NAME=VALUE")
        parameters = dict(text.split("=", 1) for text in options.parameters)
        warn = (lambda message: None) if options.quiet else _print_warning
        if options.bake_emitters:
            _convert_baked(options, parameters, warn)
        else:
            convert(load_scene(options.scene, parameters=parameters, warn=warn), options.out)
    except WavefrontError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _convert_baked(options, parameters, warn):
    from tools import bake  # only here: needs Mitsuba

    if Path(options.scene).suffix.lower() != ".xml":
        raise WavefrontError(f"{options.scene}: --bake-emitters needs a Mitsuba scene")
    # which of our skies would be used does not matter
    scene = load_scene(
        options.scene, parameters=parameters, warn=lambda text: None if "--bake-emitters" in text else warn(text)
    )
    with tempfile.TemporaryDirectory(prefix="wavefront-bake-") as folder:
        baked = bake.bake_sunsky(options.scene, folder, parameters)
        convert(bake.replace_records(scene, baked), options.out)


def _print_warning(message):
    print(f"warning: {message}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
