"""The command: ``python -m wavefront.render SCENE``."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

import wavefront
from wavefront.errors import WavefrontError
from wavefront.output import check_not_read, check_writable, describe_render, write_outputs
from wavefront.renderer import Renderer
from wavefront.scene import json_format, load_scene

EXIT_ERROR = 2
EXIT_INTERRUPTED = 130

DESCRIPTION = """\
Render a scene: our own scene.json (see --schema), Mitsuba's scene.xml, or glTF.

Writes OUT.exr (linear radiance, and the AOVs asked for), OUT.png (the same, for the eye) and OUT.json (settings,
versions, times and counts)."""

EXAMPLES = """\
examples:
  python -m wavefront.render scenes/cornell-box.json
  python -m wavefront.render scene.xml -o out.exr --spp 256 --size 640x360 --aov albedo,normal
  python -m wavefront.render scene.json --time 60 --set integrator.max_depth=6 --set film.filter.type=tent"""


def parse_memory(text: str) -> int:
    """Bytes from a number with an optional suffix K, M, G or T (powers of 1024)."""
    factors = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
    suffix = text[-1:].upper()
    try:
        value = float(text[:-1]) * factors[suffix] if suffix in factors else float(text)
        if value >= 1.0:
            return int(value)
    except (ValueError, OverflowError):
        pass
    raise argparse.ArgumentTypeError(f"{text!r} is not an amount of memory; allowed: a number of bytes, or 512M, 2G, …")


def parse_size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isascii() and width.isdigit() and height.isascii() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size; allowed: WIDTHxHEIGHT, such as 640x360")
    return int(width), int(height)


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m wavefront.render",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", nargs="?", metavar="SCENE", help="scene.json, scene.xml, or scene.gltf or .glb")
    parser.add_argument("--schema", action="store_true", help="print the JSON Schema of the scene format and exit")
    parser.add_argument("--version", action="version", version=f"wavefront {wavefront.__version__}")

    output = parser.add_argument_group("output")
    output.add_argument("-o", "--output", metavar="OUT.exr", help="default: the scene's name, in the current folder")
    output.add_argument("--size", type=parse_size, metavar="WxH", help="film size in pixels")
    output.add_argument("--aov", metavar="A,B", help="extra channels: albedo, normal, depth, variance (of the mean)")
    output.add_argument("--half", action="store_true", help="16-bit floats; a value that overflows is an error")
    output.add_argument("--exposure", type=float, default=0.0, metavar="STOPS", help="of the PNG only; default 0")

    sampling = parser.add_argument_group("sampling")
    budget = sampling.add_mutually_exclusive_group()
    budget.add_argument("--spp", type=int, metavar="N", help="samples per pixel; default: the scene's")
    budget.add_argument("--time", type=float, metavar="S", help="render for S seconds instead")
    sampling.add_argument("--max-depth", type=int, metavar="N", help="longest path in segments; 2 is direct light")
    sampling.add_argument("--no-nee", action="store_true", help="no next-event estimation: BSDF sampling alone")
    sampling.add_argument("--no-rr", action="store_true", help="no Russian roulette")
    sampling.add_argument("--seed", type=int, default=0, metavar="N", help="of the random numbers; default 0")
    sampling.add_argument(
        "--set", action="append", default=[], metavar="PATH=VALUE", help="change any key, as in integrator.max_depth=6"
    )
    sampling.add_argument(
        "--define",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="value of a $NAME of a Mitsuba scene; camera=NAME or scene=NAME of a glTF file",
    )

    machine = parser.add_argument_group("machine")
    machine.add_argument("--device", default="cpu", help="cpu (default), cuda or cuda:N")
    machine.add_argument("--threads", type=int, metavar="N", help="workers on the CPU device; default: all cores")
    machine.add_argument(
        "--memory", type=parse_memory, default="4G", metavar="SIZE", help="budget for film and paths; default 4G"
    )
    machine.add_argument("--profile", action="store_true", help="print the time of every stage")
    machine.add_argument("--quiet", action="store_true", help="print errors only")
    return parser


def overrides_from(arguments: argparse.Namespace) -> list[str]:
    """The settings on the command line as overrides of the scene's keys; `--set` comes last and wins."""
    overrides = []
    if arguments.size:
        overrides += [f"film.width={arguments.size[0]}", f"film.height={arguments.size[1]}"]
    if arguments.aov is not None:
        overrides.append(f"film.aovs={json.dumps([name for name in arguments.aov.split(',') if name])}")
    if arguments.half:
        overrides.append("film.precision=half")
    if arguments.max_depth is not None:
        overrides.append(f"integrator.max_depth={arguments.max_depth}")
    if arguments.no_nee:
        overrides.append("integrator.nee=false")
    if arguments.no_rr:
        overrides.append("integrator.rr_depth=null")
    if arguments.spp is not None:
        overrides.append(f"integrator.spp={arguments.spp}")
    return overrides + arguments.set


