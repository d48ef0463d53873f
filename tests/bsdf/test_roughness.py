"""The roughness of a vertex, against the definition worked out by hand for each material."""

import numpy as np
import pytest
import warp as wp

from tests.bsdf.materials import Materials
from wavefront.bsdf.roughness import make_roughness
from wavefront.bsdf.tables import MaterialTables
from wavefront.scene import description as d
from wavefront.texture import TextureTables

KINDS = (
    "blend",
    "blend_transmissive",
    "conductor",
    "dielectric",
    "diffuse",
    "null",
    "oren_nayar",
    "plastic",
    "principled",
    "rough_conductor",
    "rough_dielectric",
    "rough_plastic",
)
roughness_at = make_roughness(KINDS, ("checkerboard",))


@wp.kernel(enable_backward=False, module="unique")
def roughness_kernel(
    materials: MaterialTables,
    textures: TextureTables,
    uv: wp.vec2,
    cos_o: float,
    # out
    result: wp.array[wp.float32],
):
    result[0] = roughness_at(materials, textures, 0, uv, cos_o)


DIFFUSE = d.Diffuse(reflectance=0.5)
COPPER = d.RoughConductor(material="Cu", alpha=0.25)
CHECKS = d.Checkerboard(color0=0.36, color1=0.04)
CASES = {  # at the front; at the back
    "diffuse": (d.TwoSided(front=DIFFUSE), 1.0, 1.0),
    "oren-nayar": (d.OrenNayar(roughness=0.3), 1.0, 1.0),
    "mirror": (d.Conductor(material="Cu"), 1.0, 1.0),
    "conductor": (COPPER, 0.5, 1.0),
    "anisotropic": (d.RoughConductor(material="Cu", alpha_u=0.1, alpha_v=0.22), 0.4, 1.0),
    "textured": (d.RoughConductor(material="Cu", alpha=CHECKS), 0.6, 1.0),
    "sides": (d.TwoSided(front=COPPER, back=DIFFUSE), 0.5, 1.0),
    "glass": (d.RoughDielectric(alpha=0.09), 0.3, 0.3),
    "plastic": (d.Plastic(), 1.0, 1.0),
    "rough plastic": (d.RoughPlastic(alpha=0.16), 0.4, 1.0),
    "principled": (d.Principled(roughness=0.7), 0.7, 1.0),
    "textured principled": (d.Principled(roughness=CHECKS), 0.36, 1.0),
    "blend": (d.Blend(first=COPPER, second=DIFFUSE, weight=0.25), 0.75 * 0.5 + 0.25, 1.0),
    "blend with a mirror": (d.Blend(first=COPPER, second=d.Conductor(material="Cu"), weight=0.25), 0.5, 1.0),
}


@pytest.mark.parametrize("case", CASES)
def test_roughness(case):
    bsdf, front, back = CASES[case]
    scene = Materials(bsdf).scene
    for cos_o, expected in ((0.8, front), (-0.8, back)):
        result = wp.zeros(1, dtype=wp.float32, device="cpu")
        inputs = [scene.materials, scene.textures, wp.vec2(0.2, 0.2), cos_o]
        wp.launch(roughness_kernel, dim=1, inputs=inputs, outputs=[result], device="cpu")
        np.testing.assert_allclose(result.numpy()[0], expected, rtol=1e-6)
