"""Maps from the unit square to the shapes that a renderer samples, their densities, and orthonormal bases.

Every map is continuous or piecewise continuous and takes numbers from [0, 1). A density is with respect to the
natural measure of the shape: area, solid angle, or length.
"""

import warp as wp

_INV_PI = wp.constant(0.3183098861837907)
_INV_TWO_PI = wp.constant(0.15915494309189535)
_INV_FOUR_PI = wp.constant(0.07957747154594767)

GAUSSIAN_CUTOFF = wp.constant(4.0)  # standard deviations
_GAUSSIAN_MASS = wp.constant(0.9999366575163338)  # erf(4 / sqrt(2)): mass of a unit normal within the cut-off
_SQRT_2 = wp.constant(1.4142135623730951)
_INV_SQRT_TWO_PI = wp.constant(0.3989422804014327)


# --- disk and hemisphere ---------------------------------------------------------------------------------------------


@wp.func
def _eighth(x: float) -> wp.vec2:
    """Cosine and sine of x pi/4, |x| <= 1, to 1.3e-7 of each.

    Polynomials fitted for the least largest relative error: the C library reduces any angle first, which takes longer.
    """
    y = x * x
    cosine = 1.0 + y * (-0.308425138 + y * (0.01585434923 + y * (-0.0003259889861 + y * 3.559581927e-06)))
    sine = x * (0.7853981609 + y * (-0.08074543253 + y * (0.002490001024 + y * -3.595045224e-05)))
    return wp.vec2(cosine, sine)


@wp.func
def unit_circle(u: float) -> wp.vec2:
    """Cosine and sine of 2 pi u, u in [0, 1]."""
    quarters = wp.floor(4.0 * u + 0.5)
    p = _eighth(2.0 * (4.0 * u - quarters))  # exactly the rest
    turns = int(quarters)
    if turns % 2 == 1:
        p = wp.vec2(-p[1], p[0])
    return wp.where(turns == 2 or turns == 3, -p, p)


@wp.func
def _concentric(u: wp.vec2) -> wp.vec3:
    """Point of the disk and its signed radius by the concentric map, Shirley and Chiu 1997, "A Low Distortion Map".

    Squares |x| = r or |y| = r around the centre become circles of radius r. The radius may be negative, which
    saves two of the four cases: (-r, phi) is the point opposite to (r, phi). The angle is pi/4 times the ratio of the
    coordinates, from the axis of the greater one.
    """
    x = 2.0 * u[0] - 1.0
    y = 2.0 * u[1] - 1.0
    along_x = wp.abs(x) > wp.abs(y)
    radius = wp.where(along_x, x, y)
    other = wp.where(along_x, y, x)
    p = radius * _eighth(other / wp.where(radius == 0.0, 1.0, radius))
    return wp.where(along_x, wp.vec3(p[0], p[1], radius), wp.vec3(p[1], p[0], radius))


@wp.func
def square_to_disk(u: wp.vec2) -> wp.vec2:
    """Uniform on the unit disk (density 1/pi)."""
    p = _concentric(u)
    return wp.vec2(p[0], p[1])


@wp.func
def disk_pdf(p: wp.vec2) -> float:
    return wp.where(wp.dot(p, p) <= 1.0, _INV_PI, 0.0)


@wp.func
def square_to_cosine_hemisphere(u: wp.vec2) -> wp.vec3:
    """Density cos(theta)/pi: a uniform point of the disk, lifted to the hemisphere (Malley's method).

    z = sqrt(1 - r^2) uses (1 - r)(1 + r), which keeps its relative precision at grazing angles.
    """
    p = _concentric(u)
    return wp.vec3(p[0], p[1], wp.sqrt((1.0 - p[2]) * (1.0 + p[2])))


@wp.func
def cosine_hemisphere_pdf(w: wp.vec3) -> float:
    return wp.max(w[2], 0.0) * _INV_PI


# --- sphere and cone -------------------------------------------------------------------------------------------------


@wp.func
def square_to_sphere(u: wp.vec2) -> wp.vec3:
    """Uniform on the unit sphere: z is uniform in (-1, 1] (Archimedes), and 1 - z^2 = 4 u (1 - u)."""
    r = 2.0 * wp.sqrt(u[0] * (1.0 - u[0]))
    p = r * unit_circle(u[1])
    return wp.vec3(p[0], p[1], 1.0 - 2.0 * u[0])


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
    p = r * unit_circle(u[1])
    return wp.vec3(p[0], p[1], 1.0 - h)


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
