"""What the knobs of a user trade: measures time against error, and prints the frontier.

    python -m tools.trade SCENE [--knob NAME[=v1,v2,...] ...] [--spp N,N,... | --seconds S,S,...] [--output FOLDER]

Every knob (`tools.knobs`; by default all of them but those of guides) is turned on its own, from the scene's settings;
then what is on the Pareto frontier of time against error is joined in pairs (`--rounds`), or all combinations are taken
(`--grid`). Each setting is rendered with several seeds. The report names the settings on the frontier, those that are
*dominated* (another setting takes less time and has less error, and the runs allow to say so), and those that are not
separated.
Knobs with a bias, such as the longest path, are measured against the reference of the unrestricted scene, and the part
of an error that is bias is told apart (`tools.frontier`). Each setting is also compiled and rendered once in a process
of its own with an empty kernel cache, for compile time and peak memory.

Several scenes are swept together: the settings that are joined are those on the frontier of the geometric means of time
and error, which gets a table of its own.

FOLDER gets ``trade.json``, ``frontier.png``, references, and the results of an experiment (`tools.results`). The same
command goes on after a kill.

Time depends on the size of the image in two ways: a small one renders in passes of few samples, of which the overhead
counts for settings with few samples.

    python -m tools.trade --check-presets [--update-presets]

sweeps the scenes of the presets of `wavefront.render --preset`, with their settings among the others; exit status 1 if
one of them is dominated. See `tools.preset_check`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import msgspec
from rich.console import Console

from tools import trade_report
from tools.experiment_spec import ReferenceSpec
from tools.knobs import KNOBS, SPP, parse_knob
from tools.methods import SEEDS, scene_name
from tools.metrics import METRICS
from tools.reference import available_cores, definitions
from tools.results import slug, write_json
from tools.sweep import Plan, Sweep, make_plan
from wavefront.errors import WavefrontError

DEFAULT_METRIC = "relmse"
REFERENCE_ERROR, REFERENCE_SECONDS = 0.005, 60.0


def numbers(text: str, kind: type, what: str) -> tuple:
    """Different positive numbers with commas between them.

    Raises:
        WavefrontError: Anything else.
    """
    try:
        found = tuple(kind(word) for word in text.split(","))
    except ValueError:
        found = ()
    if not found or len(set(found)) < len(found) or not all(0 < value < 2**31 for value in found):
        raise WavefrontError(f"{what} {text}; allowed: different positive numbers with commas between them")
    return found


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.trade", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", type=Path, metavar="SCENE", help="scene.json, scene.xml, or glTF")
    parser.add_argument(
        "--knob",
        action="append",
        default=[],
        metavar="NAME[=v1,v2,...]",
        help=f"which to turn, and to what; of {', '.join(KNOBS)}; default: all but those of guides",
    )
    parser.add_argument("--grid", action="store_true", help="all combinations of the values")
    parser.add_argument("--rounds", type=int, default=1, metavar="N", help="of joining pairs; default 1")
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--spp", metavar="N,N,...", help=f"default {','.join(map(str, KNOBS[SPP].values))}")
    budget.add_argument("--seconds", metavar="S,S,...", help="of rendering, instead of samples")
    parser.add_argument(
        "--more-spp",
        type=int,
        metavar="N",
        help="for those alone that are on the frontier without bias at the largest of --spp",
    )
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="runs of each setting; default 5")
    parser.add_argument("--metric", metavar="NAME", help=f"default {DEFAULT_METRIC}")
    parser.add_argument(
        "--override", action="extend", nargs="+", default=[], metavar="KEY=VALUE", help="change keys of the scenes"
    )
    parser.add_argument(
        "--define", action="extend", nargs="+", default=[], metavar="NAME=VALUE", help="$NAME of a Mitsuba scene"
    )
    parser.add_argument(
        "--reference-error", type=float, default=REFERENCE_ERROR, metavar="E", help=f"default {REFERENCE_ERROR}"
    )
    parser.add_argument(
        "--reference-seconds", type=float, default=REFERENCE_SECONDS, metavar="S", help="at most; default 60"
    )
    parser.add_argument("--references", type=Path, metavar="FOLDER", help="default: references in the output")
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="default: results/trade-SCENE")
    parser.add_argument("--json", action="store_true", help="print the JSON in place of the tables")
    parser.add_argument("--no-plot", action="store_true", help="write no plot")
    parser.add_argument("--threads", type=int, metavar="N", help="default: all cores")
    parser.add_argument("--device", default="cpu", help="cpu (default), cuda or cuda:N")
    parser.add_argument("--check-presets", action="store_true", help="measure the presets of wavefront.render again")
    parser.add_argument("--update-presets", action="store_true", help="and write the figures to their files")
    return parser


def plan_of(arguments: argparse.Namespace) -> Plan:
    """What the command line asks for.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    if not arguments.scenes:
        raise WavefrontError("a scene is missing: python -m tools.trade SCENE")
    knobs, sizes = {}, None
    for text in arguments.knob:
        knob, values = parse_knob(text)
        if knob.name in knobs or (knob.name == SPP and sizes):
            raise WavefrontError(f"--knob {text}: {knob.name} is there twice")
        if knob.name == SPP:
            sizes = numbers(text.partition("=")[2] or ",".join(map(str, values)), int, f"--knob {SPP}")
        else:
            knobs[knob.name] = values
    if sizes and (arguments.spp or arguments.seconds):
        raise WavefrontError("--knob spp together with --spp or --seconds; allowed: one of them")
    if not arguments.knob:
        knobs = {name: knob.values for name, knob in KNOBS.items() if name != SPP and not knob.on_request}
    if arguments.spp:
        sizes = numbers(arguments.spp, int, "--spp")
    seconds = numbers(arguments.seconds, float, "--seconds") if arguments.seconds else ()
    metric = arguments.metric or DEFAULT_METRIC
    if metric not in METRICS:
        raise WavefrontError(f"--metric {metric}; allowed: {', '.join(METRICS)}")
    if not 1 <= arguments.seeds < SEEDS:
        raise WavefrontError(f"--seeds {arguments.seeds}; allowed: 1 to {SEEDS - 1}")
    if arguments.rounds < 0:
        raise WavefrontError(f"--rounds {arguments.rounds}; allowed: 0 or more")
    sizes, more = () if seconds else sizes or KNOBS[SPP].values, arguments.more_spp
    if more is not None and not (sizes and max(sizes) < more < 2**31):
        raise WavefrontError(f"--more-spp {more}; allowed: more than the largest of --spp, and not with --seconds")
    return make_plan(
        arguments.scenes,
        knobs,
        sizes,
        seconds,
        arguments.seeds,
        metric,
        reference_of(arguments),
        arguments.override,
        definitions(arguments.define),
        more,
    )


