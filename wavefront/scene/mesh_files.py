"""Mesh files to arrays in the space of the file: PLY and OBJ through trimesh, glTF; nothing merged or smoothed.

The format readers of trimesh are called directly, not `trimesh.load`: they give the arrays as they are in the file,
where a `Trimesh` would compute, cache and copy. Their result is checked against what the file says it has, because
they leave out silently what they cannot read.
"""

from __future__ import annotations

import functools
import io
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from trimesh.exchange.obj import load_obj
from trimesh.exchange.ply import load_ply

from wavefront.errors import SceneError
from wavefront.scene import gltf_document
from wavefront.scene.gltf_accessors import TRIANGLES, read_primitive
from wavefront.scene.gltf_document import open_document
from wavefront.scene.gltf_graph import is_flat, world_nodes
from wavefront.scene.transforms import is_mirror

SUFFIXES = (".ply", ".obj", ".gltf", ".glb")


@dataclass
class FileMesh:
    """Arrays of one mesh file: positions (N, 3) float64, faces (M, 3) int64, normals (N, 3) and uvs (N, 2) or None."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uvs: np.ndarray | None


class _Unreadable(Exception):
    """What is wrong with the content of a file, in words."""


def read_mesh(path: str, where: str = "", part: tuple[int, int, int] | None = None) -> FileMesh:
    """Reads a mesh file. All parts of it are merged in file order; glTF node transforms are applied.

    The last files read are remembered as long as they do not change on disk, so that a scene that uses a mesh often
    reads it once; `clear_cache` lets go of them. The arrays are read-only.

    Args:
        path: PLY, OBJ, glTF or GLB file.
        where: Record path that an error names, such as ``shapes[3].file``.
        part: Mesh, primitive and UV set in a glTF file: this primitive alone, in the space of its mesh.

    Raises:
        SceneError: The file is missing, of another type, not readable, or without a triangle.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise SceneError(f"{path}: not a mesh file; allowed: {', '.join(SUFFIXES)}", path=where)
    try:
        stat = os.stat(path)
        if not os.path.isfile(path):
            raise SceneError(f"{path}: not a file", path=where)
        mesh = _read(os.path.abspath(path), suffix, part, stat.st_mtime_ns, stat.st_size)
    except FileNotFoundError:
        raise SceneError(f"{path}: file not found", path=where) from None
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror or error}", path=where) from None
    except _Unreadable as error:
        raise SceneError(f"{path}: {error}", path=where) from None
    return mesh


def clear_cache() -> None:
    """Lets go of the meshes that `read_mesh` remembers."""
    _read.cache_clear()
    gltf_document.clear_cache()


@functools.lru_cache(maxsize=1024)
def _read(path, suffix, part, _mtime, _size):
    readers = {".ply": _read_ply, ".obj": _read_obj}
    try:
        mesh = readers[suffix](path) if suffix in readers else _read_gltf(path, part)
    except (OSError, MemoryError, _Unreadable):
        raise
    except Exception as error:  # trimesh raises whatever its parser stumbles over
        text = " ".join(str(error).split()) or type(error).__name__
        raise _Unreadable(f"not a readable {suffix[1:].upper()} file ({text[:120]})") from None
    if not len(mesh.faces):
        raise _Unreadable("empty mesh: it has no triangles")
    for name, width in (("vertices", 3), ("faces", 3), ("normals", 3), ("uvs", 2)):
        array = getattr(mesh, name)
        if array is not None:
            if array.ndim != 2 or array.shape[1] != width:
                raise _Unreadable(f"its {name} do not have {width} numbers each")
            array.flags.writeable = False
    return mesh


# --- PLY -------------------------------------------------------------------------------------------------------


def _read_ply(path):
    with open(path, "rb") as file:
        # fix_texture would reorder vertices without their normals
        data = load_ply(file, fix_texture=False, skip_materials=True)
    if data.get("faces") is None:
        raise _Unreadable("empty mesh: it has no triangles")
    polygons = data["faces"]
    vertices = np.array(data["vertices"], np.float64)
    normals = data.get("vertex_normals")
    uvs = data["visual"].uv if "visual" in data else None
    per_corner = _corner_uvs(data["metadata"]["_ply_raw"]["face"]["data"], polygons)
    if per_corner is not None:
        # UVs belong to the corners of faces: every corner becomes a vertex
        _check_range(polygons, len(vertices))
        corners = polygons.reshape(-1)
        vertices, uvs = vertices[corners], per_corner
        normals = None if normals is None else np.asarray(normals)[corners]
        polygons = np.arange(len(corners)).reshape(polygons.shape)
    return FileMesh(vertices, _triangles(polygons), _floats(normals), _floats(uvs))


def _corner_uvs(face_data, polygons):
    """(corners, 2) from a `texcoord` list of the faces, or None."""
    names = face_data.dtype.names if isinstance(face_data, np.ndarray) else tuple(face_data)
    if not names or "texcoord" not in names:
        return None
    texcoord = face_data["texcoord"]
    texcoord = texcoord["f1"] if isinstance(face_data, np.ndarray) else texcoord
    if np.shape(texcoord) != (polygons.shape[0], 2 * polygons.shape[1]):
        raise _Unreadable("the faces' texcoord lists do not have two numbers per corner")
    return np.asarray(texcoord).reshape(-1, 2)


