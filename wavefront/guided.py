"""The guided bounce: its stages, the worker that runs them around a guide, and training between passes.

See `wavefront.guide` for the bounce, and for what a guide provides.
"""

from __future__ import annotations

import time

import warp as wp

from wavefront import queues
from wavefront.errors import WavefrontError
from wavefront.features import Features
from wavefront.guide import DIRECTIONS, LIGHTS, MIN_SAMPLE_WEIGHT, Guide, GuideContext
from wavefront.integrator import Kernels, Tile, Worker, skipped_guided_arrays
from wavefront.proposals import LightProposals, Proposals
from wavefront.queues import Paths, allocate_struct, make_counters
from wavefront.recording import Recorder, RecordScratch, Rows, scratch_arrays
from wavefront.scene import description
from wavefront.scene.device import DeviceScene
from wavefront.stages.guided_direct import make_guided_direct
from wavefront.stages.guided_evaluate import make_guided_evaluate
from wavefront.stages.guided_light import make_guided_light
from wavefront.stages.guided_propose import make_guided_propose
from wavefront.stages.guided_record import make_record_arrivals, put_throughput_aside, record_direct_light
from wavefront.stages.guided_resolve import make_guided_resolve
from wavefront.stages.guided_vertices import make_guided_vertices

TRAINING = ("records", "guide train")  # stages between passes: records are collected, the guide learns


def make_guided_kernels(f: Features) -> dict[str, wp.Kernel]:
    """The kernels of a guided bounce that others do not have, by the label of their stage."""
    bsdf = f.bsdfs, f.mask, f.textures
    frame = f.uvs, f.tangents, f.maps
    kernels = {
        "vertices": make_guided_vertices(*bsdf, f.uvs, f.mixed_deltas, f.guide_inputs),
        "propose": make_guided_propose(*bsdf, *frame, f.transmission, f.sampler, f.mixed_deltas, f.ahead),
        "directions": make_guided_evaluate(*bsdf, *frame, f.transmission),
        "resolve": make_guided_resolve(
            f.transmission, f.roulette, f.media, f.sampler, f.mixed_deltas, f.guide_pdf, f.records
        ),
    }
    if f.light_sampling:
        kernels["direct"] = make_guided_direct(*bsdf, f.lights, f.light_textures, *frame, f.media, f.sampler, f.ahead)
        kernels["light"] = make_guided_light(f.mixed_deltas, f.guide_pdf, bool(f.records))
    if f.records:
        kernels["put_aside"] = put_throughput_aside
        kernels["record_arrivals"] = make_record_arrivals(f.light_sampling and "taken" in f.records)
        if f.light_sampling:
            kernels["record_light"] = record_direct_light
    return kernels


