"""Maps from the unit square to the shapes that a renderer samples, their densities, and orthonormal bases.

Every map is continuous or piecewise continuous and takes numbers from [0, 1). A density is with respect to the
natural measure of the shape: area, solid angle, or length.
"""

import warp as wp

_INV_PI = wp.constant(0.3183098861837907)
_PI_4 = wp.constant(0.7853981633974483)
_PI_2 = wp.constant(1.5707963267948966)
_TWO_PI = wp.constant(6.283185307179586)
_INV_TWO_PI = wp.constant(0.15915494309189535)
_INV_FOUR_PI = wp.constant(0.07957747154594767)

GAUSSIAN_CUTOFF = wp.constant(4.0)  # standard deviations
_GAUSSIAN_MASS = wp.constant(0.9999366575163338)  # erf(4 / sqrt(2)): mass of a unit normal within the cut-off
_SQRT_2 = wp.constant(1.4142135623730951)
_INV_SQRT_TWO_PI = wp.constant(0.3989422804014327)


# --- disk and hemisphere ---------------------------------------------------------------------------------------------


@wp.func
def _concentric_polar(u: wp.vec2) -> wp.vec2:
    """(signed radius, angle) of the concentric map, Shirley and Chiu 1997, "A Low Distortion Map".

    Squares |x| = r or |y| = r around the centre become circles of radius r. The radius may be negative, which
    saves two of the four cases: (-r, phi) is the point opposite to (r, phi).
    """
    x = 2.0 * u[0] - 1.0
    y = 2.0 * u[1] - 1.0
    radius = 0.0
    phi = 0.0
    if wp.abs(x) > wp.abs(y):
        radius = x
        phi = _PI_4 * (y / x)
    elif y != 0.0:
        radius = y
        phi = _PI_2 - _PI_4 * (x / y)
    return wp.vec2(radius, phi)


@wp.func
def square_to_disk(u: wp.vec2) -> wp.vec2:
    """Uniform on the unit disk (density 1/pi)."""
    polar = _concentric_polar(u)
    return wp.vec2(polar[0] * wp.cos(polar[1]), polar[0] * wp.sin(polar[1]))


@wp.func
def disk_pdf(p: wp.vec2) -> float:
    return wp.where(wp.dot(p, p) <= 1.0, _INV_PI, 0.0)


@wp.func
def square_to_cosine_hemisphere(u: wp.vec2) -> wp.vec3:
    """Density cos(theta)/pi: a uniform point of the disk, lifted to the hemisphere (Malley's method).

    z = sqrt(1 - r^2) uses (1 - r)(1 + r), which keeps its relative precision at grazing angles.
    """
    polar = _concentric_polar(u)
    r = polar[0]
    return wp.vec3(r * wp.cos(polar[1]), r * wp.sin(polar[1]), wp.sqrt(wp.max(0.0, (1.0 - r) * (1.0 + r))))


@wp.func
def cosine_hemisphere_pdf(w: wp.vec3) -> float:
    return wp.max(w[2], 0.0) * _INV_PI


# --- sphere and cone -------------------------------------------------------------------------------------------------


@wp.func
def square_to_sphere(u: wp.vec2) -> wp.vec3:
    """Uniform on the unit sphere: z is uniform in (-1, 1] (Archimedes), and 1 - z^2 = 4 u (1 - u)."""
    r = 2.0 * wp.sqrt(u[0] * (1.0 - u[0]))
    phi = _TWO_PI * u[1]
    return wp.vec3(r * wp.cos(phi), r * wp.sin(phi), 1.0 - 2.0 * u[0])


@wp.func
def sphere_pdf() -> float:
    return _INV_FOUR_PI


