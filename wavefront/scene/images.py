"""Image files to arrays and back: Pillow for 8-bit images, OpenEXR for floating point, OpenImageIO for Radiance HDR."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

from wavefront.errors import SceneError, WavefrontError

HALF_MAX = 65504.0


class HalfOverflowError(WavefrontError):
    """A value does not fit 16-bit floats."""


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """Gives a temporary path beside `path` to write to, which then replaces it; after an error nothing is left.

    Raises:
        WavefrontError: The folder or the file cannot be written.
    """
    path = Path(path)
    # the suffix stays last: image libraries choose the format by it
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise WavefrontError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


# --- reading ---------------------------------------------------------------------------------------------------


def load_image(path: str | os.PathLike, where: str = "") -> np.ndarray:
    """Pixels of an image file, first row on top, as encoded (no colour conversion).

    8-bit images give uint8; OpenEXR, Radiance HDR and 16-bit grey PNG give float32 (16-bit scaled to [0, 1]). Alpha is
    dropped (colours are not premultiplied by it), palettes are expanded, CMYK and other modes become RGB. Pillow
    reads 16-bit colour PNG with 8 bits.

    Args:
        path: The file.
        where: Record path that an error names, such as ``textures[0].file``.

    Returns:
        (H, W, C) uint8 or float32, C is 1 or 3.

    Raises:
        SceneError: Missing or unreadable file, or an EXR without R, G, B or a single channel.
    """
    path = Path(path)
    if not path.exists():
        raise SceneError(f"{path}: file not found", path=where)
    if not path.is_file():
        raise SceneError(f"{path}: not a file", path=where)
    load = {".exr": _load_exr, ".hdr": _load_hdr}.get(path.suffix.lower(), _load_pillow)
    pixels = load(path, where)
    if not pixels.size:
        raise SceneError(f"{path}: the image has no pixels", path=where)
    return np.ascontiguousarray(pixels)


def _load_pillow(path, where):
    try:
        with Image.open(path) as image:
            if image.mode.startswith("I;16") or image.mode == "I":
                return (np.asarray(image, np.float32) / np.float32(65535.0))[:, :, None]
            if image.mode == "F":
                return np.asarray(image, np.float32)[:, :, None]
            grey = image.mode in ("1", "L", "LA", "La")
            if image.mode == "P" and image.palette is not None and image.palette.mode in ("L", "LA"):
                grey = True
            pixels = np.asarray(image.convert("L" if grey else "RGB"), np.uint8)
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
        text = "not an image" if "cannot identify" in str(error) else " ".join(str(error).split())
        raise SceneError(f"{path}: cannot be read: {text}", path=where) from None
    return pixels[:, :, None] if pixels.ndim == 2 else pixels


def _load_exr(path, where):
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.asarray(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except Exception as error:  # the binding raises RuntimeError, ValueError and others
        text = " ".join(str(error).split()) or "not an OpenEXR file"
        raise SceneError(f"{path}: cannot be read: {text}", path=where) from None
    colours = [name for name in channels if name != "A"]
    if all(name in channels for name in "RGB"):
        return np.stack([channels[name] for name in "RGB"], axis=2)
    if "Y" in channels:
        return channels["Y"][:, :, None]
    if len(colours) == 1:
        return channels[colours[0]][:, :, None]
    raise SceneError(f"{path}: has channels {', '.join(channels)}; needed: R, G, B, or one channel", path=where)


def _load_hdr(path, where):
    import OpenImageIO  # only here: hardly any scene needs it

    image = OpenImageIO.ImageInput.open(str(path))
    pixels = image.read_image(0, 0, 0, image.spec().nchannels, OpenImageIO.FLOAT) if image else None
    if pixels is None:
        text = " ".join((image or OpenImageIO).geterror().split()) or "not a Radiance HDR file"
        raise SceneError(f"{path}: cannot be read: {text}", path=where)
    return np.asarray(pixels, np.float32)


# --- writing ---------------------------------------------------------------------------------------------------


def write_exr(
    path: str | os.PathLike,
    channels: dict[str, np.ndarray],
    half: bool = False,
    attributes: Mapping[str, int | float | str] | None = None,
) -> None:
    """Writes an OpenEXR image (scan lines, ZIP); the file appears whole or not at all.

    Args:
        path: The file.
        channels: (H, W) arrays by channel name: ``R``, ``G``, ``B``, ``albedo.R``, ...
        half: 16-bit floats; else 32-bit.
        attributes: Of the header, by name.

    Raises:
        HalfOverflowError: A finite value beyond 65504 in half precision.
        WavefrontError: No channels or of different shapes, or a file that cannot be written.
    """
    shapes = {np.shape(pixels) for pixels in channels.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2 or 0 in next(iter(shapes)):
        raise WavefrontError(f"{path}: channels must be (H, W) arrays of one shape; found {sorted(shapes)}")
    data = {}
    for name, pixels in channels.items():
        pixels = np.ascontiguousarray(pixels, np.float32)
        if half:
            finite = np.abs(pixels[np.isfinite(pixels)])
            if finite.size and finite.max() > HALF_MAX:
                raise HalfOverflowError(
                    f"{path}: channel {name} has {finite.max():.6g}, but half precision ends at 65504"
                )
            pixels = pixels.astype(np.float16)
        data[name] = pixels
    header = dict(attributes or {}) | {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with replacing(path) as temporary:
        try:
            with OpenEXR.File(header, data) as file:
                file.write(str(temporary))
        except RuntimeError as error:
            raise OSError(str(error)) from None


def write_png(path: str | os.PathLike, rgb8: np.ndarray) -> None:
    """Writes an 8-bit PNG; the file appears whole or not at all.

    Args:
        path: The file.
        rgb8: (H, W, 3) or (H, W) uint8.

    Raises:
        WavefrontError: Another type or shape, or a file that cannot be written.
    """
    rgb8 = np.asarray(rgb8)
    if rgb8.dtype != np.uint8 or not (rgb8.ndim == 2 or (rgb8.ndim == 3 and rgb8.shape[2] == 3)) or not rgb8.size:
        raise WavefrontError(f"{path}: a PNG needs (H, W, 3) or (H, W) uint8; found {rgb8.shape} {rgb8.dtype}")
    with replacing(path) as temporary:
        Image.fromarray(rgb8).save(temporary, format="PNG")
