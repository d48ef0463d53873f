"""Shapes to triangles in world space, and triangles to PLY files."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass

import numpy as np

from wavefront.errors import SceneError
from wavefront.scene import description
from wavefront.scene.images import replacing
from wavefront.scene.transforms import is_mirror, to_matrix

DISK_SEGMENTS = 256

# Ray-triangle tests in 32-bit floats multiply three lengths: beyond these, in metres, a triangle is never hit, or at a
# wrong distance (measured with `wp.mesh_query_ray`).
LARGEST_COORDINATE = 1e12
SMALLEST_TRIANGLE = 1e-13


@dataclass
class TriangleMesh:
    """Triangles in world space, counter-clockwise seen from the front.

    Attributes:
        vertices: (N, 3) float32, metres.
        faces: (M, 3) int32.
        normals: (N, 3) float32, unit length, or None: shade every triangle flat.
        uvs: (N, 2) float32, (0, 0) is the first row of an image, or None.
        dropped: Triangles left out because they cannot be rendered.
        notes: What the user should know: what was left out or replaced, with counts.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uvs: np.ndarray | None
    dropped: int = 0
    notes: tuple[str, ...] = ()


def tessellate(shape: description.AnyShape, where: str = "") -> TriangleMesh:
    """Triangles of a mesh, rectangle, cube or disk, in world space.

    The outward side stays outward under a mirroring transform (the winding is turned); normals go by the inverse
    transpose and are made unit length. Triangles that cannot be rendered are dropped and counted in a note: those
    without area, with a coordinate that is not finite or beyond `LARGEST_COORDINATE`, or smaller than
    `SMALLEST_TRIANGLE`. A file normal of length zero or not finite becomes the mean of the face normals around it, a UV
    that is not finite becomes (0, 0).

    Args:
        shape: The record; file paths absolute.
        where: Record path of the shape, such as ``shapes[3]``.

    Raises:
        SceneError: Missing, unreadable or empty mesh, an index out of range, normals or UVs of the wrong length, a bad
            transform. Its path starts with `where`.
    """
    matrix = to_matrix(shape.to_world, f"{where}.to_world")
    if isinstance(shape, description.Mesh):
        vertices, faces, normals, uvs, where = _mesh_arrays(shape, where)
    elif isinstance(shape, description.Rectangle):
        vertices, faces, normals, uvs = _rectangle()
    elif isinstance(shape, description.Cube):
        vertices, faces, normals, uvs = _cube()
    elif isinstance(shape, description.Disk):
        vertices, faces, normals, uvs = _disk()
    else:
        raise SceneError(f"a {type(shape).__name__.lower()} has no triangles", path=where)

    prefix = f"{shape.file}: " if getattr(shape, "file", None) else ""
    notes = []
    if normals is not None:
        normals = _replaced(normals, "normals", "by those of the faces", notes)
        normals = _scaled(_scaled(normals, axis=1) @ _scaled(np.linalg.inv(matrix[:3, :3])), axis=1)
    if uvs is not None:
        uvs = _replaced(uvs, "UVs", "by (0, 0)", notes)
    with np.errstate(over="ignore", invalid="ignore"):
        vertices = (vertices @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
    if is_mirror(matrix):
        faces = faces[:, ::-1]
    vertices, kept, reasons = _renderable(vertices, faces)
    if not kept.any():
        raise SceneError(f"{prefix}empty mesh: no triangle can be rendered ({reasons})", path=where)
    dropped = int(len(faces) - kept.sum())
    if dropped:
        notes.append(f"{dropped} triangles are left out ({reasons})")
    faces = np.ascontiguousarray(faces[kept], np.int32)
    if normals is not None:
        normals = _unit_normals(normals, vertices, faces)
    elif getattr(shape, "smooth_normals", False) and not shape.face_normals:
        normals = _unit_normals(np.zeros(vertices.shape), vertices, faces)
    if shape.flip_normals:
        faces = np.ascontiguousarray(faces[:, ::-1])
        normals = None if normals is None else -normals
    return TriangleMesh(
        np.ascontiguousarray(vertices),
        faces,
        None if normals is None else np.ascontiguousarray(normals, np.float32),
        None if uvs is None else np.ascontiguousarray(uvs, np.float32),
        dropped,
        tuple(notes),
    )


def own_space(shape: description.Mesh, where: str = "") -> TriangleMesh:
    """The triangles of a mesh as they are given, in 32-bit floats: not transformed, none left out, normals as they are.

    Raises:
        SceneError: As `tessellate` does, but for what that finds after the transform.
    """
    vertices, faces, normals, uvs, _ = _mesh_arrays(shape, where)
    with np.errstate(over="ignore"):
        vertices, normals, uvs = (a if a is None else a.astype(np.float32) for a in (vertices, normals, uvs))
    return TriangleMesh(vertices, faces.astype(np.int32), normals, uvs)


def has_file_normals(path: str, where: str = "") -> bool:
    """Whether a mesh file has vertex normals. Raises SceneError as `tessellate` does."""
    return _read_mesh(path, where).normals is not None


def clear_cache() -> None:
    """Lets go of the mesh files that are remembered for the next use."""
    if mesh_files := sys.modules.get("wavefront.scene.mesh_files"):
        mesh_files.clear_cache()


def _read_mesh(path, where, part=None):
    # Imported here, since trimesh takes most of a second to import and scenes without mesh files need none of it.
    from wavefront.scene.mesh_files import read_mesh

    return read_mesh(path, where, part)


# --- meshes ----------------------------------------------------------------------------------------------------


def _mesh_arrays(shape, where):
    """(vertices, faces, normals, uvs) in object space, float64, and the record path that errors of the data name."""
    inline = shape.vertices is not None or shape.faces is not None
    if (shape.file is not None) == inline:
        found = "both" if inline else "neither"
        raise SceneError(f"a mesh has either a file or vertices and faces; found {found}", path=where)
    if inline:
        if shape.vertices is None or shape.faces is None:
            raise SceneError("an inline mesh needs both vertices and faces", path=where)
        if not len(shape.vertices) or not len(shape.faces):
            raise SceneError("empty mesh: it has no triangles", path=where)
        vertices, faces = np.array(shape.vertices, np.float64), np.array(shape.faces, np.int64)
        normals = None if shape.normals is None else np.array(shape.normals, np.float64).reshape(-1, 3)
        uvs = None if shape.uvs is None else np.array(shape.uvs, np.float64).reshape(-1, 2)
        names = {name: f"{where}.{name}" for name in ("vertices", "faces", "normals", "uvs")}
    else:
        for name in ("normals", "uvs"):
            if getattr(shape, name) is not None:
                raise SceneError(f"{name} are for inline vertices; the file has its own", path=f"{where}.{name}")
        source = f"{where}.file"
        part = shape.part and (shape.part.mesh, shape.part.primitive, shape.part.uv_set)
        data = _read_mesh(shape.file, source, part)
        vertices, faces, normals, uvs = data.vertices, data.faces, data.normals, data.uvs
        names = dict.fromkeys(("vertices", "faces", "normals", "uvs"), source)
        where = source
    if shape.face_normals:
        normals = None
    _check(vertices, faces, normals, uvs, names, "" if inline else f"{shape.file}: ")
    flip = shape.flip_v
    if flip is None:
        flip = not inline and shape.file.lower().endswith(".obj")
    if flip and uvs is not None:
        uvs = np.column_stack([uvs[:, 0], 1.0 - uvs[:, 1]])
    return vertices, faces, normals, uvs, where


def _check(vertices, faces, normals, uvs, names, prefix):
    for name, array in (("vertices", vertices), ("normals", normals), ("uvs", uvs)):
        if array is None:
            continue
        if len(array) != len(vertices):
            raise SceneError(f"{prefix}{len(array)} {name} for {len(vertices)} vertices", path=names[name])
    outside = np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(axis=1))
    if len(outside):
        indices = ", ".join(map(str, faces[outside[0]]))
        message = f"index out of range: faces[{outside[0]}] is {indices} and there are {len(vertices)} vertices"
        raise SceneError(prefix + message, path=names["faces"])


