"""Guided vertices: queues the vertices where a guide has a say, with the share of BSDF sampling there."""

from __future__ import annotations

import warp as wp

from wavefront.bsdf.dispatch import is_smooth
from wavefront.bsdf.tables import MaterialTables
from wavefront.proposals import Proposals
from wavefront.queues import Paths, Queue, Surfaces, push, queue_size


@wp.kernel(enable_backward=False, module="unique")
def queue_guided_vertices(
    materials: MaterialTables,
    paths: Paths,
    surfaces: Surfaces,
    hits: Queue,
    share: float,  # of BSDF sampling, unless the guide says otherwise
    # out
    proposals: Proposals,
    guided: Queue,
    counters: wp.array[wp.int32],
):
    """A BSDF of deltas alone needs no guide."""
    i = wp.tid()
    if i >= queue_size(hits):
        return
    slot = hits.slots[i]
    cos_o = -wp.dot(surfaces.shading_normal[slot], paths.direction[slot])
    if is_smooth(materials.materials[surfaces.material[slot]], cos_o):
        proposals.share[slot] = share
        push(guided, slot, counters)
    else:
        proposals.share[slot] = 1.0
