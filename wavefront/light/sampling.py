"""Light selection by power, and sampling of a point on the selected light."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.accel.geometry import INFINITE, Geometry
from wavefront.light.delta import spot_falloff
from wavefront.light.envmap import envmap_storage, make_envmap
from wavefront.light.sun import sample_sun
from wavefront.light.tables import (
    KIND_CONSTANT,
    KIND_DIRECTIONAL,
    KIND_ENVMAP_BYTES,
    KIND_ENVMAP_FLOATS,
    KIND_ENVMAP_HALVES,
    KIND_POINT,
    KIND_SPHERE,
    KIND_SPOT,
    KIND_SUN,
    KIND_TRIANGLE,
    LightTables,
)
from wavefront.surface import position_error, scaled_cross, sphere_uv, triangle_extent
from wavefront.texture import TextureTables, make_eval_parameter
from wavefront.warp_samples import (
    cone_pdf,
    orthonormal_basis,
    sphere_pdf,
    square_to_cone,
    square_to_sphere,
    square_to_triangle,
    to_world,
)

# A shadow ray ends before its light by the roundings of a distance: a ray test cannot place a small, far light better.
SHADOW_T_MAX = wp.constant(1.0 - 32.0 * 5.9604645e-8)


@wp.struct
class LightSample:
    wi: wp.vec3  # unit vector towards the light
    target: wp.vec3  # where the shadow ray ends; unused for the environment
    t_max: wp.float32  # of a shadow ray to the target, in units of its distance; INFINITE for the environment
    L: wp.vec3  # emitted radiance; zero if the sample is useless
    pdf: wp.float32  # in solid angle, selection included; of a light without extent, the probability of its selection
    delta: wp.int32  # 1: a light without extent, of which L is the irradiance on a surface that faces it


@wp.func
def select_light(lights: LightTables, u: float) -> int:
    """Index of a light drawn from the alias table."""
    n = lights.lights.shape[0]
    cell = wp.min(int(u * float(n)), n - 1)
    light = lights.lights[cell]
    return wp.where(u < light.alias_threshold, cell, light.alias)


@wp.func
def sphere_cone(sphere: wp.vec4, p: wp.vec3) -> float:
    """1 - cos of the half angle under which a sphere is seen from p; 0 from inside or on it."""
    to_center = wp.vec3(sphere[0], sphere[1], sphere[2]) - p
    distance2 = wp.dot(to_center, to_center)
    r2 = sphere[3] * sphere[3]
    if distance2 <= r2 * 1.00001:
        return 0.0
    sin2 = r2 / distance2
    return sin2 / (1.0 + wp.sqrt(1.0 - sin2))


@functools.cache
def make_light_sampler(kinds: tuple[str, ...], textures: tuple[str, ...]):
    """Sampling of the kinds of light in a scene.

    Args:
        kinds: Names of the kinds, from `tables.KINDS`.
        textures: Kinds of texture that emitters may have.

    Returns:
        `sample_light(lights, geometry, textures, p, u) -> LightSample` for a point p, and
        `light_pdf(lights, geometry, light, p, wi, q, normal) -> float`, the density in solid angle with which that
        would have chosen the point q (with its normal) of an area light, seen from p in direction wi.
    """
    has_triangle = "triangle" in kinds
    has_sphere = "sphere" in kinds
    has_constant = "constant" in kinds
    storage = envmap_storage(kinds)
    has_envmap = storage is not None
    envmap_kind = {"bytes": KIND_ENVMAP_BYTES, "halves": KIND_ENVMAP_HALVES}.get(storage, KIND_ENVMAP_FLOATS)
    eval_envmap, sample_envmap = make_envmap(storage)
    has_directional = "directional" in kinds
    has_point = "point" in kinds or "spot" in kinds
    has_spot = "spot" in kinds
    has_sun = "sun" in kinds
    textured = bool(textures)
    eval_parameter = make_eval_parameter(textures)

    @wp.func
    def sample_light(
        lights: LightTables, geometry: Geometry, textures: TextureTables, p: wp.vec3, u: wp.vec4
    ) -> LightSample:
        result = LightSample()
        result.t_max = SHADOW_T_MAX
        light = lights.lights[select_light(lights, u[0])]
        if wp.static(has_triangle):
            if light.kind == KIND_TRIANGLE:
                emitter = lights.emitters[light.emitter]
                i0 = geometry.indices[3 * light.primitive]
                i1 = geometry.indices[3 * light.primitive + 1]
                i2 = geometry.indices[3 * light.primitive + 2]
                v0 = geometry.points[i0]
                v1 = geometry.points[i1]
                v2 = geometry.points[i2]
                b12 = square_to_triangle(wp.vec2(u[1], u[2]))
                b = wp.vec2(1.0 - b12[0] - b12[1], b12[0])
                b2 = b12[1]
                q = b[0] * v0 + b[1] * v1 + b2 * v2
                to_light = q - p
                extent = triangle_extent(v0, v1, v2)
                cross = scaled_cross(v0, v1, v2, extent)  # along the geometric normal
                shape = geometry.shapes[geometry.shape_of[light.primitive]]
                if shape.smooth == 1:
                    shading_normal = b[0] * geometry.normals[i0] + b[1] * geometry.normals[i1]
                    shading_normal += b2 * geometry.normals[i2]
                    if wp.dot(shading_normal, cross) < 0.0:
                        cross = -cross
                if shape.two_sided == 1 and wp.dot(cross, to_light) > 0.0:
                    cross = -cross
                # Emission is towards the front of the geometric normal; the density in area, 2 / |cross|, becomes one
                # in solid angle by distance^2 / cos. Both lengths are in units of the extent.
                if wp.dot(cross, to_light) < 0.0:
                    wi = wp.normalize(to_light)
                    normal = wp.normalize(cross)
                    result.wi = wi
                    result.target = q + position_error(v0, v1, v2, b[0], b[1], normal) * normal
                    result.pdf = light.pmf * 2.0 * wp.length_sq(to_light / extent) / -wp.dot(cross, wi)
                    uv = wp.vec2(0.0)
                    if wp.static(textured):
                        uv = b[0] * geometry.uvs[i0] + b[1] * geometry.uvs[i1] + b2 * geometry.uvs[i2]
                    result.L = eval_parameter(textures, emitter.radiance, emitter.radiance_texture, uv)
        if wp.static(has_sphere):
            if light.kind == KIND_SPHERE:
                emitter = lights.emitters[light.emitter]
                sphere = geometry.spheres[light.primitive - geometry.triangle_count]
                shape = geometry.shapes[geometry.shape_of[light.primitive]]
                center = wp.vec3(sphere[0], sphere[1], sphere[2])
                r = sphere[3]
                one_minus_cos = sphere_cone(sphere, p)
                inwards = shape.flip == 1
                if shape.two_sided == 1:
                    inwards = one_minus_cos <= 0.0
                normal = wp.vec3(0.0)
                if one_minus_cos > 0.0:
                    to_center = center - p
                    distance = wp.length(to_center)
                    local = square_to_cone(wp.vec2(u[1], u[2]), one_minus_cos)
                    axis = to_center / distance
                    s, t = orthonormal_basis(axis)
                    wi = to_world(s, t, axis, local)
                    # Near intersection of the sampled ray, then put back exactly onto the sphere.
                    sin2 = local[0] * local[0] + local[1] * local[1]
                    t_near = distance * local[2] - wp.sqrt(wp.max(r * r - distance * distance * sin2, 0.0))
                    normal = wp.normalize(p + t_near * wi - center)
                    result.wi = wi
                    result.pdf = light.pmf * cone_pdf(one_minus_cos)
                    result.L = wp.where(inwards, wp.vec3(0.0), emitter.radiance)
                else:
                    normal = square_to_sphere(wp.vec2(u[1], u[2]))
                    to_light = center + r * normal - p
                    wi = wp.normalize(to_light)
                    cos_light = wp.where(inwards, wp.dot(normal, wi), -wp.dot(normal, wi))
                    if cos_light > 0.0:
                        result.wi = wi
                        result.pdf = light.pmf * sphere_pdf() * wp.dot(to_light, to_light) / (cos_light * r * r)
                        result.L = emitter.radiance
                error = 1.0e-6 * (r + wp.max(wp.abs(center)))
                result.target = center + (r + wp.where(inwards, -error, error)) * normal
                if wp.static(textured):
                    if result.L[0] + result.L[1] + result.L[2] > 0.0 and emitter.radiance_texture >= 0:
                        local_normal = geometry.sphere_to_local[light.primitive - geometry.triangle_count] * normal
                        uv = sphere_uv(local_normal)
                        result.L = eval_parameter(textures, emitter.radiance, emitter.radiance_texture, uv)
        if wp.static(has_constant):
            if light.kind == KIND_CONSTANT:
                result.wi = square_to_sphere(wp.vec2(u[1], u[2]))
                result.t_max = INFINITE
                result.pdf = light.pmf * sphere_pdf()
                result.L = lights.emitters[light.emitter].radiance
        if wp.static(has_envmap):
            if light.kind == wp.static(envmap_kind):
                result.wi = sample_envmap(lights.envmap, wp.vec3(u[1], u[2], u[3]))
                # Radiance and density of the rounded direction: what a ray that escapes in it will find.
                found = eval_envmap(lights.envmap, result.wi)
                result.t_max = INFINITE
                result.pdf = light.pmf * found.pdf
                result.L = wp.where(found.pdf > 0.0, found.L, wp.vec3(0.0))
        if wp.static(has_directional):
            if light.kind == KIND_DIRECTIONAL:
                distant = lights.distant[light.emitter]
                result.wi = distant.direction
                result.t_max = INFINITE
                result.pdf = light.pmf
                result.L = distant.emitted
                result.delta = 1
        if wp.static(has_point):
            if light.kind == KIND_POINT or light.kind == KIND_SPOT:
                point = lights.points[light.emitter]
                to_light = point.position - p
                distance2 = wp.dot(to_light, to_light)
                if distance2 > 0.0:
                    result.wi = wp.normalize(to_light)
                    result.target = point.position
                    result.pdf = light.pmf
                    result.L = point.intensity / distance2
                    result.delta = 1
                    if wp.static(has_spot):
                        if light.kind == KIND_SPOT:
                            result.L *= spot_falloff(point, -result.wi)
        if wp.static(has_sun):
            if light.kind == KIND_SUN:
                distant = lights.distant[light.emitter]
                result.wi = sample_sun(distant, wp.vec2(u[1], u[2]))
                result.t_max = INFINITE
                result.pdf = light.pmf * cone_pdf(distant.one_minus_cos)
                result.L = distant.emitted
        return result

    @wp.func
    def light_pdf(
        lights: LightTables, geometry: Geometry, light_index: int, p: wp.vec3, wi: wp.vec3, q: wp.vec3, normal: wp.vec3
    ) -> float:
        light = lights.lights[light_index]
        pdf = float(0.0)
        if wp.static(has_triangle):
            if light.kind == KIND_TRIANGLE:
                v0 = geometry.points[geometry.indices[3 * light.primitive]]
                v1 = geometry.points[geometry.indices[3 * light.primitive + 1]]
                v2 = geometry.points[geometry.indices[3 * light.primitive + 2]]
                extent = triangle_extent(v0, v1, v2)
                cross = scaled_cross(v0, v1, v2, extent)
                pdf = 2.0 * wp.length_sq((q - p) / extent) / (wp.abs(wp.dot(normal, wi)) * wp.length(cross))
        if wp.static(has_sphere):
            if light.kind == KIND_SPHERE:
                sphere = geometry.spheres[light.primitive - geometry.triangle_count]
                one_minus_cos = sphere_cone(sphere, p)
                if one_minus_cos > 0.0:
                    pdf = cone_pdf(one_minus_cos)
                else:
                    pdf = sphere_pdf() * wp.length_sq(q - p)
                    pdf /= wp.abs(wp.dot(normal, wi)) * sphere[3] * sphere[3]
        return light.pmf * pdf

    return sample_light, light_pdf
