"""The frame that a BSDF is evaluated in: the shading normal and, where a scene needs one, a tangent."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.queues import Surfaces
from wavefront.warp_samples import orthonormal_basis


@wp.struct
class ShadingFrame:
    """Local z is the shading normal n, x the tangent s along growing u, y is n x s.

    Without anything that depends on the direction of x, `tangent` is not set, and any tangent will do.
    """

    normal: wp.vec3
    tangent: wp.vec3  # unit length, orthogonal to the normal


@functools.cache
def make_frame(tangents: bool):
    """Functions of frames.

    Args:
        tangents: Field of `Features`.

    Returns:
        `frame_at(surfaces, slot) -> ShadingFrame` and `basis(frame) -> (s, t)`.
    """

    @wp.func
    def frame_at(surfaces: Surfaces, slot: int) -> ShadingFrame:
        frame = ShadingFrame()
        frame.normal = surfaces.shading_normal[slot]
        if wp.static(tangents):
            frame.tangent = surfaces.tangent[slot]
        return frame

    @wp.func
    def tangent_basis(frame: ShadingFrame):
        return frame.tangent, wp.cross(frame.normal, frame.tangent)

    @wp.func
    def any_basis(frame: ShadingFrame):
        s, t = orthonormal_basis(frame.normal)
        return s, t

    return frame_at, tangent_basis if tangents else any_basis
