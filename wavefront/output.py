"""What a render leaves behind: OUT.exr, OUT.png and OUT.json."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import platform
import time
from pathlib import Path

import msgspec
import numpy as np
import warp as wp

import wavefront
from wavefront.errors import WavefrontError
from wavefront.renderer import Renderer, peak_memory_bytes
from wavefront.scene import description
from wavefront.scene.images import HalfOverflowError, replacing, write_exr, write_png
from wavefront.scene.lookup import walk


def output_paths(exr: Path) -> tuple[Path, Path, Path]:
    """The image, its picture for the eye, and its account."""
    return exr, exr.with_suffix(".png"), exr.with_suffix(".json")


def check_writable(exr: Path) -> None:
    """Refuses an output that cannot be written, before time is spent on it.

    Raises:
        WavefrontError: Wrong suffix, a missing or read-only folder, or a folder in the place of a file.
    """
    if exr.suffix.lower() != ".exr":
        raise WavefrontError(f"{exr}: the output is an OpenEXR file; allowed: a name that ends in .exr")
    if not exr.parent.is_dir():
        raise WavefrontError(f"{exr}: the folder {exr.parent} does not exist")
    for path in output_paths(exr):
        if path.is_dir():
            raise WavefrontError(f"{path}: cannot be written: it is a folder")
        if path.exists() and not os.access(path, os.W_OK):
            raise WavefrontError(f"{path}: cannot be written: permission denied")
    probe = exr.with_name(f".{exr.stem}.{os.getpid()}.probe")
    try:
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise WavefrontError(f"{exr}: cannot be written: {error.strerror or error}") from None


def check_not_read(exr: Path, source: str | os.PathLike, scene: description.Scene) -> None:
    """Refuses an output that would replace the scene file, or an image or mesh of the scene.

    Raises:
        WavefrontError: Names the file.
    """
    read = {os.path.realpath(source)} | {
        os.path.realpath(record.file) for _, record in walk(scene) if getattr(record, "file", None)
    }
    for path in output_paths(exr):
        if os.path.realpath(path) in read:
            raise WavefrontError(
                f"{path}: would be overwritten, but the scene is read from it; choose another name with -o"
            )


def tone_map(image: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    """8-bit sRGB from linear radiance, clipped at 1 after scaling by 2^exposure (IEC 61966-2-1).

    Args:
        image: Linear Rec. 709, shape [height, width, 3].
        exposure: Stops.
    """
    x = np.clip(np.nan_to_num(np.asarray(image, np.float64) * 2.0**exposure), 0.0, 1.0)
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-12) ** (1.0 / 2.4) - 0.055)
    return (encoded * 255.0 + 0.5).astype(np.uint8)


def scene_hash(scene: description.Scene) -> str:
    """SHA-256 of a scene: its records, with the contents of files in the place of their paths."""
    plain = msgspec.to_builtins(scene)
    files = {}
    for _, record in walk(scene):
        file = getattr(record, "file", None)
        if file and file not in files:
            files[file] = hashlib.sha256(Path(file).read_bytes()).hexdigest()

    def replace(value):
        if isinstance(value, dict):
            return {k: files.get(v, v) if k == "file" else replace(v) for k, v in value.items()}
        return [replace(v) for v in value] if isinstance(value, list) else value

    return hashlib.sha256(json.dumps(replace(plain), sort_keys=True).encode()).hexdigest()


def describe_render(renderer: Renderer, source: str, started: float) -> dict:
    """The account of a render, for OUT.json.

    Args:
        renderer: After rendering.
        source: Path of the scene, as given.
        started: `time.perf_counter()` at the start of the program.
    """
    s = renderer.statistics
    seconds = max(s.render_seconds, 1e-9)
    return {
        "scene": str(source),
        "scene_sha256": scene_hash(renderer.scene),
        "settings": {
            "film": msgspec.to_builtins(msgspec.structs.asdict(renderer.scene.film)),
            "integrator": msgspec.to_builtins(msgspec.structs.asdict(renderer.scene.integrator)),
            "seed": renderer.seed,
            "threads": renderer.threads,
        },
        "features": dataclasses.asdict(renderer.features),
        "versions": {
            "wavefront": wavefront.__version__,
            "warp": wp.config.version,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "device": renderer.device,
        "device_name": wp.get_device(renderer.device).name,
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "samples_per_pixel": s.sample_count,
        "paths": s.paths,
        "rays": s.rays,
        "shadow_rays": s.shadow_rays,
        "seconds": {
            "compile": s.compile_seconds,
            "render": s.render_seconds,
            "total": time.perf_counter() - started,
        },
        "stage_seconds": s.stage_seconds,
        "mpaths_per_second": s.paths / seconds / 1e6,
        "mrays_per_second": (s.rays + s.shadow_rays) / seconds / 1e6,
        "nonfinite": s.nonfinite,
        "triangles": renderer.device_scene.triangle_count,
        "triangles_with_instances": renderer.device_scene.instanced_triangle_count,
        "instances": renderer.device_scene.instance_count,
        "spheres": renderer.device_scene.sphere_count,
        "lights": renderer.device_scene.light_count,
        "bytes_per_path": renderer.bytes_per_path,
        "paths_in_flight": renderer.capacity * renderer.threads,
        "peak_memory_bytes": peak_memory_bytes(),
        "warnings": renderer.warnings,
    }


def write_outputs(exr: Path, renderer: Renderer, exposure: float, account: dict) -> None:
    """Writes the three files, each under a temporary name first.

    Raises:
        WavefrontError: A file cannot be written; or a value overflows half precision, in which case the image is
            there in 32-bit floats all the same.
    """
    exr, png, account_path = output_paths(exr)
    channels = renderer.film.channels()
    overflow = None
    try:
        write_exr(exr, channels, half=renderer.scene.film.precision == "half")
    except HalfOverflowError as error:
        overflow = error
        write_exr(exr, channels)
    write_png(png, tone_map(renderer.film.image(), exposure))
    with replacing(account_path) as temporary:
        temporary.write_text(json.dumps(account, indent=2) + "\n", encoding="utf-8")
    if overflow is not None:
        raise WavefrontError(f"{overflow}; nothing is lost: it was written as 32-bit floats")
