"""Distributions of normals, masking, and visible normals: against float64, and the sampler against its density."""

import numpy as np
import pytest
import warp as wp
from scipy.special import erf

from tests.bsdf import harness, oracle
from tests.chi_square import cell_sums, histogram, nodes, p_value, sidak
from wavefront.bsdf.microfacet import visible_beckmann_slope

DISTRIBUTIONS = [oracle.GGX, oracle.BECKMANN]
ALPHAS = [1e-4, 0.01, 0.1, 0.5, 1.0, (1e-4, 1e-2), (0.5, 0.05), (0.2, 1.0)]
COSINES = [1.0, 0.9, 0.3, 0.01, 1e-4]
SHAPE = (31, 17)
PER_CELL = 12
N = 200_000


@wp.kernel(enable_backward=False, module="unique")
def slope_kernel(
    z: wp.array(dtype=float), s: wp.array(dtype=float), u: wp.array(dtype=float), x: wp.array(dtype=float)
):
    i = wp.tid()
    x[i] = visible_beckmann_slope(z[i], s[i], u[i])


def normals(n: int, alpha, seed: int) -> np.ndarray:
    """Normals spread over the lobe and its tail: slopes around alpha, logarithmically."""
    rng = np.random.default_rng(seed)
    alpha_x, alpha_y = np.broadcast_to(alpha, 2)
    slope = 10.0 ** rng.uniform(-2.0, 0.5, size=n)
    phi = rng.uniform(0.0, 2.0 * np.pi, size=n)
    m = np.stack([alpha_x * slope * np.cos(phi), alpha_y * slope * np.sin(phi), np.ones(n)], axis=1)
    return (m / np.linalg.norm(m, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("kind", DISTRIBUTIONS)
@pytest.mark.parametrize("alpha", ALPHAS)
def test_distribution_and_masking(alpha, kind):
    alpha = np.broadcast_to(alpha, 2).astype(np.float32).astype(np.float64)
    m = normals(4000, alpha, seed=1)
    wo = harness.random_directions(4000, seed=2, hemisphere=True)
    wo[:1000] *= [1.0, 1.0, 1e-3]
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    d, g1, pdf = harness.microfacet_terms(wo, m, alpha, kind)
    wo, m = wo.astype(np.float64), m.astype(np.float64)
    expected_d, expected_g1 = oracle.distribution(m, alpha, kind), oracle.g1(wo, alpha, kind)
    np.testing.assert_allclose(d, expected_d, rtol=1e-5)
    np.testing.assert_allclose(g1, expected_g1, rtol=2e-6)
    cos_m = np.sum(wo * m, axis=1)
    # Relative to the largest value that the cosine allows: the cosine itself is a difference near zero.
    expected = expected_d * expected_g1 / wo[:, 2] * np.maximum(0.0, cos_m)
    scale = expected_d * expected_g1 / wo[:, 2]
    assert np.all(np.abs(pdf - expected) <= 1e-5 * expected + 1e-6 * scale)


def test_normals_below_the_horizon_have_no_density():
    m = np.array([[1.0, 0.0, 0.0], [0.6, 0.0, -0.8], [0.0, 0.0, -1.0]])
    for kind in DISTRIBUTIONS:
        d, _, pdf = harness.microfacet_terms(harness.direction(0.5), m, 0.5, kind)
        np.testing.assert_array_equal(d, 0.0)
        np.testing.assert_array_equal(pdf, 0.0)


@pytest.mark.parametrize("tan", [0.0, 1e-4, 0.1, 0.3, 1.0, 3.0, 100.0, 1e4, 1e8])
def test_slope_inverts_the_exact_distribution(tan):
    u = np.concatenate([[2.0**-25, 2.0**-24, 1.0 - 2.0**-24], np.linspace(0.001, 0.999, 999)]).astype(np.float32)
    z = np.full(len(u), np.cos(np.arctan(tan)), dtype=np.float32)
    s = np.full(len(u), np.sin(np.arctan(tan)), dtype=np.float32)
    x = wp.empty(len(u), dtype=float, device="cpu")
    inputs = [wp.array(a, dtype=float, device="cpu") for a in (z, s, u)]
    wp.launch(slope_kernel, dim=len(u), inputs=inputs, outputs=[x], device="cpu")
    x = x.numpy().astype(np.float64)
    z, s = z.astype(np.float64), s.astype(np.float64)

    def cdf(x):
        return z * (1.0 + erf(x)) + s * np.exp(-(x**2)) / np.sqrt(np.pi)

    limit = np.minimum(z / np.maximum(s, 1e-30), 30.0)
    assert np.all(x <= limit * (1.0 + 1e-6) + 1e-6)
    np.testing.assert_allclose(cdf(x) / cdf(limit), u, rtol=1e-5, atol=1e-7)


# The chart of the hemisphere of normals, with slopes divided by alpha: their azimuth, and w = 1 / sqrt(1 + r^2) with r
# their length. It adapts to alpha, and in w the density has no singularity: for GGX, seen at an angle, it falls like
# r^-3 per d(r^2), and d(r^2) = 2 dw / w^3. With z = cos(theta): d(omega) = z^3 d(area of slopes).


def density_in_cells(wo, alpha, kind: int) -> np.ndarray:
    alpha_x, alpha_y = np.broadcast_to(alpha, 2)
    w, b, area = nodes(SHAPE, PER_CELL)
    r = np.sqrt((1.0 - w) * (1.0 + w)) / w
    phi = 2.0 * np.pi * b
    x, y = alpha_x * r * np.cos(phi), alpha_y * r * np.sin(phi)
    z = 1.0 / np.sqrt(1.0 + x**2 + y**2)
    m = np.stack([x * z, y * z, z], axis=1)
    _, _, pdf = harness.microfacet_terms(wo, m, alpha, kind)
    jacobian = 2.0 * np.pi * z**3 * alpha_x * alpha_y / w**3
    return cell_sums(pdf * jacobian * area, SHAPE, PER_CELL)


@pytest.mark.parametrize("kind", DISTRIBUTIONS)
@pytest.mark.parametrize("alpha", ALPHAS)
def test_visible_normals_follow_their_density(alpha, kind):
    """The density integrates to one (no visible normal is lost), and samples follow it, down to grazing angles."""
    for seed, cos_o in enumerate(COSINES):
        wo = harness.direction(cos_o)
        probabilities = density_in_cells(wo, alpha, kind)
        assert probabilities.sum() == pytest.approx(1.0, abs=1e-3), cos_o
        m = harness.visible_normals(wo, alpha, kind, harness.uniforms(N, seed)).astype(np.float64)
        np.testing.assert_allclose(np.linalg.norm(m, axis=1), 1.0, atol=3e-7)
        assert np.all(m[:, 2] > 0.0)
        assert np.all(m @ wo.astype(np.float32) > -1e-6)
        x, y = (m[:, :2] / (np.broadcast_to(alpha, 2) * m[:, 2:])).T
        azimuth = np.mod(np.arctan2(y, x) / (2.0 * np.pi), 1.0)
        counts = histogram(1.0 / np.sqrt(1.0 + x**2 + y**2), azimuth, SHAPE)
        assert p_value(counts, probabilities / probabilities.sum()) > sidak(len(COSINES)), cos_o
