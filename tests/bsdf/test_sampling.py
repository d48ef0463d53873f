"""Samplers against their densities, weights against values, energy and reciprocity, for every BSDF with a density."""

import numpy as np
import pytest
from scipy import stats

from tests.bsdf import harness
from tests.bsdf.charts import integrate
from tests.chi_square import p_value, sidak

N = 200_000
ALPHAS = [1e-4, 0.01, 0.1, 0.5, 1.0, (0.02, 0.1), (0.6, 0.15)]
ONE_SIDED = [1.0, 0.6, 0.05]  # cosines of wo
TWO_SIDED = [1.0, 0.6, 0.05, -0.9, -0.5, -0.05]  # inside glass, total reflection begins at -0.745
GRAZING = 1e-3  # not with the narrowest lobe: its half vectors could not be told apart from float32 directions
IOR = 1.5
QUADRATURE_ERROR = 1e-3  # of integrals over the cells; the horizon cuts through some

CASES = [("diffuse", 1.0, 0)] + [
    (name, alpha, distribution)
    for name in ("rough_conductor", "rough_dielectric")
    for distribution in (0, 1)
    for alpha in ALPHAS
]
each_case = pytest.mark.parametrize(("name", "alpha", "distribution"), CASES)


def cosines(name: str, alpha) -> list[float]:
    grazing = [GRAZING] if np.min(alpha) > 1e-3 else []
    return grazing + (TWO_SIDED if name == "rough_dielectric" else ONE_SIDED)


@each_case
def test_samples_follow_the_pdf(name, alpha, distribution):
    """Chi-square over cells that adapt to the lobe.

    The pdf integrates to one minus the probability that a sample falls below the horizon and ends there. The mean
    weight is compared with the integral of f cos in the same cells: the furnace, which must not exceed one.
    """
    p = harness.parameters(alpha=alpha, distribution=distribution, ior=IOR)
    level = sidak(3 * len(cosines(name, alpha)))
    for seed, cos_o in enumerate(cosines(name, alpha)):
        wo = harness.direction(cos_o)
        probabilities, values, charts = integrate(name, p, wo, alpha, IOR)
        assert probabilities.sum() < 1.0 + QUADRATURE_ERROR, cos_o
        s = harness.sample(name, p, wo, harness.uniforms(N, seed))
        alive = s.pdf > 0.0
        np.testing.assert_array_equal(alive, s.weight[:, 0] > 0.0)
        wi = s.wi[alive].astype(np.float64)
        counts = np.concatenate([chart.counts(wi) for chart in charts])
        assert counts.sum() == alive.sum()
        total = probabilities.sum()
        assert p_value(np.append(counts, 0), probabilities / total) > level, cos_o
        z = stats.norm.isf(level / 2.0)
        assert abs(alive.mean() - total) < z * alive.std() / np.sqrt(N) + QUADRATURE_ERROR, cos_o

        n = IOR if cos_o > 0.0 else 1.0 / IOR
        energy = s.weight[:, 0].astype(np.float64) * s.eta.astype(np.float64) ** 2  # flux, not radiance
        factors = np.array([1.0, n * n])[: len(charts)]
        expected = values[:, 0] @ factors
        assert expected < 1.0 + QUADRATURE_ERROR, cos_o
        assert energy.max() <= 1.0 + 1e-6
        error = abs(energy.mean() - expected)
        sigma = energy.std() / np.sqrt(N)
        assert error < z * sigma + QUADRATURE_ERROR, cos_o


