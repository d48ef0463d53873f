"""Builds glTF files part by part: for the scenes of `tools.make_scenes`, and for tests, which need odd ones."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from pathlib import Path

import numpy as np

COMPONENTS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


def png(pixels: np.ndarray) -> bytes:
    """A PNG of (H, W, 3) or (H, W, 4) uint8 or uint16, not compressed: the same bytes whatever library is installed."""
    height, width, channels = pixels.shape
    rows = pixels.astype(pixels.dtype.newbyteorder(">")).reshape(height, -1)
    data = b"".join(b"\0" + row.tobytes() for row in rows)
    header = struct.pack(">IIBBBBB", width, height, 8 * pixels.itemsize, {3: 2, 4: 6}[channels], 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(data, 0)), (b"IEND", b"")]
    parts = [struct.pack(">I4s", len(c), k) + c + struct.pack(">I", zlib.crc32(k + c)) for k, c in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


class GltfBuilder:
    """A glTF file in the making.

    Attributes:
        tree: The JSON, which may be changed at will.
        data: The binary buffer.
    """

    def __init__(self) -> None:
        self.tree: dict = {"asset": {"version": "2.0"}}
        self.data = bytearray()

    def add(self, kind: str, **item) -> int:
        """Appends to a list of the file, such as ``materials``; returns the index."""
        items = self.tree.setdefault(kind, [])
        items.append(item)
        return len(items) - 1

    def use(self, *extensions: str) -> None:
        """Declares extensions as used."""
        used = self.tree.setdefault("extensionsUsed", [])
        used.extend(name for name in extensions if name not in used)

    def view(self, data: bytes, **fields) -> int:
        """A buffer view of `data`, which starts at a multiple of 4 bytes."""
        self.data.extend(b"\0" * (-len(self.data) % 4))
        start = len(self.data)
        self.data.extend(data)
        return self.add("bufferViews", buffer=0, byteOffset=start, byteLength=len(data), **fields)

    def accessor(self, array: np.ndarray, stride: int | None = None, **fields) -> int:
        """An accessor of the rows of `array`, whose type is that of the components.

        Args:
            array: (N,) or (N, components).
            stride: Bytes from one element to the next; default: no gaps.
            fields: More keys, such as ``normalized=True``.
        """
        array = np.ascontiguousarray(array)
        rows = array.reshape(len(array), -1)
        size = rows.shape[1] * rows.itemsize
        data, view = rows.astype(rows.dtype.newbyteorder("<")).tobytes(), {}
        if stride is not None:
            data = b"".join(data[i : i + size].ljust(stride, b"\xee") for i in range(0, len(data), size))
            view["byteStride"] = stride
        return self.add(
            "accessors",
            bufferView=self.view(data, **view),
            componentType=COMPONENTS[str(array.dtype)],
            count=len(rows),
            type=TYPES[rows.shape[1]],
            **fields,
        )

    def mesh(self, vertices, faces=None, normals=None, uvs=None, name: str | None = None, **primitive) -> int:
        """A mesh of one primitive, 32-bit floats, with the bounds that the standard wants."""
        vertices = np.asarray(vertices, np.float32)
        bounds = {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
        attributes = {"POSITION": self.accessor(vertices, **bounds)}
        if normals is not None:
            attributes["NORMAL"] = self.accessor(np.asarray(normals, np.float32))
        if uvs is not None:
            attributes["TEXCOORD_0"] = self.accessor(np.asarray(uvs, np.float32))
        if faces is not None:
            primitive["indices"] = self.accessor(np.asarray(faces, np.uint32).ravel())
        item = {"primitives": [{"attributes": attributes, **primitive}]}
        return self.add("meshes", **item, **({} if name is None else {"name": name}))

    def texture(self, png: bytes, **sampler) -> int:
        """A texture of an embedded PNG or JPEG."""
        mime = "image/png" if png[:4] == b"\x89PNG" else "image/jpeg"
        fields = {"source": self.add("images", bufferView=self.view(png), mimeType=mime)}
        if sampler:
            fields["sampler"] = self.add("samplers", **sampler)
        return self.add("textures", **fields)

    def scene(self, *nodes: int, name: str | None = None) -> int:
        """A scene of root nodes."""
        fields = {} if name is None else {"name": name}
        return self.add("scenes", nodes=list(nodes), **fields)

    def _finished(self, **buffer) -> bytes:
        tree = dict(self.tree)
        if self.data:
            tree["buffers"] = [{"byteLength": len(self.data), **buffer}, *tree.get("buffers", [])[1:]]
        return json.dumps(tree).encode()

    def glb(self) -> bytes:
        """The bytes of a GLB file."""
        text, data = self._finished(), bytes(self.data)
        chunks = [(b"JSON", text.ljust(-(-len(text) // 4) * 4))]
        if data:
            chunks.append((b"BIN\0", data.ljust(-(-len(data) // 4) * 4, b"\0")))
        body = b"".join(struct.pack("<I4s", len(chunk), kind) + chunk for kind, chunk in chunks)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body

    def gltf(self) -> bytes:
        """The bytes of a glTF file that holds its buffer as a data URI."""
        return self._finished(uri="data:application/octet-stream;base64," + base64.b64encode(self.data).decode())

    def write(self, path: Path) -> Path:
        """Writes GLB or glTF, by the suffix."""
        path.write_bytes(self.glb() if path.suffix == ".glb" else self.gltf())
        return path
