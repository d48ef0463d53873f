"""Images beside Mitsuba 3, from the same XML: does each real scene look the same?

Both renderers draw batches of samples of a small film until the ratio of their means is known to `--error`, or until
`--seconds` have passed. Every tile of the image is then tested (see `tools.image_test`): the table gives the share of
tile and channel tests that pass at 95 % (95 % are expected of equal images), the smallest p-value corrected for
their number, and the ratio of the image means with its 95 % interval. A scene is the *same* if no tile differs at a
false alarm rate of 1e-4 and the interval meets 1 +- 0.005; it is *noisy* if the interval is wider than 0.02.
Next-event estimation, no Russian roulette, box filter. Media are compared with Mitsuba's `volpath`; its `path` ignores
them. A `sunsky`, of which each renderer has a model of its own, is baked by Mitsuba, so that the transport is compared
(`tools.bake`); ours is shown beside it. Where rare paths carry most of the light (a caustic of a small light), the mean
of an image says nothing for hours; `--clamp C` compares the means of single samples clamped at radiance C, which agree
because both renderers sample in the same ways. Pictures: ours, Mitsuba's, and where tiles differ (red: ours is
brighter, blue: darker; full colour: 4 standard errors).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image
from rich.console import Console
from rich.table import Table

from tools.bake import bake_sunsky, baked_xml, replace_records
from tools.bench_common import machine
from tools.image_test import FALSE_ALARM_RATE, RATIO_TOLERANCE, Comparison, Estimate, tile_means
from tools.peers import mitsuba as peer
from tools.peers.images import like_the_peer, our_batches, rounding_of, their_batches
from tools.peers.mitsuba_records import integrator_of
from wavefront.errors import WavefrontError
from wavefront.output import tone_map
from wavefront.renderer import Renderer
from wavefront.scene import description, load_scene
from wavefront.scene.images import replacing

TILE_ROWS = 9
BATCHES = 48  # of each renderer, about; their spread tells the noise
LEAST_BATCHES = 16
NOISY = 0.02  # width of an interval that says nothing
OWN_SKY_SAMPLES = 16
SHEET_WIDTH = 1280  # pixels
SETTINGS = ("width", "max_depth", "error", "seconds", "clamp", "threads", "variant")


@dataclasses.dataclass
class Row:
    """The outcome for one scene.

    Attributes:
        name: Of the scene's folder.
        note: What is compared, where it is not simply the file.
        comparison: Ours over Mitsuba's.
        images: Mean radiance of ours and of Mitsuba's, [height, width, 3] each.
        own_sky: The same with our own model of the sky, where the light was baked.
        samples: Per pixel, of ours and of Mitsuba's.
        seconds: Wall time of ours and of Mitsuba's.
    """

    name: str
    note: str
    comparison: Comparison
    images: tuple[np.ndarray, np.ndarray]
    own_sky: np.ndarray | None
    samples: tuple[int, int]
    seconds: tuple[float, float]

    @property
    def tiles_passed(self) -> float:
        """Share of tests at the 5 % level that pass."""
        return float((self.comparison.p_values > 0.05).mean())

    @property
    def verdict(self) -> str:
        low, high = self.comparison.interval()
        if self.comparison.smallest_p < FALSE_ALARM_RATE or low > 1.0 + RATIO_TOLERANCE or high < 1.0 - RATIO_TOLERANCE:
            return "differs"
        return "noisy" if high - low > NOISY else "same"

    def figures(self) -> dict:
        """For the JSON file."""
        ratio, error = self.comparison.ratio()
        return {
            "scene": self.name,
            "note": self.note,
            "ratio": ratio,
            "standard_error": error,
            "interval": self.comparison.interval(),
            "tiles": list(self.comparison.error.shape[:2]),
            "tiles_passed_at_95_percent": self.tiles_passed,
            "smallest_p_corrected": self.comparison.smallest_p,
            "detectable_in_a_tile": self.comparison.detectable(),
            "samples_per_pixel": dict(zip(("ours", "mitsuba"), self.samples, strict=True)),
            "seconds": dict(zip(("ours", "mitsuba"), self.seconds, strict=True)),
            "verdict": self.verdict,
        }


def clamped(singles: Iterator[np.ndarray], spp: int, limit: float) -> Iterator[np.ndarray]:
    """Means over `spp` images of one sample per pixel each, of which every channel is clamped at `limit`."""
    while True:
        yield sum(np.minimum(next(singles), limit) for _ in range(spp)) / spp


class Side:
    """One renderer's batches: their tile means, their mean image, and the time they took."""

    def __init__(self, batches: Iterator[np.ndarray], spp: int, tiles: tuple[int, int]):
        self.batches, self.spp, self.tiles = batches, spp, tiles
        self.total: np.ndarray | float = 0.0
        self.means: list[np.ndarray] = []
        self.seconds = 0.0

    def draw(self) -> None:
        begin = time.perf_counter()
        image = np.asarray(next(self.batches), np.float64)
        self.seconds += time.perf_counter() - begin
        self.total = self.total + image
        self.means.append(tile_means(image, self.tiles))

    @property
    def image(self) -> np.ndarray:
        return self.total / len(self.means)

    @property
    def samples(self) -> int:
        return self.spp * len(self.means)


