"""From a binary tree to a wide one: what becomes a child, by dynamic programming (Ylitie, Karras and Laine 2017).

C(n, i) is the least cost, by the surface area heuristic, of representing the boxes below node n by at most i children
of some wide node. A node is one child, as a leaf or as a wide node of its own, or hands its places on to both its
children: C(n, i) = min over 0 < k < i of C(left, k) + C(right, i - k).
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import warp as wp

from wavefront.accel.ploc import BinaryTree, Tree, half_area

WIDTH = 8  # children of a node
NODE_COST = 1.0  # of visiting a node
BLOCK_COST = 0.8  # of the tests of a block of a leaf, over that
EMPTY = wp.constant(-2147483648)  # the link of a place without a child

wp.set_module_options({"enable_backward": False})

Costs = wp.types.vector(length=WIDTH, dtype=wp.float32)
Children = wp.types.vector(length=WIDTH, dtype=wp.int32)


@wp.func
def leaf_cost(area: float, count: int, block: int, max_blocks: int) -> float:
    blocks = (count + block - 1) // block
    cost = float(wp.inf)
    if blocks <= max_blocks:
        cost = area * BLOCK_COST * float(blocks)
    return cost


@wp.func
def split(left: Costs, right: Costs, places: int):
    """How many of `places` children go to the left, and the cost."""
    best = int(1)
    least = float(wp.inf)
    for k in range(1, places):
        cost = left[k - 1] + right[places - k - 1]
        if cost < least:
            least = cost
            best = k
    return best, least


@wp.kernel
def find_costs(tree: Tree, first: int, block: int, max_blocks: int, costs: wp.array[Costs]):
    """C(n, i + 1) at [i] for the nodes of one round; the last entry is that of the node as a wide node."""
    node = first + wp.tid()
    area = half_area(tree.lower[node], tree.upper[node])
    c = Costs()
    leaf = leaf_cost(area, tree.count[node], block, max_blocks)
    children = tree.children[node]
    if children[0] < 0:
        for i in range(WIDTH):
            c[i] = leaf
    else:
        left = costs[children[0]]
        right = costs[children[1]]
        _k, below = split(left, right, WIDTH)
        inner = below + area * NODE_COST
        c[0] = wp.min(leaf, inner)
        for i in range(2, WIDTH):
            _places, distributed = split(left, right, i)
            c[i - 1] = wp.min(c[i - 2], distributed)
        c[WIDTH - 1] = inner
    costs[node] = c


@wp.kernel
def find_ranges(tree: Tree, first: int, ranges: wp.array[wp.int32]):
    """Where the boxes below each node begin in the order of leaves; for nodes of one round, after those above."""
    node = first + wp.tid()
    children = tree.children[node]
    ranges[children[0]] = ranges[node]
    ranges[children[1]] = ranges[node] + tree.count[children[0]]


@wp.kernel
def order_boxes(boxes: wp.array[wp.int32], ranges: wp.array[wp.int32], order: wp.array[wp.int32]):
    i = wp.tid()
    order[ranges[i]] = boxes[i]


@wp.func
def is_leaf(tree: Tree, costs: wp.array[Costs], node: int, block: int, max_blocks: int) -> bool:
    """Whether a node that takes one place is a leaf."""
    if tree.children[node][0] < 0:
        return True
    if tree.count[node] > block * max_blocks:
        return False
    area = half_area(tree.lower[node], tree.upper[node])
    return leaf_cost(area, tree.count[node], block, max_blocks) <= costs[node][WIDTH - 1]


@wp.kernel
def expand(
    tree: Tree,
    costs: wp.array[Costs],
    roots: wp.array[wp.int32],
    block: int,
    max_blocks: int,
    # out
    children: wp.array[Children],
    inner: wp.array[wp.int32],
    blocks: wp.array[wp.int32],
):
    """Children of the wide nodes of one level, as nodes of the binary tree, with how many are not leaves."""
    i = wp.tid()
    root = roots[i]
    found = Children()
    inner_count = int(0)
    block_count = int(0)
    n = int(0)
    if is_leaf(tree, costs, root, block, max_blocks) and tree.children[root][0] < 0:
        found[0] = root  # a tree of one box
        n = 1
        block_count = 1
    else:
        # Nodes that still have to be given their places.
        nodes = Children()
        places = Children()
        top = int(1)
        nodes[0] = root
        places[0] = WIDTH
        while top > 0:
            top -= 1
            node = nodes[top]
            p = places[top]
            handed_on = node == root
            if p > 1 and not handed_on and tree.children[node][0] >= 0:
                # As many places as are of use.
                while p > 1 and costs[node][p - 1] >= costs[node][p - 2]:
                    p -= 1
                handed_on = p > 1
            if handed_on:
                below = tree.children[node]
                k, _least = split(costs[below[0]], costs[below[1]], p)
                nodes[top] = below[1]
                places[top] = p - k
                nodes[top + 1] = below[0]
                places[top + 1] = k
                top += 2
            else:
                found[n] = node
                n += 1
                if is_leaf(tree, costs, node, block, max_blocks):
                    block_count += (tree.count[node] + block - 1) // block
                else:
                    inner_count += 1
    for k in range(n, WIDTH):
        found[k] = -1
    children[i] = found
    inner[i] = inner_count
    blocks[i] = block_count


@wp.kernel
def link(
    tree: Tree,
    costs: wp.array[Costs],
    children: wp.array[Children],
    inner: wp.array[wp.int32],
    blocks: wp.array[wp.int32],
    ranges: wp.array[wp.int32],
    block: int,
    max_blocks: int,
    first_node: int,
    next_node: int,
    next_block: int,
    # out
    links: wp.array[Children],
    roots: wp.array[wp.int32],
    block_ranges: wp.array[wp.vec2i],
):
    """Numbers the children of one level, and lists the roots of the next; `inner` and `blocks` are inclusive sums.

    A link is the number of a wide node, or ~(first block * max_blocks + blocks - 1), or `EMPTY`.
    """
    i = wp.tid()
    node_index = int(0)
    block_index = int(0)
    if i > 0:
        node_index = inner[i - 1]
        block_index = blocks[i - 1]
    found = children[i]
    out = Children()
    for k in range(WIDTH):
        node = found[k]
        if node < 0:
            out[k] = EMPTY
        elif is_leaf(tree, costs, node, block, max_blocks):
            count = tree.count[node]
            n = (count + block - 1) // block
            out[k] = ~((next_block + block_index) * max_blocks + n - 1)
            for b in range(n):
                start = ranges[node] + b * block
                block_ranges[next_block + block_index + b] = wp.vec2i(start, wp.min(block, count - b * block))
            block_index += n
        else:
            out[k] = next_node + node_index
            roots[node_index] = node
            node_index += 1
    links[first_node + i] = out


@dataclasses.dataclass
class WideTree:
    """What `collapse` made.

    Attributes:
        links: Of each node, see `link`; node 0 is the root, and each level comes after the one above.
        levels: First node of each level, and the number of nodes.
        block_ranges: First box of each block of a leaf in `order`, and how many it has.
        order: Index of each box.
    """

    links: wp.array
    levels: list[int]
    block_ranges: wp.array
    order: wp.array


def collapse(binary: BinaryTree, block: int, max_blocks: int) -> WideTree:
    """Chooses the children of wide nodes.

    Args:
        binary: The tree.
        block: Boxes that one block of a leaf holds.
        max_blocks: Of a leaf.
    """
    tree, device, n = binary.tree, binary.boxes.device, binary.boxes.shape[0]
    total = 2 * n - 1
    costs = wp.empty(total, dtype=Costs, device=device)
    rounds = list(itertools.pairwise(binary.starts))
    for first, end in rounds:
        wp.launch(find_costs, end - first, inputs=[tree, first, block, max_blocks], outputs=[costs], device=device)
    ranges = wp.zeros(total, dtype=wp.int32, device=device)
    for first, end in reversed(rounds[1:]):
        wp.launch(find_ranges, end - first, inputs=[tree, first], outputs=[ranges], device=device)
    order = wp.empty(n, dtype=wp.int32, device=device)
    wp.launch(order_boxes, n, inputs=[binary.boxes, ranges], outputs=[order], device=device)

    # A wide node has two children or more, and so there are fewer of them than boxes.
    links = wp.empty(n, dtype=Children, device=device)
    block_ranges = wp.empty(n, dtype=wp.vec2i, device=device)
    roots = wp.array(np.array([total - 1], np.int32), device=device)
    levels, block_count = [0, 1], 0
    while True:
        first, count = levels[-2], levels[-1] - levels[-2]
        if count == 0:
            break
        children = wp.empty(count, dtype=Children, device=device)
        inner, blocks = (wp.empty(count, dtype=wp.int32, device=device) for _ in range(2))
        inputs = [tree, costs, roots, block, max_blocks]
        wp.launch(expand, count, inputs=inputs, outputs=[children, inner, blocks], device=device)
        for array in (inner, blocks):
            wp.utils.array_scan(array, array)
        next_count, next_blocks = (int(array[count - 1 : count].numpy()[0]) for array in (inner, blocks))
        roots = wp.empty(max(next_count, 1), dtype=wp.int32, device=device)
        inputs = [tree, costs, children, inner, blocks, ranges, block, max_blocks, first, levels[-1], block_count]
        wp.launch(link, count, inputs=inputs, outputs=[links, roots, block_ranges], device=device)
        levels.append(levels[-1] + next_count)
        block_count += next_blocks
    del levels[-1]
    # Copies, for views would keep the whole of the arrays, most of which is unused.
    return WideTree(wp.clone(links[: levels[-1]]), levels, wp.clone(block_ranges[:block_count]), order)
