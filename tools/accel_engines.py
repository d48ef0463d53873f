"""What `tools.bench_accel` measures: hierarchies that are built over triangles, and queries of rays against them.

Ours, `wp.Mesh`, Embree through embreex, and Mitsuba 3. All are used in one process, so that they trace the same rays,
take turns, and can be compared answer by answer.
"""

from __future__ import annotations

import abc
import ctypes
import dataclasses
import functools
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import warp as wp

from tools.peers import mitsuba as peer
from wavefront.accel.bvh import TriangleBvh
from wavefront.accel.geometry import Geometry, RayHits
from wavefront.accel.intersector import make_intersector
from wavefront.accel.stream import make_streams
from wavefront.errors import WavefrontError

LEAF_SIZES = (1, 2, 4, 8)  # of wp.Mesh
ENGINES = ("stream", "portable", "wp.Mesh", "embree", "mitsuba")
CHUNK = 1 << 14  # rays of a launch on the CPU device, at most
VARIANT = "llvm_ad_rgb"

closest_hit, occluded = make_intersector(True, False)
streams = make_streams(True, False)


@dataclasses.dataclass
class Rays:
    """Rays of one kind.

    Attributes:
        origin, direction: [N, 3] float32; directions have any length.
        t_max: End of each, in units of its direction, [N] float32; only queries for any hit heed it.
        coherent: Neighbours are alike; a hint.
    """

    origin: np.ndarray
    direction: np.ndarray
    t_max: np.ndarray
    coherent: bool


@dataclasses.dataclass
class Answer:
    """Of a query for the closest hit `primitive` (-1: none) and `t`, [N] each; of one for any hit `blocked`, [N]."""

    primitive: np.ndarray | None = None
    t: np.ndarray | None = None
    blocked: np.ndarray | None = None


class Structure(abc.ABC):
    """A hierarchy over triangles.

    Attributes:
        name: For tables.
        engines: Ways to trace rays against it.
    """

    name: str
    engines: tuple[str, ...]

    @abc.abstractmethod
    def prepare(self, points: np.ndarray, faces: np.ndarray) -> None:
        """Takes the triangles; not timed."""

    @abc.abstractmethod
    def build(self) -> None:
        """Builds the hierarchy, to the end."""

    @abc.abstractmethod
    def release(self) -> None:
        """Lets go of the hierarchy."""

    def statistics(self) -> dict | None:
        """What the hierarchy tells of itself."""
        return None

    @abc.abstractmethod
    def query(self, engine: str, rays: Rays, any_hit: bool):
        """Something with `run()`, which is timed, and `answer()`, an `Answer`."""


# --- on Warp -----------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False, module="unique")
def mesh_closest(
    mesh: wp.uint64,
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    # out
    primitive: wp.array[wp.int32],
    t: wp.array[float],
    uv: wp.array[wp.vec2],
):
    i = wp.tid()
    query = wp.mesh_query_ray(mesh, origin[i], direction[i], 3.0e38)
    face = int(-1)
    if query.result:
        face = query.face
        t[i] = query.t
        uv[i] = wp.vec2(query.u, query.v)
    primitive[i] = face


@wp.kernel(enable_backward=False, module="unique")
def mesh_any(
    mesh: wp.uint64,
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    t_max: wp.array[float],
    # out
    blocked: wp.array[wp.int32],
):
    i = wp.tid()
    blocked[i] = wp.where(wp.mesh_query_ray_anyhit(mesh, origin[i], direction[i], t_max[i]), 1, 0)


@wp.kernel(enable_backward=False, module="unique")
def portable_closest(
    geometry: Geometry,
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    # out
    primitive: wp.array[wp.int32],
    t: wp.array[float],
    uv: wp.array[wp.vec2],
):
    i = wp.tid()
    hit = closest_hit(geometry, origin[i], direction[i])
    primitive[i] = hit.primitive
    t[i] = hit.t
    uv[i] = wp.vec2(hit.u, hit.v)


