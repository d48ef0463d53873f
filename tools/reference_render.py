"""The renders of `tools.reference`: samples are added, from checkpoint to checkpoint, until an image is good enough.

Whether its error is small enough is asked at numbers of samples that do not depend on the interruptions of a render
(`next_stop`), so that a render which was killed ends with the same samples as one which was not.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np
import warp as wp
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from tools.methods import SEEDS, Job, Mitsuba
from wavefront.checkpoint import CheckpointWriter, read_checkpoint, write_checkpoint
from wavefront.errors import WavefrontError
from wavefront.film import LUMINANCE
from wavefront.identity import scene_hash, scene_records
from wavefront.output import write_film
from wavefront.render import Interrupt
from wavefront.renderer import Renderer
from wavefront.scene.images import write_exr_blocks

EPSILON = 0.01  # of relMSE
LEAST_SAMPLES = 64  # before the variance that they show is believed
STOPS_PER_DOUBLING = 4
BATCH = 16  # samples per pixel of one call of Mitsuba; stops are multiples of it


@dataclasses.dataclass(frozen=True)
class Goal:
    """When a reference is good enough: at the first of these; None is no limit.

    Attributes:
        error: Relative standard error, see `relative_error`.
        spp: Samples per pixel.
        seconds: Wall time of rendering, over all processes that took part.

    Raises:
        WavefrontError: No limit, or one out of range.
    """

    error: float | None = None
    spp: int | None = None
    seconds: float | None = None

    def __post_init__(self):
        if self.error is None and self.spp is None and self.seconds is None:
            raise WavefrontError("a reference without limit; allowed: an error, spp or seconds")
        if self.error is not None and not 0.0 < self.error < math.inf:
            raise WavefrontError(f"a relative standard error of {self.error:g}; allowed: more than 0")
        if self.spp is not None and not 2 <= self.spp < 2**31:
            raise WavefrontError(f"a reference of {self.spp} samples per pixel; allowed: 2 to 2^31 - 1")
        if self.seconds is not None and not 0.0 < self.seconds < math.inf:
            raise WavefrontError(f"a reference of {self.seconds:g} seconds; allowed: more than 0")

    def over(self, samples: int, seconds: float) -> bool:
        """Whether a budget is used up."""
        return bool((self.spp and samples >= self.spp) or (self.seconds and seconds >= self.seconds and samples >= 2))

    def reached(self, samples: int, seconds: float, error: float) -> bool:
        return self.over(samples, seconds) or (self.error is not None and error <= self.error)

    def share(self, samples: int, seconds: float, error: float) -> float:
        """How much of the work is done, as far as one can tell: the error falls with the root of the time."""
        shares = [
            samples / self.spp if self.spp else 0.0,
            seconds / self.seconds if self.seconds else 0.0,
            (self.error / error) ** 2 if self.error and error > 0.0 else 0.0,
        ]
        return min(max(shares), 1.0)


def relative_error(image: np.ndarray, variance: np.ndarray) -> float:
    """Root of the mean over pixels of variance / (Y^2 + 0.01).

    Args:
        image: Mean radiance, [h, w, 3].
        variance: Of the mean luminance Y, [h, w].
    """
    luminance = np.asarray(image, np.float64) @ LUMINANCE
    return float(np.sqrt(np.mean(variance / (luminance**2 + EPSILON))))


def median_relative_error(image: np.ndarray, variance: np.ndarray) -> float:
    """Median of standard error over luminance, of the pixels that are not black; arguments as above."""
    luminance = np.asarray(image, np.float64) @ LUMINANCE
    lit = luminance > 0.0
    return float(np.median(np.sqrt(variance[lit]) / luminance[lit])) if lit.any() else 0.0


def next_stop(samples: int) -> int:
    """The next number of samples at which the error is looked at: 64 times powers of 2^(1/4), in whole batches."""
    step = 0
    while True:
        stop = math.ceil(LEAST_SAMPLES * 2.0 ** (step / STOPS_PER_DOUBLING) / BATCH) * BATCH
        if stop > samples:
            return stop
        step += 1


def is_stop(samples: int) -> bool:
    return samples >= LEAST_SAMPLES and next_stop(samples - 1) == samples


# --- the two renderers -------------------------------------------------------------------------------------------


class Maker(Protocol):
    """A render that gives an image with its variance and can be interrupted.

    Attributes:
        samples: Per pixel, so far.
        seconds: Wall time of rendering, so far, over all processes.
    """

    samples: int
    seconds: float

    def add(self, spp: int, seconds: float | None, after: Callable[[], bool]) -> None:
        """Adds samples per pixel; after some of them calls `after`, which may end it by returning True."""

    def estimate(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean radiance [h, w, 3], and the variance of the mean luminance [h, w], NaN as long as it is not known."""

    def save(self, path: Path) -> None: ...

    def load(self, path: Path) -> None: ...

    def write(self, path: Path) -> None:
        """Writes the EXR file."""

    def details(self) -> dict: ...


