"""Pearson's chi-square test of samples against a density."""

from __future__ import annotations

import numpy as np
from scipy import stats

FALSE_ALARM_RATE = 1e-4  # of one test function, however many tests it makes


def sidak(tests: int, rate: float = FALSE_ALARM_RATE) -> float:
    """Level of each of several independent tests, so that all together raise a false alarm with the given rate."""
    return 1.0 - (1.0 - rate) ** (1.0 / tests)


def p_value(counts: np.ndarray, probabilities: np.ndarray) -> float:
    """p-value of counts in cells; what the probabilities lack to one is the probability of no cell.

    `counts` are those of the cells, followed by the number of samples in no cell. Cells that expect fewer than five
    samples are pooled, smallest first, so that the chi-square distribution is a good approximation.
    """
    counts = np.asarray(counts, dtype=np.float64)
    n = counts.sum()
    rest = max(0.0, 1.0 - float(probabilities.sum()))
    expected = n * np.append(probabilities, rest)
    order = np.argsort(expected)
    counts, expected = counts[order], expected[order]
    # The pool takes cells until each further one, and the pool itself, expects five samples.
    cumulative = np.cumsum(expected)
    pooled = int(np.searchsorted(expected, 5.0))
    if pooled > 0:
        pooled = min(max(pooled, int(np.searchsorted(cumulative, 5.0)) + 1), len(expected))
        if cumulative[pooled - 1] < 1e-3 and counts[:pooled].sum() > 0:
            return 0.0  # samples where there is no density at all
        counts = np.append(counts[pooled:], counts[:pooled].sum())
        expected = np.append(expected[pooled:], cumulative[pooled - 1])
    if len(expected) < 2:
        raise ValueError("the samples fall into a single cell: nothing is tested")
    statistic = np.sum((counts - expected) ** 2 / expected)
    return float(stats.chi2.sf(statistic, len(expected) - 1))


def histogram(x: np.ndarray, y: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Counts of points of the unit square in cells, and last those outside the square."""
    inside = (x >= 0.0) & (x <= 1.0) & (y >= 0.0) & (y <= 1.0)
    i = np.minimum((x[inside] * shape[0]).astype(int), shape[0] - 1)
    j = np.minimum((y[inside] * shape[1]).astype(int), shape[1] - 1)
    counts = np.bincount(i * shape[1] + j, minlength=shape[0] * shape[1])
    return np.append(counts, np.count_nonzero(~inside))


def nodes(shape: tuple[int, int], per_cell: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Midpoints of a regular subdivision of the cells of the unit square, and the area that each stands for.

    Midpoints rather than Gauss nodes: densities have edges (the horizon, total reflection) inside cells. The order
    is that of `cell_sums`.
    """
    nx, ny = shape[0] * per_cell, shape[1] * per_cell
    x = (np.arange(nx) + 0.5) / nx
    y = (np.arange(ny) + 0.5) / ny
    gx, gy = np.meshgrid(x, y, indexing="ij")
    return gx.ravel(), gy.ravel(), 1.0 / (nx * ny)


def cell_sums(values: np.ndarray, shape: tuple[int, int], per_cell: int) -> np.ndarray:
    """Sums over the nodes of each cell, cells in the order of `histogram`."""
    return values.reshape(shape[0], per_cell, shape[1], per_cell).sum(axis=(1, 3)).ravel()
