"""Exact spheres, found by a hierarchy of their boxes."""

import numpy as np
import warp as wp

from wavefront.accel.geometry import Geometry, Hit
from wavefront.accel.traverse import Ray, make_traversal


def sphere_boxes(spheres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corners, [N, 3], of spheres, [N, 4]; grown by some roundings, so that they never cut a sphere."""
    grown = spheres[:, 3:] + 1e-6 * (np.abs(spheres[:, :3]).max(axis=1, keepdims=True) + spheres[:, 3:])
    return spheres[:, :3] - grown, spheres[:, :3] + grown


@wp.func
def intersect_sphere(origin: wp.vec3, direction: wp.vec3, sphere: wp.vec4) -> wp.vec2:
    """Both parameters at which a ray meets a sphere; (-1, -1) if it does not.

    The discriminant is taken from the distance of the centre to the ray, which keeps its digits when the sphere is
    small or far (Haines, Guenther and Akenine-Moeller 2019, Ray Tracing Gems, chapter 7).
    """
    r = sphere[3]
    f = origin - wp.vec3(sphere[0], sphere[1], sphere[2])
    a = wp.dot(direction, direction)
    b = -wp.dot(f, direction)
    nearest = f + (b / a) * direction
    discriminant = r * r - wp.dot(nearest, nearest)
    if discriminant < 0.0:
        return wp.vec2(-1.0, -1.0)
    root = wp.sqrt(a * discriminant)
    c = (wp.length(f) - r) * (wp.length(f) + r)
    q = wp.where(b < 0.0, b - root, b + root)
    if q == 0.0:
        return wp.vec2(0.0, 0.0)
    t0 = c / q
    t1 = q / a
    return wp.vec2(wp.min(t0, t1), wp.max(t0, t1))


@wp.func
def visit_sphere(geometry: Geometry, link: int, ray: Ray, nearest: Hit, any_will_do: bool) -> Hit:
    hit = nearest
    index = ~link
    both = intersect_sphere(ray.origin, ray.direction, geometry.spheres[index])
    t = wp.where(both[0] > 0.0, both[0], both[1])
    primitive = geometry.triangle_count + index
    if t > 0.0 and (t < hit.t or (t == hit.t and primitive < hit.primitive)):
        hit.t = t
        hit.primitive = primitive
        hit.u = 0.0
        hit.v = 0.0
    return hit


trace_spheres = make_traversal(visit_sphere, Hit)
