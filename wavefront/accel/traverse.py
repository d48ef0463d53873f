"""Rays against hierarchies in plain Warp, on either device: slabs of eight boxes, and a watertight triangle test.

What is computed, and in which order of roundings, is the same in `wavefront.accel.stream`: of equal distances the
primitive of the lowest number wins, so a hit depends on neither the order of traversal nor the device.
"""

# Annotations are evaluated at once, for types of a function may depend on what it is made for.
import functools

import warp as wp

from wavefront.accel.bvh import BLOCK, BLOCK_VECTORS, MAX_BLOCKS, MAX_LEVELS, NODE_VECTORS, Bvh, Extents, grid_point
from wavefront.accel.collapse import EMPTY, WIDTH
from wavefront.accel.geometry import Geometry, Hit

# Slope of a direction along a plane: finite, for 0 times infinity is no distance, and so great that even 1e-17 m, such
# as roundings leave of a zero, times it is beyond all hits.
STEEPEST = wp.constant(8.0e37)
# Relative slack of the sides of a box: three roundings of the slab test (Ize 2013), and those of the triangle test.
# With it the box of a triangle is not behind it, and of triangles at all but one distance the order of visits chooses
# none.
NEAR_SLACK = wp.constant(0.999998)
FAR_SLACK = wp.constant(1.000002)

# Comparators of a sorting network (Knuth 1998, section 5.3.4), in layers that could run at once.
NETWORK = (
    ((0, 2), (1, 3), (4, 6), (5, 7)),
    ((0, 4), (1, 5), (2, 6), (3, 7)),
    ((0, 1), (2, 3), (4, 5), (6, 7)),
    ((2, 4), (3, 5)),
    ((1, 4), (3, 6)),
    ((1, 2), (3, 4), (5, 6)),
)
COMPARATORS = tuple(pair for layer in NETWORK for pair in layer)
UNMET = wp.constant(0x7F800000)  # the bits of infinity

Keys = wp.types.vector(length=WIDTH, dtype=wp.int32)
Levels = wp.types.vector(length=MAX_LEVELS, dtype=wp.int32)
Waiting = wp.types.vector(length=MAX_LEVELS, dtype=wp.uint32)


@wp.struct
class Shear:
    """The map that makes a ray the z axis: axes kx, ky, kz of the world, the last the longest of the direction."""

    kx: wp.int32
    ky: wp.int32
    kz: wp.int32
    x: wp.float32
    y: wp.float32
    z: wp.float32


@wp.struct
class Ray:
    """Of a direction of any length, with what tests of boxes and triangles need of it."""

    origin: wp.vec3
    direction: wp.vec3
    slope: wp.vec3
    shear: Shear


@wp.func
def slope(d: float) -> float:
    """1 / d, finite."""
    if wp.abs(d) < 1.0 / STEEPEST:
        return wp.where(d < 0.0 or 1.0 / d < 0.0, -STEEPEST, STEEPEST)  # 1 / -0 is negative
    return 1.0 / d


@wp.func
def far_origin(x: float, slope: float) -> float:
    """Coordinate of the origin of a ray for the sides where it leaves boxes.

    A ray along an axis starts a rounding further back, so that one within the side of a box is within the box.
    """
    back = wp.where(wp.abs(slope) == STEEPEST, wp.max(1.2e-7 * wp.abs(x), 1.0e-17), 0.0)
    return x - wp.sign(slope) * back


@wp.func
def slopes(direction: wp.vec3) -> wp.vec3:
    return wp.vec3(slope(direction[0]), slope(direction[1]), slope(direction[2]))


