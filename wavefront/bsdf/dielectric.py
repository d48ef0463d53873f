"""Smooth boundary between two dielectrics: reflection and refraction, both sides."""

import warp as wp

from wavefront.bsdf.fresnel import fresnel_dielectric
from wavefront.bsdf.record import BsdfSample, no_sample


@wp.func
def sample_dielectric(
    eta: float, specular_reflectance: wp.vec3, specular_transmittance: wp.vec3, wo: wp.vec3, u: wp.vec3
) -> BsdfSample:
    """Reflects with the probability of the Fresnel reflectance, which then cancels from the weight.

    eta = n_interior / n_exterior, the normal points to the exterior. Radiance that crosses the boundary scales with
    n^2; a path from the viewer crosses against the light, which leaves the factor (n_wo / n_wi)^2.
    """
    result = no_sample()
    fresnel = fresnel_dielectric(wo[2], eta)
    if u[2] < fresnel.reflectance:
        result.wi = wp.vec3(-wo[0], -wo[1], wo[2])
        result.weight = specular_reflectance
    else:
        result.wi = wp.vec3(-fresnel.inv_eta * wo[0], -fresnel.inv_eta * wo[1], fresnel.cos_t)
        result.weight = (fresnel.inv_eta * fresnel.inv_eta) * specular_transmittance
        result.eta = fresnel.eta
    return result