def definitions_from(arguments: argparse.Namespace) -> dict[str, str]:
    definitions = {}
    for text in arguments.define:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise WavefrontError(f"--define {text!r}; allowed: NAME=VALUE")
        definitions[name] = value
    return definitions


class Interrupt:
    """Ctrl-C asks the render to stop after its pass; a second one ends the program at once."""

    def __init__(self, console: Console):
        self.requested, self.console = False, console

    def __enter__(self):
        self.previous = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_):
        signal.signal(signal.SIGINT, self.previous)

    def _handle(self, *_):
        self.requested = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self.console.print("stopping after this pass; Ctrl-C again to stop without saving")


def run_with_progress(renderer: Renderer, console: Console, spp: int | None, seconds: float | None) -> bool:
    """Renders with a progress bar; returns whether it was interrupted."""
    columns = (
        TextColumn("{task.fields[spp]}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %  {task.fields[rate]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    film, workers = renderer.scene.film, f" with {renderer.threads} threads" if renderer.device == "cpu" else ""
    with Interrupt(console) as interrupt, Progress(*columns, console=console) as progress:
        console.print(f"rendering {film.width}x{film.height} on {renderer.device}{workers}", highlight=False)
        task = progress.add_task("", total=seconds or spp, spp="0 spp", rate="")

        def update(r: Renderer) -> bool:
            s = r.statistics
            rate = (s.rays + s.shadow_rays) / max(s.render_seconds, 1e-9)
            completed = min(s.render_seconds, seconds) if seconds else s.sample_count
            wanted = "" if seconds else f"/{spp}"
            progress.update(
                task, completed=completed, spp=f"{s.sample_count}{wanted} spp", rate=f"{rate / 1e6:.2f} Mrays/s"
            )
            return interrupt.requested

        renderer.render(spp=spp, seconds=seconds, callback=update)
        return interrupt.requested


def print_profile(renderer: Renderer, console: Console) -> None:
    """The table of `--profile`."""
    stages = renderer.statistics.stage_seconds
    total = sum(stages.values())
    table = Table(title="Time by stage, summed over workers")
    table.add_column("stage")
    for name in ("seconds", "share", "ns / path"):
        table.add_column(name, justify="right")
    for stage, value in stages.items():
        per_path = 1e9 * value / max(renderer.statistics.paths, 1)
        table.add_row(stage, f"{value:.3f}", f"{100.0 * value / max(total, 1e-12):.1f} %", f"{per_path:.1f}")
    table.add_row("all", f"{total:.3f}", "", f"{1e9 * total / max(renderer.statistics.paths, 1):.1f}")
    console.print(table)


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Renders as the command line says; returns the exit status.

    Raises:
        WavefrontError: With the one line that the user needs.
    """

    def warn(message: str) -> None:
        console.print(f"warning: {message}", markup=False, highlight=False, soft_wrap=True)

    started = time.perf_counter()
    seconds = arguments.time
    if arguments.spp is not None and arguments.spp < 1:
        raise WavefrontError(f"--spp {arguments.spp}; allowed: 1 or more")
    if seconds is not None and not 0.0 < seconds < float("inf"):
        raise WavefrontError(f"--time {seconds:g}; allowed: more than 0")
    output = Path(arguments.output or Path(arguments.scene).with_suffix(".exr").name)
    check_writable(output)
    scene = load_scene(arguments.scene, overrides_from(arguments), definitions_from(arguments), warn)
    check_not_read(output, arguments.scene, scene)
    renderer = Renderer(
        scene,
        device=arguments.device,
        threads=arguments.threads,
        memory=arguments.memory,
        seed=arguments.seed,
        profile=arguments.profile,
        on_compile=lambda message: console.print(message, highlight=False),
    )
    for note in renderer.device_scene.notes:
        warn(note)
    spp = None if seconds else scene.integrator.spp
    interrupted = run_with_progress(renderer, console, spp, seconds)
    write_outputs(output, renderer, arguments.exposure, describe_render(renderer, arguments.scene, started))
    for stage, count in renderer.statistics.nonfinite.items():
        if count:
            warn(f"{count} contributions of the {stage} stage were not finite or negative, and were left out")
    if arguments.profile:
        print_profile(renderer, console)
    s = renderer.statistics
    console.print(
        f"{output}: {s.sample_count} samples per pixel in {s.render_seconds:.1f} s"
        + (" (interrupted)" if interrupted else ""),
        highlight=False,
        soft_wrap=True,
    )
    return EXIT_INTERRUPTED if interrupted else 0


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    parser = build_parser()
    arguments = parser.parse_args(argv)
    if arguments.schema:
        print(json.dumps(json_format.schema(), indent=2))
        return 0
    if arguments.scene is None:
        parser.error("a scene is missing: python -m wavefront.render SCENE")
    console = Console(stderr=True, quiet=arguments.quiet)
    try:
        return run(arguments, console)
    except WavefrontError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_ERROR
    except KeyboardInterrupt:
        print("interrupted: nothing was saved", file=sys.stderr)
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
