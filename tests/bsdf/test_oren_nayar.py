"""The rough diffuse BSDF. Mitsuba 3 has none: the oracles are its formula in float64 and its energy in closed form."""

import numpy as np
import pytest
from scipy import stats

from tests.bsdf import harness
from tests.chi_square import cell_sums, histogram, nodes, p_value, sidak

SHAPE, PER_CELL, N = (31, 17), 8, 200_000
REFLECTANCE = (0.9, 0.5, 0.1)


def hemisphere():
    z, b, area = nodes(SHAPE, PER_CELL)
    r = np.sqrt((1.0 - z) * (1.0 + z))
    return np.stack([r * np.cos(2.0 * np.pi * b), r * np.sin(2.0 * np.pi * b), z], axis=1), 2.0 * np.pi * area


def albedo(cos_o, roughness):
    """Of a white surface: Portsmouth, Kutz and Hill 2024, equations 14 to 16."""
    theta, sine = np.arccos(cos_o), np.sqrt(1.0 - cos_o**2)
    g = sine * (theta - sine * cos_o) + 2.0 / 3.0 * ((sine / cos_o) * (1.0 - sine**3) - sine)
    return (np.pi + roughness * g) / (np.pi + (np.pi / 2.0 - 2.0 / 3.0) * roughness)


def angles(w):
    return np.arccos(w[:, 2]), np.arctan2(w[:, 1], w[:, 0])


@pytest.mark.parametrize("roughness", [0.0, 0.3, 1.0])
def test_value(roughness):
    """In angles, as the papers write it: s = sin sin cos(difference of azimuths)."""
    wo, wi = (harness.random_directions(5000, seed, hemisphere=True) for seed in (1, 2))
    e = harness.evaluate("oren_nayar", harness.parameters(REFLECTANCE, alpha=roughness), wo, wi)
    (o, phi_o), (i, phi_i) = angles(wo.astype(np.float64)), angles(wi.astype(np.float64))
    s = np.sin(o) * np.sin(i) * np.cos(phi_o - phi_i)
    t = np.where(s > 0.0, np.maximum(np.cos(o), np.cos(i)), 1.0)
    f = (1.0 + roughness * s / t) / (np.pi + (np.pi / 2.0 - 2.0 / 3.0) * roughness)
    np.testing.assert_allclose(e.value, (f * np.cos(i))[:, None] * np.array(REFLECTANCE), rtol=1e-4, atol=1e-6)
    backward = harness.evaluate("oren_nayar", harness.parameters(REFLECTANCE, alpha=roughness), wi, wo)
    np.testing.assert_allclose(e.value / wi[:, 2:], backward.value / wo[:, 2:], rtol=2e-5, atol=1e-7)


@pytest.mark.parametrize("roughness", [0.0, 0.3, 1.0])
def test_roughness_zero_is_lambert(roughness):
    wo, wi = (harness.random_directions(1000, seed, hemisphere=True) for seed in (1, 2))
    rough = harness.evaluate("oren_nayar", harness.parameters(alpha=roughness), wo, wi)
    lambert = harness.evaluate("diffuse", harness.parameters(), wo, wi)
    same = np.allclose(rough.value, lambert.value, rtol=1e-5, atol=1e-9)
    assert same == (roughness == 0.0)


@pytest.mark.parametrize("cos_o", [1.0, 0.6, 0.05, 1e-3])
@pytest.mark.parametrize("roughness", [0.0, 0.3, 1.0])
def test_samples_follow_the_pdf(roughness, cos_o):
    """Chi-square, the pdf integrates to one, the mean weight is the albedo, which is at most one, and each weight is at
    most 3.2. False-alarm rate 1e-4 each test."""
    p = harness.parameters(alpha=roughness)
    wo = harness.direction(cos_o)
    wi, solid_angle = hemisphere()
    probabilities = cell_sums(harness.evaluate("oren_nayar", p, wo, wi).pdf * solid_angle, SHAPE, PER_CELL)
    assert probabilities.sum() == pytest.approx(1.0, abs=1e-5)
    s = harness.sample("oren_nayar", p, wo, harness.uniforms(N, 1))
    w = s.wi.astype(np.float64)
    counts = histogram(w[:, 2], np.mod(np.arctan2(w[:, 1], w[:, 0]) / (2.0 * np.pi), 1.0), SHAPE)
    level = sidak(2)
    assert p_value(counts, probabilities / probabilities.sum()) > level
    weight = s.weight[:, 0].astype(np.float64)
    expected = albedo(cos_o, roughness)
    assert expected <= 1.0 + 1e-12
    assert abs(weight.mean() - expected) < stats.norm.isf(level / 2.0) * weight.std() / np.sqrt(N) + 1e-5
    assert weight.max() <= (3.2 if roughness > 0.0 else 1.0 + 1e-6)
    e = harness.evaluate("oren_nayar", p, wo, s.wi)
    np.testing.assert_allclose(s.pdf, e.pdf, rtol=1e-6)
    np.testing.assert_allclose(s.weight * s.pdf[:, None], e.value, rtol=1e-5, atol=1e-12)
