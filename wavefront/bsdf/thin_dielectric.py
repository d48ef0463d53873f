"""A thin sheet of a dielectric, such as a window pane modelled by one surface: both sides alike.

Light enters the sheet and is reflected inside any number of times. With F of one boundary, what comes back is F + (1
- F)^2 F (1 + F^2 + ...) = 2 F / (1 + F), and the rest, (1 - F) / (1 + F), passes without a change of direction (as
`thindielectric` of Mitsuba 3). In a sheet without absorption nothing is lost, and radiance scales with no index.
"""

import warp as wp

from wavefront.bsdf.fresnel import fresnel_dielectric
from wavefront.bsdf.record import BsdfSample, no_sample


@wp.func
def sample_thin_dielectric(
    eta: float, specular_reflectance: wp.vec3, specular_transmittance: wp.vec3, wo: wp.vec3, u: wp.vec3
) -> BsdfSample:
    """Reflects with the probability of the sheet's reflectance, which then cancels from the weight."""
    result = no_sample()
    one = fresnel_dielectric(wp.abs(wo[2]), eta).reflectance
    if u[2] < 2.0 * one / (1.0 + one):
        result.wi = wp.vec3(-wo[0], -wo[1], wo[2])
        result.weight = specular_reflectance
    else:
        result.wi = -wo
        result.weight = specular_transmittance
    return result
