"""Shadow rays: what is in between, and nothing else, stops a contribution."""

import numpy as np

from tests.stages.harness import Counters, Scene, launch, paths, shadow_rays
from wavefront.stages.shadow import make_shadow

WALL = [(-1.0, -1.0, -2.0), (1.0, -1.0, -2.0), (0.0, 1.0, -2.0)]
BALL = (5.0, 0.0, -3.0, 0.5)
INFINITE = 3e38
CASES = [
    # origin, direction (to the target at parameter t_max), t_max, is it free?
    ((0.0, 0.0, 0.0), (0.0, 0.0, -4.0), 1.0, False),  # wall halfway
    ((0.0, 0.0, 0.0), (0.0, 0.0, -1.9), 1.0, True),  # ends before the wall
    ((0.0, 0.0, 0.0), (0.0, 0.0, -2.1), 1.0, False),  # ends just behind it
    ((0.0, 0.0, -4.0), (0.0, 0.0, 4.0), 1.0, False),  # from its back
    ((0.0, 0.0, 0.0), (0.0, 0.0, 4.0), 1.0, True),  # away from it
    ((0.0, 0.0, 0.0), (3.0, 0.0, -4.0), 1.0, True),  # past it
    ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), INFINITE, False),
    ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), INFINITE, True),
    ((5.0, 0.0, 0.0), (0.0, 0.0, -6.0), 1.0, False),  # ball halfway
    ((5.0, 0.0, 0.0), (0.0, 0.0, -2.4), 1.0, True),
    ((5.0, 0.0, 0.0), (0.0, 0.0, -2.6), 1.0, False),
    ((5.0, 0.0, -3.0), (0.0, 0.0, -0.4), 1.0, True),  # within the ball
    ((5.0, 0.0, -3.0), (0.0, 0.0, -0.6), 1.0, False),  # out of the ball
    ((5.0, 0.0, -4.0), (0.0, 0.0, -1.0), INFINITE, True),
    ((5.0, 0.0, 0.0), (0.0, 0.0, -1.0), INFINITE, False),
    ((5.0, 0.6, 0.0), (0.0, 0.0, -9.0), 1.0, True),  # past the ball
]


def shadow(slots):
    n = len(CASES)
    origin, direction, t_max, _ = (np.array(x) for x in zip(*CASES, strict=True))
    counters = Counters()
    p = paths(n, L=0.5)
    rays = shadow_rays(n, origin=origin, direction=direction, t_max=t_max, L=(1.0, 2.0, 3.0))
    scene = Scene([WALL], [BALL])
    launch(make_shadow(True, True), n, scene.geometry, rays, counters.queue("shadow", slots, capacity=n), p)
    return p.L.numpy()


def test_visibility():
    free = np.array([case[3] for case in CASES])
    L = shadow(range(len(CASES)))
    np.testing.assert_array_equal(L, np.where(free[:, None], (1.5, 2.5, 3.5), 0.5))


def test_only_queued_slots():
    L = shadow([4, 9])
    assert (L[[4, 9]] == (1.5, 2.5, 3.5)).all()
    assert (np.delete(L, [4, 9], axis=0) == 0.5).all()
