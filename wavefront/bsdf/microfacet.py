"""Microfacet distributions: GGX and Beckmann with Smith's shadowing, sampled by visible normals.

Walter et al. 2007, "Microfacet Models for Refraction through Rough Surfaces"; Heitz 2014, "Understanding the
Masking-Shadowing Function in Microfacet-Based BRDFs". `alpha` is the roughness along x and along y: every function
takes the surface for one of alpha = 1 stretched by alpha (Heitz 2014, section 5.3). `m` is a microfacet normal with
m.z > 0, and `w` a direction above the macroscopic surface (w.z > 0). All squares of sines come from x and y, never
from 1 - z^2, which is 0 in float32 for the slopes of a lobe with alpha < 3e-4.
"""

import warp as wp

from wavefront.warp_samples import unit_circle

DISTRIBUTION_GGX = wp.constant(0)
DISTRIBUTION_BECKMANN = wp.constant(1)

_INV_PI = wp.constant(0.3183098861837907)
_INV_SQRT_PI = wp.constant(0.5641895835477563)
_STEP = wp.constant(5.9604644775390625e-8)  # 2^-24, the spacing of 24-bit uniform numbers
_MAX_ITERATIONS = wp.constant(16)


# --- distribution of normals -----------------------------------------------------------------------------------------


@wp.func
def microfacet_d(m: wp.vec3, alpha: wp.vec2, distribution: int) -> float:
    """Density D(m) of normals: the integral of D(m) m.z over the hemisphere is one.

    With the stretched slope s^2 = (x / alpha.x)^2 + (y / alpha.y)^2
        GGX       D = 1 / (pi alpha.x alpha.y (z^2 + s^2)^2)
        Beckmann  D = exp(-s^2 / z^2) / (pi alpha.x alpha.y z^4)
    """
    d = 0.0
    if m[2] > 0.0:
        inv_area = 1.0 / (alpha[0] * alpha[1])
        x = m[0] / alpha[0]
        y = m[1] / alpha[1]
        slope2 = x * x + y * y
        cos2 = m[2] * m[2]
        if distribution == DISTRIBUTION_GGX:
            r = cos2 + slope2
            d = _INV_PI * inv_area / (r * r)
        else:
            # At the horizon the exponential is 0 long before the floor acts, and 0 / 0 must not arise.
            cos2 = wp.max(cos2, 1.0e-12)
            d = _INV_PI * inv_area * wp.exp(-slope2 / cos2) / (cos2 * cos2)
    return d


# --- masking ---------------------------------------------------------------------------------------------------------


@wp.func
def smith_g1_over_cos(w: wp.vec3, alpha: wp.vec2, distribution: int) -> float:
    """G1(w) / |w.z|: finite at grazing angles, where densities need it. The caller checks that w sees the microfacet.

    With z = |w.z|, s the length of (alpha.x w.x, alpha.y w.y) and a = z / s, Smith's G1 = 1 / (1 + Lambda(a)) is
        GGX       G1 = 2 z / (z + sqrt(z^2 + s^2))
        Beckmann  G1 = 2 z / (z (1 + erf(a)) + s exp(-a^2) / sqrt(pi)).
    """
    z = wp.abs(w[2])
    x = alpha[0] * w[0]
    y = alpha[1] * w[1]
    s2 = x * x + y * y
    denominator = 0.0
    if distribution == DISTRIBUTION_GGX:
        denominator = z + wp.sqrt(z * z + s2)
    else:
        s = wp.sqrt(s2)
        if z < 6.0 * s:
            a = z / s
            denominator = z * (1.0 + wp.erf(a)) + s * wp.exp(-a * a) * _INV_SQRT_PI
        else:
            denominator = 2.0 * z  # erf(6) rounds to 1, and the other term is below 1e-16 of this one
    return 2.0 / denominator


@wp.func
def smith_g1(w: wp.vec3, alpha: wp.vec2, distribution: int) -> float:
    """Fraction of the microfacets facing w that w sees. The caller checks that w sees the front of the microfacet."""
    return wp.min(wp.abs(w[2]) * smith_g1_over_cos(w, alpha, distribution), 1.0)


# --- visible normals -------------------------------------------------------------------------------------------------


@wp.func
def visible_normal_pdf(wo: wp.vec3, m: wp.vec3, alpha: wp.vec2, distribution: int) -> float:
    """Density of the normals seen from wo: D(m) G1(wo) max(0, wo.m) / wo.z (Heitz and d'Eon 2014), wo.z > 0."""
    return (
        microfacet_d(m, alpha, distribution) * smith_g1_over_cos(wo, alpha, distribution) * wp.max(0.0, wp.dot(wo, m))
    )


