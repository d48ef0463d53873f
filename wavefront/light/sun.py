"""The sun: a disc of even radiance, infinitely far away, whose directions are a cone."""

import warp as wp

from wavefront.light.tables import DistantRecord
from wavefront.warp_samples import orthonormal_basis, square_to_cone, to_world


@wp.func
def sample_sun(sun: DistantRecord, u: wp.vec2) -> wp.vec3:
    """A direction towards the sun, uniform over its solid angle."""
    s, t = orthonormal_basis(sun.direction)
    return wp.normalize(to_world(s, t, sun.direction, square_to_cone(u, sun.one_minus_cos)))


@wp.func
def in_sun(sun: DistantRecord, w: wp.vec3) -> bool:
    """Whether a direction meets the disc. |a - b|^2 = 2 (1 - cos) keeps its digits where the disc is small."""
    return 0.5 * wp.length_sq(w - sun.direction) <= sun.one_minus_cos
