"""Rough diffuse reflection, as of clay, plaster or the moon: Oren and Nayar 1994 in the improved form of Fujii.

The qualitative model of Oren and Nayar ("Generalization of Lambert's Reflectance Model") reflects more than it receives
at grazing angles and has a dark ring where its two cases meet. Fujii's form (2012, "A tiny improvement of Oren-Nayar
reflectance model"; its energy is derived by Portsmouth, Kutz and Hill 2024, "EON") keeps the idea and mends both:
    f = reflectance A (1 + roughness s / t),    A = 1 / (pi + (pi / 2 - 2 / 3) roughness),
    s = wo.wi - cos(wo) cos(wi),    t = max(cos(wo), cos(wi)) for s > 0, else 1.
A white surface then reflects at most all it receives, at grazing incidence; roughness 0 is Lambert's law.
"""

import warp as wp

from wavefront.bsdf.record import BsdfEval, BsdfSample, no_eval, no_sample
from wavefront.warp_samples import cosine_hemisphere_pdf, square_to_cosine_hemisphere, unit_circle

_TWO_PI = wp.constant(6.283185307179586)
_FUJII = wp.constant(0.9041296601282299)  # pi / 2 - 2 / 3
_PI = wp.constant(3.141592653589793)


@wp.func
def eval_oren_nayar(reflectance: wp.vec3, roughness: float, wo: wp.vec3, wi: wp.vec3) -> BsdfEval:
    """The density mixes cosine and uniform: where both directions graze, f alone grows as 1 / cos, so that the weight
    of samples by cosine would not be bounded. Mixed with p = roughness / (1 + roughness) it is at most 3.2."""
    result = no_eval()
    if wo[2] > 0.0 and wi[2] > 0.0:
        s = wo[0] * wi[0] + wo[1] * wi[1]
        t = float(1.0)
        if s > 0.0:
            t = wp.max(wo[2], wi[2])
        a = 1.0 / (_PI + _FUJII * roughness)
        p = roughness / (1.0 + roughness)
        result.value = (a * wp.max(1.0 + roughness * s / t, 0.0) * wi[2]) * reflectance
        result.pdf = (1.0 - p) * cosine_hemisphere_pdf(wi) + p / _TWO_PI
    return result


@wp.func
def sample_oren_nayar(reflectance: wp.vec3, roughness: float, wo: wp.vec3, u: wp.vec3) -> BsdfSample:
    result = no_sample()
    if wo[2] > 0.0:
        wi = wp.vec3(0.0, 0.0, 1.0)
        if u[2] < roughness / (1.0 + roughness):
            p = wp.sqrt((1.0 - u[1]) * (1.0 + u[1])) * unit_circle(u[0])
            wi = wp.vec3(p[0], p[1], u[1])
        else:
            wi = square_to_cosine_hemisphere(wp.vec2(u[0], u[1]))
        e = eval_oren_nayar(reflectance, roughness, wo, wi)
        if e.pdf > 0.0:
            result.wi = wi
            result.weight = e.value / e.pdf
            result.pdf = e.pdf
    return result
