"""Every map against its density, the ends of the unit interval, and orthonormal bases."""

import numpy as np
import pytest
import warp as wp

from tests.chi_square import cell_sums, histogram, nodes, p_value, sidak
from wavefront import warp_samples as ws

DEVICE = "cpu"
SHAPE = (31, 17)
PER_CELL = 4
N = 200_000
ENDS = [0.0, 2.0**-24, 0.25, 0.5, 0.75, 1.0 - 2.0**-24]
TINY_CONE = 1e-12  # a sun of 1e-6 rad; its cosine is 1 in float32
CONES = [TINY_CONE, 1e-5, 0.3, 1.0, 2.0]

DISK, HEMISPHERE, SPHERE, CONE, TRIANGLE, TENT, GAUSSIAN = range(7)


@wp.kernel(enable_backward=False, module="unique")
def map_kernel(kind: int, u: wp.array(dtype=wp.vec2), parameter: float, result: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    p = wp.vec2(0.0, 0.0)
    if kind == wp.static(DISK):
        p = ws.square_to_disk(u[i])
    elif kind == wp.static(TRIANGLE):
        p = ws.square_to_triangle(u[i])
    elif kind == wp.static(TENT):
        p = ws.square_to_tent(u[i])
    elif kind == wp.static(GAUSSIAN):
        p = ws.square_to_gaussian(u[i])
    w = wp.vec3(p[0], p[1], 0.0)
    if kind == wp.static(HEMISPHERE):
        w = ws.square_to_cosine_hemisphere(u[i])
    elif kind == wp.static(SPHERE):
        w = ws.square_to_sphere(u[i])
    elif kind == wp.static(CONE):
        w = ws.square_to_cone(u[i], parameter)
    result[i] = w


@wp.kernel(enable_backward=False, module="unique")
def pdf_kernel(kind: int, x: wp.array(dtype=wp.vec3), parameter: float, result: wp.array(dtype=float)):
    i = wp.tid()
    v = x[i]
    pdf = 2.0  # triangle: barycentric coordinates have area 1/2
    if kind == wp.static(DISK):
        pdf = ws.disk_pdf(wp.vec2(v[0], v[1]))
    elif kind == wp.static(HEMISPHERE):
        pdf = ws.cosine_hemisphere_pdf(v)
    elif kind == wp.static(SPHERE):
        pdf = ws.sphere_pdf()
    elif kind == wp.static(CONE):
        pdf = ws.cone_pdf(parameter)
    elif kind == wp.static(TENT):
        pdf = ws.tent_pdf(v[0]) * ws.tent_pdf(v[1])
    elif kind == wp.static(GAUSSIAN):
        pdf = ws.gaussian_pdf(v[0]) * ws.gaussian_pdf(v[1])
    result[i] = pdf


@wp.kernel(enable_backward=False, module="unique")
def basis_kernel(
    n: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    # outputs
    s_out: wp.array(dtype=wp.vec3),
    t_out: wp.array(dtype=wp.vec3),
    local: wp.array(dtype=wp.vec3),
    back: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    s, t = ws.orthonormal_basis(n[i])
    s_out[i] = s
    t_out[i] = t
    local[i] = ws.to_local(s, t, n[i], v[i])
    back[i] = ws.to_world(s, t, n[i], local[i])


def apply_map(kind: int, u: np.ndarray, parameter: float = 0.0) -> np.ndarray:
    result = wp.empty(len(u), dtype=wp.vec3, device=DEVICE)
    inputs = [kind, wp.array(u, dtype=wp.vec2, device=DEVICE), parameter]
    wp.launch(map_kernel, dim=len(u), inputs=inputs, outputs=[result], device=DEVICE)
    return result.numpy().astype(np.float64)


def density(kind: int, x: np.ndarray, parameter: float = 0.0) -> np.ndarray:
    result = wp.empty(len(x), dtype=float, device=DEVICE)
    inputs = [kind, wp.array(np.asarray(x, dtype=np.float32), dtype=wp.vec3, device=DEVICE), parameter]
    wp.launch(pdf_kernel, dim=len(x), inputs=inputs, outputs=[result], device=DEVICE)
    return result.numpy().astype(np.float64)


def uniforms(seed: int) -> np.ndarray:
    return (np.random.default_rng(seed).integers(0, 2**24, size=(N, 2)) * 2.0**-24).astype(np.float32)


# A chart turns points of the shape into the unit square (to test in cells), and back with its Jacobian.


def _azimuth(x, y):
    return np.mod(np.arctan2(y, x) / (2.0 * np.pi), 1.0)


def chart(kind: int, x: np.ndarray, parameter: float) -> tuple[np.ndarray, np.ndarray]:
    if kind == DISK:
        return np.hypot(x[:, 0], x[:, 1]), _azimuth(x[:, 0], x[:, 1])
    if kind == HEMISPHERE:
        return x[:, 2], _azimuth(x[:, 0], x[:, 1])
    if kind == SPHERE:
        return (x[:, 2] + 1.0) / 2.0, _azimuth(x[:, 0], x[:, 1])
    if kind == CONE:
        h = (x[:, 0] ** 2 + x[:, 1] ** 2) / (1.0 + x[:, 2]) if parameter < 1.0 else 1.0 - x[:, 2]
        return h / (parameter * (1.0 + 1e-6)), _azimuth(x[:, 0], x[:, 1])
    if kind == TRIANGLE:
        rest = 1.0 - x[:, 0]
        return x[:, 0], x[:, 1] / np.maximum(rest, 1e-12)
    radius = 1.0 if kind == TENT else 4.0
    return (x[:, 0] / radius + 1.0) / 2.0, (x[:, 1] / radius + 1.0) / 2.0


def inverse_chart(kind: int, a: np.ndarray, b: np.ndarray, parameter: float) -> tuple[np.ndarray, np.ndarray]:
    """Points, and area (or solid angle) per area of the unit square."""
    phi = 2.0 * np.pi * b
    zero = np.zeros_like(a)
    if kind == DISK:
        return np.stack([a * np.cos(phi), a * np.sin(phi), zero], axis=1), 2.0 * np.pi * a
    if kind in (HEMISPHERE, SPHERE, CONE):
        z, scale = {HEMISPHERE: (a, 1.0), SPHERE: (2.0 * a - 1.0, 2.0), CONE: (1.0 - parameter * a, parameter)}[kind]
        r = np.sqrt(1.0 - z * z)
        return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1), np.full_like(a, 2.0 * np.pi * scale)
    if kind == TRIANGLE:
        return np.stack([a, b * (1.0 - a), zero], axis=1), 1.0 - a
    radius = 1.0 if kind == TENT else 4.0
    x = np.stack([radius * (2.0 * a - 1.0), radius * (2.0 * b - 1.0), zero], axis=1)
    return x, np.full_like(a, 4.0 * radius * radius)


CASES = [(kind, 0.0) for kind in (DISK, HEMISPHERE, SPHERE, TRIANGLE, TENT, GAUSSIAN)] + [(CONE, c) for c in CONES]


@pytest.mark.parametrize(("kind", "parameter"), CASES)
def test_samples_follow_the_density(kind, parameter):
    a, b, area = nodes(SHAPE, PER_CELL)
    points, jacobian = inverse_chart(kind, a, b, parameter)
    expected = cell_sums(density(kind, points, parameter) * jacobian * area, SHAPE, PER_CELL)
    assert expected.sum() == pytest.approx(1.0, abs=2e-3)
    expected /= expected.sum()  # quadrature error; the integral itself was tested above
    samples = apply_map(kind, uniforms(kind), parameter)
    counts = histogram(*chart(kind, samples, parameter), SHAPE)
    assert counts[-1] == 0
    assert p_value(counts, expected) > sidak(len(CASES))


@pytest.mark.parametrize(("kind", "parameter"), CASES)
def test_ends_of_the_unit_interval(kind, parameter):
    u = np.array([(a, b) for a in ENDS for b in ENDS], dtype=np.float32)
    x = apply_map(kind, u, parameter)
    assert np.all(np.isfinite(x))
    if kind in (HEMISPHERE, SPHERE, CONE):
        np.testing.assert_allclose(np.linalg.norm(x, axis=1), 1.0, atol=3e-7)
    pdf = density(kind, x, parameter)
    assert np.all(np.isfinite(pdf))
    assert np.all(pdf >= 0.0)
    bound = {TENT: 1.0, GAUSSIAN: 4.0, DISK: 1.0 + 1e-6}.get(kind)
    if bound is not None:
        assert np.all(np.abs(x) <= bound)
    if kind == HEMISPHERE:
        assert np.all(x[:, 2] >= 0.0)
    if kind == TRIANGLE:
        assert np.all(x >= 0.0)
        assert np.all(x[:, 0] + x[:, 1] <= 1.0 + 1e-7)


@wp.kernel(enable_backward=False, module="unique")
def circle_kernel(u: wp.array(dtype=float), result: wp.array(dtype=wp.vec2)):
    i = wp.tid()
    result[i] = ws.unit_circle(u[i])


def test_unit_circle():
    """Against float64; the quarters are exact, and small sines keep their relative precision."""
    u = np.concatenate([np.linspace(0.0, 1.0, 1 << 16), np.arange(9) / 8.0, 10.0 ** np.linspace(-40.0, 0.0, 1000)])
    u = u.astype(np.float32)
    result = wp.zeros(len(u), dtype=wp.vec2, device=DEVICE)
    wp.launch(circle_kernel, dim=len(u), inputs=[wp.array(u, device=DEVICE)], outputs=[result], device=DEVICE)
    angle = 2.0 * np.pi * u.astype(np.float64)
    found = result.numpy().astype(np.float64)
    np.testing.assert_allclose(found, np.stack([np.cos(angle), np.sin(angle)], axis=1), rtol=0.0, atol=1.0e-7)
    small = (u > 1e-37) & (u < 0.1)
    np.testing.assert_allclose(found[small, 1], np.sin(angle[small]), rtol=2.0e-7)
    quarters = np.float32([0.0, 0.25, 0.5, 0.75, 1.0])
    exact = found[np.searchsorted(u[1 << 16 : (1 << 16) + 9], quarters) + (1 << 16)]
    np.testing.assert_array_equal(exact, [[1, 0], [0, 1], [-1, 0], [0, -1], [1, 0]])


def test_tiny_cone_spreads_over_its_disk():
    """At 1e-6 rad the sine is the angle: its square is uniform up to 2 (1 - cos)."""
    x = apply_map(CONE, uniforms(5), TINY_CONE)
    r2 = x[:, 0] ** 2 + x[:, 1] ** 2
    assert r2.max() == pytest.approx(2.0 * TINY_CONE, rel=1e-3)
    assert r2.mean() == pytest.approx(TINY_CONE, rel=6.0 / np.sqrt(3.0 * N))  # six standard errors


def test_orthonormal_basis():
    rng = np.random.default_rng(3)
    n = rng.normal(size=(20_000, 3))
    n[:2_000, :2] *= 10.0 ** rng.uniform(-8.0, 0.0, size=(2_000, 1))  # around the poles
    n = np.concatenate([n, np.eye(3), -np.eye(3), [[1e-20, 0.0, -1.0], [0.0, 1.0, -0.0], [1.0, 0.0, -1e-30]]])
    n = (n / np.linalg.norm(n, axis=1, keepdims=True)).astype(np.float32)
    v = rng.normal(size=n.shape).astype(np.float32)
    arrays = [wp.empty(len(n), dtype=wp.vec3, device=DEVICE) for _ in range(4)]
    inputs = [wp.array(a, dtype=wp.vec3, device=DEVICE) for a in (n, v)]
    wp.launch(basis_kernel, dim=len(n), inputs=inputs, outputs=arrays, device=DEVICE)
    s, t, local, back = (a.numpy().astype(np.float64) for a in arrays)
    basis = np.stack([s, t, n.astype(np.float64)], axis=1)
    identity = np.broadcast_to(np.eye(3), basis.shape)
    np.testing.assert_allclose(basis @ basis.transpose(0, 2, 1), identity, atol=6e-7)
    np.testing.assert_allclose(np.linalg.det(basis), 1.0, atol=1e-6)  # right-handed
    np.testing.assert_allclose(local, np.einsum("nij,nj->ni", basis, v), atol=2e-6)
    np.testing.assert_allclose(back, v, atol=3e-6)