# --- OBJ -------------------------------------------------------------------------------------------------------


def _read_obj(path):
    data = Path(path).read_bytes().removeprefix(b"\xef\xbb\xbf")
    if not data.isascii():
        # only names and comments have other letters; trimesh would need another library to tell their encoding
        data = data.decode("latin-1").encode("ascii", "replace")
    if b"\t" in data or b"\n " in data:
        data = re.sub(rb"(?m)^ +", b"", data.replace(b"\t", b" "))
    if b"#" in data:
        data = re.sub(rb"#[^\n]*", b"", data)
    # without these lines trimesh makes one mesh of all groups, in file order
    data = re.sub(rb"(?m)^(?:usemtl|mtllib|[ogs])(?: .*)?$", b"", data) if _has_groups(data) else data
    if not re.search(rb"(?m)^f ", data):
        raise _Unreadable("empty mesh: it has no faces")
    if re.search(rb"(?m)^f [^\n]*-", data):
        raise _Unreadable("relative (negative) indices in OBJ faces are not supported")
    try:
        # maintain_order would average the UV indices of a vertex
        geometry = load_obj(io.BytesIO(data), skip_materials=True, maintain_order=False)
    except IndexError:
        raise _Unreadable("index out of range: a face names a vertex or a normal that is not in the file") from None
    if not geometry.get("geometry"):
        raise _Unreadable("empty mesh: it has no triangles")
    (mesh,) = geometry["geometry"].values()
    normals = mesh.get("vertex_normals")
    uvs = mesh["visual"].uv if mesh.get("visual") is not None else None
    for name, found, pattern in (
        ("texture coordinates", uvs, rb"(?m)^f +\d+/\d"),
        ("normals", normals, rb"(?m)^f +\d+/\d*/\d"),
    ):
        if found is None and re.search(pattern, data):
            reason = "some faces have none, or an index is out of range"
            raise _Unreadable(f"the {name} of its faces cannot be read: {reason}")
    return FileMesh(_floats(mesh["vertices"]), _triangles(mesh["faces"]), _floats(normals), _floats(uvs))


def _has_groups(data):
    return any(key in data for key in (b"\nusemtl", b"\nmtllib", b"\no", b"\ng", b"\ns")) or data[:1] in b"umogs"


# --- glTF ------------------------------------------------------------------------------------------------------


def _read_gltf(path, part):
    try:
        document = open_document(path)
        if part is not None:
            triangles = read_primitive(document, *part)
            return FileMesh(triangles.vertices, triangles.faces, triangles.normals, triangles.uvs)
        parts = [
            _gltf_part(read_primitive(document, node.mesh, i), matrix)
            for node, matrix in ((document.root.nodes[i], matrix) for i, matrix in world_nodes(document))
            if node.mesh is not None and not is_flat(matrix)
            for i, primitive in enumerate(document.item("meshes", node.mesh, "nodes").primitives)
            if primitive.mode >= TRIANGLES  # not points or lines
        ]
    except SceneError as error:
        raise _Unreadable(f"{error.path}: {error.message}" if error.path else error.message) from None
    if not parts:
        raise _Unreadable("empty mesh: it has no triangles")
    return _merged(parts)


def _gltf_part(triangles, matrix):
    normals = triangles.normals
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is counted where it is rendered
        vertices = triangles.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        if normals is not None:
            normals = normals @ np.linalg.inv(matrix[:3, :3])
    faces = triangles.faces[:, ::-1] if is_mirror(matrix) else triangles.faces
    return FileMesh(vertices, faces, normals, triangles.uvs)


def _merged(parts):
    """One mesh of several. Normals or UVs that only some have are refused: there is no right value for the others."""
    if len(parts) == 1:
        return parts[0]
    for name in ("normals", "uvs"):
        if len({getattr(part, name) is None for part in parts}) == 2:
            raise _Unreadable(f"some of its meshes have {name} and others have none; split the file")
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets[:-1], strict=True)])

    def joined(name):
        return None if getattr(parts[0], name) is None else np.concatenate([getattr(part, name) for part in parts])

    return FileMesh(joined("vertices"), faces, joined("normals"), joined("uvs"))


# --- arrays ----------------------------------------------------------------------------------------------------


def _floats(array):
    return None if array is None else np.array(array, np.float64)


def _triangles(polygons):
    """Fans of the polygons, in order: (M, 3) int64."""
    if not len(polygons):
        return np.zeros((0, 3), np.int64)
    if np.ndim(polygons) != 2 or np.asarray(polygons).dtype == object:
        return np.array(trimesh.geometry.triangulate_quads(polygons), np.int64)
    polygons = np.asarray(polygons, np.int64)
    count = polygons.shape[1] - 2
    if count < 1:
        raise _Unreadable("a face has fewer than three corners")
    fans = [np.stack([polygons[:, 0], polygons[:, i], polygons[:, i + 1]], axis=1) for i in range(1, count + 1)]
    return np.stack(fans, axis=1).reshape(-1, 3)


def _check_range(polygons, count):
    if polygons.min() < 0 or polygons.max() >= count:
        raise _Unreadable(f"index out of range: a face names vertex {polygons.max()} of {count}")