@wp.kernel(enable_backward=False, module="unique")
def portable_any(
    geometry: Geometry,
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    t_max: wp.array[float],
    # out
    blocked: wp.array[wp.int32],
):
    i = wp.tid()
    blocked[i] = wp.where(occluded(geometry, origin[i], direction[i], t_max[i]), 1, 0)


@functools.cache
def make_stream(any_hit: bool):
    """Kernel of one thread over a queue of slots; only the CPU device can compile it."""
    if any_hit:

        @wp.kernel(enable_backward=False, module="unique")
        def stream_any(
            geometry: Geometry,
            slots: wp.array[wp.int32],
            origin: wp.array[wp.vec3],
            direction: wp.array[wp.vec3],
            t_max: wp.array[float],
            # out
            blocked: wp.array[wp.int32],
        ):
            streams.occluded(geometry, slots, slots.shape[0], origin, direction, t_max, blocked)

        return stream_any

    @wp.kernel(enable_backward=False, module="unique")
    def stream_closest(
        geometry: Geometry,
        slots: wp.array[wp.int32],
        origin: wp.array[wp.vec3],
        direction: wp.array[wp.vec3],
        # out
        primitive: wp.array[wp.int32],
        t: wp.array[float],
        uv: wp.array[wp.vec2],
    ):
        hits = RayHits()
        hits.primitive = primitive
        hits.t = t
        hits.uv = uv
        streams.closest(geometry, slots, slots.shape[0], origin, direction, hits)

    return stream_closest


