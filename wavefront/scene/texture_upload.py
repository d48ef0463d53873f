"""Textures on their way to the device: each image once, in the type of its file."""

from __future__ import annotations

import numpy as np
import warp as wp

from wavefront.errors import SceneError
from wavefront.scene import description
from wavefront.scene.images import load_image
from wavefront.scene.lookup import resolve_texture
from wavefront.texture import IMAGE_TYPES, KINDS, WRAP_MODES, TextureRecord, TextureTables, srgb_to_linear


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


def load_bitmap(texture: description.Bitmap, where: str) -> np.ndarray:
    """Pixels of the image of a record, or of its one channel, as `load_image` gives them. Raises SceneError as that."""
    if texture.image is None:
        pixels = load_image(texture.file, where, alpha=texture.channel == "a")
    else:
        from wavefront.scene.gltf_images import load_embedded  # only here: hardly any scene needs it

        pixels = load_embedded(texture.file, texture.image, where, alpha=texture.channel == "a")
    if texture.channel in (None, "a"):
        return pixels
    return np.ascontiguousarray(pixels[:, :, min("rgb".index(texture.channel), pixels.shape[2] - 1), None])


class TextureAtlas:
    """Collects the textures that parameters refer to, each image once."""

    def __init__(self):
        self.records: list[dict] = []
        self.kinds: list[str] = []
        self.means: list[np.ndarray] = []
        self.pixels: dict[str, list[np.ndarray]] = {kind: [] for kind in IMAGE_TYPES}
        self.known: dict[tuple, int] = {}
        self.images: dict[tuple, tuple[str, int, np.ndarray]] = {}
        self.references: list[int] = []  # of parameters to textures so far: the indices of those

    def parameter(self, scene: description.Scene, value, where: str, scalar: bool = False) -> tuple[object, int]:
        """Value and texture index (-1: none) of a parameter."""
        value = resolve_texture(scene, value)
        if isinstance(value, (description.Bitmap, description.Checkerboard)):
            self.references.append(self.add(value, where, scalar))
            return (1.0 if scalar else np.ones(3)), self.references[-1]
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
                    "checkerboard",
                    rows | {"kind": KINDS["checkerboard"], "color0": color0, "color1": color1},
                    (color0 + color1) / 2,
                )
            else:
                self._add_bitmap(texture, where, scalar, rows)
        return self.known[key]

    def _add_bitmap(self, texture: description.Bitmap, where: str, scalar: bool, rows: dict):
        decode = texture.color_space == "srgb" and texture.channel != "a"  # alpha is linear in all formats
        kind, first, pixels = self._image(texture, decode, where)
        integer = pixels.dtype.kind == "u"
        number = scalar or texture.channel is not None
        srgb = integer and (decode or (texture.color_space == "auto" and not number))
        record = {
            "kind": KINDS[kind],
            "first": first,
            "height": pixels.shape[0],
            "width": pixels.shape[1],
            "channels": pixels.shape[2],
            "srgb": int(srgb),
            "nearest": int(texture.filter == "nearest"),
            "wrap": WRAP_MODES[texture.wrap],
            "scale": rgb(texture.scale),
        }
        self._append(kind, rows | record, rgb(texture.scale) * np.broadcast_to(_mean(pixels, srgb), 3))

    def _image(self, texture: description.Bitmap, decode: bool, where: str) -> tuple[str, int, np.ndarray]:
        """Kind, first value in the array of the kind, and pixels of an image, which is stored once.

        `decode`: floats are sRGB-encoded; they are stored linear.
        """
        file, key = texture.file, (texture.file, texture.image, texture.channel, decode)
        if key in self.images:
            return self.images[key]
        stored = self.images.get((*key[:-1], not decode))
        if stored is not None and stored[2].dtype.kind == "u":  # integers are stored as encoded
            return stored
        pixels = load_bitmap(texture, where)
        if pixels.shape[0] * pixels.shape[1] > np.iinfo(np.int32).max:
            found = f"{pixels.shape[1]}x{pixels.shape[0]}"
            raise SceneError(f"{file}: a texture has at most 2^31 - 1 pixels; found {found}", path=where)
        if pixels.dtype.kind == "f":
            finite = np.isfinite(pixels)
            if not finite.all():
                y, x = np.argwhere(~finite.all(axis=2))[0]
                raise SceneError(f"{file}: pixel ({x}, {y}) is not finite", path=where)
            if decode:
                pixels = srgb_to_linear(np.maximum(pixels.astype(np.float64), 0.0)).astype(np.float32)
        kind = next(name for name, dtype in IMAGE_TYPES.items() if dtype == pixels.dtype)
        store = self.pixels[kind]
        self.images[key] = kind, sum(part.size for part in store), pixels
        store.append(pixels.ravel())
        return self.images[key]

    def _append(self, kind: str, record: dict, mean: np.ndarray):
        self.records.append(record)
        self.kinds.append(kind)
        self.means.append(np.asarray(mean, np.float64))

    def upload(self, device: str) -> TextureTables:
        tables = TextureTables()
        tables.records = struct_array(TextureRecord, self.records, device)
        for kind, parts in self.pixels.items():
            if parts:
                setattr(tables, kind, wp.array(np.concatenate(parts), device=device))
        encoded = {record["kind"] for record in self.records if record.get("srgb")}
        for kind, name, steps in (("bytes", "srgb_to_linear", 255), ("shorts", "srgb16_to_linear", 65535)):
            if KINDS[kind] in encoded:
                values = srgb_to_linear(np.arange(steps + 1) / steps)
                setattr(tables, name, wp.array(values, dtype=wp.float32, device=device))
        return tables


def _mean(pixels: np.ndarray, srgb: bool) -> np.ndarray:
    """Mean of each channel, linear; of integers by their histogram, which needs no copy of the pixels."""
    if pixels.dtype.kind == "f":
        return np.maximum(pixels, 0).mean(axis=(0, 1), dtype=np.float64)
    steps = np.iinfo(pixels.dtype).max
    values = np.arange(steps + 1) / steps
    values = srgb_to_linear(values) if srgb else values
    counts = [np.bincount(pixels[:, :, i].ravel(), minlength=steps + 1) for i in range(pixels.shape[2])]
    return np.array([count @ values for count in counts]) / (pixels.shape[0] * pixels.shape[1])
