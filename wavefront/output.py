"""What a render leaves behind: OUT.exr, OUT.png and OUT.json."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import warp as wp

import wavefront
from wavefront.errors import WavefrontError
from wavefront.film import INTEGERS, Film, row_blocks
from wavefront.identity import scene_hash
from wavefront.renderer import Renderer, peak_memory_bytes
from wavefront.scene import description
from wavefront.scene.images import HalfOverflowError, replacing, write_exr_blocks, write_png_blocks
from wavefront.scene.lookup import walk


def output_paths(exr: Path) -> tuple[Path, Path, Path]:
    """The image, its picture for the eye, and its account."""
    return exr, exr.with_suffix(".png"), exr.with_suffix(".json")


def check_image_path(exr: Path) -> None:
    """Refuses an output that cannot be written, before time is spent on it.

    Raises:
        WavefrontError: Wrong suffix, a missing or read-only folder, or a folder in the place of a file.
    """
    if exr.suffix.lower() != ".exr":
        raise WavefrontError(f"{exr}: the output is an OpenEXR file; allowed: a name that ends in .exr")
    for path in output_paths(exr):
        check_writable(path)


def check_writable(path: Path) -> None:
    """Refuses a file that cannot be written: in a missing or read-only folder, or in the place of a folder.

    Raises:
        WavefrontError: Names the file.
    """
    if not path.parent.is_dir():
        raise WavefrontError(f"{path}: the folder {path.parent} does not exist")
    if path.is_dir():
        raise WavefrontError(f"{path}: cannot be written: it is a folder")
    if path.exists() and not os.access(path, os.W_OK):
        raise WavefrontError(f"{path}: cannot be written: permission denied")
    probe = path.with_name(f".{path.stem}.{os.getpid()}.probe")
    try:
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise WavefrontError(f"{path}: cannot be written: {error.strerror or error}") from None


def check_not_read(paths: Sequence[Path], source: str | os.PathLike, scene: description.Scene) -> None:
    """Refuses files to write that would replace the scene file, or an image or mesh of the scene.

    Raises:
        WavefrontError: Names the file.
    """
    read = {os.path.realpath(source)} | {
        os.path.realpath(record.file) for _, record in walk(scene) if getattr(record, "file", None)
    }
    for path in paths:
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


def image_attributes(renderer: Renderer) -> dict[str, int | str]:
    """What the header of an image says of its making, for those who combine images (see `tools.merge`).

    Attributes: ``renderer``, ``sceneHash`` (of `identity.scene_records`), ``settings`` (film and integrator, JSON),
    ``seed`` (decimal; several after a merge, with commas), ``samplesPerPixel``, ``sumOfWeights`` (of the samples of a
    pixel, decimal, if samples have weights), and the format's own ``pixelAspectRatio``.
    """
    records, film = renderer.scene_records, renderer.film
    return {
        "renderer": f"wavefront {wavefront.__version__}",
        "sceneHash": scene_hash(records),
        "settings": json.dumps({"film": records["film"], "integrator": records["integrator"]}, sort_keys=True),
        "seed": str(renderer.seed),  # text: a header has no 64-bit integers
        "samplesPerPixel": renderer.sample_count,
        "PixelAspectRatio": renderer.scene.film.pixel_aspect,
    } | ({"sumOfWeights": repr(film.weight_sums[0])} if film.weighted else {})


def describe_render(renderer: Renderer, source: str, started: float, preset: dict | None = None) -> dict:
    """The account of a render, for OUT.json.

    Args:
        renderer: After rendering.
        source: Path of the scene, as given.
        started: `time.perf_counter()` at the start of the program.
        preset: From `Preset.account`, if there was one.
    """
    s = renderer.statistics
    seconds = max(s.render_seconds, 1e-9)
    return {
        "scene": str(source),
        "scene_sha256": scene_hash(renderer.scene_records),
        "settings": {
            "film": msgspec.to_builtins(msgspec.structs.asdict(renderer.scene.film)),
            "integrator": msgspec.to_builtins(msgspec.structs.asdict(renderer.scene.integrator)),
            "seed": renderer.seed,
            "threads": renderer.threads,
        },
        "preset": preset,
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
        "bytes_per_pixel": renderer.bytes_per_pixel,
        "bytes_per_path": renderer.bytes_per_path,
        "paths_in_flight": renderer.capacity * renderer.threads,
        "warnings": renderer.warnings,
    } | ({"guide": describe_guide(renderer)} if renderer.guide else {})


def describe_guide(renderer: Renderer) -> dict:
    """The account of a guided render's guide, ``method``, ``settings`` and ``statistics``, and of the weights of
    samples, if they have any (see `Film`)."""
    film, guide, weights = renderer.film, renderer.guide, {}
    if film.weighted:
        weights = {"sum_of_weights": film.weight_sums[0], "effective_samples_per_pixel": film.effective_samples}
    return {"method": guide.name, "settings": guide.identity(), "statistics": guide.statistics()} | weights


def write_film(exr: Path, renderer: Renderer, half: bool) -> None:
    """Writes the channels of the film, from the film itself in blocks of rows.

    Indices and counts are 32-bit floats whatever `half` says.

    Raises:
        HalfOverflowError: A finite value beyond 65504 in half precision.
        WavefrontError: The file cannot be written.
    """
    film, record = renderer.film, renderer.scene.film
    names = film.rows(0, 1)
    write_exr_blocks(
        exr,
        (record.window.x, record.window.y, film.width, film.height),
        (record.width, record.height),
        {name: "half" if half and name not in INTEGERS else "float" for name in names},
        (film.rows(first, last) for first, last in row_blocks(film.width, film.height)),
        image_attributes(renderer),
    )


def write_picture(png: Path, film: Film, exposure: float) -> None:
    """Writes the film for the eye, in blocks of rows.

    Raises:
        WavefrontError: The file cannot be written.
    """
    blocks = row_blocks(film.width, film.height)
    pictures = (tone_map(film.image_rows(first, last), exposure) for first, last in blocks)
    write_png_blocks(png, (film.height, film.width, 3), pictures)


def write_outputs(exr: Path, renderer: Renderer, exposure: float, account: dict) -> None:
    """Writes the three files, each under a temporary name first.

    Raises:
        HalfOverflowError: A value overflows half precision; the image is there in 32-bit floats all the same.
        WavefrontError: A file cannot be written.
    """
    exr, png, account_path = output_paths(exr)
    overflow = None
    try:
        write_film(exr, renderer, renderer.scene.film.precision == "half")
    except HalfOverflowError as error:
        overflow = error
        write_film(exr, renderer, False)
    write_picture(png, renderer.film, exposure)
    account["peak_memory_bytes"] = peak_memory_bytes()  # with what writing took
    with replacing(account_path) as temporary:
        temporary.write_text(json.dumps(account, indent=2) + "\n", encoding="utf-8")
    if overflow is not None:
        raise HalfOverflowError(f"{overflow}; nothing is lost: it was written as 32-bit floats")
