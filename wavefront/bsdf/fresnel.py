"""Fresnel reflectance for unpolarised light.

Both functions are rearranged so that no difference of nearly equal numbers is left: float32 results are good to
a few units in the last place also for eta close to 1, at grazing angles and for strongly absorbing metals.
"""

import warp as wp


@wp.struct
class FresnelDielectric:
    """Reflectance at a smooth boundary and where the refracted ray goes."""

    reflectance: float
    transmittance: float  # 1 - reflectance, to full relative precision also where nearly everything is reflected
    cos_t: float  # cosine of the transmitted direction, of the other sign than cos_i; 0 under total reflection
    eta: float  # n_transmitted / n_incident
    inv_eta: float


@wp.func
def fresnel_refracting(c: float, p: float, n: float, e: float) -> wp.vec2:
    """(reflectance, transmittance) of a ray that refracts: c = |cos_i|, p = n |cos_t| > 0, n = n_t / n_i, e = n^2 - 1.

    The amplitudes are r_s = (c - p) / (c + p) and r_p = (n^2 c - p) / (n^2 c + p). Snell's law says p^2 - c^2 = e, so
    both numerators have the factor e, which is taken out exactly:
        r_s = -e / (c + p)^2                r_p = e (c (c + p) - 1) / ((c + p) (n^2 c + p)).
    What is not reflected is 1 - r_s^2 = 4 c p / (c + p)^2 and 1 - r_p^2 = 4 n^2 c p / (n^2 c + p)^2.
    """
    s = c + p
    q = n * n * c + p
    r_s = e / (s * s)
    r_p = e * (c * s - 1.0) / (s * q)
    t = 2.0 * c * p * (1.0 / (s * s) + n * n / (q * q))
    return wp.vec2(wp.min(0.5 * (r_s * r_s + r_p * r_p), 1.0), wp.min(t, 1.0))


@wp.func
def fresnel_dielectric(cos_i: float, eta: float) -> FresnelDielectric:
    """Fresnel's equations for a boundary with relative index eta = n_below / n_above; cos_i < 0 comes from below.

    With n = n_t / n_i, Snell's law is p^2 = n^2 - 1 + c^2, negative under total reflection.
    """
    result = FresnelDielectric()
    c = wp.abs(cos_i)
    n = float(eta)
    e = (eta - 1.0) * (eta + 1.0)
    if cos_i < 0.0:
        n = 1.0 / eta
        e = -e * n * n
    result.eta = n
    result.inv_eta = 1.0 / n
    if e == 0.0:
        # No boundary at all: everything passes straight on, at every angle.
        result.reflectance = 0.0
        result.transmittance = 1.0
        result.cos_t = -cos_i
    else:
        p2 = e + c * c
        if p2 <= 0.0:
            result.reflectance = 1.0
            result.transmittance = 0.0
            result.cos_t = 0.0
        else:
            p = wp.sqrt(p2)
            split = fresnel_refracting(c, p, n, e)
            result.reflectance = split[0]
            result.transmittance = split[1]
            result.cos_t = wp.where(cos_i < 0.0, p, -p) / n
    return result


@wp.func
def fresnel_conductor_scalar(c: float, eta: float, k: float) -> float:
    """Reflectance of a metal with complex index eta + i k, seen from vacuum at cos(theta) = c >= 0.

    Born and Wolf, section 14.2; with s2 = sin^2, the real part `a` of sqrt((eta + i k)^2 - s2) follows from
        t = eta^2 - k^2 - s2,    m = |(eta + i k)^2 - s2| = sqrt(t^2 + 4 eta^2 k^2),    2 a^2 = m + t,
    where for t < 0 the sum cancels and 2 a^2 = 4 eta^2 k^2 / (m - t) is used instead. Then
        R_s = (m + c^2 - 2 a c) / (m + c^2 + 2 a c)
        R_p = R_s (m c^2 + s2^2 - 2 a c s2) / (m c^2 + s2^2 + 2 a c s2).
    """
    c2 = c * c
    s2 = wp.max(0.0, 1.0 - c2)
    t = (eta - k) * (eta + k) - s2
    ek2 = 4.0 * eta * eta * k * k
    m = wp.sqrt(t * t + ek2)
    a2 = 0.0
    if t >= 0.0:
        a2 = 0.5 * (m + t)
    elif ek2 > 0.0:
        a2 = 0.5 * ek2 / (m - t)
    ac2 = 2.0 * wp.sqrt(a2) * c
    # A denominator vanishes only with its numerator: eta = 1, k = 0 at c = 0, or eta = k = 0 at c = 1. The limits are
    # those of total reflection.
    r_s = 1.0
    d_s = m + c2 + ac2
    if d_s > 0.0:
        r_s = (m + c2 - ac2) / d_s
    r_p = 1.0
    n_p = m * c2 + s2 * s2
    d_p = n_p + ac2 * s2
    if d_p > 0.0:
        r_p = (n_p - ac2 * s2) / d_p
    return wp.clamp(0.5 * r_s * (1.0 + r_p), 0.0, 1.0)


@wp.func
def fresnel_conductor(cos_i: float, eta: wp.vec3, k: wp.vec3) -> wp.vec3:
    """Reflectance of a metal per colour channel; the metal is opaque, so only |cos_i| matters."""
    c = wp.abs(cos_i)
    return wp.vec3(
        fresnel_conductor_scalar(c, eta[0], k[0]),
        fresnel_conductor_scalar(c, eta[1], k[1]),
        fresnel_conductor_scalar(c, eta[2], k[2]),
    )
