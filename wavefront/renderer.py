"""The Python API: a renderer for one scene on one device."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import resource
import sys
import time
from collections.abc import Callable

import msgspec
import numpy as np
import warp as wp

import wavefront
from wavefront.accel.intersector import ACCELS
from wavefront.checkpoint import CheckpointError, film_sections, read_checkpoint, write_checkpoint
from wavefront.errors import WavefrontError
from wavefront.film import BLOCK_PIXELS, CHANNELS, Film
from wavefront.guide import Guide, check_guide
from wavefront.guided import Guiding
from wavefront.identity import scene_records
from wavefront.integrator import (
    Worker,
    make_features,
    make_kernels,
    plan_tiles,
    run_tiles,
    state_bytes_per_slot,
)
from wavefront.queues import TOTAL_PATHS, TOTAL_RAYS, TOTAL_SHADOW_RAYS
from wavefront.scene.description import Scene
from wavefront.scene.device import upload_scene
from wavefront.scene.json_format import checked
from wavefront.scene.lookup import bsdf_of_shape
from wavefront.scene.validate import validate
from wavefront.strict import find_nonfinite
from wavefront.trace import PathTrace, TraceWorker

CPU_CAPACITY = 1 << 14  # paths in flight per worker: their state stays in a core's second-level cache
CUDA_CAPACITY = 1 << 21
MIN_CAPACITY = 1 << 10
DEFAULT_MEMORY = 4 << 30
OUTPUT_LIBRARIES = 64 << 20  # code and buffers of what writes images
PASS_SECONDS = 2.0  # aimed at: passes are where progress, time limits and Ctrl-C are looked at


@dataclasses.dataclass
class Statistics:
    """What a render did so far. Times are wall time; stage times are summed over workers."""

    sample_count: int = 0
    paths: int = 0
    rays: int = 0
    shadow_rays: int = 0
    compile_seconds: float = 0.0
    render_seconds: float = 0.0
    stage_seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    nonfinite: dict[str, int] = dataclasses.field(default_factory=dict)


def resolve_device(device: str) -> str:
    """The alias of a Warp device.

    Raises:
        WavefrontError: There is no such device.
    """
    names = [d.alias for d in wp.get_devices()]
    wanted = "cuda:0" if device == "cuda" else device
    if wanted not in names:
        raise WavefrontError(f"unknown device {device!r}; available: {', '.join(names)}")
    return wanted


def peak_memory_bytes() -> int:
    """Largest resident size of this process so far, as the operating system counts it."""
    try:  # getrusage may give that of the process which started this one
        with open("/proc/self/status", encoding="ascii") as file:
            return next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmHWM:"))
    except (OSError, StopIteration):
        pass
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def resident_bytes() -> int:
    """Memory that this process holds now; where the system does not say, the most that it has held."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * resource.getpagesize()
    except OSError:
        return peak_memory_bytes()


def output_bytes(aovs: tuple[str, ...]) -> int:
    """Memory that writing a film takes, at most.

    Two blocks of rows, the next being made while the last is held: means in float64, then channels and the same
    interleaved in float32; the copies of the last one that the library makes; and what it takes by itself.
    """
    channels = 3 + sum(len(CHANNELS[aov]) for aov in aovs)
    return BLOCK_PIXELS * 2 * (24 + 3 * 4 * channels) + OUTPUT_LIBRARIES


