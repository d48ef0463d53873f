"""What a setting costs besides its rendering time: compile time with an empty cache, and peak memory.

Run as a child process (`bench_common.Child`), because both can be told of a fresh process alone. Its job is a dict:
``scene``, ``overrides``, ``parameters``, ``threads``, ``device``; whatever it is asked, it answers with
``compile_seconds`` and ``peak_memory_bytes``: of the process on the CPU device, of Warp's memory pool on CUDA (None
where there is no pool).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import msgspec

from guiding.registry import plain_settings
from tools.bench_common import Child, peak_memory_bytes, serve
from tools.experiment_spec import PlannedScene
from tools.methods import RENDERERS
from tools.results import write_json
from wavefront.errors import WavefrontError
from wavefront.identity import scene_hash


class Cost(msgspec.Struct, forbid_unknown_fields=True):
    """Of a setting, whatever its budget: seconds to compile its kernels, and bytes."""

    compile_seconds: float
    peak_memory_bytes: int | None


def measure(job: dict) -> Cost:
    """In a process of its own, with an empty kernel cache.

    Raises:
        WavefrontError: It failed.
    """
    with (
        tempfile.TemporaryDirectory(prefix="wavefront-cost-") as cache,
        Child("tools.setting_cost", job, {"WARP_CACHE_PATH": cache}) as child,
    ):
        return Cost(**child.ask({}))


def measure_all(
    scene: PlannedScene, features: dict[str, str], folder: Path, progress: Callable[[str], object]
) -> dict[str, Cost]:
    """The costs of all methods on a scene, kept in ``costs.json``; measured once for those with the same kernels and
    the same guide, whose settings say what its network is like.

    Args:
        scene: Planned, with a job for each method.
        features: By method, the hash of what its kernels are built for.
        folder: Of the results.
        progress: Called with what is being measured.

    Raises:
        WavefrontError: A process failed, or the file is damaged.
    """
    path = folder / "costs.json"
    try:
        known = msgspec.json.decode(path.read_bytes(), type=dict[str, Cost]) if path.exists() else {}
    except msgspec.MsgspecError as error:
        raise WavefrontError(f"{path}: damaged: {error}") from None
    found = {}
    for name, digest in features.items():
        job = scene.jobs[name]
        film = job.scene.film
        versions = RENDERERS["wavefront"].versions(job.device)
        guide = plain_settings(job.scene)
        parts = [scene.name, film.width, film.height, digest, job.threads, job.device, versions]
        key = scene_hash([*parts, guide] if guide else parts)
        if key not in known:
            progress(f"{scene.name}, {name}: compile time and memory")
            request = {"scene": str(job.path), "overrides": job.overrides, "parameters": dict(job.parameters)}
            known[key] = measure({**request, "threads": job.threads, "device": job.device})
            write_json(path, known)
        found[name] = known[key]
    return found


def make(job: dict):
    """The child's side, for `serve`."""

    def answer(request: dict) -> dict:
        import warp as wp

        from tools.methods import Wavefront, load_job

        loaded = load_job(Path(job["scene"]), job["overrides"], job["parameters"], job["threads"], job["device"])
        engine = Wavefront(loaded, 0)
        engine.add(1)
        engine.image()
        if job["device"] == "cpu":
            peak = peak_memory_bytes()
        else:
            pool = wp.is_mempool_enabled(job["device"])
            peak = wp.get_mempool_used_mem_high(job["device"]) if pool else None
        return {"compile_seconds": engine.compile_seconds, "peak_memory_bytes": peak}

    return answer


if __name__ == "__main__":
    serve(make)
