"""Plastic with a microfacet surface: a diffuse base below a rough dielectric coating, one-sided.

As `plastic`, with the coating's reflection spread over a microfacet lobe, and with the fraction of light that passes a
rough coating, T(cos), in place of Fresnel's 1 - F:
    f = F D G / (4 cos(wo) cos(wi)) + T(wo) T(wi) base / (pi eta^2)
as `roughplastic` of Mitsuba 3. `table` holds T at equally spaced cosines from `first`, see `coating.py`.
"""

import warp as wp

from wavefront.bsdf.fresnel import fresnel_dielectric
from wavefront.bsdf.microfacet import microfacet_d, sample_visible_normal, smith_g1, smith_g1_over_cos
from wavefront.bsdf.plastic import coated_base, coating_probability
from wavefront.bsdf.record import BsdfEval, BsdfSample, no_eval, no_sample
from wavefront.warp_samples import cosine_hemisphere_pdf, square_to_cosine_hemisphere

TABLE_SIZE = wp.constant(64)


@wp.func
def coating_transmittance(table: wp.array[wp.float32], first: int, cos: float) -> float:
    x = wp.min(cos, 1.0) * float(TABLE_SIZE - 1)
    i = wp.min(int(x), TABLE_SIZE - 2)
    return wp.lerp(table[first + i], table[first + i + 1], x - float(i))


@wp.func
def _eval_with_normal(
    diffuse: wp.vec3,
    specular_reflectance: wp.vec3,
    eta: float,
    internal_reflectance: float,
    nonlinear: int,
    alpha: wp.vec2,
    distribution: int,
    table: wp.array[wp.float32],
    first: int,
    wo: wp.vec3,
    wi: wp.vec3,
    m: wp.vec3,
    cos_m: float,
) -> BsdfEval:
    """Both parts, for directions above the surface and the microfacet normal m between them."""
    result = BsdfEval()
    t_o = coating_transmittance(table, first, wo[2])
    t_i = coating_transmittance(table, first, wi[2])
    p = coating_probability(diffuse, specular_reflectance, 1.0 - t_o, t_o)
    cosine = cosine_hemisphere_pdf(wi)
    lobe = 0.25 * microfacet_d(m, alpha, distribution) * smith_g1_over_cos(wo, alpha, distribution)
    glossy = lobe * smith_g1(wi, alpha, distribution) * fresnel_dielectric(cos_m, eta).reflectance
    base = (t_o * t_i * cosine) * coated_base(diffuse, eta, internal_reflectance, nonlinear)
    result.value = base + glossy * specular_reflectance
    result.pdf = p * lobe + (1.0 - p) * cosine
    return result


@wp.func
def sample_rough_plastic(
    diffuse: wp.vec3,
    specular_reflectance: wp.vec3,
    eta: float,
    internal_reflectance: float,
    nonlinear: int,
    alpha: wp.vec2,
    distribution: int,
    table: wp.array[wp.float32],
    first: int,
    wo: wp.vec3,
    u: wp.vec3,
) -> BsdfSample:
    """Samples one part and weights with both, so that a path may be connected either way."""
    result = no_sample()
    if wo[2] > 0.0:
        t_o = coating_transmittance(table, first, wo[2])
        p = coating_probability(diffuse, specular_reflectance, 1.0 - t_o, t_o)
        m = wp.vec3(0.0, 0.0, 1.0)
        wi = wp.vec3(0.0, 0.0, 1.0)
        cos_m = float(1.0)
        if u[2] < p:
            m = sample_visible_normal(wo, alpha, distribution, wp.vec2(u[0], u[1]))
            cos_m = wp.dot(wo, m)
            wi = 2.0 * cos_m * m - wo
        else:
            wi = square_to_cosine_hemisphere(wp.vec2(u[0], u[1]))
            h = wo + wi
            length = wp.length(h)
            m = h / length  # both are above the surface, or wi is dropped below
            cos_m = 0.5 * length
        if wi[2] > 0.0:
            e = _eval_with_normal(
                diffuse,
                specular_reflectance,
                eta,
                internal_reflectance,
                nonlinear,
                alpha,
                distribution,
                table,
                first,
                wo,
                wi,
                m,
                cos_m,
            )
            if e.pdf > 0.0:
                result.wi = wi
                result.weight = e.value / e.pdf
                result.pdf = e.pdf
    return result


@wp.func
def eval_rough_plastic(
    diffuse: wp.vec3,
    specular_reflectance: wp.vec3,
    eta: float,
    internal_reflectance: float,
    nonlinear: int,
    alpha: wp.vec2,
    distribution: int,
    table: wp.array[wp.float32],
    first: int,
    wo: wp.vec3,
    wi: wp.vec3,
) -> BsdfEval:
    result = no_eval()
    h = wo + wi
    length = wp.length(h)
    if wo[2] > 0.0 and wi[2] > 0.0 and length > 0.0:
        result = _eval_with_normal(
            diffuse,
            specular_reflectance,
            eta,
            internal_reflectance,
            nonlinear,
            alpha,
            distribution,
            table,
            first,
            wo,
            wi,
            h / length,
            0.5 * length,
        )
    return result
