"""Philox against the published vectors, and uniformity of the numbers that the renderer draws."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

from wavefront.rng import PURPOSE_BSDF, PURPOSE_CAMERA, PURPOSE_LIGHT, philox, to_unit_interval, uniform4

DEVICE = "cpu"
FALSE_ALARM_RATE = 1e-4  # of each statistical test


@wp.kernel(enable_backward=False, module="unique")
def philox_kernel(
    counters: wp.array(dtype=wp.vec4ui), keys: wp.array(dtype=wp.vec2ui), result: wp.array(dtype=wp.vec4ui)
):
    i = wp.tid()
    result[i] = philox(counters[i], keys[i])


@wp.kernel(enable_backward=False, module="unique")
def uniform_kernel(
    seed: wp.uint64,
    index: wp.array2d(dtype=wp.int32),  # pixel, sample, bounce, purpose
    result: wp.array(dtype=wp.vec4),
):
    i = wp.tid()
    result[i] = uniform4(seed, wp.uint32(index[i, 0]), wp.uint32(index[i, 1]), index[i, 2], index[i, 3])


@wp.kernel(enable_backward=False, module="unique")
def unit_interval_kernel(bits: wp.array(dtype=wp.uint32), result: wp.array(dtype=float)):
    i = wp.tid()
    result[i] = to_unit_interval(bits[i])


def uniforms(seed: int, index) -> np.ndarray:
    index = np.ascontiguousarray(index, dtype=np.int32)
    result = wp.empty(len(index), dtype=wp.vec4, device=DEVICE)
    inputs = [wp.uint64(seed), wp.array(index, dtype=wp.int32, device=DEVICE)]
    wp.launch(uniform_kernel, dim=len(index), inputs=inputs, outputs=[result], device=DEVICE)
    return result.numpy()


def grid(pixels=1, samples=1, bounces=1, purposes=(PURPOSE_CAMERA,)) -> np.ndarray:
    axes = np.meshgrid(np.arange(pixels), np.arange(samples), np.arange(bounces), list(purposes), indexing="ij")
    return np.stack([a.ravel() for a in axes], axis=1)


def test_known_answers():
    """The vectors for philox4x32-10 that Random123 publishes."""
    ones = 0xFFFFFFFF
    counters = [(0, 0, 0, 0), (ones,) * 4, (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344)]
    keys = [(0, 0), (ones, ones), (0xA4093822, 0x299F31D0)]
    expected = [
        (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8),
        (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ]
    result = wp.empty(3, dtype=wp.vec4ui, device=DEVICE)
    inputs = [
        wp.array(np.array(counters, dtype=np.uint32), dtype=wp.vec4ui, device=DEVICE),
        wp.array(np.array(keys, dtype=np.uint32), dtype=wp.vec2ui, device=DEVICE),
    ]
    wp.launch(philox_kernel, dim=3, inputs=inputs, outputs=[result], device=DEVICE)
    np.testing.assert_array_equal(result.numpy(), np.array(expected, dtype=np.uint32))


def test_unit_interval_is_half_open():
    bits = np.array([0, 0xFF, 0x100, 0x80000000, 0xFFFFFF00, 0xFFFFFFFF], dtype=np.uint32)
    result = wp.empty(len(bits), dtype=float, device=DEVICE)
    inputs = [wp.array(bits, dtype=wp.uint32, device=DEVICE)]
    wp.launch(unit_interval_kernel, dim=len(bits), inputs=inputs, outputs=[result], device=DEVICE)
    np.testing.assert_array_equal(result.numpy(), [0.0, 0.0, 2.0**-24, 0.5, 1.0 - 2.0**-24, 1.0 - 2.0**-24])


def test_every_word_of_counter_and_key_matters():
    base = np.array([[5, 6, 7, PURPOSE_LIGHT]])
    reference = uniforms(1, base)
    for column in range(4):
        changed = base.copy()
        changed[0, column] += 1
        assert np.all(uniforms(1, changed) != reference)
    assert np.all(uniforms(2, base) != reference)
    assert np.all(uniforms(1 + (1 << 32), base) != reference)  # the upper half of the seed
    np.testing.assert_array_equal(uniforms(1, base), reference)


@pytest.mark.parametrize(
    ("name", "index"),
    [
        ("pixels", grid(pixels=1 << 16)),
        ("samples", grid(samples=1 << 16)),
        ("bounces", grid(pixels=1 << 10, bounces=64)),
        ("purposes", grid(pixels=1 << 14, purposes=(PURPOSE_CAMERA, PURPOSE_LIGHT, PURPOSE_BSDF, 7))),
    ],
)
def test_uniform_over_neighbouring_counters(name, index):
    u = uniforms(0, index)
    assert u.min() >= 0.0
    assert u.max() < 1.0
    level = 1.0 - (1.0 - FALSE_ALARM_RATE) ** (1.0 / 4.0)  # Šidák, four components
    for component in range(4):
        counts = np.bincount((u[:, component] * 256.0).astype(int), minlength=256)
        assert stats.chisquare(counts).pvalue > level, name


def _independent(a: np.ndarray, b: np.ndarray, level: float) -> bool:
    """Chi-square test that pairs (a, b) are uniform on the unit square."""
    cells = (a * 16.0).astype(int) * 16 + (b * 16.0).astype(int)
    return stats.chisquare(np.bincount(cells, minlength=256)).pvalue > level


def test_neighbours_are_independent():
    """Pairs of numbers that belong to neighbouring seeds, pixels, samples, bounces and purposes, and to one draw."""
    n = 1 << 16
    first = grid(pixels=n)
    u = uniforms(0, first)
    others = {"seed": uniforms(1, first), "seed, high": uniforms(1 << 32, first)}
    for column, name in enumerate(("pixel", "sample", "bounce", "purpose")):
        neighbour = first.copy()
        neighbour[:, column] += 1
        others[name] = uniforms(0, neighbour)
    pairs = {f"{name} {c}": (u[:, c], other[:, c]) for name, other in others.items() for c in range(4)}
    pairs |= {f"components {a} {b}": (u[:, a], u[:, b]) for a in range(4) for b in range(a)}
    level = 1.0 - (1.0 - FALSE_ALARM_RATE) ** (1.0 / len(pairs))
    for name, (a, b) in pairs.items():
        assert _independent(a, b, level), name