class WarpQuery:
    """Rays in device memory, and launches over them: on the CPU device shares, each by the first thread that is free.

    Args:
        kernel: Its inputs are the hierarchy, then the queue if it is a stream's, then the rays and the answers.
        handle: The hierarchy.
        queue: Whether the kernel reads a queue of slots in one thread.
        rays: To trace.
        any_hit: Whether the kernel is one for any hit.
        device: Of the kernel.
        threads: On the CPU device.
    """

    def __init__(self, kernel, handle, queue: bool, rays: Rays, any_hit: bool, device: str, threads: int):
        n = len(rays.origin)
        self.any_hit, self.device, self.threads = any_hit, device, threads
        arrays = [wp.array(part, dtype=wp.vec3, device=device) for part in (rays.origin, rays.direction)]
        if any_hit:
            arrays.append(wp.array(rays.t_max, dtype=float, device=device))
            self.blocked = wp.zeros(n, dtype=wp.int32, device=device)
            arrays.append(self.blocked)
        else:
            self.primitive = wp.zeros(n, dtype=wp.int32, device=device)
            self.t = wp.zeros(n, dtype=float, device=device)
            self.uv = wp.zeros(n, dtype=wp.vec2, device=device)
            arrays += [self.primitive, self.t, self.uv]
        slots = wp.array(np.arange(n), dtype=wp.int32, device=device)
        self.arrays = [*arrays, slots]  # recorded commands do not keep them alive
        self.commands = []
        chunk = max(1, min(CHUNK, -(-n // (4 * threads)))) if device == "cpu" else n
        for first in range(0, n, chunk):
            share = slice(first, min(first + chunk, n))
            if queue:
                size, inputs = 1, [handle, slots[share], *arrays]
            else:
                size, inputs = share.stop - share.start, [handle, *(array[share] for array in arrays)]
            self.arrays += inputs
            self.commands.append(wp.launch(kernel, size, inputs=inputs, device=device, record_cmd=True))

    def run(self) -> None:
        if self.threads == 1:
            for command in self.commands:
                command.launch()
        else:
            with ThreadPoolExecutor(self.threads) as pool:
                for _ in pool.map(lambda command: command.launch(), self.commands):
                    pass
        wp.synchronize_device(self.device)

    def answer(self) -> Answer:
        if self.any_hit:
            return Answer(blocked=self.blocked.numpy() != 0)
        return Answer(self.primitive.numpy(), self.t.numpy())


class OnWarp(Structure):
    """What the hierarchies on Warp have in common."""

    def __init__(self, device: str, threads: int):
        self.device, self.threads = device, threads if device == "cpu" else 1

    def prepare(self, points: np.ndarray, faces: np.ndarray) -> None:
        self.points = wp.array(points, dtype=wp.vec3, device=self.device)
        self.indices = wp.array(faces.ravel(), dtype=wp.int32, device=self.device)


class Ours(OnWarp):
    """Ours, traced by the portable code and, on the CPU device, as a stream."""

    name = "wavefront"

    def __init__(self, device: str, threads: int, engines: tuple[str, ...] = ("stream", "portable")):
        super().__init__(device, threads)
        self.engines = engines

    def build(self) -> None:
        self.hierarchy = TriangleBvh(self.points, self.indices)
        self.geometry = Geometry()  # its root is node 0
        self.geometry.bvh = self.hierarchy.bvh

    def release(self) -> None:
        self.hierarchy = self.geometry = None

    def statistics(self) -> dict:
        return dataclasses.asdict(self.hierarchy.statistics())

    def query(self, engine: str, rays: Rays, any_hit: bool) -> WarpQuery:
        queue = engine == "stream"
        kernel = make_stream(any_hit) if queue else (portable_any if any_hit else portable_closest)
        return WarpQuery(kernel, self.geometry, queue, rays, any_hit, self.device, self.threads)


class WarpMesh(OnWarp):
    """`wp.Mesh` by its SAH constructor."""

    def __init__(self, device: str, threads: int, leaf_size: int):
        super().__init__(device, threads)
        self.leaf_size = leaf_size
        self.name = f"wp.Mesh, leaf {leaf_size}"
        self.engines = (self.name,)

    def build(self) -> None:
        self.mesh = wp.Mesh(self.points, self.indices, bvh_constructor="sah", bvh_leaf_size=self.leaf_size)
        wp.synchronize_device(self.device)

    def release(self) -> None:
        self.mesh = None

    def query(self, engine: str, rays: Rays, any_hit: bool) -> WarpQuery:
        kernel = mesh_any if any_hit else mesh_closest
        return WarpQuery(kernel, self.mesh.id, False, rays, any_hit, self.device, self.threads)


# --- peers -------------------------------------------------------------------------------------------------------


def _embreex():
    try:
        from embreex import mesh_construction, rtcore, rtcore_scene
    except ImportError as error:
        raise WavefrontError(f"embreex is not installed ({error}); it comes with pip install '.[embree]'") from None
    return mesh_construction, rtcore, rtcore_scene


class Embree(Structure):
    """Embree 4 through embreex, which calls Embree for one ray after the other, on the calling thread alone."""

    name = "Embree, one thread"
    engines = (name,)

    def prepare(self, points: np.ndarray, faces: np.ndarray) -> None:
        self.points, self.faces = np.ascontiguousarray(points), np.ascontiguousarray(faces)

    def build(self) -> None:
        mesh_construction, rtcore, rtcore_scene = _embreex()
        self.scene = rtcore_scene.EmbreeScene(rtcore.EmbreeDevice())
        self.mesh = mesh_construction.TriangleMesh(self.scene, self.points, self.faces)
        ray = np.ones((1, 3), np.float32)
        self.scene.run(ray, ray)  # the first query builds

    def release(self) -> None:
        self.mesh = self.scene = None

    def query(self, engine: str, rays: Rays, any_hit: bool) -> EmbreeQuery:
        return EmbreeQuery(self.scene, rays, any_hit)


class EmbreeQuery:
    def __init__(self, scene, rays: Rays, any_hit: bool):
        self.scene, self.any_hit = scene, any_hit
        self.arguments = {"vec_origins": rays.origin, "vec_directions": rays.direction}
        if any_hit:
            self.arguments |= {"dists": rays.t_max, "query": "OCCLUDED"}
        else:
            self.arguments |= {"output": True}  # with distances and barycentric coordinates, as the others answer

    def run(self) -> None:
        self.found = self.scene.run(**self.arguments)

    def answer(self) -> Answer:
        if self.any_hit:
            return Answer(blocked=self.found >= 0)
        return Answer(self.found["primID"], self.found["tfar"])


class Mitsuba(Structure):
    """Mitsuba 3 in the variant `llvm_ad_rgb`, which traces packets of rays with an Embree of its own."""

    name = f"Mitsuba {VARIANT}"
    engines = (name,)

    def __init__(self, threads: int):
        self.mi = peer.use_variant(VARIANT)
        import drjit

        self.dr = drjit
        drjit.set_thread_count(threads)

    def prepare(self, points: np.ndarray, faces: np.ndarray) -> None:
        self.mesh = self.mi.Mesh("triangles", len(points), len(faces))
        parameters = self.mi.traverse(self.mesh)
        parameters["vertex_positions"] = points.ravel()
        parameters["faces"] = faces.ravel().astype(np.uint32)
        parameters.update()
        self.dr.sync_thread()

    def build(self) -> None:
        self.scene = self.mi.load_dict({"type": "scene", "mesh": self.mesh}, parallel=False)
        self.dr.sync_thread()

    def release(self) -> None:
        self.scene = None

    def query(self, engine: str, rays: Rays, any_hit: bool) -> MitsubaQuery:
        return MitsubaQuery(self, rays, any_hit)


class MitsubaQuery:
    def __init__(self, structure: Mitsuba, rays: Rays, any_hit: bool):
        self.dr, self.scene, self.any_hit, self.coherent = structure.dr, structure.scene, any_hit, rays.coherent
        mi = structure.mi
        origin, direction = (mi.Point3f(rays.origin.T), mi.Vector3f(rays.direction.T))
        self.ray = mi.Ray3f(origin, direction)
        if any_hit:
            self.ray.maxt = mi.Float(rays.t_max)
        self.dr.make_opaque(self.ray)

    def run(self) -> None:
        if self.any_hit:
            self.found = self.scene.ray_test(self.ray, coherent=self.coherent)
            self.dr.eval(self.found)
        else:
            self.found = self.scene.ray_intersect_preliminary(self.ray, coherent=self.coherent)
            self.dr.eval(self.found.t, self.found.prim_index, self.found.prim_uv)
        self.dr.sync_thread()

    def answer(self) -> Answer:
        if self.any_hit:
            return Answer(blocked=np.array(self.found))
        t = np.array(self.found.t)
        return Answer(np.where(np.isfinite(t), np.array(self.found.prim_index).astype(np.int64), -1), t)


# --- all ---------------------------------------------------------------------------------------------------------


def missing(engine: str, device: str) -> str | None:
    """Why an engine cannot be used on a device, or None where it can."""
    if device != "cpu" and engine in ("stream", "embree", "mitsuba"):
        return f"{engine} is measured on the CPU device alone"
    if engine == "embree":
        try:
            _embreex()
        except WavefrontError as error:
            return str(error)
    return peer.missing(VARIANT) if engine == "mitsuba" else None


def make_structures(engines: tuple[str, ...], device: str, threads: int) -> list[Structure]:
    """The hierarchies that engines, of `ENGINES`, trace rays against.

    Raises:
        WavefrontError: An engine cannot be used.
    """
    structures: list[Structure] = []
    if own := tuple(engine for engine in ("stream", "portable") if engine in engines):
        structures.append(Ours(device, threads, own))
    if "wp.Mesh" in engines:
        structures += [WarpMesh(device, threads, leaf_size) for leaf_size in LEAF_SIZES]
    if "embree" in engines:
        structures.append(Embree())
    if "mitsuba" in engines:
        structures.append(Mitsuba(threads))
    return structures


def memory_in_use(device: str) -> int | None:
    """Bytes that this process holds: resident ones, after free pages are returned, or those of Warp's pool on CUDA.

    None where that cannot be told.
    """
    if device != "cpu":
        return wp.get_mempool_used_mem_current(device) if wp.is_mempool_enabled(device) else None
    try:
        ctypes.CDLL(None).malloc_trim(0)
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, AttributeError):
        return None
