"""Path state in fixed slots, and queues of slot indices (Laine, Karras and Aila 2013).

A path lives in one slot for its whole life. Stages read the queue they work on, early-out on its device-side count,
and push the slot to the queues of the stages that come next. Nothing here is atomic across threads of the CPU
device: every worker owns its paths and its queues.
"""

from __future__ import annotations

import numpy as np
import warp as wp

# Layout of the counters that a worker's kernels share: one int32 array, so that the host reads them in one look.
RAYS = wp.constant(0)  # count of each queue
HITS = wp.constant(1)
ESCAPED = wp.constant(2)
EMISSIVE = wp.constant(3)
SHADOW = wp.constant(4)
DEPTH = wp.constant(5)  # scatterings so far, the same for all paths of a pass
CONTINUE = wp.constant(6)  # 1 while the bounce loop goes on: the condition of wp.capture_while
STATUS = wp.constant(7)  # bit flags below
NONFINITE_EMISSION = wp.constant(8)  # contributions left out because they were not finite or negative, by stage
NONFINITE_ESCAPED = wp.constant(9)
NONFINITE_DIRECT = wp.constant(10)
NONFINITE_SCATTER = wp.constant(11)
NONFINITE_ACCUMULATE = wp.constant(12)
GUIDED = wp.constant(13)  # counts of the queues of a guided bounce
LIT = wp.constant(14)
PROPOSED = wp.constant(15)
SMOOTH = wp.constant(16)
COUNTER_COUNT = 17
NONFINITE_STAGES = {"emission": 8, "escaped": 9, "direct": 10, "scatter": 11, "accumulate": 12}

STATUS_QUEUE_OVERFLOW = wp.constant(1)

# Totals over passes, int64.
TOTAL_RAYS = wp.constant(0)
TOTAL_SHADOW_RAYS = wp.constant(1)
TOTAL_PATHS = wp.constant(2)
TOTAL_COUNT = 3

# Layout of the int32 array that says which pixels and samples a pass traces.
TILE_X = wp.constant(0)
TILE_Y = wp.constant(1)
TILE_WIDTH = wp.constant(2)
TILE_HEIGHT = wp.constant(3)
FIRST_SAMPLE = wp.constant(4)
SAMPLE_COUNT = wp.constant(5)  # samples per pixel in this pass
TILE_FIELDS = 6


@wp.struct
class Counters:
    """What the stages of a worker count.

    In a struct, because Warp compiles a kernel with an array among its own arguments twice for the CPU device.
    """

    values: wp.array[wp.int32]


@wp.struct
class Queue:
    """Indices of slots; `count` may exceed the capacity after an overflow, which sets a status bit."""

    slots: wp.array[wp.int32]
    count: wp.array[wp.int32]


@wp.func
def queue_size(queue: Queue) -> int:
    return wp.min(queue.count[0], queue.slots.shape[0])


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return thread < size ? thread + 1 : thread;
#else
    return thread == 0 ? size : thread;
