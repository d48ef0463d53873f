"""Direct light: the contribution that a shadow ray carries, against float64, and its expectation in closed form."""

import numpy as np
import warp as wp
from scipy import stats

from tests.chi_square import FALSE_ALARM_RATE
from tests.stages.harness import (
    Counters,
    Scene,
    launch,
    lights,
    materials,
    no_textures,
    paths,
    power_heuristic,
    shadow_rays,
    surfaces,
    uniforms,
    unit,
)
from wavefront import queues
from wavefront.rng import PURPOSE_LIGHT
from wavefront.stages.direct import make_direct

SEED = 2**35 + 11
DEPTH = 3
CORNERS = np.array([(-0.5, -0.4, 2.0), (0.2, 0.9, 2.2), (0.8, -0.3, 1.9)])  # faces down, towards the vertex at 0
RADIANCE = np.array([3.0, 2.0, 1.0])
REFLECTANCE = np.array([0.8, 0.5, 0.25])
BETA = np.array([0.5, 1.0, 2.0])
WO = unit([0.3, 0.1, 1.0])
PMF = 0.5  # of the triangle; the other light is the environment
SKY = np.array([0.1, 0.2, 0.4])


def direct(n, slots=None, wo=WO, beta=BETA, material=0, capacity=None, radiance=RADIANCE, offset=1e-5):
    capacity = n if capacity is None else capacity
    counters = Counters(DEPTH)
    p = paths(n, direction=-np.asarray(wo), beta=beta, sample=5)
    s = surfaces(n, material=material, offset=offset)
    hits = counters.queue("hits", range(n) if slots is None else slots, capacity=n)
    shadow = counters.queue("shadow", capacity=capacity)
    rays = shadow_rays(n, origin=np.nan, L=np.nan)
    # A second mesh keeps the kinds of light apart from the primitives.
    scene = Scene([CORNERS], shapes=[{"first_light": 0}])
    tables = lights([{"kind": 0, "primitive": 0}, {"kind": 2, "primitive": -1}], [radiance, SKY], environment=1)
    table = materials(
        diffuse=[{"reflectance": REFLECTANCE}],
        conductor=[{"eta": 0.0, "k": 1.0, "reflectance": 1.0}],
    )
    kernel = make_direct(("conductor", "diffuse"), False, (), ("constant", "triangle"), (), False, False, ())
    arguments = [scene.geometry, table, no_textures(), tables, p, s, hits, wp.uint64(SEED)]
    launch(kernel, n, *arguments, rays, shadow, counters.struct)
    return rays, counters


def oracle(n):
    """Per slot in float64: which light, direction, target, and the weighted contribution."""
    u = uniforms(SEED, np.arange(n), 5, DEPTH, int(PURPOSE_LIGHT))
    triangle = u[:, 0] < PMF
    root = np.sqrt(1.0 - u[:, 1])
    b1, b2 = 1.0 - root, u[:, 2] * root
    target = (1.0 - b1 - b2)[:, None] * CORNERS[0] + b1[:, None] * CORNERS[1] + b2[:, None] * CORNERS[2]
    r = 2.0 * np.sqrt(u[:, 1] * (1.0 - u[:, 1]))
    phi = 2.0 * np.pi * u[:, 2]
    sky = np.stack([r * np.cos(phi), r * np.sin(phi), 1.0 - 2.0 * u[:, 1]], axis=1)
    wi = np.where(triangle[:, None], unit(target), sky)
    cross = np.cross(CORNERS[1] - CORNERS[0], CORNERS[2] - CORNERS[0])
    cos_light = -wi @ unit(cross)
    area_pdf = np.sum(target**2, axis=1) / (np.abs(cos_light) * 0.5 * np.linalg.norm(cross))
    pdf = PMF * np.where(triangle, area_pdf, 0.25 / np.pi)
    bsdf_pdf = np.maximum(wi[:, 2], 0.0) / np.pi
    radiance = np.where(triangle[:, None], RADIANCE, SKY)
    weight = np.where(bsdf_pdf > 0.0, power_heuristic(pdf, bsdf_pdf), 0.0)
    L = (weight * bsdf_pdf / pdf)[:, None] * BETA * REFLECTANCE * radiance
    return triangle, wi, target, L, bsdf_pdf > 0.0, pdf, bsdf_pdf


