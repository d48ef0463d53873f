"""The Sobol sampler: its points against an independent implementation, how they are stratified and scrambled, and that
every number is uniform and independent of those of other decisions."""

import math

import numpy as np
import pytest
import warp as wp
from scipy import stats
from scipy.stats import qmc

from tests.chi_square import p_value, sidak
from tests.test_rng import grid
from wavefront.rng import PURPOSE_BSDF, PURPOSE_CAMERA, PURPOSE_GUIDE, PURPOSE_LIGHT
from wavefront.sampler import SAMPLERS, reverse_bits, scramble, shuffled_index, sobol_digits

DEVICE = "cpu"
PURPOSES = (PURPOSE_CAMERA, PURPOSE_LIGHT, PURPOSE_BSDF, PURPOSE_GUIDE)


def make_draw_kernel(name):
    draw = SAMPLERS[name]

    @wp.kernel(enable_backward=False, module="unique")
    def draw_kernel(seed: wp.uint64, index: wp.array2d[wp.uint32], result: wp.array[wp.vec4]):
        i = wp.tid()
        result[i] = draw(seed, index[i, 0], index[i, 1], wp.int32(index[i, 2]), wp.int32(index[i, 3]))

    return draw_kernel


DRAW_KERNELS = {name: make_draw_kernel(name) for name in SAMPLERS}


@wp.kernel(enable_backward=False, module="unique")
def digits_kernel(
    index: wp.array[wp.uint32],
    shift: wp.uint32,
    factor: wp.uint32,
    # out
    points: wp.array[wp.vec4ui],
    scrambled: wp.array[wp.vec3ui],  # digits, a shuffled index, the index backwards
):
    i = wp.tid()
    points[i] = sobol_digits(index[i])
    shuffled = shuffled_index(index[i], shift, factor)
    scrambled[i] = wp.vec3ui(scramble(index[i], shift, factor), shuffled, reverse_bits(index[i]))


def draw(index, seed=0, name="sobol") -> np.ndarray:
    """Numbers of rows of pixel, sample, bounce and purpose: [N, 4]."""
    index = np.ascontiguousarray(index, dtype=np.uint32)
    result = wp.empty(len(index), dtype=wp.vec4, device=DEVICE)
    inputs = [wp.uint64(seed), wp.array(index, dtype=wp.uint32, device=DEVICE)]
    wp.launch(DRAW_KERNELS[name], dim=len(index), inputs=inputs, outputs=[result], device=DEVICE)
    return result.numpy()


def points(n, pixel=0, bounce=0, purpose=PURPOSE_BSDF, seed=0, first=0, name="sobol") -> np.ndarray:
    """The samples from `first` of one decision: [n, 4]."""
    index = np.array([[pixel, 0, bounce, purpose]]).repeat(n, axis=0)
    index[:, 1] = first + np.arange(n)
    return draw(index, seed, name)


def digits(index, shift=0, factor=1):
    index = np.ascontiguousarray(index, dtype=np.uint32)
    out = wp.empty(len(index), dtype=wp.vec4ui, device=DEVICE), wp.empty(len(index), dtype=wp.vec3ui, device=DEVICE)
    inputs = [wp.array(index, dtype=wp.uint32, device=DEVICE), wp.uint32(shift), wp.uint32(factor)]
    wp.launch(digits_kernel, dim=len(index), inputs=inputs, outputs=list(out), device=DEVICE)
    return out[0].numpy(), out[1].numpy()


def backwards(x) -> np.ndarray:
    """The 32 bits of numbers in the other order."""
    bits = np.unpackbits(np.asarray(x, "<u4")[..., None].view(np.uint8), axis=-1, bitorder="little")
    return np.packbits(bits[..., ::-1], axis=-1, bitorder="little").view("<u4")[..., 0]


# --- the sequence ------------------------------------------------------------------------------------------------


def test_points_of_the_sequence():
    """SciPy's sequence has the same direction numbers, and goes through them in the order of a Gray code."""
    n = 1 << 12
    expected = qmc.Sobol(4, scramble=False, bits=32).random(n)
    index = np.arange(n) ^ (np.arange(n) >> 1)
    found, extra = digits(index)
    np.testing.assert_array_equal(backwards(found) / 2.0**32, expected)
    np.testing.assert_array_equal(extra[:, 2], backwards(index))


