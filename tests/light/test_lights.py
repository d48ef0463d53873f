"""Light selection and sampling: exact probabilities, solid angles in closed form, and densities that agree."""

import functools

import msgspec
import numpy as np
import pytest
import warp as wp
from scipy import stats

from tests.chi_square import FALSE_ALARM_RATE, p_value, sidak
from wavefront.accel.geometry import Geometry
from wavefront.accel.intersector import make_intersector
from wavefront.light.sampling import LightSample, make_light_sampler, select_light
from wavefront.light.tables import Light, LightTables, build_alias_table
from wavefront.scene import description as d
from wavefront.scene.device import upload_scene
from wavefront.surface import make_vertex
from wavefront.texture import TextureTables

DEVICE = "cpu"
N = 100_000
ULP = 2.0**-24

closest_hit, occluded = make_intersector(True, True)[:2]
vertex_of = make_vertex(True, True, True, False, False, False)
sample_light, light_pdf = make_light_sampler(("constant", "sphere", "triangle"), ())


@wp.kernel(enable_backward=False, module="unique")
def select_kernel(
    lights: LightTables,
    first: int,
    # outputs
    counts: wp.array(dtype=wp.int32),
):
    """Every number that the renderer can draw, once: an exact distribution instead of a sample of it."""
    wp.atomic_add(counts, select_light(lights, float(first + wp.tid()) * 5.9604644775390625e-8), 1)


@wp.kernel(enable_backward=False, module="unique")
def choose_kernel(
    lights: LightTables,
    u: wp.array(dtype=float),
    # outputs
    counts: wp.array(dtype=wp.int32),
):
    wp.atomic_add(counts, select_light(lights, u[wp.tid()]), 1)