def test_contribution_of_each_slot():
    n = 400
    rays, counters = direct(n)
    triangle, wi, target, L, lit, _, _ = oracle(n)
    assert triangle.any()
    assert (~triangle & lit).any()
    assert (~triangle & ~lit).any()
    assert counters.content("shadow") == np.flatnonzero(lit).tolist()
    np.testing.assert_allclose(rays.L.numpy()[lit], L[lit], rtol=1e-5)
    assert np.isnan(rays.L.numpy()[~lit]).all()
    origin, direction, t_max = rays.origin.numpy(), rays.direction.numpy(), rays.t_max.numpy()
    np.testing.assert_allclose(origin[lit], np.broadcast_to([0.0, 0.0, 1e-5], (lit.sum(), 3)), atol=1e-9)
    np.testing.assert_allclose((origin + direction)[triangle], target[triangle], atol=1e-5)
    np.testing.assert_allclose(t_max[triangle], 1.0, atol=1e-5)  # ends short of the light by roundings
    assert (t_max[triangle] < 1.0).all()
    np.testing.assert_allclose(direction[lit & ~triangle], wi[lit & ~triangle], atol=1e-6)
    assert (t_max[lit & ~triangle] > 1e38).all()
    assert counters[queues.NONFINITE_DIRECT] == 0


def test_target_is_in_front_of_the_light():
    """On the side it emits to, by less than anybody sees."""
    n = 400
    rays, _ = direct(n)
    triangle, *_ = oracle(n)
    normal = unit(np.cross(CORNERS[1] - CORNERS[0], CORNERS[2] - CORNERS[0]))
    height = ((rays.origin.numpy() + rays.direction.numpy()).astype(np.float64)[triangle] - CORNERS[0]) @ normal
    assert normal[2] < 0.0
    assert (height > 0.0).all()
    assert (height < 1e-4).all()


def test_expectation_is_the_closed_form():
    """Undoing the MIS weight, the mean is the reflected irradiance of the triangle (Lambert's formula for polygons)
    and of the half sphere of sky; z-test with a false-alarm rate of 1e-4."""
    n = 100_000
    rays, counters = direct(n)
    _, _, _, _, _, pdf, bsdf_pdf = oracle(n)
    queued = np.zeros(n, bool)
    queued[counters.content("shadow")] = True
    value = np.where(queued[:, None], rays.L.numpy().astype(np.float64), 0.0)
    value /= np.where(queued, power_heuristic(pdf, np.where(queued, bsdf_pdf, 1.0)), 1.0)[:, None]
    # Lambert: E / L = 1/2 sum of angle_i * (unit normal of the side's plane)_z.
    corners = unit(CORNERS)
    factor = 0.0
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        factor += 0.5 * np.arccos(a @ b) * unit(np.cross(a, b))[2]
    expected = BETA * REFLECTANCE / np.pi * (abs(factor) * RADIANCE + np.pi * SKY)
    z = (value.mean(axis=0) - expected) / (value.std(axis=0) / np.sqrt(n))
    assert np.abs(z).max() < stats.norm.isf(0.5 * FALSE_ALARM_RATE / 3)


def test_no_sample_from_below_or_for_a_mirror():
    for arguments in ({"wo": -WO}, {"material": 1}):
        rays, counters = direct(100, **arguments)
        assert counters.content("shadow") == []
        assert np.isnan(rays.L.numpy()).all()


def test_only_queued_slots_are_lit():
    _, _, _, _, lit, _, _ = oracle(50)
    chosen = np.flatnonzero(lit)[[1, 4, 7]]
    _, counters = direct(50, slots=chosen)
    assert counters.content("shadow") == chosen.tolist()


def test_bad_contributions_are_counted_and_left_out():
    n = 60
    beta = np.tile(BETA, (n, 1))
    _, _, _, _, lit, _, _ = oracle(n)
    bad = np.flatnonzero(lit)[:3]
    beta[bad[0], 1], beta[bad[1], 0], beta[bad[2], 2] = np.nan, np.inf, -1.0
    rays, counters = direct(n, beta=beta)
    assert counters[queues.NONFINITE_DIRECT] == 3
    assert counters.content("shadow") == sorted(set(np.flatnonzero(lit)) - set(bad))
    assert np.isnan(rays.L.numpy()[bad]).all()


def test_overflow_sets_the_status_bit():
    _, counters = direct(50, capacity=3)
    assert counters[queues.STATUS] == int(queues.STATUS_QUEUE_OVERFLOW)
    assert (counters.beyond("shadow") == -7).all()