class WavefrontMaker:
    """A reference of this renderer, whose film knows the variance; unguided: all samples are alike, and independent."""

    def __init__(self, job: Job, seed: int):
        job.scene.film.aovs = ["variance"]
        try:
            self.renderer = Renderer(job.scene, device=job.device, threads=job.threads, seed=seed, guide=None)
        finally:
            job.scene.film.aovs = []

    @property
    def samples(self) -> int:
        return self.renderer.sample_count

    @property
    def seconds(self) -> float:
        return self.renderer.statistics.render_seconds

    def add(self, spp: int, seconds: float | None, after: Callable[[], bool]) -> None:
        self.renderer.add_samples(spp, seconds, lambda _: after())

    def estimate(self) -> tuple[np.ndarray, np.ndarray]:
        return self.renderer.film.image(), self.renderer.film.variance()

    def save(self, path: Path) -> None:
        self.renderer.save_checkpoint(path)

    def load(self, path: Path) -> None:
        self.renderer.load_checkpoint(path)

    def write(self, path: Path) -> None:
        write_film(path, self.renderer, half=False)

    def details(self) -> dict:
        s = self.renderer.statistics
        left_out = {stage: count for stage, count in s.nonfinite.items() if count}
        return {"paths": s.paths, "nonfinite": left_out, "compile_seconds": s.compile_seconds}


class MitsubaMaker:
    """A reference of Mitsuba 3: batches with seeds of their own, the variance from their spread.

    With batches of n_i samples and means m_i, sum(n_i (m_i - m)^2) / (batches - 1) is without bias for the variance of
    one sample, and 1 / sum(n_i) of it that of the mean m.
    """

    def __init__(self, job: Job, seed: int):
        if not 0 <= seed < SEEDS:
            raise WavefrontError(f"seed {seed} of a reference by mitsuba; allowed: 0 to {SEEDS - 1}")
        self.job, self.seed = job, seed
        self.engine = Mitsuba(job, seed)
        self.samples, self.seconds = 0, 0.0
        window = job.scene.film.window
        self.shape = (window.height, window.width)
        # Sums over batches: of n_i m_i, and of n_i Y_i^2.
        self.sums = {
            "L": np.zeros((*self.shape, 3)),
            "luminance_squared": np.zeros(self.shape),
        }

    def add(self, spp: int, seconds: float | None, after: Callable[[], bool]) -> None:
        begin, target = time.perf_counter(), self.samples + spp
        while self.samples < target:
            started, count = time.perf_counter(), min(BATCH, target - self.samples)
            image = self.engine.draw(count)
            self.sums["L"] += count * image
            self.sums["luminance_squared"] += count * (image @ LUMINANCE) ** 2
            self.samples += count
            now = time.perf_counter()
            self.seconds += now - started
            if after() or (seconds is not None and now - begin >= seconds):
                break

    def estimate(self) -> tuple[np.ndarray, np.ndarray]:
        image = self.sums["L"] / self.samples
        batches = self.engine.calls
        if batches < 2:
            return image, np.full(self.shape, np.nan)
        squares = self.sums["luminance_squared"] - self.samples * (image @ LUMINANCE) ** 2
        return image, np.maximum(squares, 0.0) / ((batches - 1) * self.samples)

    def _sections(self):
        return {
            "batches": {name: wp.array(values.ravel(), dtype=wp.float64, device="cpu", copy=False)
                        for name, values in self.sums.items()}
        }  # fmt: skip

    def _identity(self):
        records = scene_records(self.job.scene)
        return Mitsuba.versions(self.job.device) | {"seed": self.seed, "batch": BATCH, "scene": records}

    def save(self, path: Path) -> None:
        progress = {"calls": self.engine.calls, "samples": self.samples, "seconds": self.seconds}
        write_checkpoint(path, {"identity": self._identity(), "progress": progress}, self._sections())

    def load(self, path: Path) -> None:
        about = read_checkpoint(path, self._identity(), self._sections())
        progress = about["progress"]
        self.engine.calls, self.samples, self.seconds = (progress[name] for name in ("calls", "samples", "seconds"))

    def write(self, path: Path) -> None:
        image, variance = self.estimate()
        channels = dict(zip("RGB", np.moveaxis(image, 2, 0), strict=True)) | {"variance.Y": variance}
        film, window = self.job.scene.film, self.job.scene.film.window
        write_exr_blocks(
            path,
            (window.x, window.y, window.width, window.height),
            (film.width, film.height),
            dict.fromkeys(channels, "float"),
            [{name: pixels.astype(np.float32) for name, pixels in channels.items()}],
            {
                "renderer": " ".join(("mitsuba", *Mitsuba.versions(self.job.device).values())),
                "sceneHash": scene_hash(scene_records(self.job.scene)),
                "seed": str(self.seed),
                "samplesPerPixel": self.samples,
            },
        )

    def details(self) -> dict:
        return {"batches": self.engine.calls, "compile_seconds": self.engine.compile_seconds}


