"""Smooth conductor: a coloured mirror, one-sided."""

import warp as wp

from wavefront.bsdf.fresnel import fresnel_conductor
from wavefront.bsdf.record import BsdfSample, no_sample


@wp.func
def sample_conductor(eta: wp.vec3, k: wp.vec3, specular_reflectance: wp.vec3, wo: wp.vec3, u: wp.vec3) -> BsdfSample:
    """Mirror direction, weighted with the Fresnel reflectance; needs no random numbers."""
    result = no_sample()
    if wo[2] > 0.0:
        result.wi = wp.vec3(-wo[0], -wo[1], wo[2])
        result.weight = wp.cw_mul(specular_reflectance, fresnel_conductor(wo[2], eta, k))
    return result