def _replaced(array, name, by, notes):
    """A copy in which rows with a number that does not fit a float32 are zero; `notes` gets their count."""
    with np.errstate(over="ignore"):
        bad = ~np.isfinite(array.astype(np.float32)).all(axis=1)
    if bad.any():
        notes.append(f"{bad.sum()} {name} that are not finite are replaced {by}")
        array = np.where(bad[:, None], 0.0, array)
    return array


def _renderable(vertices, faces):
    """Which triangles can be rendered, (M,) bool, and in words how many cannot and why.

    The vertices come back with those that no such triangle may use moved onto others: they must not reach bounds or the
    acceleration structure.
    """
    finite = np.isfinite(vertices).all(axis=1)
    near = finite & (np.abs(np.where(finite[:, None], vertices, 0.0)) <= LARGEST_COORDINATE).all(axis=1)
    wanted = near[faces].all(axis=1)
    counts = {"with a coordinate that is not finite": ~finite[faces].all(axis=1)}
    counts[f"that reach beyond {LARGEST_COORDINATE:g} m"] = ~(wanted | counts["with a coordinate that is not finite"])
    vertices = np.where(near[:, None], vertices, vertices[faces[wanted][0, 0]] if wanted.any() else 0.0)
    corners = vertices.astype(np.float64)[faces]  # in which the cross product of float32 numbers does not underflow
    edges = corners[:, 1:] - corners[:, :1]
    area = (np.cross(edges[:, 0], edges[:, 1]) != 0.0).any(axis=1)
    small = np.abs(edges).max(axis=(1, 2)) < SMALLEST_TRIANGLE
    counts["without area"] = wanted & ~area
    counts[f"smaller than {SMALLEST_TRIANGLE:g} m"] = wanted & area & small
    reasons = ", ".join(f"{which.sum()} {why}" for why, which in counts.items() if which.any())
    return vertices, wanted & area & ~small, reasons


