"""Intersection of rays with a scene: the one interface that stages see.

With instances there are two levels: a hierarchy of their boxes, and below it the triangles and spheres of a group.
"""

# Annotations are evaluated at once, for the type of a hit depends on whether there are instances.
import functools
from typing import NamedTuple

import warp as wp

from wavefront.accel.bvh import NODE_VECTORS
from wavefront.accel.collapse import EMPTY, WIDTH
from wavefront.accel.geometry import INFINITE, Geometry, hit_type
from wavefront.accel.instance import point_to_local
from wavefront.accel.spheres import any_sphere, closest_sphere
from wavefront.accel.traverse import Distances, Links, TriangleHit, box_distances, slopes, trace_triangles

ACCELS = ("bvh", "mesh")  # how they are found: our hierarchy, or queries of `wp.Mesh`


class Intersector(NamedTuple):
    """Functions that trace rays; `direction` is of unit length for hits, of any length for occlusion.

    Attributes:
        closest_hit: `(geometry, origin, direction) -> hit_type(instances)`.
        occluded: `(geometry, origin, direction, t_max) -> bool`.
        closest_other: `(geometry, origin, direction, hit)`: the nearer of `hit` and what is met besides the scene's own
            triangles, which have been traced before.
        occluded_by_other: As `occluded`, the scene's own triangles apart.
    """

    closest_hit: wp.Function
    occluded: wp.Function
    closest_other: wp.Function
    occluded_by_other: wp.Function


@functools.cache
def make_triangle_queries(accel: str):
    """Functions of the triangles of a scene or of a group.

    Args:
        accel: One of `ACCELS`.

    Returns:
        `closest(geometry, mesh, root, first_triangle, origin, direction, t_max) -> TriangleHit` and
        `any_before(geometry, mesh, root, origin, direction, t_max) -> bool`; of `mesh` and `root` one counts.
    """
    if accel == "bvh":

        @wp.func
        def closest(
            geometry: Geometry,
            mesh: wp.uint64,
            root: int,
            first_triangle: int,
            origin: wp.vec3,
            direction: wp.vec3,
            t_max: float,
        ) -> TriangleHit:
            return trace_triangles(geometry.bvh, root, origin, direction, t_max, False)

        @wp.func
        def any_before(
            geometry: Geometry, mesh: wp.uint64, root: int, origin: wp.vec3, direction: wp.vec3, t_max: float
        ) -> bool:
            return trace_triangles(geometry.bvh, root, origin, direction, t_max, True).primitive >= 0

    else:

        @wp.func
        def closest(
            geometry: Geometry,
            mesh: wp.uint64,
            root: int,
            first_triangle: int,
            origin: wp.vec3,
            direction: wp.vec3,
            t_max: float,
        ) -> TriangleHit:
            hit = TriangleHit()
            hit.t = t_max
            hit.primitive = -1
            query = wp.mesh_query_ray(mesh, origin, direction, t_max)
            if query.result and query.t < t_max:
                hit.t = query.t
                hit.primitive = first_triangle + query.face
                hit.u = query.u
                hit.v = query.v
            return hit

        @wp.func
        def any_before(
            geometry: Geometry, mesh: wp.uint64, root: int, origin: wp.vec3, direction: wp.vec3, t_max: float
        ) -> bool:
            return wp.mesh_query_ray_anyhit(mesh, origin, direction, t_max)

    return closest, any_before


