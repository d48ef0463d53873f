"""Proposes the next direction of a guided bounce: chooses the technique of each vertex and samples the BSDF where it is
the one; the others are queued for the guide."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.dispatch import make_bsdf
from wavefront.bsdf.frame import make_frame
from wavefront.bsdf.tables import MaterialTables
from wavefront.proposals import TECHNIQUE_BSDF, TECHNIQUE_GUIDE, Proposals, make_bsdf_share
from wavefront.queues import DEPTH, Counters, Paths, Queue, Surfaces, push, queue_end, slot_at
from wavefront.rng import PURPOSE_BSDF, PURPOSE_TECHNIQUE
from wavefront.sampler import SAMPLERS
from wavefront.stage_kernel import stage_kernel
from wavefront.stages.ahead import make_fetch_textures
from wavefront.texture import TextureTables


@functools.cache
def make_guided_propose(
    bsdfs: tuple[str, ...],
    mask: bool,
    textures: tuple[str, ...],
    uvs: bool,
    tangents: bool,
    maps: tuple[str, ...],
    transmission: bool,
    sampler: str,
    mixed_deltas: bool,
    ahead: bool,
):
    """Kernel of the stage; the arguments are the fields of `Features` of the same name."""
    _, sample_bsdf, _ = make_bsdf(bsdfs, mask, textures, tangents, bool(maps))
    frame_at, _ = make_frame(tangents, bool(maps))
    draw = SAMPLERS[sampler]
    bsdf_share = make_bsdf_share(mixed_deltas)
    fetch_textures = make_fetch_textures(textures, uvs, ahead)

    @stage_kernel
    def propose_directions(
        materials: MaterialTables,
        textures: TextureTables,
        paths: Paths,
        surfaces: Surfaces,
        hits: Queue,
        seed: wp.uint64,
        # in and out
        proposals: Proposals,
        # out
        proposed: Queue,  # to be filled by the guide
        smooth: Queue,  # directions for which the guide's density is needed
        counters: Counters,
    ):
        for i in range(wp.tid(), queue_end(hits, wp.tid())):
            fetch_textures(materials, textures, surfaces, hits, i)
            slot = slot_at(hits, i)
            pixel = paths.pixel[slot]
            sample = paths.sample[slot]
            depth = counters.values[DEPTH]
            share = bsdf_share(proposals, slot)
            if share < 1.0:
                choice = draw(seed, pixel, sample, depth, PURPOSE_TECHNIQUE)
                if choice[0] >= share:
                    proposals.technique[slot] = TECHNIQUE_GUIDE
                    push(proposed, slot, counters)
                    push(smooth, slot, counters)
                    continue
            u = draw(seed, pixel, sample, depth, PURPOSE_BSDF)
            uv = wp.vec2(0.0)
            if wp.static(uvs):
                uv = surfaces.uv[slot]
            bsdf = sample_bsdf(
                materials,
                textures,
                surfaces.material[slot],
                uv,
                frame_at(surfaces, slot),
                -paths.direction[slot],
                wp.vec3(u[0], u[1], u[2]),
            )
            proposals.technique[slot] = TECHNIQUE_BSDF
            proposals.wi[slot] = wp.normalize(bsdf.wi)
            proposals.weight[slot] = bsdf.weight
            proposals.bsdf_pdf[slot] = bsdf.pdf
            if wp.static(transmission):
                proposals.eta[slot] = bsdf.eta
            if share < 1.0 and bsdf.pdf > 0.0:
                push(smooth, slot, counters)

    return propose_directions
