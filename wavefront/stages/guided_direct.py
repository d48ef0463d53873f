"""Direct light of a guided bounce, first part: proposes a light sample per vertex and evaluates the BSDF there.

It is weighted by `guided_light`, when the guide has told its density in the direction of the light.
"""

from __future__ import annotations

import functools

import warp as wp

from wavefront.accel.geometry import Geometry
from wavefront.bsdf.tables import MaterialTables
from wavefront.light.tables import LightTables
from wavefront.proposals import LightProposals
from wavefront.queues import DEPTH, Counters, Paths, Queue, ShadowRays, Surfaces, push, queue_end, slot_at
from wavefront.stage_kernel import stage_kernel
from wavefront.stages.ahead import make_fetch_textures
from wavefront.stages.light_proposal import make_light_proposal
from wavefront.texture import TextureTables


@functools.cache
def make_guided_direct(
    bsdfs: tuple[str, ...],
    mask: bool,
    textures: tuple[str, ...],
    lights: tuple[str, ...],
    light_textures: tuple[str, ...],
    uvs: bool,
    tangents: bool,
    maps: tuple[str, ...],
    media: bool,
    sampler: str,
    ahead: bool,
):
    """Kernel of the stage; the arguments are the fields of `Features` of the same name."""
    propose_light, aim_shadow_ray = make_light_proposal(
        bsdfs, mask, textures, lights, light_textures, uvs, tangents, maps, media, sampler
    )
    fetch_textures = make_fetch_textures(textures, uvs, ahead)

    @stage_kernel
    def propose_direct_light(
        geometry: Geometry,
        materials: MaterialTables,
        textures: TextureTables,
        lights: LightTables,
        paths: Paths,
        surfaces: Surfaces,
        guided: Queue,
        seed: wp.uint64,
        # out
        light_proposals: LightProposals,
        shadow_rays: ShadowRays,  # L: f |cos| L, with what media leave of it
        lit: Queue,
        counters: Counters,
    ):
        for i in range(wp.tid(), queue_end(guided, wp.tid())):
            fetch_textures(materials, textures, surfaces, guided, i)
            slot = slot_at(guided, i)
            proposal = propose_light(
                geometry, materials, textures, lights, paths, surfaces, slot, seed, counters.values[DEPTH]
            )
            light = proposal.light
            bsdf = proposal.bsdf
            if bsdf.value[0] + bsdf.value[1] + bsdf.value[2] == 0.0:
                continue
            if aim_shadow_ray(geometry, surfaces, slot, light, wp.cw_mul(bsdf.value, light.L), shadow_rays):
                light_proposals.wi[slot] = light.wi
                light_proposals.pdf[slot] = light.pdf
                light_proposals.delta[slot] = light.delta
                light_proposals.bsdf_pdf[slot] = bsdf.pdf
                push(lit, slot, counters)

    return propose_direct_light
