"""The BSDF functions of each kind, called with the parameters that the tables and textures hold."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.conductor import sample_conductor
from wavefront.bsdf.dielectric import sample_dielectric
from wavefront.bsdf.diffuse import eval_diffuse, sample_diffuse
from wavefront.bsdf.fresnel import fresnel_conductor
from wavefront.bsdf.null import sample_null
from wavefront.bsdf.oren_nayar import eval_oren_nayar, sample_oren_nayar
from wavefront.bsdf.plastic import eval_plastic, sample_plastic
from wavefront.bsdf.principled import PrincipledParameters, make_principled
from wavefront.bsdf.record import BsdfEval, BsdfSample
from wavefront.bsdf.rough_conductor import eval_rough_conductor, sample_rough_conductor
from wavefront.bsdf.rough_dielectric import eval_rough_dielectric, sample_rough_dielectric
from wavefront.bsdf.rough_plastic import eval_rough_plastic, sample_rough_plastic
from wavefront.bsdf.tables import (
    KIND_CONDUCTOR,
    KIND_DIELECTRIC,
    KIND_DIFFUSE,
    KIND_NULL,
    KIND_OREN_NAYAR,
    KIND_PLASTIC,
    KIND_PRINCIPLED,
    KIND_PRINCIPLED_TRANSMISSIVE,
    KIND_ROUGH_CONDUCTOR,
    KIND_ROUGH_DIELECTRIC,
    KIND_ROUGH_PLASTIC,
    KIND_THIN_DIELECTRIC,
    PRINCIPLED_FRACTIONS,
    MaterialTables,
    PrincipledRecord,
)
from wavefront.bsdf.thin_dielectric import sample_thin_dielectric
from wavefront.texture import TextureTables, luminance, make_eval_parameter, make_eval_texture

MIN_ALPHA = wp.constant(1.0e-4)  # below, a microfacet lobe is too narrow for float32


@wp.func
def clamp_alpha(alpha: float) -> float:
    """A constant is checked when the scene is read, a texture may hold any value."""
    return wp.clamp(alpha, MIN_ALPHA, 1.0)


@functools.cache
def make_eval_scalar(textures: tuple[str, ...]):
    """`eval_scalar(tables, value, texture, uv) -> float`: a parameter that is a number; of a colour, the luminance."""
    textured = bool(textures)
    eval_texture = make_eval_texture(textures)

    @wp.func
    def eval_scalar(tables: TextureTables, value: float, texture: int, uv: wp.vec2) -> float:
        if wp.static(textured):
            if texture >= 0:
                return luminance(eval_texture(tables, texture, uv))
        return value

    return eval_scalar


@functools.cache
def make_eval_alpha(textures: tuple[str, ...]):
    """`eval_alpha(tables, value, texture_u, texture_v, uv) -> vec2`: roughness along the tangent and across it."""
    eval_scalar = make_eval_scalar(textures)

    @wp.func
    def eval_alpha(textures: TextureTables, value: wp.vec2, texture_u: int, texture_v: int, uv: wp.vec2) -> wp.vec2:
        u = clamp_alpha(eval_scalar(textures, value[0], texture_u, uv))
        v = u
        if value[1] != value[0] or texture_v != texture_u:
            v = clamp_alpha(eval_scalar(textures, value[1], texture_v, uv))
        return wp.vec2(u, v)

    return eval_alpha


@functools.cache
def make_principled_at(textures: tuple[str, ...]):
    """`principled_at(record, tables, uv) -> PrincipledParameters`: what a principled material is at one point."""
    eval_parameter = make_eval_parameter(textures)
    eval_scalar = make_eval_scalar(textures)

    textured = bool(textures)
    index = PRINCIPLED_FRACTIONS.index

    @wp.func
    def principled_at(r: PrincipledRecord, textures: TextureTables, uv: wp.vec2) -> PrincipledParameters:
        p = PrincipledParameters()
        p.base_color = eval_parameter(textures, r.base_color, r.base_color_texture, uv)
        f = r.fractions
        if wp.static(textured):
            for i in range(r.textured):  # one look-up in the code, however many parameters have a texture
                f[r.textured_fraction[i]] = wp.clamp(eval_scalar(textures, 0.0, r.fraction_texture[i], uv), 0.0, 1.0)
        p.roughness = f[wp.static(index("roughness"))]
        p.anisotropic = f[wp.static(index("anisotropic"))]
        p.metallic = f[wp.static(index("metallic"))]
        p.spec_trans = f[wp.static(index("spec_trans"))]
        p.spec_tint = f[wp.static(index("spec_tint"))]
        p.sheen = f[wp.static(index("sheen"))]
        p.sheen_tint = f[wp.static(index("sheen_tint"))]
        p.flatness = f[wp.static(index("flatness"))]
        p.clearcoat = f[wp.static(index("clearcoat"))]
        p.clearcoat_gloss = f[wp.static(index("clearcoat_gloss"))]
        p.eta = r.eta
        p.specular_rate = r.specular_rate
        p.clearcoat_rate = r.clearcoat_rate
        p.diffuse_rate = r.diffuse_rate
        return p

    return principled_at


@functools.cache
def make_kinds(kinds: tuple[str, ...], textures: tuple[str, ...]):
    """BSDFs in their local frame, by kind and index of the record.

    Args:
        kinds: Names of the kinds in a scene, from `tables.KINDS`; no other is compiled.
        textures: Kinds of texture that parameters may have, see `texture.make_eval_texture`.

    Returns:
        `eval_local(tables, textures, kind, index, uv, wo, wi) -> BsdfEval`,
        `sample_local(tables, textures, kind, index, uv, wo, u) -> BsdfSample`, and
        `albedo_local(tables, textures, kind, index, uv) -> vec3`.
    """
    has_diffuse = "diffuse" in kinds
    has_conductor = "conductor" in kinds
    has_rough_conductor = "rough_conductor" in kinds
    has_dielectric = "dielectric" in kinds
    has_rough_dielectric = "rough_dielectric" in kinds
    has_plastic = "plastic" in kinds
    has_rough_plastic = "rough_plastic" in kinds
    has_thin_dielectric = "thin_dielectric" in kinds
    has_null = "null" in kinds
    has_oren_nayar = "oren_nayar" in kinds
    has_transmissive = "principled_transmissive" in kinds
    has_principled = "principled" in kinds or has_transmissive
    eval_parameter = make_eval_parameter(textures)
    eval_scalar = make_eval_scalar(textures)
    eval_alpha = make_eval_alpha(textures)
    principled_at = make_principled_at(textures)
    # One pair of functions for both kinds: what transmits includes what does not.
    eval_principled, sample_principled = make_principled(has_transmissive)

    @wp.func
    def eval_local(
        tables: MaterialTables, textures: TextureTables, kind: int, index: int, uv: wp.vec2, wo: wp.vec3, wi: wp.vec3
    ) -> BsdfEval:
        result = BsdfEval()
        if wp.static(has_diffuse):
            if kind == KIND_DIFFUSE:
                d = tables.diffuse[index]
                result = eval_diffuse(eval_parameter(textures, d.reflectance, d.reflectance_texture, uv), wo, wi)
        if wp.static(has_oren_nayar):
            if kind == KIND_OREN_NAYAR:
                n = tables.oren_nayar[index]
                result = eval_oren_nayar(
                    eval_parameter(textures, n.reflectance, n.reflectance_texture, uv),
                    wp.clamp(eval_scalar(textures, n.roughness, n.roughness_texture, uv), 0.0, 1.0),
                    wo,
                    wi,
                )
        if wp.static(has_rough_conductor):
            if kind == KIND_ROUGH_CONDUCTOR:
                c = tables.conductor[index]
                result = eval_rough_conductor(
                    eval_parameter(textures, c.eta, c.eta_texture, uv),
                    eval_parameter(textures, c.k, c.k_texture, uv),
                    eval_parameter(textures, c.reflectance, c.reflectance_texture, uv),
                    eval_alpha(textures, c.alpha, c.alpha_u_texture, c.alpha_v_texture, uv),
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
                    eval_alpha(textures, g.alpha, g.alpha_u_texture, g.alpha_v_texture, uv),
                    g.distribution,
                    wo,
                    wi,
                )
        if wp.static(has_plastic):
            if kind == KIND_PLASTIC:
                p = tables.plastic[index]
                result = eval_plastic(
                    eval_parameter(textures, p.diffuse, p.diffuse_texture, uv),
                    eval_parameter(textures, p.reflectance, p.reflectance_texture, uv),
                    p.eta,
                    p.internal_reflectance,
                    p.nonlinear,
                    wo,
                    wi,
                )
        if wp.static(has_rough_plastic):
            if kind == KIND_ROUGH_PLASTIC:
                p = tables.plastic[index]
                result = eval_rough_plastic(
                    eval_parameter(textures, p.diffuse, p.diffuse_texture, uv),
                    eval_parameter(textures, p.reflectance, p.reflectance_texture, uv),
                    p.eta,
                    p.internal_reflectance,
                    p.nonlinear,
                    wp.vec2(p.alpha),
                    p.distribution,
                    tables.coatings,
                    p.first,
                    wo,
                    wi,
                )
        if wp.static(has_principled):
            if kind == KIND_PRINCIPLED or kind == KIND_PRINCIPLED_TRANSMISSIVE:
                result = eval_principled(principled_at(tables.principled[index], textures, uv), wo, wi)
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
        if wp.static(has_oren_nayar):
            if kind == KIND_OREN_NAYAR:
                n = tables.oren_nayar[index]
                result = sample_oren_nayar(
                    eval_parameter(textures, n.reflectance, n.reflectance_texture, uv),
                    wp.clamp(eval_scalar(textures, n.roughness, n.roughness_texture, uv), 0.0, 1.0),
                    wo,
                    u,
                )
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
                    eval_alpha(textures, c.alpha, c.alpha_u_texture, c.alpha_v_texture, uv),
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
                    eval_alpha(textures, g.alpha, g.alpha_u_texture, g.alpha_v_texture, uv),
                    g.distribution,
                    wo,
                    u,
                )
        if wp.static(has_plastic):
            if kind == KIND_PLASTIC:
                p = tables.plastic[index]
                result = sample_plastic(
                    eval_parameter(textures, p.diffuse, p.diffuse_texture, uv),
                    eval_parameter(textures, p.reflectance, p.reflectance_texture, uv),
                    p.eta,
                    p.internal_reflectance,
                    p.nonlinear,
                    wo,
                    u,
                )
        if wp.static(has_rough_plastic):
            if kind == KIND_ROUGH_PLASTIC:
                p = tables.plastic[index]
                result = sample_rough_plastic(
                    eval_parameter(textures, p.diffuse, p.diffuse_texture, uv),
                    eval_parameter(textures, p.reflectance, p.reflectance_texture, uv),
                    p.eta,
                    p.internal_reflectance,
                    p.nonlinear,
                    wp.vec2(p.alpha),
                    p.distribution,
                    tables.coatings,
                    p.first,
                    wo,
                    u,
                )
        if wp.static(has_thin_dielectric):
            if kind == KIND_THIN_DIELECTRIC:
                s = tables.dielectric[index]
                result = sample_thin_dielectric(
                    s.eta,
                    eval_parameter(textures, s.reflectance, s.reflectance_texture, uv),
                    eval_parameter(textures, s.transmittance, s.transmittance_texture, uv),
                    wo,
                    u,
                )
        if wp.static(has_principled):
            if kind == KIND_PRINCIPLED or kind == KIND_PRINCIPLED_TRANSMISSIVE:
                result = sample_principled(principled_at(tables.principled[index], textures, uv), wo, u)
        if wp.static(has_null):
            if kind == KIND_NULL:
                result = sample_null(wo)
        return result

    @wp.func
    def albedo_local(tables: MaterialTables, textures: TextureTables, kind: int, index: int, uv: wp.vec2) -> wp.vec3:
        albedo = wp.vec3(0.0)
        if wp.static(has_diffuse):
            if kind == KIND_DIFFUSE:
                d = tables.diffuse[index]
                albedo = eval_parameter(textures, d.reflectance, d.reflectance_texture, uv)
        if wp.static(has_oren_nayar):
            if kind == KIND_OREN_NAYAR:
                n = tables.oren_nayar[index]
                albedo = eval_parameter(textures, n.reflectance, n.reflectance_texture, uv)
        if wp.static(has_conductor or has_rough_conductor):
            if kind == KIND_CONDUCTOR or kind == KIND_ROUGH_CONDUCTOR:
                c = tables.conductor[index]
                fresnel = fresnel_conductor(
                    1.0,
                    eval_parameter(textures, c.eta, c.eta_texture, uv),
                    eval_parameter(textures, c.k, c.k_texture, uv),
                )
                albedo = wp.cw_mul(fresnel, eval_parameter(textures, c.reflectance, c.reflectance_texture, uv))
        if wp.static(has_dielectric or has_rough_dielectric or has_thin_dielectric):
            if kind == KIND_DIELECTRIC or kind == KIND_ROUGH_DIELECTRIC or kind == KIND_THIN_DIELECTRIC:
                g = tables.dielectric[index]
                albedo = eval_parameter(textures, g.transmittance, g.transmittance_texture, uv)
        if wp.static(has_plastic or has_rough_plastic):
            if kind == KIND_PLASTIC or kind == KIND_ROUGH_PLASTIC:
                p = tables.plastic[index]
                albedo = eval_parameter(textures, p.diffuse, p.diffuse_texture, uv)
        if wp.static(has_principled):
            if kind == KIND_PRINCIPLED or kind == KIND_PRINCIPLED_TRANSMISSIVE:
                b = tables.principled[index]
                albedo = eval_parameter(textures, b.base_color, b.base_color_texture, uv)
        if wp.static(has_null):
            if kind == KIND_NULL:
                albedo = wp.vec3(1.0)
        return albedo

    return eval_local, sample_local, albedo_local
