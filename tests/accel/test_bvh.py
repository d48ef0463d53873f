"""Trees against what they were built of: a walk of the tables in NumPy, which shares no code with the build."""

import dataclasses
import itertools

import numpy as np
import pytest
import warp as wp

from tests.accel.oracle import check, judge
from tests.accel.soups import CLOSED, SOUPS, hard_rays
from tests.accel.tracing import DEVICE, check_any, portable_kernel, soup_bvh, trace_both, vectors
from tests.test_cuda_compile import built, compile_modules
from wavefront.accel import bvh as bvh_module
from wavefront.accel import collapse, ploc
from wavefront.accel.bvh import BoxBvh, TriangleBvh, place

EMPTY = -(2**31)
NODE_COST, BLOCK_COST = 1.0, 0.8


@dataclasses.dataclass
class Walk:
    """What lies below a root, which comes last: the members of each leaf, each box as (its corners, the widths of the
    cells to which these are rounded, the members below it, whether it is a leaf, its blocks), each node as (its number,
    the widths of its cells, the members below it, the corners of all boxes of its children), and levels."""

    leaves: list
    boxes: list
    nodes: list
    levels: int


def walk(bvh, root: int, block: int, max_blocks: int) -> Walk:
    """Follows the links, and nothing else, from the root to the leaves."""
    tables = bvh.nodes.numpy().reshape(-1, 28)
    vectors = bvh.blocks.numpy().reshape(-1, 40)
    out = Walk([], [], [], 0)

    def below(node, level):
        out.levels = max(out.levels, level)
        origin, widths = tables[node, :3].astype(np.longdouble), tables[node, 4:7].astype(np.longdouble)
        cells = tables[node, 16:].view(np.uint8).reshape(2, 3, 8)
        corners = origin[:, None] + cells * widths[:, None]
        links = tables[node, 8:16].view(np.int32)
        found = []
        for k in range(8):
            link = int(links[k])
            if link == EMPTY:
                assert (corners[0, :, k] > corners[1, :, k]).all() or (widths == 0.0).any()
                continue
            blocks = 0
            if link >= 0:
                members = below(link, level + 1)
            else:
                first, blocks = divmod(-1 - link, max_blocks)
                blocks += 1
                members = [first]
                if block == 4:
                    members = vectors[first : first + blocks, -4:].view(np.int32).ravel().tolist()
                    empty = np.array(members).reshape(-1, 4) < 0
                    places = np.isnan(vectors[first : first + blocks, :36].reshape(-1, 9, 4))
                    assert (places == empty[:, None]).all()
                count = len([m for m in members if m >= 0])
                assert 0 < count <= block * blocks and count > block * (blocks - 1)
                members = [m for m in members if m >= 0]
                out.leaves.append(members)
            out.boxes.append((corners[:, :, k].copy(), widths, members, link < 0, blocks))
            found += members
        used = links != EMPTY
        corners = np.array([corners[0, :, used].min(axis=0), corners[1, :, used].max(axis=0)])
        out.nodes.append((node, widths, found, corners))
        return found

    below(root, 1)
    return out


