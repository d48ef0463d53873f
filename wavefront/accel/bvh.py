"""Hierarchies with eight children a node, over triangles and over boxes, as the traversal reads them.

A node is 112 bytes, much as that of Ylitie, Karras and Laine (2017): the origin of a grid and the widths of its cells,
each a vector of four, eight links (see `wavefront.accel.collapse.link`), and the corners of the boxes of its children
in cells, a byte each: the lower x of all eight, then y and z, then the upper ones. The grid spans the box of the node,
and the sides of that stay where they are, for rays start from walls that lie in them; other corners are rounded
outwards by at most a cell. A leaf is one or two blocks of four triangles: the x of their first vertices, then y and z,
then those of the second and third vertices, then the indices of the triangles; places without a triangle hold NaN. So
that eight boxes or four triangles are tested at once, each with one vector instruction a coordinate. In a hierarchy of
boxes a leaf is a box, and its link the box's number.
"""

from __future__ import annotations

import dataclasses
import itertools
import time

import numpy as np
import warp as wp

from wavefront.accel import collapse, ploc
from wavefront.accel.collapse import BLOCK_COST, EMPTY, NODE_COST, WIDTH, Children, WideTree

BLOCK = 4  # triangles of a block
MAX_BLOCKS = 2  # of a leaf
NODE_VECTORS = 7
BLOCK_VECTORS = 10
MAX_LEVELS = 22  # of a hierarchy
STACK_SIZE = 160  # entries a traversal needs: a level leaves seven nodes for later, and the last eight
CELLS = wp.constant(255)  # of the grid of a node along an axis

wp.set_module_options({"enable_backward": False})

Extents = wp.types.vector(length=WIDTH, dtype=wp.float32)
Corners = wp.types.matrix(shape=(3, WIDTH), dtype=wp.float32)


@wp.struct
class Bvh:
    """The tables of one or several hierarchies; each is named by its root."""

    nodes: wp.array[wp.vec4]
    links: wp.array[wp.vec4i]  # the same memory
    blocks: wp.array[wp.vec4]
    primitives: wp.array[wp.vec4i]  # the same memory


@wp.kernel
def triangle_bounds(
    points: wp.array[wp.vec3],
    indices: wp.array[wp.int32],
    # out
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
):
    i = wp.tid()
    a = points[indices[3 * i]]
    b = points[indices[3 * i + 1]]
    c = points[indices[3 * i + 2]]
    lower[i] = wp.min(wp.min(a, b), c)
    upper[i] = wp.max(wp.max(a, b), c)


@wp.kernel
def name_triangles(
    order: wp.array[wp.int32], block_ranges: wp.array[wp.vec2i], first_triangle: int, first_block: int, bvh: Bvh
):
    """Numbers of the triangles of each block."""
    i = wp.tid()
    numbers = wp.vec4i(-1)
    for k in range(block_ranges[i][1]):
        numbers[k] = first_triangle + order[block_ranges[i][0] + k]
    bvh.primitives[BLOCK_VECTORS * (first_block + i) + 9] = numbers


@wp.kernel
def write_blocks(
    points: wp.array[wp.vec3],
    indices: wp.array[wp.int32],
    first_triangle: int,
    first_block: int,
    # out
    bvh: Bvh,
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
):
    """Vertices of the triangles of each block, and its box."""
    i = wp.tid()
    block = BLOCK_VECTORS * (first_block + i)
    box_lower = wp.vec3(wp.inf)
    box_upper = wp.vec3(-wp.inf)
    for k in range(BLOCK):
        vertex = wp.vec3(wp.nan)
        primitive = bvh.primitives[block + 9][k]
        triangle = primitive - first_triangle
        for j in range(3):
            if primitive >= 0:
                vertex = points[indices[3 * triangle + j]]
                box_lower = wp.min(box_lower, vertex)
                box_upper = wp.max(box_upper, vertex)
            for axis in range(3):
                bvh.blocks[block + 3 * j + axis][k] = vertex[axis]
    lower[i] = box_lower
    upper[i] = box_upper


