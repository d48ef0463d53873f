"""Whether two renderers make the same image: a test of every tile, and a confidence interval of the ratio of means.

Both renderers are run in batches of independent samples. A batch gives one value per tile and channel, its mean over
the tile, which is a mean over thousands of paths and so nearly normal; the spread over batches gives its variance
without a model of either renderer. The tiles are compared by Welch's t-test, at a level that makes the false alarm
rate of a whole comparison at most `FALSE_ALARM_RATE` (Šidák's inequality holds for correlated channels too). The seeds
are fixed: a comparison that passes once passes always, until one of the renderers changes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
from scipy import stats

FALSE_ALARM_RATE = 1e-4  # of the tile tests of one comparison
RATIO_TOLERANCE = 0.005  # the 95 % confidence interval of the ratio of means must lie within 1 ± this
# Float32 arithmetic, of which both renderers have their own: left out of the difference of a tile before it is tested.
ROUNDING = 2e-5


def tile_means(image: np.ndarray, tiles: tuple[int, int]) -> np.ndarray:
    """Means over a grid of tiles.

    Args:
        image: [H, W, 3], H and W multiples of the number of tiles.
        tiles: Rows and columns of the grid.

    Returns:
        [rows, columns, 3].
    """
    (rows, columns), (height, width, channels) = tiles, image.shape
    assert height % rows == 0 and width % columns == 0, (image.shape, tiles)
    return image.reshape(rows, height // rows, columns, width // columns, channels).mean(axis=(1, 3))


@dataclasses.dataclass
class Comparison:
    """Batches of two renderers.

    Args:
        a: Tile means of the batches of the one, [batches, rows, columns, 3].
        b: Those of the other; the number of batches may differ.
    """

    a: np.ndarray
    b: np.ndarray

    @property
    def degrees(self) -> np.ndarray:
        """Welch and Satterthwaite's degrees of freedom of the difference, [rows, columns, 3]."""
        va, vb = (x.var(axis=0, ddof=1) / len(x) for x in (self.a, self.b))
        denominator = va**2 / (len(self.a) - 1) + vb**2 / (len(self.b) - 1)
        return np.where(denominator > 0.0, (va + vb) ** 2 / np.maximum(denominator, 1e-300), 1.0)

    @property
    def error(self) -> np.ndarray:
        """Standard error of the difference of means, [rows, columns, 3]."""
        return np.sqrt(self.a.var(axis=0, ddof=1) / len(self.a) + self.b.var(axis=0, ddof=1) / len(self.b))

    @property
    def p_values(self) -> np.ndarray:
        """Two-sided, [rows, columns, 3]."""
        mean_a, mean_b = self.a.mean(axis=0), self.b.mean(axis=0)
        difference = np.maximum(np.abs(mean_a - mean_b) - ROUNDING * np.maximum(mean_a, mean_b), 0.0)
        error = self.error
        t = np.divide(difference, error, out=np.where(difference > 0.0, np.inf, 0.0), where=error > 0.0)
        return 2.0 * stats.t.sf(t, self.degrees)

    def level(self, rate: float = FALSE_ALARM_RATE) -> float:
        """Level of the test of one tile and channel."""
        return 1.0 - (1.0 - rate) ** (1.0 / self.error.size)

    def ratio(self, channel: int | None = None) -> tuple[float, float]:
        """Ratio of the image means a / b, of one channel or of all, and its standard error (first order)."""
        pick = slice(None) if channel is None else slice(channel, channel + 1)
        a, b = (x[..., pick].mean(axis=(1, 2, 3)) for x in (self.a, self.b))
        ratio = a.mean() / b.mean()
        error = ratio * np.hypot(_relative_error(a), _relative_error(b))
        return float(ratio), float(error)

    def interval(self, confidence: float = 0.95) -> tuple[float, float]:
        """Confidence interval of the ratio of the image means."""
        ratio, error = self.ratio()
        half = error * stats.t.isf((1.0 - confidence) / 2.0, min(len(self.a), len(self.b)) - 1)
        return ratio - half, ratio + half

    def detectable(self, power: float = 0.9) -> float:
        """The relative difference of one tile that is found with this power: the median over tiles with light."""
        mean = self.b.mean(axis=0)
        lit = mean > 1e-3 * mean.max()
        threshold = stats.t.isf(self.level() / 2.0, self.degrees) + stats.norm.isf(1.0 - power)
        return float(np.median((threshold * self.error)[lit] / mean[lit]))

    def __str__(self) -> str:
        ratio, error = self.ratio()
        low, high = self.interval()
        p = self.p_values
        return (
            f"ratio {ratio:.5f} ± {error:.5f}, 95 % interval [{low:.5f}, {high:.5f}]; smallest p {p.min():.1e} at tile "
            f"and channel {tuple(map(int, np.unravel_index(p.argmin(), p.shape)))}, level {self.level():.1e}; "
            f"{len(self.a)} and {len(self.b)} batches; finds a difference of {100.0 * self.detectable():.2g} % in a "
            f"tile and of {100.0 * 4.0 * error:.2g} % in the mean"
        )

    def check(self, tolerance: float = RATIO_TOLERANCE) -> None:
        """Asserts that no tile differs and that the ratio of means is one up to the tolerance."""
        low, high = self.interval()
        assert self.p_values.min() > self.level(), f"tiles differ: {self}"
        assert 1.0 - tolerance <= low and high <= 1.0 + tolerance, f"the means differ: {self}"


def _relative_error(batches):
    return batches.std(ddof=1) / np.sqrt(len(batches)) / batches.mean()


def compare(
    a: Iterator[np.ndarray],
    b: Iterator[np.ndarray],
    tiles: tuple[int, int],
    error: float = 0.001,
    batches: tuple[int, int] = (16, 256),
    progress: Callable[[Comparison], object] | None = None,
) -> Comparison:
    """Takes batches of two renderers until their ratio of means is known.

    When to stop depends on the standard error alone, never on the difference, so it does not favour either outcome.

    Args:
        a: Images [H, W, 3] of equal, independent batches of samples.
        b: Those of the other renderer.
        tiles: Rows and columns of the grid.
        error: Standard error of the ratio to reach. 0.001 leaves 3 standard errors between a ratio of one and an
            interval that crosses `RATIO_TOLERANCE`.
        batches: At least and at most so many of each.
        progress: Called after each pair of batches from the first on that suffices for a comparison.
    """
    taken: tuple[list, list] = ([], [])
    while True:
        for source, values in zip((a, b), taken, strict=True):
            values.append(tile_means(np.asarray(next(source), np.float64), tiles))
        count = len(taken[0])
        if count < batches[0]:
            continue
        comparison = Comparison(*(np.array(values) for values in taken))
        if progress is not None:
            progress(comparison)
        if comparison.ratio()[1] <= error:
            return comparison
        assert count < batches[1], f"too noisy to say: {comparison}"
