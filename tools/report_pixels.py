"""Images inside a page: 16-bit floats, compressed, as text.

Each value is multiplied by a power of two that brings the largest of the image to the range from 2^14 to 2^15, and
rounded to IEEE 754 half precision, whose 11 significant bits leave a relative error of at most 2^-11 (0.05 %). Values
below 2^-29 of the largest have fewer bits, and an absolute error of at most 2^-39 of it.
"""

from __future__ import annotations

import base64
import zlib

import numpy as np

RELATIVE_ERROR, ABSOLUTE_ERROR = 2.0**-11, 2.0**-39  # the latter of the largest value; the larger of both holds


def encode(pixels: np.ndarray) -> tuple[str, int]:
    """An image as text.

    Of three channels, those of red and blue are stored as differences to green, modulo 2^16, since they are alike; high
    and low bytes stand apart, since the low ones are noise. All is for the compression (RFC 1950), and in base64.

    Args:
        pixels: Finite, [height, width, C]; C is 1 or 3.

    Returns:
        The text, and the exponent e: values are those of the halves times 2^e.
    """
    exponent = int(np.frexp(np.abs(pixels).max(initial=0.0))[1]) - 15
    halves = np.ldexp(np.asarray(pixels, np.float64), -exponent).astype(np.float16).view(np.uint16)
    planes = np.ascontiguousarray(np.moveaxis(halves, 2, 0))
    if len(planes) == 3:
        planes[0] -= planes[1]
        planes[2] -= planes[1]
    data = (planes >> 8).astype(np.uint8).tobytes() + (planes & 255).astype(np.uint8).tobytes()
    return base64.b64encode(zlib.compress(data, 9)).decode("ascii"), exponent


def decode(text: str, exponent: int, height: int, width: int) -> np.ndarray:
    """The inverse of `encode`, up to rounding, as page/pixels.js has it too: [height, width, C] float64."""
    data = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).astype(np.uint16)
    planes = ((data[: data.size // 2] << 8) | data[data.size // 2 :]).reshape(-1, height, width)
    if len(planes) == 3:
        planes[0] += planes[1]
        planes[2] += planes[1]
    return np.ldexp(np.moveaxis(planes.view(np.float16), 0, 2).astype(np.float64), exponent)
