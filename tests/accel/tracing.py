"""Rays traced against a hierarchy in both ways, which must agree bit for bit."""

from __future__ import annotations

import dataclasses

import numpy as np
import warp as wp

from wavefront.accel.bvh import Bvh, TriangleBvh
from wavefront.accel.geometry import Geometry, RayHits
from wavefront.accel.intersector import make_intersector
from wavefront.accel.stream import make_streams

DEVICE = "cpu"
FAR = 3.0e38  # what bounds the closest hit

closest_hit, occluded = make_intersector(True, False)
closest_stream, occluded_stream = make_streams(True, False)


@wp.kernel(enable_backward=False, module="unique")
def portable_kernel(
    geometry: Geometry,
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    t_max: wp.array[wp.float32],
    # out
    primitive: wp.array[wp.int32],
    t: wp.array[wp.float32],
    uv: wp.array[wp.vec2],
    blocked: wp.array[wp.int32],
):
    i = wp.tid()
    hit = closest_hit(geometry, origin[i], direction[i])
    primitive[i] = hit.primitive
    t[i] = hit.t
    uv[i] = wp.vec2(hit.u, hit.v)
    blocked[i] = wp.where(occluded(geometry, origin[i], direction[i], t_max[i]), 1, 0)


@wp.kernel(enable_backward=False, module="unique")
def stream_kernel(
    geometry: Geometry,
    slots: wp.array[wp.int32],
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    t_max: wp.array[wp.float32],
    # out
    primitive: wp.array[wp.int32],
    t: wp.array[wp.float32],
    uv: wp.array[wp.vec2],
    blocked: wp.array[wp.int32],
):
    hits = RayHits()
    hits.primitive = primitive
    hits.t = t
    hits.uv = uv
    closest_stream(geometry, slots, slots.shape[0], origin, direction, hits)
    occluded_stream(geometry, slots, slots.shape[0], origin, direction, t_max, blocked)


@dataclasses.dataclass
class Hits:
    """Arrays of N: number of the first triangle (-1: none), distance, weights of vertices 0 and 1 [N, 2], and whether
    any triangle lies before `t_max`."""

    primitive: np.ndarray
    t: np.ndarray
    uv: np.ndarray
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


def trace(kernel, bvh: Bvh, root: int, origin, direction, t_max=None) -> Hits:
    """What one of both kernels finds; the stream takes its rays in a mixed order."""
    n = len(origin)
    t_max = wp.array(np.full(n, FAR) if t_max is None else t_max, dtype=wp.float32, device=DEVICE)
    queue, dim = [], n
    if kernel is stream_kernel:
        queue = [wp.array(np.random.default_rng(1).permutation(n).astype(np.int32), device=DEVICE)]
        dim = 1
    out = [wp.zeros(n, dtype=t, device=DEVICE) for t in (wp.int32, wp.float32, wp.vec2, wp.int32)]
    inputs = [triangles_below(bvh, root), *queue, vectors(origin), vectors(direction), t_max]
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=out, device=DEVICE)
    return Hits(*(a.numpy() for a in out))


def trace_both(bvh: Bvh, root: int, origin, direction, t_max=None) -> Hits:
    """Asserts that both kernels find the same bits."""
    hits, others = (trace(kernel, bvh, root, origin, direction, t_max) for kernel in (portable_kernel, stream_kernel))
    for field in dataclasses.fields(Hits):
        a, b = (getattr(h, field.name) for h in (hits, others))
        assert a.dtype == b.dtype
        different = (a.view(np.int32) != b.view(np.int32)).reshape(len(a), -1).any(axis=1)
        assert not different.any(), (field.name, np.flatnonzero(different)[:5], a[different][:5], b[different][:5])
    return hits


def check_any(bvh: Bvh, root: int, origin, direction, closest: Hits) -> None:
    """Asserts that any-hit with bounds on either side of the closest hit agrees with it to the last bit."""
    hit, t = closest.primitive >= 0, closest.t
    none = np.zeros(len(hit), bool)
    # The end is left out, and so is what lies behind; a stream of closest hits ends at `FAR`.
    further = np.where(hit, np.minimum(np.float32(1.5) * np.minimum(t, 2e38), FAR), 1.0)
    for bound, blocked in ((t, none), (0.5 * t, none), (further, hit), (np.nextafter(t, np.float32(np.inf)), hit)):
        wrong = (trace_both(bvh, root, origin, direction, bound).blocked != 0) != blocked
        assert not wrong.any(), (np.flatnonzero(wrong)[:5], wrong.sum())
