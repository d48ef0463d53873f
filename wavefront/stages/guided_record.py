"""Writes down what recorded paths find on their way: see `wavefront.recording`.

The stages that add emission multiply it with the throughput. While paths are recorded, that is put aside before the
intersection, which then leaves the transmittance of the segment in its place; the same kernels run on that first, into
an array of their own, and once more with the throughput.
"""

from __future__ import annotations

import functools

import warp as wp

from wavefront.queues import DEPTH, Counters, Paths, Queue, queue_end, slot_at
from wavefront.recording import RecordScratch, Rows, record_row
from wavefront.stage_kernel import stage_kernel


@stage_kernel
def put_throughput_aside(
    rays: Queue,
    # out
    paths: Paths,
    scratch: RecordScratch,
):
    """Before the intersection."""
    for i in range(wp.tid(), queue_end(rays, wp.tid())):
        slot = slot_at(rays, i)
        scratch.beta[slot] = paths.beta[slot]
        paths.beta[slot] = wp.vec3(1.0)


@functools.cache
def make_record_arrivals(taken: bool):
    """Kernel of the stage after the intersection and the emission that is seen from the last vertex.

    Args:
        taken: Whether weights take from the emission, and the records shall have what they take.
    """

    @stage_kernel
    def record_arrivals(
        rays: Queue,
        tile: wp.array[wp.int32],
        counters: Counters,
        # out
        paths: Paths,
        scratch: RecordScratch,
        rows: Rows,
    ):
        for i in range(wp.tid(), queue_end(rays, wp.tid())):
            slot = slot_at(rays, i)
            through = paths.beta[slot]
            paths.beta[slot] = wp.cw_mul(scratch.beta[slot], through)
            emission = scratch.emission[slot]
            scratch.emission[slot] = wp.vec3(0.0)
            whole = wp.vec3(0.0)
            if wp.static(taken):
                whole = scratch.whole_emission[slot]
                scratch.whole_emission[slot] = wp.vec3(0.0)
            row = record_row(rows, tile, slot)
            if row < 0:
                continue
            depth = counters.values[DEPTH]
            entry = wp.min(depth, rows.depth) * rows.count + row
            if depth <= rows.depth:
                rows.arrival[entry] = emission
                rows.through[entry] = through
                if wp.static(taken):
                    rows.taken[entry] = wp.max(whole - emission, wp.vec3(0.0))
            else:
                rows.arrival[entry] += wp.cw_mul(rows.through[entry], emission)
                rows.through[entry] = wp.cw_mul(rows.through[entry], through)

    return record_arrivals


@stage_kernel
def record_direct_light(
    shadow: Queue,
    tile: wp.array[wp.int32],
    counters: Counters,
    # out
    paths: Paths,
    scratch: RecordScratch,
    rows: Rows,
):
    """After the shadow rays, which have left in `scratch.visible` what they would have added to the path."""
    for i in range(wp.tid(), queue_end(shadow, wp.tid())):
        slot = slot_at(shadow, i)
        L = scratch.visible[slot]
        if wp.max(L) == 0.0:
            continue
        scratch.visible[slot] = wp.vec3(0.0)
        paths.L[slot] += L
        row = record_row(rows, tile, slot)
        if row >= 0:
            entry = wp.min(counters.values[DEPTH], rows.depth) * rows.count + row
            rows.arrival[entry] += wp.cw_mul(rows.through[entry], scratch.light[slot])