class Renderer:
    """Renders one scene; samples add up over calls of `render`.

    Args:
        scene: The records, from `wavefront.load_scene` or built in Python.
        device: ``cpu``, ``cuda`` or ``cuda:N``.
        threads: Workers on the CPU device; default: one per available core.
        memory: Budget in bytes for the film and the path state.
        whole_process: On the CPU device, the budget is for all that the process holds: what it holds already and what
            writing the film takes come off it.
        seed: Of the random numbers. Same seed and device, same image.
        strict: A contribution that is not finite or negative is an error that names the path; else it is counted.
        guide: Of the directions of paths, see `wavefront.guide`; None: unguided, also where the scene names a guide.
            A scene that names one needs either, because methods are no part of the renderer: `guiding.guide_of(scene)`
            makes it.
        profile: On CUDA, time every stage, at the price of a synchronisation after each.
        accel: How rays find triangles: ``bvh``, our hierarchy, or ``mesh``, queries of `wp.Mesh`, as a reference.
        paths_in_flight: Most paths of all workers together, at least `MIN_CAPACITY` a worker; default: `CPU_CAPACITY` a
            worker, or `CUDA_CAPACITY`. The image does not depend on it.
        on_compile: Called with a message before kernels are compiled.

    Attributes:
        scene: The records, checked; a copy.
        guide: As given, or None.
        training: Whether the guide learned from the last pass.
        statistics: See `Statistics`.

    Raises:
        SceneError: The scene cannot be rendered.
        WavefrontError: Unknown device, a budget that is too small, or a guide with settings out of range, in a strict
            render, or named by the scene and not given.
    """

    def __init__(
        self,
        scene: Scene,
        device: str = "cpu",
        threads: int | None = None,
        memory: int = DEFAULT_MEMORY,
        whole_process: bool = False,
        seed: int = 0,
        strict: bool = False,
        profile: bool = False,
        on_compile: Callable[[str], None] | None = None,
        guide: Guide | msgspec.UnsetType | None = msgspec.UNSET,
        accel: str = "bvh",
        paths_in_flight: int | None = None,
    ):
        if not 0 <= seed < 2**64:
            raise WavefrontError(f"seed {seed} is out of range; allowed: 0 to 2^64 - 1")
        if threads is not None and threads < 1:
            raise WavefrontError(f"{threads} threads; allowed: 1 or more")
        if accel not in ACCELS:
            raise WavefrontError(f"accel {accel!r}; allowed: {', '.join(ACCELS)}")
        scene = checked(scene)  # a scene built in Python gets the checks that a file gets, and a copy is kept
        if guide is msgspec.UNSET:
            if scene.integrator.guide is not None:
                raise WavefrontError(
                    f"integrator.guide names {scene.integrator.guide.preset!r}, and Renderer makes no guides; allowed: "
                    "guide=guiding.guide_of(scene), or guide=None to render without"
                )
            guide = None
        if guide is None:
            scene.integrator.guide = None
        else:
            check_guide(guide)
            if strict:
                raise WavefrontError(
                    f"a strict render traces paths again, which a guide that has learned since would not repeat; "
                    f"allowed: a guide ({guide.name}) or a strict render"
                )
        self.warnings = validate(scene)
        self.scene, self.device, self.seed, self.strict = scene, resolve_device(device), seed, strict
        self.device_scene = upload_scene(scene, self.device, accel)
        self.warnings += self.device_scene.notes
        self.features = make_features(scene, self.device_scene, guide)
        self.kernels = make_kernels(self.features)
        self.guide, self._guiding, self.training = guide, None, False
        if guide is not None:
            guide.threads = threads
            self._guiding = Guiding(guide, scene, self.device_scene, self.features, self.device)
        self.statistics = Statistics()
        self._trace_worker: TraceWorker | None = None
        self._resumed = Statistics()  # what the statistics were in the checkpoint that was loaded
        self._compile(on_compile)

        film = scene.film
        available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        self.threads = (threads or available or 1) if self.device == "cpu" else 1
        window, aovs = film.window, tuple(film.aovs)
        weighted = self.features.weighted
        self.bytes_per_pixel = Film.bytes_per_pixel(aovs, weighted)
        self.bytes_per_path = state_bytes_per_slot(self.features) + (guide.bytes_per_slot() if guide else 0)
        if paths_in_flight is not None and paths_in_flight < MIN_CAPACITY * self.threads:
            raise WavefrontError(
                f"{paths_in_flight} paths in flight on {self.threads} threads; allowed: "
                f"{MIN_CAPACITY * self.threads} or more"
            )
        self._most_paths = paths_in_flight // self.threads if paths_in_flight else None
        pixels, held = window.width * window.height, 0
        if whole_process and self.device == "cpu":
            held = max(resident_bytes() + output_bytes(aovs), peak_memory_bytes() - pixels * self.bytes_per_pixel)
        self.capacity = self._plan_capacity(memory, held, pixels)
        self.film = Film(window.width, window.height, aovs, self.device, bsdf_of_shape(scene), weighted)
        make_worker = self._guiding.make_worker if self._guiding else Worker
        self.workers = [
            make_worker(
                scene=scene,
                device_scene=self.device_scene,
                features=self.features,
                kernels=self.kernels,
                film=self.film,
                seed=seed,
                capacity=self.capacity,
                device=self.device,
                profile=profile,
            )
            for _ in range(self.threads)
        ]

    def _compile(self, on_compile) -> None:
        start = time.perf_counter()
        modules = self.kernels.modules()
        if self._guiding:
            modules = list(dict.fromkeys(modules + self._guiding.modules()))
        if on_compile:
            on_compile(f"compiling {len(modules)} kernels for {self.device} (cached for the next time)")
        # Modules share functions, and what a module is hashed to depends on whether another that shares a function has
        # been built already. Hashed one after another before any is built, they find their cached kernels again.
        for module in modules:
            module.get_module_hash(1 if self.device == "cpu" else None)
        # All before the first launch and before any worker starts: a module that loads while another thread launches
        # from it is not safe.
        wp.force_load(self.device, modules=modules, max_workers=os.cpu_count() or 1)
        self.statistics.compile_seconds = time.perf_counter() - start

    def _plan_capacity(self, memory: int, held: int, pixels: int) -> int:
        """Paths in flight per worker, from the memory budget, of which some is held already."""
        if pixels > 2**31 - 1:
            raise WavefrontError(f"a film of {pixels} pixels; allowed: up to 2^31 - 1")
        film = pixels * self.bytes_per_pixel + (self._guiding.nbytes() if self._guiding else 0)
        left = memory - held - film
        most = self._most_paths or (CPU_CAPACITY if self.device == "cpu" else CUDA_CAPACITY)
        capacity = min(most, left // (self.bytes_per_path * self.threads))
        if capacity < MIN_CAPACITY:
            needed = held + film + MIN_CAPACITY * self.bytes_per_path * self.threads
            owner = "the film and the guide" if self.guide else "the film"
            rest = f", {film / 2**20:.0f} MiB of it for {owner} and {held / 2**20:.0f} MiB for all else" if held else ""
            raise WavefrontError(
                f"a memory budget of {memory / 2**20:.0f} MiB is too small for {pixels} pixels on {self.threads} "
                f"threads; at least {math.ceil(needed / 2**20)} MiB is needed{rest}"
            )
        return int(capacity)

    @functools.cached_property
    def scene_records(self) -> dict:
        """What this is a render of, see `identity.scene_records`. Read from the scene's files at first use."""
        return scene_records(self.scene)

    @property
    def sample_count(self) -> int:
        """Samples per pixel in the film."""
        return self.film.sample_count

    def add_samples(
        self,
        spp: int | None = None,
        seconds: float | None = None,
        callback: Callable[[Renderer], bool | None] | None = None,
    ) -> None:
        """Adds samples to the film.

        Args:
            spp: Samples per pixel to add; default: the scene's, or without limit if `seconds` is given.
            seconds: Wall time after which no further pass starts.
            callback: Called after every pass; returning True ends the render there.

        Raises:
            WavefrontError: `spp` or `seconds` is not positive, or the guide gives a sample weight out of range.
            NonFiniteError: In a strict render, at the end of the pass.
        """
        if spp is not None and spp < 1:
            raise WavefrontError(f"spp {spp}; allowed: 1 or more")
        if seconds is not None and not seconds > 0.0:
            raise WavefrontError(f"a time of {seconds} s; allowed: more than 0")
        if spp is None:
            spp = self.scene.integrator.spp if seconds is None else 2**31 - 1 - self.sample_count
        if self.sample_count + spp > 2**31 - 1:
            raise WavefrontError("more than 2^31 - 1 samples per pixel")
        training, weight = False, 1.0
        begin = time.perf_counter()
        elapsed_before = self.statistics.render_seconds
        target = self.sample_count + spp
        samples = 1
        while self.sample_count < target:
            samples = min(samples, target - self.sample_count)
            pass_start = time.perf_counter()
            if self._guiding:
                spent = elapsed_before + pass_start - begin
                progress = self.sample_count / target if seconds is None else spent / (elapsed_before + seconds)
                training = self._guiding.trains(progress)
                weight = self._guiding.sample_weight(progress)
                samples = 1 if training or weight != 1.0 else samples
            self._pass(samples, training, weight)
            self.training = training
            now = time.perf_counter()
            self.statistics.render_seconds = elapsed_before + now - begin
            if callback is not None and callback(self):
                break
            if seconds is not None and now - begin >= seconds:
                break
            # The next pass: at most twice this one, at most PASS_SECONDS or what is left of the time.
            duration = max(now - pass_start, 1e-6)
            left = PASS_SECONDS if seconds is None else min(PASS_SECONDS, seconds - (now - begin))
            samples = max(1, min(2 * samples, int(samples * left / duration)))

    def render(
        self,
        spp: int | None = None,
        seconds: float | None = None,
        callback: Callable[[Renderer], bool | None] | None = None,
    ) -> np.ndarray:
        """Adds samples to the film, as `add_samples` does, and returns the image so far.

        Returns:
            Mean radiance, shape [height, width, 3], float32, linear Rec. 709.
        """
        self.add_samples(spp, seconds, callback)
        return self.film.image()

    def _identity(self) -> dict:
        """What must be equal for a checkpoint to be continued; its samples would be others otherwise."""
        return {
            "wavefront": wavefront.__version__,
            "warp": wp.config.version,
            "device": self.device.split(":")[0],
            "accel": self.features.accel,
            "seed": self.seed,
            "scene": self.scene_records,
        } | ({"guide": {"name": self.guide.name, "settings": self.guide.identity()}} if self.guide else {})

    def _sections(self) -> dict:
        """All arrays of a checkpoint."""
        return film_sections(self.film) | ({"guide": self.guide.arrays()} if self.guide else {})

    def save_checkpoint(self, path: str | os.PathLike) -> None:
        """Writes all that `load_checkpoint` needs, see `wavefront.checkpoint`; `path` is replaced whole or not at all.

        Raises:
            CheckpointError: The file cannot be written; what was there is still there.
        """
        about = {
            "identity": self._identity(),
            "statistics": dataclasses.asdict(self.statistics),
        }
        write_checkpoint(path, about, self._sections())

    def load_checkpoint(self, path: str | os.PathLike) -> None:
        """Goes on from a checkpoint of the same scene, settings, seed, version and kind of device.

        What follows is the same to the last bit as without the interruption. The number of threads, the memory budget
        and the samples asked for may be others.

        Raises:
            CheckpointError: Missing, damaged, or of another render, with what differs; nothing has changed then.
        """
        if self.sample_count:
            raise WavefrontError(f"{path}: a checkpoint must be loaded before the first sample")

        def check(about: dict) -> None:
            left_out = sum(about["statistics"]["nonfinite"].values())
            if self.strict and left_out:
                raise CheckpointError(
                    f"{path}: {left_out} contributions of its samples were not finite or negative and were left out; "
                    "allowed: none in a strict render"
                )

        about = read_checkpoint(path, self._identity(), self._sections(), check)
        self._resumed = Statistics(**about["statistics"])
        self.film.sample_count = self._resumed.sample_count
        self.statistics.render_seconds = self._resumed.render_seconds
        if self.guide:
            self.guide.restored()
        self._collect()

    def _pass(self, samples: int, training: bool = False, weight: float = 1.0) -> None:
        film = self.film
        if film.weighted:
            film.begin_pass(weight)
        if training:
            self._guiding.begin(self.workers, film.sample_count)
        run_tiles(self.workers, plan_tiles(film.width, film.height, self.capacity, film.sample_count, samples))
        if self.device != "cpu":
            wp.synchronize_device(self.device)
        for worker in self.workers:
            worker.check_status()
        if training:
            self._guiding.train(self.workers)
        first, left_out = film.sample_count, sum(self.statistics.nonfinite.values())
        film.end_pass(samples)
        self._collect()
        if self.strict and sum(self.statistics.nonfinite.values()) > left_out:
            raise find_nonfinite(self, first, samples)

    def trace(self, x: int, y: int, sample: int = 0) -> PathTrace:
        """Traces one path of a pixel again, whether or not it is in the film, and says what happens at each vertex.

        Args:
            x, y: Pixel, from the upper left corner.
            sample: From 0.

        Raises:
            WavefrontError: No such pixel or sample, or the render is guided.
        """
        if self.guide:
            raise WavefrontError(f"a path of a render that a guide ({self.guide.name}) leads cannot be traced again")
        if self._trace_worker is None:
            self._trace_worker = TraceWorker(self)
        return self._trace_worker.trace(x, y, sample)

    def _collect(self) -> None:
        s = self.statistics
        totals = sum(worker.queues.totals.numpy() for worker in self.workers)
        before = self._resumed
        s.sample_count = self.film.sample_count
        s.paths = before.paths + int(totals[TOTAL_PATHS])
        s.rays = before.rays + int(totals[TOTAL_RAYS])
        s.shadow_rays = before.shadow_rays + int(totals[TOTAL_SHADOW_RAYS])
        s.stage_seconds, s.nonfinite = dict(before.stage_seconds), dict(before.nonfinite)
        between = [self._guiding.seconds] if self._guiding else []
        for seconds in [worker.stage_seconds for worker in self.workers] + between:
            for stage, value in seconds.items():
                s.stage_seconds[stage] = s.stage_seconds.get(stage, 0.0) + value
        for worker in self.workers:
            for stage, value in worker.nonfinite().items():
                s.nonfinite[stage] = s.nonfinite.get(stage, 0) + value