def check_tree(hierarchy, lower, upper, first: int = 0, block: int = 4, max_blocks: int = 2) -> Walk:
    """Each box in one leaf, each child's box that of what is below but for less than a cell, and the statistics.

    Corners are rounded to float32 as a ray finds them.
    """
    found = walk(hierarchy.bvh, hierarchy.first_node, block, max_blocks)
    assert sorted(itertools.chain(*found.leaves)) == list(range(first, first + len(lower)))
    nodes = range(hierarchy.first_node, hierarchy.first_node + hierarchy.node_count)
    assert sorted(n[0] for n in found.nodes) == list(nodes)
    for corners, widths, members, _leaf, _blocks in found.boxes:
        below = np.array(members) - first
        low, high = lower[below].min(axis=0), upper[below].max(axis=0)
        lowest, highest, less, more = (
            c.astype(np.float32) for c in (*corners, corners[0] + widths, corners[1] - widths)
        )
        assert (lowest <= low).all() and (high <= highest).all()
        assert ((less > low) & (more < high) | (widths == 0.0)).all()
    for _node, _widths, members, (lowest, highest) in found.nodes:  # the grid spans the node
        below = np.array(members) - first
        low, high = lower[below].min(axis=0), upper[below].max(axis=0)
        assert (lowest == low).all() and (highest.astype(np.float32) >= high).all()
        assert (highest - high <= 4e-7 * (high.astype(np.longdouble) - low) + np.spacing(np.abs(high))).all()
    statistics = hierarchy.statistics()
    leaf = np.array([b[3] for b in found.boxes])
    blocks = np.array([b[4] for b in found.boxes])
    assert statistics.primitives == len(lower)
    assert statistics.nodes == len(found.nodes) == hierarchy.node_count
    assert statistics.leaves == leaf.sum() == len(found.leaves)
    assert statistics.levels == found.levels <= bvh_module.MAX_LEVELS
    assert hierarchy.block_count == blocks.sum()
    assert statistics.bytes == 112 * len(found.nodes) + (160 * blocks.sum() if block == 4 else 0)
    assert statistics.seconds > 0.0
    areas, root = np.array([half_area(*b[0]) for b in found.boxes]), half_area(*found.nodes[-1][3])
    node_visits = block_visits = 0.0
    if root > 0.0:
        node_visits, block_visits = 1.0 + areas[~leaf].sum() / root, (areas * blocks).sum() / root
    figures = statistics.node_visits, statistics.block_visits, statistics.sah_cost
    cost = NODE_COST * node_visits + BLOCK_COST * block_visits
    np.testing.assert_allclose(figures, (node_visits, block_visits, cost), rtol=1e-9)
    return found


def half_area(lower, upper):
    d = upper - lower
    return d[..., 0] * d[..., 1] + d[..., 1] * d[..., 2] + d[..., 2] * d[..., 0]


def bounds(corners):
    corners = np.asarray(corners, np.float32)
    return corners.min(axis=1), corners.max(axis=1)


@pytest.mark.parametrize("soup", SOUPS)
def test_each_triangle_is_in_one_leaf_and_boxes_are_exact(soup):
    for count in (1, 2, 3, 4, 5, 8, 9, 33, 1000):
        for scale in (1.0, 1e12, 1e-12, 1e25):  # the squares of the last do not fit a float32
            corners = np.float32(scale * SOUPS[soup](np.random.default_rng(count), count))
            check_tree(soup_bvh(corners), *bounds(corners))


def test_triangles_without_extent_make_a_tree():
    """All in one point, and all on one line."""
    rng = np.random.default_rng(1)
    for corners in (np.ones((500, 3, 3)), rng.random((500, 3, 1)) * np.ones(3), rng.random((500, 3, 1)) * (1.0, 0, 0)):
        check_tree(soup_bvh(corners), *bounds(corners))


def table_bits(bvh):
    return bvh.links.numpy().copy(), bvh.primitives.numpy().copy()


def test_two_builds_are_equal_bit_for_bit():
    vertices, faces = CLOSED["displaced_sphere"]()
    tables = []
    for _ in range(2):
        indices = wp.array(faces.astype(np.int32).ravel(), device=DEVICE)
        bvh = TriangleBvh(vectors(vertices), indices).bvh
        tables.append(table_bits(bvh))
    for a, b in zip(*tables, strict=True):
        assert (a == b).all()


# --- depth -------------------------------------------------------------------------------------------------------


def geometric(count, ratio=2.0):
    """Side by side, each `ratio` times as wide as the one before, and of equal height."""
    x = ratio ** (np.arange(count + 1) - 0.5 * count)
    corners = np.zeros((count, 3, 3))
    corners[:, :, 0] = x[:-1, None]
    corners[:, 1, 0] = x[1:]
    corners[:, 2, 1] = 1.0
    corners[:, :, 2] = 0.5
    return corners.astype(np.float32)


def levels_of(corners):
    lower, upper = (vectors(a) for a in bounds(corners))
    return len(collapse.collapse(ploc.build_binary(lower, upper), 4, 2).levels) - 1


def test_a_chain_of_boxes_falls_back_to_a_shallow_tree():
    """Clusters of a geometric progression grow by one neighbour at a time; such a tree would overflow the stack."""
    corners = geometric(240)
    assert levels_of(corners) > bvh_module.MAX_LEVELS
    check_tree(soup_bvh(corners), *bounds(corners))


