"""What the samplers are worth: error against samples per pixel of each, and what a sample costs.

Every sampler renders a scene with several seeds, alternating with the others in one process. The error is the standard
deviation of a pixel between seeds, the root of its mean square over pixels and channels, relative to the mean radiance;
it needs no reference. The order is the slope of log error over log samples, -0.5 for independent samples. The cost is
the processor time of a sample relative to an independent one, as the median over pairs of renders.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from tools.bench_common import ROOT, machine, show, spread
from wavefront import Renderer, load_scene
from wavefront.errors import WavefrontError
from wavefront.output import check_writable
from wavefront.render import parse_size
from wavefront.sampler import SAMPLERS
from wavefront.scene.images import replacing

BASELINE = "independent"
ORDER_FROM = 4  # samples per pixel from which the slope is fitted


def sample_counts(most: int) -> list[int]:
    """Powers of four up to a number of samples, and that number."""
    counts = [4**k for k in range(16) if 4**k < most]
    return [*counts, most]


def order(counts: list[int], errors: list[float]) -> float:
    """Slope of log error over log samples, by least squares."""
    used = [(n, e) for n, e in zip(counts, errors, strict=True) if n >= ORDER_FROM and e > 0.0]
    if len(used) < 2:
        return float("nan")
    x, y = np.log(np.array(used)).T
    return float(np.polyfit(x, y, 1)[0])


def measure(path: Path, arguments: argparse.Namespace, progress) -> dict:
    """Renders a scene with every sampler and seed; returns the account of it.

    Raises:
        WavefrontError: The scene cannot be rendered, or is black.
    """
    width, height = arguments.size
    overrides = [f"film.width={width}", f"film.height={height}", *arguments.set]
    scenes = {name: load_scene(path, [*overrides, f"integrator.sampler={name}"]) for name in SAMPLERS}
    counts = sample_counts(arguments.spp)
    images = {name: [] for name in SAMPLERS}  # [seeds][counts] of [h, w, 3]
    seconds = {name: [] for name in SAMPLERS}  # of all threads, for a sample after the first ones
    for seed in range(arguments.seeds):
        names = list(SAMPLERS) if seed % 2 == 0 else list(SAMPLERS)[::-1]
        for name in names:
            renderer = Renderer(scenes[name], threads=arguments.threads, seed=seed, guide=None)
            renderer.render(counts[0])
            stack, begin = [renderer.film.image().astype(np.float64)], time.process_time()
            for n in counts[1:]:
                stack.append(renderer.render(n - renderer.sample_count).astype(np.float64))
            seconds[name].append((time.process_time() - begin) / (counts[-1] - counts[0]))
            images[name].append(stack)
        progress(f"{path.stem}: seed {seed + 1} of {arguments.seeds}")
    mean = float(np.mean([stack[-1] for stack in images[BASELINE]]))
    if not mean > 0.0:
        raise WavefrontError(f"{path}: the image is black; nothing can be measured")
    account = {"name": path.stem, "scene": str(path), "width": width, "height": height, "spp": counts, "samplers": {}}
    for name in SAMPLERS:
        variances = np.var(np.array(images[name]), axis=0, ddof=1).mean(axis=(1, 2, 3))
        errors = [float(e) for e in np.sqrt(variances) / mean]
        ratios = [a / b for a, b in zip(seconds[name], seconds[BASELINE], strict=True)]
        account["samplers"][name] = {"error": errors, "order": order(counts, errors), "cost": spread(ratios)}
    baseline = account["samplers"][BASELINE]["error"]
    for sampler in account["samplers"].values():
        pairs = zip(baseline, sampler["error"], strict=True)
        sampler["variance_ratio"] = [(a / b) ** 2 if b > 0.0 else None for a, b in pairs]
    return account


def scene_table(account: dict) -> Table:
    table = Table(title="{name}, {width} x {height}: relative error".format(**account), title_justify="left")
    table.add_column("samples per pixel")
    samplers = account["samplers"]
    for name in samplers:
        table.add_column(name, justify="right")
    for name in samplers:
        if name != BASELINE:
            table.add_column(f"variance, {BASELINE} / {name}", justify="right")
    for i, n in enumerate(account["spp"]):
        errors = [f"{sampler['error'][i]:.3g}" for sampler in samplers.values()]
        ratios = [sampler["variance_ratio"][i] for name, sampler in samplers.items() if name != BASELINE]
        table.add_row(str(n), *errors, *("" if ratio is None else f"{ratio:.3g}" for ratio in ratios))
    table.add_row("order", *(f"{sampler['order']:.2f}" for sampler in samplers.values()))
    table.add_row("cost of a sample", *(show(sampler["cost"]) for sampler in samplers.values()))
    return table


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench_samplers", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", type=Path, metavar="SCENE", help="default: cornell-box and door-ajar")
    parser.add_argument("--spp", type=int, default=256, metavar="N", help="most samples per pixel; default 256")
    parser.add_argument("--seeds", type=int, default=8, metavar="N", help="renders of each sampler; default 8")
    parser.add_argument("--size", type=parse_size, default="64x64", metavar="WxH", help="default 64x64")
    parser.add_argument("--threads", type=int, metavar="N", help="default: all cores")
    parser.add_argument(
        "--set", action="append", default=[], metavar="PATH=VALUE", help="change any key, as in integrator.max_depth=2"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Measures and reports; returns the exit status.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    if arguments.seeds < 2:
        raise WavefrontError(f"--seeds {arguments.seeds}; allowed: 2 or more, between which the error is measured")
    if arguments.spp < 2:
        raise WavefrontError(f"--spp {arguments.spp}; allowed: 2 or more")
    if arguments.json:
        check_writable(arguments.json)
    begin = time.perf_counter()

    def progress(message: str) -> None:
        print(f"[{time.perf_counter() - begin:6.1f} s] {message}", file=sys.stderr, flush=True)

    paths = arguments.scenes or [ROOT / "scenes" / f"{name}.json" for name in ("cornell-box", "door-ajar")]
    account = {"machine": machine(), "scenes": [measure(path, arguments, progress) for path in paths]}
    console = Console(width=None if sys.stdout.isatty() else 160, highlight=False)
    for scene in account["scenes"]:
        console.print(scene_table(scene))
    if arguments.json:
        with replacing(arguments.json) as temporary:
            temporary.write_text(json.dumps(account, indent=2) + "\n", encoding="utf-8")
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status: 0, or 2 after an error, of which one line is printed."""
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
