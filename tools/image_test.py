"""Whether two renderers make the same image: a test of every tile, and a confidence interval of the ratio of means.

Both renderers are run in batches of independent samples. A batch gives one value per tile and channel, its mean over
the tile, which is a mean over thousands of paths and so nearly normal; the spread over batches gives its variance
without a model of either renderer. Of an image that is there already, the variances of its pixels take their place.
The tiles are compared by Welch's t-test, at a level that makes the false alarm rate of a whole comparison at most
`FALSE_ALARM_RATE` (Šidák's inequality holds for correlated channels too). The seeds are fixed: a comparison that passes
once passes always, until one of the renderers changes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy import stats

FALSE_ALARM_RATE = 1e-4  # of the tile tests of one comparison
RATIO_TOLERANCE = 0.005  # the 95 % confidence interval of the ratio of means must lie within 1 ± this
ROUNDING = 2e-5  # of float32: left out of the difference of a tile before it is tested


def tile_edges(size: int, count: int) -> np.ndarray:
    """First pixels of `count` tiles that divide `size` pixels as evenly as can be, and the end: [count + 1]."""
    return np.arange(count + 1) * size // count


def tile_sums(image: np.ndarray, tiles: tuple[int, int]) -> np.ndarray:
    """Sums over a grid of tiles.

    Args:
        image: [H, W, C].
        tiles: Rows and columns of the grid, at most H and W.

    Returns:
        [rows, columns, C].
    """
    (rows, columns), (height, width) = tiles, image.shape[:2]
    assert 0 < rows <= height and 0 < columns <= width, (image.shape, tiles)
    sums = np.add.reduceat(image, tile_edges(height, rows)[:-1], axis=0)
    return np.add.reduceat(sums, tile_edges(width, columns)[:-1], axis=1)


def tile_areas(shape: tuple[int, ...], tiles: tuple[int, int]) -> np.ndarray:
    """Pixels of each tile of an image of this shape, [rows, columns, 1]."""
    heights, widths = (np.diff(tile_edges(size, count)) for size, count in zip(shape[:2], tiles, strict=True))
    return np.outer(heights, widths)[:, :, None]


def tile_means(image: np.ndarray, tiles: tuple[int, int]) -> np.ndarray:
    """Means over a grid of tiles, [rows, columns, C]; arguments as of `tile_sums`."""
    return tile_sums(image, tiles) / tile_areas(image.shape, tiles)


@dataclasses.dataclass
class Estimate:
    """What a renderer says of an image: means, the variances of these means, and how well the variances are known.

    Attributes:
        tiles: Means of tiles, [rows, columns, C].
        variance: Of `tiles`.
        degrees: Degrees of freedom of the variances, one or [rows, columns, C].
        means: Of the whole image: each channel (R, G and B, or luminance alone), and all together, [C + 1].
        errors: Standard errors of `means`.
        degrees_of_errors: Degrees of freedom of `errors`.
    """

    tiles: np.ndarray
    variance: np.ndarray
    degrees: float | np.ndarray
    means: np.ndarray
    errors: np.ndarray
    degrees_of_errors: float

    @classmethod
    def from_batches(cls, batches: Sequence[np.ndarray]) -> Estimate:
        """From tile means of independent batches of equal size, [batches, rows, columns, 3]."""
        batches = np.asarray(batches)
        n = len(batches)
        whole = batches.mean(axis=(1, 2))
        whole = np.column_stack([whole, whole.mean(axis=1)])
        return cls(
            batches.mean(axis=0),
            batches.var(axis=0, ddof=1) / n,
            n - 1,
            whole.mean(axis=0),
            whole.std(axis=0, ddof=1) / np.sqrt(n),
            n - 1,
        )

    @classmethod
    def from_variance(cls, image: np.ndarray, variance: np.ndarray, tiles: tuple[int, int]) -> Estimate:
        """From an image and the estimated variance of every pixel's mean; pixels are independent.

        How well the variance of a tile is known is taken from how it is spread over its pixels, by Satterthwaite's
        formula (1946): (sum v)^2 / sum(v^2 / n) degrees of freedom, with n = 1 for a pixel, as if it had two samples.
        A light path that few samples find makes one variance large and leaves others too small; where one pixel has
        most of the variance of its tile, the tile says next to nothing, however many samples there were.

        Args:
            image: [H, W, C].
            variance: Of `image`, the same shape, 0 where it is exact.
            tiles: Rows and columns of the grid.
        """
        pixels, sums = image.shape[0] * image.shape[1], tile_sums(variance, tiles)
        means, errors = image.mean(axis=(0, 1)), np.sqrt(variance.sum(axis=(0, 1))) / pixels
        return cls(
            tile_means(image, tiles),
            sums / tile_areas(image.shape, tiles) ** 2,
            degrees_of_sums(sums, tile_sums(np.square(variance), tiles)),
            np.append(means, means.mean()),
            np.append(errors, errors.mean()),  # as if the channels erred together: an upper bound
            float(degrees_of_sums(variance.sum(axis=(0, 1)), np.square(variance).sum(axis=(0, 1))).min()),
        )


def degrees_of_sums(sums: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """Degrees of freedom of sums of variances, of which the sums of squares are known too; infinite where all are 0."""
    return np.divide(np.square(sums), squares, out=np.full_like(sums, np.inf), where=squares > 0.0)


@dataclasses.dataclass
class Comparison:
    """Two estimates of one image, `a` over `b`.

    Attributes:
        a: The one.
        b: The other.
        rounding: Part of the mean of a tile that may differ: what arithmetic, of which both have their own, can make.
    """

    a: Estimate
    b: Estimate
    rounding: float = ROUNDING

    @property
    def error(self) -> np.ndarray:
        """Standard error of the difference of tiles, [rows, columns, C]."""
        return np.sqrt(self.a.variance + self.b.variance)

    @property
    def degrees(self) -> np.ndarray:
        """Welch and Satterthwaite's degrees of freedom of the difference of tiles, [rows, columns, C]."""
        denominator = self.a.variance**2 / self.a.degrees + self.b.variance**2 / self.b.degrees
        return np.where(denominator > 0.0, self.error**4 / np.maximum(denominator, 1e-300), 1.0)

    @property
    def p_values(self) -> np.ndarray:
        """Two-sided, [rows, columns, C]."""
        difference = np.abs(self.a.tiles - self.b.tiles) - self.rounding * np.maximum(self.a.tiles, self.b.tiles)
        difference, error = np.maximum(difference, 0.0), self.error
        t = np.divide(difference, error, out=np.where(difference > 0.0, np.inf, 0.0), where=error > 0.0)
        return 2.0 * stats.t.sf(t, self.degrees)

    @property
    def smallest_p(self) -> float:
        """Smallest p-value of a tile, corrected for the number of tests (Šidák)."""
        p = self.p_values.min()
        return 1.0 if p == 1.0 else float(-np.expm1(self.error.size * np.log1p(-p)))

    def level(self, rate: float = FALSE_ALARM_RATE) -> float:
        """Level of the test of one tile and channel."""
        return float(-np.expm1(np.log1p(-rate) / self.error.size))

    def ratio(self, channel: int = -1) -> tuple[float, float]:
        """Ratio of the image means, of one channel or (-1) of all, and its standard error (first order)."""
        a, b = self.a.means[channel], self.b.means[channel]
        return float(a / b), float(a / b * np.hypot(self.a.errors[channel] / a, self.b.errors[channel] / b))

    def interval(self, confidence: float = 0.95) -> tuple[float, float]:
        """Confidence interval of the ratio of the image means."""
        ratio, error = self.ratio()
        half = error * stats.t.isf((1.0 - confidence) / 2.0, min(self.a.degrees_of_errors, self.b.degrees_of_errors))
        return float(ratio - half), float(ratio + half)

    def detectable(self, power: float = 0.9) -> float:
        """The relative difference of one tile that is found with this power: the median over tiles with light."""
        mean = self.b.tiles
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
            f"degrees of freedom {np.median(self.a.degrees):.4g} and {np.median(self.b.degrees):.4g}; finds a "
            f"difference of {100.0 * self.detectable():.2g} % in a tile"
        )

    def check(self, tolerance: float = RATIO_TOLERANCE) -> None:
        """Asserts that no tile differs and that the ratio of means is one up to the tolerance."""
        low, high = self.interval()
        assert self.p_values.min() > self.level(), f"tiles differ: {self}"
        assert 1.0 - tolerance <= low and high <= 1.0 + tolerance, f"the means differ: {self}"