def test_high_digits_of_the_index():
    """Points are linear in the digits of the index, and the last of 32 has its own direction number."""
    rng = np.random.default_rng(1)
    a, b = rng.integers(0, 2**32, (2, 1000), dtype=np.uint32)
    np.testing.assert_array_equal(digits(a)[0] ^ digits(b)[0], digits(a ^ b)[0])
    found = digits(np.uint32(1) << np.arange(32, dtype=np.uint32))[0]
    # A direction number ends with the digit of its number: the generator matrices are triangular.
    assert (found >> np.arange(32, dtype=np.uint32)[:, None] == 1).all()


# --- scrambling --------------------------------------------------------------------------------------------------

KEYS = [(0, 0), (1, 1), (0xFFFFFFFF, 0xFFFFFFFF), (0x243F6A88, 0x85A308D3), (0x13198A2E, 0x03707344)]


@pytest.mark.parametrize(("shift", "factor"), KEYS)
def test_scrambling_is_nested(shift, factor):
    """Two numbers keep the number of leading digits in which they agree, so that elementary intervals are permuted."""
    rng = np.random.default_rng(2)
    a = rng.integers(0, 2**32, 4000, dtype=np.uint32)
    common = rng.integers(0, 32, len(a)).astype(np.uint32)
    b = a ^ (np.uint32(1) << common) ^ (rng.integers(0, 2**32, len(a), dtype=np.uint32) << common << np.uint32(1))
    x, y = (digits(v, shift, factor)[1][:, 0] for v in (a, b))
    difference = x ^ y
    np.testing.assert_array_equal(difference & (~difference + np.uint32(1)), np.uint32(1) << common)


@pytest.mark.parametrize(("shift", "factor"), KEYS)
def test_shuffling_keeps_blocks(shift, factor):
    """Of every power of two: the first ones are the first ones in another order, and aligned blocks stay together."""
    n = 1 << 12
    shuffled = digits(np.arange(n), shift, factor)[1][:, 1].astype(np.int64)
    for m in range(13):
        blocks = shuffled.reshape(-1, 1 << m)
        np.testing.assert_array_equal(np.sort(blocks[0]), np.arange(1 << m))
        assert (blocks >> m == blocks[:, :1] >> m).all()
        assert len(set(blocks[:, 0] >> m)) == len(blocks)
    last = digits(np.array([2**31 - 2, 2**31 - 1]), shift, factor)[1][:, 1]
    assert last[0] ^ last[1] == 1


def test_digits_are_flipped_at_random():
    """Owen's scrambling flips each digit by a bit that belongs to the digits before it. Of 8 numbers that differ in the
    first three digits, over random keys: every such bit is set as often as not, and every two are equal as often as
    not; false-alarm rate 1e-4."""
    rng = np.random.default_rng(3)
    prefixes = np.arange(8)
    flips = []
    for shift, factor in rng.integers(0, 2**32, (4000, 2)):
        x = digits(prefixes, shift, factor)[1][:, 0] ^ prefixes.astype(np.uint32)
        # One bit for each node of the tree of three levels.
        flips.append([x[0] & 1, *((x[i] >> 1) & 1 for i in range(2)), *((x[i] >> 2) & 1 for i in range(4))])
    flips = np.array(flips)
    n, nodes = flips.shape
    pairs = [(a, b) for a in range(nodes) for b in range(a)]
    counts = [*flips.sum(axis=0), *((flips[:, a] ^ flips[:, b]).sum() for a, b in pairs)]
    level = sidak(len(counts))
    for count in counts:
        assert stats.binomtest(int(count), n, 0.5).pvalue > level


# --- stratification: exact ---------------------------------------------------------------------------------------


def assert_net(x, t=0):
    """A (t,m,s)-net of 2^m points (Niederreiter 1992): each elementary interval of volume 2^(t-m) holds 2^t."""
    n, s = x.shape
    m = int(math.log2(n))
    for shape in np.ndindex(*[m - t + 1] * s):
        if sum(shape) == m - t:
            cells = np.zeros(n, int)
            for k, q in enumerate(shape):
                cells = (cells << q) + np.floor(x[:, k].astype(np.float64) * 2.0**q).astype(int)
            counts = np.bincount(cells, minlength=1 << (m - t))
            assert (counts == 1 << t).all(), shape


