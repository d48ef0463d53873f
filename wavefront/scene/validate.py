"""What types cannot say: whether a scene's names, files, nesting and numbers make sense together."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from wavefront.errors import SceneError
from wavefront.scene import description
from wavefront.scene.ior import CONDUCTORS, INDEX_OF_REFRACTION
from wavefront.scene.lookup import BSDF_FIELDS, MEDIUM_FIELDS, NUMBER_FIELDS, TEXTURE_FIELDS, shown, unknown_name, walk
from wavefront.scene.meshes import LARGEST_COORDINATE
from wavefront.scene.transforms import to_matrix

GLTF_SUFFIXES = (".gltf", ".glb")
MESH_SUFFIXES = (".ply", ".obj", *GLTF_SUFFIXES)
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff", ".exr", ".hdr")
_REFLECTING = ("diffuse", "oren_nayar", "conductor", "rough_conductor", "plastic", "rough_plastic", "principled")
_MAPS = ("normal_map", "bump_map")
_HOLDERS = (
    description.TwoSided,
    description.Mask,
    description.NormalMap,
    description.BumpMap,
    description.Blend,
)
_LARGEST = float(np.finfo(np.float32).max)


def validate(
    scene: description.Scene, file: str | os.PathLike | None = None, warn: Callable[[str], object] | None = None
) -> list[str]:
    """Checks `scene` and returns warnings, each of which is also passed to `warn`.

    Raises:
        SceneError: The first thing found that makes the scene impossible to render, with its record path.
    """
    try:
        _check_names(scene)
        bsdfs = {bsdf.name: bsdf for bsdf in scene.bsdfs if bsdf.name}
        textures = {texture.name for texture in scene.textures if texture.name}
        media = {medium.name for medium in scene.media if medium.name}
        for path, record in walk(scene):
            _check_numbers(record, path)
            _check_references(record, path, bsdfs, textures, media)
            if hasattr(record, "alpha_u"):
                _check_roughness(record, path)
            if isinstance(record, (description.Bitmap, description.Envmap)):
                embedded = getattr(record, "image", None) is not None
                _check_file(record.file, GLTF_SUFFIXES if embedded else IMAGE_SUFFIXES, "image", f"{path}.file")
            elif isinstance(record, (description.Conductor, description.RoughConductor)):
                _check_conductor(record, path)
            elif hasattr(record, "int_ior"):
                _check_dielectric(record, path)
            elif isinstance(record, description.Principled):
                _check_principled(record, path)
            elif isinstance(record, description.Mesh):
                _check_mesh(record, path)
            elif isinstance(record, _HOLDERS):
                _check_nesting(record, path, bsdfs)
                if isinstance(record, description.BumpMap):
                    _check_height(record, path, scene)
            elif isinstance(record, description.Homogeneous):
                _check_value([record.scale * value for value in np.ravel(record.sigma_a).tolist()], f"{path}.sigma_a")
        for i, shape in enumerate(scene.shapes):
            _check_shape(shape, f"shapes[{i}]")
        _check_groups(scene)
        _check_camera(scene.camera)
        _check_crop(scene.film)
        _check_emitters(scene)
        for i, aov in enumerate(scene.film.aovs):
            if aov in scene.film.aovs[:i]:
                _fail(f"film.aovs[{i}]", f"{aov!r} is given twice")
    except SceneError as error:
        raise SceneError(error.message, file, error.path) from None
    warnings = _find_warnings(scene)
    for message in warnings if warn else ():
        warn(message)
    return warnings


def _fail(path, message):
    raise SceneError(message, None, path)


def _find_warnings(scene):
    warnings = []
    if not scene.shapes and not scene.instances:
        warnings.append("the scene has no shapes")
    if not scene.emitters and all(shape.emitter is None for shape in scene.shapes):
        warnings.append("the scene has no emitter: the image will be black")
    for i, emitter in enumerate(scene.emitters if not scene.integrator.nee else ()):
        if isinstance(emitter, (description.Directional, description.Point, description.Spot)):
            kind = emitter.__struct_config__.tag
            warnings.append(
                f"emitters[{i}]: a {kind} light adds nothing where integrator.nee is false: no ray meets it"
            )
    if "variance" in scene.film.aovs and scene.integrator.sampler != "independent":
        warnings.append(
            "film.aovs: variance is that of independent samples; those of integrator.sampler "
            f"{shown(scene.integrator.sampler)} are not, and have less as a rule"
        )
    for kind in ("textures", "bsdfs", "media"):
        for i, record in enumerate(getattr(scene, kind)):
            if not record.name:
                warnings.append(f"{kind}[{i}] has no name, so nothing can refer to it")
    used = {instance.group for instance in scene.instances}
    for i, group in enumerate(scene.groups):
        if group.name not in used:
            warnings.append(f"groups[{i}]: no instance puts {shown(group.name)} into the scene")
    return warnings


# --- names and references --------------------------------------------------------------------------------------


def _check_names(scene):
    for kind in ("textures", "bsdfs", "media", "emitters", "groups", "shapes", "instances"):
        seen = set()
        for i, record in enumerate(getattr(scene, kind)):
            if record.name and record.name in seen:
                _fail(f"{kind}[{i}].name", f"the name {shown(record.name)} is taken by an earlier entry of {kind}")
            seen.add(record.name)


def _check_references(record, path, bsdfs, textures, media):
    for field in record.__struct_fields__:
        value = getattr(record, field)
        if isinstance(value, str):
            if field in TEXTURE_FIELDS and value not in textures:
                _fail(f"{path}.{field}", unknown_name("texture", value, textures))
            if field in BSDF_FIELDS and value not in bsdfs:
                _fail(f"{path}.{field}", unknown_name("BSDF", value, bsdfs))
            if field in MEDIUM_FIELDS and value not in media:
                _fail(f"{path}.{field}", unknown_name("medium", value, media))


# --- BSDFs -----------------------------------------------------------------------------------------------------


def _check_conductor(bsdf, path):
    given = [name for name in ("material", "eta", "k") if getattr(bsdf, name) is not None]
    if given not in (["material"], ["eta", "k"]):
        _fail(path, f"a conductor has material, or eta and k; found {' and '.join(given) if given else 'none of them'}")
    if bsdf.material is not None and bsdf.material not in CONDUCTORS:
        _fail(f"{path}.material", unknown_name("metal", bsdf.material, CONDUCTORS))


def _check_roughness(bsdf, path):
    given = [name for name in ("alpha", "alpha_u", "alpha_v") if getattr(bsdf, name) is not None]
    if given not in ([], ["alpha"], ["alpha_u", "alpha_v"]):
        _fail(path, f"a rough surface has alpha, or alpha_u and alpha_v; found {' and '.join(given)}")


def _check_dielectric(bsdf, path):
    for field in ("int_ior", "ext_ior"):
        ior = getattr(bsdf, field)
        if isinstance(ior, str) and ior not in INDEX_OF_REFRACTION:
            _fail(f"{path}.{field}", unknown_name("index of refraction", ior, INDEX_OF_REFRACTION))


def _check_principled(bsdf, path):
    if bsdf.eta is not None and bsdf.specular is not None:
        _fail(path, "a principled BSDF has eta or specular; found both")


def _check_nesting(bsdf, path, bsdfs):
    """From the outside to the inside: mask, map, twosided, map, blends, what scatters; a surface has one map at most.

    So nesting ends by itself.
    """
    for field in sorted(BSDF_FIELDS.intersection(bsdf.__struct_fields__)):
        inner, place = getattr(bsdf, field), f"{path}.{field}"
        if isinstance(inner, str):
            _check_cycle(inner, place, bsdfs)
            inner = bsdfs.get(inner)  # an unknown name is reported where the reference is checked
        if inner is None:
            continue
        kind = _kind(inner)
        if isinstance(bsdf, description.TwoSided):
            _check_side(kind, inner, place, bsdfs)
        elif isinstance(bsdf, description.Mask) and kind == "mask":
            _fail(place, "a mask cannot hold another mask; multiply their opacities")
        elif isinstance(bsdf, description.Blend) and kind in (*_MAPS, "mask", "twosided"):
            _fail(place, f"a blend cannot hold {kind}; put the {kind} around the blend")
        elif isinstance(bsdf, (description.NormalMap, description.BumpMap)):
            _check_map(bsdf.__struct_config__.tag, kind, inner, place, bsdfs)


def _check_side(kind, inner, path, bsdfs):
    """A side of a two-sided BSDF reflects."""
    if kind in _MAPS:
        inner = _resolved(inner.bsdf, bsdfs)
        kind, path = (_kind(inner) if inner is not None else "diffuse"), f"{path}.bsdf"
    allowed = f"allowed: {', '.join(_REFLECTING)}, a blend of those, and a normal_map or bump_map around one"
    if kind == "blend":
        for part in _blended(inner, bsdfs):
            if part not in (*_REFLECTING, *_MAPS, "mask", "twosided"):  # of which a blend says itself
                _fail(path, f"a twosided BSDF cannot hold a blend with {part}; {allowed}")
    elif kind not in _REFLECTING:
        _fail(path, f"a twosided BSDF cannot hold {kind}; {allowed}")


def _check_map(holder, kind, inner, path, bsdfs):
    if kind in (*_MAPS, "mask", "null"):
        hint = {"mask": f"; put the {holder} into the mask", "null": ", which has no normal"}.get(kind, "")
        _fail(path, f"a {holder} cannot hold {kind}{hint}")
    for side in ("front", "back") if kind == "twosided" else ():
        nested = _resolved(getattr(inner, side), bsdfs)
        if nested is not None and nested.__struct_config__.tag in _MAPS:
            _fail(f"{path}.{side}", f"a {holder} cannot hold {nested.__struct_config__.tag}")


def _check_height(bsdf, path, scene):
    named = {texture.name: texture for texture in scene.textures}
    height = named.get(bsdf.height) if isinstance(bsdf.height, str) else bsdf.height
    if isinstance(height, description.Checkerboard) or getattr(height, "filter", "") == "nearest":
        found = "a checkerboard" if isinstance(height, description.Checkerboard) else "filter 'nearest'"
        _fail(f"{path}.height", f"expected a bitmap with the filter 'bilinear', which has slopes; found {found}")


def _kind(bsdf):
    if isinstance(bsdf, description.Principled) and bsdf.spec_trans != 0.0:
        return "principled with spec_trans"
    return bsdf.__struct_config__.tag


def _resolved(bsdf, bsdfs):
    return bsdfs.get(bsdf) if isinstance(bsdf, str) else bsdf


def _blended(blend, bsdfs):
    """Kinds that a blend of blends mixes; a part that is unknown or part of a cycle is left out."""
    stack, seen = [blend], set()
    while stack:
        bsdf = stack.pop()
        if bsdf is None or id(bsdf) in seen:
            continue
        if isinstance(bsdf, description.Blend):
            seen.add(id(bsdf))
            stack += [_resolved(bsdf.first, bsdfs), _resolved(bsdf.second, bsdfs)]
        else:
            yield _kind(bsdf)


def _check_cycle(name, path, bsdfs):
    """Follows the references that start with `name`; a name that leads back to itself is refused."""
    open_names, stack = [], [(name, 0)]
    while stack:
        name, depth = stack.pop()
        del open_names[depth:]
        if name in open_names:
            chain = [*open_names[open_names.index(name) :], name]
            _fail(path, f"BSDFs refer to each other in a cycle: {' -> '.join(map(shown, chain))}")
        open_names.append(name)
        for _, record in walk(bsdfs[name]) if name in bsdfs else ():
            for field in BSDF_FIELDS.intersection(record.__struct_fields__):
                if isinstance(getattr(record, field), str):
                    stack.append((getattr(record, field), depth + 1))


# --- emitters --------------------------------------------------------------------------------------------------


def _check_emitters(scene):
    environment = None
    for i, emitter in enumerate(scene.emitters):
        path = f"emitters[{i}]"
        sky = isinstance(emitter, description.SunSky) and emitter.sky_scale > 0.0
        if sky or isinstance(emitter, (description.Constant, description.Envmap)):
            if environment is not None:
                _fail(path, f"a scene has at most one environment; {environment} is one already")
            environment = path
        if isinstance(emitter, description.Envmap):
            matrix = _check_transform(emitter.to_world, f"{path}.to_world")
            if matrix is not None and not _is_similarity(matrix):
                _fail(f"{path}.to_world", "an environment can be rotated; found different scales or a shear")
        direction = getattr(emitter, "direction", None)
        if direction is not None and not np.linalg.norm(direction) > 0.0:
            _fail(f"{path}.direction", "the direction is zero")
        if isinstance(emitter, description.SunSky):
            _check_sun(emitter, path)
        if isinstance(emitter, description.Spot):
            if emitter.beam_width is not None and emitter.beam_width > emitter.cutoff_angle:
                found = f"{emitter.beam_width:g} and {emitter.cutoff_angle:g}"
                _fail(f"{path}.beam_width", f"expected at most cutoff_angle; found {found}")
        if isinstance(emitter, description.Sun) and emitter.irradiance is not None and emitter.radiance is not None:
            _fail(path, "a sun has irradiance or radiance; found both")


def _check_sun(emitter, path):
    length = np.linalg.norm(emitter.up)
    if not length > 0.0:
        _fail(f"{path}.up", "the direction is zero")
    sine = -np.dot(emitter.direction, emitter.up) / (length * np.linalg.norm(emitter.direction))
    if not sine > 0.0:
        elevation = np.degrees(np.arcsin(max(sine, -1.0)))
        _fail(
            f"{path}.direction", f"the sky is one of daylight; found the sun {elevation:.1f} degrees above the horizon"
        )


# --- camera and film -------------------------------------------------------------------------------------------


def _check_camera(camera):
    matrix = _check_transform(camera.to_world, "camera.to_world")
    farthest = 10.0 * LARGEST_COORDINATE  # with room to see all of what may be there
    if matrix is not None and np.abs(matrix[:3, 3]).max() > farthest:
        _fail("camera.to_world", f"the camera is beyond {farthest:g} m, where 32-bit rays hit nothing")
    scale = 1.0 if matrix is None else np.abs(matrix[:3, :3]).max()
    for name in ("aperture_radius", "width"):
        if getattr(camera, name, 0.0) * scale > _LARGEST:
            _fail(
                f"camera.{name}", f"times the scale of to_world it is above {_LARGEST:.4g}, too large for 32-bit floats"
            )


def _check_crop(film):
    window = film.window
    if window.x + window.width > film.width or window.y + window.height > film.height:
        found = f"{window.width}x{window.height} at ({window.x}, {window.y})"
        _fail("film.crop", f"expected a window inside the film of {film.width}x{film.height} pixels; found {found}")


# --- shapes ----------------------------------------------------------------------------------------------------


def _check_shape(shape, path):
    matrix = _check_transform(shape.to_world, f"{path}.to_world")
    if isinstance(shape, description.Sphere) and matrix is not None and not _is_similarity(matrix):
        _fail(f"{path}.to_world", "a sphere can be scaled uniformly only; found different scales or a shear")


def _check_groups(scene):
    for i, group in enumerate(scene.groups):
        if not group.shapes:
            _fail(f"groups[{i}].shapes", "the group is empty")
        for j, shape in enumerate(group.shapes):
            path = f"groups[{i}].shapes[{j}]"
            _check_shape(shape, path)
            if shape.emitter is not None:
                _fail(f"{path}.emitter", "a shape of a group cannot emit: lights are not instanced")
    names = {group.name for group in scene.groups}
    for i, instance in enumerate(scene.instances):
        if instance.group not in names:
            _fail(f"instances[{i}].group", unknown_name("group", instance.group, names))
        path = f"instances[{i}].to_world"
        matrix = _check_transform(instance.to_world, path)
        if matrix is not None and not np.all(np.abs(np.linalg.inv(matrix[:3, :3])) <= _LARGEST):
            _fail(path, f"the transform's inverse has a number above {_LARGEST:.4g}, too large for 32-bit floats")


def _check_file(file, suffixes, kind, path):
    suffix = Path(file).suffix.lower()
    if suffix not in suffixes:
        _fail(path, f"unknown {kind} format {shown(suffix)} of {shown(file)}; allowed: {', '.join(suffixes)}")
    if not os.path.isfile(file):
        _fail(path, f"file not found: {shown(file)}")


def _check_mesh(mesh, path):
    inline = [name for name in ("vertices", "faces", "normals", "uvs") if getattr(mesh, name) is not None]
    if mesh.file is not None:
        if inline:
            _fail(path, f"a mesh with a file has no {inline[0]} of its own")
        _check_file(mesh.file, MESH_SUFFIXES, "mesh", f"{path}.file")
        if mesh.part is not None and Path(mesh.file).suffix.lower() not in GLTF_SUFFIXES:
            _fail(f"{path}.part", f"only glTF files have parts; found {shown(mesh.file)}")
        return
    if mesh.part is not None:
        _fail(f"{path}.part", "only a mesh with a file has parts")
    if "vertices" not in inline or "faces" not in inline:
        _fail(
            path, f"a mesh has file, or vertices and faces; found {' and '.join(inline) if inline else 'none of them'}"
        )
    for name in ("vertices", "faces"):
        if len(getattr(mesh, name)) == 0:
            _fail(f"{path}.{name}", "the mesh is empty")
    count = len(mesh.vertices)
    for name in ("normals", "uvs"):
        if name in inline and len(getattr(mesh, name)) != count:
            _fail(f"{path}.{name}", f"expected one per vertex, {count}; found {len(getattr(mesh, name))}")
    try:
        faces = np.asarray(mesh.faces, dtype=np.int64)
        wrong = (faces < 0) | (faces >= count)
    except OverflowError:  # an index of more than 64 bits
        wrong = np.array([[not 0 <= index < count for index in face] for face in mesh.faces])
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        found = shown(str(mesh.faces[row][column]))[1:-1]
        _fail(f"{path}.faces[{row}]", f"expected vertex indices from 0 to {count - 1}; found {found}")


# --- numbers and transforms ------------------------------------------------------------------------------------


def _check_numbers(record, path):
    """But for those of a mesh, of which `meshes.tessellate` leaves out what cannot be rendered."""
    for field in record.__struct_fields__:
        value = getattr(record, field)
        place = f"{path}.{field}" if path else field
        if isinstance(value, (float, int)) or (isinstance(value, (tuple, list)) and field not in NUMBER_FIELDS):
            _check_value(value, place)


def _check_value(value, place):
    if isinstance(value, (tuple, list)):
        for i, item in enumerate(value):
            _check_value(item, f"{place}[{i}]")
    elif isinstance(value, (float, int)) and not abs(value) <= _LARGEST:
        if value != value or abs(value) == float("inf"):
            _fail(place, f"expected a finite number; found {value}")
        _fail(place, f"expected a number of at most {_LARGEST:.4g}, as 32-bit floats are; found {float(value):g}")


def _check_transform(transform, path):
    """The matrix of a transform that was found to be well-formed and invertible; None where there is none."""
    if not transform:
        return None
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is an error of its own
        matrix = to_matrix(transform, path)
    if not np.all(np.abs(matrix) <= _LARGEST):
        _fail(path, f"the transform's matrix has a number above {_LARGEST:.4g}, too large for 32-bit floats")
    return matrix


def _is_similarity(matrix):
    """Whether the matrix scales all directions alike, up to float32 rounding."""
    values = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    return values[0] - values[2] <= 1e-4 * values[0]
