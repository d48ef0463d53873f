"""Direct light: proposes a light sample per vertex, evaluates the BSDF there, and queues a shadow ray."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.accel.geometry import Geometry
from wavefront.bsdf.dispatch import is_smooth
from wavefront.bsdf.tables import MaterialTables
from wavefront.finite import is_radiance
from wavefront.light.mis import power_heuristic
from wavefront.light.tables import DELTA, LightTables
from wavefront.queues import (
    DEPTH,
    NONFINITE_DIRECT,
    Counters,
    Paths,
    Queue,
    ShadowRays,
    Surfaces,
    push,
    queue_end,
    slot_at,
)
from wavefront.stage_kernel import stage_kernel
from wavefront.stages.ahead import make_fetch_textures
from wavefront.stages.light_proposal import make_light_proposal
from wavefront.texture import TextureTables


@functools.cache
def make_direct(
    bsdfs: tuple[str, ...],
    mask: bool,
    textures: tuple[str, ...],
    lights: tuple[str, ...],
    light_textures: tuple[str, ...],
    uvs: bool,
    tangents: bool,
    maps: tuple[str, ...],
    media: bool = False,
    sampler: str = "independent",
    ahead: bool = False,
):
    """Kernel of the stage; the arguments are the fields of `Features` of the same name."""
    propose_light, aim_shadow_ray = make_light_proposal(
        bsdfs, mask, textures, lights, light_textures, uvs, tangents, maps, media, sampler
    )
    extended = any(kind not in DELTA for kind in lights)

    fetch_textures = make_fetch_textures(textures, uvs, ahead)

    @stage_kernel
    def sample_direct_light(
        geometry: Geometry,
        materials: MaterialTables,
        textures: TextureTables,
        lights: LightTables,
        paths: Paths,
        surfaces: Surfaces,
        hits: Queue,
        seed: wp.uint64,
        # out
        shadow_rays: ShadowRays,
        shadow: Queue,
        counters: Counters,
    ):
        for i in range(wp.tid(), queue_end(hits, wp.tid())):
            fetch_textures(materials, textures, surfaces, hits, i)
            slot = slot_at(hits, i)
            cos_o = -wp.dot(surfaces.shading_normal[slot], paths.direction[slot])
            if not is_smooth(materials.materials[surfaces.material[slot]], cos_o):
                continue

            # propose and evaluate
            proposal = propose_light(
                geometry, materials, textures, lights, paths, surfaces, slot, seed, counters.values[DEPTH]
            )
            light = proposal.light
            bsdf = proposal.bsdf
            if bsdf.value[0] + bsdf.value[1] + bsdf.value[2] == 0.0:
                continue

            # resolve
            weight = 1.0 / light.pdf
            if wp.static(extended):
                if light.delta == 0:
                    weight *= power_heuristic(light.pdf, bsdf.pdf)
            L = weight * wp.cw_mul(paths.beta[slot], wp.cw_mul(bsdf.value, light.L))
            if not is_radiance(L):
                wp.atomic_add(counters.values, NONFINITE_DIRECT, 1)
                continue
            if aim_shadow_ray(geometry, surfaces, slot, light, L, shadow_rays):
                push(shadow, slot, counters)

    return sample_direct_light
