"""Escaped rays: adds the radiance of what lies around the scene, weighted against light sampling."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.light.envmap import envmap_storage, make_envmap
from wavefront.light.mis import power_heuristic
from wavefront.light.sun import in_sun
from wavefront.light.tables import LightTables
from wavefront.queues import NONFINITE_ESCAPED, Counters, Paths, Queue, queue_end, slot_at
from wavefront.stage_kernel import stage_kernel
from wavefront.stages.contribution import add_radiance
from wavefront.warp_samples import cone_pdf, sphere_pdf


@functools.cache
def make_escaped(escape_lights: tuple[str, ...], light_sampling: bool):
    """Kernel of the stage; the arguments are the properties of `Features` of the same name."""
    has_constant = "constant" in escape_lights
    has_sun = "sun" in escape_lights
    storage = envmap_storage(escape_lights)
    has_envmap = storage is not None
    eval_envmap, _ = make_envmap(storage, density=light_sampling)

    @stage_kernel
    def add_environment(
        lights: LightTables,
        paths: Paths,
        escaped: Queue,
        # out
        counters: Counters,
    ):
        for i in range(wp.tid(), queue_end(escaped, wp.tid())):
            slot = slot_at(escaped, i)
            L = wp.vec3(0.0)
            if wp.static(has_constant):
                light = lights.lights[lights.environment]
                weight = float(1.0)
                if wp.static(light_sampling):
                    if paths.pdf[slot] > 0.0:
                        weight = power_heuristic(paths.pdf[slot], light.pmf * sphere_pdf())
                L += weight * lights.emitters[light.emitter].radiance
            if wp.static(has_envmap):
                found = eval_envmap(lights.envmap, paths.direction[slot])
                weight = float(1.0)
                if wp.static(light_sampling):
                    if paths.pdf[slot] > 0.0:
                        weight = power_heuristic(paths.pdf[slot], lights.lights[lights.environment].pmf * found.pdf)
                L += weight * found.L
            if wp.static(has_sun):
                for k in range(lights.sun_count):
                    light = lights.lights[lights.first_sun + k]
                    sun = lights.distant[light.emitter]
                    if in_sun(sun, paths.direction[slot]):
                        weight = float(1.0)
                        if wp.static(light_sampling):
                            if paths.pdf[slot] > 0.0:
                                weight = power_heuristic(paths.pdf[slot], light.pmf * cone_pdf(sun.one_minus_cos))
                        L += weight * sun.emitted
            add_radiance(paths, slot, wp.cw_mul(paths.beta[slot], L), counters, NONFINITE_ESCAPED)

    return add_environment
