"""Bump and normal maps: from the frame of a surface to the frame that its BSDF is evaluated in.

As `bumpmap` and `normalmap` of Mitsuba 3.9. Normals are in the frame (s, t, n) of the surface below: s is the tangent
along growing u, n the shading normal, t = n x s.
"""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.frame import ShadingFrame, terminator_alpha2
from wavefront.bsdf.tables import MAP_BUMP, MapRecord, MaterialTables
from wavefront.finite import is_finite, is_finite3
from wavefront.surface import Vertex
from wavefront.texture import TextureTables, make_eval_gradient, make_eval_parameter
from wavefront.warp_samples import to_local, to_world


@wp.func
def bump_normal(gradient: wp.vec2, jacobian: wp.vec3, geometric_normal: wp.vec3) -> wp.vec3:
    """Normal of a displaced surface, of any length (Blinn 1978, "Simulation of Wrinkled Surfaces").

    With dp/du = a s and dp/dv = b s + c t, a displacement h along n turns them into a s + h_u n and b s + c t + h_v n,
    if the change of n itself is neglected. Their cross product, divided by a c, is turned to the side of the geometric
    normal.
    """
    a = jacobian[0]
    b = jacobian[1]
    c = jacobian[2]
    n = wp.vec3(-gradient[0] / a, (gradient[0] * b / a - gradient[1]) / c, 1.0)
    if a * c == 0.0 or not is_finite3(n):  # no UVs from which a slope could be told
        n = wp.vec3(0.0, 0.0, 1.0)
    return wp.where(wp.dot(geometric_normal, n) < 0.0, -n, n)


@wp.func
def unit_or(v: wp.vec3, fallback: wp.vec3) -> wp.vec3:
    length = wp.length(v)
    if length > 0.0 and is_finite(length):
        return v / length
    return fallback


@functools.cache
def make_mapped_frame(textures: tuple[str, ...], bumps: bool):
    """`mapped_frame(materials, textures, material, vertex, wo) -> ShadingFrame`.

    The frame of a vertex (of which position and offset are not read) whose material may have a map, seen from `wo`.

    Args:
        textures: Field of `Features`.
        bumps: Whether some map is a bump map.
    """
    eval_parameter = make_eval_parameter(textures)
    eval_gradient = make_eval_gradient(textures)

    @wp.func
    def mapped_normal(tables: TextureTables, record: MapRecord, vertex: Vertex, geometric_normal: wp.vec3) -> wp.vec3:
        if wp.static(bumps):
            if record.kind == MAP_BUMP:
                gradient = record.scale * eval_gradient(tables, record.texture, vertex.uv)
                return bump_normal(gradient, vertex.uv_jacobian, geometric_normal)
        n = 2.0 * eval_parameter(tables, record.normal, record.texture, vertex.uv) - wp.vec3(1.0)
        return wp.vec3(record.scale * n[0], record.scale * n[1], n[2])

    @wp.func
    def mapped_frame(
        materials: MaterialTables, textures: TextureTables, material: int, vertex: Vertex, wo_world: wp.vec3
    ) -> ShadingFrame:
        base = vertex.shading_normal
        s = vertex.tangent
        t = wp.cross(base, s)
        frame = ShadingFrame()
        frame.normal = base
        frame.tangent = s
        frame.base_normal = base
        frame.terminator = 0.0
        wo = to_local(s, t, base, wo_world)
        maps = materials.maps_of[material]
        index = wp.where(wo[2] >= 0.0, maps.front, maps.back)
        if index < 0:
            return frame
        record = materials.maps[index]
        n = mapped_normal(textures, record, vertex, to_local(s, t, base, vertex.geometric_normal))
        if wo[2] < 0.0 and maps.mirrored == 1:
            # The back of a two-sided BSDF is the mirror image of a front, at the plane of the base. The normal of the
            # image is (x, y, -z), and the frame is that of the other side of the surface.
            n = wp.vec3(-n[0], -n[1], n[2])
        if record.flip == 1 and wo[2] * wp.dot(wo, n) <= 0.0:
            n = wp.vec3(-n[0], -n[1], n[2])  # Schuessler et al. 2017, section 4.3
        n = unit_or(n, wp.vec3(0.0, 0.0, 1.0))
        x = unit_or(wp.vec3(1.0, 0.0, 0.0) - n[0] * n, wp.vec3(0.0, 1.0, 0.0))
        frame.normal = wp.normalize(to_world(s, t, base, n))
        frame.tangent = wp.normalize(to_world(s, t, base, x))
        if record.shadowing == 1:
            frame.terminator = terminator_alpha2(n)
        if maps.mirrored == 1 and wo[2] * wp.dot(wo, n) <= 0.0:
            frame.terminator = -1.0  # the side of a two-sided BSDF that is seen, seen from its back
        return frame

    return mapped_frame