@each_case
def test_weight_is_value_over_pdf(name, alpha, distribution):
    """Of the sample's own direction, for coloured materials. The half vector h that `eval` recovers from float32
    directions has errors of 1e-7 / |h| in slope, which the lobe turns into relative errors of the pdf of slope / alpha.
    """
    p = harness.parameters(
        (0.9, 0.5, 0.2), (0.3, 0.6, 1.0), eta=(0.2, 1.1, 4.0), k=(3.9, 2.5, 0.5),
        alpha=alpha, distribution=distribution, ior=IOR,
    )  # fmt: skip
    for seed, cos_o in enumerate(cosines(name, alpha)):
        wo = harness.direction(cos_o)
        s = harness.sample(name, p, wo, harness.uniforms(20_000, seed))
        alive = s.pdf > 0.0
        e = harness.evaluate(name, p, wo, s.wi)
        # At the critical angle the reflectance has an infinite slope, so that any rounding of the cosine is seen.
        cos_m2 = 0.25 * np.sum((wo + s.wi) ** 2, axis=1)
        critical = np.abs(cos_m2 - (1.0 - IOR**-2)) < 3e-3 if name == "rough_dielectric" and cos_o < 0.0 else False
        usable = alive & (e.pdf > 1e-20) & ~np.asarray(critical)
        assert usable.sum() > 0.99 * alive.sum()
        np.testing.assert_allclose(
            s.weight[usable] * e.pdf[usable, None], e.value[usable], rtol=2e-5 if np.min(alpha) > 1e-3 else 2e-4
        )
        n = np.where(s.wi[:, 2] * cos_o < 0.0, s.eta, 1.0)[:, None]
        h = np.linalg.norm(wo + n * s.wi, axis=1)
        tolerance = 2e-5 + 4e-6 / (np.min(alpha) * np.minimum(h, 1.0))
        deviation = np.abs(e.pdf[usable] / s.pdf[usable] - 1.0)
        assert np.all(deviation < tolerance[usable]), cos_o
        np.testing.assert_allclose(np.linalg.norm(s.wi, axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("alpha", [0.4, (0.4, 0.1)])
@pytest.mark.parametrize("distribution", [0, 1])
def test_reciprocity(distribution, alpha):
    """f(wo, wi) n_wi^2 = f(wi, wo) n_wo^2, n the index of the side that a direction is on (equal for reflection).

    Where a direction grazes its microfacet, Fresnel's transmittance amplifies the rounding of the cosine; such pairs
    are left out.
    """
    wo = harness.random_directions(20_000, 1)
    wi = harness.random_directions(20_000, 2)
    n_wi = np.where(wi[:, 2:] > 0.0, 1.0, IOR)
    n_wo = np.where(wo[:, 2:] > 0.0, 1.0, IOR)
    h = n_wo * wo + n_wi * wi
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    clear = np.minimum(np.abs(np.sum(h * wo, axis=1)), np.abs(np.sum(h * wi, axis=1))) > 0.05
    p = harness.parameters(alpha=alpha, distribution=distribution, ior=IOR, eta=(0.2, 1.1, 4.0), k=(3.9, 2.5, 0.5))
    for name in ("diffuse", "rough_conductor", "rough_dielectric"):
        forward = harness.evaluate(name, p, wo, wi).value / np.abs(wi[:, 2:]) * n_wi**2
        backward = harness.evaluate(name, p, wi, wo).value / np.abs(wo[:, 2:]) * n_wo**2
        assert np.count_nonzero(forward[clear]) > 10_000
        np.testing.assert_allclose(forward[clear], backward[clear], rtol=2e-4, atol=1e-12)


def test_reflectors_are_one_sided():
    w = harness.random_directions(2000, 3)
    wi = harness.random_directions(2000, 4)
    below = (w[:, 2] <= 0.0) | (wi[:, 2] <= 0.0)
    u = harness.uniforms(2000, 5)
    for name in ("diffuse", "rough_conductor", "plastic", "oren_nayar"):
        e = harness.evaluate(name, harness.parameters(alpha=0.5), w, wi)
        assert np.all((e.value[:, 0] == 0.0) == below)
        assert np.all((e.pdf == 0.0) == below)
    for name in ("diffuse", "conductor", "rough_conductor", "plastic", "oren_nayar"):
        s = harness.sample(name, harness.parameters(alpha=0.5), w, u)
        assert np.all(s.weight[w[:, 2] <= 0.0] == 0.0)
        assert np.all(s.wi[s.weight[:, 0] > 0.0, 2] > 0.0)


def test_tints_multiply():
    wo, wi = harness.random_directions(500, 6), harness.random_directions(500, 7)
    reflection = (wo[:, 2] * wi[:, 2] > 0.0)[:, None]
    tint_r, tint_t = np.array([0.9, 0.5, 0.0]), np.array([0.25, 0.0, 1.0])
    for name in ("diffuse", "rough_conductor", "rough_dielectric"):
        white = harness.evaluate(name, harness.parameters(alpha=0.4), wo, wi).value
        tinted = harness.evaluate(name, harness.parameters(tint_r, tint_t, alpha=0.4), wo, wi).value
        np.testing.assert_allclose(tinted, white * np.where(reflection, tint_r, tint_t), rtol=1e-6)
