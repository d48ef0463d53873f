"""The probability of a delta direction is the frequency with which the sampler takes one.

A test of proportions per case, false alarm rate 1e-4.
"""

import numpy as np
import pytest
import warp as wp
from scipy import stats

from tests.bsdf import harness
from tests.bsdf.materials import KINDS, TEXTURES, Materials, vertices
from wavefront.bsdf.delta import make_delta_probability
from wavefront.bsdf.tables import MaterialTables
from wavefront.scene import description as d
from wavefront.texture import TextureTables

delta_probability = make_delta_probability(KINDS, True, TEXTURES)
N = 20_000


@wp.kernel(enable_backward=False, module="unique")
def delta_kernel(
    materials: MaterialTables,
    textures: TextureTables,
    uv: wp.vec2,
    wo: wp.vec3,
    # out
    result: wp.array[wp.float32],
):
    result[0] = delta_probability(materials, textures, 0, uv, wp.vec3(0.0, 0.0, 1.0), wo)


PLASTIC = d.Plastic(int_ior=1.5, ext_ior=1.0, diffuse_reflectance=[0.3, 0.2, 0.1])
DIFFUSE = d.Diffuse(reflectance=0.5)
CHECKS = d.Checkerboard(color0=0.75, color1=0.25)
CASES = {
    "diffuse": DIFFUSE,
    "plastic": PLASTIC,
    "two-sided plastic": d.TwoSided(front=PLASTIC),
    "mask": d.Mask(bsdf=d.TwoSided(front=DIFFUSE), opacity=CHECKS),
    "mask of plastic": d.Mask(bsdf=d.TwoSided(front=PLASTIC), opacity=0.6),
    "blend": d.Blend(first=DIFFUSE, second=d.Dielectric(), weight=0.3),
    "blend of plastic and a mirror": d.Blend(first=PLASTIC, second=d.Conductor(material="Cu"), weight=CHECKS),
    "null": d.Null(),
}


@pytest.mark.parametrize("cos_o", [0.9, 0.1, -0.4])
@pytest.mark.parametrize("case", CASES)
def test_frequency(case, cos_o):
    m = Materials(CASES[case])
    wo = np.array([np.sqrt(1.0 - cos_o * cos_o), 0.0, cos_o])
    uv = (0.2, 0.7)
    samples = m.sample(0, wo, harness.uniforms(N, 5), vertices(N, uv))
    found = int(((samples["pdf"] == 0.0) & (samples["weight"].max(axis=1) > 0.0)).sum())
    result = wp.zeros(1, dtype=wp.float32, device="cpu")
    inputs = [m.scene.materials, m.scene.textures, wp.vec2(*uv), wp.vec3(*wo)]
    wp.launch(delta_kernel, dim=1, inputs=inputs, outputs=[result], device="cpu")
    p = float(result.numpy()[0])
    if p in (0.0, 1.0):
        assert found == p * N
    else:
        assert stats.binomtest(found, N, p).pvalue > 1e-4
