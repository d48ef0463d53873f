"""Queues and path state: sizes, memory, and an overflow that nobody overlooks."""

import numpy as np
import pytest
import warp as wp

from tests.stages.harness import DEVICE, Counters, launch
from wavefront import Renderer, WavefrontError, queues
from wavefront.queues import (
    Paths,
    Queue,
    QueueSet,
    ShadowRays,
    Surfaces,
    allocate_struct,
    bytes_per_slot,
    push,
    queue_end,
    queue_size,
    slot_at,
)
from wavefront.scene import description as d


@wp.kernel(enable_backward=False, module="unique")
def push_kernel(queue: Queue, counters: queues.Counters, sizes: wp.array(dtype=wp.int32)):
    i = wp.tid()
    push(queue, 100 + i, counters)
    sizes[i] = queue_size(queue)


@pytest.mark.parametrize("capacity", [0, 1, 5, 12, 20])
def test_push(capacity):
    """What does not fit is counted, reported, and not written; readers see no more than the capacity."""
    counters = Counters()
    queue = counters.queue("hits", capacity=capacity)
    sizes = wp.zeros(12, dtype=wp.int32, device=DEVICE)
    launch(push_kernel, 12, queue, counters.struct, sizes)
    kept = min(12, capacity)
    assert sorted(counters.storage["hits"].numpy()[:kept]) == list(range(100, 100 + kept))
    assert (counters.storage["hits"].numpy()[kept:] == -7).all()
    assert counters[queues.HITS] == 12
    assert counters[queues.STATUS] == (0 if capacity >= 12 else int(queues.STATUS_QUEUE_OVERFLOW))
    assert sizes.numpy().max() == kept


@wp.kernel(enable_backward=False, module="unique")
def visit_kernel(queue: Queue, visits: wp.array(dtype=wp.int32)):
    for i in range(wp.tid(), queue_end(queue, wp.tid())):
        visits[slot_at(queue, i)] += 1


@pytest.mark.parametrize(("entries", "threads"), [(0, 1), (1, 1), (12, 1), (12, 12), (12, 20), (30, 20)])
def test_every_entry_is_visited_once(entries, threads):
    """By whatever number of threads; what did not fit is not there."""
    counters = Counters()
    queue = counters.queue("hits", capacity=20)
    slots = np.random.default_rng(1).permutation(20).astype(np.int32)
    counters.storage["hits"].numpy()[:20] = slots
    queue.count.fill_(entries)
    visits = wp.zeros(20, dtype=wp.int32, device=DEVICE)
    launch(visit_kernel, threads, queue, visits)
    expected = np.zeros(20, np.int32)
    expected[slots[:entries]] = 1
    np.testing.assert_array_equal(visits.numpy(), expected)


def test_queue_set():
    """Every queue counts in its own place; queues that are not named take no memory."""
    q = QueueSet(8, DEVICE, ("rays", "hits"))
    for name, index in QueueSet.INDEX.items():
        assert q[name].slots.shape[0] == (8 if name in ("rays", "hits") else 0)
        q.host_counters[:] = 0
        q[name].count.numpy()[0] = 3
        assert q.counters.numpy()[index] == 3
        assert q.count(name) == 3
    others = (queues.DEPTH, queues.CONTINUE, queues.STATUS, *queues.NONFINITE_STAGES.values())
    assert len({*QueueSet.INDEX.values(), *others}) == queues.COUNTER_COUNT


@pytest.mark.parametrize("struct", [Paths, Surfaces, ShadowRays])
def test_bytes_per_slot_is_what_is_allocated(struct):
    for skip in ((), tuple(struct.vars)[:2]):
        instance = allocate_struct(struct, 1000, DEVICE, skip)
        allocated = 0
        for name in struct.vars:
            value = getattr(instance, name)
            if name in skip:
                assert value is None or value.size == 0
            else:
                assert value.shape == (1000,)
                allocated += value.capacity
        assert allocated == 1000 * bytes_per_slot(struct, skip)


def room():
    shape = d.Sphere(flip_normals=True, bsdf=d.Diffuse(reflectance=0.5), emitter=d.Area(radiance=1.0))
    integrator = d.PathIntegrator(max_depth=4, nee=False, rr_depth=None)
    return d.Scene(shapes=[shape], film=d.Film(width=16, height=16), integrator=integrator)


def test_worker_raises_on_overflow():
    """Through the whole renderer: a queue of hits that is too small ends the render with an error."""
    renderer = Renderer(room(), threads=1)
    renderer.render(1)
    worker = renderer.workers[0]
    worker.check_status()
    hits = worker.queues["hits"]
    storage = hits.slots.numpy()
    storage[:] = -7
    hits.slots = hits.slots[:10]
    # The recorded launches hold copies of the struct, so they are made anew from the same arguments.
    for stage in ("intersect", "scatter"):
        kernel = getattr(renderer.kernels, stage)
        worker.commands[stage] = wp.launch(
            kernel, dim=worker.capacity, inputs=worker._arguments[stage], device=DEVICE, record_cmd=True
        )
    with pytest.raises(WavefrontError, match="queue overflowed"):
        renderer.render(1)
    assert (storage[10:] == -7).all()
    assert renderer.sample_count == 1


def test_statistics_count_nonfinite_contributions_by_stage():
    renderer = Renderer(room(), threads=1)
    renderer.render(1)
    assert set(renderer.statistics.nonfinite) == {"emission", "escaped", "direct", "scatter", "accumulate"}
    renderer.workers[0].queues.counters.numpy()[queues.NONFINITE_STAGES["direct"]] = 3
    assert renderer.workers[0].nonfinite() == renderer.statistics.nonfinite | {"direct": 3}
    assert sum(renderer.statistics.nonfinite.values()) == 0
    np.testing.assert_allclose(renderer.film.image(), 1.875, rtol=1e-6)
