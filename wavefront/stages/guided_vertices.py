"""Guided vertices: queues the vertices where a guide has a say, with the share of BSDF sampling there."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.delta import make_delta_probability
from wavefront.bsdf.dispatch import is_smooth
from wavefront.bsdf.tables import MaterialTables
from wavefront.proposals import Proposals
from wavefront.queues import Paths, Queue, Surfaces, push, queue_size
from wavefront.texture import TextureTables


@functools.cache
def make_guided_vertices(bsdfs: tuple[str, ...], mask: bool, textures: tuple[str, ...], uvs: bool, mixed_deltas: bool):
    """Kernel of the stage; the arguments are the fields and properties of `Features` of the same name."""
    delta_probability = make_delta_probability(bsdfs, mask, textures)

    @wp.kernel(enable_backward=False, module="unique")
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
        counters: wp.array[wp.int32],
    ):
        i = wp.tid()
        if i >= queue_size(hits):
            return
        slot = hits.slots[i]
        material = surfaces.material[slot]
        normal = surfaces.shading_normal[slot]
        wo = -paths.direction[slot]
        delta = float(0.0)
        smooth = is_smooth(materials.materials[material], wp.dot(normal, wo))
        if wp.static(mixed_deltas):
            if smooth:
                uv = wp.vec2(0.0)
                if wp.static(uvs):
                    uv = surfaces.uv[slot]
                delta = delta_probability(materials, textures, material, uv, normal, wo)
                smooth = delta < 1.0
            proposals.delta[slot] = delta
        proposals.share[slot] = wp.where(smooth, share, 1.0)
        if smooth:  # a BSDF of deltas alone needs no guide
            push(guided, slot, counters)

    return queue_guided_vertices
