"""The command: ``python -m wavefront.render SCENE``."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

import wavefront
from wavefront.accel.intersector import ACCELS
from wavefront.checkpoint import CheckpointError, CheckpointWriter
from wavefront.errors import WavefrontError
from wavefront.film import CHANNELS
from wavefront.guide import Guide
from wavefront.guide_file import load_guide, save_guide
from wavefront.guide_options import add_guide_options, check_guide_files, guide_overrides, in_words, make_guide
from wavefront.output import (
    check_image_path,
    check_not_read,
    check_writable,
    describe_render,
    output_paths,
    write_outputs,
)
from wavefront.presets import NAMES, load_preset
from wavefront.renderer import Renderer
from wavefront.sampler import SAMPLERS
from wavefront.scene import Scene, json_format, load_scene
from wavefront.scene.images import HalfOverflowError
from wavefront.strict import NonFiniteError

EXIT_ERROR = 2
EXIT_SIGNAL = 128  # plus the number of the signal
CHECKPOINT_SECONDS = 300.0

DESCRIPTION = """\
Render a scene: our own scene.json (see --schema), Mitsuba's scene.xml, or glTF.

Writes OUT.exr (linear radiance, and the AOVs asked for), OUT.png (the same, for the eye) and OUT.json (settings,
versions, times and counts)."""

EXAMPLES = """\
examples:
  python -m wavefront.render scenes/cornell-box.json
  python -m wavefront.render scene.xml -o out.exr --spp 256 --size 640x360 --aov albedo,normal
  python -m wavefront.render scene.json --time 60 --set integrator.max_depth=6 --set film.filter.type=tent
  python -m wavefront.render scene.json --spp 100000 --checkpoint night --resume night
  python -m wavefront.render scene.json --pixel 120,60 --sample 3 --trace"""


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


def parse_crop(text: str) -> tuple[int, ...]:
    """Width, height, x and y of a window."""
    match = re.fullmatch(r"([0-9]+)x([0-9]+)\+([0-9]+)\+([0-9]+)", text.lower())
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a window; allowed: WIDTHxHEIGHT+X+Y, such as 64x48+100+20")
    return tuple(map(int, match.groups()))


def parse_pixel(text: str) -> tuple[int, int]:
    x, _, y = text.partition(",")
    if not (x.isascii() and x.isdigit() and y.isascii() and y.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a pixel; allowed: X,Y, such as 12,7")
    return int(x), int(y)


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
    output.add_argument(
        "--crop",
        type=parse_crop,
        metavar="WxH+X+Y",
        help="render a window of the film, X,Y being its upper left corner",
    )
    output.add_argument("--aov", metavar="A,B", help=f"extra channels: {', '.join(CHANNELS)}")
    output.add_argument("--half", action="store_true", help="16-bit floats; a value that overflows is an error")
    output.add_argument("--exposure", type=float, default=0.0, metavar="STOPS", help="of the PNG only; default 0")

    sampling = parser.add_argument_group("sampling")
    sampling.add_argument(
        "--preset",
        metavar="NAME",
        help=f"{', '.join(NAMES)}: measured settings in place of the scene's; other options win",
    )
    budget = sampling.add_mutually_exclusive_group()
    budget.add_argument("--spp", type=int, metavar="N", help="samples per pixel; default: the scene's")
    budget.add_argument("--time", type=float, metavar="S", help="render for S seconds instead")
    sampling.add_argument("--max-depth", type=int, metavar="N", help="longest path in segments; 2 is direct light")
    sampling.add_argument("--no-nee", action="store_true", help="no next-event estimation: BSDF sampling alone")
    sampling.add_argument("--no-rr", action="store_true", help="no Russian roulette")
    sampling.add_argument("--sampler", choices=SAMPLERS, help="of the random numbers; default: the scene's")
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

    add_guide_options(parser)

    long = parser.add_argument_group("long renders")
    long.add_argument("--checkpoint", metavar="FILE", help="save what a later --resume needs, from time to time")
    long.add_argument("--every", type=float, metavar="S", help="seconds between checkpoints; default 300")
    long.add_argument(
        "--resume",
        metavar="FILE",
        help="go on from a checkpoint, up to --spp in total or for --time more; "
        "with --checkpoint of the same FILE, a missing one is a render that begins",
    )

    path = parser.add_argument_group(
        "one path", "Added to the command of a render: traces a path of it again, in place of rendering and writing."
    )
    path.add_argument("--pixel", type=parse_pixel, metavar="X,Y", help="print the radiance of one sample of a pixel")
    path.add_argument("--sample", type=int, metavar="N", help="which one; default 0")
    path.add_argument("--trace", action="store_true", help="print the path, vertex by vertex")
    path.add_argument("--json", action="store_true", help="print the path as JSON")

    machine = parser.add_argument_group("machine")
    machine.add_argument("--device", default="cpu", help="cpu (default), cuda or cuda:N")
    machine.add_argument(
        "--accel", choices=ACCELS, default="bvh", help="how rays find triangles; mesh: queries of wp.Mesh, a reference"
    )
    machine.add_argument("--threads", type=int, metavar="N", help="workers on the CPU device; default: all cores")
    machine.add_argument(
        "--paths-in-flight", type=int, metavar="N", help="most paths at a time; default: by the device"
    )
    machine.add_argument(
        "--memory",
        type=parse_memory,
        default="4G",
        metavar="SIZE",
        help="most memory: of the process (cpu), of film and paths (cuda); default 4G",
    )
    machine.add_argument(
        "--strict", action="store_true", help="a contribution that is not finite is an error that names its path"
    )
    machine.add_argument("--profile", action="store_true", help="print the time of every stage")
    machine.add_argument("--quiet", action="store_true", help="print errors only")
    return parser


def overrides_from(arguments: argparse.Namespace) -> list[str]:
    """The settings on the command line as overrides of the scene's keys: a preset comes first, `--set` last and wins.

    Raises:
        WavefrontError: There is no such preset.
    """
    overrides = load_preset(arguments.preset).overrides if arguments.preset is not None else []
    if arguments.size:
        overrides += [f"film.width={arguments.size[0]}", f"film.height={arguments.size[1]}"]
    if arguments.crop:
        overrides.append(
            "film.crop=" + json.dumps(dict(zip(("width", "height", "x", "y"), arguments.crop, strict=True)))
        )
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
    if arguments.sampler is not None:
        overrides.append(f"integrator.sampler={arguments.sampler}")
    if arguments.spp is not None:
        overrides.append(f"integrator.spp={arguments.spp}")
    return overrides + guide_overrides(arguments) + arguments.set


def definitions_from(arguments: argparse.Namespace) -> dict[str, str]:
    definitions = {}
    for text in arguments.define:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise WavefrontError(f"--define {text!r}; allowed: NAME=VALUE")
        definitions[name] = value
    return definitions


class Interrupt:
    """Ctrl-C, or SIGTERM as clusters send it, asks the render to stop after its pass; a second one ends the program."""

    def __init__(self, console: Console):
        self.requested, self.console = 0, console  # the signal's number

    def __enter__(self):
        self.previous = {number: signal.signal(number, self._handle) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_):
        for number, handler in self.previous.items():
            signal.signal(number, handler)

    def _handle(self, number, _):
        self.requested = number
        signal.signal(number, self.previous[number])
        self.console.print("stopping after this pass; Ctrl-C again to stop without saving")


def run_with_progress(
    renderer: Renderer,
    console: Console,
    spp: int | None,
    seconds: float | None,
    checkpoints: CheckpointWriter | None = None,
) -> int:
    """Renders up to `spp` samples per pixel in total, or for `seconds` from now, with a progress bar.

    Returns:
        The number of the signal that interrupted it, or 0.
    """
    if spp is not None and spp <= renderer.sample_count:
        return 0
    begun = renderer.statistics.render_seconds  # of earlier processes
    columns = (
        TextColumn("{task.fields[spp]}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %  {task.fields[rate]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        *([TextColumn("{task.fields[guide]}", markup=False)] if renderer.guide else []),
    )
    film, workers = renderer.film, ""
    if renderer.device == "cpu":
        workers = f" with {renderer.threads} thread{'s' * (renderer.threads != 1)}"
    with Interrupt(console) as interrupt, Progress(*columns, console=console) as progress:
        console.print(
            f"rendering {film.width}x{film.height} on {renderer.device}{workers}; {renderer.bytes_per_pixel} bytes per "
            f"pixel, {renderer.bytes_per_path} per path, {renderer.capacity * renderer.threads} paths in flight",
            highlight=False,
            soft_wrap=True,
        )
        task = progress.add_task("", total=seconds or spp, spp="0 spp", rate="", guide="")

        def update(r: Renderer) -> bool:
            s = r.statistics
            rate = (s.rays + s.shadow_rays) / max(s.render_seconds, 1e-9)
            completed = min(s.render_seconds - begun, seconds) if seconds else s.sample_count
            wanted = "" if seconds else f"/{spp}"
            progress.update(
                task,
                completed=completed,
                spp=f"{s.sample_count}{wanted} spp",
                rate=f"{rate / 1e6:.2f} Mrays/s",
                guide=r.guide.progress() if r.training else "",
            )
            if checkpoints is not None:
                checkpoints.after_pass()
            return bool(interrupt.requested)

        renderer.add_samples(spp=spp and spp - renderer.sample_count, seconds=seconds, callback=update)
        return interrupt.requested


def check_checkpoints(arguments: argparse.Namespace, output: Path) -> tuple[Path | None, Path | None]:
    """The checkpoint to resume from and the one to write, either of which may be None.

    Raises:
        WavefrontError: A missing file, one that would be lost, or one that cannot be written.
    """
    checkpoint, resume = (Path(name) if name else None for name in (arguments.checkpoint, arguments.resume))
    if checkpoint is None:
        if arguments.every is not None:
            raise WavefrontError("--every is for --checkpoint, which is missing")
    else:
        if arguments.every is not None and not arguments.every > 0.0:
            raise WavefrontError(f"--every {arguments.every:g}; allowed: more than 0")
        if checkpoint in output_paths(output):
            raise WavefrontError(f"{checkpoint}: the checkpoint would replace the image; choose another name")
        same = resume is not None and os.path.realpath(resume) == os.path.realpath(checkpoint)
        if same:
            resume = checkpoint if checkpoint.exists() else None
        elif checkpoint.exists():
            raise WavefrontError(
                f"{checkpoint}: exists; to go on from it, add --resume {checkpoint}; to begin again, remove it"
            )
        check_writable(checkpoint)
    if resume is not None and not resume.is_file():
        raise WavefrontError(f"{resume}: there is no such checkpoint to resume from")
    return resume, checkpoint


def rescue(renderer: Renderer, output: Path, checkpoints: CheckpointWriter | None) -> str:
    """Where the samples are after the image could not be written: the end of the error message."""
    if checkpoints is not None and checkpoints.saved_samples == renderer.sample_count:
        return f"nothing is lost: --resume {checkpoints.path} writes it"
    name = f"{output.stem}.{os.getpid()}.checkpoint"
    for place in (output.with_name(name), Path(tempfile.gettempdir()) / name):
        with contextlib.suppress(CheckpointError):
            renderer.save_checkpoint(place)
            return f"nothing is lost: --resume {place} writes it"
    if checkpoints is not None and checkpoints.saved_samples:
        saved = f"{checkpoints.saved_samples} of {renderer.sample_count} samples"
        return f"--resume {checkpoints.path} goes on from {saved}"
    return "and no checkpoint could be written either"


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


def make_renderer(arguments: argparse.Namespace, scene: Scene, guide: Guide | None, console: Console) -> Renderer:
    """The renderer of a scene as the command line says."""
    return Renderer(
        scene,
        device=arguments.device,
        threads=arguments.threads,
        memory=arguments.memory,
        whole_process=True,
        seed=arguments.seed,
        strict=arguments.strict,
        profile=arguments.profile,
        on_compile=lambda message: console.print(message, highlight=False),
        guide=guide,
        accel=arguments.accel,
        paths_in_flight=arguments.paths_in_flight,
    )


def run_trace(arguments: argparse.Namespace, console: Console, warn: Callable[[str], None]) -> int:
    """Prints one path; returns the exit status.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    scene = load_scene(arguments.scene, overrides_from(arguments), definitions_from(arguments), warn)
    renderer = make_renderer(arguments, scene, make_guide(scene, arguments), console)
    trace = renderer.trace(*arguments.pixel, arguments.sample or 0)
    if arguments.json:
        print(trace.to_json())
    elif arguments.trace:
        Console(highlight=False).print(trace.to_table())
    else:
        print(*(f"{value:.9g}" for value in trace.L))
    return 0


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Renders as the command line says; returns the exit status.

    Raises:
        WavefrontError: With the one line that the user needs.
    """

    def warn(message: str) -> None:
        console.print(f"warning: {message}", markup=False, highlight=False, soft_wrap=True)

    if arguments.pixel is not None:
        return run_trace(arguments, console, warn)
    for option in ("sample", "trace", "json"):
        value = getattr(arguments, option)
        if value is not None and value is not False:
            raise WavefrontError(f"--{option} is for --pixel, which is missing")
    started = time.perf_counter()
    seconds = arguments.time
    if arguments.spp is not None and arguments.spp < 1:
        raise WavefrontError(f"--spp {arguments.spp}; allowed: 1 or more")
    if seconds is not None and not 0.0 < seconds < float("inf"):
        raise WavefrontError(f"--time {seconds:g}; allowed: more than 0")
    output = Path(arguments.output or Path(arguments.scene).with_suffix(".exr").name)
    check_image_path(output)
    resume, checkpoint = check_checkpoints(arguments, output)
    scene = load_scene(arguments.scene, overrides_from(arguments), definitions_from(arguments), warn)
    check_not_read(output_paths(output), arguments.scene, scene)
    guide = make_guide(scene, arguments)
    check_guide_files(arguments, scene, output, resume, checkpoint)
    preset = None
    if arguments.preset is not None:
        preset = load_preset(arguments.preset).account(scene, timed=seconds is not None)
        bias = f"; biased by {', '.join(preset['biased_by'])}" if preset["biased_by"] else ""
        console.print(f"preset {arguments.preset}{bias}", highlight=False, soft_wrap=True)
    renderer = make_renderer(arguments, scene, guide, console)
    for note in renderer.device_scene.notes:
        warn(note)
    spp = None if seconds else scene.integrator.spp
    if resume is not None:
        renderer.load_checkpoint(resume)
        message = f"{resume}: resuming after {renderer.sample_count} samples per pixel"
        console.print(message, highlight=False, soft_wrap=True)
        if spp is not None and spp < renderer.sample_count:
            warn(f"{resume} holds more samples than the {spp} asked for, and all are in the image")
    elif arguments.load_guide is not None:  # what is resumed has its own, which began with it
        load_guide(guide, arguments.load_guide)
    checkpoints = None
    if checkpoint is not None:
        saved = renderer.sample_count if resume == checkpoint else None
        checkpoints = CheckpointWriter(renderer, checkpoint, arguments.every or CHECKPOINT_SECONDS, warn, saved)
    try:
        interrupted = run_with_progress(renderer, console, spp, seconds, checkpoints)
    except NonFiniteError as error:
        saved = checkpoints is not None and checkpoints.saved_samples
        kept = f"; {checkpoint} holds the {saved} samples before" if saved else ""
        raise WavefrontError(f"{error}; no image was written{kept}") from None
    if checkpoints is not None:
        checkpoints.write()
    lost = None
    if arguments.save_guide is not None:
        try:
            save_guide(guide, arguments.save_guide)
        except CheckpointError as error:
            lost = error  # once the image is written
    account = describe_render(renderer, arguments.scene, started, preset)
    try:
        write_outputs(output, renderer, arguments.exposure, account)
    except HalfOverflowError:
        raise
    except (WavefrontError, MemoryError) as error:
        raise WavefrontError(f"{error or 'out of memory'}; {rescue(renderer, output, checkpoints)}") from None
    for stage, count in renderer.statistics.nonfinite.items():
        if count:
            warn(
                f"{count} contributions of the {stage} stage were not finite or negative, and were left out; "
                "--strict names the first"
            )
    if arguments.profile:
        print_profile(renderer, console)
    if guide is not None:
        console.print(in_words(guide), highlight=False, soft_wrap=True)
    s = renderer.statistics
    console.print(
        f"{output}: {s.sample_count} samples per pixel in {s.render_seconds:.1f} s"
        + (" (interrupted)" if interrupted else ""),
        highlight=False,
        soft_wrap=True,
    )
    if lost is not None:
        raise lost
    return EXIT_SIGNAL + interrupted if interrupted else 0


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
        return EXIT_SIGNAL + signal.SIGINT


if __name__ == "__main__":
    sys.exit(main())
