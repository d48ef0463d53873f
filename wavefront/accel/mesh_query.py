"""Intersection of rays with the scene: triangles through `wp.Mesh`, exact spheres through `wp.Bvh`.

The one interface that the stages see is `make_intersector`: `closest_hit` and `occluded`. A hit names a primitive:
triangles come first, spheres after them; of each, those of the scene itself first, then those of its groups. With
instances there are two levels: a `wp.Bvh` of their boxes, and below it the triangles and spheres of a group.
"""

# Annotations are evaluated at once, for the type of a hit depends on whether there are instances.
import functools

import warp as wp

from wavefront.accel.instance import Group, Instance, point_to_local

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
    index: wp.int32  # place in the scene's list of shapes
    exterior: wp.int32  # medium in front; -1: the shape bounds no medium
    interior: wp.int32  # medium behind


@wp.struct
class Geometry:
    mesh: wp.uint64
    sphere_bvh: wp.uint64
    triangle_count: wp.int32
    points: wp.array[wp.vec3]
    indices: wp.array[wp.int32]
    normals: wp.array[wp.vec3]  # per vertex; empty if no mesh has any
    uvs: wp.array[wp.vec2]  # per vertex; empty if nothing reads UVs or needs a tangent
    spheres: wp.array[wp.vec4]  # centre and radius
    sphere_to_local: wp.array[wp.mat33]  # world normals to the sphere's own axes; empty as `uvs`
    shape_of: wp.array[wp.int32]  # shape of each primitive
    shapes: wp.array[Shape]
    instance_bvh: wp.uint64
    instances: wp.array[Instance]  # empty if there are none
    groups: wp.array[Group]
    sigma_a: wp.array[wp.vec3]  # of each medium, 1/m; the first is vacuum; empty if none absorbs
    camera_medium: wp.int32


@wp.struct
class Hit:
    t: wp.float32
    primitive: wp.int32  # -1: none
    u: wp.float32  # weights of the triangle's first and second vertex
    v: wp.float32


@wp.struct
class InstanceHit:
    """A hit in a scene with instances."""

    t: wp.float32
    primitive: wp.int32
    u: wp.float32
    v: wp.float32
    instance: wp.int32  # -1: the primitive is the scene's own


def hit_type(instances: tuple[str, ...]):
    """The struct of a hit."""
    return InstanceHit if instances else Hit


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


@wp.func
def closest_sphere(
    bvh: wp.uint64, spheres: wp.array[wp.vec4], first: int, origin: wp.vec3, unit: wp.vec3, t_max: float
):
    """Parameter and index (-1: none) of the first sphere of a hierarchy that a ray of unit direction meets."""
    t_hit = float(t_max)
    found = int(-1)
    candidates = wp.bvh_query_ray(bvh, origin, unit)
    index = int(0)
    while wp.bvh_query_next(candidates, index, t_hit):
        t = intersect_sphere(origin, unit, spheres[first + index])
        t_near = wp.where(t[0] > 0.0, t[0], t[1])
        if t_near > 0.0 and t_near < t_hit:
            t_hit = t_near
            found = first + index
    return t_hit, found


@wp.func
def any_sphere(
    bvh: wp.uint64, spheres: wp.array[wp.vec4], first: int, origin: wp.vec3, direction: wp.vec3, t_max: float
) -> bool:
    length = wp.length(direction)
    unit = direction / length
    candidates = wp.bvh_query_ray(bvh, origin, unit)
    index = int(0)
    found = bool(False)
    while wp.bvh_query_next(candidates, index, t_max * length):
        t = intersect_sphere(origin, unit, spheres[first + index])
        t_near = wp.where(t[0] > 0.0, t[0], t[1])
        if t_near > 0.0 and t_near < t_max * length:
            found = True
            break
    return found


@functools.cache
def make_intersector(triangles: bool, spheres: bool, instances: tuple[str, ...] = ()):
    """Functions that trace rays against the kinds of primitive in a scene.

    Args:
        triangles: The scene itself has triangles.
        spheres: The scene itself has spheres.
        instances: Kinds of primitive, ``triangles`` and ``spheres``, in the groups of which there are instances.

    Returns:
        `closest_hit(geometry, origin, direction) -> hit_type(instances)` for a unit direction, and
        `occluded(geometry, origin, direction, t_max) -> bool` for a direction of any length.
    """
    AnyHit = hit_type(instances)
    group_triangles = "triangles" in instances
    group_spheres = "spheres" in instances

    @wp.func
    def closest_hit(geometry: Geometry, origin: wp.vec3, direction: wp.vec3) -> AnyHit:
        hit = AnyHit()
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
            t, index = closest_sphere(geometry.sphere_bvh, geometry.spheres, 0, origin, direction, hit.t)
            if index >= 0:
                hit.t = t
                hit.primitive = geometry.triangle_count + index
        if wp.static(len(instances) > 0):
            hit.instance = -1
            boxes = wp.bvh_query_ray(geometry.instance_bvh, origin, direction)
            k = int(0)
            while wp.bvh_query_next(boxes, k, hit.t):
                instance = geometry.instances[k]
                group = geometry.groups[instance.group]
                # The direction keeps its length in the world, so that parameters are those of the world.
                local_origin = point_to_local(instance, origin)
                local_direction = instance.to_local * direction
                if wp.static(group_triangles):
                    if group.mesh != wp.uint64(0):
                        found = wp.mesh_query_ray(group.mesh, local_origin, local_direction, hit.t)
                        if found.result and found.t < hit.t:
                            hit.t = found.t
                            hit.primitive = group.first_triangle + found.face
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
    def occluded(geometry: Geometry, origin: wp.vec3, direction: wp.vec3, t_max: float) -> bool:
        if wp.static(triangles):
            if wp.mesh_query_ray_anyhit(geometry.mesh, origin, direction, t_max):
                return True
        if wp.static(spheres):
            if any_sphere(geometry.sphere_bvh, geometry.spheres, 0, origin, direction, t_max):
                return True
        if wp.static(len(instances) > 0):
            boxes = wp.bvh_query_ray(geometry.instance_bvh, origin, direction)
            k = int(0)
            while wp.bvh_query_next(boxes, k, t_max):
                instance = geometry.instances[k]
                group = geometry.groups[instance.group]
                local_origin = point_to_local(instance, origin)
                local_direction = instance.to_local * direction
                if wp.static(group_triangles):
                    if group.mesh != wp.uint64(0):
                        if wp.mesh_query_ray_anyhit(group.mesh, local_origin, local_direction, t_max):
                            return True
                if wp.static(group_spheres):
                    if group.sphere_bvh != wp.uint64(0):
                        if any_sphere(
                            group.sphere_bvh, geometry.spheres, group.first_sphere, local_origin, local_direction, t_max
                        ):
                            return True
        return False

    return closest_hit, occluded
