"""The von Mises-Fisher distribution on the sphere: density, sampling, moments, and the product of two.

    p(w) = kappa / (2 pi (1 - exp(-2 kappa))) · exp(-kappa h),    h = 1 - mu · w,

with unit vectors mu (the mean direction) and w, for any concentration kappa >= 0; kappa = 0 is the uniform
distribution. Two things keep float32 exact from there to kappa = 1e6 and beyond. Exponents are differences, as in Jakob
2012, "Numerically stable sampling of the von Mises Fisher distribution on S²", through `log1p` and `expm1`. And angles
are measured by h = |w - mu|² / 2, which is equal to 1 - mu · w for unit vectors but does not cancel: the dot product
would be off by 6e-8, which kappa multiplies.
"""

from __future__ import annotations

import warp as wp

from nn.activations import expm1, log1p

_TWO_PI = wp.constant(6.283185307179586)
_INV_TWO_PI = wp.constant(0.15915494309189535)
_UNIFORM = wp.constant(1.0e-15)  # a kappa below this is zero in float32; its products and squares would leave the range

# The lobe that stands for the clamped cosine, max(cos, 0) / pi, as in the published code of Dong et al. 2023. It is
# close to the best fit of one lobe in the mean square over the sphere, kappa = 2.2925. Its error: 0.0247 root mean
# square (19.0 % of the cosine's own), 0.0440 at most (the peak, 1/pi = 0.3183, is 0.3530); total variation 0.132;
# KL(cosine || lobe) 0.1266, where the best is 0.0919 at kappa = 2.9515. 10.07 % of its mass is below the horizon.
COSINE_KAPPA = wp.constant(2.19)


@wp.func
def one_minus_cosine(a: wp.vec3, b: wp.vec3) -> float:
    """h = 1 - cos of the angle between two unit vectors, with all its digits however small the angle."""
    return 0.5 * wp.length_sq(a - b)


# --- density ---------------------------------------------------------------------------------------------------------


@wp.func
def vmf_peak(kappa: float) -> float:
    """The density at the mean direction, kappa / (2 pi (1 - exp(-2 kappa))); 1 / (4 pi) for kappa = 0."""
    mass = -expm1(-2.0 * kappa)
    return _INV_TWO_PI * wp.where(mass > 0.0, kappa / mass, 0.5)


@wp.func
def vmf_pdf(mu: wp.vec3, kappa: float, w: wp.vec3) -> float:
    """Density in solid angle."""
    return vmf_peak(kappa) * wp.exp(-kappa * one_minus_cosine(mu, w))


@wp.func
def vmf_log_pdf(mu: wp.vec3, kappa: float, w: wp.vec3) -> float:
    """Logarithm of the density, finite where the density itself is zero in float32."""
    return wp.log(vmf_peak(kappa)) - kappa * one_minus_cosine(mu, w)


@wp.func
def vmf_moments(kappa: float) -> wp.vec2:
    """(1 - A, A / kappa), where A = coth(kappa) - 1 / kappa is the mean cosine; (1, 1/3) for kappa = 0.

    1 - A is the mean of h, and d log p / d kappa = 1 - A - h. The series of Langevin's function serves below 1/2, where
    the first term left out is 2e-9; above, 1 - A is 1 / kappa - 2 / (exp(2 kappa) - 1).
    """
    if kappa < 0.5:
        k2 = kappa * kappa
        ratio = 0.33333333 + k2 * (-2.2222222e-2 + k2 * (2.1164021e-3 + k2 * (-2.1164021e-4 + k2 * 2.1377799e-5)))
        return wp.vec2(1.0 - kappa * ratio, ratio)
    e = wp.exp(-2.0 * kappa)
    complement = 1.0 / kappa - 2.0 * e / (1.0 - e)
    return wp.vec2(complement, (1.0 - complement) / kappa)


# --- sampling --------------------------------------------------------------------------------------------------------


@wp.func
def sample_one_minus_cosine(kappa: float, u: float) -> float:
    """h from u in [0, 1): the inverse of the distribution function u = (1 - exp(-kappa h)) / (1 - exp(-2 kappa)).

    Jakob's logarithm is log(1 - u (1 - exp(-2 kappa))). Where it is small it is a `log1p`; where it is large, a sum of
    two numbers that are not negative. So h has all its digits at both ends.
    """
    if kappa < _UNIFORM:
        return 2.0 * u
    e = u * expm1(-2.0 * kappa)
    exponent = 0.0
    if e > -0.5:
        exponent = -log1p(e)
    else:
        exponent = -wp.log((1.0 - u) + u * wp.exp(-2.0 * kappa))
    return wp.min(exponent / kappa, 2.0)


@wp.func
def turn_from_z(mu: wp.vec3, v: wp.vec3) -> wp.vec3:
    """v turned by an isometry that takes +z to the unit vector mu (Householder's reflection, or minus one).

    The mirror is perpendicular to mu + z or mu - z, whichever is longer.
    """
    sign = wp.where(mu[2] < 0.0, -1.0, 1.0)
    a = mu + wp.vec3(0.0, 0.0, sign)
    return (wp.dot(a, v) / (1.0 + wp.abs(mu[2])) * a - v) * sign


@wp.func
def sample_vmf(mu: wp.vec3, kappa: float, u: wp.vec2) -> wp.vec3:
    """A unit vector with density `vmf_pdf`: u[0] gives the angle from mu, nearest first, u[1] the azimuth."""
    h = sample_one_minus_cosine(kappa, u[0])
    r = wp.sqrt(h * (2.0 - h))
    phi = _TWO_PI * u[1]
    return wp.normalize(turn_from_z(mu, wp.vec3(r * wp.cos(phi), r * wp.sin(phi), 1.0 - h)))


# --- product ---------------------------------------------------------------------------------------------------------


@wp.func
def multiply_vmf(mu: wp.vec3, kappa: float, other_mu: wp.vec3, other_kappa: float):
    """The lobe proportional to the product of two.

    The exponents add up: kappa' mu' = kappa mu + other_kappa other_mu, and

        exp(-kappa h) exp(-other_kappa other_h) = exp(-loss) exp(-kappa' h'),    loss = kappa + other_kappa - kappa'.

    The loss is a difference of large numbers; 2 kappa other_kappa h0 / (kappa + other_kappa + kappa'), with h0 of the
    angle between the two, is equal and loses nothing.

    Returns:
        mu', kappa' and loss.
    """
    s = kappa * mu + other_kappa * other_mu
    product_kappa = wp.length(s)
    total = kappa + other_kappa + product_kappa
    loss = 0.0
    if total > 0.0:
        loss = 2.0 * kappa * (other_kappa / total) * one_minus_cosine(mu, other_mu)
    product_mu = mu
    if product_kappa > _UNIFORM:
        product_mu = s / product_kappa
    return product_mu, product_kappa, loss
