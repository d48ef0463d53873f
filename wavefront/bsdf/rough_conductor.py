"""Conductor with a microfacet surface, one-sided.

Torrance and Sparrow: f = F D G / (4 cos(wo) cos(wi)), G = G1(wo) G1(wi). Visible normals have the density
D G1(wo) (wo.m) / cos(wo) (Heitz and d'Eon 2014) and reflection the Jacobian 1 / (4 wo.m), so
    pdf = D G1(wo) / (4 cos(wo)),    f cos(wi) = pdf F G1(wi),    weight = F G1(wi) <= 1.
"""

import warp as wp

from wavefront.bsdf.fresnel import fresnel_conductor
from wavefront.bsdf.microfacet import microfacet_d, sample_visible_normal, smith_g1, smith_g1_over_cos
from wavefront.bsdf.record import BsdfEval, BsdfSample, no_eval, no_sample


@wp.func
def sample_rough_conductor(
    eta: wp.vec3,
    k: wp.vec3,
    specular_reflectance: wp.vec3,
    alpha: wp.vec2,
    distribution: int,
    wo: wp.vec3,
    u: wp.vec3,
) -> BsdfSample:
    result = no_sample()
    if wo[2] > 0.0:
        m = sample_visible_normal(wo, alpha, distribution, wp.vec2(u[0], u[1]))
        cos_m = wp.dot(wo, m)
        wi = 2.0 * cos_m * m - wo
        pdf = 0.25 * microfacet_d(m, alpha, distribution) * smith_g1_over_cos(wo, alpha, distribution)
        if wi[2] > 0.0 and pdf > 0.0:
            reflectance = fresnel_conductor(cos_m, eta, k)
            result.wi = wi
            result.weight = smith_g1(wi, alpha, distribution) * wp.cw_mul(specular_reflectance, reflectance)
            result.pdf = pdf
    return result


@wp.func
def eval_rough_conductor(
    eta: wp.vec3,
    k: wp.vec3,
    specular_reflectance: wp.vec3,
    alpha: wp.vec2,
    distribution: int,
    wo: wp.vec3,
    wi: wp.vec3,
) -> BsdfEval:
    """Both cosines to the half vector m = h / |h|, h = wo + wi, are |h| / 2; |h|^2 may underflow to zero."""
    result = no_eval()
    h = wo + wi
    length = wp.length(h)
    if wo[2] > 0.0 and wi[2] > 0.0 and length > 0.0:
        m = h / length
        result.pdf = 0.25 * microfacet_d(m, alpha, distribution) * smith_g1_over_cos(wo, alpha, distribution)
        reflectance = fresnel_conductor(0.5 * length, eta, k)
        g1 = smith_g1(wi, alpha, distribution)
        result.value = (result.pdf * g1) * wp.cw_mul(specular_reflectance, reflectance)
    return result