#endif
""")
def end_of_share(size: int, thread: int) -> int: ...


@wp.func
def queue_end(queue: Queue, thread: int) -> int:
    """Where the entries of a thread end that begin at the index of the thread.

    On CUDA a thread takes one. On the CPU device the first takes all: what describes the arrays of a kernel's arguments
    is then loaded once for a queue and not again for every entry, which was a tenth of the time of a render.
    """
    return end_of_share(queue_size(queue), thread)


@wp.func
def slot_at(queue: Queue, i: int) -> int:
    """Entry `i`. Slots are not negative, and the compiler knows: an index that may be is counted from the end."""
    return queue.slots[i] & 0x7FFFFFFF


@wp.func
def push(queue: Queue, slot: int, counters: Counters):
    index = wp.atomic_add(queue.count, 0, 1)
    if index < queue.slots.shape[0]:
        queue.slots[index] = slot
    else:
        wp.atomic_or(counters.values, STATUS, STATUS_QUEUE_OVERFLOW)


@wp.struct
class Paths:
    """State of a path between its vertices, one entry per slot."""

    origin: wp.array[wp.vec3]  # next ray
    direction: wp.array[wp.vec3]  # unit length
    beta: wp.array[wp.vec3]  # throughput
    L: wp.array[wp.vec3]  # radiance collected so far
    pdf: wp.array[wp.float32]  # of `direction`, in solid angle; 0 for a delta lobe or the camera
    eta: wp.array[wp.float32]  # product of relative indices of refraction; allocated if something transmits
    medium: wp.array[wp.int32]  # that the next ray travels in; allocated if a medium absorbs
    pixel: wp.array[wp.uint32]  # key of the random numbers, with the sample
    sample: wp.array[wp.uint32]


@wp.struct
class Surfaces:
    """The vertex that a path has just reached, one entry per slot."""

    position: wp.array[wp.vec3]
    geometric_normal: wp.array[wp.vec3]  # on the side of the shading normal
    shading_normal: wp.array[wp.vec3]
    # Unit length, orthogonal to the shading normal, along growing u; allocated if a BSDF or a map depends on it.
    tangent: wp.array[wp.vec3]
    uv_jacobian: wp.array[wp.vec3]  # see `surface.Vertex`; allocated if there are bump maps
    base_normal: wp.array[wp.vec3]  # shading normal before bump or normal maps; allocated if there are such
    terminator: wp.array[wp.float32]  # see `bsdf.frame.base_shadowing`; allocated as the base normal
    offset: wp.array[wp.float32]  # how far along the geometric normal a ray must start, in metres
    uv: wp.array[wp.vec2]  # allocated if a texture is looked up, or asked for as an AOV
    media: wp.array[wp.vec2i]  # in front of the geometric normal and behind it; allocated if a medium absorbs
    material: wp.array[wp.int32]  # -1 where the ray escaped
    light: wp.array[wp.int32]  # -1 where the surface does not emit
    shape: wp.array[wp.int32]  # allocated if asked for as an AOV


@wp.struct
class ShadowRays:
    """Light samples that wait for their visibility, one entry per slot."""

    origin: wp.array[wp.vec3]
    direction: wp.array[wp.vec3]  # scaled so that the light is at parameter t_max
    t_max: wp.array[wp.float32]
    L: wp.array[wp.vec3]  # what arrives at the camera if nothing is in between
    blocked: wp.array[wp.int32]  # 1 if something is in between; allocated if rays go in streams


def allocate_struct(struct: type, capacity: int, device: str, skip: tuple[str, ...] = ()):
    """An instance of a struct of arrays with `capacity` entries in every array but those in `skip`."""
    instance = struct()
    for name, variable in struct.vars.items():
        if name not in skip:
            setattr(instance, name, wp.zeros(capacity, dtype=variable.type.dtype, device=device))
    return instance


def bytes_per_slot(struct: type, skip: tuple[str, ...] = ()) -> int:
    """Memory that one slot of `struct` takes."""
    return sum(wp.types.type_size_in_bytes(v.type.dtype) for name, v in struct.vars.items() if name not in skip)


def make_counters(values: wp.array) -> Counters:
    """The argument of stages."""
    counters = Counters()
    counters.values = values
    return counters


class QueueSet:
    """The queues of one worker and the counters they share.

    Args:
        capacity: Slots per queue.
        device: Warp device.
        names: Queues to allocate; the others are empty and must not be pushed to.
    """

    INDEX = {
        "rays": 0,
        "hits": 1,
        "escaped": 2,
        "emissive": 3,
        "shadow": 4,
        "guided": 13,
        "lit": 14,
        "proposed": 15,
        "smooth": 16,
    }

    def __init__(self, capacity: int, device: str, names: tuple[str, ...]):
        self.capacity = capacity
        self.counters = wp.zeros(COUNTER_COUNT, dtype=wp.int32, device=device)
        self.counter_struct = make_counters(self.counters)
        self.totals = wp.zeros(TOTAL_COUNT, dtype=wp.int64, device=device)
        self.queues = {}
        for name, index in self.INDEX.items():
            queue = Queue()
            queue.slots = wp.zeros(capacity if name in names else 0, dtype=wp.int32, device=device)
            queue.count = self.counters[index : index + 1]
            self.queues[name] = queue
        # On the CPU device the host sees the counters in place, and launches no more than is queued.
        self.host_counters: np.ndarray | None = self.counters.numpy() if device == "cpu" else None

    def __getitem__(self, name: str) -> Queue:
        return self.queues[name]

    def count(self, name: str) -> int:
        """Entries in a queue; on the CPU device only."""
        return int(self.host_counters[self.INDEX[name]])
