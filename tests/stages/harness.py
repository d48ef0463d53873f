"""Builds what a stage reads on a handful of slots, by hand, and launches its kernel alone."""

from __future__ import annotations

import numpy as np
import warp as wp

from wavefront import queues
from wavefront.accel.bvh import BoxBvh, TriangleBvh, place
from wavefront.accel.geometry import Geometry, Shape
from wavefront.bsdf import tables as bsdf
from wavefront.light import tables as light
from wavefront.queues import Paths, Queue, ShadowRays, Surfaces, allocate_struct
from wavefront.rng import uniform4
from wavefront.texture import TextureRecord, TextureTables

DEVICE = "cpu"


def array(values, dtype) -> wp.array:
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device=DEVICE)


def records(struct, rows: list[dict]) -> wp.array:
    host = np.zeros(len(rows), dtype=struct.numpy_dtype())
    for i, row in enumerate(rows):
        for name, value in row.items():
            host[name][i] = value
    return wp.array(host, dtype=struct, device=DEVICE)


def state(struct, n: int, **fields):
    """A struct of arrays with `n` slots; fields not given are zero. A value may be one for all slots or one each."""
    instance = allocate_struct(struct, n, DEVICE)
    for name, value in fields.items():
        target = getattr(instance, name)
        host = target.numpy()
        host[:] = value
        setattr(instance, name, wp.array(host, dtype=target.dtype, device=DEVICE))
    return instance


def paths(n: int, **fields) -> Paths:
    """`n` paths that have just left the camera at the origin along -z."""
    defaults = {"direction": (0.0, 0.0, -1.0), "beta": 1.0, "eta": 1.0, "pixel": np.arange(n)}
    return state(Paths, n, **(defaults | fields))


def surfaces(n: int, **fields) -> Surfaces:
    """Vertices that face +z."""
    defaults = {"geometric_normal": (0.0, 0.0, 1.0), "shading_normal": (0.0, 0.0, 1.0), "light": -1, "offset": 1e-5}
    return state(Surfaces, n, **(defaults | fields))


def shadow_rays(n: int, **fields) -> ShadowRays:
    return state(ShadowRays, n, **fields)


class Counters:
    """The counters of a worker, and queues that count in them."""

    INDEX = {"rays": 0, "hits": 1, "escaped": 2, "emissive": 3, "shadow": 4}

    def __init__(self, depth: int = 0):
        self.array = wp.zeros(queues.COUNTER_COUNT, dtype=wp.int32, device=DEVICE)
        self.struct = queues.make_counters(self.array)
        self.totals = wp.zeros(queues.TOTAL_COUNT, dtype=wp.int64, device=DEVICE)
        self.array.numpy()[queues.DEPTH] = depth  # on the CPU device the host sees it in place
        self.storage = {}

    def queue(self, name: str, slots=(), capacity: int = 16) -> Queue:
        """A queue that holds `slots`. One entry more than the capacity is allocated to catch what is out of bounds."""
        storage = wp.array(np.full(capacity + 4, -7, np.int32), dtype=wp.int32, device=DEVICE)
        storage.numpy()[: len(slots)] = slots
        self.storage[name] = storage
        queue = Queue()
        queue.slots = storage[:capacity]
        index = self.INDEX[name]
        queue.count = self.array[index : index + 1]
        self.array.numpy()[index] = len(slots)
        return queue

    def content(self, name: str) -> list[int]:
        return sorted(self.storage[name].numpy()[: self[self.INDEX[name]]].tolist())

    def beyond(self, name: str) -> np.ndarray:
        """What lies behind the end of the queue: -7 where nothing was written."""
        return self.storage[name].numpy()[-4:]

    def __getitem__(self, index: int) -> int:
        return int(self.array.numpy()[index])


def launch(kernel, dim: int, *arguments) -> None:
    wp.launch(kernel, dim=dim, inputs=list(arguments), device=DEVICE)


# --- scene tables ------------------------------------------------------------------------------------------------


