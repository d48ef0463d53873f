"""What is proposed at the vertices of a guided bounce, before a direction is chosen; how the techniques combine.

At a vertex there are two techniques for the next direction: the BSDF with some probability, its share, and the guide
with what is left. The direction is one sample of their mixture (Veach 1997, section 9.2.4: one-sample multiple
importance sampling with the balance heuristic).

Delta directions are left to the BSDF. They are all that is seen through a mask, or in a coating, and a guide should not
take their samples. So with d the probability that a BSDF sample is a delta, and s what the guide asks for, the share of
the BSDF is s + (1 - s) d: the guide gets a fraction 1 - s of the samples that would be no deltas. As d depends on
nothing that is sampled at the vertex, the result is unbiased for any d.
"""

from __future__ import annotations

import functools

import warp as wp

MIN_SHARE = wp.constant(0.01)  # of BSDF sampling, whatever a guide asks for: every direction keeps a density
TECHNIQUE_BSDF = wp.constant(0)
TECHNIQUE_GUIDE = wp.constant(1)

# What a guide may ask to know of the surface at a vertex, by type; arrays of `Proposals` that are filled before the
# guide prepares.
INPUTS = {"roughness": wp.float32, "transmits": wp.int32}


@wp.struct
class Proposals:
    """The vertex's proposal for the next direction, one entry per slot."""

    share: wp.array[wp.float32]  # that the guide asks for; 1 where a guide has no say
    roughness: wp.array[wp.float32]  # see `bsdf.roughness`; allocated if the guide asks
    transmits: wp.array[wp.int32]  # 1: light comes from both sides; allocated if the guide asks
    delta: wp.array[wp.float32]  # probability of a delta; allocated if a surface may have those and other directions
    technique: wp.array[wp.int32]
    wi: wp.array[wp.vec3]  # unit length; a guide that has none to offer proposes zero, which ends the path
    weight: wp.array[wp.vec3]  # of the BSDF: its sample's f |cos| / pdf; of the guide: f |cos|
    bsdf_pdf: wp.array[wp.float32]  # at `wi`; 0 if that is a delta direction of the BSDF
    eta: wp.array[wp.float32]  # as `BsdfSample.eta`; allocated if something transmits
    guide_pdf: wp.array[wp.float32]  # at `wi`; of a guide without a density, the weight of its contribution


@wp.struct
class LightProposals:
    """The vertex's light sample, one entry per slot; where it is and what it sends is in `ShadowRays`."""

    wi: wp.array[wp.vec3]
    pdf: wp.array[wp.float32]  # of light sampling
    delta: wp.array[wp.int32]  # 1: a light without extent, which no other technique finds
    bsdf_pdf: wp.array[wp.float32]
    guide_pdf: wp.array[wp.float32]  # allocated if the guide has a density


@functools.cache
def make_bsdf_share(mixed_deltas: bool):
    """`bsdf_share(proposals, slot) -> float`: the probability of sampling the BSDF, from what the guide asks for in
    [MIN_SHARE, 1] (MIN_SHARE for NaN).

    Args:
        mixed_deltas: Property of `Features`.
    """

    @wp.func
    def bsdf_share(proposals: Proposals, slot: int) -> float:
        share = proposals.share[slot]
        if not share >= MIN_SHARE:
            share = MIN_SHARE
        share = wp.min(share, 1.0)
        if wp.static(mixed_deltas):
            share += (1.0 - share) * proposals.delta[slot]
        return share

    return bsdf_share


@functools.cache
def make_scatter_pdf(guide_pdf: bool):
    """`scatter_pdf(share, bsdf_pdf, guide_pdf) -> float`: the density with which a direction that is not a delta is
    chosen, or what stands for it.

    A guide without a density cannot say with what density the next direction comes. Both of its techniques are then
    unbiased by themselves, as the protocol demands of the guide, and so is their mixture:
        share E[(f h / p)(wi of the BSDF)] + (1 - share) E[W (f h)(wi of the guide)] = integral of f h
    for any function h of the direction, if f is 0 where p, the density of BSDF sampling, is. Light sampling combines
    with that for any weights that sum to one at every direction, known or not known to be good: with
    w = q^2 / (q^2 + p^2) for the light sample (q its density), and h = (1 - w) L for the emission that the next
    direction finds, the sum of both expectations is the integral of f w L + f (1 - w) L. So p stands for the density
    of the mixture in both weights. It is the right one where the guide does as the BSDF does, and nowhere does it
    change the expectation.
    """

    @wp.func
    def scatter_pdf(share: float, bsdf_pdf: float, guide_pdf_at: float) -> float:
        if wp.static(guide_pdf):
            if share < 1.0:
                return share * bsdf_pdf + (1.0 - share) * guide_pdf_at
        return bsdf_pdf

    return scatter_pdf