def test_the_deepest_tree_that_is_kept_has_room_on_the_stack():
    """Rays along all boxes, so that each level leaves as much as it can for later."""
    count = next(n for n in range(120, 240) if levels_of(geometric(n, 1.7)) == bvh_module.MAX_LEVELS)
    corners = geometric(count, 1.7)
    hierarchy = soup_bvh(corners)
    assert check_tree(hierarchy, *bounds(corners)).levels == bvh_module.MAX_LEVELS
    rng = np.random.default_rng(6)
    origin, direction = hard_rays(rng, corners, 1000)
    along = rng.uniform(0.1, 0.5, 1000)
    rays = np.stack([corners[:, :, 0].max() * np.ones(1000), along, 0.5 + 1e-3 * rng.random(1000)], -1)
    origin = np.concatenate([origin, rays]).astype(np.float32)
    direction = np.concatenate([direction, np.tile([[-1.0, 0.0, 0.0]], (1000, 1))]).astype(np.float32)
    hits = trace_both(hierarchy.bvh, 0, origin, direction)
    check(judge(corners, origin, direction), hits)
    check_any(hierarchy.bvh, 0, origin, direction, hits)


# --- quality -----------------------------------------------------------------------------------------------------


def top_down_cost(lower, upper):
    """Sum of the half areas of the inner nodes of a tree of which each split is the best of all along the axes."""
    count = len(lower)
    if count == 1:
        return 0.0
    best, parts = np.inf, None
    for axis in range(3):
        order = np.argsort(lower[:, axis] + upper[:, axis], kind="stable")
        areas = []
        for o in (order, order[::-1]):
            low, high = np.minimum.accumulate(lower[o]), np.maximum.accumulate(upper[o])
            areas.append(half_area(low, high)[:-1] * np.arange(1, count))
        cost = areas[0] + areas[1][::-1]
        k = int(cost.argmin())
        if cost[k] < best:
            best, parts = cost[k], (order[: k + 1], order[k + 1 :])
    own = half_area(lower.min(axis=0), upper.max(axis=0))
    return own + sum(top_down_cost(lower[p], upper[p]) for p in parts)


def binary_cost(lower, upper, radius):
    """The same sum, of a tree by clustering."""
    tree = ploc.build_binary(vectors(lower), vectors(upper), radius).tree
    inner = slice(len(lower), None)
    return half_area(tree.lower.numpy()[inner].astype(np.float64), tree.upper.numpy()[inner].astype(np.float64)).sum()


def test_clusters_are_as_good_as_the_best_splits():
    """Ratio of costs, mean over soups; a build that pairs neighbours along the Morton curve is far behind."""
    clusters, pairs = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        if seed % 2:
            corners = rng.random((400, 1, 3)) + 0.03 * rng.normal(size=(400, 3, 3))
        else:  # of all sizes
            corners = rng.normal(size=(400, 1, 3)) + 10.0 ** rng.uniform(-3, 0, (400, 1, 1)) * rng.normal(
                size=(400, 3, 3)
            )
        lower, upper = bounds(corners)
        best = top_down_cost(lower.astype(np.float64), upper.astype(np.float64))
        clusters.append(binary_cost(lower, upper, ploc.RADIUS) / best)
        pairs.append(binary_cost(lower, upper, 0) / best)
    assert np.mean(clusters) < 1.1, clusters
    assert np.mean(pairs) > 1.3 * np.mean(clusters), (clusters, pairs)


