"""Rays traced against a hierarchy in both ways, which must agree bit for bit."""

import dataclasses
import functools

import numpy as np
import warp as wp

from wavefront.accel.bvh import Bvh, TriangleBvh
from wavefront.accel.geometry import Geometry, RayHits
from wavefront.accel.intersector import make_intersector
from wavefront.accel.stream import make_streams

DEVICE = "cpu"
FAR = 3.0e38  # what bounds the closest hit


@functools.cache
def make_kernels(triangles: bool = True, spheres: bool = False, instances: tuple[str, ...] = ()):
    """The portable kernel, a thread a ray, and that of a stream; the arguments are those of `make_intersector`."""
    closest_hit, occluded = make_intersector(triangles, spheres, instances)
    closest_stream, occluded_stream = make_streams(triangles, spheres, instances)
    instanced = bool(instances)

    @wp.kernel(enable_backward=False, module="unique")
    def portable(
        geometry: Geometry,
        origin: wp.array[wp.vec3],
        direction: wp.array[wp.vec3],
        t_max: wp.array[wp.float32],
        # out
        hits: RayHits,
        blocked: wp.array[wp.int32],
    ):
        i = wp.tid()
        hit = closest_hit(geometry, origin[i], direction[i])
        hits.primitive[i] = hit.primitive
        hits.t[i] = hit.t
        hits.uv[i] = wp.vec2(hit.u, hit.v)
        if wp.static(instanced):
            hits.instance[i] = hit.instance
        blocked[i] = wp.where(occluded(geometry, origin[i], direction[i], t_max[i]), 1, 0)

    @wp.kernel(enable_backward=False, module="unique")
    def stream(
        geometry: Geometry,
        slots: wp.array[wp.int32],
        origin: wp.array[wp.vec3],
        direction: wp.array[wp.vec3],
        t_max: wp.array[wp.float32],
        # out
        hits: RayHits,
        blocked: wp.array[wp.int32],
    ):
        closest_stream(geometry, slots, slots.shape[0], origin, direction, hits)
        occluded_stream(geometry, slots, slots.shape[0], origin, direction, t_max, blocked)

    return portable, stream


portable_kernel, stream_kernel = make_kernels()


@dataclasses.dataclass
class Hits:
    """Arrays of N: number of the first primitive (-1: none), distance, weights of vertices 0 and 1 [N, 2], instance
    (zeros without instances), and whether anything lies before `t_max`."""

    primitive: np.ndarray
    t: np.ndarray
    uv: np.ndarray
    instance: np.ndarray
    blocked: np.ndarray


def vectors(a) -> wp.array:
    return wp.array(np.ascontiguousarray(a, np.float32).reshape(-1, 3), dtype=wp.vec3, device=DEVICE)


def soup_bvh(corners, first_triangle: int = 0) -> TriangleBvh:
    """Of triangles [M, 3, 3] that share no vertex."""
    indices = wp.array(np.arange(3 * len(corners), dtype=np.int32), device=DEVICE)
    return TriangleBvh(vectors(corners), indices, first_triangle)


def triangles_below(bvh: Bvh, root: int) -> Geometry:
    """A scene of the triangles of one hierarchy."""
    geometry = Geometry()
    geometry.bvh, geometry.own.root = bvh, root
    return geometry


def launch(kernel, geometry: Geometry, origin, direction, t_max=None, slots=None, fill: int = 0) -> Hits:
    """What one of a pair of kernels finds; a stream takes its rays in a mixed order, or those of `slots`.

    Args:
        fill: What is in the arrays before.
    """
    n = len(origin)
    t_max = wp.array(np.full(n, FAR) if t_max is None else t_max, dtype=wp.float32, device=DEVICE)
    queue, dim = [], n
    if "slots" in kernel.adj.arg_types:
        slots = np.random.default_rng(1).permutation(n) if slots is None else slots
        queue, dim = [wp.array(slots, dtype=wp.int32, device=DEVICE)], 1
    hits, blocked = RayHits(), wp.full(n, fill, dtype=wp.int32, device=DEVICE)
    for name, variable in RayHits.vars.items():
        setattr(hits, name, wp.full(n, fill, dtype=variable.type.dtype, device=DEVICE))
    inputs = [geometry, *queue, vectors(origin), vectors(direction), t_max]
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=[hits, blocked], device=DEVICE)
    return Hits(*(getattr(hits, name).numpy() for name in RayHits.vars), blocked.numpy())


def compare(kernels, geometry: Geometry, origin, direction, t_max=None) -> Hits:
    """Asserts that both of a pair of kernels find the same bits."""
    hits, others = (launch(kernel, geometry, origin, direction, t_max) for kernel in kernels)
    for field in dataclasses.fields(Hits):
        a, b = (getattr(h, field.name) for h in (hits, others))
        assert a.dtype == b.dtype
        different = (a.view(np.int32) != b.view(np.int32)).reshape(len(a), -1).any(axis=1)
        assert not different.any(), (field.name, np.flatnonzero(different)[:5], a[different][:5], b[different][:5])
    return hits


def trace(kernel, bvh: Bvh, root: int, origin, direction, t_max=None) -> Hits:
    """What one of both kernels finds among the triangles of one hierarchy."""
    return launch(kernel, triangles_below(bvh, root), origin, direction, t_max)


def trace_both(bvh: Bvh, root: int, origin, direction, t_max=None) -> Hits:
    """Asserts that both kernels find the same bits among them."""
    return compare(make_kernels(), triangles_below(bvh, root), origin, direction, t_max)


def check_any(bvh: Bvh, root: int, origin, direction, closest: Hits) -> None:
    check_bounds(make_kernels(), triangles_below(bvh, root), origin, direction, closest)


def check_bounds(kernels, geometry: Geometry, origin, direction, closest: Hits) -> None:
    """Asserts that any-hit with bounds on either side of the closest hit agrees with it to the last bit."""
    hit, t = closest.primitive >= 0, closest.t
    none = np.zeros(len(hit), bool)
    # The end is left out, and so is what lies behind; closest hits end at `FAR`.
    further = np.where(hit, np.minimum(np.float32(1.5) * np.minimum(t, 2e38), FAR), 1.0)
    for bound, blocked in ((t, none), (0.5 * t, none), (further, hit), (np.nextafter(t, np.float32(np.inf)), hit)):
        wrong = (compare(kernels, geometry, origin, direction, bound).blocked != 0) != blocked
        assert not wrong.any(), (np.flatnonzero(wrong)[:5], wrong.sum())
