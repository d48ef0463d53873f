"""A surface that is not there: light passes, though the shape may still emit."""

import warp as wp

from wavefront.bsdf.record import BsdfSample, no_sample


@wp.func
def sample_null(wo: wp.vec3) -> BsdfSample:
    result = no_sample()
    result.wi = -wo
    result.weight = wp.vec3(1.0)
    return result
