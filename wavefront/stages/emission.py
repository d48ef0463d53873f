"""Emission: adds the radiance of a light that was hit, weighted against light sampling."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.accel.geometry import Geometry
from wavefront.light.mis import power_heuristic
from wavefront.light.sampling import make_light_sampler
from wavefront.light.tables import AREA, LightTables
from wavefront.queues import NONFINITE_EMISSION, Counters, Paths, Queue, Surfaces, queue_end, slot_at
from wavefront.stage_kernel import stage_kernel
from wavefront.stages.contribution import add_radiance
from wavefront.texture import TextureTables, make_eval_parameter


@functools.cache
def make_emission(lights: tuple[str, ...], light_textures: tuple[str, ...], light_sampling: bool):
    """Kernel of the stage; the arguments are the fields of `Features` of the same name."""
    area_lights = tuple(kind for kind in lights if kind in AREA)
    _, light_pdf = make_light_sampler(area_lights, light_textures)
    eval_parameter = make_eval_parameter(light_textures)
    textured = bool(light_textures)

    @stage_kernel
    def add_emission(
        geometry: Geometry,
        lights: LightTables,
        textures: TextureTables,
        paths: Paths,
        surfaces: Surfaces,
        emissive: Queue,
        # out
        counters: Counters,
    ):
        for i in range(wp.tid(), queue_end(emissive, wp.tid())):
            slot = slot_at(emissive, i)
            light = surfaces.light[slot]
            emitter = lights.emitters[lights.lights[light].emitter]
            weight = float(1.0)
            if wp.static(light_sampling):
                pdf = paths.pdf[slot]
                if pdf > 0.0:
                    other = light_pdf(
                        lights,
                        geometry,
                        light,
                        paths.origin[slot],
                        paths.direction[slot],
                        surfaces.position[slot],
                        surfaces.geometric_normal[slot],
                    )
                    weight = power_heuristic(pdf, other)
            uv = wp.vec2(0.0)
            if wp.static(textured):
                uv = surfaces.uv[slot]
            radiance = eval_parameter(textures, emitter.radiance, emitter.radiance_texture, uv)
            add_radiance(paths, slot, weight * wp.cw_mul(paths.beta[slot], radiance), counters, NONFINITE_EMISSION)

    return add_emission
