"""Rays against soups of triangles: both traversals against each other, bit for bit, and against float64 brute force.

What decides between right and wrong is a bound of rounding errors (see `tests.accel.oracle`), not chance: rays are
drawn from fixed seeds.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.accel.oracle import check, judge
from tests.accel.soups import SOUPS, hard_rays, on_triangles
from tests.accel.tracing import (
    FAR,
    check_any,
    launch,
    portable_kernel,
    soup_bvh,
    stream_kernel,
    trace,
    trace_both,
    triangles_below,
)

COUNTS = (1, 2, 3, 8, 9, 60, 300)
# By 1e15 the products of three lengths overflow in float32, and by 1e-12 those of two lose their last bits.
PLACES = {
    "ordinary": (1.0, 0.0),
    "far off": (1.0, 1e3),
    "huge": (1e12, 0.0),
    "enormous": (1e15, 0.0),
    "tiny": (1e-12, 0.0),
}


def compare(corners, origin, direction):
    """Closest and any hits of one soup; returns the part of rays that have only one right answer and that hit."""
    corners = np.asarray(corners, np.float32)
    bvh = soup_bvh(corners).bvh
    hits = trace_both(bvh, 0, origin, direction)
    check_any(bvh, 0, origin, direction, hits)
    return check(judge(corners, origin, direction), hits), (hits.primitive >= 0).mean()


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("soup", SOUPS)
def test_hits_are_those_of_brute_force(soup, place):
    scale, shift = PLACES[place]
    if soup == "all_sizes" and place == "tiny":
        scale = 1e-7  # the smallest are 1e-12
    figures = []
    for count in COUNTS:
        rng = np.random.default_rng(count)
        corners = ((SOUPS[soup](rng, count) + shift) * scale).astype(np.float32)
        figures.append(compare(corners, *hard_rays(rng, corners, 1200)))
    decided, hit = np.mean(figures, axis=0)
    # Two thirds of the rays are aimed at edges and vertices; of copies, and of points and segments, all are right.
    assert decided > (0.05 if soup in ("duplicated", "degenerate") else 0.2), decided
    assert 0.2 < hit < 1.0, hit


@pytest.mark.parametrize("soup", ["scattered", "axis_aligned"])
def test_ordinary_rays_have_one_right_answer(soup):
    """So that the bounds of the oracle cannot hide what is wrong."""
    rng = np.random.default_rng(5)
    corners = SOUPS[soup](rng, 200).astype(np.float32)
    origin = 3.0 * rng.normal(size=(8000, 3))
    direction = rng.normal(size=(8000, 3)) - origin
    decided, hit = compare(corners, np.float32(origin), np.float32(direction))
    assert decided > (0.99 if soup == "scattered" else 0.5), decided  # of squares that coincide, either is right
    assert hit > 0.5


coordinate = st.one_of(
    st.sampled_from([0.0, -0.0, 1.0, -1.0, 0.5, 2.0, 1.0000001, 1e-7, 1e4, 16777217.0]),
    st.floats(-4.0, 4.0, width=32).map(lambda x: x if abs(x) > 1e-12 else 0.0),
    st.integers(-2, 2).map(float),
)
points = st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=3, max_size=8)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(points, st.integers(1, 24), st.integers(0, 2**32 - 1))
def test_hits_among_any_points_are_those_of_brute_force(vertices, count, seed):
    """Triangles with common vertices, such as occur in meshes, and rays through and from these."""
    rng = np.random.default_rng(seed)
    vertices = np.array(vertices, np.float32)
    corners = vertices[rng.integers(0, len(vertices), (count, 3))]
    origin, direction = hard_rays(rng, corners, 150)
    exact = vertices[rng.integers(0, len(vertices), (2, 150))]
    origin = np.concatenate([origin, exact[0], exact[0] + exact[1]])
    direction = np.concatenate([direction, exact[1] - exact[0], -exact[1]])
    compare(corners, origin, direction)


def test_of_equal_triangles_the_first_is_hit():
    """Wherever the others are in the tree: 40 copies of each of 20 triangles, of which some face an axis."""
    rng = np.random.default_rng(11)
    originals = np.concatenate([SOUPS["scattered"](rng, 10), SOUPS["axis_aligned"](rng, 10)])
    order = np.concatenate([rng.permutation(20) for _ in range(40)])
    corners = originals[order].astype(np.float32)
    origin = np.float32(3.0 * rng.normal(size=(40000, 3)))
    direction = np.float32(on_triangles(rng, corners, 40000) - origin)
    hits = trace_both(soup_bvh(corners).bvh, 0, origin, direction)
    alone = trace(portable_kernel, soup_bvh(corners[:20]).bvh, 0, origin, direction)
    assert (alone.primitive >= 0).mean() > 0.7
    for name in ("primitive", "t", "uv"):
        assert (getattr(alone, name) == getattr(hits, name)).all(), name


def test_rays_within_the_sides_of_boxes_hit_the_edges_there():
    """Along an axis, through the border of a sheet, which is that of all boxes around it."""
    rng = np.random.default_rng(3)
    x = np.linspace(-1.0, 1.0, 21)
    square = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    cells = np.stack(np.meshgrid(range(20), range(20)), axis=-1).reshape(-1, 1, 1, 2) + square
    sheet = np.full((800, 3, 3), 0.25)
    sheet[:, :, :2] = x[cells].reshape(800, 3, 2)
    border = rng.uniform(-1.0, 1.0, (4000, 2))
    side = rng.integers(0, 2, 4000)
    border[np.arange(4000), side] = rng.choice((-1.0, 1.0), 4000)
    for axis in range(3):
        origin = np.column_stack([border, np.full(4000, 3.0)])
        direction = np.array([0.0, 0.0, -1.0])
        corners, origin, direction = (np.roll(a, axis, axis=-1) for a in (sheet, origin, direction))
        directions = np.where(direction == 0.0, np.copysign(0.0, rng.normal(size=(4000, 3))), direction)
        hits = trace_both(soup_bvh(np.float32(corners)).bvh, 0, np.float32(origin), np.float32(directions))
        assert (hits.primitive >= 0).all()
        np.testing.assert_allclose(hits.t, 2.75, rtol=4e-7)


def test_rays_without_length_and_bounds_without_extent_hit_nothing():
    rng = np.random.default_rng(2)
    corners = SOUPS["scattered"](rng, 50).astype(np.float32)
    bvh = soup_bvh(corners).bvh
    origin = corners[:, 0]
    for zero in (0.0, -0.0):
        hits = trace_both(bvh, 0, origin, np.full((50, 3), zero), np.full(50, FAR))
        assert (hits.primitive == -1).all() and (hits.t == np.float32(FAR)).all() and not hits.blocked.any()
    direction = rng.normal(size=(50, 3))
    for bound in (0.0, -1.0):
        assert not trace_both(bvh, 0, origin, direction, np.full(50, bound)).blocked.any()


def test_a_stream_of_any_length_leaves_other_slots_alone():
    """No ray, fewer than are in flight, and more; the queue names every second slot."""
    rng = np.random.default_rng(4)
    corners = SOUPS["scattered"](rng, 50).astype(np.float32)
    bvh = soup_bvh(corners).bvh
    for count in (0, 1, 15, 16, 17, 100):
        origin, direction = hard_rays(rng, corners, 2 * count + 2)
        expected = trace(portable_kernel, bvh, 0, origin, direction)
        slots = 2 * np.arange(count)
        out = launch(stream_kernel, triangles_below(bvh, 0), origin, direction, slots=slots, fill=-7)
        primitive, blocked = out.primitive, out.blocked
        assert (primitive[: 2 * count : 2] == expected.primitive[: 2 * count : 2]).all()
        assert (blocked[: 2 * count : 2] == expected.blocked[: 2 * count : 2]).all()
        assert all((a[1::2] == -7).all() and (a[2 * count :] == -7).all() for a in vars(out).values())
