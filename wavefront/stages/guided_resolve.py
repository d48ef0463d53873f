"""Resolve: makes the proposals of a guided bounce into the next direction, its weight and its density, updates the
throughput, plays Russian roulette and queues the next ray."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.finite import is_finite, is_finite3, is_radiance
from wavefront.medium import medium_towards
from wavefront.proposals import TECHNIQUE_GUIDE, Proposals, make_bsdf_share, make_scatter_pdf
from wavefront.queues import DEPTH, NONFINITE_SCATTER, Counters, Paths, Queue, Surfaces, push, queue_end, slot_at
from wavefront.recording import Rows, record_row
from wavefront.rng import PURPOSE_BSDF
from wavefront.sampler import SAMPLERS
from wavefront.stage_kernel import stage_kernel
from wavefront.stages.scatter import survival_probability
from wavefront.surface import spawn_origin


@functools.cache
def make_guided_resolve(
    transmission: bool,
    roulette: bool,
    media: bool,
    sampler: str,
    mixed_deltas: bool,
    guide_pdf: bool,
    records: tuple[str, ...],
):
    """Kernel of the stage; the arguments are the fields of `Features` of the same name."""
    draw = SAMPLERS[sampler]
    bsdf_share, scatter_pdf = make_bsdf_share(mixed_deltas), make_scatter_pdf(guide_pdf)

    @wp.func
    def record_scattering(
        rows: Rows,
        row: int,
        depth: int,
        surfaces: Surfaces,
        slot: int,
        wo: wp.vec3,
        wi: wp.vec3,
        pdf: float,
        guide_pdf_at: float,
        proposals: Proposals,
        weight: wp.vec3,
        survival: float,
    ):
        if depth >= rows.depth:
            entry = rows.depth * rows.count + row
            rows.through[entry] = wp.cw_mul(rows.through[entry], weight / survival)
            return
        entry = depth * rows.count + row
        rows.scatterings[row] = depth + 1
        rows.pdf[entry] = pdf
        rows.weight[entry] = weight
        rows.survival[entry] = survival
        if wp.static("position" in records):
            rows.position[entry] = surfaces.position[slot]
        if wp.static("normal" in records):
            rows.normal[entry] = surfaces.shading_normal[slot]
        if wp.static("wo" in records):
            rows.wo[entry] = wo
        if wp.static("wi" in records):
            rows.wi[entry] = wi
        if wp.static("guide_pdf" in records):
            rows.guide_pdf[entry] = guide_pdf_at
        if wp.static("bsdf_pdf" in records):
            rows.bsdf_pdf[entry] = proposals.bsdf_pdf[slot]
        if wp.static("roughness" in records):
            rows.roughness[entry] = proposals.roughness[slot]
        if wp.static("transmits" in records):
            rows.transmits[entry] = proposals.transmits[slot]

    @stage_kernel
    def resolve_directions(
        proposals: Proposals,
        surfaces: Surfaces,
        hits: Queue,
        rr_depth: int,
        seed: wp.uint64,
        tile: wp.array[wp.int32],
        # in and out
        paths: Paths,
        # out
        rays: Queue,
        rows: Rows,
        counters: Counters,
    ):
        for i in range(wp.tid(), queue_end(hits, wp.tid())):
            slot = slot_at(hits, i)
            depth = counters.values[DEPTH]
            share = bsdf_share(proposals, slot)
            wi = proposals.wi[slot]
            bsdf_pdf = proposals.bsdf_pdf[slot]
            pdf = float(bsdf_pdf)
            guide_pdf_at = float(0.0)
            weight = wp.vec3(proposals.weight[slot])
            if proposals.technique[slot] == TECHNIQUE_GUIDE:
                guide_pdf_at = proposals.guide_pdf[slot]
                if wp.static(guide_pdf):
                    pdf = scatter_pdf(share, bsdf_pdf, guide_pdf_at)
                    # Zero where the guide denies a direction of its own by a rounding.
                    weight = wp.where(pdf > 0.0, weight / pdf, wp.vec3(0.0))
                else:
                    weight = wp.where(bsdf_pdf > 0.0, guide_pdf_at * weight, wp.vec3(0.0))
            elif share < 1.0:
                if bsdf_pdf == 0.0:  # a delta: no other technique finds it
                    weight = weight / share
                elif wp.static(guide_pdf):
                    guide_pdf_at = proposals.guide_pdf[slot]
                    pdf = scatter_pdf(share, bsdf_pdf, guide_pdf_at)
                    weight = (bsdf_pdf / pdf) * weight

            beta = wp.cw_mul(paths.beta[slot], weight)
            finite = is_radiance(beta) and is_finite3(wi) and is_finite(pdf) and is_finite(guide_pdf_at)
            if not (finite and guide_pdf_at >= 0.0):
                wp.atomic_add(counters.values, NONFINITE_SCATTER, 1)
                continue
            if wp.max(beta) == 0.0:
                continue
            eta = float(1.0)
            if wp.static(transmission):
                eta = paths.eta[slot] * proposals.eta[slot]
                paths.eta[slot] = eta
            survival = float(1.0)
            if wp.static(roulette):
                if depth + 1 >= rr_depth:
                    survival = survival_probability(beta, eta)
                    u = draw(seed, paths.pixel[slot], paths.sample[slot], depth, PURPOSE_BSDF)
                    if u[3] >= survival:
                        continue
                    beta /= survival
            if wp.static(bool(records)):
                row = record_row(rows, tile, slot)
                if row >= 0:
                    wo = -paths.direction[slot]
                    record_scattering(
                        rows, row, depth, surfaces, slot, wo, wi, pdf, guide_pdf_at, proposals, weight, survival
                    )
            paths.beta[slot] = beta
            paths.direction[slot] = wi
            paths.pdf[slot] = pdf
            if wp.static(media):
                paths.medium[slot] = medium_towards(surfaces.media[slot], surfaces.geometric_normal[slot], wi)
            paths.origin[slot] = spawn_origin(
                surfaces.position[slot], surfaces.geometric_normal[slot], surfaces.offset[slot], wi
            )
            push(rays, slot, counters)

    return resolve_directions
