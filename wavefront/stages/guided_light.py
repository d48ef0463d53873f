"""Direct light of a guided bounce, second part: weights light samples against the mixture, and queues shadow rays."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.finite import is_finite, is_radiance
from wavefront.light.mis import power_heuristic
from wavefront.proposals import LightProposals, Proposals, make_bsdf_share, make_scatter_pdf
from wavefront.queues import NONFINITE_DIRECT, Counters, Paths, Queue, ShadowRays, push, queue_end, slot_at
from wavefront.recording import RecordScratch
from wavefront.stage_kernel import stage_kernel


@functools.cache
def make_guided_light(mixed_deltas: bool, guide_pdf: bool, recorded: bool):
    """Kernel of the stage.

    Args:
        mixed_deltas, guide_pdf: Of `Features`.
        recorded: Whether there are records, which need the light without the throughput.
    """
    bsdf_share, scatter_pdf = make_bsdf_share(mixed_deltas), make_scatter_pdf(guide_pdf)

    @stage_kernel
    def weight_light_samples(
        paths: Paths,
        proposals: Proposals,
        light_proposals: LightProposals,
        lit: Queue,
        # in and out
        shadow_rays: ShadowRays,
        # out
        scratch: RecordScratch,
        shadow: Queue,
        counters: Counters,
    ):
        for i in range(wp.tid(), queue_end(lit, wp.tid())):
            slot = slot_at(lit, i)
            pdf = light_proposals.pdf[slot]
            weight = 1.0 / pdf
            if light_proposals.delta[slot] == 0:
                guide_pdf_at = float(0.0)
                if wp.static(guide_pdf):
                    guide_pdf_at = light_proposals.guide_pdf[slot]
                other = scatter_pdf(bsdf_share(proposals, slot), light_proposals.bsdf_pdf[slot], guide_pdf_at)
                if not (is_finite(other) and other >= 0.0):
                    wp.atomic_add(counters.values, NONFINITE_DIRECT, 1)
                    continue
                weight *= power_heuristic(pdf, other)
            arriving = shadow_rays.L[slot]
            L = weight * wp.cw_mul(paths.beta[slot], arriving)
            if not is_radiance(L):
                wp.atomic_add(counters.values, NONFINITE_DIRECT, 1)
                continue
            if wp.static(recorded):
                scratch.light[slot] = weight * arriving
            shadow_rays.L[slot] = L
            push(shadow, slot, counters)

    return weight_light_samples
