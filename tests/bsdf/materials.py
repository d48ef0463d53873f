"""Runs whole materials (sides, opacity, maps, blends) of an uploaded scene over arrays of vertices and directions.

Its kernels know the kinds, textures and maps that the tests of this folder use; they are compiled once for all.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from tests.bsdf import harness
from wavefront.bsdf.dispatch import make_bsdf
from wavefront.bsdf.frame import ShadingFrame
from wavefront.bsdf.maps import make_mapped_frame
from wavefront.bsdf.record import BsdfEval, BsdfSample
from wavefront.bsdf.tables import MaterialTables
from wavefront.scene import description as d
from wavefront.scene.device import upload_scene
from wavefront.surface import Vertex
from wavefront.texture import TextureTables

DEVICE = "cpu"
KINDS = (
    "blend",
    "blend_transmissive",
    "conductor",
    "dielectric",
    "diffuse",
    "null",
    "plastic",
    "rough_conductor",
    "rough_dielectric",
)
TEXTURES = ("checkerboard", "floats")
eval_bsdf, sample_bsdf, _ = make_bsdf(KINDS, True, TEXTURES, True, True)
mapped_frame = make_mapped_frame(TEXTURES, True)


@wp.kernel(enable_backward=False, module="unique")
def evaluate_kernel(
    materials: MaterialTables,
    textures: TextureTables,
    material: int,
    vertices: wp.array[Vertex],
    wo: wp.array[wp.vec3],
    wi: wp.array[wp.vec3],
    u: wp.array[wp.vec3],
    # outputs
    frames: wp.array[ShadingFrame],
    evals: wp.array[BsdfEval],
    samples: wp.array[BsdfSample],
):
    i = wp.tid()
    vertex = vertices[i]
    frame = ShadingFrame()
    frame.normal = vertex.shading_normal
    frame.tangent = vertex.tangent
    frame.base_normal = vertex.shading_normal
    if materials.maps.shape[0] > 0:
        frame = mapped_frame(materials, textures, material, vertex, wo[i])
    frames[i] = frame
    evals[i] = eval_bsdf(materials, textures, material, vertex.uv, frame, wo[i], wi[i])
    samples[i] = sample_bsdf(materials, textures, material, vertex.uv, frame, wo[i], u[i])


def vertices(n: int, uv=(0.3, 0.6), s=(1.0, 0.0, 0.0), t=(0.0, 1.0, 0.0), jacobian=(1.0, 0.0, 1.0)) -> np.ndarray:
    """`n` vertices with tangents s and t, of which the geometric normal is the shading normal."""
    host = np.zeros(n, dtype=Vertex.numpy_dtype())
    host["shading_normal"] = host["geometric_normal"] = np.cross(s, t)
    host["tangent"], host["uv"], host["uv_jacobian"] = s, uv, jacobian
    return host


class Materials:
    """Materials in the order given."""

    def __init__(self, *bsdfs: d.Bsdf):
        self.scene = upload_scene(d.Scene(shapes=[d.Sphere(bsdf=bsdf) for bsdf in bsdfs]), DEVICE)

    def run(self, material: int, wo, wi, u=None, at: np.ndarray | None = None):
        """Frames, evaluations at `wi`, and samples with `u`, as structured arrays; world space."""
        n = max(len(np.atleast_2d(a)) for a in (wo, wi) if a is not None) if u is None else len(u)
        u = np.full((n, 3), 0.5) if u is None else u
        wi = (0.0, 0.0, 1.0) if wi is None else wi
        out = [wp.empty(n, dtype=kind, device=DEVICE) for kind in (ShadingFrame, BsdfEval, BsdfSample)]
        at = wp.array(vertices(n) if at is None else at, dtype=Vertex, device=DEVICE)
        arrays = [wp.array(harness.vectors(a, n), dtype=wp.vec3, device=DEVICE) for a in (wo, wi, u)]
        inputs = [self.scene.materials, self.scene.textures, material, at, *arrays]
        wp.launch(evaluate_kernel, dim=n, inputs=inputs, outputs=out, device=DEVICE)
        return [a.numpy() for a in out]

    def evaluate(self, material: int, wo, wi, at: np.ndarray | None = None) -> np.ndarray:
        return self.run(material, wo, wi, at=at)[1]

    def sample(self, material: int, wo, u, at: np.ndarray | None = None) -> np.ndarray:
        return self.run(material, wo, None, u, at)[2]