def _unit_normals(normals, vertices, faces):
    """(N, 3) unit normals; those of length zero become the mean of the face normals around them, weighted by angle."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    zero = length[:, 0] == 0.0
    if zero.any():
        normals = np.where(zero[:, None], _angle_weighted(vertices, faces), normals)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        # a vertex that no triangle uses, or whose triangles cancel out
        normals = np.where(length > 0.0, normals, (0.0, 0.0, 1.0))
        length = np.where(length > 0.0, length, 1.0)
    return normals / length


def _scaled(vectors, axis=None):
    """The array, or each row for axis 1, scaled so that its largest number is 1: lengths must not overflow."""
    largest = np.abs(vectors).max(axis=axis, keepdims=True)
    return vectors / np.where(largest > 0.0, largest, 1.0)


def _angle_weighted(vertices, faces):
    """(N, 3) sums of face normals weighted by the angle at the vertex (Thürmer and Wüthrich 1998)."""
    corners = vertices.astype(np.float64)[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    total = np.zeros((len(vertices), 3))
    for i in range(3):
        a = corners[:, (i + 1) % 3] - corners[:, i]
        b = corners[:, (i + 2) % 3] - corners[:, i]
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ij,ij->i", a, b))
        np.add.at(total, faces[:, i], angle[:, None] * normal)
    return total


# --- primitives: UVs as those of Mitsuba 3, so that textured scenes look the same --------------------------------


def _rectangle():
    vertices = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], np.float64)
    uvs = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float64)
    return vertices, np.array([(0, 1, 2), (0, 2, 3)]), np.tile((0.0, 0.0, 1.0), (4, 1)), uvs


# Normal, direction of u, direction of v of the sides of the cube.
_SIDES = (
    ((0, -1, 0), (0, 0, 1), (1, 0, 0)),
    ((0, 1, 0), (-1, 0, 0), (0, 0, -1)),
    ((1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ((0, 0, 1), (0, 1, 0), (1, 0, 0)),
    ((-1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, -1), (0, -1, 0), (1, 0, 0)),
)


def _cube():
    corners = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], np.float64)
    sides = np.array(_SIDES, np.float64)
    signed = 2.0 * corners - 1.0
    vertices = sides[:, None, 0] + signed[None, :, :1] * sides[:, None, 1] + signed[None, :, 1:] * sides[:, None, 2]
    faces = np.array([(0, 1, 2), (3, 0, 2)])[None] + 4 * np.arange(6)[:, None, None]
    normals = np.repeat(sides[:, 0], 4, axis=0)
    return vertices.reshape(-1, 3), faces.reshape(-1, 3), normals, np.tile(corners, (6, 1))


def _disk():
    """A fan; its rim is a little outside the unit circle, so that the area is exactly pi. u is the distance from the
    centre and v the angle over a full turn; every triangle has its own centre vertex, because v is not unique there."""
    n = DISK_SEGMENTS
    radius = np.sqrt(2.0 * np.pi / (n * np.sin(2.0 * np.pi / n)))
    turn = np.arange(n + 1) / n
    rim = np.stack([radius * np.cos(2.0 * np.pi * turn), radius * np.sin(2.0 * np.pi * turn), 0.0 * turn], axis=1)
    vertices = np.concatenate([rim, np.zeros((n, 3))])
    uvs = np.concatenate([np.stack([0.0 * turn + 1.0, turn], 1), np.stack([np.zeros(n), (np.arange(n) + 0.5) / n], 1)])
    faces = np.stack([n + 1 + np.arange(n), np.arange(n), np.arange(n) + 1], axis=1)
    return vertices, faces, np.tile((0.0, 0.0, 1.0), (len(vertices), 1)), uvs


# --- writing ---------------------------------------------------------------------------------------------------


def write_ply(path: str | os.PathLike, mesh: TriangleMesh) -> None:
    """Writes a binary little-endian PLY with normals (nx ny nz) and UVs (s t) where the mesh has them.

    The file appears whole or not at all.

    Raises:
        WavefrontError: It cannot be written.
    """
    columns = [(name, mesh.vertices[:, i]) for i, name in enumerate("xyz")]
    if mesh.normals is not None:
        columns += [(name, mesh.normals[:, i]) for i, name in enumerate(("nx", "ny", "nz"))]
    if mesh.uvs is not None:
        columns += [(name, mesh.uvs[:, i]) for i, name in enumerate("st")]
    table = np.empty(len(mesh.vertices), [(name, "<f4") for name, _ in columns])
    for name, values in columns:
        table[name] = values + np.float32(0.0)  # no minus zeros, which a reader may or may not keep
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("indices", "<i4", (3,))])
    faces["count"], faces["indices"] = 3, mesh.faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name, _ in columns]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    with replacing(path) as temporary:
        temporary.write_bytes("\n".join(header).encode() + table.tobytes() + faces.tobytes())
