"""Blends: against their parts, the sampler against its density, and against Mitsuba 3 where that is right."""

import numpy as np
import pytest
from scipy import stats

from tests.bsdf import harness
from tests.bsdf.materials import Materials, vertices
from tests.chi_square import cell_sums, histogram, nodes, p_value, sidak
from wavefront.scene import description as d

SHAPE, PER_CELL, N = (31, 17), 12, 200_000
DIFFUSE = d.Diffuse(reflectance=[0.9, 0.5, 0.1])
METAL = d.RoughConductor(eta=[0.2, 0.9, 1.1], k=[3.9, 2.4, 2.2], alpha=0.4)
GLASS = d.Dielectric(int_ior=1.5, ext_ior=1.0)
GROUND_GLASS = d.RoughDielectric(int_ior=1.5, ext_ior=1.0, alpha=0.4)
PLASTIC = d.Plastic(int_ior=1.5, ext_ior=1.0, diffuse_reflectance=[0.3, 0.8, 0.6])
MIRROR = d.Conductor(material="Cu")
PAIRS = {
    "two that reflect": (DIFFUSE, METAL),
    "a part of a delta": (PLASTIC, METAL),
    "with glass": (DIFFUSE, GLASS),
    "with ground glass": (DIFFUSE, GROUND_GLASS),
    "with null": (METAL, d.Null()),
    "deltas": (GLASS, d.Null()),
}
TRANSMISSIVE = ("with glass", "with ground glass", "with null", "deltas")


def sphere_nodes():
    x, y, area = nodes(SHAPE, PER_CELL)
    z = 2.0 * x - 1.0
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(2.0 * np.pi * y), r * np.sin(2.0 * np.pi * y), z], axis=1), 4.0 * np.pi * area


