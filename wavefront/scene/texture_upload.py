"""Textures on their way to the device: each image once, in the type of its file."""

from __future__ import annotations

import numpy as np
import warp as wp

from wavefront.errors import SceneError
from wavefront.scene import description
from wavefront.scene.images import load_image
from wavefront.scene.lookup import resolve_texture
from wavefront.texture import WRAP_MODES, TextureRecord, TextureTables, srgb_to_linear


def struct_array(struct: type, records: list[dict], device: str) -> wp.array:
    """A device array of structs from dicts of fields (in NumPy, since a struct a triangle in Python is slow)."""
    host = np.zeros(len(records), dtype=struct.numpy_dtype())
    for i, record in enumerate(records):
        for name, value in record.items():
            host[name][i] = value
    return wp.array(host, dtype=struct, device=device)


def rgb(value) -> np.ndarray:
    """A grey value or a colour as three numbers."""
    return np.broadcast_to(np.asarray(value, np.float64), 3)


class TextureAtlas:
    """Collects the textures that parameters refer to, each image once."""

    def __init__(self):
        self.records: list[dict] = []
        self.kinds: list[str] = []
        self.means: list[np.ndarray] = []
        self.bytes: list[np.ndarray] = []
        self.floats: list[np.ndarray] = []
        self.known: dict[tuple, int] = {}

    def parameter(self, scene: description.Scene, value, where: str, scalar: bool = False) -> tuple[object, int]:
        """Value and texture index (-1: none) of a parameter."""
        value = resolve_texture(scene, value)
        if isinstance(value, (description.Bitmap, description.Checkerboard)):
            return (1.0 if scalar else np.ones(3)), self.add(value, where, scalar)
        return (float(value) if scalar and np.ndim(value) == 0 else rgb(value)), -1

    def add(self, texture: description.Texture, where: str, scalar: bool) -> int:
        """Index of a texture; `scalar` textures hold numbers, not colours, unless they say otherwise."""
        key = (repr(texture), scalar)
        if key not in self.known:
            self.known[key] = len(self.records)
            rows = {"uv_row0": texture.uv_transform[0], "uv_row1": texture.uv_transform[1]}
            if isinstance(texture, description.Checkerboard):
                color0, color1 = rgb(texture.color0), rgb(texture.color1)
                self._append(
                    "checkerboard", rows | {"kind": 0, "color0": color0, "color1": color1}, (color0 + color1) / 2
                )
            else:
                self._add_bitmap(texture, where, scalar, rows)
        return self.known[key]

    def _add_bitmap(self, texture: description.Bitmap, where: str, scalar: bool, rows: dict):
        pixels = load_image(texture.file, where)
        height, width, channels = pixels.shape
        is_bytes = pixels.dtype == np.uint8
        srgb = texture.color_space == "srgb" or (texture.color_space == "auto" and is_bytes and not scalar)
        if not is_bytes:
            if not np.isfinite(pixels).all():
                y, x = np.argwhere(~np.isfinite(pixels).all(axis=2))[0]
                raise SceneError(f"{texture.file}: pixel ({x}, {y}) is not finite", path=where)
            if srgb:
                pixels = srgb_to_linear(np.maximum(pixels, 0.0)).astype(np.float32)
        store = self.bytes if is_bytes else self.floats
        first = sum(part.size for part in store)
        store.append(pixels.ravel())
        linear = pixels.reshape(-1, channels) / 255.0 if is_bytes else np.maximum(pixels.reshape(-1, channels), 0.0)
        if is_bytes and srgb:
            linear = srgb_to_linear(linear)
        record = {
            "kind": 1 if is_bytes else 2,
            "first": first,
            "width": width,
            "height": height,
            "channels": channels,
            "srgb": int(srgb),
            "nearest": int(texture.filter == "nearest"),
            "wrap": WRAP_MODES[texture.wrap],
        }
        self._append("bytes" if is_bytes else "floats", rows | record, np.broadcast_to(linear.mean(axis=0), 3))

    def _append(self, kind: str, record: dict, mean: np.ndarray):
        self.records.append(record)
        self.kinds.append(kind)
        self.means.append(np.asarray(mean, np.float64))

    def upload(self, device: str) -> TextureTables:
        tables = TextureTables()
        tables.records = struct_array(TextureRecord, self.records, device)
        tables.bytes = wp.array(np.concatenate(self.bytes) if self.bytes else np.zeros(0, np.uint8), device=device)
        tables.floats = wp.array(
            np.concatenate(self.floats) if self.floats else np.zeros(0), dtype=wp.float32, device=device
        )
        tables.srgb_to_linear = wp.array(srgb_to_linear(np.arange(256) / 255.0), dtype=wp.float32, device=device)
        return tables