@wp.func
def square_to_cone(u: wp.vec2, one_minus_cos_max: float) -> wp.vec3:
    """Uniform in the cone of directions around +z with cos(theta) >= 1 - one_minus_cos_max.

    The cone is given by 1 - cos(theta_max), because the cosine of a small angle is 1 in float32. With
    h = 1 - cos(theta), h is uniform in [0, one_minus_cos_max) and sin^2(theta) = h (2 - h), which loses nothing.
    """
    h = u[0] * one_minus_cos_max
    r = wp.sqrt(wp.max(0.0, h * (2.0 - h)))
    phi = _TWO_PI * u[1]
    return wp.vec3(r * wp.cos(phi), r * wp.sin(phi), 1.0 - h)


@wp.func
def cone_pdf(one_minus_cos_max: float) -> float:
    """Density of any direction inside the cone; its solid angle is 2 pi (1 - cos(theta_max))."""
    return _INV_TWO_PI / one_minus_cos_max


# --- triangle --------------------------------------------------------------------------------------------------------


@wp.func
def square_to_triangle(u: wp.vec2) -> wp.vec2:
    """Barycentric coordinates (b1, b2) of the second and third vertex, uniform over the triangle.

    Turk 1990, "Generating Random Points in Triangles": the distance from the first vertex is a square root.
    """
    root = wp.sqrt(1.0 - u[0])
    return wp.vec2(1.0 - root, u[1] * root)


# --- reconstruction filters ------------------------------------------------------------------------------------------


@wp.func
def sample_tent(u: float) -> float:
    """Density 1 - |x| on [-1, 1]: the CDF is (1 + x)^2 / 2 below zero, and mirrored above."""
    x = 0.0
    if u < 0.5:
        x = wp.sqrt(2.0 * u) - 1.0
    else:
        x = 1.0 - wp.sqrt(2.0 - 2.0 * u)
    return x


@wp.func
def tent_pdf(x: float) -> float:
    return wp.max(0.0, 1.0 - wp.abs(x))


@wp.func
def square_to_tent(u: wp.vec2) -> wp.vec2:
    return wp.vec2(sample_tent(u[0]), sample_tent(u[1]))


@wp.func
def sample_gaussian(u: float) -> float:
    """Unit normal truncated at GAUSSIAN_CUTOFF, by the inverse CDF: x = sqrt(2) erfinv((2 u - 1) erf(4 / sqrt(2)))."""
    x = _SQRT_2 * wp.erfinv((2.0 * u - 1.0) * _GAUSSIAN_MASS)
    return wp.clamp(x, -GAUSSIAN_CUTOFF, GAUSSIAN_CUTOFF)


@wp.func
def gaussian_pdf(x: float) -> float:
    pdf = _INV_SQRT_TWO_PI / _GAUSSIAN_MASS * wp.exp(-0.5 * x * x)
    return wp.where(wp.abs(x) <= GAUSSIAN_CUTOFF, pdf, 0.0)


@wp.func
def square_to_gaussian(u: wp.vec2) -> wp.vec2:
    return wp.vec2(sample_gaussian(u[0]), sample_gaussian(u[1]))


# --- orthonormal bases -----------------------------------------------------------------------------------------------


@wp.func
def orthonormal_basis(n: wp.vec3):
    """Tangents (s, t) that complete the unit vector n to a right-handed basis (s, t, n).

    Duff et al. 2017, "Building an Orthonormal Basis, Revisited": Frisvad's formula, mirrored for n.z < 0, where it
    would lose all precision near n.z = -1.
    """
    sign = wp.where(n[2] < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    s = wp.vec3(1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0])
    t = wp.vec3(b, sign + n[1] * n[1] * a, -n[1])
    return s, t


@wp.func
def to_local(s: wp.vec3, t: wp.vec3, n: wp.vec3, v: wp.vec3) -> wp.vec3:
    """Coordinates of v in the basis (s, t, n)."""
    return wp.vec3(wp.dot(v, s), wp.dot(v, t), wp.dot(v, n))


@wp.func
def to_world(s: wp.vec3, t: wp.vec3, n: wp.vec3, v: wp.vec3) -> wp.vec3:
    """The vector whose coordinates in the basis (s, t, n) are v."""
    return v[0] * s + v[1] * t + v[2] * n