KEYS_OF_DECISIONS = [(0, 0, 0), (123_456, 1, 1), (2**32 - 1, 7, 2**64 - 1)]  # pixel, bounce, seed


@pytest.mark.parametrize(("pixel", "bounce", "seed"), KEYS_OF_DECISIONS)
@pytest.mark.parametrize("purpose", PURPOSES)
def test_every_power_of_two_is_a_net(pixel, bounce, seed, purpose):
    x = points(1 << 12, pixel, bounce, purpose, seed)
    if purpose == PURPOSE_LIGHT:
        x = x[:, [1, 2, 0, 3]]
    for m in range(13):
        assert_net(x[: 1 << m, :2])
    for m in range(1, 9):
        assert_net(x[: 1 << m, :3], t=1)
    for m in range(3, 9):
        assert_net(x[: 1 << m], t=3)
    for k in range(4):
        assert_net(x[:, k : k + 1])
    for first in (16, 48, 4080):  # aligned blocks
        assert_net(x[first : first + 16, :2])


def test_far_samples_are_stratified():
    """Up to the last sample that a render can have."""
    for first in (2**24, 2**31 - 1024):
        assert_net(points(1024, first=first)[:, :2])


# --- uniformity and independence: chi-square ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "index"),
    [
        ("pixels", grid(pixels=1 << 16)),
        ("pixels, a later sample", grid(pixels=1 << 16) + np.array([0, 77, 0, 0])),
        ("pixels and samples", grid(pixels=1 << 15, samples=3)),
        ("bounces", grid(pixels=1 << 10, bounces=64)),
        ("purposes", grid(pixels=1 << 14, purposes=PURPOSES)),
    ],
)
@pytest.mark.parametrize("seed", [0, 2**40 + 3])
def test_marginals(name, index, seed):
    """One number, and two of one decision, over streams: uniform on [0, 1) and on its square."""
    u = draw(index, seed)
    assert u.min() >= 0.0
    assert u.max() < 1.0
    if "samples" in name:  # those of one pixel are not independent, so take one of each at random
        u = u.reshape(-1, 3, 4)[np.arange(1 << 15), np.random.default_rng(4).integers(0, 3, 1 << 15)]
    level = sidak(2 * 5 * 18)
    for a in range(4):
        for place in (1.0, 2.0**8, 2.0**16):  # the first digits, and those after them
            cells = (np.mod(u[:, a] * place, 1.0) * 256.0).astype(int)
            assert stats.chisquare(np.bincount(cells, minlength=256)).pvalue > level
        for b in range(a):
            assert pair_p_value(u[:, a], u[:, b]) > level


def pair_p_value(a, b) -> float:
    """Of Pearson's test that pairs (a, b) are uniform on the unit square, in 16 x 16 cells."""
    cells = (a * 16.0).astype(int) * 16 + (b * 16.0).astype(int)
    return stats.chisquare(np.bincount(cells, minlength=256)).pvalue


def test_decisions_are_independent():
    """Pairs of numbers of the same sample and of another one, from decisions that differ in one word of their key, over
    pixels. Sequences that are scrambled apart but shuffled alike pass that: so the distances of two samples in two
    decisions are tested together too."""
    n = 1 << 16
    first = grid(pixels=n) + np.array([0, 5, 0, PURPOSE_LIGHT])
    others = {"seed": (first, 1), "high seed": (first, 1 << 32)}
    for column, name in ((0, "pixel"), (2, "bounce"), (3, "purpose")):
        others[name] = (first + np.eye(4, dtype=int)[column], 0)
    later = np.array([0, 8, 0, 0])  # sample 13: in no small block with sample 5
    u, v = draw(first), draw(first + later)
    cases = {}
    for name, (index, seed) in others.items():
        x, y = draw(index, seed), draw(index + later, seed)
        for a in range(4):
            for b in range(4):
                cases[f"{name} {a} {b}, one sample"] = pair_p_value(u[:, a], x[:, b])
                cases[f"{name} {a} {b}, two samples"] = pair_p_value(u[:, a], y[:, b])
            # Distance between two samples, of which neither may tell that of the other decision.
            apart = [np.mod(late[:, a] - early[:, a], 1.0) for early, late in ((u, v), (x, y))]
            ranks = [stats.rankdata(d, method="ordinal") - 1 for d in apart]
            cases[f"{name} {a}, distances"] = pair_p_value(*(rank / n for rank in ranks))
    level = sidak(len(cases))
    for name, p in cases.items():
        assert p > level, name


