"""Delta BSDFs and limits: everything about them is known in closed form."""

import itertools

import numpy as np
import pytest

from tests.bsdf import harness, oracle
from tests.chi_square import sidak
from wavefront.scene.ior import CONDUCTORS

N = 100_000


def test_mirror():
    wo = harness.random_directions(1000, 1)
    s = harness.sample("conductor", harness.parameters((0.9, 0.5, 0.0)), wo, harness.uniforms(1000, 2))
    above = wo[:, 2] > 0.0
    np.testing.assert_array_equal(s.wi[above], (wo * [-1.0, -1.0, 1.0])[above])
    np.testing.assert_allclose(s.weight[above], np.broadcast_to([0.9, 0.5, 0.0], (above.sum(), 3)), rtol=1e-6)
    np.testing.assert_array_equal(s.weight[~above], 0.0)
    np.testing.assert_array_equal(s.pdf, 0.0)
    np.testing.assert_array_equal(s.eta, 1.0)


def test_gold():
    eta, k = CONDUCTORS["Au"]
    wo = harness.random_directions(1000, 1, hemisphere=True)
    s = harness.sample("conductor", harness.parameters(eta=eta, k=k), wo, harness.uniforms(1000, 2))
    expected = oracle.fresnel(wo[:, 2:].astype(np.float64), np.array(eta) + 1j * np.array(k))
    np.testing.assert_allclose(s.weight, expected, rtol=2e-6)


@pytest.mark.parametrize("ior", [1.0001, 1.5, 4.0, 0.5])
def test_dielectric(ior):
    """Snell's law, the probability of reflection, and energy: each sample carries all of the flux."""
    ior = float(np.float32(ior))
    cosines = [1.0, 0.5, 0.05, -0.05, -0.5, -1.0]
    for seed, cos_o in enumerate(cosines):
        wo = harness.direction(cos_o)
        s = harness.sample("dielectric", harness.parameters(ior=ior), wo, harness.uniforms(N, seed))
        n = ior if cos_o > 0.0 else 1.0 / ior
        reflected = s.wi[:, 2] * cos_o > 0.0
        expected = oracle.fresnel(np.array([cos_o]), n)[0]
        sigma = np.sqrt(expected * (1.0 - expected) / N)
        assert abs(reflected.mean() - expected) <= 5.0 * sigma + 1e-6  # false-alarm rate 6e-7 each
        np.testing.assert_allclose(s.wi[reflected], np.broadcast_to(wo * [-1, -1, 1], (reflected.sum(), 3)), atol=1e-7)
        np.testing.assert_array_equal(s.weight[reflected], 1.0)
        np.testing.assert_array_equal(s.eta[reflected], 1.0)
        np.testing.assert_allclose(s.weight[~reflected, 0] * s.eta[~reflected] ** 2, 1.0, rtol=1e-6)
        np.testing.assert_allclose(s.eta[~reflected], n, rtol=2e-7)
        # n_o sin(theta_o) = n_i sin(theta_i), in the plane of incidence, on the other side.
        np.testing.assert_allclose(
            n * s.wi[~reflected, :2], np.broadcast_to(-wo[:2], ((~reflected).sum(), 2)), rtol=1e-6, atol=1e-7
        )
        np.testing.assert_allclose(np.linalg.norm(s.wi, axis=1), 1.0, atol=3e-7)
        np.testing.assert_array_equal(s.pdf, 0.0)


@pytest.mark.parametrize("ior", [1.0001, 1.5, 4.0, 0.5])
def test_thin_dielectric(ior):
    """The share of reflection is the sum over reflections inside the sheet, the same from both sides; a pass is
    straight on. Each sample carries all of the flux."""
    ior = float(np.float32(ior))
    for seed, cos_o in enumerate([1.0, 0.5, 0.05, -0.05, -0.5, -1.0]):
        wo = harness.direction(cos_o)
        p = harness.parameters((0.9, 0.5, 0.0), (0.3, 0.6, 1.0), ior=ior)
        s = harness.sample("thin_dielectric", p, wo, harness.uniforms(N, seed))
        f = oracle.fresnel(np.array([cos_o]), ior)[0]
        # F, then into the sheet, once or three, five, ... times reflected inside, and out again
        expected = f + (1.0 - f) ** 2 * sum(f ** (2 * k + 1) for k in range(4000))
        reflected = s.wi[:, 2] * cos_o > 0.0
        sigma = np.sqrt(expected * (1.0 - expected) / N)
        assert abs(reflected.mean() - expected) <= 5.0 * sigma + 1e-6  # false-alarm rate 6e-7 each
        mirror = np.where(reflected[:, None], wo * [-1.0, -1.0, 1.0], -wo)
        np.testing.assert_allclose(s.wi, mirror, atol=1e-7)
        tint = np.where(reflected[:, None], (0.9, 0.5, 0.0), (0.3, 0.6, 1.0))
        np.testing.assert_allclose(s.weight, tint, rtol=1e-6)
        np.testing.assert_array_equal(s.pdf, 0.0)
        np.testing.assert_array_equal(s.eta, 1.0)


def test_null_lets_everything_pass():
    wo = harness.random_directions(100, 1)
    s = harness.sample("null", harness.parameters(), wo, harness.uniforms(100, 2))
    np.testing.assert_array_equal(s.wi, -wo)
    np.testing.assert_array_equal(s.weight, 1.0)
    np.testing.assert_array_equal(s.pdf, 0.0)
    np.testing.assert_array_equal(s.eta, 1.0)


