"""Guided vertices: queues the vertices where a guide has a say, with the share of BSDF sampling and what
the guide asks to know of the surface there."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.delta import make_delta_probability
from wavefront.bsdf.dispatch import is_smooth, side_kind, transmits
from wavefront.bsdf.roughness import make_roughness
from wavefront.bsdf.tables import MaterialTables
from wavefront.proposals import Proposals
from wavefront.queues import Counters, Paths, Queue, Surfaces, push, queue_end, slot_at
from wavefront.stage_kernel import stage_kernel
from wavefront.texture import TextureTables


@functools.cache
def make_guided_vertices(
    bsdfs: tuple[str, ...],
    mask: bool,
    textures: tuple[str, ...],
    uvs: bool,
    mixed_deltas: bool,
    guide_inputs: tuple[str, ...],
):
    """Kernel of the stage; the arguments are the fields and properties of `Features` of the same name."""
    delta_probability = make_delta_probability(bsdfs, mask, textures)
    roughness_at = make_roughness(bsdfs, textures)

    @stage_kernel
    def queue_guided_vertices(
        materials: MaterialTables,
        textures: TextureTables,
        paths: Paths,
        surfaces: Surfaces,
        hits: Queue,
        share: float,  # of BSDF sampling, unless the guide says otherwise
        # out
        proposals: Proposals,
        guided: Queue,
        counters: Counters,
    ):
        for i in range(wp.tid(), queue_end(hits, wp.tid())):
            slot = slot_at(hits, i)
            material = surfaces.material[slot]
            normal = surfaces.shading_normal[slot]
            wo = -paths.direction[slot]
            delta = float(0.0)
            cos_o = wp.dot(normal, wo)
            smooth = is_smooth(materials.materials[material], cos_o)
            uv = wp.vec2(0.0)
            if wp.static(uvs):
                uv = surfaces.uv[slot]
            if wp.static(mixed_deltas):
                if smooth:
                    delta = delta_probability(materials, textures, material, uv, normal, wo)
                    smooth = delta < 1.0
                proposals.delta[slot] = delta
            proposals.share[slot] = wp.where(smooth, share, 1.0)
            if wp.static("roughness" in guide_inputs):
                proposals.roughness[slot] = roughness_at(materials, textures, material, uv, cos_o)
            if wp.static("transmits" in guide_inputs):
                through = transmits(side_kind(materials.materials[material], cos_o))
                proposals.transmits[slot] = wp.where(through, 1, 0)
            if smooth:  # a BSDF of deltas alone needs no guide
                push(guided, slot, counters)

    return queue_guided_vertices
