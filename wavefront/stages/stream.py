"""Queues of rays against the scene's own triangles, on the CPU device: one thread follows many of them at a time."""

from __future__ import annotations

from wavefront.accel.geometry import Geometry
from wavefront.accel.stream import any_triangles, closest_triangles
from wavefront.queues import Paths, Queue, ShadowRays, TriangleHits, queue_size
from wavefront.stage_kernel import stage_kernel


@stage_kernel
def stream_rays(
    geometry: Geometry,
    paths: Paths,
    rays: Queue,
    # out
    hits: TriangleHits,
):
    """A launch of one thread."""
    closest_triangles(
        geometry.bvh,
        geometry.root,
        rays.slots,
        queue_size(rays),
        paths.origin,
        paths.direction,
        hits.primitive,
        hits.t,
        hits.uv,
    )


@stage_kernel
def stream_shadow_rays(
    geometry: Geometry,
    shadow: Queue,
    shadow_rays: ShadowRays,  # also out
):
    """A launch of one thread."""
    any_triangles(
        geometry.bvh,
        geometry.root,
        shadow.slots,
        queue_size(shadow),
        shadow_rays.origin,
        shadow_rays.direction,
        shadow_rays.t_max,
        shadow_rays.blocked,
    )
