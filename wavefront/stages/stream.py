"""Queues of rays against the scene, on the CPU device: one thread follows many of them at a time."""

from __future__ import annotations

import functools

from wavefront.accel.geometry import Geometry, RayHits
from wavefront.accel.stream import make_streams
from wavefront.queues import Paths, Queue, ShadowRays, queue_size
from wavefront.stage_kernel import stage_kernel


@functools.cache
def make_stream(triangles: bool, spheres: bool, instances: tuple[str, ...]):
    """Kernel of the stage; the arguments are the fields of `Features` of the same name. A launch of one thread."""
    closest = make_streams(triangles, spheres, instances).closest

    @stage_kernel
    def stream_rays(
        geometry: Geometry,
        paths: Paths,
        rays: Queue,
        # out
        hits: RayHits,
    ):
        closest(geometry, rays.slots, queue_size(rays), paths.origin, paths.direction, hits)

    return stream_rays


@functools.cache
def make_stream_shadow(triangles: bool, spheres: bool, instances: tuple[str, ...]):
    """The same of shadow rays."""
    occluded = make_streams(triangles, spheres, instances).occluded

    @stage_kernel
    def stream_shadow_rays(
        geometry: Geometry,
        shadow: Queue,
        shadow_rays: ShadowRays,  # also out
    ):
        occluded(
            geometry,
            shadow.slots,
            queue_size(shadow),
            shadow_rays.origin,
            shadow_rays.direction,
            shadow_rays.t_max,
            shadow_rays.blocked,
        )

    return stream_shadow_rays