class Scene:
    """Triangles (rows of three corners) and spheres (centre and radius), each a shape of its own."""

    def __init__(self, triangles=(), spheres=(), normals=None, uvs=None, shapes=None):
        g = self.geometry = Geometry()
        corners = np.asarray(triangles, np.float32).reshape(-1, 3)
        count = len(corners) // 3
        g.triangle_count = count
        g.points = array(corners, wp.vec3)
        g.indices = array(np.arange(3 * count, dtype=np.int32), wp.int32)
        g.normals = array(np.zeros((0, 3)) if normals is None else np.reshape(normals, (-1, 3)), wp.vec3)
        g.uvs = array(np.zeros((0, 2)) if uvs is None else np.reshape(uvs, (-1, 2)), wp.vec2)
        g.spheres = array(np.asarray(spheres, np.float32).reshape(-1, 4), wp.vec4)
        total = count + len(spheres)
        g.shape_of = array(np.arange(total, dtype=np.int32), wp.int32)
        defaults = [{"first_light": -1, "first_primitive": i} for i in range(total)]
        g.shapes = records(Shape, [a | b for a, b in zip(defaults, shapes or [{}] * total, strict=True)])
        hierarchies = []
        if count:
            hierarchies.append((TriangleBvh(g.points, g.indices, alone=False), g.points))
        if len(spheres):
            s = np.asarray(spheres, np.float32)
            boxes = [array(s[:, :3] + grown * s[:, 3:], wp.vec3) for grown in (-1.001, 1.001)]
            hierarchies.append((BoxBvh(*boxes, alone=False), *boxes))
        if hierarchies:
            g.bvh = place(hierarchies)
            g.own.sphere_root = hierarchies[-1][0].first_node


def lights(rows: list[dict], radiances, environment: int = -1) -> light.LightTables:
    """Lights with their probability `pmf`, each selected by its own cell (so equal probabilities), one emitter each."""
    tables = light.LightTables()
    defaults = [{"emitter": i, "pmf": 1.0 / len(rows), "alias_threshold": 1.0, "alias": i} for i in range(len(rows))]
    tables.lights = records(light.Light, [a | b for a, b in zip(defaults, rows, strict=True)])
    tables.emitters = records(light.EmitterRecord, [{"radiance": L, "radiance_texture": -1} for L in radiances])
    tables.environment = environment
    return tables


def no_textures() -> TextureTables:
    tables = TextureTables()
    tables.records = records(TextureRecord, [])
    tables.bytes, tables.floats = array(np.zeros(0, np.uint8), wp.uint8), array(np.zeros(0), wp.float32)
    tables.srgb_to_linear = array(np.zeros(256), wp.float32)
    return tables


def materials(diffuse=(), conductor=(), dielectric=()) -> bsdf.MaterialTables:
    """One material per record: one-sided diffuse and smooth conductors, then smooth dielectrics."""
    tables = bsdf.MaterialTables()
    rows = [{"front": bsdf.KINDS["diffuse"], "front_index": i} for i in range(len(diffuse))]
    rows += [{"front": bsdf.KINDS["conductor"], "front_index": i} for i in range(len(conductor))]
    glass = bsdf.KINDS["dielectric"]
    rows += [{"front": glass, "front_index": i, "back": glass, "back_index": i} for i in range(len(dielectric))]
    tables.materials = records(bsdf.Material, [{"opacity": 1.0, "opacity_texture": -1} | row for row in rows])
    parameters = ("reflectance", "transmittance", "eta", "k", "alpha_u", "alpha_v")
    none = {f"{name}_texture": -1 for name in parameters}

    def with_defaults(struct, rows):
        return records(struct, [{k: v for k, v in none.items() if k in struct.vars} | row for row in rows])

    tables.diffuse = with_defaults(bsdf.DiffuseRecord, list(diffuse))
    tables.conductor = with_defaults(bsdf.ConductorRecord, list(conductor))
    tables.dielectric = with_defaults(bsdf.DielectricRecord, list(dielectric))
    return tables


# --- oracles -----------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False, module="unique")
def _uniform_kernel(
    seed: wp.uint64,
    pixel: wp.array(dtype=wp.uint32),
    sample: wp.array(dtype=wp.uint32),
    bounce: int,
    purpose: int,
    # outputs
    u: wp.array(dtype=wp.vec4),
):
    i = wp.tid()
    u[i] = uniform4(seed, pixel[i], sample[i], bounce, purpose)


def uniforms(seed: int, pixel, sample, bounce: int, purpose: int) -> np.ndarray:
    """The random numbers of given keys (the generator has tests of its own), float64, shape [N, 4]."""
    pixel, sample = np.broadcast_arrays(np.asarray(pixel, np.uint32), np.asarray(sample, np.uint32))
    out = wp.zeros(pixel.size, dtype=wp.vec4, device=DEVICE)
    keys = [array(a.ravel(), wp.uint32) for a in (pixel, sample)]
    wp.launch(_uniform_kernel, pixel.size, [wp.uint64(seed), *keys, bounce, purpose], [out], device=DEVICE)
    return out.numpy().astype(np.float64)


def power_heuristic(a, b):
    """Veach's weight in float64."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    return a**2 / (a**2 + b**2)


def unit(v):
    v = np.asarray(v, np.float64)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
