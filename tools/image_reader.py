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
from pathlib import Path

import numpy as np
import OpenEXR

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
        display = pixels.dtype.kind == "u"
        if display:
            pixels = srgb_to_linear(pixels / np.iinfo(pixels.dtype).max)
        image = LoadedImage(path, np.broadcast_to(pixels, (*pixels.shape[:2], 3)), display=display)
    check_finite(image.pixels, path, origin=image.origin)
    return image


def _read_exr(path, layer):
    channels, origin = _exr_channels(path)
    names = _colour_channels(path, channels, layer)
    shapes = {channels[name].shape for name in names}
    if len(shapes) > 1:
        raise WavefrontError(f"{path}: the channels {', '.join(names)} have different sizes {sorted(shapes)}")
    half = any(channels[name].dtype == np.float16 for name in names)
    pixels = np.stack([channels[name] for name in names], axis=-1, dtype=np.float32, casting="same_kind")
    image = LoadedImage(path, np.broadcast_to(pixels, (*pixels.shape[:2], 3)), origin=origin, half=half)
    return _with_variance(image, channels)


def _exr_channels(path) -> tuple[dict[str, np.ndarray], tuple[int, int]]:
    """All channels by name, with that of their part in front where two parts have the same, and the first pixel."""
    channels = {}
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            origin = file.header()["dataWindow"][0]
            for part in file.parts:
                for name, channel in part.channels.items():
                    channels[f"{part.name()}.{name}" if name in channels else name] = np.asarray(channel.pixels)
    except Exception as error:  # the binding raises RuntimeError, ValueError and others
        text = " ".join(str(error).split()) or "not an OpenEXR file"
        raise WavefrontError(f"{path}: cannot be read: {text}") from None
    return channels, (int(origin[0]), int(origin[1]))


def _colour_channels(path, channels: dict[str, np.ndarray], layer: str | None) -> list[str]:
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


def _with_variance(image: LoadedImage, channels: dict[str, np.ndarray]) -> LoadedImage:
    for names, power in VARIANCES:
        if not all(name in channels and channels[name].shape == image.pixels.shape[:2] for name in names):
            continue
        values = np.stack([channels[name] for name in names], axis=-1).astype(np.float64)
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
    return image
