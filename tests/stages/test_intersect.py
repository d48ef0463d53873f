"""Intersect: the vertex of each slot, and the queues it is put on."""

import numpy as np
import pytest
import warp as wp

from tests.stages.harness import Counters, Scene, array, launch, paths, surfaces, unit
from wavefront import queues
from wavefront.accel.geometry import RayHits
from wavefront.stages.intersect import make_intersect

FAR = -5.0
# Two triangles across -z, the second behind and larger, and a sphere to the right of both.
NEAR = [(-1.0, -1.0, -2.0), (1.0, -1.0, -2.0), (0.0, 1.0, -2.0)]
BACK = [(-9.0, -9.0, FAR), (9.0, -9.0, FAR), (0.0, 20.0, FAR)]
NORMALS = [unit([(-0.5, 0.0, 1.0), (0.5, 0.0, 1.0), (0.0, 0.5, 1.0)]), np.zeros((3, 3))]
UVS = [[(0.0, 0.0), (1.0, 0.0), (0.5, 1.0)], [(0.0, 0.0), (2.0, 0.0), (0.0, 2.0)]]
SPHERE = (3.0, 0.0, -3.0, 0.5)
SHAPES = [
    {"material": 4, "smooth": 1, "first_light": 10},
    {"material": 5},
    {"material": 6, "first_light": 20},
]
DIRECTIONS = unit(
    [
        (0.0, 0.0, -1.0),  # 0: near triangle
        (0.2, -0.2, -1.0),  # 1: near triangle
        (1.5, 0.5, -2.0),  # 2: back triangle
        (3.0, 0.1, -3.0),  # 3: sphere
        (0.0, 0.0, 1.0),  # 4: nothing
        (1.0, 0.0, 1.0),  # 5: nothing
    ]
)


def trace(
    directions=DIRECTIONS,
    origin=(0.0, 0.0, 0.0),
    depth=0,
    max_depth=8,
    slots=None,
    shapes=SHAPES,
    normals=NORMALS,
    capacity=16,
    **flags,
):
    features = {
        "smooth": True,
        "uvs": True,
        "tangents": True,
        "bumps": True,
        "area_lights": True,
        "escape_lights": True,
    } | flags
    scene = Scene([NEAR, BACK], [SPHERE], normals, UVS, shapes)
    scene.geometry.sphere_to_local = array(np.eye(3, dtype=np.float32)[None], wp.mat33)
    n = len(directions)
    counters = Counters(depth)
    p = paths(n, origin=origin, direction=directions)
    s = surfaces(n, material=99, light=99)
    rays = counters.queue("rays", range(n) if slots is None else slots)
    out = [counters.queue(name, capacity=capacity) for name in ("hits", "escaped", "emissive")]
    inputs = [scene.geometry, p, rays, RayHits(), max_depth, s, *out, counters.struct]
    launch(make_intersect(True, True, **features), 16, *inputs)
    return s, counters


