"""The principled BSDF: Disney's model (Burley 2012 and 2015) as Mitsuba 3 parameterises it.

Below, m is the half vector, d its angle to either direction, and S(c) = (1 - c)^5 Schlick's weight. A surface is
metallic by a share, and of the rest a share `spec_trans` refracts: with t = (1 - metallic) spec_trans and
b = (1 - metallic)(1 - spec_trans), f is the sum of

    main specular  F D G / (4 cos(wo) cos(wi)), GGX with alpha = roughness^2 (at least 0.001) divided along x and
                   multiplied along y by sqrt(1 - 0.9 anisotropic), where
                   F = metallic schlick(base_color)
                       + (1 - metallic) ((1 - spec_tint) fresnel(eta) + spec_tint schlick(r0 tint)),
                   schlick(r) = r + (1 - r) S(d), r0 = ((eta - 1) / (eta + 1))^2, tint = base_color / luminance
    refraction     t sqrt(base_color) times that of a rough dielectric: light that enters and leaves is tinted once
    diffuse        b base_color / pi (the diffuse term and retro-reflection of 2015), towards an approximation of
                   subsurface scattering (Hanrahan and Krueger) by `flatness`
    sheen          (1 - metallic) sheen S(d), white to tint by `sheen_tint`
    clearcoat      clearcoat / 4 schlick(0.04) D G: D is GTR1 with alpha from 0.1 (gloss 0) to 0.001, G is Smith's for
                   GGX with alpha = 1/4, and no cosines divide.

From inside (wo below) only the boundary is left: t times a rough dielectric, whose transmission has the tint as above.

Sampling takes a lobe by the weights main specular rate, clearcoat / 4 times its rate, and b times the diffuse rate. The
main specular lobe refracts with probability t (1 - fresnel).
"""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.fresnel import FresnelDielectric, fresnel_dielectric
from wavefront.bsdf.microfacet import (
    DISTRIBUTION_GGX,
    microfacet_d,
    sample_visible_normal,
    smith_g1,
    smith_g1_over_cos,
)
from wavefront.bsdf.record import BsdfEval, BsdfSample, no_eval, no_sample
from wavefront.bsdf.rough_dielectric import eval_rough_dielectric, sample_rough_dielectric
from wavefront.film import LUMINANCE
from wavefront.warp_samples import cosine_hemisphere_pdf, square_to_cosine_hemisphere, unit_circle

MIN_ALPHA = wp.constant(1.0e-3)  # of the main specular lobe
_CLEARCOAT_G_ALPHA = wp.constant(0.25)
_INV_PI = wp.constant(0.3183098861837907)


@wp.struct
class PrincipledParameters:
    """At one point of a surface: every value is in its range."""

    base_color: wp.vec3
    roughness: wp.float32
    anisotropic: wp.float32
    metallic: wp.float32
    spec_trans: wp.float32
    eta: wp.float32  # interior over exterior index of refraction; not 1 where spec_trans is not 0
    spec_tint: wp.float32
    sheen: wp.float32
    sheen_tint: wp.float32
    flatness: wp.float32
    clearcoat: wp.float32
    clearcoat_gloss: wp.float32
    specular_rate: wp.float32
    clearcoat_rate: wp.float32
    diffuse_rate: wp.float32


@wp.func
def main_alpha(p: PrincipledParameters) -> wp.vec2:
    alpha = p.roughness * p.roughness
    aspect = wp.sqrt(1.0 - 0.9 * p.anisotropic)
    return wp.vec2(wp.max(alpha / aspect, MIN_ALPHA), wp.max(alpha * aspect, MIN_ALPHA))


@wp.func
def schlick_weight(cos: float) -> float:
    x = wp.clamp(1.0 - cos, 0.0, 1.0)
    return x * x * x * x * x


@wp.func
def tint_of(color: wp.vec3) -> wp.vec3:
    """The colour at luminance one; black is without tint."""
    luminance = wp.dot(color, wp.static(wp.vec3(*LUMINANCE)))
    if luminance > 0.0:
        return color / luminance
    return wp.vec3(1.0)


@wp.func
def root(color: wp.vec3) -> wp.vec3:
    return wp.vec3(wp.sqrt(color[0]), wp.sqrt(color[1]), wp.sqrt(color[2]))


# --- clearcoat -------------------------------------------------------------------------------------------------------


@wp.func
def clearcoat_alpha(gloss: float) -> float:
    return wp.lerp(0.1, 0.001, gloss)


@wp.func
def gtr1_d(m: wp.vec3, alpha: float) -> float:
    """Density of normals, GTR with exponent 1 (Burley 2012, appendix B.2), as z^2 + (x^2 + y^2) / alpha^2 for GGX.

    D = (alpha^2 - 1) / (pi ln(alpha^2) (x^2 + y^2 + alpha^2 z^2)), alpha < 1.
    """
    a2 = alpha * alpha
    return (1.0 - a2) * _INV_PI / (-2.0 * wp.log(alpha) * (m[0] * m[0] + m[1] * m[1] + a2 * m[2] * m[2]))


