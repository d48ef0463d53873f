"""Shadow rays: adds a light sample to its path if nothing is in between."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.accel.mesh_query import Geometry, make_intersector
from wavefront.queues import Paths, Queue, ShadowRays, queue_size


@functools.cache
def make_shadow(triangles: bool, spheres: bool, instances: tuple[str, ...] = ()):
    """Kernel of the stage; the arguments are the fields of `Features` of the same name."""
    _, occluded = make_intersector(triangles, spheres, instances)

    @wp.kernel(enable_backward=False, module="unique")
    def trace_shadow_rays(
        geometry: Geometry,
        shadow_rays: ShadowRays,
        shadow: Queue,
        # out
        paths: Paths,
    ):
        i = wp.tid()
        if i >= queue_size(shadow):
            return
        slot = shadow.slots[i]
        if not occluded(geometry, shadow_rays.origin[slot], shadow_rays.direction[slot], shadow_rays.t_max[slot]):
            paths.L[slot] += shadow_rays.L[slot]

    return trace_shadow_rays
