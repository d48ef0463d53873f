"""From a hit to the vertex of a path: position, normals, UV, and how far a new ray must start from it."""

# Annotations are evaluated at once, for the type of a hit depends on whether there are instances.
import functools

import warp as wp

from wavefront.accel.geometry import Geometry, hit_type
from wavefront.accel.instance import normal_to_world, offset_to_world, point_to_local, point_to_world
from wavefront.finite import is_finite
from wavefront.warp_samples import orthonormal_basis

# Roundings in an interpolated position and in a ray-triangle test, in units of float32's 2^-24: a handful each (Higham
# 2002, section 3.1), doubled to be safe.
POSITION_ERROR = wp.constant(32.0 * 5.9604645e-8)
# The same for a sphere, where fewer roundings meet: a large one, such as a ground, should not lose contact shadows.
SPHERE_ERROR = wp.constant(10.0 * 5.9604645e-8)


@wp.struct
class Vertex:
    position: wp.vec3
    geometric_normal: wp.vec3
    shading_normal: wp.vec3
    offset: wp.float32
    uv: wp.vec2
    tangent: wp.vec3  # s: unit length, orthogonal to the shading normal n, along growing u
    uv_jacobian: wp.vec3  # (a, b, c): in the plane of s and t = n x s, dp/du is a s and dp/dv is b s + c t


@wp.func
def position_error(v0: wp.vec3, v1: wp.vec3, v2: wp.vec3, b0: float, b1: float, normal: wp.vec3) -> float:
    """How far along the normal a ray must start so that it cannot meet its own triangle again, in metres.

    Two errors add. The position b0 v0 + b1 v1 + b2 v2 is off the plane by roundings of its terms. And the ray-triangle
    test finds the plane at a parameter that is off by roundings of the triangle's extent, even where the coordinates
    along the normal are zero: on a floor at y = 0, a ray that leaves mostly along x meets the floor again without
    this part. Both follow the numbers that enter, so the offset is right for a scene of any scale and needs no epsilon
    of the scene (compare Waechter and Binder 2019; Pharr, Jakob and Humphreys 2023, section 6.8).
    """
    b2 = wp.abs(1.0 - b0 - b1)
    magnitude = b0 * wp.abs(v0) + b1 * wp.abs(v1) + b2 * wp.abs(v2)
    return POSITION_ERROR * (wp.dot(magnitude, wp.abs(normal)) + triangle_extent(v0, v1, v2))


@wp.func
def _larger(a: float, b: float) -> float:
    """One instruction on the CPU device, where that of `wp.max` is six for the sake of NaN."""
    return wp.where(a > b, a, b)


