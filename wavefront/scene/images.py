"""Image files to arrays and back.

Pillow reads 8-bit images, OpenEXR its own, OpenImageIO all else; OpenImageIO writes, for it takes rows.
"""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterable, Iterator, Mapping
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


def load_image(path: str | os.PathLike, where: str = "", alpha: bool = False) -> np.ndarray:
    """Pixels of an image file, first row on top, as encoded (no colour conversion).

    The type is that of the file: 8-bit images give uint8 and 16-bit ones uint16, for 0 to 1; OpenEXR images of halves
    give float16, other floats float32. Radiance HDR gives float16 where that holds every value exactly. Alpha is
    dropped (colours are not premultiplied by it), palettes are expanded, CMYK and other modes become RGB.

    Args:
        path: The file.
        where: Record path that an error names, such as ``textures[0].file``.
        alpha: The alpha channel in place of the colours; where there is none, it is 1.

    Returns:
        (H, W, C) of one of these types, C is 1 or 3.

    Raises:
        SceneError: Missing or unreadable file, or one without R, G, B or a single channel.
    """
    path = Path(path)
    if not path.exists():
        raise SceneError(f"{path}: file not found", path=where)
    if not path.is_file():
        raise SceneError(f"{path}: not a file", path=where)
    suffix = path.suffix.lower()
    if suffix == ".exr":
        pixels = _load_exr(path, where, alpha)
    elif suffix in (".hdr", ".tif", ".tiff") or (suffix == ".png" and _is_16_bit_png(path)):
        pixels = _load_oiio(path, where, alpha)
    else:
        pixels = _load_pillow(path, where, alpha)
    if not pixels.size:
        raise SceneError(f"{path}: the image has no pixels", path=where)
    if suffix == ".hdr":  # 8-bit mantissas, but exponents that may be out of range
        with np.errstate(over="ignore"):
            halves = pixels.astype(np.float16)
        if np.array_equal(halves, pixels):
            pixels = halves
    return np.ascontiguousarray(pixels)


def _is_16_bit_png(path):
    """From the header: Pillow would read 16-bit colours with 8 bits."""
    with open(path, "rb") as file:
        head = file.read(25)
    return head[12:16] == b"IHDR" and head[24:] == b"\x10"


def _load_pillow(path, where, alpha):
    try:
        with Image.open(path) as image:
            if alpha:
                return np.asarray(image.convert("RGBA").getchannel("A"), np.uint8)[:, :, None]
            grey = image.mode in ("1", "L", "LA", "La")
            if image.mode == "P" and image.palette is not None and image.palette.mode in ("L", "LA"):
                grey = True
            pixels = np.asarray(image.convert("L" if grey else "RGB"), np.uint8)
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
        text = "not an image" if "cannot identify" in str(error) else " ".join(str(error).split())
        raise SceneError(f"{path}: cannot be read: {text}", path=where) from None
    return pixels[:, :, None] if pixels.ndim == 2 else pixels


def _load_exr(path, where, alpha):
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except Exception as error:  # the binding raises RuntimeError, ValueError and others
        text = " ".join(str(error).split()) or "not an OpenEXR file"
        raise SceneError(f"{path}: cannot be read: {text}", path=where) from None
    if alpha:
        first = next(iter(channels.values()))
        channels = {"A": channels.get("A", np.ones_like(first))}
    colours = [name for name in channels if name != "A" or alpha]
    if all(name in channels for name in "RGB"):
        colours = ["R", "G", "B"]
    elif "Y" in channels:
        colours = ["Y"]
    if len(colours) not in (1, 3) or (len(colours) == 3 and colours != ["R", "G", "B"]):
        raise SceneError(f"{path}: has channels {', '.join(channels)}; needed: R, G, B, or one channel", path=where)
    pixels = np.stack([channels[name] for name in colours], axis=2)
    return pixels if pixels.dtype == np.float16 else pixels.astype(np.float32, copy=False)


