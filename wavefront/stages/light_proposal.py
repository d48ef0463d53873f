"""A light sample at a vertex with what the BSDF makes of it, and the shadow ray towards it."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.accel.geometry import INFINITE, Geometry
from wavefront.bsdf.dispatch import make_bsdf
from wavefront.bsdf.frame import make_frame
from wavefront.bsdf.record import BsdfEval
from wavefront.bsdf.tables import MaterialTables
from wavefront.light.sampling import LightSample, make_light_sampler
from wavefront.light.tables import LightTables
from wavefront.medium import medium_towards, transmittance
from wavefront.queues import Paths, ShadowRays, Surfaces
from wavefront.rng import PURPOSE_LIGHT
from wavefront.sampler import SAMPLERS
from wavefront.surface import spawn_origin
from wavefront.texture import TextureTables


@wp.struct
class LightProposal:
    light: LightSample
    bsdf: BsdfEval  # in the direction of the light; zero if the sample is of no use


@functools.cache
def make_light_proposal(
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
):
    """Functions of a light sample; the arguments are the fields of `Features` of the same name.

    Returns:
        `propose_light(geometry, materials, textures, lights, paths, surfaces, slot, seed, depth) -> LightProposal`, and
        `aim_shadow_ray(geometry, surfaces, slot, light, L, shadow_rays) -> bool`, which sets the slot's shadow ray with
        what the media on the way leave of `L`, and says whether that is anything.
    """
    eval_bsdf, _, _ = make_bsdf(bsdfs, mask, textures, tangents, bool(maps))
    frame_at, _ = make_frame(tangents, bool(maps))
    sample_light, _ = make_light_sampler(lights, light_textures)
    draw = SAMPLERS[sampler]

    @wp.func
    def propose_light(
        geometry: Geometry,
        materials: MaterialTables,
        textures: TextureTables,
        lights: LightTables,
        paths: Paths,
        surfaces: Surfaces,
        slot: int,
        seed: wp.uint64,
        depth: int,
    ) -> LightProposal:
        result = LightProposal()
        u = draw(seed, paths.pixel[slot], paths.sample[slot], depth, PURPOSE_LIGHT)
        light = sample_light(lights, geometry, textures, surfaces.position[slot], u)
        result.light = light
        if light.L[0] + light.L[1] + light.L[2] != 0.0:
            uv = wp.vec2(0.0)
            if wp.static(uvs):
                uv = surfaces.uv[slot]
            frame = frame_at(surfaces, slot)
            wo = -paths.direction[slot]
            result.bsdf = eval_bsdf(materials, textures, surfaces.material[slot], uv, frame, wo, light.wi)
        return result

    @wp.func
    def aim_shadow_ray(
        geometry: Geometry, surfaces: Surfaces, slot: int, light: LightSample, L: wp.vec3, shadow_rays: ShadowRays
    ) -> bool:
        position = surfaces.position[slot]
        normal = surfaces.geometric_normal[slot]
        origin = spawn_origin(position, normal, surfaces.offset[slot], light.wi)
        arriving = L
        if wp.static(media):
            medium = medium_towards(surfaces.media[slot], normal, light.wi)
            distance = wp.where(light.t_max < INFINITE, wp.length(light.target - position), INFINITE)
            arriving = wp.cw_mul(L, transmittance(geometry.sigma_a[medium], distance))
            if wp.max(arriving) == 0.0:
                return False
        shadow_rays.origin[slot] = origin
        shadow_rays.direction[slot] = wp.where(light.t_max < INFINITE, light.target - origin, light.wi)
        shadow_rays.t_max[slot] = light.t_max
        shadow_rays.L[slot] = arriving
        return True

    return propose_light, aim_shadow_ray
