"""Strict renders: which path made a contribution that is not finite or negative."""

from __future__ import annotations

from collections.abc import Callable

from wavefront.errors import WavefrontError
from wavefront.integrator import Tile, Worker
from wavefront.trace import TraceWorker, worker_arguments

SEARCH_CAPACITY = 1 << 16  # paths in flight of the worker that searches


class NonFiniteError(WavefrontError):
    """A contribution that is not finite or negative, in a strict render.

    Args:
        stage: That made it.
        x, y, sample, seed: Which path it is of.
    """

    def __init__(self, stage: str, x: int, y: int, sample: int, seed: int):
        self.stage, self.x, self.y, self.sample, self.seed = stage, x, y, sample, seed
        super().__init__(
            f"the {stage} stage made a contribution that is not finite or negative at pixel {x},{y}, sample {sample}, "
            f"seed {seed}; to see its path, add --pixel {x},{y} --sample {sample} --trace"
        )


def find_nonfinite(renderer, first_sample: int, sample_count: int) -> NonFiniteError:
    """The first path, by sample and then by pixel, with a contribution that is not finite or negative.

    The samples are traced again in ever smaller tiles, which costs nothing unless there is such a contribution. So the
    answer depends neither on workers nor on passes.

    Args:
        renderer: After a pass that counted such a contribution.
        first_sample, sample_count: The samples of that pass.
    """
    worker = Worker(**worker_arguments(renderer, min(SEARCH_CAPACITY, renderer.capacity)))
    for sample in range(first_sample, first_sample + sample_count):

        def found(x: int, y: int, width: int, height: int, sample=sample) -> bool:
            before = sum(worker.nonfinite().values())
            worker.trace_tile(Tile(x, y, width, height, sample, 1))
            return sum(worker.nonfinite().values()) > before

        pixel = first_pixel(found, renderer.film.width, renderer.film.height, worker.capacity)
        if pixel is not None:
            window = renderer.scene.film.window
            x, y = pixel[0] + window.x, pixel[1] + window.y
            stages = TraceWorker(renderer).trace(x, y, sample).left_out
            return NonFiniteError(stages[0], x, y, sample, renderer.seed)
    raise AssertionError("a contribution that is not finite was counted, but no path makes one")


def first_pixel(
    found: Callable[[int, int, int, int], bool], width: int, height: int, capacity: int
) -> tuple[int, int] | None:
    """The first pixel, row by row, that `found` finds: in bands from the top, and then by halves.

    Args:
        found: Whether there is one in the rectangle (x, y, width, height), of at most `capacity` pixels.
        width, height: Of the film.
        capacity: Pixels.

    Returns:
        Its x and y; None if there is none.
    """
    columns = min(width, capacity)
    rows = max(1, capacity // columns)
    for top in range(0, height, rows):
        for left in range(0, width, columns):
            x, y, w, h = left, top, min(columns, width - left), min(rows, height - top)
            if not found(x, y, w, h):
                continue
            while h > 1:  # the upper half, or else the lower
                upper = h // 2
                y, h = (y, upper) if found(x, y, w, upper) else (y + upper, h - upper)
            while w > 1:
                half = w // 2
                x, w = (x, half) if found(x, y, half, 1) else (x + half, w - half)
            return x, y
    return None
