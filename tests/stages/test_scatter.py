"""Scatter: throughput, next ray, Russian roulette, and what ends a path."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

from tests.chi_square import FALSE_ALARM_RATE
from tests.stages.harness import Counters, launch, materials, no_textures, paths, surfaces, uniforms, unit
from wavefront import queues
from wavefront.rng import PURPOSE_BSDF
from wavefront.stages.scatter import make_scatter

SEED = 2**33 + 3
REFLECTANCE = np.array([0.8, 0.4, 0.1])
ETA = 1.5
DIFFUSE, MIRROR, GLASS = 0, 1, 2
WO = unit([0.5, 0.0, 1.0])
OFFSET = 1e-3
POSITION = (1.0, 2.0, 3.0)


def scatter(n, material, depth=0, rr_depth=None, beta=1.0, eta=1.0, wo=WO, slots=None, capacity=None, table=None):
    counters = Counters(depth)
    p = paths(n, direction=-np.asarray(wo), beta=beta, eta=eta, sample=3, origin=np.nan, pdf=-1.0)
    s = surfaces(n, material=material, offset=OFFSET, position=POSITION)
    hits = counters.queue("hits", range(n) if slots is None else slots, capacity=n)
    rays = counters.queue("rays", capacity=n if capacity is None else capacity)
    table = table or materials(
        diffuse=[{"reflectance": REFLECTANCE}],
        conductor=[{"eta": 0.0, "k": 1.0, "reflectance": (0.9, 0.8, 0.7)}],
        dielectric=[{"eta": ETA, "reflectance": 1.0, "transmittance": 1.0}],
    )
    kernel = make_scatter(
        ("conductor", "dielectric", "diffuse"), False, (), False, False, (), True, rr_depth is not None
    )
    launch(kernel, n, table, no_textures(), s, hits, rr_depth or 0, wp.uint64(SEED), p, rays, counters.struct)
    return p, counters


def random_numbers(n, depth=0):
    return uniforms(SEED, np.arange(n), 3, depth, int(PURPOSE_BSDF))


def test_diffuse():
    """Cosine-distributed directions from the concentric map, weight = reflectance, density cos / pi."""
    n = 500
    p, counters = scatter(n, DIFFUSE, beta=(1.0, 2.0, 4.0), depth=2)
    u = 2.0 * random_numbers(n, depth=2)[:, :2] - 1.0
    x, y = u.T
    wide = np.abs(x) > np.abs(y)
    with np.errstate(divide="ignore", invalid="ignore"):
        r = np.where(wide, x, y)
        phi = np.where(wide, np.pi / 4 * y / x, np.pi / 2 - np.pi / 4 * x / y)
    wi = np.stack([r * np.cos(phi), r * np.sin(phi), np.sqrt(1.0 - r**2)], axis=1)
    assert counters.content("rays") == list(range(n))
    # The basis about the normal (0, 0, 1) is that of the coordinates.
    np.testing.assert_allclose(p.direction.numpy(), wi, atol=2e-6)
    np.testing.assert_allclose(p.pdf.numpy(), wi[:, 2] / np.pi, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(p.beta.numpy(), np.broadcast_to(REFLECTANCE * (1.0, 2.0, 4.0), (n, 3)), rtol=1e-6)
    origin = np.add(POSITION, (0.0, 0.0, OFFSET))
    np.testing.assert_allclose(p.origin.numpy(), np.broadcast_to(origin, (n, 3)), rtol=1e-6)


def test_mirror_is_a_delta():
    p, _ = scatter(4, MIRROR)
    np.testing.assert_allclose(p.direction.numpy(), np.tile(WO * (-1, -1, 1), (4, 1)), atol=1e-6)
    np.testing.assert_allclose(p.beta.numpy(), np.tile((0.9, 0.8, 0.7), (4, 1)), rtol=1e-6)
    assert (p.pdf.numpy() == 0.0).all()


@pytest.mark.parametrize("inside", [False, True])
def test_glass(inside):
    """Fresnel's probability of reflection; refraction by Snell, radiance over eta^2, and the index that a path has
    crossed; the ray starts on the side that it goes to."""
    n = 2000
    sign = -1.0 if inside else 1.0
    wo = unit([0.3, 0.0, sign])
    ratio = 1.0 / ETA if inside else ETA
    p, _ = scatter(n, GLASS, wo=wo, eta=ETA if inside else 1.0)
    cos = abs(wo[2])
    cos_t = np.sqrt(1.0 - (1.0 - cos**2) / ratio**2)
    r_s, r_p = (cos - ratio * cos_t) / (cos + ratio * cos_t), (ratio * cos - cos_t) / (ratio * cos + cos_t)
    fresnel = 0.5 * (r_s**2 + r_p**2)
    u = random_numbers(n)[:, 2]
    clear = np.abs(u - fresnel) > 1e-6
    reflected = u < fresnel
    assert 0 < reflected.sum() < n
    expected = np.where(reflected[:, None], wo * (-1, -1, 1), (-wo[0] / ratio, -wo[1] / ratio, -sign * cos_t))
    np.testing.assert_allclose(p.direction.numpy()[clear], expected[clear], atol=1e-6)
    crossed = 1.0 if inside else ETA
    np.testing.assert_allclose(p.eta.numpy(), np.where(reflected, ETA if inside else 1.0, crossed), rtol=1e-6)
    np.testing.assert_allclose(p.beta.numpy()[:, 0], np.where(reflected, 1.0, ratio**-2.0), rtol=1e-5)
    height = (p.origin.numpy()[:, 2] - POSITION[2]) / OFFSET
    np.testing.assert_allclose(height, np.sign(expected[:, 2]), rtol=1e-3)


# --- Russian roulette ----------------------------------------------------------------------------------------------


def survivors(p, counters, n):
    alive = np.zeros(n, bool)
    alive[counters.content("rays")] = True
    return alive


@pytest.mark.parametrize("beta", [0.01, 0.3, 1.0, 1.15, 1.3, 50.0])
def test_roulette_threshold(beta):
    """Survives if the fourth number is below min(0.95, largest channel), and is divided by just that."""
    n = 2000
    p, counters = scatter(n, DIFFUSE, depth=4, rr_depth=5, beta=beta)
    q = min(0.95, beta * REFLECTANCE[0])
    u = random_numbers(n, depth=4)[:, 3]
    clear = np.abs(u - q) > 1e-6
    alive = survivors(p, counters, n)
    np.testing.assert_array_equal(alive[clear], (u < q)[clear])
    assert 0 < alive.sum() < n
    np.testing.assert_allclose(p.beta.numpy()[alive], np.tile(beta * REFLECTANCE / q, (alive.sum(), 1)), rtol=1e-5)


@pytest.mark.parametrize("beta", [0.05, 0.5, 2.0])
def test_roulette_is_unbiased(beta):
    """The mean throughput is that without roulette; z-test with a false-alarm rate of 1e-4 (three cases)."""
    n = 50_000
    p, counters = scatter(n, DIFFUSE, depth=1, rr_depth=1, beta=beta)
    alive = survivors(p, counters, n)
    value = np.where(alive, p.beta.numpy()[:, 1], 0.0).astype(np.float64)
    z = (value.mean() - beta * REFLECTANCE[1]) / (value.std() / np.sqrt(n))
    assert abs(z) < stats.norm.isf(0.5 * FALSE_ALARM_RATE / 3)


@pytest.mark.parametrize(
    ("depth", "rr_depth", "plays"), [(0, 1, True), (0, 2, False), (3, 5, False), (4, 5, True), (9, 5, True)]
)
def test_roulette_starts_at_its_depth(depth, rr_depth, plays):
    """The path has depth + 1 segments when it scatters; roulette may end it from `rr_depth` segments on."""
    n = 300
    p, counters = scatter(n, DIFFUSE, depth=depth, rr_depth=rr_depth)
    assert (survivors(p, counters, n).sum() < n) == plays


def test_roulette_undoes_the_scaling_of_radiance():
    """Inside glass of index 1.5 radiance is 2.25 times as dense: a throughput of 1 / 2.25 is worth 1."""
    n = 3000
    p, counters = scatter(n, GLASS, rr_depth=1, wo=unit([0.3, 0.0, 1.0]))
    alive = survivors(p, counters, n)
    u = random_numbers(n)[:, 3]
    clear = np.abs(u - 0.95) > 1e-6
    np.testing.assert_array_equal(alive[clear], (u < 0.95)[clear])
    inside = alive & (p.eta.numpy() > 1.2)
    assert inside.any()
    np.testing.assert_allclose(p.beta.numpy()[inside], ETA**-2.0 / 0.95, rtol=1e-5)


# --- the end of a path ---------------------------------------------------------------------------------------------


def test_absorbed_paths_are_not_queued():
    """From the back of a one-sided surface, and for a throughput of zero."""
    for arguments in ({"wo": -WO}, {"beta": 0.0}):
        _, counters = scatter(50, DIFFUSE, **arguments)
        assert counters.content("rays") == []
        assert counters[queues.NONFINITE_SCATTER] == 0


def test_one_black_channel_does_not_end_a_path():
    table = materials(diffuse=[{"reflectance": (0.0, 0.5, 0.0)}])
    p, counters = scatter(20, DIFFUSE, table=table)
    assert counters.content("rays") == list(range(20))
    assert (p.beta.numpy() == (0.0, 0.5, 0.0)).all()


def test_bad_throughput_is_counted_and_ends_the_path():
    beta = np.ones((6, 3))
    beta[1, 0], beta[2, 1], beta[3, 2] = np.nan, np.inf, -0.5
    _, counters = scatter(6, DIFFUSE, beta=beta)
    assert counters[queues.NONFINITE_SCATTER] == 3
    assert counters.content("rays") == [0, 4, 5]
    for other in ("escaped", "direct", "emission"):
        assert counters[queues.NONFINITE_STAGES[other]] == 0


def test_only_queued_slots_scatter():
    p, counters = scatter(10, DIFFUSE, slots=[7, 2])
    assert counters.content("rays") == [2, 7]
    assert (np.delete(p.pdf.numpy(), [2, 7]) == -1.0).all()


def test_overflow_sets_the_status_bit():
    _, counters = scatter(10, DIFFUSE, capacity=4)
    assert counters[queues.STATUS] == int(queues.STATUS_QUEUE_OVERFLOW)
    assert counters[queues.RAYS] == 10
    assert (counters.beyond("rays") == -7).all()
