"""Evaluates the BSDF in the directions that the guide proposes."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.boundary import make_crossed_eta
from wavefront.bsdf.dispatch import make_bsdf
from wavefront.bsdf.frame import make_frame
from wavefront.bsdf.tables import MaterialTables
from wavefront.proposals import Proposals
from wavefront.queues import NONFINITE_SCATTER, Counters, Paths, Queue, Surfaces, queue_end, slot_at
from wavefront.stage_kernel import stage_kernel
from wavefront.texture import TextureTables

UNIT_TOLERANCE = wp.constant(1.0e-3)  # of the squared length of a proposed direction


@functools.cache
def make_guided_evaluate(
    bsdfs: tuple[str, ...],
    mask: bool,
    textures: tuple[str, ...],
    uvs: bool,
    tangents: bool,
    maps: tuple[str, ...],
    transmission: bool,
):
    """Kernel of the stage; the arguments are the fields of `Features` of the same name."""
    eval_bsdf, _, _ = make_bsdf(bsdfs, mask, textures, tangents, bool(maps))
    frame_at, _ = make_frame(tangents, bool(maps))
    crossed_eta = make_crossed_eta(bsdfs)

    @stage_kernel
    def evaluate_directions(
        materials: MaterialTables,
        textures: TextureTables,
        paths: Paths,
        surfaces: Surfaces,
        proposed: Queue,
        # in and out
        proposals: Proposals,
        # out
        counters: Counters,
    ):
        for i in range(wp.tid(), queue_end(proposed, wp.tid())):
            slot = slot_at(proposed, i)
            wi = proposals.wi[slot]
            length2 = wp.length_sq(wi)
            weight = wp.vec3(0.0)
            pdf = float(0.0)
            eta = float(1.0)
            if wp.abs(length2 - 1.0) <= UNIT_TOLERANCE:
                wi = wp.normalize(wi)
                proposals.wi[slot] = wi
                material = surfaces.material[slot]
                uv = wp.vec2(0.0)
                if wp.static(uvs):
                    uv = surfaces.uv[slot]
                frame = frame_at(surfaces, slot)
                wo = -paths.direction[slot]
                bsdf = eval_bsdf(materials, textures, material, uv, frame, wo, wi)
                weight = bsdf.value
                pdf = bsdf.pdf
                if wp.static(transmission):
                    eta = crossed_eta(materials, material, frame, wo, wi)
            elif length2 != 0.0:  # NaN, or no unit vector
                wp.atomic_add(counters.values, NONFINITE_SCATTER, 1)
            proposals.weight[slot] = weight
            proposals.bsdf_pdf[slot] = pdf
            if wp.static(transmission):
                proposals.eta[slot] = eta

    return evaluate_directions
