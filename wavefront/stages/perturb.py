"""Perturb: turns the shading frames of vertices whose material has a bump or normal map."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.maps import make_mapped_frame
from wavefront.bsdf.tables import MaterialTables
from wavefront.queues import Paths, Queue, Surfaces, queue_end, slot_at
from wavefront.stage_kernel import stage_kernel
from wavefront.surface import Vertex
from wavefront.texture import TextureTables


@functools.cache
def make_perturb(textures: tuple[str, ...], uvs: bool, bumps: bool):
    """Kernel of the stage.

    Args:
        textures, uvs: Fields of `Features`.
        bumps: Whether some map is a bump map.
    """
    mapped_frame = make_mapped_frame(textures, bumps)

    @stage_kernel
    def perturb_frames(
        materials: MaterialTables,
        textures: TextureTables,
        paths: Paths,
        rays: Queue,
        # in and out
        surfaces: Surfaces,
    ):
        for i in range(wp.tid(), queue_end(rays, wp.tid())):
            slot = slot_at(rays, i)
            material = surfaces.material[slot]
            if material < 0:
                continue
            vertex = Vertex()
            vertex.geometric_normal = surfaces.geometric_normal[slot]
            vertex.shading_normal = surfaces.shading_normal[slot]
            vertex.tangent = surfaces.tangent[slot]
            if wp.static(uvs):
                vertex.uv = surfaces.uv[slot]
            if wp.static(bumps):
                vertex.uv_jacobian = surfaces.uv_jacobian[slot]
            frame = mapped_frame(materials, textures, material, vertex, -paths.direction[slot])
            surfaces.shading_normal[slot] = frame.normal
            surfaces.tangent[slot] = frame.tangent
            surfaces.base_normal[slot] = frame.base_normal
            surfaces.terminator[slot] = frame.terminator

    return perturb_frames
