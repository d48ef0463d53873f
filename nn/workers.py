"""Launches spread over threads on the CPU device, and buffers that are used again."""

from __future__ import annotations

import collections
import contextlib
import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import warp as wp


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Workers:
    """Runs parts of a job in threads. A launch holds no lock while it runs, so that launches run side by side.

    Args:
        threads: How many; the calling thread is one of them.
    """

    def __init__(self, threads: int):
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads - 1, thread_name_prefix="nn") if threads > 1 else None

    def run(self, job: Callable[[int, int, int], object], n: int, smallest: int = 1) -> None:
        """Calls ``job(first, count, worker)`` so that every item below `n` is in one call.

        Args:
            job: Must give the same result however the items are split.
            n: Number of items.
            smallest: Fewest items that are worth a call.
        """
        if n <= 0:
            return
        parts = min(2 * self.threads, n // max(smallest, 1)) if self._pool else 1
        if parts <= 1:
            job(0, n, 0)
            return
        bounds = [n * i // parts for i in range(parts + 1)]
        tickets = itertools.count()

        def work(worker):
            while (i := next(tickets)) < parts:
                job(bounds[i], bounds[i + 1] - bounds[i], worker)

        futures = [self._pool.submit(work, worker) for worker in range(1, min(self.threads, parts))]
        try:
            work(0)
        finally:
            for future in futures:
                future.result()


class Buffers:
    """Arrays of float32 that begin as zeros and are lent again; several threads may ask."""

    def __init__(self, device):
        self.device = device
        self._free = collections.defaultdict(collections.deque)

    @contextlib.contextmanager
    def lend(self, kind: object, size: int):
        """An array of at least `size`; one of a `kind` is given back as it was left."""
        array = self.take(kind, size)
        try:
            yield array
        finally:
            self.give(kind, array)

    def take(self, kind: object, size: int) -> wp.array:
        """As `lend`, until `give`."""
        free = self._free[kind]
        try:
            array = free.pop()
        except IndexError:
            array = None
        if array is None or array.size < size:
            array = wp.zeros(max(size, 1), dtype=wp.float32, device=self.device)
        return array

    def give(self, kind: object, array: wp.array) -> None:
        """Makes `array` available again."""
        self._free[kind].append(array)
