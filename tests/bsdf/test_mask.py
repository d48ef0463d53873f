"""Masks: a share of the surface that is there, or with a cutoff, all or nothing."""

import numpy as np
import pytest

from tests.bsdf import harness
from tests.bsdf.materials import Materials, vertices
from wavefront.scene import description as d

DIFFUSE = d.TwoSided(front=d.Diffuse(reflectance=[0.9, 0.5, 0.1]))
CHECKS = d.Checkerboard(color0=0.75, color1=0.25)
THERE, NOT_THERE = (0.2, 0.2), (0.2, 0.7)  # of the two colours
N = 500


def run(material, at, seed=1):
    wo, wi = harness.random_directions(N, seed), harness.random_directions(N, seed + 1)
    _, evals, samples = material.run(0, wo, wi, harness.uniforms(N, seed + 2), vertices(N, at))
    _, plain, _ = Materials(DIFFUSE).run(0, wo, wi, harness.uniforms(N, seed + 2), vertices(N, at))
    passed = np.all(samples["wi"] == -wo.astype(np.float32), axis=1)
    return evals, plain, passed


def test_without_a_cutoff_opacity_is_a_share():
    mask = Materials(d.Mask(bsdf=DIFFUSE, opacity=CHECKS))
    for at, opacity in ((THERE, 0.75), (NOT_THERE, 0.25)):
        evals, plain, passed = run(mask, at)
        np.testing.assert_allclose(evals["value"], opacity * plain["value"], rtol=1e-6)
        np.testing.assert_allclose(evals["pdf"], opacity * plain["pdf"], rtol=1e-6)
        assert abs(passed.mean() - (1.0 - opacity)) < 5.0 * np.sqrt(0.1875 / N)  # false alarm rate 6e-7


@pytest.mark.parametrize("cutoff", [0.26, 0.5, 0.75])  # at the cutoff itself, the surface is there
def test_a_cutoff_is_all_or_nothing(cutoff):
    mask = Materials(d.Mask(bsdf=DIFFUSE, opacity=CHECKS, cutoff=cutoff))
    evals, plain, passed = run(mask, THERE)
    np.testing.assert_array_equal(evals["value"], plain["value"])
    np.testing.assert_array_equal(evals["pdf"], plain["pdf"])
    assert not passed.any()
    evals, _, passed = run(mask, NOT_THERE)
    assert not evals["value"].any() and not evals["pdf"].any()
    assert passed.all()


@pytest.mark.parametrize(("opacity", "cutoff", "there"), [(0.3, 0.3, True), (0.3, 0.31, False), (1.0, 2.0, False)])
def test_a_cutoff_of_a_number(opacity, cutoff, there):
    _, _, passed = run(Materials(d.Mask(bsdf=DIFFUSE, opacity=opacity, cutoff=cutoff)), THERE)
    assert passed.all() != there and passed.any() != there