def collect(source: Iterator[np.ndarray], count: int, tiles: tuple[int, int]) -> np.ndarray:
    """Tile means of the next batches, [count, rows, columns, 3]."""
    return np.array([tile_means(np.asarray(next(source), np.float64), tiles) for _ in range(count)])


def compare(
    a: Iterator[np.ndarray],
    b: Iterator[np.ndarray] | Estimate,
    tiles: tuple[int, int],
    error: float = 0.001,
    least: int = 16,
    most: int = 256,
    rounding: float = ROUNDING,
    progress: Callable[[Comparison], object] | None = None,
) -> Comparison:
    """Takes batches of two renderers until the ratio of their means is known.

    When to stop depends on the standard error alone, never on the difference, so it favours neither outcome.

    Args:
        a: Images [H, W, 3] of equal, independent batches of samples.
        b: Those of the other renderer, or an estimate that is there already.
        tiles: Rows and columns of the grid.
        error: Standard error of the ratio to reach. 0.001 leaves 3 standard errors between a ratio of one and an
            interval that crosses `RATIO_TOLERANCE`.
        least: Batches of each at least.
        most: Batches of each at most; it fails if `error` is not reached by then.
        rounding: See `Comparison`.
        progress: Called with what is known, after every batch from the `least` on.
    """
    ours, theirs = collect(a, least, tiles), None if isinstance(b, Estimate) else collect(b, least, tiles)
    while True:
        comparison = Comparison(
            Estimate.from_batches(ours), b if theirs is None else Estimate.from_batches(theirs), rounding
        )
        if progress is not None:
            progress(comparison)
        if comparison.ratio()[1] <= error:
            return comparison
        assert len(ours) < most, f"too noisy to say: {comparison}"
        ours = np.concatenate([ours, collect(a, 1, tiles)])
        if theirs is not None:
            theirs = np.concatenate([theirs, collect(b, 1, tiles)])
