"""How kernels of the renderer and of guides are declared."""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

# A function that is not inlined gets the tables of a scene by value, several hundred bytes of array descriptors at each
# call; of veach-ajar's light sampling half of the time was such copies. Warp's own limit leaves them in BSDFs of many
# kinds; no limit at all makes such kernels compile three times as long.
_WARP_LIMIT, _LIMIT = "-inline-threshold=9000", "-inline-threshold=100000"


def stage_kernel(function: Callable) -> wp.Kernel:
    """A kernel in a module of its own, without a backward pass.

    For the CPU device it is compiled with Warp's flags, as `wp.config.cpu_compiler_flags` has them, and a higher limit
    for inlining.
    """
    flags = wp.config.cpu_compiler_flags
    options = {"cpu_compiler_flags": flags and flags.replace(_WARP_LIMIT, _LIMIT)}
    return wp.kernel(function, enable_backward=False, module="unique", module_options=options)
