"""Bookkeeping between bounces, on the device, so that the host need not look."""

from __future__ import annotations

import warp as wp

from wavefront.queues import (
    CONTINUE,
    DEPTH,
    EMISSIVE,
    ESCAPED,
    GUIDED,
    HITS,
    LIT,
    PROPOSED,
    RAYS,
    SHADOW,
    SMOOTH,
    TOTAL_RAYS,
    TOTAL_SHADOW_RAYS,
)
from wavefront.stage_kernel import stage_kernel


@stage_kernel
def drain_rays(counters: wp.array[wp.int32], totals: wp.array[wp.int64]):
    """Before scattering: counts the rays traced and empties their queue, which scattering fills again."""
    totals[TOTAL_RAYS] += wp.int64(counters[RAYS])
    totals[TOTAL_SHADOW_RAYS] += wp.int64(counters[SHADOW])
    counters[RAYS] = 0


@stage_kernel
def advance_bounce(counters: wp.array[wp.int32]):
    """After scattering: empties the other queues and tells whether there is another bounce."""
    counters[HITS] = 0
    counters[ESCAPED] = 0
    counters[EMISSIVE] = 0
    counters[SHADOW] = 0
    counters[DEPTH] += 1
    counters[CONTINUE] = wp.where(counters[RAYS] > 0, 1, 0)


@stage_kernel
def advance_guided_bounce(counters: wp.array[wp.int32]):
    """As `advance_bounce`, with the queues of a guided bounce."""
    counters[HITS] = 0
    counters[ESCAPED] = 0
    counters[EMISSIVE] = 0
    counters[SHADOW] = 0
    counters[GUIDED] = 0
    counters[LIT] = 0
    counters[PROPOSED] = 0
    counters[SMOOTH] = 0
    counters[DEPTH] += 1
    counters[CONTINUE] = wp.where(counters[RAYS] > 0, 1, 0)