@wp.func
def sample_gtr1(alpha: float, u: wp.vec2) -> wp.vec3:
    """A normal with density D(m) m.z, by the inverse CDF (Burley 2012, appendix B.2).

    With a = alpha^2, cos^2 = (1 - a^(1 - u)) / (1 - a), so that sin^2 = a (a^-u - 1) / (1 - a), which is as precise
    for a narrow lobe as for a wide one.
    """
    a = alpha * alpha
    sin2 = wp.min(a * (wp.exp(-2.0 * u[1] * wp.log(alpha)) - 1.0) / (1.0 - a), 1.0)
    r = wp.sqrt(sin2)
    p = r * unit_circle(u[0])
    return wp.vec3(p[0], p[1], wp.sqrt(1.0 - sin2))


# --- the parts above the surface -------------------------------------------------------------------------------------


@wp.func
def diffuse_factor(p: PrincipledParameters, cos_o: float, cos_i: float, cos_d: float) -> float:
    """pi f of the diffuse lobe over base_color: Burley 2015, sections 5.1 and 5.3.

    With Fo = S(cos(wo)), Fi = S(cos(wi)) and R = 2 roughness cos(d)^2
        diffuse    (1 - Fo / 2)(1 - Fi / 2) + R (Fo + Fi + Fo Fi (R - 1))
        flattened  1.25 ((1 + (R / 2 - 1) Fo)(1 + (R / 2 - 1) Fi) (1 / (cos(wo) + cos(wi)) - 1 / 2) + 1 / 2).
    """
    fo = schlick_weight(cos_o)
    fi = schlick_weight(cos_i)
    r = 2.0 * p.roughness * cos_d * cos_d
    factor = (1.0 - 0.5 * fo) * (1.0 - 0.5 * fi) + r * (fo + fi + fo * fi * (r - 1.0))
    if p.flatness > 0.0:
        k = 0.5 * r - 1.0
        flat = 1.25 * ((1.0 + k * fo) * (1.0 + k * fi) * (1.0 / (cos_o + cos_i) - 0.5) + 0.5)
        factor = wp.lerp(factor, flat, p.flatness)
    return factor


@wp.func
def main_reflectance(p: PrincipledParameters, tint: wp.vec3, fresnel: FresnelDielectric, schlick: float) -> wp.vec3:
    """F of the main specular lobe, from outside."""
    white = wp.vec3(1.0)
    result = wp.vec3((1.0 - p.metallic) * (1.0 - p.spec_tint) * fresnel.reflectance)
    result += p.metallic * (p.base_color + schlick * (white - p.base_color))
    r = (p.eta - 1.0) / (p.eta + 1.0)
    tinted = (r * r) * tint
    return result + ((1.0 - p.metallic) * p.spec_tint) * (tinted + schlick * (white - tinted))


