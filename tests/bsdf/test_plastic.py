"""Plastics: a sampler of two parts against its density, energy, reciprocity, and the constants of coatings."""

import itertools

import numpy as np
import pytest
from scipy import stats

from tests.bsdf import harness, oracle
from tests.chi_square import cell_sums, histogram, nodes, p_value, sidak
from wavefront.bsdf.coating import diffuse_fresnel, rough_coating

SHAPE, PER_CELL, N = (31, 17), 16, 200_000
IOR = 1.5
QUADRATURE_ERROR = 2e-3
# Lobes that the cells of a hemisphere resolve; narrower ones are those of the rough conductor.
SMOOTH = [("plastic", 0.1, 0, c) for c in (1.0, 0.6, 0.05)]
ROUGH = [("rough_plastic", a, d, c) for d in (0, 1) for a, c in ((0.1, 1.0), (0.1, 0.6), (0.5, 0.1), (1.0, 0.05))]


def parameters(name, alpha, distribution, **fields):
    return harness.parameters(
        alpha=alpha,
        distribution=distribution,
        ior=IOR,
        coating="rough" if name == "rough_plastic" else "smooth",
        **fields,
    )


def hemisphere():
    """Directions at the nodes of cells that are equal in cosine and azimuth, and the solid angle of each."""
    z, b, area = nodes(SHAPE, PER_CELL)
    r = np.sqrt((1.0 - z) * (1.0 + z))
    return np.stack([r * np.cos(2.0 * np.pi * b), r * np.sin(2.0 * np.pi * b), z], axis=1), 2.0 * np.pi * area


@pytest.mark.parametrize(("name", "alpha", "distribution", "cos_o"), SMOOTH + ROUGH)
@pytest.mark.parametrize("nonlinear", [False, True])
def test_samples_follow_the_pdf(name, alpha, distribution, cos_o, nonlinear):
    """Chi-square of the samples with a density, a z-test of the share of the delta, and the furnace: the mean weight is
    the integral of f cos and the mirror's share, per channel, and at most one. False-alarm rate 1e-4 each test."""
    diffuse, specular = (0.9, 0.3, 0.05), (1.0, 0.5, 0.8)
    p = parameters(name, alpha, distribution, diffuse=diffuse, reflectance=specular, nonlinear=nonlinear)
    wo = harness.direction(cos_o)
    wi, solid_angle = hemisphere()
    e = harness.evaluate(name, p, wo, wi)
    probabilities = cell_sums(e.pdf * solid_angle, SHAPE, PER_CELL)
    expected = (e.value * solid_angle).sum(axis=0)
    s = harness.sample(name, p, wo, harness.uniforms(N, 1))
    smooth = s.pdf > 0.0
    level = sidak(5)
    z = stats.norm.isf(level / 2.0)
    w = s.wi[smooth].astype(np.float64)
    counts = histogram(w[:, 2], np.mod(np.arctan2(w[:, 1], w[:, 0]) / (2.0 * np.pi), 1.0), SHAPE)
    assert p_value(counts, probabilities / probabilities.sum()) > level
    assert abs(smooth.mean() - probabilities.sum()) < z * max(smooth.std(), 0.01) / np.sqrt(N) + QUADRATURE_ERROR
    if name == "plastic":
        mirror = wo * [-1.0, -1.0, 1.0]
        np.testing.assert_allclose(s.wi[~smooth], np.broadcast_to(mirror, ((~smooth).sum(), 3)), atol=1e-7)
        fresnel = oracle.fresnel(np.array([cos_o]), IOR)[0]
        expected = expected + fresnel * np.array(specular)
    weight = s.weight.astype(np.float64)
    assert np.all(expected < 1.0 + QUADRATURE_ERROR)
    assert np.all(np.abs(weight.mean(axis=0) - expected) < z * weight.std(axis=0) / np.sqrt(N) + QUADRATURE_ERROR)


@pytest.mark.parametrize("nonlinear", [False, True])
@pytest.mark.parametrize("ior", [1.1, 1.5, 2.4, 0.8])
def test_white_plastic_absorbs_nothing(nonlinear, ior):
    """All that is not mirrored comes back from a white base: the integral over wi is 1 - F(wo), to the quadrature."""
    p = harness.parameters(ior=ior, nonlinear=nonlinear)
    x, w = np.polynomial.legendre.leggauss(400)
    z = 0.5 * (x + 1.0)
    wi = np.stack([np.sqrt(1.0 - z * z), np.zeros_like(z), z], axis=1)
    for cos_o in (1.0, 0.7, 0.2):
        value = harness.evaluate("plastic", p, harness.direction(cos_o), wi).value[:, 0].astype(np.float64)
        total = np.sum(value * 0.5 * w) * 2.0 * np.pi + oracle.fresnel(np.array([cos_o]), ior)[0]
        assert total == pytest.approx(1.0, abs=1e-3 if ior < 1.0 else 2e-5)


@pytest.mark.parametrize("name", ["plastic", "rough_plastic"])
@pytest.mark.parametrize(("alpha", "distribution"), [(1e-4, 0), (0.01, 1), (0.1, 0), (0.5, 1), (1.0, 0)])
def test_weight_is_value_over_pdf(name, alpha, distribution):
    """The half vector that `eval` recovers from float32 directions is off by 1e-7 / |h| in slope, which a lobe turns
    into a relative error of slope / alpha of its part of value and pdf."""
    p = parameters(name, alpha, distribution, diffuse=(0.9, 0.5, 0.2), reflectance=(0.3, 0.6, 1.0), nonlinear=True)
    for seed, cos_o in enumerate((1.0, 0.5, 0.05)):
        wo = harness.direction(cos_o)
        s = harness.sample(name, p, wo, harness.uniforms(20_000, seed))
        e = harness.evaluate(name, p, wo, s.wi)
        alive = s.pdf > 0.0
        assert alive.sum() > 4000
        tolerance = 2e-5 + 8e-6 / (alpha * np.minimum(np.linalg.norm(wo + s.wi, axis=1), 1.0))[alive]
        assert np.all(np.abs(e.pdf[alive] / s.pdf[alive] - 1.0) < tolerance)
        ratio = s.weight[alive] * s.pdf[alive, None] / e.value[alive] - 1.0
        assert np.all(np.abs(ratio) < tolerance[:, None])
        delta = (s.pdf == 0.0) & (s.weight[:, 0] > 0.0)
        assert delta.any() == (name == "plastic")


