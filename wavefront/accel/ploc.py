"""A binary hierarchy of boxes by parallel locally-ordered clustering (Meister and Bittner 2018).

The boxes are put in the order of a Morton curve. Then, again and again, each cluster looks for the neighbour within a
few places of that order with which it shares the smallest box, and those that chose each other become one cluster. The
result does not depend on the device or on the order in which threads run.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import warp as wp

RADIUS = 16  # places to either side that a cluster looks at; more makes better trees, and takes longer

wp.set_module_options({"enable_backward": False})


@wp.struct
class Tree:
    """A binary tree of n boxes: nodes 0 to n-1 are boxes in Morton order, the others have children of lower index."""

    lower: wp.array[wp.vec3]
    upper: wp.array[wp.vec3]
    children: wp.array[wp.vec2i]  # empty box: leaf
    count: wp.array[wp.int32]  # boxes below


@dataclasses.dataclass
class BinaryTree:
    """What `build_binary` made.

    Attributes:
        tree: On the device; the last node is the root.
        boxes: Index of the box that each leaf has.
        starts: First node of each round of clustering, and the number of nodes. Children are of earlier rounds.
    """

    tree: Tree
    boxes: wp.array
    starts: list[int]


@wp.func
def half_area(lower: wp.vec3, upper: wp.vec3) -> float:
    """Half of the surface area of a box."""
    d = upper - lower
    return d[0] * d[1] + d[1] * d[2] + d[2] * d[0]


@wp.func
def spread_bits(x: wp.uint64) -> wp.uint64:
    """The lowest 21 bits, two places apart."""
    x = (x | (x << wp.uint64(32))) & wp.uint64(0x1F00000000FFFF)
    x = (x | (x << wp.uint64(16))) & wp.uint64(0x1F0000FF0000FF)
    x = (x | (x << wp.uint64(8))) & wp.uint64(0x100F00F00F00F00F)
    x = (x | (x << wp.uint64(4))) & wp.uint64(0x10C30C30C30C30C3)
    return (x | (x << wp.uint64(2))) & wp.uint64(0x1249249249249249)


@wp.kernel
def morton_codes(
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    origin: wp.vec3,
    scale: float,
    # out
    keys: wp.array[wp.int64],
    boxes: wp.array[wp.int32],
):
    i = wp.tid()
    # Halves first: the sum of large coordinates may not fit.
    p = (0.5 * lower[i] + 0.5 * upper[i] - origin) * scale
    x = wp.uint64(wp.clamp(p[0], 0.0, 2097151.0))
    y = wp.uint64(wp.clamp(p[1], 0.0, 2097151.0))
    z = wp.uint64(wp.clamp(p[2], 0.0, 2097151.0))
    keys[i] = wp.int64(spread_bits(x) | (spread_bits(y) << wp.uint64(1)) | (spread_bits(z) << wp.uint64(2)))
    boxes[i] = i


@wp.kernel
def make_leaves(
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    boxes: wp.array[wp.int32],
    # out
    tree: Tree,
    clusters: wp.array[wp.int32],
):
    i = wp.tid()
    tree.lower[i] = lower[boxes[i]]
    tree.upper[i] = upper[boxes[i]]
    tree.children[i] = wp.vec2i(-1, -1)
    tree.count[i] = 1
    clusters[i] = i


@wp.kernel
def find_neighbours(tree: Tree, clusters: wp.array[wp.int32], count: int, radius: int, neighbours: wp.array[wp.int32]):
    """The other cluster with which the common box is smallest; among equals that with the smallest i xor j.

    Both keys are those of the pair, so the best pair of all chooses each other, and equal boxes pair off at once.
    """
    i = wp.tid()
    lower = tree.lower[clusters[i]]
    upper = tree.upper[clusters[i]]
    best = wp.min(i ^ 1, count - 1)  # without a radius: pairs, and the last one alone
    least = float(wp.inf)
    for j in range(wp.max(i - radius, 0), wp.min(i + radius + 1, count)):
        if j != i:
            node = clusters[j]
            area = half_area(wp.min(lower, tree.lower[node]), wp.max(upper, tree.upper[node]))
            if area < least or (area == least and (i ^ j) < (i ^ best)):
                least = area
                best = j
    neighbours[i] = best


@wp.kernel
def mark(neighbours: wp.array[wp.int32], kept: wp.array[wp.int32], merged: wp.array[wp.int32]):
    """What is left of each place (1, or 0 where another place takes the pair) and whether a pair is made there."""
    i = wp.tid()
    j = neighbours[i]
    paired = neighbours[j] == i and j != i
    kept[i] = wp.where(paired and i > j, 0, 1)
    merged[i] = wp.where(paired and i < j, 1, 0)


@wp.kernel
def merge(
    clusters: wp.array[wp.int32],
    neighbours: wp.array[wp.int32],
    places: wp.array[wp.int32],
    pairs: wp.array[wp.int32],
    first: int,
    # out
    tree: Tree,
    next_clusters: wp.array[wp.int32],
):
    """`places` and `pairs` are the inclusive sums of what `mark` found."""
    i = wp.tid()
    before = int(0)
    pairs_before = int(0)
    if i > 0:
        before = places[i - 1]
        pairs_before = pairs[i - 1]
    if places[i] == before:
        return
    node = clusters[i]
    if pairs[i] > pairs_before:
        left = node
        right = clusters[neighbours[i]]
        node = first + pairs_before
        tree.lower[node] = wp.min(tree.lower[left], tree.lower[right])
        tree.upper[node] = wp.max(tree.upper[left], tree.upper[right])
        tree.children[node] = wp.vec2i(left, right)
        tree.count[node] = tree.count[left] + tree.count[right]
    next_clusters[before] = node


def build_binary(lower: wp.array, upper: wp.array, radius: int = RADIUS) -> BinaryTree:
    """Builds a tree over boxes.

    Args:
        lower, upper: Corners, [N] vec3, N >= 1, finite.
        radius: See `RADIUS`; 0 pairs neighbours in Morton order, for a depth of log2 N.
    """
    n, device = lower.shape[0], lower.device
    corners = np.stack([lower.numpy(), upper.numpy()])
    centers = 0.5 * corners[0] + 0.5 * corners[1]
    origin, extent = centers.min(axis=0), float(np.ptp(centers, axis=0).max())
    keys, boxes = (wp.empty(2 * n, dtype=dtype, device=device) for dtype in (wp.int64, wp.int32))
    # Not finer than a float32 resolves: 1 / extent may overflow.
    scale = 2097152.0 / max(extent, 1e-30)
    wp.launch(
        morton_codes, n, inputs=[lower, upper, wp.vec3(*origin.tolist()), scale], outputs=[keys, boxes], device=device
    )
    wp.utils.radix_sort_pairs(keys, boxes, n)

    tree = Tree()
    for name, dtype in (("lower", wp.vec3), ("upper", wp.vec3), ("children", wp.vec2i), ("count", wp.int32)):
        setattr(tree, name, wp.empty(2 * n - 1, dtype=dtype, device=device))
    names = ("clusters", "next", "neighbours", "kept", "merged", "places", "pairs")
    work = {name: wp.empty(n, dtype=wp.int32, device=device) for name in names}
    wp.launch(make_leaves, n, inputs=[lower, upper, boxes], outputs=[tree, work["clusters"]], device=device)
    starts = [0, n]
    count = n
    while count > 1:
        w = {name: array[:count] for name, array in work.items()}
        wp.launch(find_neighbours, count, inputs=[tree, w["clusters"], count, radius, w["neighbours"]], device=device)
        wp.launch(mark, count, inputs=[w["neighbours"]], outputs=[w["kept"], w["merged"]], device=device)
        wp.utils.array_scan(w["kept"], w["places"])
        wp.utils.array_scan(w["merged"], w["pairs"])
        inputs = [w["clusters"], w["neighbours"], w["places"], w["pairs"], starts[-1]]
        wp.launch(merge, count, inputs=inputs, outputs=[tree, w["next"]], device=device)
        left = int(w["places"][count - 1 : count].numpy()[0])
        starts.append(starts[-1] + count - left)
        count = left
        work["clusters"], work["next"] = work["next"], work["clusters"]
    return BinaryTree(tree, boxes[:n], starts)