@functools.cache
def make_principled(transmission: bool):
    """Functions of the BSDF for scenes in which some principled material transmits, or none.

    Args:
        transmission: Whether `spec_trans` may be other than 0; without, the surface is one-sided.

    Returns:
        `eval_principled(p, wo, wi) -> BsdfEval` and `sample_principled(p, wo, u) -> BsdfSample`.
    """

    @wp.func
    def refracting_share(p: PrincipledParameters) -> float:
        share = float(0.0)
        if wp.static(transmission):
            share = (1.0 - p.metallic) * p.spec_trans
        return share

    @wp.func
    def diffuse_share(p: PrincipledParameters) -> float:
        share = 1.0 - p.metallic
        if wp.static(transmission):
            share *= 1.0 - p.spec_trans
        return share

    @wp.func
    def lobe_probabilities(p: PrincipledParameters) -> wp.vec3:
        """Of main specular, clearcoat and diffuse, from outside."""
        coat = 0.25 * p.clearcoat * p.clearcoat_rate
        base = diffuse_share(p) * p.diffuse_rate
        return wp.vec3(p.specular_rate, coat, base) / (p.specular_rate + coat + base)

    @wp.func
    def eval_above(
        p: PrincipledParameters, probabilities: wp.vec3, wo: wp.vec3, wi: wp.vec3, m: wp.vec3, cos_m: float
    ) -> BsdfEval:
        """All parts for two directions above the surface, and the half vector m between them."""
        result = BsdfEval()
        alpha = main_alpha(p)
        tint = tint_of(p.base_color)
        fresnel = fresnel_dielectric(cos_m, p.eta)
        # Light that goes to the thinner side meets Schlick's weight at the angle of refraction.
        schlick = schlick_weight(wp.where(p.eta < 1.0, wp.abs(fresnel.cos_t), cos_m))
        cosine = cosine_hemisphere_pdf(wi)

        lobe = 0.25 * microfacet_d(m, alpha, DISTRIBUTION_GGX) * smith_g1_over_cos(wo, alpha, DISTRIBUTION_GGX)
        glossy = lobe * smith_g1(wi, alpha, DISTRIBUTION_GGX)
        result.value = glossy * main_reflectance(p, tint, fresnel, schlick)
        reflecting = float(1.0)
        if wp.static(transmission):
            reflecting = 1.0 - refracting_share(p) * fresnel.transmittance
        result.pdf = probabilities[0] * reflecting * lobe + probabilities[2] * cosine

        base = (diffuse_share(p) * diffuse_factor(p, wo[2], wi[2], cos_m) * cosine) * p.base_color
        result.value += base
        if p.sheen > 0.0:
            sheen = (1.0 - p.metallic) * p.sheen * schlick_weight(cos_m) * wi[2]
            result.value += sheen * (wp.vec3(1.0) + p.sheen_tint * (tint - wp.vec3(1.0)))
        if p.clearcoat > 0.0:
            d = gtr1_d(m, clearcoat_alpha(p.clearcoat_gloss))
            rough = wp.vec2(_CLEARCOAT_G_ALPHA)
            g = smith_g1(wo, rough, DISTRIBUTION_GGX) * smith_g1(wi, rough, DISTRIBUTION_GGX)
            result.value += wp.vec3(0.25 * p.clearcoat * (0.04 + 0.96 * schlick) * d * g * wi[2])
            result.pdf += probabilities[1] * d * m[2] / (4.0 * cos_m)
        return result

    @wp.func
    def eval_principled(p: PrincipledParameters, wo: wp.vec3, wi: wp.vec3) -> BsdfEval:
        result = no_eval()
        if wo[2] > 0.0 and wi[2] > 0.0:
            h = wo + wi
            length = wp.length(h)
            if length > 0.0:
                result = eval_above(p, lobe_probabilities(p), wo, wi, h / length, 0.5 * length)
        else:
            if wp.static(transmission):
                share = refracting_share(p)
                if share > 0.0:
                    tint = root(p.base_color)
                    result = eval_rough_dielectric(p.eta, wp.vec3(1.0), tint, main_alpha(p), DISTRIBUTION_GGX, wo, wi)
                    result.value *= share
                    if wo[2] > 0.0:
                        result.pdf *= share * lobe_probabilities(p)[0]
        return result

    @wp.func
    def sample_principled(p: PrincipledParameters, wo: wp.vec3, u: wp.vec3) -> BsdfSample:
        """Samples one lobe and weights with all that share its side."""
        result = no_sample()
        u2 = wp.vec2(u[0], u[1])
        alpha = main_alpha(p)
        share = refracting_share(p)
        probabilities = lobe_probabilities(p)
        boundary = wo[2] < 0.0  # whether the sample is one of a rough dielectric alone
        u_boundary = u[2]
        if wo[2] > 0.0:
            m = wp.vec3(0.0, 0.0, 1.0)
            wi = wp.vec3(0.0, 0.0, 1.0)
            cos_m = float(1.0)
            x = u[2]
            if x < probabilities[2]:
                wi = square_to_cosine_hemisphere(u2)
                h = wo + wi
                cos_m = 0.5 * wp.length(h)
                m = wp.normalize(h)
            else:
                x -= probabilities[2]
                if x < probabilities[1]:
                    m = sample_gtr1(clearcoat_alpha(p.clearcoat_gloss), u2)
                else:
                    x = (x - probabilities[1]) / probabilities[0]
                    m = sample_visible_normal(wo, alpha, DISTRIBUTION_GGX, u2)
                    if wp.static(transmission):
                        passing = fresnel_dielectric(wp.max(wp.dot(wo, m), 0.0), p.eta).transmittance
                        boundary = x < share * passing
                        u_boundary = 1.0  # refracts at the same normal, as that follows from the same numbers
                cos_m = wp.dot(wo, m)
                wi = 2.0 * cos_m * m - wo
            if not boundary and wi[2] > 0.0 and cos_m > 0.0:
                e = eval_above(p, probabilities, wo, wi, m, cos_m)
                if e.pdf > 0.0:
                    result.wi = wi
                    result.weight = e.value / e.pdf
                    result.pdf = e.pdf
        if wp.static(transmission):
            if boundary and share > 0.0:
                tint = root(p.base_color)
                result = sample_rough_dielectric(
                    p.eta, wp.vec3(1.0), tint, alpha, DISTRIBUTION_GGX, wo, wp.vec3(u[0], u[1], u_boundary)
                )
                if wo[2] > 0.0:
                    result.weight /= probabilities[0]
                    result.pdf *= share * probabilities[0]
                else:
                    result.weight *= share
        return result

    return eval_principled, sample_principled