def _load_oiio(path, where, alpha):
    import OpenImageIO  # only here: hardly any scene needs it

    config = OpenImageIO.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # colours as they are in the file
    image = OpenImageIO.ImageInput.open(str(path), config)
    pixels = None
    if image:
        spec = image.spec()
        if spec.nchannels > 4:
            raise SceneError(f"{path}: has {spec.nchannels} channels; needed: one or three, and alpha", path=where)
        kind = spec.format.basetype
        kept = {OpenImageIO.UINT8: OpenImageIO.UINT8, OpenImageIO.UINT16: OpenImageIO.UINT16}
        pixels = image.read_image(0, 0, 0, spec.nchannels, kept.get(kind, OpenImageIO.FLOAT))
    if pixels is None:
        text = " ".join((image or OpenImageIO).geterror().split()) or "not an image"
        raise SceneError(f"{path}: cannot be read: {text}", path=where)
    if alpha:
        opaque = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1
        found = image.spec().alpha_channel
        return pixels[:, :, found : found + 1] if found >= 0 else np.full_like(pixels[:, :, :1], opaque)
    return pixels[:, :, : 3 if pixels.shape[2] >= 3 else 1]


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
    height, width = shapes.pop()
    formats = dict.fromkeys(channels, "half" if half else "float")
    write_exr_blocks(path, (0, 0, width, height), (width, height), formats, [channels], attributes)


def write_exr_blocks(
    path: str | os.PathLike,
    window: tuple[int, int, int, int],
    size: tuple[int, int],
    formats: dict[str, str],
    blocks: Iterable[dict[str, np.ndarray]],
    attributes: Mapping[str, int | float | str] | None = None,
) -> None:
    """Writes an OpenEXR image (scan lines, ZIP) block by block; the file appears whole or not at all.

    Args:
        path: The file.
        window: x, y, width and height of the data in the image (the data window).
        size: Width and height of the image (the display window).
        formats: ``half`` or ``float`` for every channel.
        blocks: Arrays (rows, width) of every channel, from the top.
        attributes: Of the header, by name; ``PixelAspectRatio`` and ``Software`` are known to the format.

    Raises:
        HalfOverflowError: A finite value beyond 65504 in half precision.
        WavefrontError: The file cannot be written.
    """
    import OpenImageIO  # only here: it takes 30 MB

    x, y, width, height = window
    kinds = tuple(formats.values())
    spec = OpenImageIO.ImageSpec(width, height, len(formats), "half" if set(kinds) == {"half"} else "float")
    spec.x, spec.y, spec.full_x, spec.full_y, spec.full_width, spec.full_height = x, y, 0, 0, *size
    spec.channelnames = tuple(formats)
    if len(set(kinds)) > 1:  # where all are alike, it is not read
        spec.channelformats = kinds
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "")  # none: a file says what is in it alone
    for name, value in (attributes or {}).items():
        spec.attribute(name, value)

    def interleaved():
        for block in blocks:
            for name, kind in formats.items():
                if kind == "half":
                    _check_half(path, name, block[name])
            yield np.stack([block[name] for name in formats], axis=-1, dtype=np.float32, casting="same_kind")

    _write_scanlines(path, spec, interleaved())


def _check_half(path, name, pixels):
    finite = np.abs(pixels[np.isfinite(pixels)])
    if finite.size and finite.max() > HALF_MAX:
        raise HalfOverflowError(f"{path}: channel {name} has {finite.max():.6g}, but half precision ends at 65504")


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
    write_png_blocks(path, rgb8.shape, [rgb8])


def write_png_blocks(path: str | os.PathLike, shape: tuple[int, ...], blocks: Iterable[np.ndarray]) -> None:
    """Writes an 8-bit PNG block by block; the file appears whole or not at all.

    Args:
        path: The file.
        shape: (H, W, 3) or (H, W) of the image.
        blocks: Rows of it from the top, uint8.

    Raises:
        WavefrontError: The file cannot be written.
    """
    import OpenImageIO

    height, width, channels = (*shape, 1)[:3]
    spec = OpenImageIO.ImageSpec(width, height, channels, "uint8")
    _write_scanlines(path, spec, (block.reshape(-1, width, channels) for block in blocks))


def _write_scanlines(path, spec, blocks):
    """Writes blocks of rows [rows, width, channels] to a new file."""
    import OpenImageIO

    def check(done, image):
        # Some writers report an error, but no failure.
        if not done or image.has_error:
            raise OSError((image.geterror() or "unknown error").splitlines()[0])

    with replacing(path) as temporary:
        image = OpenImageIO.ImageOutput.create(str(temporary))
        check(image.open(str(temporary), spec), image)
        try:
            y = spec.y
            for block in blocks:
                check(image.write_scanlines(y, y + len(block), 0, np.ascontiguousarray(block)), image)
                y += len(block)
        finally:
            closed = image.close()
        check(closed, image)
