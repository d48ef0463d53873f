"""Closest hit: reads queued rays, writes the vertex they reach and sorts the slots by what has to be done there."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.accel.geometry import INFINITE, Geometry, RayHits, hit_type
from wavefront.accel.intersector import make_intersector
from wavefront.medium import transmittance
from wavefront.queues import DEPTH, Counters, Paths, Queue, Surfaces, push, queue_end, slot_at
from wavefront.stage_kernel import stage_kernel
from wavefront.stages.ahead import make_fetch_triangles
from wavefront.surface import make_vertex


@functools.cache
def make_intersect(
    triangles: bool,
    spheres: bool,
    smooth: bool,
    uvs: bool,
    tangents: bool,
    bumps: bool,
    area_lights: bool,
    escape_lights: bool,
    shape_index: bool = False,
    media: bool = False,
    instances: tuple[str, ...] = (),
    accel: str = "bvh",
    streams: bool = False,
    ahead: bool = False,
):
    """Kernel of the stage; the arguments are the fields of `Features` of the same name (or whether there are any).

    `shape_index`: whether the index of the shape is an AOV.
    """
    closest_hit = make_intersector(triangles, spheres, instances, accel).closest_hit
    AnyHit = hit_type(instances)
    instanced = bool(instances)
    vertex_of = make_vertex(triangles, spheres, smooth, uvs, tangents, bumps, instances)
    fetch_triangles = make_fetch_triangles(smooth, uvs, ahead)

    @stage_kernel
    def closest_hits(
        geometry: Geometry,
        paths: Paths,  # also out, where a medium absorbs
        rays: Queue,
        ray_hits: RayHits,
        max_depth: int,
        # out
        surfaces: Surfaces,
        hits: Queue,
        escaped: Queue,
        emissive: Queue,
        counters: Counters,
    ):
        for i in range(wp.tid(), queue_end(rays, wp.tid())):
            if wp.static(streams):
                fetch_triangles(geometry, ray_hits, rays, i)
            slot = slot_at(rays, i)
            origin = paths.origin[slot]
            direction = paths.direction[slot]
            hit = AnyHit()
            if wp.static(streams):
                hit.t = ray_hits.t[slot]
                hit.primitive = ray_hits.primitive[slot]
                hit.u = ray_hits.uv[slot][0]
                hit.v = ray_hits.uv[slot][1]
                if wp.static(instanced):
                    hit.instance = ray_hits.instance[slot]
            else:
                hit = closest_hit(geometry, origin, direction)
            if wp.static(media):
                medium = geometry.camera_medium
                start = origin
                if counters.values[DEPTH] > 0:
                    medium = paths.medium[slot]
                    start = surfaces.position[
                        slot
                    ]  # the last vertex: the ray starts off it, as far as a sheet may be thick
                sigma_a = geometry.sigma_a[medium]
            if hit.primitive < 0:
                surfaces.material[slot] = -1
                if wp.static(media):
                    paths.beta[slot] = wp.cw_mul(paths.beta[slot], transmittance(sigma_a, INFINITE))
                if wp.static(escape_lights):
                    push(escaped, slot, counters)
                continue
            vertex = vertex_of(geometry, origin, direction, hit)
            shape = geometry.shapes[geometry.shape_of[hit.primitive]]
            surfaces.position[slot] = vertex.position
            surfaces.geometric_normal[slot] = vertex.geometric_normal
            surfaces.shading_normal[slot] = vertex.shading_normal
            surfaces.offset[slot] = vertex.offset
            surfaces.material[slot] = shape.material
            if wp.static(uvs):
                surfaces.uv[slot] = vertex.uv
            if wp.static(tangents):
                surfaces.tangent[slot] = vertex.tangent
            if wp.static(bumps):
                surfaces.uv_jacobian[slot] = vertex.uv_jacobian
            if wp.static(shape_index):
                surfaces.shape[slot] = shape.index
            if wp.static(media):
                sides = wp.vec2i(shape.exterior, shape.interior)
                surfaces.media[slot] = wp.where(shape.exterior < 0, wp.vec2i(medium, medium), sides)
                distance = wp.length(vertex.position - start)
                paths.beta[slot] = wp.cw_mul(paths.beta[slot], transmittance(sigma_a, distance))
            if wp.static(area_lights):
                light = int(-1)
                front = wp.dot(vertex.geometric_normal, direction) < 0.0
                if shape.first_light >= 0 and (front or shape.two_sided == 1):
                    light = shape.first_light + hit.primitive - shape.first_primitive
                    push(emissive, slot, counters)
                surfaces.light[slot] = light
            # At the last vertex of the longest path only its emission counts.
            if counters.values[DEPTH] + 1 < max_depth:
                push(hits, slot, counters)

    return closest_hits