@pytest.mark.parametrize("name", ["plastic", "rough_plastic"])
def test_reciprocity(name):
    p = parameters(name, 0.3, 0, diffuse=(0.9, 0.5, 0.2), reflectance=(0.3, 0.6, 1.0), nonlinear=True)
    wo, wi = (harness.random_directions(20_000, seed, hemisphere=True) for seed in (1, 2))
    clear = np.minimum(wo[:, 2], wi[:, 2]) > 0.02
    forward = harness.evaluate(name, p, wo, wi).value / wi[:, 2:]
    backward = harness.evaluate(name, p, wi, wo).value / wo[:, 2:]
    assert np.all(forward[clear] > 0.0)
    np.testing.assert_allclose(forward[clear], backward[clear], rtol=1e-4)


@pytest.mark.parametrize("name", ["plastic", "rough_plastic"])
def test_black_parts(name):
    """Without a base or without a coating's reflection the other part has all samples, and nothing is divided by 0."""
    wo = np.array([harness.direction(c) for c in (1.0, 0.3, 1e-4, 1e-20)])
    for diffuse, specular in itertools.product([(0.0,) * 3, (0.7,) * 3], repeat=2):
        p = parameters(name, 0.2, 0, diffuse=diffuse, reflectance=specular)
        for o in wo:
            s = harness.sample(name, p, o, harness.uniforms(500, 1))
            e = harness.evaluate(name, p, o, s.wi)
            for field in (s.weight, s.pdf, s.wi, e.value, e.pdf):
                assert np.all(np.isfinite(field))
            if specular[0] == 0.0:
                assert not np.any((s.pdf == 0.0) & (s.weight[:, 0] > 0.0))
            if diffuse[0] == specular[0] == 0.0:
                assert np.all(s.weight == 0.0)
        if diffuse[0] == 0.0 < specular[0] and name == "plastic":
            assert np.all(harness.sample(name, p, wo[1], harness.uniforms(500, 1)).pdf == 0.0)


@pytest.mark.parametrize("eta", [1.0, 1.1, 1.5, 2.4, 1.0 / 1.5, 0.5])
def test_diffuse_reflectance_of_a_boundary(eta):
    cosines = (np.arange(400_000) + 0.5) / 400_000
    expected = np.mean(2.0 * cosines * oracle.fresnel(cosines, eta))
    assert diffuse_fresnel(eta) == pytest.approx(expected, abs=2e-6)


def coating_oracle(cos_o, alpha, kind, eta, count=400):
    """What a rough coating lets through, and what it reflects to the inside, by quadrature over slopes in float64.

    Slopes r = alpha sqrt(u) / (1 - v) with u = 1 - (1 - v)^2 for GGX: equal steps in v follow its long tail.
    """
    v = (np.arange(count) + 0.5) / count
    if kind == oracle.GGX:
        slope, weight = alpha * np.sqrt(1.0 - (1.0 - v) ** 2) / (1.0 - v), 2.0 * (1.0 - v)
    else:
        slope, weight = alpha * np.sqrt(-np.log1p(-v)), np.ones(count)
    r, phi = np.meshgrid(slope, np.pi * v, indexing="ij")
    m = np.stack([r * np.cos(phi), r * np.sin(phi), np.ones_like(r)], axis=-1).reshape(-1, 3)
    m /= np.linalg.norm(m, axis=1, keepdims=True)
    o = np.array([np.sqrt(1.0 - cos_o**2), 0.0, cos_o])
    c = np.maximum(m @ o, 0.0)
    # D m.z times the Jacobian is the weight, so that a visible normal has this one:
    weight = np.repeat(weight, count) / count**2 * oracle.g1(o[None], alpha, kind) * c / (cos_o * m[:, 2])
    t = (c / eta - np.sqrt(1.0 - (1.0 - c * c) / eta**2))[:, None] * m - o / eta
    passed = (1.0 - oracle.fresnel(c, eta)) * np.where(t[:, 2] < 0.0, oracle.g1(t, alpha, kind), 0.0)
    i = 2.0 * c[:, None] * m - o
    returned = oracle.fresnel(c, 1.0 / eta) * np.where(i[:, 2] > 0.0, oracle.g1(i, alpha, kind), 0.0)
    return np.sum(weight * passed), np.sum(weight * returned)


@pytest.mark.parametrize("kind", [oracle.GGX, oracle.BECKMANN])
@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
def test_rough_coatings(alpha, kind):
    alpha = float(np.float32(alpha))
    table, internal = rough_coating(IOR, alpha, kind)
    for i in (2, 10, 31, 63):
        expected, _ = coating_oracle(i / 63.0, alpha, kind, IOR)
        assert table[i] == pytest.approx(expected, abs=1.5e-3)
    returned = [0.0] + [coating_oracle(i / 63.0, alpha, kind, IOR, 100)[1] for i in range(1, 64)]
    assert internal == pytest.approx(2.0 * np.mean(np.array(returned) * np.arange(64) / 63.0), abs=1.5e-3)
