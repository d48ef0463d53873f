"""Arrays of the caller as Warp arrays of a device, without copies where that is possible."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from nn.errors import NnError

Array = np.ndarray | wp.array  # or a tensor of PyTorch, which is not needed for the other two


def is_tensor(array: object) -> bool:
    """Whether it is a tensor of PyTorch."""
    return hasattr(array, "__torch_function__")


def as_input(array: Array, width: int | None, name: str, device) -> wp.array:
    """A contiguous float32 array ``[n, width]`` that shares the memory of `array` if that is such an array.

    A `width` of None allows any but 0.

    Raises:
        NnError: Kind, shape, type or device are not allowed; `name` is what the message calls it.
    """
    shape = tuple(getattr(array, "shape", ()))
    if len(shape) != 2 or (shape[1] != width if width is not None else shape[1] < 1):
        allowed = "1 or more" if width is None else width
        raise NnError(f"{name}: found shape {shape}; allowed: [n, {allowed}]")
    if is_tensor(array) and str(array.dtype) == "torch.float32":
        array = wp.from_torch(array.detach().contiguous(), requires_grad=False)
    if isinstance(array, wp.array):
        if array.dtype != wp.float32 or array.device != device:
            raise NnError(f"{name}: found {array.dtype.__name__} on {array.device}; allowed: float32 on {device}")
        return array if array.is_contiguous else wp.clone(array)
    if not isinstance(array, np.ndarray):
        found = array.dtype if is_tensor(array) else type(array).__name__
        raise NnError(f"{name}: found {found}; allowed: a NumPy or Warp array, or a tensor of float32")
    if array.dtype.kind not in "fiu":
        raise NnError(f"{name}: found {array.dtype}; allowed: float32")
    array = np.ascontiguousarray(array, np.float32)
    if array.shape[0] == 0:
        return empty((0, shape[1]), device)
    return wp.array(array, dtype=wp.float32, device=device, copy=False)


def as_output(out: Array | None, n: int, width: int, like: Array, device) -> tuple[wp.array, Callable[[], Array]]:
    """An array ``[n, width]`` to write to, and a function that then gives the caller `out`, or a new one like `like`.

    Raises:
        NnError: `out` cannot be written to in place.
    """
    if out is None:
        if isinstance(like, wp.array) or is_tensor(like):
            array = empty((n, width), device)
            return array, lambda: as_kind_of(like, array)
        out = np.empty((n, width), np.float32)
    if tuple(out.shape) != (n, width):
        raise NnError(f"out: found shape {tuple(out.shape)}; allowed: {(n, width)}")
    if is_tensor(out):
        if str(out.dtype) != "torch.float32" or not out.is_contiguous() or out.requires_grad:
            raise NnError("out: allowed: a contiguous tensor of float32 without gradient")
        return wp.from_torch(out, requires_grad=False), lambda: out
    if isinstance(out, wp.array):
        if out.dtype != wp.float32 or not out.is_contiguous or out.device != device:
            raise NnError(f"out: allowed: a contiguous float32 array on {device}")
        return out, lambda: out
    if out.dtype != np.float32 or not out.flags.c_contiguous or not out.flags.writeable:
        raise NnError("out: allowed: a contiguous float32 array that can be written")
    if n == 0:
        return empty((0, width), device), lambda: out
    if device.is_cpu:
        return wp.array(out, dtype=wp.float32, device=device, copy=False), lambda: out
    array = empty((n, width), device)

    def finish():
        out[...] = array.numpy()
        return out

    return array, finish


def as_kind_of(like: Array, array: wp.array) -> Array:
    """`array` as NumPy, Warp or PyTorch has it, whichever `like` is of."""
    if is_tensor(like):
        return wp.to_torch(array)
    return array if isinstance(like, wp.array) else array.numpy()


def as_index(index: Array, n: int, most: int, name: str, device) -> wp.array:
    """`n` row numbers below `most`, as int32. Those on a GPU are not read back: kernels leave NaN for wrong ones.

    Raises:
        NnError: Its length, type or a number is not allowed.
    """
    checked = device.is_cpu or isinstance(index, np.ndarray)
    if is_tensor(index):
        index = wp.from_torch(index.detach().contiguous()) if str(index.dtype) == "torch.int32" else index.cpu().numpy()
    if not isinstance(index, wp.array):
        index = wp.array(np.ascontiguousarray(index, np.int32), dtype=wp.int32, device=device)
    if index.shape != (n,) or index.dtype != wp.int32:
        raise NnError(f"{name}: found an index of shape {index.shape}; allowed: {n} whole numbers")
    if n and checked:
        values = index.numpy()
        if values.min() < 0 or values.max() >= most:
            raise NnError(f"{name}: found indices from {values.min()} to {values.max()}; allowed: 0 to {most - 1}")
    return index


def empty(shape: tuple[int, ...], device) -> wp.array:
    """A float32 array that holds anything."""
    return wp.empty(shape, dtype=wp.float32, device=device)


def check_rows(array: wp.array, rows: wp.array) -> None:
    """Raises an `NnError` unless both have as many rows."""
    if array.shape[0] != rows.shape[0]:
        raise NnError(f"found {array.shape[0]} rows of targets for {rows.shape[0]} rows of inputs")
