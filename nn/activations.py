"""Activation functions and their derivatives, as functions of one float for kernels.

Softplus and Squareplus have the schema's slope parameter of 10: log(1 + exp(10 x)) / 10.
"""

from __future__ import annotations

import warp as wp

NAMES = ("None", "ReLU", "LeakyReLU", "SiLU", "Sigmoid", "Tanh", "Softplus", "Squareplus", "Exponential", "Sine")
CODES = {name: code for code, name in enumerate(NAMES)}
# The derivative of these is a function of the input, that of the others of the output.
FROM_INPUT = ("SiLU", "Sine")

NONE = wp.constant(0)
RELU = wp.constant(1)
LEAKY_RELU = wp.constant(2)
SILU = wp.constant(3)
SIGMOID = wp.constant(4)
TANH = wp.constant(5)
SOFTPLUS = wp.constant(6)
SQUAREPLUS = wp.constant(7)
EXPONENTIAL = wp.constant(8)
SINE = wp.constant(9)


@wp.func
def sigmoid(x: wp.float32):
    """The logistic function."""
    return 1.0 / (1.0 + wp.exp(-x))


@wp.func
def log1p(e: wp.float32):
    """log(1 + e) for e > -1, exact for small e (Kahan): the rounding of 1 + e cancels."""
    u = 1.0 + e
    if u == 1.0:
        return e
    return wp.log(u) * (e / (u - 1.0))


@wp.func
def expm1(x: wp.float32):
    """exp(x) - 1 for x <= 0, exact for small x (Kahan)."""
    u = wp.exp(x)
    if u == 1.0:
        return x
    if u < 0.5:
        return u - 1.0
    return (u - 1.0) * (x / wp.log(u))


@wp.func
def activate(code: int, x: wp.float32):
    """The activation `code` of x; NaN stays NaN."""
    if code == RELU:
        return wp.where(x < 0.0, 0.0, x)
    if code == LEAKY_RELU:
        return wp.where(x < 0.0, 0.01 * x, x)
    if code == SILU:
        return x * sigmoid(x)
    if code == SIGMOID:
        return sigmoid(x)
    if code == TANH:
        return wp.tanh(x)
    if code == SOFTPLUS:
        return wp.where(x < 0.0, 0.0, x) + 0.1 * log1p(wp.exp(-10.0 * wp.abs(x)))
    if code == SQUAREPLUS:
        # 0.5 (|x| + r), and its conjugate for x < 0, where the sum would cancel
        big = 0.5 * (wp.abs(x) + wp.sqrt(x * x + 0.04))
        return wp.where(x < 0.0, 0.01 / big, big)
    if code == EXPONENTIAL:
        return wp.exp(x)
    if code == SINE:
        return wp.sin(x)
    return x


@wp.func
def derivative(code: int, v: wp.float32):
    """The derivative of the activation `code`; v is its output, or its input for SiLU and Sine."""
    if code == RELU:
        return wp.where(v > 0.0, 1.0, 0.0)
    if code == LEAKY_RELU:
        return wp.where(v > 0.0, 1.0, 0.01)
    if code == SILU:
        s = sigmoid(v)
        return s * (1.0 + v * (1.0 - s))
    if code == SIGMOID:
        return v * (1.0 - v)
    if code == TANH:
        return 1.0 - v * v
    if code == SOFTPLUS:
        return -expm1(-10.0 * v)
    if code == SQUAREPLUS:
        y2 = v * v
        return y2 / (y2 + 0.01)
    if code == EXPONENTIAL:
        return v
    if code == SINE:
        return wp.cos(v)
    return 1.0
