"""Images of any renderer, with the variances of their pixels if the file has them.

An OpenEXR file is radiance. Its colours are the channels R, G and B, or those of one layer (``beauty.R``, …), or one
channel alone, which is grey. Variances of the mean of each pixel are

- ``variance.Y``, that of the luminance: the AOV `variance` of this renderer;
- ``variance.R`` ``.G`` ``.B``: those of the channels;
- ``se.R`` ``.G`` ``.B``: standard errors, their square roots.

Names of other kinds are left alone: the ``Variance.R`` of pbrt's film, for one, is the variance of samples, not of
their mean. Pictures with 8 or 16 bits are made for a display, and are decoded by the inverse of the sRGB curve; other
files of floats (Radiance HDR, TIFF) are radiance.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from tools.metrics import check_finite
from wavefront.errors import WavefrontError
from wavefront.scene.images import load_image
from wavefront.texture import srgb_to_linear

BEAUTY = ("beauty", "combined", "color", "rgb", "rgba")  # last parts of names of layers that hold the image itself
# Channels, and the power of them that is the variance.
VARIANCES = (
    (("variance.R", "variance.G", "variance.B"), 1),
    (("se.R", "se.G", "se.B"), 2),
    (("variance.Y",), 1),
)


@dataclasses.dataclass
class LoadedImage:
    """An image file.

    Attributes:
        path: Of the file.
        pixels: Linear Rec. 709, shape [h, w, 3], float32 (float64 for what was decoded from sRGB), finite.
        variance: Of the mean of each pixel, shape [h, w, 3], or [h, w, 1] of its luminance, float64; or none.
        origin: x, y of the first pixel in the image, other than 0, 0 for a crop window.
        display: Whether the file was made for a display, by 8 or 16 bits.
        half: Whether the values were rounded to 16-bit floats.
        note: Why there is no variance, where channels of that name are there; else empty.
    """

    path: Path
    pixels: np.ndarray
    variance: np.ndarray | None = None
    origin: tuple[int, int] = (0, 0)
    display: bool = False
    half: bool = False
    note: str = ""


def read_image(path: Path, layer: str | None = None) -> LoadedImage:
    """Reads an image file.

    Args:
        path: An image.
        layer: Of an OpenEXR file, the layer of the colours; empty: channels without a layer. Found if not given.

    Raises:
        WavefrontError: A missing or unreadable file, no such layer or more than one that it may be, a value that is
            not finite (with its pixel), or a negative variance.
    """
    path = Path(path)
    if path.suffix.lower() == ".exr" and path.is_file():
        image = _read_exr(path, layer)
    else:
        pixels = load_image(path)
        if layer is not None:
            raise WavefrontError(f"{path}: has no layer {layer!r}; allowed: layers of OpenEXR files")
        display = pixels.dtype.kind == "u"
        if display:
            pixels = srgb_to_linear(pixels / np.iinfo(pixels.dtype).max)
        image = LoadedImage(path, np.broadcast_to(pixels, (*pixels.shape[:2], 3)), display=display)
    check_finite(image.pixels, path, origin=image.origin)
    return image


class _Exr:
    """An open OpenEXR file: its channels by name, with that of their part in front where two parts have the same."""

    def __init__(self, path: Path):
        # OpenImageIO, because the OpenEXR binding prints about damaged files
        self.path, self.file = path, oiio.ImageInput.open(str(path))
        if self.file is None or self.file.format_name() != "openexr":
            raise WavefrontError(
                f"{path}: cannot be read: {' '.join(oiio.geterror().split()) or 'not an OpenEXR file'}"
            )
        self.channels: dict[str, tuple[int, int]] = {}  # part, and place in it
        self.specs = []
        while self.file.seek_subimage(len(self.specs), 0):
            spec, part = self.file.spec(), len(self.specs)
            for i, name in enumerate(spec.channelnames):
                self.channels[f"{spec.getattribute('name')}.{name}" if name in self.channels else name] = (part, i)
            self.specs.append(spec)

    def window(self, names: Sequence[str]) -> tuple[int, int, int, int]:
        """Width, height, x and y of channels."""
        specs = [self.specs[self.channels[name][0]] for name in names]
        windows = {(spec.width, spec.height, spec.x, spec.y) for spec in specs}
        if len(windows) > 1:
            raise WavefrontError(f"{self.path}: the channels {', '.join(names)} have windows {sorted(windows)}")
        return windows.pop()

    def is_half(self, name: str) -> bool:
        part, i = self.channels[name]
        return self.specs[part].channelformat(i) == oiio.TypeDesc("half")

    def read(self, names: Sequence[str]) -> np.ndarray:
        """[h, w, len(names)], float32."""
        width, height, *_ = self.window(names)
        pixels = np.empty((height, width, len(names)), np.float32)
        for c, name in enumerate(names):
            part, i = self.channels[name]
            channel = self.file.read_image(part, 0, i, i + 1, oiio.FLOAT)
            if channel is None:
                raise WavefrontError(f"{self.path}: cannot be read: {' '.join(self.file.geterror().split())}")
            pixels[..., c] = channel[..., 0]
        return pixels


def _read_exr(path, layer):
    file = _Exr(path)
    names = _colour_channels(path, list(file.channels), layer)
    pixels = file.read(names)
    image = LoadedImage(
        path,
        np.broadcast_to(pixels, (*pixels.shape[:2], 3)),
        origin=file.window(names)[2:],
        half=any(map(file.is_half, names)),
    )
    for variances, power in VARIANCES:
        if all(name in file.channels for name in variances):
            file.window([*names, *variances])  # the same
            return _with_variance(image, variances, file.read(variances).astype(np.float64), power)
    return image


def _colour_channels(path: Path, channels: Sequence[str], layer: str | None) -> list[str]:
    """The three channels, or the one of a grey image, that hold the colours."""
    prefixes = [name[:-1] for name in channels if name[-2:] in ("R", ".R")]
    layers = [p[:-1] for p in prefixes if all(p + c in channels for c in "GB")]
    if layer is None:
        if "" in layers:
            layer = ""
        else:
            named = [name for name in layers if name.rpartition(".")[2].lower() in BEAUTY] or layers
            if len(named) > 1:
                raise WavefrontError(f"{path}: it has layers {', '.join(named)}; choose one with --layer")
            if named:
                layer = named[0]
            else:
                grey = [name for name in channels if name != "A"]
                grey = ["Y"] if "Y" in grey else grey
                if len(grey) == 1:
                    return grey
    if layer not in layers:
        found = f"layers {', '.join(map(repr, layers))}" if layers else f"channels {', '.join(channels)}"
        raise WavefrontError(f"{path}: has {found}; needed: {'R, G, B' if layer is None else f'a layer {layer!r}'}")
    return [f"{layer}.{c}" if layer else c for c in "RGB"]


def _with_variance(image: LoadedImage, names: Sequence[str], values: np.ndarray, power: int) -> LoadedImage:
    if np.isnan(values).all():
        return dataclasses.replace(image, note=f"{image.path}: {names[0]} is NaN, as it is for one sample a pixel")
    check_finite(values, image.path, names, image.origin)
    if values.min() < 0.0:
        y, x, c = np.unravel_index(values.argmin(), values.shape)
        raise WavefrontError(
            f"{image.path}: pixel ({x + image.origin[0]}, {y + image.origin[1]}), channel {names[c]}: "
            f"{values[y, x, c]:g}; allowed: 0 or more"
        )
    return dataclasses.replace(image, variance=values**power)
