"""The frame that a BSDF is evaluated in: the shading normal and, where a scene needs one, a tangent.

A bump or normal map turns the frame. What was the shading normal before is then the base normal.
"""

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
    base_normal: wp.vec3  # set where a scene has maps, as is
    terminator: float  # alpha^2 of `base_shadowing`; -1: nothing is reflected


@functools.cache
def make_frame(tangents: bool, maps: bool):
    """Functions of frames.

    Args:
        tangents: Field of `Features`.
        maps: Whether some material has a bump or normal map.

    Returns:
        `frame_at(surfaces, slot) -> ShadingFrame` and `basis(frame) -> (s, t)`.
    """

    @wp.func
    def frame_at(surfaces: Surfaces, slot: int) -> ShadingFrame:
        frame = ShadingFrame()
        frame.normal = surfaces.shading_normal[slot]
        if wp.static(tangents):
            frame.tangent = surfaces.tangent[slot]
        if wp.static(maps):
            frame.base_normal = surfaces.base_normal[slot]
            frame.terminator = surfaces.terminator[slot]
        return frame

    @wp.func
    def tangent_basis(frame: ShadingFrame):
        return frame.tangent, wp.cross(frame.normal, frame.tangent)

    @wp.func
    def any_basis(frame: ShadingFrame):
        s, t = orthonormal_basis(frame.normal)
        return s, t

    return frame_at, tangent_basis if tangents else any_basis


@wp.func
def terminator_alpha2(n: wp.vec3) -> float:
    """Squared roughness of the surface that a mapped normal (unit length, base normal z) is taken as a sample of."""
    return wp.min(0.125 * (n[0] * n[0] + n[1] * n[1]) / (n[2] * n[2]), 1.0)


@wp.func
def base_shadowing(frame: ShadingFrame, wi: wp.vec3) -> float:
    """Factor of a BSDF whose frame was turned by a map: GGX masking of `wi` above the base surface, so that light does
    not end at a sharp line where it falls below the turned surface (Conty Estevez, Lecocq and Stein 2019, Ray Tracing
    Gems, chapter 12); zero where `wi` is above one of the two surfaces and below the other.
    """
    z = wp.dot(frame.base_normal, wi)
    if z * wp.dot(frame.normal, wi) <= 0.0 or frame.terminator < 0.0:
        return 0.0
    if frame.terminator == 0.0:
        return 1.0
    z2 = z * z
    return 2.0 / (1.0 + wp.sqrt(1.0 + frame.terminator * wp.max(1.0 - z2, 0.0) / z2))
