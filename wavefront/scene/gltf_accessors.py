"""Accessors of glTF files to arrays, and primitives to triangles (glTF 2.0, sections 3.6 and 3.7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavefront.scene.gltf_document import Document, Primitive

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_NAMES = {5120: "byte", 5121: "unsigned byte", 5122: "short", 5123: "unsigned short", 5125: "unsigned int",
          5126: "float"}  # fmt: skip
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_ZEROS = 1 << 24  # elements of an accessor without data of its own: a number in a small file must not fill the memory
TRIANGLES, STRIP, FAN = 4, 5, 6

# What an attribute may be made of: (type, components, and with KHR_mesh_quantization); `n` marks normalised integers.
_INDICES = ("SCALAR", ("5121", "5123", "5125"), ())
_POSITION = ("VEC3", ("5126",), ("5120", "5120n", "5121", "5121n", "5122", "5122n", "5123", "5123n"))
_NORMAL = ("VEC3", ("5126",), ("5120n", "5122n"))
_TEXCOORD = ("VEC2", ("5126", "5121n", "5123n"), ("5120", "5120n", "5121", "5122", "5122n", "5123"))


@dataclass
class Triangles:
    """One primitive: vertices (N, 3), faces (M, 3), normals (N, 3) and uvs (N, 2), these two or None. 64 bits each."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uvs: np.ndarray | None


def read_accessor(document: Document, index: int, where: str) -> np.ndarray:
    """The elements of an accessor, as they are stored: sparse ones put in place, integers not yet normalised.

    Args:
        document: The file.
        index: Of the accessor; SCALAR or VEC2 to VEC4.
        where: The place in the JSON that refers to it.

    Returns:
        (count, components) of the type of the file.

    Raises:
        SceneError: An index out of range, elements beyond the end of their buffer view, or a sparse index that is not
            ascending or beyond the count.
    """
    accessor = document.item("accessors", index, where)
    place = f"accessors[{index}]"
    kind, width = np.dtype(COMPONENTS[accessor.component_type]), _WIDTHS.get(accessor.type)
    if width is None:
        raise document.error(f"{place}.type", f"{accessor.type} is not supported here")
    if accessor.buffer_view is None:
        if accessor.count > _ZEROS:
            raise document.error(f"{place}.count", f"without bufferView, at most {_ZEROS} elements are supported")
        elements = np.zeros((accessor.count, width), kind)
    else:
        elements = _elements(document, accessor.buffer_view, accessor.byte_offset, accessor.count, kind, width, place)
    if accessor.sparse is None:
        return elements
    sparse, place = accessor.sparse, f"{place}.sparse"
    if sparse.count > accessor.count:
        raise document.error(f"{place}.count", f"expected at most {accessor.count}; found {sparse.count}")
    indices, values = sparse.indices, sparse.values
    at = _elements(document, indices.buffer_view, indices.byte_offset, sparse.count,
                   np.dtype(COMPONENTS[indices.component_type]), 1, f"{place}.indices")[:, 0]  # fmt: skip
    replaced = _elements(document, values.buffer_view, values.byte_offset, sparse.count, kind, width, f"{place}.values")
    at = at.astype(np.int64)
    if at[-1] >= accessor.count or (np.diff(at) <= 0).any():
        raise document.error(f"{place}.indices", f"expected ascending indices below {accessor.count}")
    elements = elements.copy()
    elements[at] = replaced
    return elements


def _elements(document, view_index, offset, count, kind, width, place):
    """(count, width) elements of a buffer view, without a copy."""
    data = document.view(view_index, f"{place}.bufferView")
    size = kind.itemsize * width
    stride = document.root.buffer_views[view_index].byte_stride or size
    if stride < size:
        message = f"byteStride is {stride}, but an element of {place} has {size} bytes"
        raise document.error(f"bufferViews[{view_index}].byteStride", message)
    if offset + (count - 1) * stride + size > len(data):
        message = f"{count} elements of {size} bytes do not fit into bufferViews[{view_index}] of {len(data)} bytes"
        raise document.error(place, message)
    return np.ndarray((count, width), kind, data, offset, (stride, kind.itemsize))


def normalised(values: np.ndarray) -> np.ndarray:
    """Integers as the numbers in [0, 1] or [-1, 1] that they stand for (section 3.6.2.2), rounded to 32 bits."""
    return np.maximum(values / float(np.iinfo(values.dtype).max), -1.0).astype(np.float32)


