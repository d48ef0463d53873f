"""Finding records in a scene: by name, or all of them."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable, Iterator

from wavefront.bsdf.tables import PRINCIPLED_FRACTIONS
from wavefront.errors import SceneError
from wavefront.scene import description

# Fields in which a string is the name of a texture.
TEXTURE_FIELDS = frozenset(
    (
        "reflectance",
        "diffuse_reflectance",
        "specular_reflectance",
        "specular_transmittance",
        "alpha",
        "alpha_u",
        "alpha_v",
        "base_color",
        *PRINCIPLED_FRACTIONS,
        "opacity",
        "weight",
        "normal",
        "height",
        "radiance",
        "eta",
        "k",
    )
)
# Fields in which a string is the name of a BSDF.
BSDF_FIELDS = frozenset(("bsdf", "front", "back", "first", "second"))
# Fields in which a string is the name of a medium.
MEDIUM_FIELDS = frozenset(("interior", "exterior", "medium"))
# Long lists of numbers, in which there is no record to find.
NUMBER_FIELDS = frozenset(("vertices", "faces", "normals", "uvs"))
_LISTED = 24  # names that a message lists at most

_DEFAULT_BSDF = description.Diffuse()


def unknown_name(kind: str, name: str, known: Iterable[str]) -> str:
    """The message for a name that is not known: the nearest known one, then all of them unless there are many."""
    names = sorted(known)
    if not names:
        return f"unknown {kind} {shown(name)}; none is defined"
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"; did you mean {shown(close[0])}?" if close else ";"
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return f"unknown {kind} {shown(name)}{hint} known: {', '.join(map(shown, names[:_LISTED]))}{more}"


def shown(text: str) -> str:
    """Text from a file as it is quoted in a message: on one line, printable, not too long."""
    return repr(text if len(text) <= 60 else text[:57] + "...")


def resolve_bsdf(scene: description.Scene, ref: str | description.Bsdf | None) -> description.Bsdf:
    """The BSDF record that `ref` names, `ref` itself if it is a record, and the default for None.

    The fields of a nested BSDF are left as they are: resolve them in turn.

    Raises:
        SceneError: No BSDF of the scene has that name.
    """
    if ref is None:
        return _DEFAULT_BSDF
    return _resolve("bsdf", scene.bsdfs, ref)


def indexed_shapes(scene: description.Scene) -> Iterator[tuple[str, description.AnyShape]]:
    """All shapes with their paths, those of groups after the others: their order is the index of a shape."""
    for i, shape in enumerate(scene.shapes):
        yield f"shapes[{i}]", shape
    for g, group in enumerate(scene.groups):
        for i, shape in enumerate(group.shapes):
            yield f"groups[{g}].shapes[{i}]", shape


def bsdf_of_shape(scene: description.Scene) -> list[int]:
    """Index of the BSDF of each shape: its place in `bsdfs`; those that stand in shapes are counted on from there."""
    places = {bsdf.name: i for i, bsdf in enumerate(scene.bsdfs)}
    own = itertools.count(len(scene.bsdfs))
    return [places[shape.bsdf] if isinstance(shape.bsdf, str) else next(own) for _, shape in indexed_shapes(scene)]


def resolve_texture(scene: description.Scene, ref: object) -> object:
    """The texture record that `ref` names; a number, a colour or a texture record is returned as it is.

    Raises:
        SceneError: No texture of the scene has that name.
    """
    return _resolve("texture", scene.textures, ref)


def roughness(bsdf: description.RoughConductor | description.RoughDielectric) -> tuple[tuple[str, object], ...]:
    """Field and value of the roughness along the tangent, and the same across it."""
    if bsdf.alpha_u is not None:
        return ("alpha_u", bsdf.alpha_u), ("alpha_v", bsdf.alpha_v)
    return (("alpha", 0.1 if bsdf.alpha is None else bsdf.alpha),) * 2


def resolve_medium(scene: description.Scene, ref: str | description.Medium | None) -> description.Medium | None:
    """The medium record that `ref` names; a record, or None for vacuum, is returned as it is.

    Raises:
        SceneError: No medium of the scene has that name.
    """
    return _resolve("medium", scene.media, ref)


def _resolve(kind, records, ref):
    if not isinstance(ref, str):
        return ref
    for record in records:
        if record.name == ref and ref:
            return record
    raise SceneError(unknown_name(kind, ref, (record.name for record in records if record.name)))


def walk(record: description.Record, path: str = "") -> Iterator[tuple[str, description.Record]]:
    """All records in `record`, itself first, in the order of the file, each with its path such as ``bsdfs[2]``."""
    stack: list[tuple[str, object]] = [(path, record)]  # not recursive: a file may nest as deep as it likes
    while stack:
        path, item = stack.pop()
        if isinstance(item, description.Record):
            yield path, item
            prefix = path + "." if path else ""
            children = [
                (prefix + name, getattr(item, name)) for name in item.__struct_fields__ if name not in NUMBER_FIELDS
            ]
        else:
            children = [(f"{path}[{i}]", child) for i, child in enumerate(item)]
        stack.extend(child for child in reversed(children) if isinstance(child[1], (description.Record, list)))


def value_at(scene: description.Scene, key: str) -> object:
    """A setting of a scene by the key of its override, such as ``integrator.max_depth`` or ``film.filter.type``; None
    for one of a record that is not there."""
    value = scene
    for step in key.split("."):
        if value is None:
            return None
        value = value.__struct_config__.tag if step == "type" else getattr(value, step)
    return value
