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
    Counters,
)
from wavefront.stage_kernel import stage_kernel


@stage_kernel
def drain_rays(counters: Counters, totals: wp.array[wp.int64]):
    """Before scattering: counts the rays traced and empties their queue, which scattering fills again."""
    totals[TOTAL_RAYS] += wp.int64(counters.values[RAYS])
    totals[TOTAL_SHADOW_RAYS] += wp.int64(counters.values[SHADOW])
    counters.values[RAYS] = 0


@stage_kernel
def advance_bounce(counters: Counters):
    """After scattering: empties the other queues and tells whether there is another bounce."""
    counters.values[HITS] = 0
    counters.values[ESCAPED] = 0
    counters.values[EMISSIVE] = 0
    counters.values[SHADOW] = 0
    counters.values[DEPTH] += 1
    counters.values[CONTINUE] = wp.where(counters.values[RAYS] > 0, 1, 0)


@stage_kernel
def advance_guided_bounce(counters: Counters):
    """As `advance_bounce`, with the queues of a guided bounce."""
    counters.values[HITS] = 0
    counters.values[ESCAPED] = 0
    counters.values[EMISSIVE] = 0
    counters.values[SHADOW] = 0
    counters.values[GUIDED] = 0
    counters.values[LIT] = 0
    counters.values[PROPOSED] = 0
    counters.values[SMOOTH] = 0
    counters.values[DEPTH] += 1
    counters.values[CONTINUE] = wp.where(counters.values[RAYS] > 0, 1, 0)
