"""Asking for memory before it is needed, on the CPU device, where a thread would otherwise wait for it.

On CUDA other threads run meanwhile, and nothing is asked for.
"""

# Annotations are evaluated at once, for the type of an argument is that of a factory.
import functools

import warp as wp

_PREFETCH = """
#if !defined(__CUDA_ARCH__)
    __builtin_prefetch(values.data + i);
#endif
"""


@functools.cache
def make_prefetch(dtype):
    """`prefetch(values, i)` for an array of `dtype`; `i` may be any number."""

    @wp.func_native(_PREFETCH)
    def prefetch(values: wp.array(dtype=dtype), i: wp.int64): ...

    return prefetch
