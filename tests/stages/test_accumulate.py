"""Accumulate: sums per pixel in the order of the samples, in float64, at the place of the tile."""

import numpy as np
import pytest
import warp as wp

from tests.stages.harness import Counters, array, launch, paths
from wavefront import queues
from wavefront.film import LUMINANCE, Film
from wavefront.stages.accumulate import make_accumulate
from wavefront.stages.advance import advance_bounce, drain_rays

WIDTH, HEIGHT = 11, 7
TILE = (3, 2, 5, 4, 6, 3)


def accumulate(L, film, tile=TILE, variance=True, weighted=False):
    """Adds the radiances to the film and returns the counters."""
    p, counters = paths(len(L), L=L), Counters()
    tile = array(np.array(tile, np.int32), wp.int32)
    # More threads than pixels in the tile, as in a captured graph.
    launch(make_accumulate(variance, weighted), len(L), p, tile, film.width, film.arrays, counters.struct)
    return counters


def radiances(seed, n=100):
    """Values so different in magnitude that even float64 sums in another order are seen."""
    return (10.0 ** np.random.default_rng(seed).uniform(-10.0, 10.0, (n, 3))).astype(np.float32)


@pytest.mark.parametrize("variance", [False, True])
def test_sums(variance):
    film = Film(WIDTH, HEIGHT, ("variance",) if variance else (), "cpu")
    expected = np.zeros((HEIGHT, WIDTH, 3))
    squares = np.zeros((HEIGHT, WIDTH))
    for seed in (1, 2):
        L = radiances(seed)
        accumulate(L, film, variance=variance)
        x0, y0, width, height, _, samples = TILE
        for local in range(width * height):
            x, y = x0 + local % width, y0 + local // width
            for s in range(samples):
                value = L[local * samples + s].astype(np.float64)
                expected[y, x] += value
                squares[y, x] += (value @ LUMINANCE) ** 2
    # The same sums in the same order: not a bit is different, and pixels around the tile are zero.
    np.testing.assert_array_equal(film.arrays.L.numpy().reshape(HEIGHT, WIDTH, 3), expected)
    if variance:
        np.testing.assert_allclose(film.arrays.luminance_squared.numpy().reshape(HEIGHT, WIDTH), squares, rtol=1e-6)


def test_weighted_sums():
    """Of dyadic weights and luminances, whose sums have no rounding: w L, (w Y)^2 and w^2 Y."""
    film = Film(1, 1, ("variance",), "cpu", weighted=True)
    L = np.array([[3.0, 3.0, 3.0], [8.0, 8.0, 8.0], [0.5, 0.5, 0.5]], np.float32)
    for weight, first, last in ((0.25, 0, 2), (1.0, 2, 3)):
        film.begin_pass(weight)
        accumulate(L[first:last], film, (0, 0, 1, 1, first, last - first), weighted=True)
        film.end_pass(last - first)
    assert film.arrays.L.numpy().tolist() == [[0.25 * 11.0 + 0.5] * 3]
    assert film.arrays.luminance_squared.numpy()[0] == pytest.approx((9.0 + 64.0) / 16.0 + 0.25, rel=1e-6)
    assert film.arrays.weighted_luminance.numpy()[0] == pytest.approx(11.0 / 16.0 + 0.5, rel=1e-6)
    assert film.weight_sums == (1.5, 2.0 / 16.0 + 1.0, 2.0 / 64.0 + 1.0)
    assert (film.sample_count, film.effective_samples) == (3, 1.5**2 / 1.125)
    np.testing.assert_allclose(film.image(), (0.25 * 11.0 + 0.5) / 1.5, rtol=1e-7)


def test_tiles_cover_the_film_once():
    film = Film(WIDTH, HEIGHT, (), "cpu")
    for x in range(0, WIDTH, 4):
        for y in range(0, HEIGHT, 3):
            width, height = min(4, WIDTH - x), min(3, HEIGHT - y)
            accumulate(np.ones((50, 3), np.float32), film, (x, y, width, height, 0, 2), variance=False)
    assert (film.arrays.L.numpy() == 2.0).all()


def test_float64_keeps_what_float32_loses():
    film = Film(1, 1, (), "cpu")
    L = np.full((1001, 3), 0.25, np.float32)
    L[0] = 1e8
    accumulate(L, film, (0, 0, 1, 1, 0, 1001), variance=False)
    np.testing.assert_array_equal(film.arrays.L.numpy(), np.full((1, 3), 1e8 + 250.0))


# --- bookkeeping -------------------------------------------------------------------------------------------------


def test_drain_counts_and_empties_the_rays():
    counters = Counters(depth=2)
    counters.array.numpy()[:] = np.arange(10, 10 + queues.COUNTER_COUNT)
    counters.totals.numpy()[:] = (2**40, 5, 7)
    before = counters.array.numpy().copy()
    launch(drain_rays, 1, counters.struct, counters.totals)
    assert counters.totals.numpy().tolist() == [2**40 + 10, 5 + before[queues.SHADOW], 7]
    before[queues.RAYS] = 0
    np.testing.assert_array_equal(counters.array.numpy(), before)


@pytest.mark.parametrize("rays", [0, 3])
def test_advance(rays):
    counters = Counters()
    counters.array.numpy()[:] = np.arange(10, 10 + queues.COUNTER_COUNT)
    counters.array.numpy()[queues.RAYS] = rays
    expected = counters.array.numpy().copy()
    launch(advance_bounce, 1, counters.struct)
    expected[[queues.HITS, queues.ESCAPED, queues.EMISSIVE, queues.SHADOW]] = 0
    expected[queues.DEPTH] += 1
    expected[queues.CONTINUE] = 1 if rays else 0
    np.testing.assert_array_equal(counters.array.numpy(), expected)


def test_a_sum_that_overflowed_is_counted_and_left_out():
    film = Film(1, 1, ("variance",), "cpu")
    L = np.array([[1.0, 1.0, 1.0], [np.inf, 1.0, 1.0], [2.0, 2.0, 2.0]], np.float32)
    counters = accumulate(L, film, (0, 0, 1, 1, 0, 3))
    assert counters[queues.NONFINITE_ACCUMULATE] == 1
    assert film.arrays.L.numpy().tolist() == [[3.0, 3.0, 3.0]]
    assert film.arrays.luminance_squared.numpy()[0] == pytest.approx(5.0, rel=1e-5)