def test_decisions_are_shuffled_apart():
    """How many of 64 samples are below 1/q in two decisions: chi-square over pixels, false-alarm rate 1e-4.

    Of every q samples from a multiple of q on, one is below 1/q in each. Its place among them is random and
    independent, so the number is binomial, of 64/q trials with the probability 1/q. Sequences that are scrambled but
    not shuffled would have it 0 or 64/q.
    """
    pixels, n = 4000, 64
    index = grid(pixels=pixels, samples=n)
    a = draw(index).reshape(pixels, n, 4)
    cases = {}
    for name, step in {"bounce": [0, 0, 1, 0], "purpose": [0, 0, 0, PURPOSE_BSDF], "pixel": [1, 0, 0, 0]}.items():
        b = draw(index + step).reshape(pixels, n, 4)
        for q in (2, 4, 8):
            for i in range(4):
                both = ((a[:, :, i] < 1.0 / q) & (b[:, :, 3 - i] < 1.0 / q)).sum(axis=1)
                expected = stats.binom(n // q, 1.0 / q).pmf(np.arange(n // q + 1))
                cases[name, q, i] = p_value(np.bincount(both, minlength=n // q + 2), expected)
    level = sidak(len(cases))
    for case, p in cases.items():
        assert p > level, case


# --- integration -------------------------------------------------------------------------------------------------


def smooth(x):
    """A product with the integral 1 over the unit square, with all interactions."""
    return np.exp(x[..., 0] + x[..., 1]) * (1.0 + 0.5 * np.sin(3.0 * x[..., 0] * x[..., 1])) / NORM


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(40)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS
NORM = 1.0
NORM = float(_WEIGHTS @ smooth(np.stack(np.meshgrid(_NODES, _NODES, indexing="ij"), axis=-1)) @ _WEIGHTS)


def estimates(name, n, streams, dimensions=(0, 1)):
    """Means of n samples of the integrand in each of many pixels, float64."""
    u = draw(grid(pixels=streams, samples=n), 17, name).astype(np.float64) + 2.0**-25
    return smooth(u[:, list(dimensions)]).reshape(streams, n).mean(axis=1)


@pytest.mark.parametrize("n", [1, 3, 16, 100, 256])
@pytest.mark.parametrize("dimensions", [(0, 1), (2, 3)])
def test_estimates_are_unbiased(n, dimensions):
    """z-test over 4000 pixels, for any number of samples; false-alarm rate 1e-4 over all."""
    values = estimates("sobol", n, 4000, dimensions)
    z = (values.mean() - 1.0) / (values.std(ddof=1) / math.sqrt(len(values)))
    assert 2.0 * stats.norm.sf(abs(z)) > sidak(10)


def test_order_of_convergence():
    """The slope of log variance over log n, of n from 4 to 1024: -1 for independent samples, and steeper than -2.2 for
    scrambled points (-3 up to logarithms for smooth integrands, Owen 1997).

    Each variance is estimated from 300 values, with a standard error of about 9 %, so that of a slope over five
    doublings of 4 is below 0.03; the bounds are four and more of them away.
    """
    counts = 4 ** np.arange(1, 6)
    slopes = {}
    for name in SAMPLERS:
        variances = [estimates(name, int(n), 300).var(ddof=1) for n in counts]
        slopes[name] = np.polyfit(np.log(counts), np.log(variances), 1)[0]
        print(name, slopes[name], variances)
    assert abs(slopes["independent"] + 1.0) < 0.12
    assert slopes["sobol"] < -2.2
