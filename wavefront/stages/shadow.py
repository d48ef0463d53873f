"""Shadow rays: adds a light sample to its path if nothing is in between."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.accel.geometry import Geometry
from wavefront.accel.intersector import make_intersector
from wavefront.queues import Paths, Queue, ShadowRays, queue_end, slot_at
from wavefront.stage_kernel import stage_kernel


@functools.cache
def make_shadow(
    triangles: bool,
    spheres: bool,
    instances: tuple[str, ...] = (),
    accel: str = "bvh",
    streams: bool = False,
):
    """Kernel of the stage; the arguments are the fields of `Features` of the same name."""
    occluded = make_intersector(triangles, spheres, instances, accel).occluded

    @stage_kernel
    def trace_shadow_rays(
        geometry: Geometry,
        shadow_rays: ShadowRays,
        shadow: Queue,
        # out
        paths: Paths,
    ):
        for i in range(wp.tid(), queue_end(shadow, wp.tid())):
            slot = slot_at(shadow, i)
            blocked = bool(False)
            if wp.static(streams):
                blocked = shadow_rays.blocked[slot] == 1
            else:
                blocked = occluded(
                    geometry, shadow_rays.origin[slot], shadow_rays.direction[slot], shadow_rays.t_max[slot]
                )
            if not blocked:
                paths.L[slot] += shadow_rays.L[slot]

    return trace_shadow_rays
