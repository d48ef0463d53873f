"""Escaped rays: adds the radiance of the environment, weighted against light sampling."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.light.mis import power_heuristic
from wavefront.light.tables import LightTables
from wavefront.queues import NONFINITE_ESCAPED, Paths, Queue, queue_size
from wavefront.stages.contribution import add_radiance
from wavefront.warp_samples import sphere_pdf


@functools.cache
def make_escaped(light_sampling: bool):
    """Kernel of the stage; `light_sampling` is the property of `Features`."""

    @wp.kernel(enable_backward=False, module="unique")
    def add_environment(
        lights: LightTables,
        paths: Paths,
        escaped: Queue,
        # out
        counters: wp.array[wp.int32],
    ):
        i = wp.tid()
        if i >= queue_size(escaped):
            return
        slot = escaped.slots[i]
        light = lights.lights[lights.environment]
        weight = float(1.0)
        if wp.static(light_sampling):
            pdf = paths.pdf[slot]
            if pdf > 0.0:
                weight = power_heuristic(pdf, light.pmf * sphere_pdf())
        L = weight * wp.cw_mul(paths.beta[slot], lights.emitters[light.emitter].radiance)
        add_radiance(paths, slot, L, counters, NONFINITE_ESCAPED)

    return add_environment
