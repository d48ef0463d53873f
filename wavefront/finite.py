"""Whether numbers are finite, inline: `wp.isfinite` calls a C function on the CPU device, which costs all registers."""

import warp as wp

_MAX = wp.constant(3.4028234663852886e38)


@wp.func
def is_finite(x: float) -> bool:
    return wp.abs(x) <= _MAX


@wp.func
def is_finite3(v: wp.vec3) -> bool:
    """Zero times infinity or NaN is NaN, which is equal to nothing."""
    return wp.dot(v, wp.vec3(0.0)) == 0.0


@wp.func
def is_radiance(L: wp.vec3) -> bool:
    """Whether `L` is finite and not negative."""
    return is_finite3(L) and L[0] >= 0.0 and L[1] >= 0.0 and L[2] >= 0.0