@wp.func
def _sample_visible_ggx(wo: wp.vec3, alpha: wp.vec2, u: wp.vec2) -> wp.vec3:
    """Dupuy and Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps".

    Scaling x and y by alpha turns the surface into a hemisphere, w = wo scaled and normalised. Rays along -w that
    reflect from it leave uniformly in the spherical cap z > -w.z, so a uniform direction c of the cap gives the
    normal h = c + w. In the cap c.z = (1 - u)(1 + w.z) - w.z; written so, h.z and sin^2(c) are free of cancellation:
        h.z = (1 - u)(1 + w.z),   1 - c.z = u (1 + w.z),   1 + c.z = h.z + (1 - w.z),   1 - w.z = s^2 / (1 + w.z).
    """
    w = wp.normalize(wp.vec3(alpha[0] * wo[0], alpha[1] * wo[1], wo[2]))
    one_plus_z = 1.0 + w[2]
    one_minus_z = (w[0] * w[0] + w[1] * w[1]) / one_plus_z
    h_z = (1.0 - u[1]) * one_plus_z
    sin_c = wp.sqrt(u[1] * one_plus_z * (h_z + one_minus_z))
    h = sin_c * unit_circle(u[0]) + wp.vec2(w[0], w[1])
    return wp.normalize(wp.vec3(alpha[0] * h[0], alpha[1] * h[1], h_z))


@wp.func
def visible_beckmann_slope(z: float, s: float, u: float) -> float:
    """Slope x, towards the viewer, of a visible normal of a Beckmann surface with alpha = 1.

    The viewer is at (s, 0, z). A normal (-x, -y, 1) has density exp(-x^2 - y^2) / pi in slopes and is seen with
    weight max(0, z - s x), so x <= a = z / s, and the CDF of x, not yet normalised, is (the derivative of
    exp(-x^2) is -2 x exp(-x^2))
        C(x) = z (1 + erf(x)) + s exp(-x^2) / sqrt(pi),   C(a) = 2 z / G1.
    It is inverted in the variable q = 1 + erf(x) = erfc(-x), in which dC/dq = z - s x: C is increasing and concave
    in q, linear at normal incidence, and q in [0, 1 + erf(a)] always brackets the root. Newton's method approaches a
    root of a concave function from the left without overshooting; a step that leaves the bracket is replaced by
    bisection.
    """
    q_max = 2.0
    total = 2.0 * z
    if z < 6.0 * s:
        a = z / s
        erf_a = wp.erf(a)
        q_max = 1.0 + erf_a
        total = z * q_max + s * wp.exp(-a * a) * _INV_SQRT_PI
    target = u * total
    low = wp.float32(0.0)
    high = wp.float32(q_max)
    # Start between the limits: q = 2 u at normal incidence, and exp(-x^2) = u at grazing incidence.
    grazing = wp.erfc(wp.sqrt(-wp.log(u)))
    q = wp.lerp(grazing, u * q_max, z * q_max / total)
    x = wp.float32(0.0)
    for _ in range(_MAX_ITERATIONS):
        x = -wp.erfcinv(q)
        error = z * q + s * wp.exp(-x * x) * _INV_SQRT_PI - target
        if wp.abs(error) <= 1.0e-6 * target:
            break
        if error < 0.0:
            low = q
        else:
            high = q
        q = q - error / (z - s * x)
        if not (q > low and q < high):
            q = 0.5 * (low + high)
    return x


@wp.func
def _sample_visible_beckmann(wo: wp.vec3, alpha: wp.vec2, u: wp.vec2) -> wp.vec3:
    """Stretches the surface to alpha = 1, samples the two slopes, rotates them to wo's azimuth, and scales back.

    The slope across the viewing direction is an independent normal variable: its CDF is (1 + erf(y)) / 2. Numbers
    are taken at the centre of their interval of width 2^-24, since 0 would be an infinite slope.
    """
    o_x = alpha[0] * wo[0]
    o_y = alpha[1] * wo[1]
    s = wp.sqrt(o_x * o_x + o_y * o_y)
    cos_phi = 1.0
    sin_phi = 0.0
    if s > 0.0:
        cos_phi = o_x / s
        sin_phi = o_y / s
    length = wp.sqrt(s * s + wo[2] * wo[2])
    x = visible_beckmann_slope(wo[2] / length, s / length, wp.min(u[0] + 0.5 * _STEP, 1.0 - _STEP))
    y = wp.erfinv(2.0 * u[1] - 1.0 + _STEP)
    slope_x = alpha[0] * (cos_phi * x - sin_phi * y)
    slope_y = alpha[1] * (sin_phi * x + cos_phi * y)
    return wp.normalize(wp.vec3(-slope_x, -slope_y, 1.0))


@wp.func
def sample_visible_normal(wo: wp.vec3, alpha: wp.vec2, distribution: int, u: wp.vec2) -> wp.vec3:
    """A normal with density visible_normal_pdf, for wo.z > 0."""
    m = wp.vec3(0.0, 0.0, 1.0)
    if distribution == DISTRIBUTION_GGX:
        m = _sample_visible_ggx(wo, alpha, u)
    else:
        m = _sample_visible_beckmann(wo, alpha, u)
    return m