def batch_samples(make, seconds: float) -> int:
    """Samples per pixel of a batch, such that `BATCHES` of them take about `seconds`.

    Args:
        make: From samples per pixel to batches.
        seconds: Wall time.
    """
    next(make(1))  # compiles
    begin, trial = time.perf_counter(), 2
    next(make(trial))
    return max(1, int(seconds / BATCHES * trial / (time.perf_counter() - begin)))


def compare_scene(path: Path, arguments: argparse.Namespace, progress) -> Row:
    """Draws batches of both renderers in turn until the ratio of the means is known well enough."""
    name = path.resolve().parent.name
    scene = load_scene(path, warn=lambda message: progress(f"{name}: {message}"))
    columns = max(1, round(TILE_ROWS * scene.film.width / scene.film.height))
    tiles, side = (TILE_ROWS, columns), max(1, arguments.width // columns)
    width, height = columns * side, TILE_ROWS * side
    depth = min(scene.integrator.max_depth, arguments.max_depth)
    like_the_peer(scene, width, height, depth)
    integrator, notes, xml, own_sky = integrator_of(scene), [], path, None
    if arguments.clamp is not None:
        notes.append(f"samples clamped at {arguments.clamp:g}")
    if integrator != "path":
        notes.append(integrator)
    with tempfile.TemporaryDirectory(prefix="wavefront-peer-") as folder:
        if any(isinstance(emitter, description.SunSky) for emitter in scene.emitters):
            notes.append("sky baked by Mitsuba")
            own_sky = Renderer(scene, threads=arguments.threads, guide=None).render(spp=OWN_SKY_SAMPLES)
            baked = bake_sunsky(path, folder)
            scene, xml = replace_records(scene, baked), baked_xml(path, baked, Path(folder) / "baked.xml")
        theirs = peer.load_xml(xml, width, height)
        return _compare(name, scene, theirs, integrator, depth, tiles, ", ".join(notes), own_sky, arguments, progress)


def _compare(name, scene, theirs, integrator, depth, tiles, note, own_sky, arguments, progress) -> Row:
    film = scene.film
    seed = {"calls": 0}

    def our_source(spp):
        seed["calls"] += 1
        return source(our_batches, spp, scene, name=f"{name} {seed['calls']}", threads=arguments.threads)

    def their_source(spp):
        seed["calls"] += 1
        return source(their_batches, spp, theirs, max_depth=depth, seed=seed["calls"] << 14, integrator=integrator)

    def source(batches, spp, scene, **settings):
        if arguments.clamp is None:
            return batches(scene, spp=spp, **settings)
        return clamped(batches(scene, spp=1, **settings), spp, arguments.clamp)

    progress(f"{name}: {film.width}x{film.height}, depth {depth}: warming up")
    sides = [
        Side(make(spp), spp, tiles)
        for make in (our_source, their_source)
        for spp in [batch_samples(make, arguments.seconds / 2.0)]
    ]
    begin = time.perf_counter()
    while True:
        for one in sides:
            one.draw()
        if len(sides[0].means) < LEAST_BATCHES:
            continue
        comparison = Comparison(*(Estimate.from_batches(one.means) for one in sides), rounding_of(name))
        # When to stop depends on the standard error and the time, never on the difference.
        if comparison.ratio()[1] <= arguments.error or time.perf_counter() - begin > arguments.seconds:
            break
    progress(f"{name}: {comparison}")
    ours, peers = sides
    return Row(
        name,
        note,
        comparison,
        (ours.image, peers.image),
        own_sky,
        (ours.samples, peers.samples),
        (ours.seconds, peers.seconds),
    )


# --- what is shown -----------------------------------------------------------------------------------------------


def difference_picture(comparison: Comparison, shape: tuple[int, int]) -> np.ndarray:
    """Tiles in units of their standard error, 4 of them fully coloured: red where `a` is brighter; 8-bit [h, w, 3]."""
    error = comparison.error.mean(axis=2)
    difference = (comparison.a.tiles - comparison.b.tiles).mean(axis=2)
    z = np.clip(np.divide(difference, error, out=np.zeros_like(error), where=error > 0.0) / 4.0, -1.0, 1.0)
    fade = 1.0 - np.abs(z)
    colors = np.stack([np.where(z > 0, 1.0, fade), fade, np.where(z < 0, 1.0, fade)], axis=-1)
    rows, columns = error.shape
    return np.repeat(np.repeat((255 * colors).astype(np.uint8), shape[0] // rows, 0), shape[1] // columns, 1)


def exposure_of(image: np.ndarray) -> float:
    """Stops that bring the mean luminance of the lower 99 % of pixels to 0.2."""
    values = np.sort(image.mean(axis=2).ravel())
    mean = values[: max(1, int(0.99 * values.size))].mean()
    return float(np.log2(0.2 / max(mean, 1e-12)))


def picture(row: Row) -> np.ndarray:
    """Ours, Mitsuba's, the tiles' differences, and ours with our own sky, side by side, 8-bit [height, 4 width, 3]."""
    exposure = exposure_of(row.images[1])
    views = [tone_map(image, exposure) for image in row.images]
    views.append(difference_picture(row.comparison, views[0].shape[:2]))
    views.append(np.full_like(views[0], 255) if row.own_sky is None else tone_map(row.own_sky, exposure))
    return np.concatenate(views, axis=1)


def sheet(rows: list[Row]) -> Image.Image:
    """All pictures, one scene below the other, scaled to one width."""
    pictures = [Image.fromarray(picture(row)) for row in rows]
    width = SHEET_WIDTH
    pictures = [p.resize((width, round(p.height * width / p.width)), Image.Resampling.LANCZOS) for p in pictures]
    result = Image.new("RGB", (width, sum(p.height for p in pictures)))
    top = 0
    for one in pictures:
        result.paste(one, (0, top))
        top += one.height
    return result


COLUMNS = ("scene", "ours / Mitsuba", "95 % interval", "tiles passing", "smallest p", "finds", "spp, both", "verdict")


def cells(row: Row) -> tuple[str, ...]:
    """The row of the table."""
    ratio, error = row.comparison.ratio()
    low, high = row.comparison.interval()
    return (
        row.name + (f" ({row.note})" if row.note else ""),
        f"{ratio:.4f} ± {error:.4f}",
        f"{low:.4f} to {high:.4f}",
        f"{100.0 * row.tiles_passed:.1f} %",
        f"{row.comparison.smallest_p:.2g}",
        f"{100.0 * row.comparison.detectable():.1f} %",
        f"{row.samples[0]}, {row.samples[1]}",
        row.verdict,
    )


def markdown(rows: list[Row]) -> str:
    """The table for a README."""
    lines = [COLUMNS, ("---",) * len(COLUMNS), *(cells(row) for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def write(folder: Path, rows: list[Row], arguments: argparse.Namespace) -> None:
    """``table.md``, ``figures.json``, a picture per scene, and all in ``sheet.jpg``."""
    account = {
        "machine": machine(),
        "settings": {name: getattr(arguments, name) for name in SETTINGS},
        "scenes": [row.figures() for row in rows],
    }
    with replacing(folder / "table.md") as temporary:
        temporary.write_text(markdown(rows), encoding="utf-8")
    with replacing(folder / "figures.json") as temporary:
        temporary.write_text(json.dumps(account, indent=2) + "\n", encoding="utf-8")
    Image.fromarray(picture(rows[-1])).save(folder / f"{rows[-1].name}.png")
    sheet(rows).save(folder / "sheet.jpg", quality=90)


# --- the command -------------------------------------------------------------------------------------------------


def default_scenes() -> list[Path]:
    folder = os.environ.get("WAVEFRONT_SCENES")
    if not folder:
        raise WavefrontError("no scene given, and WAVEFRONT_SCENES names no folder of Mitsuba scenes")
    scenes = sorted(Path(folder).glob("*/scene.xml"))
    if not scenes:
        raise WavefrontError(f"{folder}: there is no */scene.xml")
    return scenes


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.compare_peer", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "scenes", nargs="*", type=Path, metavar="SCENE.xml", help="default: all in the folder WAVEFRONT_SCENES"
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("compare-peer"), metavar="FOLDER")
    parser.add_argument("--width", type=int, default=640, metavar="N", help="pixels, about; default 640")
    parser.add_argument("--max-depth", type=int, default=12, metavar="N", help="at most; default 12")
    parser.add_argument("--error", type=float, default=0.001, metavar="E", help="of the ratio; default 0.001")
    parser.add_argument("--seconds", type=float, default=240.0, metavar="S", help="per scene, at most; default 240")
    parser.add_argument("--clamp", type=float, default=None, metavar="C", help="radiance of a sample; default: none")
    parser.add_argument("--threads", type=int, default=None, metavar="N", help="of both; default: all cores")
    parser.add_argument("--variant", default=None, help="of Mitsuba; default llvm_ad_rgb where there is LLVM")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Compares all scenes; returns the exit status: 1 if one differs.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    for name, value in (("width", arguments.width), ("max-depth", arguments.max_depth), ("seconds", arguments.seconds)):
        if not value >= 1:
            raise WavefrontError(f"--{name} {value:g}; allowed: 1 or more")
    begin = time.perf_counter()

    def progress(message: str) -> None:
        print(f"[{time.perf_counter() - begin:6.1f} s] {message}", file=sys.stderr, flush=True)

    scenes = arguments.scenes or default_scenes()
    if arguments.variant is None:
        arguments.variant = "llvm_ad_rgb" if peer.missing("llvm_ad_rgb") is None else "scalar_rgb"
    peer.use_variant(arguments.variant, arguments.threads)
    arguments.output.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for path in scenes:
        rows.append(compare_scene(path, arguments, progress))
        write(arguments.output, rows, arguments)  # what is there is kept if a later scene fails
    table = Table(*COLUMNS, title=f"Ours and Mitsuba 3, {arguments.variant}", title_justify="left")
    for row in rows:
        table.add_row(*cells(row))
    Console(width=None if sys.stdout.isatty() else 160, highlight=False).print(table)
    return int(any(row.verdict == "differs" for row in rows))


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status: 0, 1 where a scene differs, or 2 after an error."""
    try:
        return run(build_parser().parse_args(argv))
    except (WavefrontError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
