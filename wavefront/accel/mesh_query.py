"""Intersection of rays with the scene: triangles through `wp.Mesh`, exact spheres through `wp.Bvh`.

The one interface that the stages see is `make_intersector`: `closest_hit` and `occluded`. A hit names a primitive:
triangles come first, spheres after them.
"""

from __future__ import annotations

import functools

import warp as wp

INFINITE = wp.constant(3.0e38)


@wp.struct
class Shape:
    """What the triangles of one mesh, or one sphere, share."""

    material: wp.int32
    first_light: wp.int32  # light of its first primitive; -1 if it does not emit
    first_primitive: wp.int32
    smooth: wp.int32  # 1: has vertex normals
    flip: wp.int32  # 1: a sphere that faces inwards
    two_sided: wp.int32  # 1: the back emits too
    polar: wp.int32  # 1: u is the distance from the centre of a disk, v the angle


@wp.struct
class Geometry:
    mesh: wp.uint64
    sphere_bvh: wp.uint64
    triangle_count: wp.int32
    points: wp.array[wp.vec3]
    indices: wp.array[wp.int32]
    normals: wp.array[wp.vec3]  # per vertex; empty if no mesh has any
    uvs: wp.array[wp.vec2]  # per vertex; empty if neither a texture nor a tangent needs it
    spheres: wp.array[wp.vec4]  # centre and radius
    sphere_to_local: wp.array[wp.mat33]  # world normals to the sphere's own axes; empty as `uvs`
    shape_of: wp.array[wp.int32]  # shape of each primitive
    shapes: wp.array[Shape]


@wp.struct
class Hit:
    t: wp.float32
    primitive: wp.int32  # -1: none
    u: wp.float32  # weights of the triangle's first and second vertex
    v: wp.float32


@wp.func
def intersect_sphere(origin: wp.vec3, direction: wp.vec3, sphere: wp.vec4) -> wp.vec2:
    """Both parameters at which a ray with a unit direction meets a sphere; (-1, -1) if it does not.

    The discriminant is taken from the distance of the centre to the ray, which keeps its digits when the sphere is
    small or far (Haines, Guenther and Akenine-Moeller 2019, Ray Tracing Gems, chapter 7).
    """
    r = sphere[3]
    f = origin - wp.vec3(sphere[0], sphere[1], sphere[2])
    b = -wp.dot(f, direction)
    nearest = f + b * direction
    discriminant = r * r - wp.dot(nearest, nearest)
    if discriminant < 0.0:
        return wp.vec2(-1.0, -1.0)
    root = wp.sqrt(discriminant)
    c = (wp.length(f) - r) * (wp.length(f) + r)
    q = wp.where(b < 0.0, b - root, b + root)
    if q == 0.0:
        return wp.vec2(0.0, 0.0)
    t0 = c / q
    return wp.vec2(wp.min(t0, q), wp.max(t0, q))


@functools.cache
def make_intersector(triangles: bool, spheres: bool):
    """Functions that trace rays against the kinds of primitive in a scene.

    Returns:
        `closest_hit(geometry, origin, direction) -> Hit` for a unit direction, and
        `occluded(geometry, origin, direction, t_max) -> bool` for a direction of any length.
    """

    @wp.func
    def closest_hit(geometry: Geometry, origin: wp.vec3, direction: wp.vec3) -> Hit:
        hit = Hit()
        hit.t = INFINITE
        hit.primitive = -1
        if wp.static(triangles):
            query = wp.mesh_query_ray(geometry.mesh, origin, direction, INFINITE)
            if query.result:
                hit.t = query.t
                hit.primitive = query.face
                hit.u = query.u
                hit.v = query.v
        if wp.static(spheres):
            candidates = wp.bvh_query_ray(geometry.sphere_bvh, origin, direction)
            index = int(0)
            while wp.bvh_query_next(candidates, index, hit.t):
                t = intersect_sphere(origin, direction, geometry.spheres[index])
                t_near = wp.where(t[0] > 0.0, t[0], t[1])
                if t_near > 0.0 and t_near < hit.t:
                    hit.t = t_near
                    hit.primitive = geometry.triangle_count + index
        return hit

    @wp.func
    def occluded(geometry: Geometry, origin: wp.vec3, direction: wp.vec3, t_max: float) -> bool:
        if wp.static(triangles):
            if wp.mesh_query_ray_anyhit(geometry.mesh, origin, direction, t_max):
                return True
        if wp.static(spheres):
            length = wp.length(direction)
            unit = direction / length
            candidates = wp.bvh_query_ray(geometry.sphere_bvh, origin, unit)
            index = int(0)
            found = bool(False)
            while wp.bvh_query_next(candidates, index, t_max * length):
                t = intersect_sphere(origin, unit, geometry.spheres[index])
                t_near = wp.where(t[0] > 0.0, t[0], t[1])
                if t_near > 0.0 and t_near < t_max * length:
                    found = True
                    break
            return found
        return False

    return closest_hit, occluded
