"""One renderer, measured in a process of its own: the child of `tools.bench_render`.

Its job is a dict: ``engine`` (``wavefront``, or a variant of Mitsuba), ``scene`` (a file), ``width``, ``height``,
``max_depth``, ``threads``, ``device``, and for ours ``paths_in_flight`` and ``memory`` if they are not the defaults.
It answers ``{"do": "start"}``, ``{"do": "measure", "seconds": 5.0}`` and ``{"do": "finish"}``.
"""

from __future__ import annotations

import time

import numpy as np

from tools.bench_common import peak_memory_bytes, serve

CHUNK_SECONDS = 1.0  # of one call of the peer: long enough that its start does not count


def prepared(job: dict):
    """Our records for a job: its film with a box filter, its depth, no Russian roulette, light sampling.

    A job with ``everything`` gets kernels for every feature, see `tools.every_feature`.
    """
    from wavefront.scene import description, load_scene

    scene = load_scene(job["scene"])
    scene.film = description.Film(width=job["width"], height=job["height"])
    scene.integrator = description.PathIntegrator(max_depth=job["max_depth"], rr_depth=None)
    if job.get("everything"):
        from tools.every_feature import with_every_feature

        with_every_feature(scene)
    return scene


class Wavefront:
    """Ours."""

    def __init__(self, job: dict):
        self.job = job

    def start(self, request: dict) -> dict:
        from wavefront.renderer import Renderer

        begin = time.perf_counter()
        scene = prepared(self.job)
        options = ("device", "threads", "memory", "paths_in_flight")
        self.renderer = Renderer(scene, **{name: self.job[name] for name in options if name in self.job})
        built = time.perf_counter()
        self.renderer.render(spp=1)
        compiled = self.renderer.statistics.compile_seconds
        return {
            "load_seconds": built - begin - compiled,
            "compile_seconds": compiled,
            "warm_up_seconds": time.perf_counter() - built,
        }

    def measure(self, request: dict) -> dict:
        s = self.renderer.statistics
        before = (s.paths, s.rays + s.shadow_rays, s.render_seconds)
        self.renderer.render(seconds=request["seconds"])
        paths, rays, seconds = (
            now - then for now, then in zip((s.paths, s.rays + s.shadow_rays, s.render_seconds), before, strict=True)
        )
        return {"paths": paths, "rays": rays, "seconds": seconds}

    def finish(self, request: dict) -> dict:
        r = self.renderer
        answer = {
            "mean": float(r.film.image().astype(np.float64).mean()),
            "bytes_per_path": r.bytes_per_path,
            "paths_in_flight": r.capacity * r.threads,
            "triangles": r.device_scene.triangle_count,
            "lights": r.device_scene.light_count,
            "nonfinite": r.statistics.nonfinite,
            "peak_memory_bytes": peak_memory_bytes(),
            "stage_seconds": r.statistics.stage_seconds,
        }
        if not answer["stage_seconds"]:  # on CUDA, stages are timed apart: it takes a synchronisation after each
            from wavefront.renderer import Renderer

            profiled = Renderer(prepared(self.job), device=self.job["device"], profile=True)
            profiled.render(seconds=request.get("seconds", 1.0))
            answer["stage_seconds"] = profiled.statistics.stage_seconds
        return answer


class Mitsuba:
    """The peer, in the variant that the job names."""

    def __init__(self, job: dict):
        self.job, self.seed, self.total, self.samples = job, 0, 0.0, 0

    def start(self, request: dict) -> dict:
        from tools.peers import mitsuba as peer

        begin = time.perf_counter()
        self.peer, job = peer, self.job
        peer.use_variant(job["engine"], job["threads"])
        if job["scene"].endswith(".xml"):
            self.scene = peer.load_xml(job["scene"], job["width"], job["height"])
        else:
            self.scene = peer.load_records(prepared(job))
        loaded = time.perf_counter()
        self._render(1)
        first = time.perf_counter()
        # Calls of a fixed number of samples, so that nothing is compiled while it is measured.
        self._render(4)
        rate = 4.0 / (time.perf_counter() - first)
        most = max(1, peer.PATHS_PER_PASS // (job["width"] * job["height"]))
        self.chunk = max(1, min(most, round(rate * CHUNK_SECONDS)))
        self._render(self.chunk)
        # The first image compiles kernels, unless the variant has none or they are cached.
        return {
            "load_seconds": loaded - begin,
            "compile_seconds": first - loaded,
            "warm_up_seconds": time.perf_counter() - loaded,
        }

    def _render(self, spp):
        image = self.peer.render(self.scene, spp, self.seed, self.job["max_depth"])
        self.seed += 1
        self.total, self.samples = self.total + spp * float(image.mean()), self.samples + spp

    def measure(self, request: dict) -> dict:
        begin, calls = time.perf_counter(), 0
        while (seconds := time.perf_counter() - begin) < request["seconds"]:
            self._render(self.chunk)
            calls += 1
        return {"paths": calls * self.chunk * self.job["width"] * self.job["height"], "seconds": seconds}

    def finish(self, request: dict) -> dict:
        return {"mean": self.total / self.samples, "peak_memory_bytes": peak_memory_bytes()}


def make(job: dict):
    """The handler of a job, for `serve`."""
    engine = Wavefront(job) if job["engine"] == "wavefront" else Mitsuba(job)
    return lambda request: getattr(engine, request["do"])(request)


if __name__ == "__main__":
    serve(make)
