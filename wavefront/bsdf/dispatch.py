"""From a material to its BSDF: sides, opacity, textures, and the kinds that a scene has."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.conductor import sample_conductor
from wavefront.bsdf.dielectric import sample_dielectric
from wavefront.bsdf.diffuse import eval_diffuse, sample_diffuse
from wavefront.bsdf.fresnel import fresnel_conductor
from wavefront.bsdf.record import BsdfEval, BsdfSample
from wavefront.bsdf.rough_conductor import eval_rough_conductor, sample_rough_conductor
from wavefront.bsdf.rough_dielectric import eval_rough_dielectric, sample_rough_dielectric
from wavefront.bsdf.tables import (
    KIND_CONDUCTOR,
    KIND_DIELECTRIC,
    KIND_DIFFUSE,
    KIND_ROUGH_CONDUCTOR,
    KIND_ROUGH_DIELECTRIC,
    Material,
    MaterialTables,
)
from wavefront.texture import TextureTables, make_eval_parameter
from wavefront.warp_samples import orthonormal_basis, to_local, to_world

MIN_ALPHA = wp.constant(1.0e-4)  # below, a microfacet lobe is too narrow for float32


@wp.func
def clamp_alpha(alpha: float) -> float:
    """A constant is checked when the scene is read, a texture may hold any value."""
    return wp.clamp(alpha, MIN_ALPHA, 1.0)


@wp.func
def transmits(kind: int) -> bool:
    return kind == KIND_DIELECTRIC or kind == KIND_ROUGH_DIELECTRIC


@wp.func
def side_kind(material: Material, cos_o: float) -> int:
    return wp.where(cos_o >= 0.0, material.front, material.back)


@wp.func
def is_smooth(material: Material, cos_o: float) -> bool:
    """Whether the side that is seen has a part that is not a delta, so that a light sample can contribute."""
    kind = side_kind(material, cos_o)
    return kind == KIND_DIFFUSE or kind == KIND_ROUGH_CONDUCTOR or kind == KIND_ROUGH_DIELECTRIC


@functools.cache
def make_bsdf(kinds: tuple[str, ...], mask: bool, textures: tuple[str, ...]):
    """BSDF functions for the kinds in a scene.

    Args:
        kinds: Names of the kinds, from `tables.KINDS`.
        mask: Whether some material is not opaque.
        textures: Kinds of texture that parameters may have, see `texture.make_eval_texture`.

    Returns:
        `eval_bsdf(tables, textures, material, uv, normal, wo, wi) -> BsdfEval` without the delta parts,
        `sample_bsdf(tables, textures, material, uv, normal, wo, u) -> BsdfSample`, both with directions in world
        space, and `eval_albedo(tables, textures, material, uv, normal, wo) -> vec3`, a colour for denoisers.
    """
    has_diffuse = "diffuse" in kinds
    has_conductor = "conductor" in kinds
    has_rough_conductor = "rough_conductor" in kinds
    has_dielectric = "dielectric" in kinds
    has_rough_dielectric = "rough_dielectric" in kinds
    eval_parameter = make_eval_parameter(textures)

    @wp.func
    def eval_scalar(textures: TextureTables, value: float, texture: int, uv: wp.vec2) -> float:
        v = eval_parameter(textures, wp.vec3(value), texture, uv)
        return (v[0] + v[1] + v[2]) / 3.0

    @wp.func
    def opacity_at(textures: TextureTables, material: Material, uv: wp.vec2) -> float:
        return wp.clamp(eval_scalar(textures, material.opacity, material.opacity_texture, uv), 0.0, 1.0)

    @wp.func
    def eval_local(
        tables: MaterialTables, textures: TextureTables, kind: int, index: int, uv: wp.vec2, wo: wp.vec3, wi: wp.vec3
    ) -> BsdfEval:
        result = BsdfEval()
        if wp.static(has_diffuse):
            if kind == KIND_DIFFUSE:
                d = tables.diffuse[index]
                result = eval_diffuse(eval_parameter(textures, d.reflectance, d.reflectance_texture, uv), wo, wi)
        if wp.static(has_rough_conductor):
            if kind == KIND_ROUGH_CONDUCTOR:
                c = tables.conductor[index]
                result = eval_rough_conductor(
                    eval_parameter(textures, c.eta, c.eta_texture, uv),
                    eval_parameter(textures, c.k, c.k_texture, uv),
                    eval_parameter(textures, c.reflectance, c.reflectance_texture, uv),
                    clamp_alpha(eval_scalar(textures, c.alpha, c.alpha_texture, uv)),
                    c.distribution,
                    wo,
                    wi,
                )
        if wp.static(has_rough_dielectric):
            if kind == KIND_ROUGH_DIELECTRIC:
                g = tables.dielectric[index]
                result = eval_rough_dielectric(
                    g.eta,
                    eval_parameter(textures, g.reflectance, g.reflectance_texture, uv),
                    eval_parameter(textures, g.transmittance, g.transmittance_texture, uv),
                    clamp_alpha(eval_scalar(textures, g.alpha, g.alpha_texture, uv)),
                    g.distribution,
                    wo,
                    wi,
                )
        return result

    @wp.func
    def sample_local(
        tables: MaterialTables, textures: TextureTables, kind: int, index: int, uv: wp.vec2, wo: wp.vec3, u: wp.vec3
    ) -> BsdfSample:
        result = BsdfSample()
        if wp.static(has_diffuse):
            if kind == KIND_DIFFUSE:
                d = tables.diffuse[index]
                result = sample_diffuse(eval_parameter(textures, d.reflectance, d.reflectance_texture, uv), wo, u)
        if wp.static(has_conductor):
            if kind == KIND_CONDUCTOR:
                m = tables.conductor[index]
                result = sample_conductor(
                    eval_parameter(textures, m.eta, m.eta_texture, uv),
                    eval_parameter(textures, m.k, m.k_texture, uv),
                    eval_parameter(textures, m.reflectance, m.reflectance_texture, uv),
                    wo,
                    u,
                )
        if wp.static(has_rough_conductor):
            if kind == KIND_ROUGH_CONDUCTOR:
                c = tables.conductor[index]
                result = sample_rough_conductor(
                    eval_parameter(textures, c.eta, c.eta_texture, uv),
                    eval_parameter(textures, c.k, c.k_texture, uv),
                    eval_parameter(textures, c.reflectance, c.reflectance_texture, uv),
                    clamp_alpha(eval_scalar(textures, c.alpha, c.alpha_texture, uv)),
                    c.distribution,
                    wo,
                    u,
                )
        if wp.static(has_dielectric):
            if kind == KIND_DIELECTRIC:
                s = tables.dielectric[index]
                result = sample_dielectric(
                    s.eta,
                    eval_parameter(textures, s.reflectance, s.reflectance_texture, uv),
                    eval_parameter(textures, s.transmittance, s.transmittance_texture, uv),
                    wo,
                    u,
                )
        if wp.static(has_rough_dielectric):
            if kind == KIND_ROUGH_DIELECTRIC:
                g = tables.dielectric[index]
                result = sample_rough_dielectric(
                    g.eta,
                    eval_parameter(textures, g.reflectance, g.reflectance_texture, uv),
                    eval_parameter(textures, g.transmittance, g.transmittance_texture, uv),
                    clamp_alpha(eval_scalar(textures, g.alpha, g.alpha_texture, uv)),
                    g.distribution,
                    wo,
                    u,
                )
        return result

    @wp.func
    def mirror_side(kind: int, v: wp.vec3, cos_o: float) -> wp.vec3:
        """A reflecting BSDF always sees its front; one that transmits tells the sides apart itself."""
        if cos_o < 0.0 and not transmits(kind):
            return wp.vec3(v[0], v[1], -v[2])
        return v

    @wp.func
    def eval_bsdf(
        tables: MaterialTables,
        textures: TextureTables,
        material_index: int,
        uv: wp.vec2,
        normal: wp.vec3,
        wo: wp.vec3,
        wi: wp.vec3,
    ) -> BsdfEval:
        material = tables.materials[material_index]
        s, t = orthonormal_basis(normal)
        wo_local = to_local(s, t, normal, wo)
        cos_o = wo_local[2]
        kind = side_kind(material, cos_o)
        index = wp.where(cos_o >= 0.0, material.front_index, material.back_index)
        result = eval_local(
            tables,
            textures,
            kind,
            index,
            uv,
            mirror_side(kind, wo_local, cos_o),
            mirror_side(kind, to_local(s, t, normal, wi), cos_o),
        )
        if wp.static(mask):
            opacity = opacity_at(textures, material, uv)
            result.value *= opacity
            result.pdf *= opacity
        return result

    @wp.func
    def sample_bsdf(
        tables: MaterialTables,
        textures: TextureTables,
        material_index: int,
        uv: wp.vec2,
        normal: wp.vec3,
        wo: wp.vec3,
        u: wp.vec3,
    ) -> BsdfSample:
        material = tables.materials[material_index]
        u_lobe = u[2]
        if wp.static(mask):
            opacity = opacity_at(textures, material, uv)
            if u_lobe >= opacity:  # straight through: a delta, chosen with the probability that is its weight
                through = BsdfSample()
                through.wi = -wo
                through.weight = wp.vec3(1.0)
                through.eta = 1.0
                return through
            u_lobe = wp.min(u_lobe / opacity, 1.0 - 5.9604645e-8)  # what is left of the number chooses the lobe
        s, t = orthonormal_basis(normal)
        wo_local = to_local(s, t, normal, wo)
        cos_o = wo_local[2]
        kind = side_kind(material, cos_o)
        index = wp.where(cos_o >= 0.0, material.front_index, material.back_index)
        result = sample_local(
            tables, textures, kind, index, uv, mirror_side(kind, wo_local, cos_o), wp.vec3(u[0], u[1], u_lobe)
        )
        result.wi = to_world(s, t, normal, mirror_side(kind, result.wi, cos_o))
        if wp.static(mask):
            result.pdf *= opacity
        return result

    @wp.func
    def eval_albedo(
        tables: MaterialTables,
        textures: TextureTables,
        material_index: int,
        uv: wp.vec2,
        normal: wp.vec3,
        wo: wp.vec3,
    ) -> wp.vec3:
        material = tables.materials[material_index]
        cos_o = wp.dot(normal, wo)
        kind = side_kind(material, cos_o)
        index = wp.where(cos_o >= 0.0, material.front_index, material.back_index)
        albedo = wp.vec3(0.0)
        if wp.static(has_diffuse):
            if kind == KIND_DIFFUSE:
                d = tables.diffuse[index]
                albedo = eval_parameter(textures, d.reflectance, d.reflectance_texture, uv)
        if wp.static(has_conductor or has_rough_conductor):
            if kind == KIND_CONDUCTOR or kind == KIND_ROUGH_CONDUCTOR:
                c = tables.conductor[index]
                fresnel = fresnel_conductor(
                    1.0,
                    eval_parameter(textures, c.eta, c.eta_texture, uv),
                    eval_parameter(textures, c.k, c.k_texture, uv),
                )
                albedo = wp.cw_mul(fresnel, eval_parameter(textures, c.reflectance, c.reflectance_texture, uv))
        if wp.static(has_dielectric or has_rough_dielectric):
            if kind == KIND_DIELECTRIC or kind == KIND_ROUGH_DIELECTRIC:
                g = tables.dielectric[index]
                albedo = eval_parameter(textures, g.transmittance, g.transmittance_texture, uv)
        return albedo

    return eval_bsdf, sample_bsdf, eval_albedo
