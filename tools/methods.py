"""Renderers that an experiment can run: each renders one scene with one seed, a little at a time.

A *method* is a renderer with overrides of the scene's settings; `RENDERERS` is the list that experiments and
references choose from. Another renderer joins by one class with the members of `Engine` and one entry there.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import warp as wp

import wavefront
from guiding import guide_of, plain_settings
from tools.peers import cycles
from tools.peers import mitsuba as peer
from tools.peers.cycles_scene import check_scene
from tools.peers.mitsuba_records import integrator_of
from wavefront.errors import WavefrontError
from wavefront.guided import TRAINING
from wavefront.identity import scene_hash
from wavefront.renderer import Renderer
from wavefront.scene import description, load_scene

SEEDS = 1 << 7  # of references, and as many of the runs of an experiment
CALLS = 1 << 12  # of Mitsuba with one such seed; each has a seed of its own
PEER_CALL_SECONDS = 1.0  # of one call of Mitsuba, at most about
CYCLES_PROBES = 2  # first calls of Cycles, whose samples are few where there is a budget of time
CYCLES_PROBE = 2  # samples of the first, and of the next one over those that are there


@dataclasses.dataclass(frozen=True)
class Job:
    """What is rendered.

    Attributes:
        path: The scene file.
        overrides: All changes to it, such as ``integrator.nee=false``.
        parameters: Values for ``$name`` in a Mitsuba file.
        scene: The records that follow from these.
        threads: On the CPU.
        device: ``cpu``, or that of a GPU.
    """

    path: Path
    overrides: tuple[str, ...]
    parameters: tuple[tuple[str, str], ...]
    scene: description.Scene
    threads: int
    device: str = "cpu"


class Engine(Protocol):
    """One render in progress. Making one loads and compiles all that rendering needs.

    Attributes:
        whole: It learns anew in each call of `add`, and so has to be asked for all samples at once.
        compile_seconds: Of the making, what compiling took.
        training_seconds: Of all calls of `add`, what training took; rendering waits for it.
        samples: Per pixel, so far.
    """

    whole: bool
    compile_seconds: float
    training_seconds: float
    samples: int

    def __init__(self, job: Job, seed: int): ...

    @staticmethod
    def versions(device: str) -> dict[str, str]:
        """What the image depends on besides the job.

        Raises:
            WavefrontError: The renderer cannot run here.
        """

    @staticmethod
    def check(job: Job) -> None:
        """Refuses, before anything is rendered, settings that the renderer does not have.

        Raises:
            WavefrontError: Names the setting.
        """

    @staticmethod
    def run_seed(names: Sequence[str], seed: int) -> int:
        """A seed for a run of an experiment, from names and a number below `SEEDS`; no reference has it."""

    def add(self, spp: int, seconds: float | None = None) -> None:
        """Adds samples per pixel: `spp` of them, or fewer, but one or more, if `seconds` are over before.

        `spp` and what is there already make a power of two, or the end of the run. An engine that is asked for the
        `whole` gets all samples of the run, or more than it has time for.
        """

    def image(self) -> np.ndarray:
        """Mean radiance, [height, width, 3], linear Rec. 709."""

    def account(self) -> dict:
        """Further figures of the render, as plain values."""


def load_job(
    path: Path,
    overrides: Sequence[str],
    parameters: dict[str, str] | None,
    threads: int,
    device: str = "cpu",
    warn: Callable[[str], object] | None = None,
) -> Job:
    """Reads a scene; its AOVs are left out, because nobody looks at them and they take time.

    Raises:
        SceneError: The file or an override is not valid.
    """
    scene = load_scene(path, overrides, parameters or None, warn)
    scene.film.aovs, scene.film.precision = [], "float"
    return Job(path, tuple(overrides), tuple((parameters or {}).items()), scene, threads, device)


def scene_name(path: str | Path) -> str:
    """What a scene is called: its folder where the file is called ``scene``, else its file."""
    path = Path(path)
    return path.resolve().parent.name if path.stem == "scene" else path.stem


# --- ours --------------------------------------------------------------------------------------------------------


class Wavefront:
    """This renderer, with the guide that the scene names. A guide learns in a share of all samples: in one call."""

    def __init__(self, job: Job, seed: int):
        guide = guide_of(job.scene, seed)
        self.renderer = Renderer(job.scene, device=job.device, threads=job.threads, seed=seed, guide=guide)
        self.whole = guide is not None
        self.compile_seconds = self.renderer.statistics.compile_seconds

    @property
    def training_seconds(self) -> float:
        seconds = self.renderer.statistics.stage_seconds
        return sum(seconds.get(stage, 0.0) for stage in TRAINING)

    @staticmethod
    def versions(device: str) -> dict[str, str]:
        return {"wavefront": wavefront.__version__, "warp": wp.config.version}

    @staticmethod
    def check(job: Job) -> None:
        plain_settings(job.scene)  # the scene loads; its guide is known

    @staticmethod
    def run_seed(names: Sequence[str], seed: int) -> int:
        # Beyond the seeds that a person gives, and still a number that every JSON reader takes whole.
        return _digest(names, seed) | 1 << 52

    @property
    def samples(self) -> int:
        return self.renderer.sample_count

    def add(self, spp: int, seconds: float | None = None) -> None:
        self.renderer.add_samples(spp, seconds)

    def image(self) -> np.ndarray:
        return self.renderer.film.image()

    def account(self) -> dict:
        s = self.renderer.statistics
        return {
            "features": scene_hash(dataclasses.asdict(self.renderer.features)),  # same kernels, same buffers
            "paths": s.paths,
            "rays": s.rays,
            "shadow_rays": s.shadow_rays,
            "nonfinite": {stage: count for stage, count in s.nonfinite.items() if count},
            "stage_seconds": s.stage_seconds,
        } | ({"guide": self.renderer.guide.statistics()} if self.renderer.guide else {})


# --- Mitsuba 3 ---------------------------------------------------------------------------------------------------


class Mitsuba:
    """Mitsuba 3's `path`, or `volpath` where the scene has media.

    A scene of Mitsuba's own format is read by Mitsuba itself if the overrides leave all but film and integrator alone;
    else it gets our records.
    """

    whole = False
    training_seconds = 0.0

    def __init__(self, job: Job, seed: int):
        if not 0 <= seed < 2 * SEEDS:
            raise WavefrontError(f"seed {seed} of mitsuba; allowed: 0 to {2 * SEEDS - 1}")
        peer.use_variant(self.variant(job.device), job.threads)
        film, integrator = job.scene.film, job.scene.integrator
        self.seed, self.calls, self.samples, self.total = seed, 0, 0, 0.0
        self.settings = (integrator.max_depth, integrator.rr_depth, None, 0, integrator_of(job.scene))
        if _reads_itself(job):
            self.scene = peer.load_xml(job.path, film.width, film.height, dict(job.parameters))
        else:
            self.scene = peer.load_records(job.scene)
        begin = time.perf_counter()
        self._render(1, CALLS - 1)  # compiles; its samples are of no use otherwise
        self.compile_seconds = time.perf_counter() - begin
        self.rate = 1.0 / self.compile_seconds  # samples per pixel and second, at least

    @staticmethod
    def variant(device: str) -> str:
        """The fastest variant of Mitsuba on a device."""
        if device != "cpu":
            return "cuda_ad_rgb"
        return "llvm_ad_rgb" if peer.missing("llvm_ad_rgb") is None else "scalar_rgb"

    @staticmethod
    def versions(device: str) -> dict[str, str]:
        return {"mitsuba": peer.require().__version__, "variant": Mitsuba.variant(device)}

    @staticmethod
    def check(job: Job) -> None:
        scene = job.scene
        integrator, default = scene.integrator, description.PathIntegrator()
        if type(integrator) is not type(default):
            raise WavefrontError("integrator.type: mitsuba has only path")
        for name in integrator.__struct_fields__:
            value, only = getattr(integrator, name), getattr(default, name)
            if name not in ("max_depth", "rr_depth", "spp", "guide") and value != only:
                raise WavefrontError(f"integrator.{name} is {json.dumps(value)}; mitsuba has only {json.dumps(only)}")
        if any(isinstance(emitter, description.SunSky) for emitter in scene.emitters):
            raise WavefrontError(
                "sunsky: mitsuba has another model of the sky; tools.convert --bake-emitters gives both the same"
            )
        film = scene.film
        if not isinstance(film.filter, description.BoxFilter):
            # It splats samples to all pixels that another filter reaches: pixels with less noise, but not independent.
            kind = film.filter.__struct_config__.tag
            raise WavefrontError(f"film.filter.type is {kind}; with mitsuba: box")
        if _reads_itself(job) and (film.crop is not None or film.pixel_aspect != 1.0):
            raise WavefrontError("film: mitsuba reads its XML without crop window and with square pixels alone")

    @staticmethod
    def run_seed(names: Sequence[str], seed: int) -> int:
        return SEEDS + seed

    def _render(self, spp: int, call: int) -> np.ndarray:
        max_depth, *rest = self.settings
        return peer.render(self.scene, spp, self.seed * CALLS + call, max_depth, *rest)

    def draw(self, spp: int) -> np.ndarray:
        """The mean of `spp` new samples per pixel, which no other call of any seed has; [height, width, 3] float64.

        Raises:
            WavefrontError: There were `CALLS` - 1 already.
        """
        if self.calls >= CALLS - 1:
            raise WavefrontError(f"more than {CALLS - 1} calls of mitsuba in one render")
        image = self._render(spp, self.calls)
        self.calls += 1
        return image

    def add(self, spp: int, seconds: float | None = None) -> None:
        # In powers of two: Mitsuba compiles anew for other numbers of samples.
        end = None if seconds is None else time.perf_counter() + seconds
        target = self.samples + spp
        while self.samples < target:
            begin = time.perf_counter()
            most = PEER_CALL_SECONDS * self.rate if end is None else min(PEER_CALL_SECONDS, end - begin) * self.rate
            count = _power_of_two(max(1, min(target - self.samples, int(most))))
            self.total = self.total + count * self.draw(count)
            self.samples += count
            now = time.perf_counter()
            self.rate = count / (now - begin)
            if end is not None and now >= end:
                break

    def image(self) -> np.ndarray:
        return self.total / self.samples

    def account(self) -> dict:
        return {"calls": self.calls}


def _reads_itself(job: Job) -> bool:
    """Whether Mitsuba reads the file of a job; all that the overrides say must reach it otherwise."""
    ours = ("film.", "integrator.")
    return job.path.suffix.lower() == ".xml" and all(o.strip().startswith(ours) for o in job.overrides)


def _power_of_two(n: int) -> int:
    """The largest that is not above `n`."""
    return 1 << (n.bit_length() - 1)


def _digest(names: Sequence[str], seed: int) -> int:
    """A number of 48 bits from names and a seed."""
    return int.from_bytes(hashlib.sha256(json.dumps([*names, seed]).encode()).digest()[:6], "little")


# --- Cycles ------------------------------------------------------------------------------------------------------


class Cycles:
    """Blender's path tracer Cycles, in a process of its own (see `tools.peers.cycles`).

    It compiles nothing. Starting Blender and building the scene belong to loading.
    """

    whole, guided = False, False
    compile_seconds = 0.0
    training_seconds = 0.0  # of guiding: in the time of rendering; Cycles does not say how much

    def __init__(self, job: Job, seed: int):
        self.session = cycles.Session(job.scene, self.guided, job.threads)
        self.session.warm_up()
        self.seed, self.calls, self.samples, self.total, self.rate = seed, 0, 0, 0.0, None

    @staticmethod
    def versions(device: str) -> dict[str, str]:
        cycles.require()
        return {"blender": cycles.VERSION}

    @staticmethod
    def check(job: Job) -> None:
        if job.device != "cpu":
            raise WavefrontError(f"--device {job.device}: cycles is run on the cpu alone")
        check_scene(job.scene)

    @staticmethod
    def run_seed(names: Sequence[str], seed: int) -> int:
        return _digest(names, seed) % (1 << 31)

    def add(self, spp: int, seconds: float | None = None) -> None:
        end = None if seconds is None else time.perf_counter() + seconds
        target = self.samples + spp
        while self.samples < target:
            begin = time.perf_counter()
            count = target - self.samples
            if end is not None:
                # What a sample takes is found with few of them.
                most = CYCLES_PROBE * (1 + self.samples) if self.calls < CYCLES_PROBES else (end - begin) * self.rate
                count = max(1, min(count, int(most)))
            image = self.session.render(count, self.seed, self.samples)
            self.total = self.total + count * image.astype(np.float64)
            self.samples, self.calls = self.samples + count, self.calls + 1
            now = time.perf_counter()
            self.rate = count / (now - begin)
            if end is not None and now >= end:
                break

    def image(self) -> np.ndarray:
        return self.total / self.samples

    def account(self) -> dict:
        return {"calls": self.calls}


class CyclesGuided(Cycles):
    """Cycles with path guiding: Open PGL's mixtures, learned while rendering."""

    whole, guided = True, True


RENDERERS: dict[str, type[Engine]] = {
    "wavefront": Wavefront,
    "mitsuba": Mitsuba,
    "cycles": Cycles,
    "cycles guided": CyclesGuided,
}