class GuidedWorker(Worker):
    """A worker whose bounces are guided.

    A guide's methods run on the host between the stages. So on CUDA a pass is no captured graph: the host launches
    every bounce, and looks once per bounce at how many paths are left, which bounds all queues of the bounce.

    Args:
        guide: Bound to the renderer.
        guided_kernels: From `make_guided_kernels`.
        recorder: Of the records, if the guide asks for them.
        arguments: Those of `Worker`.
    """

    def __init__(
        self, guide: Guide, guided_kernels: dict[str, wp.Kernel], recorder: Recorder | None = None, **arguments
    ):
        super().__init__(**arguments)
        self.guide, self.recording = guide, False
        self.bound = self.capacity  # entries of any queue of this bounce, on CUDA
        f: Features = arguments["features"]
        device_scene, scene = arguments["device_scene"], arguments["scene"]
        skip = skipped_guided_arrays(f)
        self.proposals, self.light_proposals, self.scratch = (
            allocate_struct(struct, self.capacity, self.device, skip[struct])
            for struct in (Proposals, LightProposals, RecordScratch)
        )
        proposals, light_proposals, scratch = self.proposals, self.light_proposals, self.scratch
        rows = recorder.rows if recorder is not None else Rows()
        paths, surfaces, shadow_rays, tile = self.paths, self.surfaces, self.shadow_rays, self.tile
        counters, seed = self.queues.counter_struct, wp.uint64(arguments["seed"])
        geometry, materials = device_scene.geometry, device_scene.materials
        textures, lights = device_scene.textures, device_scene.lights
        rays, hits, shadow, guided, lit, proposed, smooth = (
            self.queues[name] for name in ("rays", "hits", "shadow", "guided", "lit", "proposed", "smooth")
        )
        tables = geometry, materials, textures, lights
        rr_depth = scene.integrator.rr_depth or 0
        inputs = {
            "vertices": [materials, textures, paths, surfaces, hits, guide.bsdf_share, proposals, guided, counters],
            "direct": [*tables, paths, surfaces, guided, seed, light_proposals, shadow_rays, lit, counters],
            "light": [paths, proposals, light_proposals, lit, shadow_rays, scratch, shadow, counters],
            "propose": [materials, textures, paths, surfaces, hits, seed, proposals, proposed, smooth, counters],
            "directions": [materials, textures, paths, surfaces, proposed, proposals, counters],
            "resolve": [proposals, surfaces, hits, rr_depth, seed, tile, paths, rays, rows, counters],
            "put_aside": [rays, paths, scratch],
            "record_arrivals": [rays, tile, counters, paths, scratch, rows],
            "record_light": [shadow, tile, counters, paths, scratch, rows],
        }
        for stage, kernel in guided_kernels.items():
            self._command(stage, kernel, inputs[stage])
        if f.records:
            self._commands_apart(arguments["kernels"], f)
        self.state = guide.make_state(
            GuideContext(
                device=self.device,
                capacity=self.capacity,
                features=f,
                scene=device_scene,
                seed=seed,
                paths=paths,
                surfaces=surfaces,
                proposals=proposals,
                counters=self.queues.counters,
            )
        )

    def _commands_apart(self, kernels: Kernels, f: Features) -> None:
        """The stages that add radiance, adding it to arrays of their own instead: the same kernels, given path states
        that share all arrays but some."""
        # What they leave out is counted by those that add to the path.
        counters = make_counters(wp.zeros_like(self.queues.counters))

        def apart(L: wp.array, pdf: wp.array | None = None):
            paths = Paths()
            for name in Paths.vars:
                setattr(paths, name, getattr(self.paths, name))
            paths.L = L
            if pdf is not None:
                paths.pdf = pdf
            return paths

        views = {"": apart(self.scratch.emission)}
        if "whole_emission" in scratch_arrays(f.records, f.light_sampling):
            views["whole_"] = apart(self.scratch.whole_emission, self.scratch.no_pdf)
        for stage in ("escaped", "emission"):
            for prefix, view in views.items():
                inputs = [view if x is self.paths else x for x in self._arguments.get(stage, [])]
                inputs = [counters if x is self.queues.counter_struct else x for x in inputs]
                self._command(f"record_{prefix}{stage}", getattr(kernels, stage), inputs)
        if kernels.shadow is not None:
            visible = apart(self.scratch.visible)
            inputs = [visible if x is self.paths else x for x in self._arguments["shadow"]]
            self._command("record_shadow", kernels.shadow, inputs)

    # --- the loop ------------------------------------------------------------------------------------------------

    def trace_tile(self, tile: Tile) -> None:
        self._set_tile(tile)
        self._trace(tile)

    def _bounce(self, aov_pixels: int = 0) -> None:
        if self.device != "cpu":
            self.bound = min(int(self.queues.counters[queues.RAYS : queues.RAYS + 1].numpy()[0]), self.capacity)
        if self.recording:
            self._launch("put_aside", "rays")
        self._launch("stream", "rays")
        self._launch("intersect", "rays")
        self._launch("perturb", "rays")
        if self.recording:
            for stage in ("escaped", "emission"):
                queue = "emissive" if stage == "emission" else stage
                self._launch(f"record_{stage}", queue)
                self._launch(f"record_whole_{stage}", queue)
            self._launch("record_arrivals", "rays")
        self._launch("escaped", "escaped")
        self._launch("emission", "emissive")
        self._launch("aov", aov_pixels)

        self._launch("vertices", "hits")
        self._ask("prepare", "guided")
        self._launch("direct", "guided")
        if self.guide.has_pdf and "light" in self.commands:
            self._ask("evaluate", "lit", self.light_proposals.wi, self.light_proposals.guide_pdf, LIGHTS)
        self._launch("light", "lit")
        self._launch("stream_shadow", "shadow")
        if self.recording:
            self._launch("record_shadow", "shadow")
            self._launch("record_light", "shadow")
        else:
            self._launch("shadow", "shadow")
        self._launch("drain", 1)
        self._launch("propose", "hits")
        for k in range(self.guide.rounds):
            self._ask("propose", "proposed", k)
        self._launch("directions", "proposed")
        if self.guide.has_pdf:
            self._ask("evaluate", "smooth", self.proposals.wi, self.proposals.guide_pdf, DIRECTIONS)
        self._launch("resolve", "hits")
        self._launch("advance", 1)

    def _ask(self, method: str, queue: str, *arguments) -> None:
        """Has the guide's state work on a queue."""
        count = self._threads(queue)
        if count == 0:
            return
        start = time.perf_counter()
        getattr(self.state, method)(self.queues[queue], count, *arguments)
        self._clock(f"guide {method}", start)

    def _threads(self, queue: str) -> int:
        return super()._threads(queue) if self.device == "cpu" else self.bound