@pytest.mark.parametrize("pair", PAIRS)
@pytest.mark.parametrize("weight", [0.0, 0.3, 1.0])
def test_values_are_those_of_the_parts(pair, weight):
    """Above and below, with a textured weight too: a texture of the same value, and another one elsewhere."""
    first, second = PAIRS[pair]
    checks = d.Checkerboard(color0=weight, color1=0.5)
    blends = d.Blend(first=first, second=second, weight=weight), d.Blend(first=first, second=second, weight=checks)
    m = Materials(first, second, *blends)
    n = 5000
    wo, wi = harness.random_directions(n, 1), harness.random_directions(n, 2)
    a, b = (m.evaluate(i, wo, wi) for i in (0, 1))
    for blend in (2, 3):
        found = m.evaluate(blend, wo, wi, vertices(n, (0.2, 0.2)))
        for field in ("value", "pdf"):
            expected = (1.0 - weight) * a[field] + weight * b[field]
            np.testing.assert_allclose(found[field], expected, rtol=1e-5, atol=1e-9)
    elsewhere = m.evaluate(3, wo, wi, vertices(n, (0.7, 0.2)))
    np.testing.assert_allclose(elsewhere["value"], 0.5 * (a["value"] + b["value"]), rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("cos_o", [0.7, -0.6])
def test_a_blend_of_blends_is_a_mixture_of_three(cos_o):
    inner = d.Blend(first=METAL, second=GROUND_GLASS, weight=0.25)
    m = Materials(DIFFUSE, METAL, GROUND_GLASS, d.Blend(first=inner, second=DIFFUSE, weight=0.4))
    weights = np.array([0.4, 0.6 * 0.75, 0.6 * 0.25])
    wo, wi = harness.direction(cos_o), harness.random_directions(5000, 2)
    parts, found = [m.evaluate(i, wo, wi) for i in range(3)], m.evaluate(3, wo, wi)
    for field in ("value", "pdf"):
        expected = sum(w * part[field] for w, part in zip(weights, parts, strict=True))
        np.testing.assert_allclose(found[field], expected, rtol=1e-5, atol=1e-9)
    s = m.sample(3, wo, harness.uniforms(N, 3))
    alive = s["pdf"] > 0.0
    e = m.evaluate(3, wo, s["wi"][alive])
    np.testing.assert_allclose(s["pdf"][alive], e["pdf"], rtol=1e-4)
    np.testing.assert_allclose(s["weight"][alive] * s["pdf"][alive, None], e["value"], rtol=2e-4, atol=1e-9)


@pytest.mark.parametrize("pair", PAIRS)
@pytest.mark.parametrize("cos_o", [0.8, 0.3, -0.9])
def test_samples_follow_the_pdf(pair, cos_o):
    """Chi-square over the sphere of directions for samples with a density, their share, and the mean weight against the
    means of the parts' weights, each from samples of its own. False-alarm rate 1e-4 each test."""
    first, second = PAIRS[pair]
    weight = 0.4
    m = Materials(first, second, d.Blend(first=first, second=second, weight=weight))
    wo = harness.direction(cos_o)
    s = m.sample(2, wo, harness.uniforms(N, 1))
    wi, area = sphere_nodes()
    probabilities = cell_sums(m.evaluate(2, wo, wi)["pdf"] * area, SHAPE, PER_CELL)
    smooth = s["pdf"] > 0.0
    level = sidak(5)
    z_level = stats.norm.isf(level / 2.0)
    assert abs(smooth.mean() - probabilities.sum()) < z_level * smooth.std() / np.sqrt(N) + 2e-3
    if smooth.any():
        w = s["wi"][smooth].astype(np.float64)
        counts = histogram(0.5 * (w[:, 2] + 1.0), np.mod(np.arctan2(w[:, 1], w[:, 0]) / (2.0 * np.pi), 1.0), SHAPE)
        assert p_value(counts, probabilities / probabilities.sum()) > level
        e = m.evaluate(2, wo, w)
        np.testing.assert_allclose(s["pdf"][smooth], e["pdf"], rtol=1e-4)
        np.testing.assert_allclose(s["weight"][smooth] * s["pdf"][smooth, None], e["value"], rtol=2e-4, atol=1e-9)
    parts = [m.sample(i, wo, harness.uniforms(N, 10 + i))["weight"].astype(np.float64) for i in (0, 1)]
    if cos_o < 0.0 and pair in TRANSMISSIVE:
        assert s["weight"].any()
    blended = s["weight"].astype(np.float64)
    expected = (1.0 - weight) * parts[0].mean(axis=0) + weight * parts[1].mean(axis=0)
    variance = sum(share**2 * p.var(axis=0) for share, p in zip((1.0 - weight, weight), parts, strict=True))
    sigma = np.sqrt((variance + blended.var(axis=0)) / N)
    assert np.all(np.abs(blended.mean(axis=0) - expected) <= z_level * sigma + 1e-6)
    crossed = (s["wi"][:, 2] * cos_o < 0.0) & (s["weight"][:, 0] > 0.0)
    if pair in ("with glass", "with ground glass"):
        assert crossed.any()
        np.testing.assert_allclose(s["eta"][crossed], 1.5 if cos_o > 0.0 else 1.0 / 1.5, rtol=1e-6)
    elif pair not in TRANSMISSIVE:
        assert not crossed.any()


def test_a_narrow_lobe_loses_nothing():
    """What `eval` makes of the rounded direction of a lobe of alpha 1e-4 does not count: the sample's own density."""
    narrow = d.RoughConductor(eta=0.0, k=1.0, alpha=1e-4)
    m = Materials(narrow, d.Blend(first=DIFFUSE, second=narrow, weight=1.0 - 1e-6))
    u, wo = harness.uniforms(N, 4), harness.direction(0.3)
    u[:, 2] = 0.5 + 0.5 * u[:, 2]  # the second part
    alone, blended = m.sample(0, wo, u), m.sample(1, wo, u)
    narrow = alone["pdf"] > 1e3  # not the tail, where the other part counts
    assert narrow.mean() > 0.99
    np.testing.assert_allclose(blended["weight"][narrow], alone["weight"][narrow], rtol=1e-5)
    np.testing.assert_allclose(blended["pdf"][narrow], alone["pdf"][narrow], rtol=1e-5)


@pytest.mark.parametrize("pair", [pair for pair in PAIRS if pair != "with null"])
def test_a_white_furnace_is_not_brighter_than_its_light(pair):
    """From outside, where radiance has no scaling by the index; the weights of white parts are at most one."""
    first, second = PAIRS[pair]
    m = Materials(d.Blend(first=first, second=second, weight=0.3))
    s = m.sample(0, harness.direction(0.4), harness.uniforms(N, 5))
    energy = s["weight"].astype(np.float64) * s["eta"][:, None].astype(np.float64) ** 2
    assert energy.mean(axis=0).max() <= 1.0 + 1e-6


def test_against_mitsuba():
    """What Mitsuba evaluates, for our samples too. What it samples has two errors where a part transmits (3.9): to the
    probability of a mirrored direction it adds the density of the other part; and where the part that is chosen rejects
    its sample (it is seen from its back, or reflects to below the surface), the direction still counts, weighted as if
    the other part had chosen it."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")

    def rgb(value):
        return {"type": "rgb", "value": value}

    glass = {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.4, "distribution": "ggx"}
    theirs = {"type": "blendbsdf", "weight": 0.4, "bsdf_0": {"type": "diffuse", "reflectance": rgb([0.9, 0.5, 0.1])}}
    bsdf, context = mi.load_dict(theirs | {"bsdf_1": glass}), mi.BSDFContext()
    m = Materials(d.Blend(first=DIFFUSE, second=GROUND_GLASS, weight=0.4))
    n = 1500
    wo, wi, u = harness.random_directions(n, 1), harness.random_directions(n, 2), harness.uniforms(n, 3)
    s, e = m.sample(0, wo, u), m.evaluate(0, wo, wi)
    si, drawn = mi.SurfaceInteraction3f(), 0
    for i in range(n):
        si.wi = wo[i].tolist()
        if min(abs(wo[i, 2]), abs(wi[i, 2])) > 0.02:
            np.testing.assert_allclose(
                e["value"][i], np.array(bsdf.eval(context, si, wi[i].tolist())), rtol=1e-3, atol=1e-6
            )
            np.testing.assert_allclose(e["pdf"][i], bsdf.pdf(context, si, wi[i].tolist()), rtol=1e-3, atol=1e-6)
        if s["weight"][i].any() and min(abs(wo[i, 2]), abs(s["wi"][i, 2])) > 0.05:
            w = s["wi"][i].tolist()
            pdf = bsdf.pdf(context, si, w)
            np.testing.assert_allclose(s["pdf"][i], pdf, rtol=3e-3)
            np.testing.assert_allclose(s["weight"][i], np.array(bsdf.eval(context, si, w)) / pdf, rtol=3e-3, atol=1e-6)
            drawn += 1
    assert drawn > 0.3 * n