@pytest.mark.parametrize("block", [1, 4])
def test_a_wide_tree_has_the_least_cost(block):
    """Of all that can be made of the binary tree, found by recursion in float64."""
    max_blocks = 1 if block == 1 else 2
    for seed, count in ((1, 7), (2, 40), (3, 700)):
        corners = SOUPS["scattered"](np.random.default_rng(seed), count).astype(np.float32)
        lower, upper = bounds(corners)
        tree = ploc.build_binary(vectors(lower), vectors(upper)).tree
        area = half_area(tree.lower.numpy().astype(np.float64), tree.upper.numpy().astype(np.float64))
        children, counts = tree.children.numpy(), tree.count.numpy()
        least = np.empty((len(area), 9))  # [n, i]: in at most i places
        for n in range(len(area)):
            blocks = -(-counts[n] // block)
            leaf = BLOCK_COST * blocks * area[n] if blocks <= max_blocks else np.inf
            left, right = children[n]
            if left < 0:
                least[n] = leaf
                continue
            divided = [min(least[left, k] + least[right, i - k] for k in range(1, i)) for i in range(2, 9)]
            wide = NODE_COST * area[n] + divided[-1]
            least[n, 1] = min(leaf, wide)
            for i in range(2, 9):
                least[n, i] = min(least[n, 1], divided[i - 2])
        hierarchy = soup_bvh(corners) if block == 4 else BoxBvh(vectors(lower), vectors(upper))
        found = walk(hierarchy.bvh, 0, block, max_blocks)
        cost = NODE_COST * area[-1]
        for _corners, _widths, members, is_leaf, blocks in found.boxes:  # before they are rounded
            box = half_area(lower[members].min(axis=0).astype(np.float64), upper[members].max(axis=0))
            cost += box * (BLOCK_COST * blocks if is_leaf else NODE_COST)
        # The root is a wide node in any case. Costs of float32 may choose another one of equals.
        assert cost == pytest.approx(wide, rel=1e-5)
        assert hierarchy.statistics().sah_cost < 1.1 * wide / area[-1]


# --- moving geometry, common tables ------------------------------------------------------------------------------


def test_refit_follows_the_vertices():
    rng = np.random.default_rng(9)
    corners = SOUPS["scattered"](rng, 300).astype(np.float32)
    hierarchy = soup_bvh(corners)
    before = table_bits(hierarchy.bvh)
    hierarchy.refit(vectors(corners))
    assert all((a == b).all() for a, b in zip(before, table_bits(hierarchy.bvh), strict=True))
    for moved in (corners * (1.0, -2.0, 0.5) + 0.3 * rng.normal(size=corners.shape), corners[::-1] + 100.0):
        moved = moved.astype(np.float32)
        hierarchy.refit(vectors(moved))
        check_tree(hierarchy, *bounds(moved))
        origin, direction = hard_rays(rng, moved, 2000)
        check(judge(moved, origin, direction), trace_both(hierarchy.bvh, 0, origin, direction))


def test_hierarchies_in_common_tables_stay_apart():
    """Each is traced from its root, has numbers of its own, and is refitted alone."""
    rng = np.random.default_rng(10)
    soups = [
        SOUPS[s](rng, n).astype(np.float32) for s, n in (("scattered", 100), ("axis_aligned", 1), ("slivers", 333))
    ]
    firsts, starts = [1000, 0, 1], [0, 100, 101, 434]
    points = vectors(np.concatenate(soups))
    corner_numbers = np.arange(3 * starts[-1], dtype=np.int32)
    hierarchies = [
        TriangleBvh(points, wp.array(corner_numbers[3 * i : 3 * j], device=DEVICE), first, alone=False)
        for (i, j), first in zip(itertools.pairwise(starts), firsts, strict=True)
    ]
    bvh = place([(h, points) for h in hierarchies])
    assert [h.first_node for h in hierarchies] == [0, *np.cumsum([h.node_count for h in hierarchies])[:-1]]

    def check_all():
        for h, corners, first in zip(hierarchies, soups, firsts, strict=True):
            assert h.bvh is bvh
            check_tree(h, *bounds(corners), first)
            origin, direction = hard_rays(rng, corners, 1000)
            check(judge(corners, origin, direction), trace_both(bvh, h.first_node, origin, direction), first)

    check_all()
    for k in (2, 0, 1):
        soups[k] = (soups[k] * (0.5, 3.0, -1.0) + 7.0).astype(np.float32)
        hierarchies[k].refit(vectors(np.concatenate(soups)))
        check_all()


@pytest.mark.parametrize("count", [1, 2, 8, 9, 500])
def test_each_box_is_in_one_leaf_of_a_hierarchy_of_boxes(count):
    rng = np.random.default_rng(count)
    lower, upper = bounds(SOUPS["all_sizes"](rng, count))
    upper[::5] = lower[::5]  # points
    hierarchy = BoxBvh(vectors(lower), vectors(upper))
    check_tree(hierarchy, lower, upper, block=1, max_blocks=1)
    before = table_bits(hierarchy.bvh)
    hierarchy.refit(vectors(lower), vectors(upper))
    assert all((a == b).all() for a, b in zip(before, table_bits(hierarchy.bvh), strict=True))
    lower, upper = bounds(SOUPS["scattered"](rng, count))
    hierarchy.refit(vectors(lower), vectors(upper))
    check_tree(hierarchy, lower, upper, block=1, max_blocks=1)


def test_build_and_traversal_compile_for_cuda(tmp_path):
    modules = [ploc, collapse, bvh_module, portable_kernel.module]
    assert compile_modules(modules, 90, tmp_path) == built(tmp_path)
