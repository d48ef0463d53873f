"""Intersection of rays with a scene: the one interface that stages see.

With instances there are two levels: a hierarchy of their boxes, and below it the triangles and spheres of a group. Of
equal distances the scene's own primitives come first, then those of the instance of the lowest number, and of these the
one of the lowest number.
"""

# Annotations are evaluated at once, for the type of a hit depends on whether there are instances.
import functools
from typing import NamedTuple

import warp as wp

from wavefront.accel.geometry import INFINITE, Geometry, Hit, InstanceHit, hit_type
from wavefront.accel.instance import Group, point_to_local
from wavefront.accel.spheres import trace_spheres
from wavefront.accel.traverse import Ray, make_ray, make_traversal, trace_triangles

ACCELS = ("bvh", "mesh")  # how triangles are found: our hierarchy, or queries of `wp.Mesh`
LARGEST = wp.constant(2147483647)


class Intersector(NamedTuple):
    """Functions that trace rays; `direction` is of any length.

    Attributes:
        closest_hit: `(geometry, origin, direction) -> hit_type(instances)`.
        occluded: `(geometry, origin, direction, t_max) -> bool`.
    """

    closest_hit: wp.Function
    occluded: wp.Function


@wp.func
def query_mesh(group: Group, ray: Ray, nearest: Hit, any_will_do: bool) -> Hit:
    """`trace_triangles` by `wp.Mesh`, which chooses among equal distances itself."""
    hit = nearest
    if any_will_do:
        if wp.mesh_query_ray_anyhit(group.mesh, ray.origin, ray.direction, hit.t):
            hit.primitive = group.first_triangle
    else:
        query = wp.mesh_query_ray(group.mesh, ray.origin, ray.direction, hit.t)
        primitive = group.first_triangle + query.face
        if query.result and (query.t < hit.t or (query.t == hit.t and primitive < hit.primitive)):
            hit.t = query.t
            hit.primitive = primitive
            hit.u = query.u
            hit.v = query.v
    return hit


@functools.cache
def make_group_tracer(triangles: bool, spheres: bool, accel: str):
    """`(geometry, group, ray, nearest, any_will_do) -> Hit` in the space of a group: the first of its primitives and of
    `nearest`; or any, if `nearest` is none.

    Args:
        triangles, spheres: Whether a group may have some.
        accel: One of `ACCELS`.
    """

    @wp.func
    def trace_group(geometry: Geometry, group: Group, ray: Ray, nearest: Hit, any_will_do: bool) -> Hit:
        hit = nearest
        if wp.static(triangles):
            if group.root >= 0:
                if wp.static(accel == "bvh"):
                    hit = trace_triangles(geometry, group.root, ray, hit, any_will_do)
                else:
                    hit = query_mesh(group, ray, hit, any_will_do)
        if wp.static(spheres):
            if group.sphere_root >= 0 and not (any_will_do and hit.primitive >= 0):
                hit = trace_spheres(geometry, group.sphere_root, ray, hit, any_will_do)
        return hit

    return trace_group


@functools.cache
def make_instance_tracer(triangles: bool, spheres: bool, accel: str):
    """`(geometry, root, ray, nearest, any_will_do) -> InstanceHit`, as `make_group_tracer`, below a node of instances.

    The arguments say what is in groups.
    """
    trace_group = make_group_tracer(triangles, spheres, accel)

    @wp.func
    def visit_instance(geometry: Geometry, link: int, ray: Ray, nearest: InstanceHit, any_will_do: bool) -> InstanceHit:
        hit = nearest
        index = ~link
        instance = geometry.instances[index]
        # The direction keeps its length in the world, so that parameters are those of the world.
        local = make_ray(point_to_local(instance, ray.origin), instance.to_local * ray.direction)
        met = Hit()
        met.t = nearest.t
        # Whether all primitives of this instance come before what was met at the same distance, or none.
        before = wp.where(index < nearest.instance, LARGEST, -1)
        met.primitive = before
        met = trace_group(geometry, geometry.groups[instance.group], local, met, any_will_do)
        if met.primitive != before:
            hit.t = met.t
            hit.primitive = met.primitive
            hit.u = met.u
            hit.v = met.v
            hit.instance = index
        return hit

    return make_traversal(visit_instance, InstanceHit)


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
    trace_own = make_group_tracer(triangles, spheres, accel)
    trace_instances = make_instance_tracer("triangles" in instances, "spheres" in instances, accel)

    @wp.func
    def trace(geometry: Geometry, origin: wp.vec3, direction: wp.vec3, t_max: float, any_will_do: bool) -> AnyHit:
        ray = make_ray(origin, direction)
        own = Hit()
        own.t = t_max
        own.primitive = -1
        own = trace_own(geometry, geometry.own, ray, own, any_will_do)
        hit = AnyHit()
        hit.t = own.t
        hit.primitive = own.primitive
        hit.u = own.u
        hit.v = own.v
        if wp.static(len(instances) > 0):
            hit.instance = -1
            if not (any_will_do and hit.primitive >= 0):
                hit = trace_instances(geometry, geometry.instance_root, ray, hit, any_will_do)
        return hit

    @wp.func
    def closest_hit(geometry: Geometry, origin: wp.vec3, direction: wp.vec3) -> AnyHit:
        return trace(geometry, origin, direction, INFINITE, False)

    @wp.func
    def occluded(geometry: Geometry, origin: wp.vec3, direction: wp.vec3, t_max: float) -> bool:
        return trace(geometry, origin, direction, t_max, True).primitive >= 0

    return Intersector(closest_hit, occluded)