def test_total_reflection_is_certain():
    """Even with the largest random number."""
    u = np.full((3, 3), harness.LARGEST_UNIFORM, dtype=np.float32)
    wo = np.array([harness.direction(c) for c in (-0.7, -0.3, -1e-4)])
    for name in ("dielectric", "rough_dielectric"):
        s = harness.sample(name, harness.parameters(ior=1.5, alpha=1e-4), wo, np.array([[0.5, 0.5, 1.0]], "f4") * u)
        alive = s.weight[:, 0] > 0.0
        assert alive[0]
        assert alive[1]
        assert np.all(s.wi[alive, 2] < 0.0)
        assert np.all(s.weight <= 1.0)


@pytest.mark.parametrize("name", ["dielectric", "rough_dielectric"])
def test_equal_indices_make_no_boundary(name):
    """Also at grazing angles and with any roughness: the tint alone, straight on."""
    wo = np.concatenate([harness.random_directions(1000, 1), [[1.0, 0.0, 0.0], [1.0, 0.0, 1e-7]]])
    p = harness.parameters(transmittance=(0.9, 0.5, 0.0), ior=1.0, alpha=0.7)
    u = harness.uniforms(len(wo), 2)
    u[:10] = 0.0  # a probability of zero must not let the number 0 through
    s = harness.sample(name, p, wo, u)
    np.testing.assert_allclose(s.wi, -wo, atol=1e-7)
    np.testing.assert_allclose(s.weight, np.broadcast_to([0.9, 0.5, 0.0], s.weight.shape), rtol=1e-6)
    np.testing.assert_array_equal(s.pdf, 0.0)
    np.testing.assert_array_equal(s.eta, 1.0)
    if name == "rough_dielectric":
        e = harness.evaluate(name, p, wo, -wo)
        np.testing.assert_array_equal(e.value, 0.0)
        np.testing.assert_array_equal(e.pdf, 0.0)


@pytest.mark.parametrize("distribution", [0, 1])
def test_vanishing_roughness_is_smooth(distribution):
    """With alpha = 1e-4 directions and mean weight are those of the smooth BSDF."""
    u = harness.uniforms(N, 3)
    level = sidak(4)
    assert level > 5.7e-7  # five standard deviations are rarer
    for cos_o in (0.7, -0.9):
        wo = harness.direction(cos_o)
        p = harness.parameters(alpha=1e-4, distribution=distribution, ior=1.5)
        rough = harness.sample("rough_dielectric", p, wo, u)
        smooth = harness.sample("dielectric", p, wo, u)
        same = rough.wi[:, 2] * smooth.wi[:, 2] > 0.0
        assert same.mean() > 0.999  # they differ where u.z falls between two reflectances
        angle = np.linalg.norm(rough.wi - smooth.wi, axis=1)[same]
        assert np.quantile(angle, 0.9) < 2e-3
        sigma = rough.weight[:, 0].std() / np.sqrt(N)
        assert abs(rough.weight[:, 0].mean() - smooth.weight[:, 0].mean()) < 5.0 * sigma


ENDS = [0.0, 2.0**-24, 0.3, 0.5, 1.0 - 2.0**-23, harness.LARGEST_UNIFORM]
ALL_KINDS = [
    "diffuse", "conductor", "rough_conductor", "dielectric", "rough_dielectric", "plastic", "rough_plastic",
    "thin_dielectric", "null", "oren_nayar",
]  # fmt: skip
DENSE = ["diffuse", "rough_conductor", "rough_dielectric", "plastic", "rough_plastic", "oren_nayar"]
COSINES = [1.0, 1.0 - 2.0**-24, 0.5, 1e-2, 1e-4, 1e-7, 1e-20, 1e-30, 0.0]


@pytest.mark.parametrize("name", ALL_KINDS)
def test_extremes_are_finite(name):
    """Every end of every range: samples and values are finite and not negative, directions are unit vectors."""
    u = np.array(list(itertools.product(ENDS, repeat=3)), dtype=np.float32)
    wo = np.array([harness.direction(sign * c, phi) for c in COSINES for sign in (1.0, -1.0) for phi in (0.0, 2.0)])
    wo_all = np.repeat(wo, len(u), axis=0)
    u_all = np.tile(u, (len(wo), 1))
    for alpha, distribution, ior in itertools.product((1e-4, 0.01, 1.0), (0, 1), (1.0, 1.0001, 1.5, 4.0, 0.25)):
        p = harness.parameters(
            alpha=alpha, distribution=distribution, ior=ior, eta=(0.2, 0.0, 4.0), k=(3.9, 0.0, 0.0),
            diffuse=(0.8, 0.0, 1.0), coating="rough" if name == "rough_plastic" else "smooth",
        )  # fmt: skip
        s = harness.sample(name, p, wo_all, u_all)
        for field in (s.wi, s.weight, s.pdf, s.eta):
            assert np.all(np.isfinite(field))
        assert np.all(s.pdf >= 0.0)
        assert np.all(s.weight >= 0.0)
        bound = 3.2 if name == "oren_nayar" else 1.0
        if "plastic" in name:
            # The part is chosen by the mean of the channels, and the base returns up to 1 / (1 - internal).
            bound = 3.0 * max(1.0, 1.0 / ((1.0 - p.internal) * ior**2))
        assert np.all(s.weight * s.eta[:, None] ** 2 <= bound + 1e-5)
        np.testing.assert_allclose(np.linalg.norm(s.wi, axis=1), 1.0, atol=1e-5)
        if name in DENSE:
            for wi in (s.wi, -wo_all, wo_all, wo_all * [-1.0, -1.0, 1.0]):
                e = harness.evaluate(name, p, wo_all, wi)
                assert np.all(np.isfinite(e.value))
                assert np.all(np.isfinite(e.pdf))
                assert np.all(e.value >= 0.0)
                assert np.all(e.pdf >= 0.0)
