"""What a setting costs besides its rendering time: compile time with an empty cache, and peak memory.

Run as a child process (`bench_common.Child`), because both can be told of a fresh process alone. Its job is a dict:
``scene``, ``overrides``, ``parameters``, ``threads``, ``device``; whatever it is asked, it answers with
``compile_seconds`` and ``peak_memory_bytes``: of the process on the CPU device, of Warp's memory pool on CUDA (None
where there is no pool).
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from pathlib import Path

import msgspec

from tools.bench_common import Child, peak_memory_bytes, serve
from tools.experiment_spec import PlannedScene
from tools.knobs import KNOBS
from tools.methods import RENDERERS
from tools.results import write_json
from wavefront.errors import WavefrontError
from wavefront.identity import scene_hash, scene_records


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


def cost_class(changes: dict, method: str) -> str:
    """Settings of one class have the same cost: those that differ in knobs alone that trade neither."""
    kept = {name: value for name, value in changes.items() if {"compile", "memory"} & set(KNOBS[name].trades)}
    return json.dumps(kept, sort_keys=True)


def measure_all(
    scene: PlannedScene, methods: dict[str, dict], folder: Path, progress: Callable[[str], object]
) -> dict[str, Cost]:
    """The costs of all methods on a scene, those of one class measured once and kept in the file ``costs.json``.

    Args:
        scene: Planned, with a job for each method.
        methods: By name, the knobs it turns.
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
    keys: dict[str, str] = {}  # by class
    found = {}
    for name, changes in methods.items():
        kind, job = cost_class(changes, name), scene.jobs[name]
        if kind not in keys:
            versions = RENDERERS["wavefront"].versions(job.device)
            keys[kind] = scene_hash([scene_hash(scene_records(job.scene)), job.threads, job.device, versions])
        if keys[kind] not in known:
            progress(f"{scene.name}, {name}: compile time and memory")
            request = {"scene": str(job.path), "overrides": job.overrides, "parameters": dict(job.parameters)}
            known[keys[kind]] = measure({**request, "threads": job.threads, "device": job.device})
            write_json(path, known)
        found[name] = known[keys[kind]]
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