@functools.cache
def make_intersector(
    triangles: bool, spheres: bool, instances: tuple[str, ...] = (), accel: str = "bvh"
) -> Intersector:
    """Functions that trace rays against the kinds of primitive in a scene.

    Args:
        triangles: The scene itself has triangles.
        spheres: The scene itself has spheres.
        instances: Kinds of primitive, ``triangles`` and ``spheres``, in the groups of which there are instances.
        accel: How triangles are found, one of `ACCELS`.
    """
    AnyHit = hit_type(instances)
    group_triangles = "triangles" in instances
    group_spheres = "spheres" in instances
    closest_triangle, any_triangle = make_triangle_queries(accel)

    @wp.func
    def closest_in_group(geometry: Geometry, k: int, origin: wp.vec3, direction: wp.vec3, nearest: AnyHit) -> AnyHit:
        hit = nearest
        instance = geometry.instances[k]
        group = geometry.groups[instance.group]
        # The direction keeps its length in the world, so that parameters are those of the world.
        local_origin = point_to_local(instance, origin)
        local_direction = instance.to_local * direction
        if wp.static(group_triangles):
            if group.root >= 0:
                found = closest_triangle(
                    geometry, group.mesh, group.root, group.first_triangle, local_origin, local_direction, hit.t
                )
                if found.primitive >= 0:
                    hit.t = found.t
                    hit.primitive = found.primitive
                    hit.u = found.u
                    hit.v = found.v
                    hit.instance = k
        if wp.static(group_spheres):
            if group.sphere_bvh != wp.uint64(0):
                scale = wp.length(local_direction)
                unit = local_direction / scale
                t_local, sphere = closest_sphere(
                    group.sphere_bvh, geometry.spheres, group.first_sphere, local_origin, unit, hit.t * scale
                )
                if sphere >= 0:
                    hit.t = t_local / scale
                    hit.primitive = geometry.triangle_count + sphere
                    hit.instance = k
        return hit

    @wp.func
    def any_in_group(geometry: Geometry, k: int, origin: wp.vec3, direction: wp.vec3, t_max: float) -> bool:
        instance = geometry.instances[k]
        group = geometry.groups[instance.group]
        local_origin = point_to_local(instance, origin)
        local_direction = instance.to_local * direction
        if wp.static(group_triangles):
            if group.root >= 0:
                if any_triangle(geometry, group.mesh, group.root, local_origin, local_direction, t_max):
                    return True
        if wp.static(group_spheres):
            if group.sphere_bvh != wp.uint64(0):
                return any_sphere(
                    group.sphere_bvh, geometry.spheres, group.first_sphere, local_origin, local_direction, t_max
                )
        return False

    @wp.func
    def closest_other(geometry: Geometry, origin: wp.vec3, direction: wp.vec3, nearest: AnyHit) -> AnyHit:
        hit = nearest
        if wp.static(spheres):
            t, index = closest_sphere(geometry.sphere_bvh, geometry.spheres, 0, origin, direction, hit.t)
            if index >= 0:
                hit.t = t
                hit.primitive = geometry.triangle_count + index
        if wp.static(len(instances) > 0):
            hit.instance = -1
            slope = slopes(direction)
            links = Links()
            distances = Distances()
            size = int(1)
            while size > 0:
                size -= 1
                link = links[size]
                if distances[size] <= hit.t:
                    if link >= 0:
                        entered = box_distances(geometry.instance_bvh, link, origin, slope, hit.t)
                        bottom = size
                        for i in range(WIDTH):
                            if entered[i] <= hit.t:
                                # The nearest so far stays on top.
                                last = wp.max(size - 1, 0)
                                place = wp.where(size > bottom and entered[i] > distances[last], last, size)
                                links[size] = links[place]
                                distances[size] = distances[place]
                                links[place] = geometry.instance_bvh.links[NODE_VECTORS * link + 1 + i // 4][i % 4]
                                distances[place] = entered[i]
                                size += 1
                    elif link != EMPTY:
                        k = geometry.instance_bvh.primitives[~link][0]
                        hit = closest_in_group(geometry, k, origin, direction, hit)
        return hit

    @wp.func
    def occluded_by_other(geometry: Geometry, origin: wp.vec3, direction: wp.vec3, t_max: float) -> bool:
        if wp.static(spheres):
            if any_sphere(geometry.sphere_bvh, geometry.spheres, 0, origin, direction, t_max):
                return True
        if wp.static(len(instances) > 0):
            slope = slopes(direction)
            links = Links()
            size = int(1)
            while size > 0:
                size -= 1
                link = links[size]
                if link >= 0:
                    entered = box_distances(geometry.instance_bvh, link, origin, slope, t_max)
                    for i in range(WIDTH):
                        if entered[i] <= t_max:
                            links[size] = geometry.instance_bvh.links[NODE_VECTORS * link + 1 + i // 4][i % 4]
                            size += 1
                elif link != EMPTY:
                    k = geometry.instance_bvh.primitives[~link][0]
                    if any_in_group(geometry, k, origin, direction, t_max):
                        return True
        return False

    @wp.func
    def closest_hit(geometry: Geometry, origin: wp.vec3, direction: wp.vec3) -> AnyHit:
        hit = AnyHit()
        hit.t = INFINITE
        hit.primitive = -1
        if wp.static(triangles):
            found = closest_triangle(geometry, geometry.mesh, geometry.root, 0, origin, direction, INFINITE)
            hit.t = found.t
            hit.primitive = found.primitive
            hit.u = found.u
            hit.v = found.v
        return closest_other(geometry, origin, direction, hit)

    @wp.func
    def occluded(geometry: Geometry, origin: wp.vec3, direction: wp.vec3, t_max: float) -> bool:
        if wp.static(triangles):
            if any_triangle(geometry, geometry.mesh, geometry.root, origin, direction, t_max):
                return True
        return occluded_by_other(geometry, origin, direction, t_max)

    return Intersector(closest_hit, occluded, closest_other, occluded_by_other)