MAKERS: dict[str, type[Maker]] = {"wavefront": WavefrontMaker, "mitsuba": MitsubaMaker}


# --- the loop ----------------------------------------------------------------------------------------------------


def clock(seconds: float) -> str:
    """A duration as ``h:mm:ss``."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


class _Saver:
    """Checkpoints of a maker, for `CheckpointWriter`."""

    def __init__(self, maker: Maker):
        self.maker, self.scene_records = maker, None
        self.save_checkpoint = maker.save

    @property
    def sample_count(self) -> int:
        return self.maker.samples


def render(maker: Maker, goal: Goal, checkpoint: Path, every: float, console: Console | None) -> None:
    """Adds samples until the goal is reached; goes on from the checkpoint if there is one, and leaves one.

    Args:
        maker: Without samples.
        goal: When to stop.
        checkpoint: The file.
        every: Seconds between checkpoints.
        console: For progress; None: none.

    Raises:
        CheckpointError: The checkpoint is damaged or of another render.
        KeyboardInterrupt: After Ctrl-C or SIGTERM, when the checkpoint is written.
    """
    console = console or Console(quiet=True)
    if checkpoint.exists():
        maker.load(checkpoint)
        console.print(f"{checkpoint.name}: goes on from {maker.samples} spp")
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[left]} left"))
    writer = CheckpointWriter(
        _Saver(maker), checkpoint, every, lambda message: console.print(f"warning: {message}"), maker.samples
    )
    with contextlib.ExitStack() as stack:
        interrupt = stack.enter_context(Interrupt(console))
        progress = stack.enter_context(Progress(*columns, console=console))
        task = progress.add_task("reference", total=1.0, left="?")
        error = math.nan

        def after() -> bool:
            share = goal.share(maker.samples, maker.seconds, error)
            left = clock(maker.seconds * (1.0 / share - 1.0)) if share > 0.0 else "?"
            words = f"{maker.samples} spp, error {error:.2g}"
            progress.update(task, description=words, completed=share, left=left)
            writer.after_pass()
            return bool(interrupt.requested)

        while not goal.over(maker.samples, maker.seconds):
            if is_stop(maker.samples):
                error = relative_error(*maker.estimate())
                if goal.error is not None and error <= goal.error:
                    break
            spp = next_stop(maker.samples) - maker.samples
            if goal.spp is not None:
                spp = min(spp, goal.spp - maker.samples)
            left = None if goal.seconds is None else max(goal.seconds - maker.seconds, 1e-3)
            maker.add(spp, left, after)
            if interrupt.requested:
                break
        writer.write()
    if interrupt.requested:
        raise KeyboardInterrupt
