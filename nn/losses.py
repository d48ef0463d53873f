"""Losses: the mean over samples and outputs of a function of prediction y and target t, and its gradient.

A loss for the training kernels is a ``wp.func(y, y_offset, target, row, factor, dL_dy, dL_dy_offset) -> float`` that
returns the sum over the outputs of one row and writes `factor` times its gradient, from `dL_dy_offset` on, with respect
to each output. `make_loss` builds those of the schema, whose targets are as wide as the outputs. A caller may pass its
own; its targets have the columns that it reads, ``target.shape[1]`` of them, which it must not read beyond.
"""

import functools

import warp as wp

EPSILON = wp.constant(wp.float32(0.01))


@wp.func
def l1(y: wp.float32, t: wp.float32, luminance: wp.float32):
    d = y - t
    return wp.vec2(wp.abs(d), slope_of_abs(d))


@wp.func
def slope_of_abs(d: wp.float32):
    """Sign of d; zero at zero, NaN for NaN."""
    return wp.where(d > 0.0, 1.0, wp.where(d < 0.0, -1.0, d))


@wp.func
def l2(y: wp.float32, t: wp.float32, luminance: wp.float32):
    d = y - t
    return wp.vec2(d * d, 2.0 * d)


@wp.func
def relative_l1(y: wp.float32, t: wp.float32, luminance: wp.float32):
    return l1(y, t, luminance) / (wp.abs(y) + EPSILON)


@wp.func
def relative_l2(y: wp.float32, t: wp.float32, luminance: wp.float32):
    return l2(y, t, luminance) / (y * y + EPSILON)


@wp.func
def relative_l2_luminance(y: wp.float32, t: wp.float32, luminance: wp.float32):
    return l2(y, t, luminance) / (luminance * luminance + EPSILON)


@wp.func
def mape(y: wp.float32, t: wp.float32, luminance: wp.float32):
    return l1(y, t, luminance) / (wp.abs(t) + EPSILON)


@wp.func
def smape(y: wp.float32, t: wp.float32, luminance: wp.float32):
    return l1(y, t, luminance) / (0.5 * (wp.abs(y) + wp.abs(t)) + EPSILON)


@wp.func
def cross_entropy(y: wp.float32, t: wp.float32, luminance: wp.float32):
    return wp.vec2(-t * wp.log(y), -t / y)


@wp.func
def variance(y: wp.float32, t: wp.float32, luminance: wp.float32):
    return wp.vec2(t * t / y, -t * t / (y * y))


_TERMS = {
    "L1": l1,
    "L2": l2,
    "RelativeL1": relative_l1,
    "RelativeL2": relative_l2,
    "RelativeL2Luminance": relative_l2_luminance,
    "MAPE": mape,
    "SMAPE": smape,
    "CrossEntropy": cross_entropy,
    "Variance": variance,
}


@functools.cache
def make_loss(otype: str):
    """The loss of that name over one row, for the training kernels."""
    term = _TERMS[otype]
    of_luminance = otype == "RelativeL2Luminance"

    @wp.func
    def loss(
        y: wp.array[wp.float32],
        y_offset: int,
        target: wp.array2d[wp.float32],
        row: int,
        factor: wp.float32,
        dL_dy: wp.array[wp.float32],
        dL_dy_offset: int,
    ):
        luminance = wp.float32(0.0)
        if wp.static(of_luminance):
            for i in range(target.shape[1] / 3 * 3):
                weights = wp.vec3(0.299, 0.587, 0.114)
                luminance += weights[i % 3] * y[y_offset + i]
        total = wp.float32(0.0)
        for i in range(target.shape[1]):
            value = wp.static(term)(y[y_offset + i], target[row, i], luminance)
            total += value[0]
            dL_dy[dL_dy_offset + i] = value[1] * factor
        return total

    return loss