@wp.kernel(enable_backward=False, module="unique")
def sample_kernel(
    geometry: Geometry,
    lights: LightTables,
    textures: TextureTables,
    p: wp.array(dtype=wp.vec3),
    u: wp.array(dtype=wp.vec4),
    # outputs
    samples: wp.array(dtype=LightSample),
    traced_pdf: wp.array(dtype=float),
    blocked: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    s = sample_light(lights, geometry, textures, p[i], u[i])
    samples[i] = s
    traced_pdf[i] = -1.0
    if s.pdf <= 0.0:
        return
    # What the emission stage will compute for a path that takes the same direction by itself.
    hit = closest_hit(geometry, p[i], s.wi)
    if hit.primitive >= 0:
        vertex = vertex_of(geometry, p[i], s.wi, hit)
        shape = geometry.shapes[geometry.shape_of[hit.primitive]]
        light = shape.first_light + hit.primitive - shape.first_primitive
        traced_pdf[i] = light_pdf(lights, geometry, light, p[i], s.wi, vertex.position, vertex.geometric_normal)
    direction = wp.where(s.t_max < 2.0, s.target - p[i], s.wi)
    if occluded(geometry, p[i], direction, s.t_max):
        blocked[i] = 1


def uniforms(n, seed):
    return (np.random.default_rng(seed).integers(0, 2**24, (n, 4)) * ULP).astype(np.float32)


# The kernel knows both kinds of primitive, so a scene has both: black ones out of the way.
OTHERS = [
    d.Sphere(center=(0.0, -1e5, -1e6), radius=1e-3),
    d.Mesh(vertices=[(0.0, -2e5, -1e6), (0.0, -2e5, -1e6 + 1), (1.0, -2e5, -1e6)], faces=[(0, 1, 2)]),
]


def run(scene, p, u):
    device_scene = upload_scene(msgspec.structs.replace(scene, shapes=scene.shapes + OTHERS), DEVICE)
    n = len(u)
    p = np.ascontiguousarray(np.broadcast_to(np.asarray(p, np.float32), (n, 3)))
    samples = wp.zeros(n, dtype=LightSample, device=DEVICE)
    pdf, blocked = wp.zeros(n, dtype=float, device=DEVICE), wp.zeros(n, dtype=wp.int32, device=DEVICE)
    p, u = wp.array(p, dtype=wp.vec3, device=DEVICE), wp.array(u, dtype=wp.vec4, device=DEVICE)
    inputs = [device_scene.geometry, device_scene.lights, device_scene.textures, p, u]
    wp.launch(sample_kernel, dim=n, inputs=inputs, outputs=[samples, pdf, blocked], device=DEVICE)
    return samples.numpy(), pdf.numpy(), blocked.numpy()


LIGHT = d.Area(radiance=[1.0, 2.0, 3.0])


def triangle(*corners):
    return d.Mesh(vertices=[tuple(map(float, c)) for c in corners], faces=[(0, 1, 2)], emitter=LIGHT)


def sphere(center, radius, inwards=False):
    return d.Sphere(center=tuple(map(float, center)), radius=radius, flip_normals=inwards, emitter=LIGHT)


def triangle_solid_angle(corners, p):
    """Van Oosterom and Strackee 1983, for the front; zero from behind."""
    a, b, c = (np.asarray(x, np.float64) - p for x in corners)
    la, lb, lc = (np.linalg.norm(x) for x in (a, b, c))
    numerator = -np.dot(a, np.cross(b, c))
    denominator = la * lb * lc + a @ b * lc + a @ c * lb + b @ c * la
    return max(0.0, 2.0 * np.arctan2(numerator, denominator))


# --- selection ---------------------------------------------------------------------------------------------------

POWERS = {
    "one": np.array([3.0]),
    "two": np.array([1.0, 1e-3]),
    "equal": np.ones(7),
    "some black": np.array([0.0, 2.0, 0.0, 1.0, 0.0, 5.0, 0.0]),
    "first and last black": np.array([0.0, *np.ones(30), 0.0]),
    "wide range": 10.0 ** np.linspace(-20.0, 20.0, 41),
    "many": np.random.default_rng(1).exponential(size=1000),
    "very many": np.random.default_rng(2).lognormal(sigma=3.0, size=100_000),
    "one bright among very many": np.append(np.full(99_999, 1e-6), 1.0),
}


@pytest.mark.parametrize("name", POWERS)
def test_probabilities_follow_the_power(name):
    """A light has one of the 2^24 numbers first, if it has power at all, and the rest by its share of the power."""
    power = POWERS[name]
    pmf, threshold, alias = build_alias_table(power)
    assert pmf.sum() == 1.0
    assert ((pmf > 0.0) == (power > 0.0)).all()
    share = power / power.sum()
    # One number for each light, taken from all in proportion, and a rounding of both ends of its range.
    assert (np.abs(pmf - share) <= (2.0 + share * len(power)) / 2.0**24).all()
    assert ((threshold >= 0.0) & (threshold <= 1.0)).all()
    assert ((alias >= 0) & (alias < len(power))).all()


def light_table(power):
    tables = LightTables()
    host = np.zeros(len(power), dtype=Light.numpy_dtype())
    host["pmf"], host["alias_threshold"], host["alias"] = build_alias_table(power)
    tables.lights = wp.array(host, dtype=Light, device=DEVICE)
    return tables


@functools.cache
def selection_counts(name):
    """How many of the 2^24 numbers select each light."""
    counts = wp.zeros(len(POWERS[name]), dtype=wp.int32, device=DEVICE)
    wp.launch(select_kernel, dim=1 << 24, inputs=[light_table(POWERS[name]), 0], outputs=[counts], device=DEVICE)
    return counts.numpy()


@pytest.mark.parametrize("name", POWERS)
def test_selection_has_the_probabilities_that_samples_are_divided_by(name):
    """Exact: of the 2^24 numbers, each light is selected by as many as its probability says; a black one by none."""
    counts = selection_counts(name)
    assert (counts == build_alias_table(POWERS[name])[0] * 2.0**24).all()
    assert (counts[POWERS[name] == 0.0] == 0).all()


@pytest.mark.parametrize("name", ["two", "many", "some black"])
def test_selection_chi_square(name):
    """The same with random numbers and a chi-square test; false-alarm rate 1e-4 over the cases."""
    power = POWERS[name]
    u = wp.array(np.ascontiguousarray(uniforms(N, seed=len(power))[:, 0]), dtype=float, device=DEVICE)
    counts = wp.zeros(len(power) + 1, dtype=wp.int32, device=DEVICE)
    wp.launch(choose_kernel, dim=N, inputs=[light_table(power), u], outputs=[counts], device=DEVICE)
    assert p_value(counts.numpy(), power / power.sum()) > sidak(3)


# --- sampling ----------------------------------------------------------------------------------------------------

FRONT = ((-1.0, -0.5, 0.0), (1.5, -0.5, 0.0), (0.0, 1.0, 0.0))
TRIANGLES = {
    "in front": (FRONT, (0.2, 0.1, 1.0)),
    "behind": (FRONT, (0.2, 0.1, -1.0)),
    "far": (FRONT, (300.0, 100.0, 1000.0)),
    "near": (FRONT, (0.1, 0.0, 0.05)),
    "grazing": (FRONT, (4.0, 0.3, 0.05)),
    "sliver": (((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1e-3, 0.0)), (0.5, 0.2, 0.3)),
    "away from the origin": (tuple(np.add(FRONT, 50.0)), (50.2, 50.1, 51.0)),
}


def check_mean(values, expected, tests):
    """z-test of a mean whose values have a finite variance."""
    values = values.astype(np.float64)
    error = max(values.std() / np.sqrt(len(values)), 2e-6 * abs(expected))
    z = (values.mean() - expected) / error
    assert abs(z) < stats.norm.isf(0.5 * sidak(tests)), (values.mean(), expected, z)


@pytest.mark.parametrize("name", TRIANGLES)
def test_triangle_solid_angle(name):
    """Mean of 1 / pdf; false-alarm rate 1e-4 over the cases. The density varies by a bounded factor, so it has a
    variance."""
    corners, p = TRIANGLES[name]
    corners = np.asarray(corners, np.float32)
    samples, _, _ = run(d.Scene(shapes=[triangle(*corners)]), p, uniforms(N, seed=len(name)))
    valid = samples["pdf"] > 0.0
    inverse = np.where(valid, 1.0 / np.where(valid, samples["pdf"], 1.0), 0.0)
    if name == "behind":
        assert not valid.any()
    else:
        check_mean(inverse, triangle_solid_angle(corners, np.asarray(p)), len(TRIANGLES))
    assert (samples["L"][valid] == (1.0, 2.0, 3.0)).all()
    assert (samples["L"][~valid] == 0.0).all()


@pytest.mark.parametrize("name", [name for name in TRIANGLES if name != "behind"])  # from behind there is no sample
def test_triangle_points_are_uniform(name):
    """Chi-square of the barycentric coordinates of the targets; false-alarm rate 1e-4 over the cases."""
    corners, p = TRIANGLES[name]
    corners = np.asarray(corners, np.float32).astype(np.float64)
    samples, _, _ = run(d.Scene(shapes=[triangle(*corners)]), p, uniforms(N, seed=5 + len(name)))
    edges = np.stack([corners[1] - corners[0], corners[2] - corners[0]], axis=1)
    b1, b2 = np.linalg.lstsq(edges, (samples["target"] - corners[0]).T, rcond=None)[0]
    # Inverse of a map of equal areas: the share of the area beyond b1, and the position across.
    across = b2 / np.maximum(1.0 - b1, 1e-9)
    i, j = (np.clip((x * 10).astype(int), 0, 9) for x in (1.0 - (1.0 - b1) ** 2, across))
    counts = np.append(np.bincount(10 * i + j, minlength=100), 0)
    assert p_value(counts, np.full(100, 0.01)) > sidak(len(TRIANGLES))


OUTSIDE = {
    "outside": ((1.0, 2.0, 3.0), 1.0, (-1.0, 0.5, 0.2)),
    "close": ((0.0, 0.0, 0.0), 1.0, (1.05, 0.0, 0.0)),
    "very close": ((0.0, 0.0, 0.0), 1.0, (0.0, 1.00002, 0.0)),
    "far and tiny": ((0.0, 0.0, 0.0), 0.01, (30.0, 40.0, 0.0)),
    "sun": ((0.0, 1.5e11, 0.0), 7e8, (3.0, 0.0, 1.0)),
    "large": ((0.0, -1e4, 0.0), 1e4, (0.0, 2.0, 0.0)),
}


def sphere_solid_angle(center, radius, p):
    distance2 = np.sum((np.asarray(p, np.float32).astype(np.float64) - center) ** 2)
    sin2 = radius**2 / distance2
    return 2.0 * np.pi * sin2 / (1.0 + np.sqrt(1.0 - sin2))


@pytest.mark.parametrize("name", OUTSIDE)
def test_sphere_from_outside(name):
    """The density is constant over the cone: solid angle exact, chi-square of the directions (false-alarm rate 1e-4
    over the cases)."""
    center, radius, p = OUTSIDE[name]
    samples, _, _ = run(d.Scene(shapes=[sphere(center, radius)]), p, uniforms(N, seed=7 + len(name)))
    expected = sphere_solid_angle(np.float64(np.float32(center)), np.float64(np.float32(radius)), p)
    # 1 - sin^2 loses digits next to the surface, where the half angle is close to a right angle.
    tolerance = {"very close": 2e-3, "large": 2e-3}.get(name, 1e-5)
    np.testing.assert_allclose(1.0 / samples["pdf"], expected, rtol=tolerance)
    axis = np.asarray(center, np.float64) - p
    axis /= np.linalg.norm(axis)
    s = np.cross(axis, [0.6, 0.0, 0.8])
    s /= np.linalg.norm(s)
    t = np.cross(axis, s)
    wi = samples["wi"].astype(np.float64)
    if name in ("sun", "far and tiny"):  # 1 - cos from the sine, which keeps its digits
        sin2 = (wi @ s) ** 2 + (wi @ t) ** 2
        h = sin2 / (1.0 + np.sqrt(1.0 - sin2))
    else:
        h = 1.0 - wi @ axis
    # Roundings of the directions put some of them on the wrong side of the edge of a cell, or of the cone: few cells.
    x = np.clip(h / (expected / (2.0 * np.pi)), 0.0, 1.0 - 1e-9)
    y = np.arctan2(wi @ t, wi @ s) / (2.0 * np.pi) + 0.5
    counts = np.bincount((x * 8).astype(int) * 8 + np.minimum((y * 8).astype(int), 7), minlength=64)
    assert p_value(np.append(counts, 0), np.full(64, 1 / 64)) > sidak(len(OUTSIDE))
    np.testing.assert_allclose(np.linalg.norm(wi, axis=1), 1.0, atol=1e-6)


INSIDE = {
    "centre": ((0.0, 0.0, 0.0), 2.0, (0.0, 0.0, 0.0)),
    "off centre": ((1.0, -2.0, 0.5), 2.0, (1.5, -1.0, 0.0)),
    "near the wall": ((0.0, 0.0, 0.0), 1.0, (0.0, 0.0, 0.97)),
}


@pytest.mark.parametrize("name", INSIDE)
def test_sphere_from_inside(name):
    """First and second moments of directions over the sphere: 4 pi, 0, 4 pi / 3; false-alarm rate 1e-4 together."""
    center, radius, p = INSIDE[name]
    samples, _, _ = run(d.Scene(shapes=[sphere(center, radius, inwards=True)]), p, uniforms(N, seed=9 + len(name)))
    inverse = 1.0 / samples["pdf"].astype(np.float64)
    wi = samples["wi"].astype(np.float64)
    tests = 10 * len(INSIDE)
    check_mean(inverse, 4.0 * np.pi, tests)
    for i in range(3):
        values = inverse * wi[:, i]
        assert abs(values.mean()) < stats.norm.isf(0.5 * sidak(tests)) * values.std() / np.sqrt(N) + 1e-5
        for j in range(i, 3):
            values = inverse * wi[:, i] * wi[:, j]
            expected = 4.0 * np.pi / 3.0 * (i == j)
            error = stats.norm.isf(0.5 * sidak(tests)) * values.std() / np.sqrt(N) + 1e-5
            assert abs(values.mean() - expected) < error, (i, j)


def test_emission_is_one_sided():
    """A sphere that faces inwards is dark from outside, and one that faces outwards from inside."""
    u = uniforms(1000, seed=3)
    assert (run(d.Scene(shapes=[sphere((0, 0, 0), 1.0, inwards=True)]), (3.0, 0.0, 0.0), u)[0]["L"] == 0.0).all()
    assert (run(d.Scene(shapes=[sphere((0, 0, 0), 1.0)]), (0.3, 0.0, 0.0), u)[0]["L"] == 0.0).all()


TWO_SIDED = d.Area(radiance=[1.0, 2.0, 3.0], two_sided=True)
SIDES = {
    "triangle, front": (triangle(*FRONT), (0.2, 0.1, 1.0), (0.2, 0.1, 1.0)),
    "triangle, back": (triangle(*FRONT), (0.2, 0.1, -1.0), (0.2, 0.1, 1.0)),
    "sphere, outside": (sphere((0, 0, 0), 1.0), (3.0, 0.0, 0.0), None),
    "sphere, inside": (sphere((0, 0, 0), 1.0), (0.3, 0.0, 0.0), None),
    "inwards, outside": (sphere((0, 0, 0), 1.0, True), (3.0, 0.0, 0.0), None),
    "inwards, inside": (sphere((0, 0, 0), 1.0, True), (0.3, 0.0, 0.0), None),
}


@pytest.mark.parametrize("name", SIDES)
def test_two_sided_emission(name):
    """Both sides: solid angle by the mean of 1 / pdf (false-alarm rate 1e-4 over the cases), the density of a traced
    hit, and nothing in the way of the shadow ray."""
    shape, p, mirrored = SIDES[name]
    scene = d.Scene(shapes=[msgspec.structs.replace(shape, emitter=TWO_SIDED)])
    samples, pdf, blocked = run(scene, p, uniforms(N, seed=21))
    assert (samples["pdf"] > 0.0).all()
    assert (samples["L"] == (1.0, 2.0, 3.0)).all()
    if mirrored is not None:
        expected = triangle_solid_angle(np.asarray(FRONT, np.float32), np.asarray(mirrored))
    else:
        expected = 4.0 * np.pi if name.endswith(", inside") else sphere_solid_angle((0.0, 0.0, 0.0), 1.0, p)
    check_mean(1.0 / samples["pdf"], expected, len(SIDES))
    assert blocked.mean() < 1e-3
    hit = pdf > 0.0
    assert (~hit).mean() < 1e-3
    assert (np.abs(pdf[hit] / samples["pdf"][hit] - 1.0) > 1e-4).mean() < 1e-3


def test_environment_is_uniform():
    samples, _, _ = run(d.Scene(emitters=[d.Constant(radiance=2.0)]), (0.0, 0.0, 0.0), uniforms(N, seed=2))
    np.testing.assert_allclose(samples["pdf"], 0.25 / np.pi, rtol=1e-6)
    z, phi = samples["wi"][:, 2].astype(np.float64), np.arctan2(samples["wi"][:, 1], samples["wi"][:, 0])
    i = np.minimum(((0.5 * z + 0.5) * 10).astype(int), 9)
    j = np.minimum(((phi / (2.0 * np.pi) + 0.5) * 10).astype(int), 9)
    assert p_value(np.append(np.bincount(10 * i + j, minlength=100), 0), np.full(100, 0.01)) > FALSE_ALARM_RATE
    assert (samples["L"] == 2.0).all()
    assert (samples["t_max"] > 1e38).all()


CASES = (
    {f"triangle {k}": ([triangle(*np.asarray(c, np.float32))], p) for k, (c, p) in TRIANGLES.items() if k != "behind"}
    | {f"sphere {k}": ([sphere(c, r)], p) for k, (c, r, p) in OUTSIDE.items()}
    | {f"inside {k}": ([sphere(c, r, True)], p) for k, (c, r, p) in INSIDE.items()}
    | {"two lights": ([triangle(*FRONT), sphere((0.0, 3.0, 0.0), 0.5)], (0.3, 0.5, 1.5))}
)


@pytest.mark.parametrize("name", CASES)
def test_density_of_a_traced_hit_is_that_of_the_sample(name):
    """MIS weights add to one only if both sides agree on the density: to 1e-4, for all but the few samples whose
    traced ray slips past the rim of the light."""
    shapes, p = CASES[name]
    samples, pdf, _ = run(d.Scene(shapes=shapes), p, uniforms(20_000, seed=11))
    valid = samples["pdf"] > 0.0
    hit = pdf[valid] > 0.0
    assert (~hit).mean() < 1e-3
    relative = np.abs(pdf[valid][hit] / samples["pdf"][valid][hit] - 1.0)
    assert (relative > 1e-4).mean() < 1e-3, np.sort(relative)[-5:]


def test_points_seen_at_a_grazing_angle():
    """The density of a direction that grazes a triangle is that of float64 for the same point: 1e-4 where the cosine
    is more than 1e-3."""
    corners = np.asarray(FRONT, np.float32)
    p = np.float32([3.0, 0.2, 0.02])
    samples, _, _ = run(d.Scene(shapes=[triangle(*corners)]), p, uniforms(20_000, seed=12))
    # The target is moved off the plane z = 0 along z: without that it is the point that was sampled.
    to_light = samples["target"].astype(np.float64) * (1.0, 1.0, 0.0) - p
    distance2 = np.sum(to_light**2, axis=1)
    cos = -to_light[:, 2] / np.sqrt(distance2)
    c = corners.astype(np.float64)
    area = 0.5 * np.linalg.norm(np.cross(c[1] - c[0], c[2] - c[0]))
    # From the front, which faces +z, the cosine is that of the height.
    valid = cos > 1e-3
    assert valid.all()
    assert (samples["pdf"] > 0.0).all()
    np.testing.assert_allclose(samples["pdf"], distance2 / (cos * area), rtol=1e-4)


VISIBLE = CASES | {
    "far triangle": ([triangle(*FRONT)], (1000.0, 2000.0, 1e4)),
    "very far triangle": ([triangle(*np.multiply(FRONT, 0.01))], (100.0, 200.0, 1e4)),
    "far sphere": ([sphere((0.0, 0.0, 0.0), 1.0)], (3000.0, 0.0, 1e4)),
    "far tiny sphere": ([sphere((0.0, 0.0, 0.0), 1e-3)], (300.0, 1000.0, 0.0)),
    "tiny triangle": ([triangle(*np.multiply(FRONT, 1e-6))], (1e-6, 0.0, 2e-6)),
    "tiny triangle, far": ([triangle(*np.multiply(FRONT, 1e-6))], (0.3, 0.1, 1.0)),
}


@pytest.mark.parametrize("name", VISIBLE)
def test_shadow_ray_reaches_its_light(name):
    """Nothing is in between, so a shadow ray must not be stopped by the light itself: at most one in 1000 is, near
    the rim."""
    shapes, p = VISIBLE[name]
    samples, _, blocked = run(d.Scene(shapes=shapes), p, uniforms(20_000, seed=13))
    valid = samples["pdf"] > 0.0
    assert valid.any()
    assert blocked[valid].mean() < 1e-3


def test_point_on_the_light_itself_is_no_light_sample():
    """From a vertex of an emissive triangle or sphere its own plane is edge-on: nothing, and nothing infinite."""
    for shape, p in ((triangle(*FRONT), (0.1, 0.0, 0.0)), (sphere((0, 0, 0), 1.0), (0.0, 1.0, 0.0))):
        samples, _, _ = run(d.Scene(shapes=[shape]), p, uniforms(20_000, seed=14))
        assert np.isfinite(samples["pdf"]).all()
        assert np.isfinite(samples["wi"]).all()
        assert (samples["pdf"] > 0.0).mean() < 0.01
