"""False colours for error images: lightness grows linearly with the error, so that a copy in grey reads the same."""

from __future__ import annotations

import numpy as np

from wavefront.output import tone_map

# CIE XYZ of the Rec. 709 primaries (ITU-R BT.709, white D65)
_XYZ = np.array([[0.412391, 0.357584, 0.180481], [0.212639, 0.715169, 0.072192], [0.019331, 0.119195, 0.950532]])
_CHROMA = 66.0  # as colourful as the way through hues stays inside Rec. 709


def _table() -> np.ndarray:
    """256 colours, 8-bit [256, 3]: black, violet, red, orange, yellow, white.

    In CIE L*a*b*, lightness is a line, hue turns from 300° to 460° and chroma is half a sine, so that equal steps of
    the error are about equal steps of colour (their lengths are within 6 % of each other).
    """
    t = np.linspace(0.0, 1.0, 256)
    hue, chroma = np.radians(300.0 + 160.0 * t), _CHROMA * np.sin(np.pi * t)
    y = (100.0 * t + 16.0) / 116.0
    f = np.stack([y + chroma * np.cos(hue) / 500.0, y, y - chroma * np.sin(hue) / 200.0], axis=1)
    edge = 6.0 / 29.0
    xyz = np.where(f > edge, f**3, 3.0 * edge**2 * (f - 4.0 / 29.0)) * _XYZ.sum(axis=1)
    return tone_map((xyz @ np.linalg.inv(_XYZ).T)[None])[0]


TABLE = _table()


def false_color(values: np.ndarray, scale: float) -> np.ndarray:
    """Colours of values: black for 0, white for `scale` and more.

    Args:
        values: Not negative, shape [h, w].
        scale: Positive.

    Returns:
        8-bit sRGB, [h, w, 3].
    """
    return TABLE[(np.clip(np.asarray(values) / scale, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)]
