"""Emission and environment: radiance times throughput times the weight against light sampling."""

import numpy as np
import pytest

from tests.stages.harness import Counters, Scene, launch, lights, no_textures, paths, power_heuristic, surfaces, unit
from wavefront import queues
from wavefront.stages.emission import make_emission
from wavefront.stages.escaped import make_escaped

BETA = np.array([0.5, 0.25, 2.0])
PDFS = np.array([0.0, 1e-6, 0.05, 0.3, 4.0, 1e6, 1e30])  # 0: a delta bounce, or the camera


# --- escaped -----------------------------------------------------------------------------------------------------


def escape(pdf, beta=BETA, radiance=(1.0, 2.0, 3.0), sampling=True, slots=None):
    n = len(pdf)
    counters = Counters()
    p = paths(n, pdf=pdf, beta=beta, L=0.125)
    tables = lights([{"pmf": 0.75}, {"pmf": 0.25}], [(9.0, 9.0, 9.0), radiance], environment=1)
    queue = counters.queue("escaped", range(n) if slots is None else slots)
    launch(make_escaped(("constant",), sampling), 16, tables, p, queue, counters.struct)
    return p.L.numpy(), counters


def test_environment_weight():
    """Power heuristic of the path's density against that of the light sample, 0.25 / (4 pi)."""
    L, _ = escape(PDFS)
    weight = np.ones(len(PDFS))
    weight[1:] = power_heuristic(PDFS[1:], 0.25 / (4.0 * np.pi))
    np.testing.assert_allclose(L, 0.125 + weight[:, None] * BETA * (1.0, 2.0, 3.0), rtol=1e-6)


def test_environment_without_light_sampling():
    L, _ = escape(PDFS, sampling=False)
    np.testing.assert_allclose(L, np.broadcast_to(0.125 + BETA * (1.0, 2.0, 3.0), (len(PDFS), 3)), rtol=1e-6)


def test_only_queued_slots_see_the_environment():
    L, _ = escape(PDFS, slots=[4, 2])
    assert (L[[0, 1, 3, 5, 6]] == 0.125).all()
    assert (L[[2, 4]] > 0.125).all()


BAD = np.array([[np.nan, 1.0, 1.0], [1.0, np.inf, 1.0], [1.0, 1.0, -1e-3], [-np.inf, 0.0, 0.0], [1.0, 1.0, 1.0]])


def test_bad_environment_contributions_are_counted_and_left_out():
    L, counters = escape(np.zeros(5), beta=BAD)
    assert counters[queues.NONFINITE_ESCAPED] == 4
    assert (L[:4] == 0.125).all()
    assert (L[4] == np.add(0.125, (1.0, 2.0, 3.0))).all()
    for other in ("emission", "direct", "scatter"):
        assert counters[queues.NONFINITE_STAGES[other]] == 0


# --- emission ----------------------------------------------------------------------------------------------------

CORNERS = np.array([(-1.0, -1.0, -3.0), (2.0, -1.0, -3.0), (0.0, 1.0, -3.5)])
CENTER, RADIUS = np.array([0.5, 0.3, -4.0]), 0.75
RADIANCES = [(1.0, 2.0, 3.0), (4.0, 0.5, 0.25)]
PMF = [0.2, 0.6]


def emit(light, pdf, origin=(0.1, -0.2, 0.3), target=None, normal=None, beta=BETA, sampling=True, slots=None):
    n = len(pdf)
    counters = Counters()
    origin = np.broadcast_to(np.asarray(origin, np.float64), (n, 3))
    p = paths(n, origin=origin, direction=unit(target - origin), pdf=pdf, beta=beta)
    s = surfaces(n, position=target, geometric_normal=normal, light=light)
    scene = Scene([CORNERS], [(*CENTER, RADIUS)])
    rows = [{"kind": 0, "primitive": 0, "pmf": PMF[0]}, {"kind": 1, "primitive": 1, "pmf": PMF[1]}]
    queue = counters.queue("emissive", range(n) if slots is None else slots)
    kernel = make_emission(("constant", "sphere", "triangle"), (), sampling)
    launch(kernel, 16, scene.geometry, lights(rows, RADIANCES), no_textures(), p, s, queue, counters.struct)
    return p.L.numpy(), counters


def triangle_hit():
    cross = np.cross(CORNERS[1] - CORNERS[0], CORNERS[2] - CORNERS[0])
    target = np.array([0.2, 0.3, 0.5]) @ CORNERS
    return target, unit(cross), 0.5 * np.linalg.norm(cross)


def test_triangle_light_weight():
    """Density in area 1 / A times distance^2 / cos, times the probability of the light."""
    target, normal, area = triangle_hit()
    origin = np.array([0.1, -0.2, 0.3])
    L, counters = emit(0, PDFS, origin, target, normal)
    distance2 = np.sum((target - origin) ** 2)
    other = PMF[0] * distance2 / (np.abs(normal @ unit(target - origin)) * area)
    weight = np.ones(len(PDFS))
    weight[1:] = power_heuristic(PDFS[1:], other)
    np.testing.assert_allclose(L, weight[:, None] * BETA * RADIANCES[0], rtol=2e-6)
    assert counters[queues.NONFINITE_EMISSION] == 0


@pytest.mark.parametrize("inside", [False, True])
def test_sphere_light_weight(inside):
    """From outside, uniform over the cone that the sphere fills; from inside, uniform over its area."""
    origin = CENTER + ([0.2, 0.1, 0.0] if inside else [0.5, 0.5, 4.3])
    normal = unit([0.3, 0.2, 1.0])
    target = CENTER + RADIUS * normal
    L, _ = emit(1, PDFS, origin, target, normal)
    distance2 = np.sum((CENTER - origin) ** 2)
    if inside:
        other = np.sum((target - origin) ** 2) / (np.abs(normal @ unit(target - origin)) * 4.0 * np.pi * RADIUS**2)
    else:
        other = 1.0 / (2.0 * np.pi * (1.0 - np.sqrt(1.0 - RADIUS**2 / distance2)))
    weight = np.ones(len(PDFS))
    weight[1:] = power_heuristic(PDFS[1:], PMF[1] * other)
    np.testing.assert_allclose(L, weight[:, None] * BETA * RADIANCES[1], rtol=3e-6)


def test_emission_without_light_sampling():
    target, normal, _ = triangle_hit()
    L, _ = emit(0, PDFS, target=target, normal=normal, sampling=False)
    np.testing.assert_allclose(L, np.broadcast_to(BETA * RADIANCES[0], (len(PDFS), 3)), rtol=1e-6)


def test_only_queued_slots_receive_emission():
    target, normal, _ = triangle_hit()
    L, _ = emit(0, PDFS, target=target, normal=normal, slots=[3])
    assert (L[[0, 1, 2, 4, 5, 6]] == 0.0).all()
    assert (L[3] > 0.0).all()


def test_bad_emission_is_counted_and_left_out():
    target, normal, _ = triangle_hit()
    L, counters = emit(0, np.zeros(5), target=target, normal=normal, beta=BAD)
    assert counters[queues.NONFINITE_EMISSION] == 4
    assert (L[:4] == 0.0).all()
    assert (L[4] == RADIANCES[0]).all()
    for other in ("escaped", "direct", "scatter"):
        assert counters[queues.NONFINITE_STAGES[other]] == 0
