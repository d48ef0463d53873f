"""The bounce loop and the passes that cover the film.

A pass adds some samples to every pixel. It is cut into tiles, each of which fills the slots of one worker. On the CPU
device several workers take tiles from a shared list, each on its own thread with its own path state; on CUDA there is
one worker, and its whole pass is one captured graph. An image does not depend on any of this: random numbers belong
to (seed, pixel, sample, bounce, purpose) and the film adds the samples of a pixel in their order.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections import deque

import numpy as np
import warp as wp

from wavefront import queues
from wavefront.accel.geometry import RayHits
from wavefront.camera import camera_kind, make_camera
from wavefront.errors import WavefrontError
from wavefront.features import Features
from wavefront.film import FIRST_HIT, Film, film_arrays, make_window
from wavefront.guide import Guide
from wavefront.proposals import INPUTS, LightProposals, Proposals
from wavefront.queues import Paths, QueueSet, ShadowRays, Surfaces, allocate_struct, bytes_per_slot
from wavefront.recording import RecordScratch, scratch_arrays
from wavefront.scene import description
from wavefront.scene.device import DeviceScene
from wavefront.stages.accumulate import make_accumulate
from wavefront.stages.advance import advance_bounce, advance_guided_bounce, drain_rays
from wavefront.stages.aov import make_aov
from wavefront.stages.direct import make_direct
from wavefront.stages.emission import make_emission
from wavefront.stages.escaped import make_escaped
from wavefront.stages.generate import make_generate
from wavefront.stages.intersect import make_intersect
from wavefront.stages.perturb import make_perturb
from wavefront.stages.scatter import make_scatter
from wavefront.stages.shadow import make_shadow
from wavefront.stages.stream import make_stream, make_stream_shadow

FILTER_SCALES = {"box": lambda f: 0.5, "tent": lambda f: f.radius, "gaussian": lambda f: f.stddev}


def filter_kind(film: description.Film) -> str:
    return type(film.filter).__struct_config__.tag


def make_features(scene: description.Scene, device_scene: DeviceScene, guide: Guide | None = None) -> Features:
    """What the kernels for a scene, its settings and a guide must do, and no more."""
    integrator, own = scene.integrator, device_scene.geometry.own
    return Features(
        triangles=own.root >= 0,
        spheres=own.sphere_root >= 0,
        instances=device_scene.instances,
        accel=device_scene.accel,
        streams=device_scene.streams,
        ahead=device_scene.ahead,
        smooth=device_scene.smooth,
        uvs=bool(device_scene.texture_kinds) or "uv" in scene.film.aovs,
        tangents=device_scene.tangents,
        bsdfs=device_scene.bsdfs,
        maps=device_scene.maps,
        mask=device_scene.mask,
        media=device_scene.media,
        textures=device_scene.texture_kinds,
        lights=device_scene.light_kinds,
        light_textures=device_scene.light_texture_kinds,
        nee=integrator.nee,
        roulette=integrator.rr_depth is not None and integrator.rr_depth < integrator.max_depth,
        sampler=integrator.sampler,
        camera=camera_kind(scene.camera),
        filter=filter_kind(scene.film),
        aovs=tuple(name for name in film_arrays(tuple(scene.film.aovs)) if name in FIRST_HIT),
        variance="variance" in scene.film.aovs,
        guide=(guide.name, *guide.key) if guide is not None else (),
        guide_pdf=guide is None or guide.has_pdf,
        guide_inputs=guide.inputs if guide is not None else (),
        records=guide.records.fields if guide is not None and guide.records is not None else (),
        weighted=guide is not None and guide.weighted,
    )


@dataclasses.dataclass(frozen=True)
class Kernels:
    """The kernels of all stages; None where there is no such stage. `wavefront.guided` has more."""

    generate: wp.Kernel
    stream: wp.Kernel | None
    intersect: wp.Kernel
    perturb: wp.Kernel | None
    escaped: wp.Kernel | None
    emission: wp.Kernel | None
    aov: wp.Kernel | None
    direct: wp.Kernel | None
    stream_shadow: wp.Kernel | None
    shadow: wp.Kernel | None
    drain: wp.Kernel
    scatter: wp.Kernel | None
    advance: wp.Kernel
    accumulate: wp.Kernel

    def modules(self) -> list:
        kernels = (getattr(self, field.name) for field in dataclasses.fields(self))
        return list({kernel.module: None for kernel in kernels if kernel is not None})


def make_kernels(f: Features) -> Kernels:
    """Kernels for a set of features; scenes that agree in what a stage reads share its kernel."""
    return Kernels(
        generate=make_generate(f.camera, f.filter, f.transmission, f.sampler),
        stream=make_stream(f.triangles, f.spheres, f.instances) if f.streams else None,
        intersect=make_intersect(
            f.triangles,
            f.spheres,
            f.smooth,
            f.uvs,
            f.tangents,
            "bump" in f.maps,
            f.area_lights,
            bool(f.escape_lights),
            "shape_index" in f.aovs,
            f.media,
            f.instances,
            f.accel,
            f.streams,
            f.ahead,
        ),
        perturb=make_perturb(f.textures, f.uvs, "bump" in f.maps) if f.maps else None,
        escaped=make_escaped(f.escape_lights, f.light_sampling) if f.escape_lights else None,
        emission=make_emission(f.lights, f.light_textures, f.light_sampling) if f.area_lights else None,
        aov=make_aov(f.aovs, f.bsdfs, f.mask, f.textures, f.uvs) if f.aovs else None,
        direct=make_direct(
            f.bsdfs,
            f.mask,
            f.textures,
            f.lights,
            f.light_textures,
            f.uvs,
            f.tangents,
            f.maps,
            f.media,
            f.sampler,
            f.ahead,
        )
        if f.light_sampling and not f.guided
        else None,
        stream_shadow=make_stream_shadow(f.triangles, f.spheres, f.instances)
        if f.streams and f.light_sampling
        else None,
        shadow=make_shadow(f.triangles, f.spheres, f.instances, f.accel, f.streams) if f.light_sampling else None,
        drain=drain_rays,
        scatter=make_scatter(
            f.bsdfs,
            f.mask,
            f.textures,
            f.uvs,
            f.tangents,
            f.maps,
            f.transmission,
            f.roulette,
            f.media,
            f.sampler,
            f.ahead,
        )
        if not f.guided
        else None,
        advance=advance_guided_bounce if f.guided else advance_bounce,
        accumulate=make_accumulate(f.variance, f.weighted),
    )


def skipped_arrays(f: Features) -> dict[type, tuple[str, ...]]:
    """Arrays of the path state that the features do without."""
    surface_arrays = {
        "uv": f.uvs,
        "tangent": f.tangents,
        "uv_jacobian": "bump" in f.maps,
        "base_normal": bool(f.maps),
        "terminator": bool(f.maps),
        "media": f.media,
        "light": f.area_lights,
        "shape": "shape_index" in f.aovs,
    }
    return {
        Paths: (() if f.transmission else ("eta",)) + (() if f.media else ("medium",)),
        Surfaces: tuple(name for name, used in surface_arrays.items() if not used),
        RayHits: (() if f.instances else ("instance",)) if f.streams else tuple(RayHits.vars),
        ShadowRays: (() if f.streams else ("blocked",)) if f.light_sampling else tuple(ShadowRays.vars),
    }


def skipped_guided_arrays(f: Features) -> dict[type, tuple[str, ...]]:
    """Arrays of the state of a guided bounce that the features do without."""
    scratch = scratch_arrays(f.records, f.light_sampling)
    lights = () if f.guide_pdf else ("guide_pdf",)
    return {
        Proposals: (() if f.transmission else ("eta",))
        + (() if f.mixed_deltas else ("delta",))
        + tuple(name for name in INPUTS if name not in f.guide_inputs),
        LightProposals: lights if f.light_sampling else tuple(LightProposals.vars),
        RecordScratch: tuple(name for name in RecordScratch.vars if name not in scratch),
    }


def queue_names(f: Features) -> tuple[str, ...]:
    """Queues that the features need."""
    needed = {
        "escaped": bool(f.escape_lights),
        "emissive": f.area_lights,
        "shadow": f.light_sampling,
        "guided": f.guided,
        "lit": f.guided and f.light_sampling,
        "proposed": f.guided,
        "smooth": f.guided,
    }
    return ("rays", "hits", *(name for name, used in needed.items() if used))


def state_bytes_per_slot(f: Features) -> int:
    """Memory of one path in flight."""
    skipped = skipped_arrays(f) | (skipped_guided_arrays(f) if f.guided else {})
    structs = sum(bytes_per_slot(struct, skip) for struct, skip in skipped.items())
    return structs + 4 * len(queue_names(f))


@dataclasses.dataclass(frozen=True)
class Tile:
    """Pixels and samples that fill one worker once."""

    x: int
    y: int
    width: int
    height: int
    first_sample: int
    sample_count: int


class Worker:
    """Path state, queues and launches of one thread (CPU) or of the whole device (CUDA)."""

    def __init__(
        self,
        scene: description.Scene,
        device_scene: DeviceScene,
        features: Features,
        kernels: Kernels,
        film: Film,
        seed: int,
        capacity: int,
        device: str,
        profile: bool = False,
        film_stride: int | None = None,  # pixels from row to row of the film's arrays; default: its width
    ):
        self.film = film
        self.device, self.capacity = device, capacity
        self.captured = None  # the graph of a pass, on CUDA
        self.capturing = False
        self.profile = profile
        self.stage_seconds: dict[str, float] = {}
        self.queues = QueueSet(capacity, device, queue_names(features))
        self.tile = wp.zeros(queues.TILE_FIELDS, dtype=wp.int32, device=device)
        skip = skipped_arrays(features)
        paths, ray_hits, surfaces, shadow_rays = (
            allocate_struct(struct, capacity, device, skip[struct]) for struct in (Paths, RayHits, Surfaces, ShadowRays)
        )
        self.paths, self.surfaces, self.shadow_rays = paths, surfaces, shadow_rays
        self.ray_hits = ray_hits
        geometry, materials = device_scene.geometry, device_scene.materials
        textures, lights = device_scene.textures, device_scene.lights
        rays, hits, escaped, emissive, shadow = (
            self.queues[name] for name in ("rays", "hits", "escaped", "emissive", "shadow")
        )
        counters, totals, tile = self.queues.counter_struct, self.queues.totals, self.tile
        camera, window = make_camera(scene.camera, scene.film), make_window(scene.film)
        scale = FILTER_SCALES[features.filter](scene.film.filter)
        max_depth, rr_depth = scene.integrator.max_depth, scene.integrator.rr_depth or 0
        width, sums, seed = film.width, film.arrays, wp.uint64(seed)
        stride = width if film_stride is None else film_stride
        tables = geometry, materials, textures, lights
        # In the order of the kernels' parameters.
        arguments = {
            "generate": [camera, tile, window, scale, seed, paths, rays, counters, totals],
            "stream": [geometry, paths, rays, ray_hits],
            "intersect": [geometry, paths, rays, ray_hits, max_depth, surfaces, hits, escaped, emissive, counters],
            "perturb": [materials, textures, paths, rays, surfaces],
            "escaped": [lights, paths, escaped, counters],
            "emission": [geometry, lights, textures, paths, surfaces, emissive, counters],
            "aov": [materials, textures, paths, surfaces, tile, stride, sums],
            "direct": [*tables, paths, surfaces, hits, seed, shadow_rays, shadow, counters],
            "stream_shadow": [geometry, shadow, shadow_rays],
            "shadow": [geometry, shadow_rays, shadow, paths],
            "drain": [counters, totals],
            "scatter": [materials, textures, surfaces, hits, rr_depth, seed, paths, rays, counters],
            "advance": [counters],
            "accumulate": [paths, tile, stride, sums, counters],
        }
        self.commands: dict[str, wp.Launch] = {}
        self._arguments: dict[str, list] = {}  # recorded commands do not keep their arrays alive
        for stage, inputs in arguments.items():
            self._command(stage, getattr(kernels, stage), inputs)

    def _command(self, label: str, kernel: wp.Kernel | None, inputs: list) -> None:
        """Makes a kernel with its arguments launchable by its label, if there is one."""
        if kernel is not None:
            self._arguments[label] = inputs
            self.commands[label] = wp.launch(
                kernel, dim=self.capacity, inputs=inputs, device=self.device, record_cmd=True
            )

    # --- the loop ------------------------------------------------------------------------------------------------

    def trace_tile(self, tile: Tile) -> None:
        """Traces all paths of a tile and adds them to the film."""
        self._set_tile(tile)
        if self.device == "cpu" or self.profile:
            self._trace(tile)
            return
        if self.captured is None:
            self.captured = self.capture()
        wp.capture_launch(self.captured)

    def _set_tile(self, tile: Tile) -> None:
        fields = np.array(dataclasses.astuple(tile), np.int32)
        if self.device == "cpu":
            self.tile.numpy()[:] = fields
        else:
            self.tile.assign(fields)

    def capture(self):
        """Records a pass, whatever its tile, as one graph that runs without the host."""
        self.capturing = True
        try:
            with wp.ScopedCapture(device=self.device) as capture:
                self._trace(None)
        finally:
            self.capturing = False
        return capture.graph

    def _trace(self, tile: Tile | None) -> None:
        pixels = tile.width * tile.height if tile else self.capacity
        self._launch("generate", pixels * tile.sample_count if tile else self.capacity)
        self._bounce(pixels)
        wp.capture_while(self.queues.counters[queues.CONTINUE : queues.CONTINUE + 1], self._bounce)
        self._launch("accumulate", pixels)

    def _bounce(self, aov_pixels: int = 0) -> None:
        self._launch("stream", "rays")
        self._launch("intersect", "rays")
        self._launch("perturb", "rays")
        self._launch("escaped", "escaped")
        self._launch("emission", "emissive")
        self._launch("aov", aov_pixels)
        self._launch("direct", "hits")
        self._launch("stream_shadow", "shadow")
        self._launch("shadow", "shadow")
        self._launch("drain", 1)
        self._launch("scatter", "hits")
        self._launch("advance", 1)

    def _launch(self, stage: str, size: str | int) -> None:
        """Launches a stage over a queue, or over a number of threads.

        On the CPU device one thread takes a whole queue, see `queues.queue_end`, and none an empty one.
        """
        command = self.commands.get(stage)
        if command is None:
            return
        if isinstance(size, str):
            size = min(self._threads(size), 1) if self.device == "cpu" else self._threads(size)
        if size == 0:
            return
        command.set_dim(min(size, self.capacity))
        start = time.perf_counter()
        command.launch()
        self._clock(stage, start)

    def _threads(self, queue: str) -> int:
        """Threads for the entries of a queue, which a stage counts itself."""
        exact = self.device == "cpu" and not self.capturing
        return min(self.queues.count(queue), self.capacity) if exact else self.capacity

    def _clock(self, stage: str, start: float) -> None:
        """Adds the time since `start` to that of a stage, if it is known."""
        if self.device != "cpu":
            if not self.profile:
                return
            wp.synchronize_device(self.device)
        self.stage_seconds[stage] = self.stage_seconds.get(stage, 0.0) + time.perf_counter() - start

    # --- what happened -------------------------------------------------------------------------------------------

    def check_status(self) -> None:
        """Raises WavefrontError where a kernel reported a failure."""
        if self.queues.counters.numpy()[queues.STATUS] & queues.STATUS_QUEUE_OVERFLOW:
            raise WavefrontError("a queue overflowed: the image would miss contributions (this is a bug)")

    def nonfinite(self) -> dict[str, int]:
        """Contributions left out, by stage."""
        counters = self.queues.counters.numpy()
        return {stage: int(counters[index]) for stage, index in queues.NONFINITE_STAGES.items()}


def plan_tiles(width: int, height: int, capacity: int, first_sample: int, sample_count: int) -> list[Tile]:
    """Tiles of at most `capacity` paths that cover the film once, tile rows from the top.

    Samples of one pixel share a tile as long as a tile keeps some hundred pixels, because their camera rays are alike.
    """
    samples = min(sample_count, max(1, capacity // 256))
    pixels = max(1, capacity // samples)
    side = max(1, int(pixels**0.5))
    tile_width = min(width, side)
    tile_height = min(height, max(1, pixels // tile_width))
    tile_width = min(width, max(tile_width, pixels // tile_height))
    tiles = []
    for s in range(first_sample, first_sample + sample_count, samples):
        count = min(samples, first_sample + sample_count - s)
        for y in range(0, height, tile_height):
            for x in range(0, width, tile_width):
                tiles.append(Tile(x, y, min(tile_width, width - x), min(tile_height, height - y), s, count))
    return tiles


def run_tiles(workers: list[Worker], tiles: list[Tile]) -> None:
    """Traces tiles on all workers, each on its own thread.

    Tiles of the same pixels must be added in the order of their samples, so tiles are handed out by groups of the
    same first sample, with a barrier in between.
    """
    groups: dict[int, list[Tile]] = {}
    for tile in tiles:
        groups.setdefault(tile.first_sample, []).append(tile)
    for group in groups.values():
        if len(workers) == 1:
            for tile in group:
                workers[0].trace_tile(tile)
            continue
        shared = deque(group)
        errors: list[BaseException] = []

        def work(worker: Worker, shared=shared, errors=errors):
            try:
                while shared and not errors:
                    try:
                        tile = shared.popleft()
                    except IndexError:  # another worker took the last one
                        return
                    worker.trace_tile(tile)
            except BaseException as error:
                errors.append(error)

        threads = [threading.Thread(target=work, args=(worker,), daemon=True) for worker in workers]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if errors:
            raise errors[0]