@wp.func
def triangle_extent(v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> float:
    """Largest coordinate of the edges from v0."""
    a = wp.abs(v1 - v0)
    b = wp.abs(v2 - v0)
    return _larger(_larger(_larger(a[0], a[1]), _larger(b[0], b[1])), _larger(a[2], b[2]))


@wp.func
def scaled_cross(v0: wp.vec3, v1: wp.vec3, v2: wp.vec3, extent: float) -> wp.vec3:
    """Cross product of the edges from v0, divided by extent^2 so that its square fits a float32 at any scale."""
    scale = 1.0 / extent
    return wp.cross((v1 - v0) * scale, (v2 - v0) * scale)


@wp.func
def spawn_origin(position: wp.vec3, geometric_normal: wp.vec3, offset: float, direction: wp.vec3) -> wp.vec3:
    """Origin of a ray that leaves a surface in `direction`, moved off the surface to the side it leaves to."""
    return position + wp.where(wp.dot(geometric_normal, direction) < 0.0, -offset, offset) * geometric_normal


@wp.func
def sphere_uv(normal: wp.vec3) -> wp.vec2:
    """u: longitude from +X towards +Y, v: colatitude from +Z, both scaled to [0, 1]."""
    u = wp.atan2(normal[1], normal[0]) / wp.static(2.0 * wp.pi)
    return wp.vec2(wp.where(u < 0.0, u + 1.0, u), wp.acos(wp.clamp(normal[2], -1.0, 1.0)) / wp.pi)


@wp.func
def uv_partials(e1: wp.vec3, e2: wp.vec3, d1: wp.vec2, d2: wp.vec2):
    """dp/du and dp/dv of a triangle, both divided by the third result, from the edges e and their differences d of UV.

    Where UVs do not tell them, dp/du is the first edge, as in Mitsuba 3, and dp/dv zero.
    """
    det = d1[0] * d2[1] - d1[1] * d2[0]
    sign = wp.sign(det)
    along_u = sign * (d2[1] * e1 - d1[1] * e2)
    along_v = sign * (d1[0] * e2 - d2[0] * e1)
    if det == 0.0 or not is_finite(det):
        along_u = e1
        along_v = wp.vec3(0.0)
    return along_u, along_v, 1.0 / wp.abs(det)


@wp.func
def tangent_along(normal: wp.vec3, dp_du: wp.vec3) -> wp.vec3:
    """Unit tangent along `dp_du`, or any where that is zero or along the normal."""
    s = dp_du - wp.dot(normal, dp_du) * normal
    length = wp.length(s)
    # What is left of a vector along the normal is rounding.
    if length > 1.0e-5 * wp.length(dp_du):
        return s / length
    s, _t = orthonormal_basis(normal)
    return s


@wp.func
def in_frame(vertex: Vertex, along_u: wp.vec3, along_v: wp.vec3) -> wp.vec3:
    """The three numbers of `Vertex.uv_jacobian`."""
    t = wp.cross(vertex.shading_normal, vertex.tangent)
    return wp.vec3(wp.dot(along_u, vertex.tangent), wp.dot(along_v, vertex.tangent), wp.dot(along_v, t))


@functools.cache
def make_vertex(
    triangles: bool,
    spheres: bool,
    smooth: bool,
    uvs: bool,
    tangents: bool,
    bumps: bool,
    instances: tuple[str, ...] = (),
):
    """`make_vertex(geometry, origin, direction, hit) -> Vertex` for a hit that exists.

    Args:
        triangles: The scene has triangles.
        spheres: The scene has spheres.
        smooth: Some mesh has vertex normals.
        uvs: Something reads UVs.
        tangents: Some BSDF or map depends on the direction of the tangent.
        bumps: There are bump maps, for which dp/du and dp/dv are needed.
        instances: Kinds of primitive in groups, as of `make_intersector`.
    """
    AnyHit = hit_type(instances)
    triangles = triangles or "triangles" in instances
    spheres = spheres or "spheres" in instances
    instanced = bool(instances)

    @wp.func
    def vertex_of(geometry: Geometry, origin: wp.vec3, direction: wp.vec3, hit: AnyHit) -> Vertex:
        vertex = Vertex()
        if wp.static(triangles):
            if hit.primitive < geometry.triangle_count:
                i0 = geometry.indices[3 * hit.primitive]
                i1 = geometry.indices[3 * hit.primitive + 1]
                i2 = geometry.indices[3 * hit.primitive + 2]
                v0 = geometry.points[i0]
                v1 = geometry.points[i1]
                v2 = geometry.points[i2]
                b2 = 1.0 - hit.u - hit.v
                vertex.position = hit.u * v0 + hit.v * v1 + b2 * v2
                normal = wp.normalize(scaled_cross(v0, v1, v2, triangle_extent(v0, v1, v2)))
                vertex.offset = position_error(v0, v1, v2, hit.u, hit.v, normal)
                if wp.static(instanced):
                    if hit.instance >= 0:
                        instance = geometry.instances[hit.instance]
                        reach = wp.abs(vertex.position) + wp.max(wp.abs(v1 - v0), wp.abs(v2 - v0))
                        vertex.offset = offset_to_world(instance, vertex.offset, reach, normal, POSITION_ERROR)
                        vertex.position = point_to_world(instance, vertex.position)
                        normal = normal_to_world(instance, normal)
                vertex.shading_normal = normal
                if wp.static(smooth):
                    if geometry.shapes[geometry.shape_of[hit.primitive]].smooth == 1:
                        n0 = geometry.normals[i0]
                        n1 = geometry.normals[i1]
                        n2 = geometry.normals[i2]
                        if wp.static(instanced):
                            if hit.instance >= 0:  # each is of unit length again, as if the mesh were in the world
                                n0 = normal_to_world(instance, n0)
                                n1 = normal_to_world(instance, n1)
                                n2 = normal_to_world(instance, n2)
                        blend = hit.u * n0 + hit.v * n1 + b2 * n2
                        if wp.length_sq(blend) > 0.0:
                            vertex.shading_normal = wp.normalize(blend)
                            if wp.dot(vertex.shading_normal, normal) < 0.0:
                                normal = -normal
                vertex.geometric_normal = normal
                if wp.static(uvs):
                    vertex.uv = hit.u * geometry.uvs[i0] + hit.v * geometry.uvs[i1] + b2 * geometry.uvs[i2]
                if wp.static(tangents):
                    e1 = v1 - v0
                    e2 = v2 - v0
                    # A disk is a fan, of which the vertex where u is 0 is the centre.
                    outwards_u = hit.v * e1 + b2 * e2
                    if geometry.uvs[i0][0] != 0.0:
                        outwards_u -= wp.where(geometry.uvs[i1][0] == 0.0, e1, e2)
                    if wp.static(instanced):
                        if hit.instance >= 0:
                            e1 = instance.to_world * e1
                            e2 = instance.to_world * e2
                            outwards_u = instance.to_world * outwards_u
                    extent = wp.max(wp.max(wp.abs(e1)), wp.max(wp.abs(e2)))
                    d1 = geometry.uvs[i1] - geometry.uvs[i0]
                    d2 = geometry.uvs[i2] - geometry.uvs[i0]
                    along_u, along_v, scale = uv_partials(e1 / extent, e2 / extent, d1, d2)
                    if geometry.shapes[geometry.shape_of[hit.primitive]].polar == 1:
                        # dp/du of a disk goes away from its centre, where u is 0, not along the middle of the triangle;
                        # and the length of dp/dv that a triangle has is that at the rim, where u is 1.
                        u = hit.u * geometry.uvs[i0][0] + hit.v * geometry.uvs[i1][0] + b2 * geometry.uvs[i2][0]
                        if u > 0.0:
                            along_u = outwards_u / (u * extent * scale)
                        along_v *= u
                    vertex.tangent = tangent_along(vertex.shading_normal, along_u)
                    if wp.static(bumps):
                        vertex.uv_jacobian = (extent * scale) * in_frame(vertex, along_u, along_v)
        if wp.static(spheres):
            if hit.primitive >= geometry.triangle_count:
                index = hit.primitive - geometry.triangle_count
                sphere = geometry.spheres[index]
                center = wp.vec3(sphere[0], sphere[1], sphere[2])
                reached = origin + hit.t * direction
                if wp.static(instanced):
                    if hit.instance >= 0:
                        moved = geometry.instances[hit.instance]
                        reached = point_to_local(moved, origin) + hit.t * (moved.to_local * direction)
                outwards = wp.normalize(reached - center)
                vertex.position = center + sphere[3] * outwards
                vertex.geometric_normal = outwards
                if geometry.shapes[geometry.shape_of[hit.primitive]].flip == 1:
                    vertex.geometric_normal = -outwards
                vertex.shading_normal = vertex.geometric_normal
                # The intersection itself loses digits of |origin - centre|, but the point was put back onto the sphere.
                vertex.offset = SPHERE_ERROR * (wp.dot(wp.abs(center), wp.abs(outwards)) + sphere[3])
                if wp.static(uvs):
                    vertex.uv = sphere_uv(geometry.sphere_to_local[index] * outwards)
                if wp.static(instanced):
                    if hit.instance >= 0:
                        reach = wp.abs(vertex.position) + wp.vec3(sphere[3])
                        vertex.offset = offset_to_world(moved, vertex.offset, reach, outwards, POSITION_ERROR)
                        vertex.position = point_to_world(moved, vertex.position)
                        vertex.geometric_normal = normal_to_world(moved, vertex.geometric_normal)
                        vertex.shading_normal = vertex.geometric_normal
                if wp.static(tangents):
                    to_local = geometry.sphere_to_local[index]
                    local = to_local * outwards
                    along_u = wp.transpose(to_local) * wp.vec3(-local[1], local[0], 0.0)
                    # From the pole (0, 0, 1) down, at half the speed of u.
                    along_v = wp.transpose(to_local) * wp.vec3(0.0, 0.0, -1.0)
                    along_v = wp.normalize(along_v - wp.dot(along_v, outwards) * outwards)
                    if wp.static(instanced):
                        if hit.instance >= 0:
                            along_u = moved.to_world * along_u
                            along_v = moved.to_world * along_v
                    vertex.tangent = tangent_along(vertex.shading_normal, along_u)
                    if wp.static(bumps):
                        scale = wp.static(wp.pi) * sphere[3]
                        vertex.uv_jacobian = scale * in_frame(vertex, 2.0 * along_u, along_v)
        return vertex

    return vertex_of
