"""Speed of rendering, beside Mitsuba 3 on the same machine, in the same run.

Every renderer has a process of its own. Rounds are interleaved, so that a slow minute of the machine hits all alike,
and compiling and warming up are timed apart. All render the same scene at the same size and depth: light sampling, no
Russian roulette, box filter, independent samples, the same number of threads. A peer that cannot run here is left out,
with the reason. A path is one camera ray with all that follows from it; a ray is one query, shadow rays too."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tools.bench_common import ROOT, Child, machine, megabytes, parse_counts, show, spread
from tools.peers import mitsuba as peer
from wavefront.errors import WavefrontError
from wavefront.render import parse_size
from wavefront.renderer import DEFAULT_MEMORY, MIN_CAPACITY

OURS = "wavefront"
PEERS = {"cpu": ("scalar_rgb", "llvm_ad_rgb"), "cuda": ("cuda_ad_rgb",)}
# Width, height and depth of scenes by name; those of others are `OTHERS`.
SETTINGS = {
    "cornell-box": (256, 256, 8),
    "veach-ajar": (320, 180, 10),
    "door-ajar": (320, 180, 10),
}
OTHERS = (320, 180, 10)
MOST_PATHS = 10**8
BYTES_PER_PATH = 1024  # more than their state takes


def default_scenes() -> list[Path]:
    """The real scenes where WAVEFRONT_SCENES names their folder, else our own like them."""
    folder = os.environ.get("WAVEFRONT_SCENES")
    if folder:
        return [Path(folder) / name / "scene.xml" for name in ("cornell-box", "veach-ajar")]
    return [ROOT / "scenes" / name for name in ("cornell-box.json", "door-ajar.json")]


def job_of(path: Path, arguments: argparse.Namespace) -> dict:
    """What every engine is told about a scene."""
    if not path.is_file():
        raise WavefrontError(f"{path}: file not found")
    name = path.stem if path.stem in SETTINGS or path.suffix == ".json" else path.resolve().parent.name
    width, height, max_depth = SETTINGS.get(name, OTHERS)
    width, height = arguments.size or (width, height)
    return {
        "name": name,
        "scene": str(path.resolve()),
        "width": width,
        "height": height,
        "max_depth": arguments.max_depth or max_depth,
        "threads": arguments.threads,
        "device": arguments.device,
    }


def bench_scene(job: dict, arguments: argparse.Namespace, progress) -> dict:
    """Measures all engines on a scene, rounds interleaved; returns the account of it."""
    engines = {OURS: {**job, "engine": OURS}}
    if arguments.device == "cpu" and arguments.threads > 1:
        engines[f"{OURS}, one thread"] = {**job, "engine": OURS, "threads": 1}
    for paths in arguments.paths:
        memory = DEFAULT_MEMORY + BYTES_PER_PATH * paths
        engines[f"{OURS}, {paths} paths"] = {**job, "engine": OURS, "paths_in_flight": paths, "memory": memory}
    for variant in PEERS["cpu" if arguments.device == "cpu" else "cuda"]:
        reason = peer.missing(variant)
        if reason is None:
            engines[f"mitsuba {variant}"] = {**job, "engine": variant}
        else:
            progress(f"mitsuba {variant} is left out: {reason}")
    account: dict = {key: job[key] for key in ("name", "scene", "width", "height", "max_depth")}
    account["engines"] = {}
    with ExitStack() as stack:
        children = {}
        for label, engine in engines.items():
            progress(f"{job['name']}: {label}: loading, warming up")
            child = stack.enter_context(Child("tools.bench_engine", engine))
            try:
                account["engines"][label] = {**child.ask({"do": "start"}), "measured": []}
                children[label] = child
            except WavefrontError as error:
                if engine["engine"] == OURS:
                    raise
                progress(f"{label} is left out: {error}")
        for number in range(arguments.rounds):
            for label, child in children.items():
                answer = child.ask({"do": "measure", "seconds": arguments.seconds})
                account["engines"][label]["measured"].append(answer)
                rate = answer["paths"] / answer["seconds"] / 1e6
                progress(f"{job['name']}: round {number + 1} of {arguments.rounds}: {label}: {rate:.3f} Mpaths/s")
        for label, child in children.items():
            account["engines"][label] |= child.ask({"do": "finish"})
    summarise(account)
    return account


def summarise(account: dict) -> None:
    """Adds rates, and ratios round by round, to the account of a scene."""
    for engine in account["engines"].values():
        measured = engine.pop("measured")
        engine["mpaths_per_second"] = spread([m["paths"] / m["seconds"] / 1e6 for m in measured])
        if all("rays" in m for m in measured):
            engine["mrays_per_second"] = spread([m["rays"] / m["seconds"] / 1e6 for m in measured])
    ours = account["engines"][OURS]["mpaths_per_second"]["rounds"]
    for label, engine in account["engines"].items():
        if label != OURS:
            theirs = engine["mpaths_per_second"]["rounds"]
            engine["ours_over_this"] = spread([a / b for a, b in zip(ours, theirs, strict=True)])


def bench_start(job: dict, progress) -> dict:
    """Compile time and time to the first image, with an empty kernel cache and with a full one, seconds."""
    account = {}
    with tempfile.TemporaryDirectory(prefix="wavefront-bench-") as folder:
        for state in ("cold", "cached"):
            progress(f"{job['name']}: compiling, {state}")
            environment = {"WARP_CACHE_PATH": str(Path(folder) / "kernels")}
            with Child("tools.bench_engine", {**job, "engine": OURS}, environment) as child:
                account[f"compile_{state}"] = child.ask({"do": "start"})["compile_seconds"]
        for state in ("cold", "cached"):
            progress(f"{job['name']}: first image, {state}")
            account[f"first_image_{state}"] = _first_image(job, Path(folder))
    return account


def _first_image(job, folder):
    command = [sys.executable, "-m", "wavefront.render", job["scene"], "--size", "64x64", "--spp", "1", "--quiet"]
    command += ["-o", str(folder / "first.exr"), "--device", job["device"]]
    if job["device"] == "cpu":
        command += ["--threads", str(job["threads"])]
    environment = {**os.environ, "WARP_CACHE_PATH": str(folder / "kernels-of-first-image")}
    begin = time.perf_counter()
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, encoding="utf-8", check=False)
    if done.returncode:
        raise WavefrontError(f"the first image failed: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    return time.perf_counter() - begin


# --- tables ------------------------------------------------------------------------------------------------------


def scene_table(account: dict) -> Table:
    title = "{name}, {width} x {height}, depth {max_depth}: median (least to most) of the rounds".format(**account)
    table = Table(title=title, title_justify="left")
    table.add_column("engine")
    for name in ("Mpaths/s", "Mrays/s", "ours / this", "load s", "compile s", "peak memory", "mean radiance"):
        table.add_column(name, justify="right")
    for label, engine in account["engines"].items():
        table.add_row(
            label,
            show(engine["mpaths_per_second"]),
            show(engine["mrays_per_second"]) if "mrays_per_second" in engine else "",
            show(engine["ours_over_this"]) if "ours_over_this" in engine else "",
            f"{engine['load_seconds']:.2f}",
            f"{engine['compile_seconds']:.2f}",
            megabytes(engine["peak_memory_bytes"]),
            f"{engine['mean']:.5f}",
        )
    return table


def stage_table(scenes: list[dict]) -> Table:
    table = Table(title="wavefront: share of each stage, summed over workers", title_justify="left")
    table.add_column("stage")
    shares = []
    for account in scenes:
        table.add_column(account["name"], justify="right")
        seconds = account["engines"][OURS]["stage_seconds"]
        total = max(sum(seconds.values()), 1e-12)
        shares.append({stage: 100.0 * value / total for stage, value in seconds.items()})
    for stage in dict.fromkeys(stage for share in shares for stage in share):
        table.add_row(stage, *(f"{share[stage]:.1f} %" if stage in share else "" for share in shares))
    table.add_section()
    table.add_row("bytes per path", *(str(account["engines"][OURS]["bytes_per_path"]) for account in scenes))
    return table


def print_report(account: dict, console: Console) -> None:
    """The tables and lines on standard output."""
    m = account["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in m["versions"].items())
    console.print(f"{m['cpu']}, {m['cores']} cores, load {m['load']}, {m['system']}; Python {m['python']}, {versions}")
    for scene in account["scenes"]:
        console.print(scene_table(scene))
    console.print(stage_table(account["scenes"]))
    if "start" in account:
        s = account["start"]
        console.print(
            f"{account['scenes'][0]['name']}: kernels compile in {s['compile_cold']:.1f} s "
            f"({s['compile_cached']:.2f} s cached); first image, 64 x 64 at 1 spp, whole process: "
            f"{s['first_image_cold']:.1f} s ({s['first_image_cached']:.2f} s cached)"
        )


# --- the command -------------------------------------------------------------------------------------------------


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench_render", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "scenes",
        nargs="*",
        type=Path,
        metavar="SCENE",
        help="scene.json or scene.xml; default: cornell-box and veach-ajar in the folder that WAVEFRONT_SCENES names, "
        "or our own cornell-box and door-ajar",
    )
    parser.add_argument("--threads", type=int, default=2, metavar="N", help="of every renderer; default 2")
    parser.add_argument("--seconds", type=float, default=5.0, metavar="S", help="of each measurement; default 5")
    parser.add_argument("--rounds", type=int, default=3, metavar="N", help="measurements of each; default 3")
    parser.add_argument("--size", type=parse_size, metavar="WxH", help="film size; default: 256x256 or 320x180")
    parser.add_argument("--max-depth", type=int, metavar="N", help="longest path in segments; default: 8 or 10")
    parser.add_argument("--device", default="cpu", help="cpu (default), cuda or cuda:N")
    parser.add_argument(
        "--paths",
        type=lambda text: parse_counts(text, MIN_CAPACITY, MOST_PATHS),
        default=[],
        metavar="N,...",
        help="also render with as many paths in flight, such as 1e5,1e6,1e7",
    )
    parser.add_argument("--no-start", action="store_true", help="leave out compile time and the first image")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Measures and reports; returns the exit status.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    for name, value, least in (("--threads", arguments.threads, 1), ("--rounds", arguments.rounds, 1)):
        if value < least:
            raise WavefrontError(f"{name} {value}; allowed: {least} or more")
    if not 0.0 < arguments.seconds < 3600.0:
        raise WavefrontError(f"--seconds {arguments.seconds:g}; allowed: more than 0, less than 3600")
    fewest = MIN_CAPACITY * (arguments.threads if arguments.device == "cpu" else 1)
    if arguments.paths and min(arguments.paths) < fewest:
        raise WavefrontError(f"--paths {min(arguments.paths)}; allowed: {fewest} or more with these threads")
    if arguments.max_depth is not None and arguments.max_depth < 1:
        raise WavefrontError(f"--max-depth {arguments.max_depth}; allowed: 1 or more")
    if arguments.json and not arguments.json.resolve().parent.is_dir():
        raise WavefrontError(f"--json {arguments.json}: there is no such folder")
    begin = time.perf_counter()

    def progress(message: str) -> None:
        print(f"[{time.perf_counter() - begin:6.1f} s] {message}", file=sys.stderr, flush=True)

    jobs = [job_of(path, arguments) for path in arguments.scenes or default_scenes()]
    account = {
        "machine": machine(),
        "settings": {name: getattr(arguments, name) for name in ("threads", "seconds", "rounds", "device")},
        "scenes": [],
    }
    for job in jobs:
        account["scenes"].append(bench_scene(job, arguments, progress))
    if not arguments.no_start:
        account["start"] = bench_start(jobs[0], progress)
    # A pipe or a file has no width; the widest table needs this much.
    print_report(account, Console(width=None if sys.stdout.isatty() else 160, highlight=False))
    if arguments.json:
        arguments.json.write_text(json.dumps(account, indent=2) + "\n", encoding="utf-8")
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
