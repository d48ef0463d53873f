"""Lights without extent: they can only be sampled, since no ray meets them by chance."""

import warp as wp

from wavefront.light.tables import PointRecord


@wp.func
def spot_falloff(spot: PointRecord, w: wp.vec3) -> float:
    """Share of the intensity of a spot light that leaves in direction w."""
    # By the tangent, which is precise at all angles.
    angle = wp.atan2(wp.length(wp.cross(spot.direction, w)), wp.dot(spot.direction, w))
    if angle >= spot.cutoff_angle:
        return 0.0
    if angle <= spot.beam_width:
        return 1.0
    return (spot.cutoff_angle - angle) / (spot.cutoff_angle - spot.beam_width)
