"""What it is worth that kernels are built for a scene: specialised kernels against kernels built for everything.

Each scene is rendered twice in the same run: as it is, and with every BSDF, texture and kind of light of this
repository's own scenes on tiny triangles behind the camera (`tools.every_feature`), which changes the kernels but not
the image. Reported are the time to compile with an empty cache, paths per second with rounds interleaved, bytes per
path, and what the CUDA compiler says about the kernels for compute capability 9.0, for which no GPU is needed:
registers and bytes of stack a thread.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tools.bench_common import ROOT, Child, machine, show, spread
from tools.bench_engine import prepared
from tools.bench_render import OURS, job_of
from wavefront.errors import WavefrontError
from wavefront.render import parse_size

ARCH = 90
STAGES = ("intersect", "direct", "shadow", "scatter")  # where the time goes


def default_scenes() -> list[Path]:
    folder = os.environ.get("WAVEFRONT_SCENES")
    if folder:
        return [Path(folder) / name / "scene.xml" for name in ("cornell-box", "veach-ajar", "bathroom")]
    return [ROOT / "scenes" / f"{name}.json" for name in ("cornell-box", "door-ajar", "glossy-plates")]


def cubin_resources(cubin: bytes) -> dict[str, int]:
    """Registers and stack bytes per thread of the kernel in a cubin, the largest if there are several.

    A cubin is an ELF file (64 bit, little-endian). Its section `.nv.info` lists attributes as (format, attribute, size,
    payload); 0x2f is a symbol's number of registers, 0x11 the size of its frame.
    """
    section_offset = struct.unpack_from("<Q", cubin, 40)[0]
    entry_size, count, names_index = struct.unpack_from("<HHH", cubin, 58)
    sections = [struct.unpack_from("<IIQQQQ", cubin, section_offset + i * entry_size) for i in range(count)]
    names = sections[names_index][4]
    found = {"registers": 0, "stack": 0}
    for name, _, _, _, offset, size in sections:
        if cubin[names + name : cubin.index(b"\0", names + name)] != b".nv.info":
            continue
        at, end = offset, offset + size
        while at < end:
            form, attribute, length = struct.unpack_from("<BBH", cubin, at)
            at += 4
            if form != 4:  # the value is in the place of the length
                continue
            key = {0x2F: "registers", 0x11: "stack"}.get(attribute)
            if key:
                found[key] = max(found[key], struct.unpack_from("<II", cubin, at)[1])
            at += length
    return found


def cuda_resources(job: dict) -> dict[str, dict[str, int]]:
    """`cubin_resources` of the stages of a scene."""
    import warp as wp

    from wavefront.integrator import make_features, make_kernels
    from wavefront.scene.device import upload_scene

    scene = prepared(job)
    kernels = make_kernels(make_features(scene, upload_scene(scene, "cpu")))
    found = {}
    with tempfile.TemporaryDirectory(prefix="wavefront-cubin-") as folder:
        for stage in STAGES:
            kernel = getattr(kernels, stage)
            if kernel is not None:
                paths = wp.compile_aot_module(kernel.module, arch=ARCH, module_dir=folder, use_ptx=False)
                found[stage] = cubin_resources(Path(paths[0]).read_bytes())
    return found


def bench_scene(job: dict, arguments: argparse.Namespace, progress) -> dict:
    """Measures both builds of a scene, rounds interleaved; returns the account of it."""
    job = {**job, "engine": OURS}
    jobs = {"specialised": job, "everything": {**job, "everything": True}}
    account: dict = {key: job[key] for key in ("name", "scene", "width", "height", "max_depth")}
    account["builds"] = {}
    with ExitStack() as stack:
        children = {}
        for label, one in jobs.items():
            progress(f"{job['name']}: {label}: compiling")
            cache = stack.enter_context(tempfile.TemporaryDirectory(prefix="wavefront-bench-"))
            child = stack.enter_context(Child("tools.bench_engine", one, {"WARP_CACHE_PATH": cache}))
            account["builds"][label] = {**child.ask({"do": "start"}), "rates": []}
            children[label] = child
        for number in range(arguments.rounds):
            for label, child in children.items():
                answer = child.ask({"do": "measure", "seconds": arguments.seconds})
                rate = answer["paths"] / answer["seconds"] / 1e6
                account["builds"][label]["rates"].append(rate)
                progress(f"{job['name']}: round {number + 1} of {arguments.rounds}: {label}: {rate:.3f} Mpaths/s")
        for label, child in children.items():
            build = account["builds"][label]
            build |= child.ask({"do": "finish"})
            build["mpaths_per_second"] = spread(build.pop("rates"))
    for label, one in jobs.items():
        progress(f"{job['name']}: {label}: compiling for compute capability {ARCH / 10:.1f}")
        account["builds"][label]["cuda"] = cuda_resources(one)
    rounds = [account["builds"][label]["mpaths_per_second"]["rounds"] for label in jobs]
    account["specialised_over_everything"] = spread([a / b for a, b in zip(*rounds, strict=True)])
    return account


def scene_table(account: dict) -> Table:
    title = "{name}, {width} x {height}, depth {max_depth}: median (least to most) of the rounds".format(**account)
    table = Table(title=title, title_justify="left")
    table.add_column("")
    builds = account["builds"]
    for label in builds:
        table.add_column(label, justify="right")

    def add(name, value):
        table.add_row(name, *(value(build) for build in builds.values()))

    add("compile, empty cache", lambda b: f"{b['compile_seconds']:.1f} s")
    add("Mpaths/s", lambda b: show(b["mpaths_per_second"]))
    table.add_row("specialised / everything", show(account["specialised_over_everything"]), "")
    add("bytes per path", lambda b: str(b["bytes_per_path"]))
    add("mean radiance", lambda b: f"{b['mean']:.5f}")
    for stage in STAGES:
        if stage in builds["specialised"]["cuda"]:
            add(
                f"{stage}: registers, stack bytes",
                lambda b, stage=stage: "{registers}, {stack}".format(**b["cuda"][stage]),
            )
    return table


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench_features", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "scenes",
        nargs="*",
        type=Path,
        metavar="SCENE",
        help="default: cornell-box, veach-ajar and bathroom in the folder WAVEFRONT_SCENES, or three of ours",
    )
    parser.add_argument("--threads", type=int, default=2, metavar="N", help="default 2")
    parser.add_argument("--seconds", type=float, default=5.0, metavar="S", help="of each measurement; default 5")
    parser.add_argument("--rounds", type=int, default=3, metavar="N", help="measurements of each; default 3")
    parser.add_argument("--size", type=parse_size, metavar="WxH", help="film size; default: 256x256 or 320x180")
    parser.add_argument("--max-depth", type=int, metavar="N", help="longest path in segments; default: 8 or 10")
    parser.add_argument("--device", default="cpu", help="cpu (default), cuda or cuda:N")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Measures and reports; returns the exit status.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    begin = time.perf_counter()

    def progress(message: str) -> None:
        print(f"[{time.perf_counter() - begin:6.1f} s] {message}", file=sys.stderr, flush=True)

    jobs = [job_of(path, arguments) for path in arguments.scenes or default_scenes()]
    account = {"machine": machine(), "scenes": [bench_scene(job, arguments, progress) for job in jobs]}
    console = Console(width=None if sys.stdout.isatty() else 160, highlight=False)
    for scene in account["scenes"]:
        console.print(scene_table(scene))
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
