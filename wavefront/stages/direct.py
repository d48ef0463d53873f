"""Direct light: proposes a light sample per vertex, evaluates the BSDF there, and queues a shadow ray."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.accel.mesh_query import INFINITE, Geometry
from wavefront.bsdf.dispatch import is_smooth, make_bsdf
from wavefront.bsdf.frame import make_frame
from wavefront.bsdf.tables import MaterialTables
from wavefront.light.mis import power_heuristic
from wavefront.light.sampling import make_light_sampler
from wavefront.light.tables import DELTA, LightTables
from wavefront.medium import medium_towards, transmittance
from wavefront.queues import (
    DEPTH,
    NONFINITE_DIRECT,
    Paths,
    Queue,
    ShadowRays,
    Surfaces,
    push,
    queue_size,
)
from wavefront.rng import PURPOSE_LIGHT
from wavefront.sampler import SAMPLERS
from wavefront.surface import spawn_origin
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
):
    """Kernel of the stage; the arguments are the fields of `Features` of the same name."""
    eval_bsdf, _, _ = make_bsdf(bsdfs, mask, textures, tangents, bool(maps))
    frame_at, _ = make_frame(tangents, bool(maps))
    sample_light, _ = make_light_sampler(lights, light_textures)
    draw = SAMPLERS[sampler]
    extended = any(kind not in DELTA for kind in lights)

    @wp.kernel(enable_backward=False, module="unique")
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
        counters: wp.array[wp.int32],
    ):
        i = wp.tid()
        if i >= queue_size(hits):
            return
        slot = hits.slots[i]
        material = surfaces.material[slot]
        frame = frame_at(surfaces, slot)
        wo = -paths.direction[slot]
        if not is_smooth(materials.materials[material], wp.dot(frame.normal, wo)):
            return

        # propose
        u = draw(seed, paths.pixel[slot], paths.sample[slot], counters[DEPTH], PURPOSE_LIGHT)
        position = surfaces.position[slot]
        light = sample_light(lights, geometry, textures, position, u)
        if light.L[0] + light.L[1] + light.L[2] == 0.0:
            return

        # evaluate
        uv = wp.vec2(0.0)
        if wp.static(uvs):
            uv = surfaces.uv[slot]
        bsdf = eval_bsdf(materials, textures, material, uv, frame, wo, light.wi)
        if bsdf.value[0] + bsdf.value[1] + bsdf.value[2] == 0.0:
            return

        # resolve
        weight = 1.0 / light.pdf
        if wp.static(extended):
            if light.delta == 0:
                weight *= power_heuristic(light.pdf, bsdf.pdf)
        L = weight * wp.cw_mul(paths.beta[slot], wp.cw_mul(bsdf.value, light.L))
        if not (wp.isfinite(L) and wp.min(L) >= 0.0):
            wp.atomic_add(counters, NONFINITE_DIRECT, 1)
            return
        origin = spawn_origin(position, surfaces.geometric_normal[slot], surfaces.offset[slot], light.wi)
        if wp.static(media):
            medium = medium_towards(surfaces.media[slot], surfaces.geometric_normal[slot], light.wi)
            distance = wp.where(light.t_max < INFINITE, wp.length(light.target - position), INFINITE)
            L = wp.cw_mul(L, transmittance(geometry.sigma_a[medium], distance))
            if wp.max(L) == 0.0:
                return
        shadow_rays.origin[slot] = origin
        shadow_rays.direction[slot] = wp.where(light.t_max < INFINITE, light.target - origin, light.wi)
        shadow_rays.t_max[slot] = light.t_max
        shadow_rays.L[slot] = L
        push(shadow, slot, counters)

    return sample_direct_light
