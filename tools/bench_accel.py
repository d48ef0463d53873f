"""Speed of ray queries: our hierarchy beside `wp.Mesh`, Embree and Mitsuba, in one run on the same rays.

On each mesh, all build their hierarchies and trace the same rays: primary rays in the order of pixels, and in random
order rays from the hits of those into the cosine-weighted hemisphere (bounce) and towards lights or, without any,
towards a sphere around all (shadow). Every kind is traced for the closest hit, without an end, and for any hit, of
shadow rays before the light. Rounds are interleaved, so that a slow minute of the machine hits all alike; the first
run of a query, with compiling, is apart. Answers are compared: two are the same where both miss, or hit the same
triangle, or hit at the same distance within 1e-4 of it.

Engines: "stream" and "portable" are the two traversals of our hierarchy, of which the first is for the CPU device
alone. "wp.Mesh" is built by its SAH constructor with leaves of 1, 2, 4 and 8 triangles; the best is the one with the
least time over all. "embree" is Embree 4 through embreex, which traces one ray after the other on one thread, whatever
--threads says. "mitsuba" is Mitsuba 3 in the variant llvm_ad_rgb, which traces packets with an Embree of its own.
Neither Embree is asked to be watertight. Threads in use are processor time over time: less than --threads means that
the engine waited or the machine was busy; rays per second of processor time are less disturbed by that. Resident memory
is what the process grew by while it built.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from tools.accel_engines import ENGINES, Answer, Structure, make_structures, memory_in_use, missing
from tools.accel_plot import write_plot
from tools.accel_rays import Case, RayMaker, from_scene, generated
from tools.bench_common import machine, parse_counts, spread
from tools.guide_figure import need_matplotlib
from wavefront.errors import WavefrontError
from wavefront.output import check_writable
from wavefront.renderer import resolve_device
from wavefront.scene.images import replacing

QUERIES = ("closest", "any")
WARM_UP = 1000  # triangles of the mesh on which builders are compiled
BUILD_SECONDS = 2.0  # no further build after as many
MEMORY_FROM = 50_000  # triangles: of fewer, the growth of the process tells nothing
SAME_DISTANCE = 1e-4
FEWEST, MOST = 100, 100_000_000  # triangles of a generated mesh


def parse_sizes(text: str) -> list[int]:
    """Numbers of triangles such as ``1e3,1e6``, or ``none``."""
    if text == "none":
        return []
    return parse_counts(text, FEWEST, MOST)


def parse_engines(text: str) -> tuple[str, ...]:
    """Some of `ENGINES`, separated by commas."""
    names = tuple(dict.fromkeys(text.split(",")))
    if unknown := [name for name in names if name not in ENGINES]:
        raise argparse.ArgumentTypeError(f"there is no engine {unknown[0]!r}; there are {', '.join(ENGINES)}")
    return names


# --- measuring ---------------------------------------------------------------------------------------------------


class Clock:
    """Seconds, and processor seconds of the whole process, since it was made."""

    def __init__(self):
        self.begin, self.begin_cpu = time.perf_counter(), time.process_time()

    def read(self) -> tuple[float, float]:
        return time.perf_counter() - self.begin, time.process_time() - self.begin_cpu


def settle(step: float = 0.01, limit: float = 1.0) -> None:
    """Waits until no thread of this process runs: those of Mitsuba still look for work for some ms after theirs.

    Linux counts the time of other threads by its ticks, of up to 10 ms, and so a shorter step may see none.
    """
    for _ in range(round(limit / step)):
        clock = Clock()
        time.sleep(step)
        wall, cpu = clock.read()
        if cpu < 0.25 * wall:
            return


def bench_build(structure: Structure, case: Case, rounds: int, device: str) -> dict:
    """Builds a hierarchy and leaves it built; returns the account of it."""
    tiny = generated(WARM_UP)
    structure.prepare(tiny.points, tiny.faces)
    clock = Clock()
    structure.build()
    account: dict = {"warm_up_seconds": clock.read()[0]}
    structure.release()
    structure.prepare(case.points, case.faces)
    seconds, cpu = [], []
    grown = None
    while len(seconds) < rounds and sum(seconds) < BUILD_SECONDS:
        structure.release()
        before = None
        if not seconds and len(case.faces) >= MEMORY_FROM:
            gc.collect()
            before = memory_in_use(device)
        settle()
        clock = Clock()
        structure.build()
        wall, busy = clock.read()
        seconds.append(wall)
        cpu.append(busy)
        if before is not None:
            gc.collect()
            grown = (memory_in_use(device) - before) / len(case.faces)
    statistics = structure.statistics()
    return account | {
        "build_seconds": spread(seconds),
        "build_threads_in_use": sum(cpu) / sum(seconds),
        "bytes_per_triangle": statistics["bytes"] / statistics["primitives"] if statistics else None,
        "resident_bytes_per_triangle": grown,
        "statistics": statistics,
    }


def differences(reference: Answer, answer: Answer) -> int:
    """Rays of which two answers are not the same."""
    if reference.blocked is not None:
        return int((reference.blocked != answer.blocked).sum())
    hit, other = reference.primitive >= 0, answer.primitive >= 0
    both = hit & other & (reference.primitive != answer.primitive)
    t, s = reference.t[both].astype(np.float64), answer.t[both].astype(np.float64)
    return int((hit != other).sum() + (np.abs(t - s) > SAME_DISTANCE * np.maximum(t, s)).sum())


def bench_case(case: Case, structures: list[Structure], arguments: argparse.Namespace, progress) -> dict:
    """Measures all engines on a mesh, rounds interleaved; returns the account of it."""
    account: dict = {"name": case.name, "triangles": len(case.faces), "generated": case.generated, "notes": case.notes}
    progress(f"{case.name}: rays")
    kinds = RayMaker(case, arguments.rays).make()
    account["rays"] = {kind: len(rays.origin) for kind, rays in kinds.items()}
    account["structures"], account["engines"] = {}, {}
    queries: dict = {}  # by kind and sort of query, those of the engines
    references: dict = {}
    hits: dict = {}
    for structure in structures:
        progress(f"{case.name}: {structure.name}: building")
        account["structures"][structure.name] = bench_build(structure, case, arguments.rounds, arguments.device)
        for engine in structure.engines:
            engine_account = account["engines"][engine] = {"structure": structure.name, "warm_up_seconds": 0.0}
            engine_account["measured"] = {}
            for kind, rays in kinds.items():
                for sort in QUERIES:
                    query = structure.query(engine, rays, sort == "any")
                    clock = Clock()
                    query.run()
                    engine_account["warm_up_seconds"] += clock.read()[0]
                    queries.setdefault((kind, sort), {})[engine] = query
                    answer = query.answer()
                    reference = references.setdefault((kind, sort), answer)
                    met = answer.blocked if sort == "any" else answer.primitive >= 0
                    hits.setdefault(kind, {}).setdefault(sort, float(met.mean()))
                    engine_account["measured"].setdefault(kind, {})[sort] = {
                        "differences": differences(reference, answer),
                        "seconds": [],
                        "cpu_seconds": [],
                    }
    account["hit_share"] = hits
    for number in range(arguments.rounds):
        for (kind, sort), engines in queries.items():
            order = list(engines.items())
            for engine, query in order if number % 2 == 0 else order[::-1]:
                settle()
                clock = Clock()
                query.run()
                wall, cpu = clock.read()
                measured = account["engines"][engine]["measured"][kind][sort]
                measured["seconds"].append(wall)
                measured["cpu_seconds"].append(cpu)
        progress(f"{case.name}: round {number + 1} of {arguments.rounds}")
    for structure in structures:
        structure.release()
    summarise(account)
    return account


def summarise(account: dict) -> None:
    """Adds rates, threads in use, ratios round by round, and the best leaf size of `wp.Mesh` to the account."""
    engines = account["engines"]
    for engine in engines.values():
        wall = cpu = total = 0.0
        for kind, sorts in engine["measured"].items():
            for measured in sorts.values():
                seconds = measured["seconds"]
                busy = measured.pop("cpu_seconds")
                wall, cpu = wall + sum(seconds), cpu + sum(busy)
                measured["mrays_per_second"] = spread([account["rays"][kind] / s / 1e6 for s in seconds])
                measured["mrays_per_cpu_second"] = spread([account["rays"][kind] / s / 1e6 for s in busy])
                measured["seconds"] = spread(seconds)
                total += measured["seconds"]["median"]
        engine["threads_in_use"] = cpu / wall
        engine["median_seconds_of_all"] = total
    first = next(iter(engines.values()))
    for engine in engines.values():
        for kind, sorts in engine["measured"].items():
            for sort, measured in sorts.items():
                pairs = zip(
                    measured["seconds"]["rounds"], first["measured"][kind][sort]["seconds"]["rounds"], strict=True
                )
                measured["first_over_this"] = spread([theirs / ours for theirs, ours in pairs])
    meshes = {name: engine["median_seconds_of_all"] for name, engine in engines.items() if name.startswith("wp.Mesh")}
    account["best_mesh"] = min(meshes, key=meshes.get) if meshes else None


# --- tables ------------------------------------------------------------------------------------------------------


def _number(value: float | None, form: str = ".3g") -> str:
    return "" if value is None else format(value, form)


def build_table(account: dict) -> Table:
    table = Table(title=f"{account['name']}: building", title_justify="left")
    table.add_column("")
    names = ("s, median (least)", "threads\nin use", "bytes a\ntriangle", "resident bytes\na triangle", "SAH cost")
    for name in (*names, "expected visits\nof nodes, blocks", "first build\nof all, s"):
        table.add_column(name, justify="right")
    for name, structure in account["structures"].items():
        seconds, statistics = structure["build_seconds"], structure["statistics"]
        table.add_row(
            name,
            f"{seconds['median']:.3g} ({seconds['min']:.3g})",
            f"{structure['build_threads_in_use']:.1f}",
            _number(structure["bytes_per_triangle"], ".1f"),
            _number(structure["resident_bytes_per_triangle"], ".0f"),
            _number(statistics and statistics["sah_cost"]),
            "{node_visits:.3g}, {block_visits:.3g}".format(**statistics) if statistics else "",
            f"{structure['warm_up_seconds']:.2f}",
        )
    return table


def query_table(account: dict) -> Table:
    first = next(iter(account["engines"]))
    kinds = list(account["rays"])
    rays = ", ".join(f"{count:,} {kind}" for kind, count in account["rays"].items())
    title = f"{account['name']}: Mrays/s, median (best) of the rounds; rays: {rays}"
    table = Table(title=title, title_justify="left")
    table.add_column("", no_wrap=True)
    for kind in kinds:
        for sort in QUERIES:
            table.add_column(f"{kind}\n{sort}", justify="right", no_wrap=True)
    names = (f"{first}/this:\nbounce", "per CPU s:\nbounce", "threads\nin use", "answers\ndiffer", "first\nruns, s")
    for name in names:
        table.add_column(name, justify="right")
    for name, engine in account["engines"].items():
        cells = [engine["measured"][kind][sort] for kind in kinds for sort in QUERIES]
        table.add_row(
            name + (" (best)" if name == account["best_mesh"] else ""),
            *("{median:.3g} ({max:.3g})".format(**cell["mrays_per_second"]) for cell in cells),
            f"{engine['measured']['bounce']['closest']['first_over_this']['median']:.2f}",
            f"{engine['measured']['bounce']['closest']['mrays_per_cpu_second']['median']:.3g}",
            f"{engine['threads_in_use']:.2f}",
            str(sum(cell["differences"] for cell in cells)),
            f"{engine['warm_up_seconds']:.2f}",
        )
    table.add_section()
    table.add_row("rays that hit", *(f"{account['hit_share'][k][s]:.0%}" for k in kinds for s in QUERIES))
    return table


def print_report(account: dict, console: Console) -> None:
    """The tables and lines on standard output."""
    m = account["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in m["versions"].items())
    console.print(f"{m['cpu']}, {m['cores']} cores, load {m['load']}, {m['system']}; Python {m['python']}, {versions}")
    settings = account["settings"]
    console.print("{device}, {threads} threads, {rounds} rounds".format(**settings))
    for engine, reason in account["left_out"].items():
        console.print(f"{engine} is left out: {reason}", markup=False)
    for case in account["cases"]:
        for note in case["notes"]:
            console.print(f"{case['name']}: {note}", markup=False)
        console.print(build_table(case))
        console.print(query_table(case))


# --- the command -------------------------------------------------------------------------------------------------


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench_accel", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", type=Path, metavar="SCENE", help="scene files; spheres are left out")
    parser.add_argument(
        "--sizes",
        type=parse_sizes,
        default="1e3,1e4,1e5,1e6",
        metavar="N,...",
        help="triangles of the generated closed meshes, up to 1e8, or none; default 1e3,1e4,1e5,1e6",
    )
    parser.add_argument(
        "--soup",
        type=parse_sizes,
        default="1e5",
        metavar="N,...",
        help="triangles of generated ones without order, or none; default 1e5",
    )
    parser.add_argument(
        "--engines",
        type=parse_engines,
        metavar="NAME,...",
        help=f"some of {', '.join(ENGINES)}; the first is what others are compared with; default: all that are here",
    )
    parser.add_argument("--threads", type=int, default=2, metavar="N", help="default 2")
    parser.add_argument("--rays", type=int, default=1 << 18, metavar="N", help="of each kind; default 262144")
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="measurements of each; default 5")
    parser.add_argument("--device", default="cpu", help="cpu (default), cuda or cuda:N")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="plot them against the triangles of --sizes, as PNG")
    return parser


def check(arguments: argparse.Namespace) -> None:
    """Raises WavefrontError with the one line that the user needs."""
    for name, least in (("threads", 1), ("rounds", 1), ("rays", 100)):
        if getattr(arguments, name) < least:
            raise WavefrontError(f"--{name} {getattr(arguments, name)}; allowed: {least} or more")
    if not (arguments.scenes or arguments.sizes or arguments.soup):
        raise WavefrontError("there is nothing to measure: no scene, no --sizes and no --soup")
    for path in arguments.scenes:
        if not path.is_file():
            raise WavefrontError(f"{path}: file not found")
    arguments.device = resolve_device(arguments.device)
    if arguments.plot:
        need_matplotlib()
        if len(set(arguments.sizes)) < 2:
            raise WavefrontError("--plot needs two --sizes or more")
        if arguments.plot.suffix.lower() != ".png":
            raise WavefrontError(f"--plot {arguments.plot}: allowed: names that end in .png")
    for path in (arguments.json, arguments.plot):
        if path:
            check_writable(path)


def run(arguments: argparse.Namespace) -> int:
    """Measures and reports; returns the exit status.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    check(arguments)
    begin = time.perf_counter()

    def progress(message: str) -> None:
        print(f"[{time.perf_counter() - begin:6.1f} s] {message}", file=sys.stderr, flush=True)

    reasons = {engine: missing(engine, arguments.device) for engine in arguments.engines or ENGINES}
    left_out = {engine: reason for engine, reason in reasons.items() if reason}
    if arguments.engines and left_out:
        raise WavefrontError(f"--engines: {next(iter(left_out.values()))}")
    used = tuple(engine for engine in reasons if engine not in left_out)
    structures = make_structures(used, arguments.device, arguments.threads)
    account = {
        "machine": machine(),
        "settings": {name: getattr(arguments, name) for name in ("threads", "rays", "rounds", "device")},
        "left_out": left_out,
        "cases": [],
    }
    makers = [lambda path=path: from_scene(path) for path in arguments.scenes]
    makers += [lambda size=size: generated(size) for size in arguments.sizes]
    makers += [lambda size=size: generated(size, ordered=False) for size in arguments.soup]
    for make in makers:
        account["cases"].append(bench_case(make(), structures, arguments, progress))
    # A pipe or a file has no width; the widest table needs this much.
    print_report(account, Console(width=None if sys.stdout.isatty() else 180, highlight=False))
    if arguments.json:
        with replacing(arguments.json) as temporary:
            temporary.write_text(json.dumps(account, indent=2) + "\n", encoding="utf-8")
    if arguments.plot:
        write_plot(arguments.plot, account)
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
