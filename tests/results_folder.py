"""A folder of results as tools.experiment leaves it, with images of known pixels, made without rendering."""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec
import numpy as np

from tools.reference_store import Account, account_path
from tools.results import (
    EXPERIMENT,
    FORMAT,
    RECORDS,
    Budget,
    Experiment,
    MethodEntry,
    Point,
    Record,
    ReferenceEntry,
    SceneEntry,
    Seconds,
    slug,
)
from wavefront.scene.images import write_exr

SCENES = {"room": (24, 16), "box": (10, 14)}  # width, height
METHODS = ("slow", "fast")
SPP = (4, 16)
SEEDS = (1, 2)
# Mean squared errors and seconds of a sample, by method and seed, so that the cost of a budget does not depend on it.
ERRORS = {("slow", 1): 1.6, ("slow", 2): 0.8, ("fast", 1): 0.4, ("fast", 2): 0.08}
SECONDS = {("slow", 1): 0.5, ("slow", 2): 0.5, ("fast", 1): 0.25, ("fast", 2): 0.5}


def radiance(name: str, width: int, height: int) -> np.ndarray:
    """Pixels over many powers of two, a few far brighter and a few negative, [height, width, 3] float32."""
    rng = np.random.default_rng(int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big"))
    image = np.exp2(rng.uniform(-8.0, 3.0, (height, width, 3)))
    image[rng.random((height, width)) < 0.02] *= 1e5
    image[rng.random((height, width)) < 0.02] *= -1.0
    return image.astype(np.float32)


def errors_of(metrics: list[str], method: str, seed: int, samples: int) -> dict[str, float]:
    """``mse`` falls with the samples, ``mae`` with their root; others are as ``mse``."""
    error = ERRORS[method, seed] / samples
    return {metric: error**0.5 if metric == "mae" else error for metric in metrics}


def write_results(
    folder: Path,
    scenes: dict[str, tuple[int, int]] = SCENES,
    methods: tuple[str, ...] = METHODS,
    metrics: tuple[str, ...] = ("mse", "mae"),
    images: bool = True,
    description: str = "What is to be seen.",
) -> Path:
    """Writes a folder of results; of methods that are neither of `METHODS`, figures are those of ``fast``.

    Args:
        folder: Is made.
        scenes: Sizes by name.
        methods, metrics: Names.
        images: Whether those of the first seed are kept.
        description: Of the experiment.
    """
    (folder / "references").mkdir(parents=True)
    entries, lines = [], []
    for scene, (width, height) in scenes.items():
        entries.append(_write_scene(folder, scene, width, height))
        for method in methods:
            for spp in SPP:
                for seed in SEEDS:
                    image = None
                    if images and seed == SEEDS[0]:
                        image = Path("images", slug(scene), slug(method), f"{spp}-spp-{seed}.exr")
                        (folder / image).parent.mkdir(parents=True, exist_ok=True)
                        _write_image(folder / image, radiance(f"{scene} {method} {spp}", width, height))
                    lines.append(_record(scene, method, spp, seed, list(metrics), image))
    experiment = Experiment(
        format=FORMAT,
        name="known results",
        description=description,
        scenes=entries,
        methods=[MethodEntry(name=name, renderer="wavefront", overrides=[], versions={"w": "1"}) for name in methods],
        budgets=[Budget(spp=spp) for spp in SPP],
        seeds=list(SEEDS),
        metrics=list(metrics),
        baseline=methods[0],
        threads=1,
        device="cpu",
        machine={"cpu": "abacus", "cores": 1},
        commit=None,
        date="2026-01-01T00:00:00+00:00",
        spec={},
    )
    (folder / EXPERIMENT).write_bytes(msgspec.json.encode(experiment))
    (folder / RECORDS).write_bytes(b"".join(msgspec.json.encode(line) + b"\n" for line in lines))
    return folder


def _write_image(path: Path, pixels: np.ndarray, **more) -> None:
    write_exr(path, {**dict(zip("RGB", np.moveaxis(pixels, 2, 0), strict=True)), **more})


def _write_scene(folder: Path, scene: str, width: int, height: int) -> SceneEntry:
    path = folder / "references" / f"{slug(scene)}.exr"
    pixels = np.abs(radiance(f"{scene} reference", width, height))
    _write_image(path, pixels, **{"variance.Y": np.ones((height, width), np.float32)})
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    account = Account(
        format=1,
        image=path.name,
        image_sha256=sha256,
        scene=scene,
        file="",
        overrides=[],
        parameters={},
        renderer="wavefront",
        versions={},
        seed=1,
        settings={},
        target={},
        target_sha256="",
        samples_per_pixel=512,
        seconds=1.0,
        error=0.01,
        median_error=0.01,
        requested={},
        reached=True,
        details={},
        machine={},
        date="",
    )
    account_path(path).write_bytes(msgspec.json.encode(account))
    image = path.relative_to(folder).as_posix()
    reference = ReferenceEntry(image=image, sha256=sha256, renderer="wavefront", samples=512, error=0.01)
    return SceneEntry(
        name=scene,
        file="",
        width=width,
        height=height,
        overrides=[],
        parameters={},
        target_sha256="",
        reference=reference,
    )


def _record(scene: str, method: str, spp: int, seed: int, metrics: list[str], image: Path | None) -> Record:
    known = method if method in METHODS else "fast"
    per_sample = SECONDS[known, seed]
    counts = [2**k for k in range(spp.bit_length()) if 2**k <= spp]
    return Record(
        scene=scene,
        method=method,
        budget=Budget(spp=spp),
        seed=seed,
        renderer_seed=seed,
        samples=spp,
        seconds=Seconds(
            load=0.0,
            compile=0.0,
            render=per_sample * spp,
            training=0.0,
            measure=0.0,
            write=0.0,
            other=0.0,
            total=per_sample * spp,
        ),
        errors=errors_of(metrics, known, seed, spp),
        points=[Point(samples=n, seconds=per_sample * n, errors=errors_of(metrics, known, seed, n)) for n in counts],
        image=image and image.as_posix(),
        made={},
        notes=[],
        account={},
    )