def test_vertices():
    s, _ = trace()
    position, n, ns = s.position.numpy(), s.geometric_normal.numpy(), s.shading_normal.numpy()
    for i, z in ((0, -2.0), (1, -2.0), (2, FAR)):
        np.testing.assert_allclose(position[i], DIRECTIONS[i] * z / DIRECTIONS[i][2], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(n[i], (0.0, 0.0, 1.0), atol=1e-6)
    np.testing.assert_array_equal(ns[2], n[2])  # flat
    corners = np.array([NEAR, BACK])
    for i, triangle in ((0, 0), (1, 0), (2, 1)):
        matrix = np.vstack([corners[triangle][:, :2].T, np.ones(3)])
        weights = np.linalg.solve(matrix, [*position[i][:2].astype(np.float64), 1.0])
        np.testing.assert_allclose(s.uv.numpy()[i], weights @ np.array(UVS[triangle]), atol=1e-6)
        if triangle == 0:
            np.testing.assert_allclose(ns[i], unit(weights @ NORMALS[0]), atol=1e-6)
    center, radius = np.array(SPHERE[:3]), SPHERE[3]
    b = DIRECTIONS[3] @ center
    t = b - np.sqrt(b**2 - center @ center + radius**2)
    np.testing.assert_allclose(position[3], t * DIRECTIONS[3], atol=1e-6)  # of coordinates up to 3
    np.testing.assert_allclose(n[3], unit(t * DIRECTIONS[3] - center), atol=1e-6)
    assert (s.offset.numpy()[:4] > 0.0).all()
    assert (s.offset.numpy()[:4] < 1e-4).all()
    assert s.material.numpy().tolist() == [4, 4, 5, 6, -1, -1]


def test_queues():
    s, counters = trace()
    assert counters.content("hits") == [0, 1, 2, 3]
    assert counters.content("escaped") == [4, 5]
    assert counters.content("emissive") == [0, 1, 3]
    assert s.light.numpy()[:4].tolist() == [10, 10, -1, 20]
    assert counters[queues.STATUS] == 0


def test_only_queued_slots_are_traced():
    s, counters = trace(slots=[3, 4])
    assert counters.content("hits") == [3]
    assert counters.content("escaped") == [4]
    assert s.material.numpy().tolist() == [99, 99, 99, 6, -1, 99]


@pytest.mark.parametrize(("depth", "scatters"), [(0, True), (6, True), (7, False), (8, False)])
def test_last_depth_only_emits(depth, scatters):
    """A path of `max_depth` segments ends at its last vertex, which may still emit, as may the environment."""
    _, counters = trace(depth=depth, max_depth=8)
    assert counters.content("hits") == ([0, 1, 2, 3] if scatters else [])
    assert counters.content("emissive") == [0, 1, 3]
    assert counters.content("escaped") == [4, 5]


def test_emission_is_one_sided():
    """From behind: both triangles are dark. From inside the sphere: dark, unless it faces inwards."""
    from_behind = [(0.0, 0.0, 1.0)]
    _, counters = trace(from_behind, origin=(0.0, 0.0, -4.0))
    assert counters.content("hits") == [0]
    assert counters.content("emissive") == []
    for flip in (0, 1):
        shapes = [SHAPES[0], SHAPES[1], SHAPES[2] | {"flip": flip}]
        s, counters = trace(from_behind, origin=SPHERE[:3], shapes=shapes)
        assert counters.content("emissive") == [0] * flip
        np.testing.assert_allclose(s.geometric_normal.numpy()[0], (0.0, 0.0, -1.0 if flip else 1.0), atol=1e-6)


def test_normal_follows_vertex_normals():
    """Vertex normals on the other side of the face turn the geometric normal, and with it the emission."""
    s, counters = trace(DIRECTIONS[:1], normals=[-NORMALS[0], NORMALS[1]])
    assert counters.content("emissive") == []
    np.testing.assert_allclose(s.geometric_normal.numpy()[0], (0.0, 0.0, -1.0), atol=1e-6)


def test_features_that_are_off_are_not_written():
    s, counters = trace(smooth=False, uvs=False, tangents=False, bumps=False, area_lights=False, escape_lights=False)
    assert counters.content("escaped") == []
    assert counters.content("emissive") == []
    assert (s.light.numpy() == 99).all()
    assert (s.uv.numpy() == 0.0).all()
    assert (s.tangent.numpy() == 0.0).all()
    np.testing.assert_array_equal(s.shading_normal.numpy()[:4], s.geometric_normal.numpy()[:4])


def test_overflow_sets_the_status_bit_and_writes_nothing_beyond():
    _, counters = trace(capacity=2)
    assert counters[queues.STATUS] == int(queues.STATUS_QUEUE_OVERFLOW)
    assert counters[queues.HITS] == 4
    assert counters[queues.EMISSIVE] == 3
    for name in ("hits", "emissive", "escaped"):
        assert (counters.beyond(name) == -7).all()