def read_primitive(document: Document, mesh: int, primitive: int, uv_set: int = 0) -> Triangles:
    """The triangles of one primitive, in the space of its mesh, with the vertices that they use.

    Args:
        document: The file.
        mesh: Index of the mesh.
        primitive: Index of the primitive in the mesh.
        uv_set: n of ``TEXCOORD_n``.

    Raises:
        SceneError: The primitive has no triangles or no positions, an accessor has the wrong type or length, or an
            index is out of range.
    """
    where = f"meshes[{mesh}].primitives[{primitive}]"
    record = _primitive(document, mesh, primitive)
    attributes = record.attributes
    if attributes.POSITION is None:
        raise document.error(f"{where}.attributes", "has no POSITION")
    vertices = _floats(document, attributes.POSITION, f"{where}.attributes.POSITION", _POSITION)
    count = len(vertices)
    normals = uvs = None
    if attributes.NORMAL is not None:
        normals = _floats(document, attributes.NORMAL, f"{where}.attributes.NORMAL", _NORMAL, count)
    texcoord = getattr(attributes, f"TEXCOORD_{uv_set}", None)
    if texcoord is not None:
        uvs = _floats(document, texcoord, f"{where}.attributes.TEXCOORD_{uv_set}", _TEXCOORD, count)
    if record.indices is None:
        corners = np.arange(count)
    else:
        _check(document, record.indices, f"{where}.indices", _INDICES)
        corners = read_accessor(document, record.indices, f"{where}.indices")[:, 0].astype(np.int64)
        if corners.max() >= count:
            message = f"index out of range: {corners.max()}, and there are {count} vertices"
            raise document.error(f"{where}.indices", message)
    faces = _faces(document, corners, record.mode, where)
    used = np.zeros(count, bool)
    used[faces] = True
    if not used.all():  # primitives may share one long list of vertices
        vertices, normals, uvs = (array if array is None else array[used] for array in (vertices, normals, uvs))
        faces = (np.cumsum(used) - 1)[faces]
    return Triangles(vertices, faces, normals, uvs)


def _primitive(document, mesh, primitive) -> Primitive:
    primitives = document.item("meshes", mesh, "").primitives
    if primitive >= len(primitives):
        raise document.error(f"meshes[{mesh}]", f"has no primitive {primitive}; it has {len(primitives)}")
    return primitives[primitive]


def _faces(document, corners, mode, where) -> np.ndarray:
    """(M, 3) indices, counter-clockwise each (section 3.7.2.1)."""
    if mode < TRIANGLES:
        raise document.error(f"{where}.mode", f"points and lines (mode {mode}) are not supported; supported: 4, 5, 6")
    count = len(corners)
    if count < 3 or (mode == TRIANGLES and count % 3):
        message = f"triangles need {'a multiple of three' if mode == TRIANGLES else 'three'} corners; found {count}"
        raise document.error(where, message)
    if mode == TRIANGLES:
        return corners.reshape(-1, 3)
    if mode == FAN:
        return np.stack([corners[1:-1], corners[2:], np.broadcast_to(corners[0], count - 2)], axis=1)
    odd = np.arange(count - 2) % 2
    return np.stack(
        [corners[:-2], np.where(odd, corners[2:], corners[1:-1]), np.where(odd, corners[1:-1], corners[2:])], axis=1
    )


def _floats(document, index, where, allowed, count=None) -> np.ndarray:
    """(N, components) float64."""
    _check(document, index, where, allowed)
    values = read_accessor(document, index, where)
    if count is not None and len(values) != count:
        raise document.error(where, f"accessors[{index}] has {len(values)} elements for {count} positions")
    if document.root.accessors[index].normalized and values.dtype.kind in "iu":
        values = normalised(values)
    return values.astype(np.float64)


def _check(document, index, where, allowed) -> None:
    """Raises SceneError unless an accessor is of an `allowed` type."""
    shape, plain, quantised = allowed
    accessor = document.item("accessors", index, where)
    found = f"{accessor.component_type}{'n' * (accessor.normalized and accessor.component_type != 5126)}"
    kinds = plain + (quantised if "KHR_mesh_quantization" in document.root.extensions_used else ())
    if accessor.type == shape and found in kinds:
        return
    wanted = ", ".join(f"{_name(kind)} ({kind[:4]})" for kind in kinds)
    message = (
        f"expected {shape} of {wanted}; found {accessor.type} of {_name(found)} ({found[:4]}) in accessors[{index}]"
    )
    raise document.error(where, message)


def _name(kind):
    return ("normalized " if kind.endswith("n") else "") + _NAMES[int(kind[:4])]
