"""Strict renders: which path made a contribution that is not finite or negative."""

from __future__ import annotations

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
    width, height = renderer.film.width, renderer.film.height
    worker = Worker(**worker_arguments(renderer, min(SEARCH_CAPACITY, renderer.capacity)))

    def found(x, y, columns, rows, sample) -> bool:
        before = sum(worker.nonfinite().values())
        worker.trace_tile(Tile(x, y, columns, rows, sample, 1))
        return sum(worker.nonfinite().values()) > before

    columns = min(width, worker.capacity)
    rows = max(1, worker.capacity // columns)
    for sample in range(first_sample, first_sample + sample_count):
        for y in range(0, height, rows):
            for x in range(0, width, columns):
                w, h = min(columns, width - x), min(rows, height - y)
                if not found(x, y, w, h, sample):
                    continue
                while h > 1:  # the upper half, or else the lower
                    upper = h // 2
                    y, h = (y, upper) if found(x, y, w, upper, sample) else (y + upper, h - upper)
                while w > 1:
                    left = w // 2
                    x, w = (x, left) if found(x, y, left, 1, sample) else (x + left, w - left)
                stages = TraceWorker(renderer).trace(x, y, sample).left_out
                return NonFiniteError(stages[0], x, y, sample, renderer.seed)
    raise AssertionError("a contribution that is not finite was counted, but no path makes one")