class Guiding:
    """A guide in a renderer: its kernels, its records and its training.

    Args:
        guide: Is bound to the renderer here.
        scene, device_scene, features, device: Those of the renderer; `features` with the guide's key.
    """

    def __init__(
        self,
        guide: Guide,
        scene: description.Scene,
        device_scene: DeviceScene,
        features: Features,
        device: str,
    ):
        self.guide, self.device = guide, device
        self.seconds: dict[str, float] = {}  # of what happens between passes
        guide.bind(scene, device_scene, features, device)
        self.kernels = make_guided_kernels(features)
        self.recorder = None
        if guide.records is not None:
            window = scene.film.window
            max_depth = scene.integrator.max_depth
            self.recorder = Recorder(guide.records, max_depth, window.width, window.height, device)

    def modules(self) -> list:
        modules = [kernel.module for kernel in self.kernels.values()] + self.guide.modules()
        return modules + (self.recorder.modules() if self.recorder is not None else [])

    def nbytes(self) -> int:
        """Memory besides that of the paths."""
        return self.guide.nbytes() + (self.recorder.nbytes if self.recorder is not None else 0)

    def make_worker(self, **arguments) -> GuidedWorker:
        return GuidedWorker(self.guide, self.kernels, self.recorder, **arguments)

    def trains(self, progress: float) -> bool:
        return self.recorder is not None and self.guide.trains(progress)

    def sample_weight(self, progress: float) -> float:
        """Of the next pass.

        Raises:
            WavefrontError: The guide gives one that is out of range.
        """
        weight = self.guide.sample_weight(progress) if self.guide.weighted else 1.0
        if not MIN_SAMPLE_WEIGHT <= weight <= 1.0:
            raise WavefrontError(
                f"guide {self.guide.name}: a sample weight of {weight} at progress {progress:.3g}; "
                f"allowed: {MIN_SAMPLE_WEIGHT} to 1"
            )
        return float(weight)

    def begin(self, workers: list[GuidedWorker], sample: int) -> None:
        """Before a pass of training, of this sample alone."""
        self.recorder.begin(sample)
        for worker in workers:
            worker.recording = True

    def train(self, workers: list[GuidedWorker]) -> None:
        """After it."""
        for worker in workers:
            worker.recording = False
        start = time.perf_counter()
        records = self.recorder.collect()
        collected = time.perf_counter()
        self.guide.train(records)
        if self.device != "cpu":
            wp.synchronize_device(self.device)
        for name, value in zip(TRAINING, (collected - start, time.perf_counter() - collected), strict=True):
            self.seconds[name] = self.seconds.get(name, 0.0) + value
