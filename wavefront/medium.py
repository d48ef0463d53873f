"""Media that absorb: what is left of light after a distance, and which medium a ray enters.

A path knows the medium that its next ray travels in. Surfaces that bound media say what is on either side of them; so
the medium follows from the side a ray leaves to, whatever the BSDF did: reflection, refraction, a null surface, a mask.
"""

import warp as wp

from wavefront.accel.geometry import INFINITE


@wp.func
def transmittance(sigma_a: wp.vec3, distance: float) -> wp.vec3:
    """exp(-sigma_a distance), by channel (Beer and Lambert); from infinity, nothing is left where there is absorption.

    A product that overflows is infinite, of which the exponential is zero; neither factor is infinite itself.
    """
    if distance >= INFINITE:
        return wp.vec3(
            wp.where(sigma_a[0] > 0.0, 0.0, 1.0),
            wp.where(sigma_a[1] > 0.0, 0.0, 1.0),
            wp.where(sigma_a[2] > 0.0, 0.0, 1.0),
        )
    return wp.vec3(wp.exp(-sigma_a[0] * distance), wp.exp(-sigma_a[1] * distance), wp.exp(-sigma_a[2] * distance))


@wp.func
def medium_towards(media: wp.vec2i, geometric_normal: wp.vec3, direction: wp.vec3) -> int:
    """The medium of a ray that leaves a surface in `direction`: of the side on which `spawn_origin` starts it."""
    return wp.where(wp.dot(geometric_normal, direction) < 0.0, media[1], media[0])