@wp.kernel
def name_boxes(order: wp.array[wp.int32], block_ranges: wp.array[wp.vec2i], first_box: int, first_node: int, bvh: Bvh):
    """From the links of blocks of one box, the first of them `first_box`, to those of the boxes themselves."""
    node = NODE_VECTORS * (first_node + wp.tid())
    for k in range(WIDTH):
        link = bvh.links[node + 2 + k // 4][k % 4]
        if link < 0 and link != EMPTY:
            bvh.links[node + 2 + k // 4][k % 4] = ~(first_box + order[block_ranges[~link - first_box][0]])


@wp.kernel
def write_links(links: wp.array[Children], node_offset: int, block_offset: int, bvh: Bvh):
    """Links among the tables of several hierarchies; `block_offset` is in units of the links of leaves."""
    i = wp.tid()
    for k in range(WIDTH):
        link = links[i][k]
        if link >= 0:
            link += node_offset
        elif link != EMPTY:
            link -= block_offset
        bvh.links[NODE_VECTORS * (node_offset + i) + 2 + k // 4][k % 4] = link


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __fmaf_rn((float)cell, width, origin);
#else
    return __builtin_fmaf((float)cell, width, origin);
#endif
""")
def grid_point(origin: float, width: float, cell: int) -> float:
    """Coordinate of the lower side of a cell, rounded once, so that it is the same wherever it is computed."""
    ...


@wp.func
def next_above(x: float) -> float:
    """The next larger number, of one that is not negative."""
    return wp.cast(wp.cast(x, wp.int32) + 1, wp.float32)


@wp.func
def cell_width(lower: float, upper: float) -> float:
    """The least with which `CELLS` cover an interval."""
    width = (0.5 * upper - 0.5 * lower) / (0.5 * float(CELLS))  # halves, for the extent may overflow
    while grid_point(lower, width, CELLS) < upper:
        width = next_above(width)
    return width


@wp.func
def cell_below(origin: float, width: float, x: float) -> int:
    """The last cell of which the lower side is not above x."""
    cell = int(0)
    if width > 0.0:
        cell = wp.clamp(int((x - origin) / width) + 1, 0, CELLS)
        while grid_point(origin, width, cell) > x:
            cell -= 1
    return cell


@wp.func
def cell_above(origin: float, width: float, x: float) -> int:
    """The first cell of which the lower side is not below x."""
    cell = int(0)
    if width > 0.0:
        cell = wp.clamp(int((x - origin) / width) - 1, 0, CELLS)
        while grid_point(origin, width, cell) < x:
            cell += 1
    return cell


@wp.kernel
def fit_nodes(
    bvh: Bvh,
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    max_blocks: int,
    first_block: int,
    first_node: int,
    offset: int,
    # in and out
    node_lower: wp.array[wp.vec3],
    node_upper: wp.array[wp.vec3],
):
    """Boxes of the nodes of one level and of their children, from those of blocks and of the level below.

    Those of nodes, counted from `first_node`, are exact: what one level is rounded by is not rounded again above.
    """
    i = offset + wp.tid()
    node = NODE_VECTORS * (first_node + i)
    low = Corners(wp.inf)
    high = Corners(-wp.inf)
    box_lower = wp.vec3(wp.inf)
    box_upper = wp.vec3(-wp.inf)
    for k in range(WIDTH):
        link = bvh.links[node + 2 + k // 4][k % 4]
        child_lower = wp.vec3(wp.inf)
        child_upper = wp.vec3(-wp.inf)
        if link >= 0:
            child_lower = node_lower[link - first_node]
            child_upper = node_upper[link - first_node]
        elif link != EMPTY:
            first = ~link // max_blocks - first_block
            for b in range(first, first + ~link % max_blocks + 1):
                child_lower = wp.min(child_lower, lower[b])
                child_upper = wp.max(child_upper, upper[b])
        for axis in range(3):
            low[axis, k] = child_lower[axis]
            high[axis, k] = child_upper[axis]
        box_lower = wp.min(box_lower, child_lower)
        box_upper = wp.max(box_upper, child_upper)
    node_lower[i] = box_lower
    node_upper[i] = box_upper
    for axis in range(3):
        origin = box_lower[axis]
        width = cell_width(origin, box_upper[axis])
        bvh.nodes[node][axis] = origin
        bvh.nodes[node + 1][axis] = width
        for half in range(2):
            lower_cells = int(0)
            upper_cells = int(0)
            for j in range(4):
                k = 4 * half + j
                # A place without a child has a box inside out, which few rays meet; its link tells.
                first_cell = int(CELLS)
                last_cell = int(0)
                if low[axis, k] <= high[axis, k]:
                    first_cell = cell_below(origin, width, low[axis, k])
                    last_cell = cell_above(origin, width, high[axis, k])
                lower_cells |= first_cell << (8 * j)
                upper_cells |= last_cell << (8 * j)
            bvh.links[node + 4 + (2 * axis + half) // 4][(2 * axis + half) % 4] = lower_cells
            bvh.links[node + 4 + (6 + 2 * axis + half) // 4][(6 + 2 * axis + half) % 4] = upper_cells


@dataclasses.dataclass(frozen=True)
class Statistics:
    """Of a hierarchy.

    Attributes:
        primitives, nodes, leaves: How many.
        levels: Of nodes.
        sah_cost: Expected nodes and blocks of leaves that a random line which meets the root's box visits, weighted by
            `NODE_COST` and `BLOCK_COST`.
        node_visits, block_visits: The same apart and without weights.
        bytes: Of its part of the tables.
        seconds: To build it.
    """

    primitives: int
    nodes: int
    leaves: int
    levels: int
    sah_cost: float
    node_visits: float
    block_visits: float
    bytes: int
    seconds: float


def _topology(lower: wp.array, upper: wp.array, block: int, max_blocks: int) -> WideTree:
    wide = collapse.collapse(ploc.build_binary(lower, upper), block, max_blocks)
    if len(wide.levels) - 1 > MAX_LEVELS:  # boxes within boxes: pairs along the Morton curve are as good, and shallow
        wide = collapse.collapse(ploc.build_binary(lower, upper, radius=0), block, max_blocks)
    return wide


class _Hierarchy:
    """What hierarchies over triangles and over boxes have in common."""

    def __init__(self, wide: WideTree, max_blocks: int, device):
        self.wide: WideTree | None = wide  # until it has its place in tables, which say the same
        self.levels, self.max_blocks, self.device = wide.levels, max_blocks, device
        self.primitive_count, self.block_count = wide.order.shape[0], wide.block_ranges.shape[0]
        self.first_node = self.first_block = 0
        self.bvh: Bvh | None = None
        self.build_seconds = 0.0

    @property
    def node_count(self) -> int:
        return self.levels[-1]

    def _place(self, bvh: Bvh, first_node: int, first_block: int) -> None:
        self.bvh, self.first_node, self.first_block = bvh, first_node, first_block
        inputs = [self.wide.links, first_node, first_block * self.max_blocks, bvh]
        wp.launch(write_links, self.node_count, inputs=inputs, device=self.device)
        self._name()
        self.wide = None

    def _fit(self, lower: wp.array, upper: wp.array) -> None:
        """Fits nodes to the boxes of blocks."""
        boxes = [wp.empty(self.node_count, dtype=wp.vec3, device=self.device) for _ in range(2)]
        for first, end in reversed(list(itertools.pairwise(self.levels))):
            inputs = [self.bvh, lower, upper, self.max_blocks, self.first_block, self.first_node, first, *boxes]
            wp.launch(fit_nodes, end - first, inputs=inputs, device=self.device)

    def statistics(self) -> Statistics:
        """Reads the tables back; takes time."""
        nodes = self.bvh.nodes.numpy().reshape(-1, 4 * NODE_VECTORS)
        nodes = nodes[self.first_node : self.first_node + self.node_count]
        # The origins of grids do not count.
        cells = nodes[:, 16:].copy().view(np.uint8).reshape(-1, 2, 3, WIDTH)
        lower, upper = (cells[:, i] * nodes[:, 4:7, None].astype(np.float64) for i in range(2))
        links = nodes[:, 8:16].view(np.int32)
        used = links != EMPTY
        d = np.where(used[:, None], upper - lower, 0.0)
        areas = d[:, 0] * d[:, 1] + d[:, 1] * d[:, 2] + d[:, 2] * d[:, 0]
        d = upper[0].max(axis=1) - lower[0].min(axis=1)
        root = d[0] * d[1] + d[1] * d[2] + d[2] * d[0]
        leaves = used & (links < 0)
        blocks = np.where(leaves, ~links % self.max_blocks + 1, 0)
        node_visits = 1.0 + float(areas[used & ~leaves].sum() / root) if root > 0.0 else 0.0
        block_visits = float((areas * blocks).sum() / root) if root > 0.0 else 0.0
        vectors = self.node_count * NODE_VECTORS + self.block_count * self._block_vectors
        return Statistics(
            primitives=self.primitive_count,
            nodes=self.node_count,
            leaves=int(leaves.sum()),
            levels=len(self.levels) - 1,
            sah_cost=NODE_COST * node_visits + BLOCK_COST * block_visits,
            node_visits=node_visits,
            block_visits=block_visits,
            bytes=16 * vectors,
            seconds=self.build_seconds,
        )


class TriangleBvh(_Hierarchy):
    """A hierarchy over triangles.

    Args:
        points: Vertices, [N] vec3, metres.
        indices: Three a triangle, [3 M] int32, M >= 1.
        first_triangle: Number of the first triangle in hits.
        alone: Whether it has tables of its own; if not, `place` puts it where it can be traced.
    """

    _block_vectors = BLOCK_VECTORS

    def __init__(self, points: wp.array, indices: wp.array, first_triangle: int = 0, alone: bool = True):
        begin = time.perf_counter()
        count, device = indices.shape[0] // 3, points.device
        lower, upper = (wp.empty(count, dtype=wp.vec3, device=device) for _ in range(2))
        wp.launch(triangle_bounds, count, inputs=[points, indices], outputs=[lower, upper], device=device)
        super().__init__(_topology(lower, upper, BLOCK, MAX_BLOCKS), MAX_BLOCKS, device)
        self.indices, self.first_triangle = indices, first_triangle
        if alone:
            place([(self, points)])
        wp.synchronize_device(device)
        self.build_seconds = time.perf_counter() - begin

    def _name(self) -> None:
        inputs = [self.wide.order, self.wide.block_ranges, self.first_triangle, self.first_block, self.bvh]
        wp.launch(name_triangles, self.block_count, inputs=inputs, device=self.device)

    def refit(self, points: wp.array) -> None:
        """Moves the vertices and fits the boxes to them; which triangles are together stays.

        Args:
            points: As many as before, in the same order.
        """
        boxes = [wp.empty(self.block_count, dtype=wp.vec3, device=self.device) for _ in range(2)]
        inputs = [points, self.indices, self.first_triangle, self.first_block]
        wp.launch(write_blocks, self.block_count, inputs=inputs, outputs=[self.bvh, *boxes], device=self.device)
        self._fit(*boxes)


class BoxBvh(_Hierarchy):
    """A hierarchy over boxes, such as those of spheres and of instances, with one box a leaf.

    Args:
        lower, upper: Corners, [N] vec3, N >= 1.
        first_box: Number of the first box in links.
        alone: As of `TriangleBvh`.
    """

    _block_vectors = 0

    def __init__(self, lower: wp.array, upper: wp.array, first_box: int = 0, alone: bool = True):
        begin = time.perf_counter()
        device = lower.device
        super().__init__(_topology(lower, upper, 1, 1), 1, device)
        self.first_box = first_box
        if alone:
            place([(self, lower, upper)])
        wp.synchronize_device(device)
        self.build_seconds = time.perf_counter() - begin

    def _place(self, bvh: Bvh, first_node: int, first_block: int) -> None:
        super()._place(bvh, first_node, self.first_box)

    def _name(self) -> None:
        inputs = [self.wide.order, self.wide.block_ranges, self.first_box, self.first_node, self.bvh]
        wp.launch(name_boxes, self.node_count, inputs=inputs, device=self.device)

    def refit(self, lower: wp.array, upper: wp.array) -> None:
        """Moves the boxes; which are together stays."""
        self._fit(lower, upper)


def place(hierarchies: list[tuple]) -> Bvh:
    """Puts hierarchies into common tables, which they share from then on, and fits them.

    The root of each is its `first_node`.

    Args:
        hierarchies: Each with the arguments of its `refit`; at least one, and none that has a place.
    """
    device = hierarchies[0][0].device
    nodes = sum(h.node_count for h, *_ in hierarchies)
    vectors = sum(h.block_count * h._block_vectors for h, *_ in hierarchies)
    bvh = Bvh()
    bvh.nodes = wp.zeros(NODE_VECTORS * nodes, dtype=wp.vec4, device=device)
    bvh.blocks = wp.empty(vectors, dtype=wp.vec4, device=device)
    bvh.links, bvh.primitives = bvh.nodes.view(wp.vec4i), bvh.blocks.view(wp.vec4i)
    first_node = first_vector = 0
    for hierarchy, *arrays in hierarchies:
        hierarchy._place(bvh, first_node, first_vector // BLOCK_VECTORS)
        hierarchy.refit(*arrays)
        first_node += hierarchy.node_count
        first_vector += hierarchy.block_count * hierarchy._block_vectors
    return bvh