def reference_of(arguments: argparse.Namespace) -> ReferenceSpec:
    """How references are made.

    Raises:
        WavefrontError: A limit that is not positive.
    """
    for option in ("reference_error", "reference_seconds"):
        if not 0.0 < getattr(arguments, option) < float("inf"):
            raise WavefrontError(f"--{option.replace('_', '-')} {getattr(arguments, option):g}; allowed: more than 0")
    return ReferenceSpec(error=arguments.reference_error, seconds=arguments.reference_seconds)


def run(arguments: argparse.Namespace) -> int:
    """Measures and reports; returns the exit status.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    if arguments.threads is not None and arguments.threads < 1:
        raise WavefrontError(f"--threads {arguments.threads}; allowed: 1 or more")
    if arguments.update_presets and not arguments.check_presets:
        raise WavefrontError("--update-presets is for --check-presets, which is missing")
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    if arguments.check_presets:
        from tools import preset_check

        return preset_check.run(arguments, console)
    if not arguments.no_plot:
        trade_report.check_plots()
    plan = plan_of(arguments)
    name = "trade-" + slug("-".join(scene_name(path) for path in arguments.scenes))
    folder = arguments.output or Path("results") / name
    references = arguments.references or folder / "references"
    threads = arguments.threads or available_cores()
    sweep = Sweep(plan, name, folder, references, threads, arguments.device, console)
    results = sweep.go(arguments.rounds, arguments.grid)
    sections = sweep.sections(results)
    account = trade_report.account(sections, sweep, results)
    write_json(folder / "trade.json", account)
    if not arguments.no_plot:
        trade_report.plot(sections, plan.metric, folder / "frontier.png")
    if arguments.json:
        print(msgspec.json.format(msgspec.json.encode(account), indent=2).decode())
        return 0
    # A pipe or a file has no width; the widest table needs this much.
    out = Console(width=None if sys.stdout.isatty() else 200, highlight=False)
    for section in sections:
        out.print(trade_report.methods_table(section, plan))
        out.print(trade_report.frontier_table(section, plan.metric))
    for line in account["remarks"]:
        out.print(line)
    out.print(f"{folder}: trade.json" + ("" if arguments.no_plot else ", frontier.png"))
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status: 0, 1 where a preset is dominated, or 2 after an error."""
    try:
        return run(build_parser().parse_args(argv))
    except (WavefrontError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; the same command goes on with the run that was interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
