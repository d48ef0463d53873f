"""Adding radiance to a path, with the account of what is left out."""

import warp as wp

from wavefront.finite import is_radiance
from wavefront.queues import Counters, Paths


@wp.func
def add_radiance(paths: Paths, slot: int, L: wp.vec3, counters: Counters, nonfinite_counter: int):
    """Adds `L` to the path's radiance; a non-finite or negative contribution is counted and left out."""
    if is_radiance(L):
        paths.L[slot] += L
    else:
        wp.atomic_add(counters.values, nonfinite_counter, 1)
