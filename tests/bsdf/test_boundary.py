"""The index of the boundary that a direction crosses is the one that a BSDF sample in this direction reports."""

import numpy as np
import pytest
import warp as wp

from tests.bsdf import harness
from wavefront.bsdf.boundary import make_crossed_eta
from wavefront.bsdf.dispatch import make_bsdf
from wavefront.bsdf.frame import ShadingFrame
from wavefront.bsdf.tables import MaterialTables
from wavefront.scene import description as d
from wavefront.scene.device import upload_scene
from wavefront.texture import TextureTables

KINDS = ("blend", "blend_transmissive", "diffuse", "principled_transmissive", "rough_dielectric")
_, sample_bsdf, _ = make_bsdf(KINDS, False, (), False, False)
crossed_eta = make_crossed_eta(KINDS)
N = 4000


@wp.kernel(enable_backward=False, module="unique")
def compare_kernel(
    materials: MaterialTables,
    textures: TextureTables,
    material: int,
    wo: wp.array[wp.vec3],
    u: wp.array[wp.vec3],
    # out
    pdf: wp.array[wp.float32],
    sampled: wp.array[wp.float32],
    found: wp.array[wp.float32],
):
    i = wp.tid()
    frame = ShadingFrame()
    frame.normal = wp.normalize(wp.vec3(0.3, -0.5, 0.8))
    s = sample_bsdf(materials, textures, material, wp.vec2(0.0), frame, wo[i], u[i])
    pdf[i] = s.pdf
    sampled[i] = s.eta
    found[i] = crossed_eta(materials, material, frame, wo[i], s.wi)


GROUND = d.RoughDielectric(int_ior=1.5, ext_ior=1.1, alpha=0.4)
DIFFUSE = d.Diffuse(reflectance=0.5)
CASES = {
    "rough dielectric": (GROUND, 1.5 / 1.1),
    "principled": (d.Principled(spec_trans=0.8, roughness=0.5, eta=1.4), 1.4),
    "blend": (d.Blend(first=DIFFUSE, second=GROUND, weight=0.6), 1.5 / 1.1),
    "two-sided": (d.TwoSided(front=DIFFUSE), None),
}


@pytest.mark.parametrize("case", CASES)
def test_as_sampled(case):
    bsdf, eta = CASES[case]
    scene = upload_scene(d.Scene(shapes=[d.Sphere(bsdf=bsdf)]), "cpu")
    wo = wp.array(harness.vectors(harness.random_directions(N, 1), N), dtype=wp.vec3, device="cpu")
    u = wp.array(harness.vectors(harness.uniforms(N, 2), N), dtype=wp.vec3, device="cpu")
    out = [wp.zeros(N, dtype=wp.float32, device="cpu") for _ in range(3)]
    wp.launch(compare_kernel, dim=N, inputs=[scene.materials, scene.textures, 0, wo, u], outputs=out, device="cpu")
    pdf, sampled, found = (array.numpy() for array in out)
    smooth = pdf > 0.0
    assert smooth.sum() > N / 4
    np.testing.assert_allclose(found[smooth], sampled[smooth], rtol=1e-6)
    for value in () if eta is None else (eta, 1.0 / eta, 1.0):
        assert (np.abs(found[smooth] - value) < 1e-5).any()
