"""Whether an image has another expected value than its reference: a z-test of every tile, by their variance channels.

The tests of all tiles and channels together have a stated false alarm rate (Šidák); `tools.image_test` has the
statistics. Per channel where all variances are per channel, else of the luminance, whose variance is bounded by that
of channels that err together. An image without variance is taken as exact. What it rests on:

- The pixels of an image are independent, as with a box filter or a filter that is sampled; those of splatted filters
  are not.
- The samples are enough for their variance to be known: where a rare path was not found, an image is both too dark and
  too sure of it. At few samples per pixel, larger tiles help (see docs/measuring.md for what was measured).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from tools.image_reader import LoadedImage
from tools.image_test import FALSE_ALARM_RATE, ROUNDING, Comparison, Estimate, tile_edges
from wavefront.errors import WavefrontError
from wavefront.film import LUMINANCE

TILE = 16  # pixels along a side, about
HALF_ROUNDING = 2.0**-11  # of 16-bit floats


class NoVarianceError(WavefrontError):
    """The images cannot be tested; the message says why."""


@dataclasses.dataclass
class BiasTest:
    """The outcome.

    Attributes:
        comparison: The image over the reference.
        channels: ``RGB``, or ``Y`` for luminance.
        exact: The files that have no variance, and are taken as exact.
        rate: False alarm rate of all tests together.
        edges: First pixels of the tiles and the end, of rows and of columns, in the image.
    """

    comparison: Comparison
    channels: str
    exact: list[str]
    rate: float
    edges: tuple[np.ndarray, np.ndarray]

    @property
    def failing(self) -> np.ndarray:
        """Which tests fail, bool [rows, columns, C]."""
        return self.comparison.p_values < self.comparison.level(self.rate)

    @property
    def failing_tiles(self) -> int:
        """Tiles of which a channel fails."""
        return int(self.failing.any(axis=2).sum())

    def failures(self) -> list[dict]:
        """The tests that fail, smallest p first: pixels, channel, both means, standard error of their difference, p."""
        comparison, (rows, columns) = self.comparison, self.edges
        p, error = comparison.p_values, comparison.error
        found = np.argwhere(self.failing)
        return [
            {
                "x": int(columns[j]),
                "y": int(rows[i]),
                "width": int(columns[j + 1] - columns[j]),
                "height": int(rows[i + 1] - rows[i]),
                "channel": self.channels[c],
                "mean": float(comparison.a.tiles[i, j, c]),
                "reference_mean": float(comparison.b.tiles[i, j, c]),
                "standard_error": float(error[i, j, c]),
                "p": float(p[i, j, c]),
            }
            for i, j, c in sorted(map(tuple, found), key=lambda at: p[at])
        ]

    def ratio(self) -> tuple[float, tuple[float, float]] | None:
        """Ratio of the image means and its 95 % interval (first order); none where a mean is not positive."""
        if min(self.comparison.a.means[-1], self.comparison.b.means[-1]) <= 0.0:
            return None
        return self.comparison.ratio()[0], self.comparison.interval()

    def figures(self) -> dict:
        """For a JSON file."""
        ratio = self.ratio()
        return {
            "channels": self.channels,
            "tiles": list(self.comparison.error.shape[:2]),
            "false_alarm_rate": self.rate,
            "taken_as_exact": self.exact,
            "failing_tiles": self.failing_tiles,
            "smallest_p_corrected": self.comparison.smallest_p,
            "detectable_in_a_tile": self.comparison.detectable() if ratio else None,
            "ratio_of_means": ratio and ratio[0],
            "ratio_interval_95": ratio and list(ratio[1]),
            "failures": self.failures(),
        }


def _luminance(image: LoadedImage) -> tuple[np.ndarray, np.ndarray]:
    """Luminance and an upper bound of its variance, [h, w, 1]."""
    weights, variance = np.asarray(LUMINANCE), image.variance
    if variance is None:
        variance = np.zeros((*image.pixels.shape[:2], 1))
    elif variance.shape[2] == 3:  # the errors of channels may be fully correlated
        variance = np.square(np.sqrt(variance) @ weights)[:, :, None]
    return (image.pixels.astype(np.float64) @ weights)[:, :, None], variance


def find_bias(image: LoadedImage, reference: LoadedImage, tile: int = TILE, rate: float = FALSE_ALARM_RATE) -> BiasTest:
    """Compares two images of one size, of which at least one has variances.

    Args:
        image: The image that is tested.
        reference: What it should be on average.
        tile: Pixels along a side of a tile, about: tiles divide the image evenly.
        rate: Probability of at least one failing tile, where the expected values are equal.

    Raises:
        NoVarianceError: Neither has variances, or one was made for a display, that is clipped and rounded.
    """
    pair = (image, reference)
    for one in pair:
        if one.display:
            raise NoVarianceError(
                f"no bias test: {one.path} was made for a display: its values are clipped and rounded"
            )
    if image.variance is None and reference.variance is None:
        reasons = [one.note for one in pair if one.note] or [
            "neither file has variances: channels variance.Y, variance.R .G .B, or se.R .G .B"
        ]
        raise NoVarianceError(f"no bias test: {'; '.join(reasons)}")
    height, width = image.pixels.shape[:2]
    tiles = (max(1, round(height / tile)), max(1, round(width / tile)))
    if all(one.variance is None or one.variance.shape[2] == 3 for one in pair):
        channels = "RGB"
        parts = [(one.pixels.astype(np.float64), _zeros_if_none(one.variance, one.pixels.shape)) for one in pair]
    else:
        channels, parts = "Y", [_luminance(one) for one in pair]
    rounding = HALF_ROUNDING if image.half or reference.half else ROUNDING
    comparison = Comparison(*(Estimate.from_variance(*part, tiles) for part in parts), rounding)
    edges = tile_edges(height, tiles[0]) + image.origin[1], tile_edges(width, tiles[1]) + image.origin[0]
    exact = [str(one.path) for one in pair if one.variance is None]
    return BiasTest(comparison, channels, exact, rate, edges)


def _zeros_if_none(variance, shape):
    return np.zeros(shape) if variance is None else variance
