"""Lambertian reflection: f = reflectance / pi, above the surface only."""

import warp as wp

from wavefront.bsdf.record import BsdfEval, BsdfSample, no_eval, no_sample
from wavefront.warp_samples import cosine_hemisphere_pdf, square_to_cosine_hemisphere


@wp.func
def sample_diffuse(reflectance: wp.vec3, wo: wp.vec3, u: wp.vec3) -> BsdfSample:
    """Samples cos / pi, so the weight is the reflectance. A direction in the horizon itself (pdf 0) is dropped."""
    result = no_sample()
    wi = square_to_cosine_hemisphere(wp.vec2(u[0], u[1]))
    if wo[2] > 0.0 and wi[2] > 0.0:
        result.wi = wi
        result.weight = reflectance
        result.pdf = cosine_hemisphere_pdf(wi)
    return result


@wp.func
def eval_diffuse(reflectance: wp.vec3, wo: wp.vec3, wi: wp.vec3) -> BsdfEval:
    result = no_eval()
    if wo[2] > 0.0 and wi[2] > 0.0:
        result.pdf = cosine_hemisphere_pdf(wi)
        result.value = reflectance * result.pdf
    return result