@wp.func
def make_shear(d: wp.vec3) -> Shear:
    """See Woop, Benthin and Wald 2013, section 3.2."""
    s = Shear()
    s.kz = 0
    if wp.abs(d[1]) > wp.abs(d[s.kz]):
        s.kz = 1
    if wp.abs(d[2]) > wp.abs(d[s.kz]):
        s.kz = 2
    s.kx = (s.kz + 1) % 3
    s.ky = (s.kx + 1) % 3
    if d[s.kz] < 0.0:  # keeps the winding
        k = s.kx
        s.kx = s.ky
        s.ky = k
    s.x = d[s.kx] / d[s.kz]
    s.y = d[s.ky] / d[s.kz]
    s.z = 1.0 / d[s.kz]
    return s


@wp.func
def make_ray(origin: wp.vec3, direction: wp.vec3) -> Ray:
    ray = Ray()
    ray.origin = origin
    ray.direction = direction
    ray.slope = slopes(direction)
    ray.shear = make_shear(direction)
    return ray


@wp.func
def box_distances(bvh: Bvh, node: int, origin: wp.vec3, slope: wp.vec3, t_max: float) -> Extents:
    """Where a ray enters the boxes of the children of a node; infinite where it does not before `t_max`."""
    found = Extents()
    near = Extents(0.0)
    far = Extents(t_max)
    place = NODE_VECTORS * node
    for axis in range(3):
        grid = bvh.nodes[place][axis]
        width = bvh.nodes[place + 1][axis]
        beside = far_origin(origin[axis], slope[axis])
        for half in range(2):
            word = 2 * axis + half
            near_cells = bvh.links[place + 4 + word // 4][word % 4]
            far_cells = bvh.links[place + 4 + (6 + word) // 4][(6 + word) % 4]
            if slope[axis] < 0.0:
                swap = near_cells
                near_cells = far_cells
                far_cells = swap
            for i in range(4):
                near_side = grid_point(grid, width, (near_cells >> (8 * i)) & 255)
                far_side = grid_point(grid, width, (far_cells >> (8 * i)) & 255)
                k = 4 * half + i
                near[k] = wp.max(near[k], (near_side - origin[axis]) * (slope[axis] * NEAR_SLACK))
                far[k] = wp.min(far[k], (far_side - beside) * (slope[axis] * FAR_SLACK))
    for k in range(WIDTH):
        found[k] = wp.where(near[k] <= far[k], near[k], float(wp.inf))
    return found


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float cd = __fmul_rn(c, d);
    return __fmaf_rn(a, b, -cd) + __fmaf_rn(-c, d, cd);
#else
    const float cd = c * d;
    return __builtin_fmaf(a, b, -cd) + __builtin_fmaf(-c, d, cd);
#endif
""")
def difference_of_products(a: float, b: float, c: float, d: float) -> float:
    """a b - c d to 1.5 units in the last place (Kahan; Jeannerod, Louvet and Muller 2013), and so of the right sign.

    Two triangles with a common edge see it with opposite signs, and no ray passes between them. And the distance keeps
    its digits in slivers, where the products all but cancel.
    """
    ...


@wp.func
def test_triangle(bvh: Bvh, block: int, k: int, origin: wp.vec3, shear: Shear, nearest: Hit) -> Hit:
    """A triangle of a block, or the nearest that the ray met before, if that is nearer."""
    hit = nearest
    kx = shear.kx
    ky = shear.ky
    kz = shear.kz
    az = bvh.blocks[block + kz][k] - origin[kz]
    bz = bvh.blocks[block + 3 + kz][k] - origin[kz]
    cz = bvh.blocks[block + 6 + kz][k] - origin[kz]
    ax = (bvh.blocks[block + kx][k] - origin[kx]) - shear.x * az
    ay = (bvh.blocks[block + ky][k] - origin[ky]) - shear.y * az
    bx = (bvh.blocks[block + 3 + kx][k] - origin[kx]) - shear.x * bz
    by = (bvh.blocks[block + 3 + ky][k] - origin[ky]) - shear.y * bz
    cx = (bvh.blocks[block + 6 + kx][k] - origin[kx]) - shear.x * cz
    cy = (bvh.blocks[block + 6 + ky][k] - origin[ky]) - shear.y * cz
    u = difference_of_products(cx, by, cy, bx)
    v = difference_of_products(ax, cy, ay, cx)
    w = difference_of_products(bx, ay, by, ax)
    inside = (u >= 0.0 and v >= 0.0 and w >= 0.0) or (u <= 0.0 and v <= 0.0 and w <= 0.0)
    det = u + v + w
    if inside and det != 0.0:
        # Weights first: products of three lengths leave the range of float32 at 1e12.
        u /= det
        v /= det
        t = shear.z * (u * az + v * bz + (w / det) * cz)
        if t > 0.0 and t <= hit.t:
            primitive = bvh.primitives[block + 9][k]
            if t < hit.t or primitive < hit.primitive:
                hit.t = t
                hit.primitive = primitive
                hit.u = u
                hit.v = v
    return hit


@wp.func
def children_met(bvh: Bvh, node: int, origin: wp.vec3, slope: wp.vec3, t_max: float) -> wp.uint32:
    """Children of a node that a ray meets before `t_max`: four bits for each, 8 plus its place, the nearest lowest."""
    entered = box_distances(bvh, node, origin, slope, t_max)
    keys = Keys()
    for k in range(WIDTH):
        # Distances are not negative, and so their bits are in the order of their values.
        keys[k] = (wp.cast(entered[k], wp.int32) & ~7) | k
    for i in range(wp.static(len(COMPARATORS))):
        a = wp.static(COMPARATORS[i][0])
        b = wp.static(COMPARATORS[i][1])
        greater = wp.max(keys[a], keys[b])
        keys[b] = wp.min(keys[a], keys[b])
        keys[a] = greater
    met = wp.uint32(0)
    for k in range(WIDTH):
        if keys[k] < UNMET:
            met = (met << wp.uint32(4)) | wp.uint32(8 | (keys[k] & 7))
    return met


@functools.cache
def make_traversal(visit: wp.Function, AnyHit: type):
    """A function that follows a ray through a hierarchy.

    Args:
        visit: `(geometry, link, ray, nearest, any_will_do) -> AnyHit`, as below, in a leaf.
        AnyHit: The struct of a hit.

    Returns:
        `(geometry, root, ray, nearest, any_will_do) -> AnyHit`: the first of what is below a node and of `nearest`; or
        any, if `nearest` is none.
    """

    @wp.func
    def traverse(geometry: Geometry, root: int, ray: Ray, nearest: AnyHit, any_will_do: bool) -> AnyHit:
        hit = nearest
        # Nodes with children that wait, one a level: an eighth of the memory of a stack of those children.
        nodes = Levels()
        waiting = Waiting()
        size = int(0)
        link = int(root)
        done = bool(False)
        while not done:
            if link >= 0:
                nodes[size] = link
                waiting[size] = children_met(geometry.bvh, link, ray.origin, ray.slope, hit.t)
                size += 1
            elif link != EMPTY:
                hit = visit(geometry, link, ray, hit, any_will_do)
                if any_will_do and hit.primitive >= 0:
                    size = 0
            while size > 0 and waiting[wp.max(size - 1, 0)] == wp.uint32(0):
                size -= 1
            if size > 0:
                met = waiting[size - 1]
                k = int(met & wp.uint32(7))
                waiting[size - 1] = met >> wp.uint32(4)
                link = geometry.bvh.links[NODE_VECTORS * nodes[size - 1] + 2 + k // 4][k % 4]
            done = size == 0
        return hit

    return traverse


@wp.func
def visit_triangles(geometry: Geometry, link: int, ray: Ray, nearest: Hit, any_will_do: bool) -> Hit:
    hit = nearest
    first = ~link // MAX_BLOCKS
    for block in range(first, first + ~link % MAX_BLOCKS + 1):
        for k in range(BLOCK):
            hit = test_triangle(geometry.bvh, BLOCK_VECTORS * block, k, ray.origin, ray.shear, hit)
    return hit


trace_triangles = make_traversal(visit_triangles, Hit)
