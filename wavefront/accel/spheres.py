"""Exact spheres: candidates from a `wp.Bvh` of their boxes."""

import warp as wp


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
