"""What a guide has learned at one vertex, next to the light that arrives there.

    python -m tools.inspect_guide SCENE --pixel X,Y --guide NAME [--spp N | --load-guide FILE]

Renders the scene with a guide, follows the path through the centre of a pixel to the first vertex where the guide has a
say, traces the radiance that arrives there from all directions, and compares the guide's density with the one that it
should have (`Guide.target`): the KL divergence in nats, that of BSDF sampling, and that of the mixture of both which
paths are sampled from. Writes OUT.png (a figure), OUT.exr (all maps, see `maps`) and OUT.json.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path

import numpy as np
from rich.console import Console

from tools.guide_figure import need_matplotlib, write_figure
from tools.guide_map import DirectionMap, Side, target_values
from tools.guide_vertex import FoundVertex, VertexWorker, centred, incident_sides
from wavefront import Renderer, load_scene
from wavefront.errors import WavefrontError
from wavefront.guide import PRODUCT, RADIANCE, RADIANCE_COSINE, Guide
from wavefront.guide_file import load_guide, save_guide
from wavefront.guide_options import add_guide_options, check_guide_files, in_words, make_guide
from wavefront.output import check_image_path, check_not_read, output_paths
from wavefront.render import (
    EXIT_ERROR,
    EXIT_SIGNAL,
    definitions_from,
    make_renderer,
    overrides_from,
    parse_memory,
    parse_pixel,
    parse_size,
    run_with_progress,
)
from wavefront.scene import Scene
from wavefront.scene.images import replacing, write_exr

LARGEST_MAP = 4096
TARGET_WORDS = {RADIANCE: "Li", RADIANCE_COSINE: "Li |cos|", PRODUCT: "f Li |cos|"}


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.inspect_guide",
        description="Draw what a guide has learned at a vertex, the light that arrives there, and how far they differ.",
    )
    parser.add_argument("scene", metavar="SCENE", help="scene.json, scene.xml, or scene.gltf or .glb")
    parser.add_argument("--pixel", type=parse_pixel, required=True, metavar="X,Y", help="whose path the vertex is of")
    parser.add_argument(
        "--vertex", type=int, default=1, metavar="N", help="which one, of those with more than deltas; default 1"
    )
    parser.add_argument(
        "--rays", type=int, default=64, metavar="N", help="paths traced per cell of the map, an even number; default 64"
    )
    parser.add_argument(
        "--grid", type=parse_size, default=(256, 128), metavar="WxH", help="cells of the map; default 256x128"
    )
    parser.add_argument("-o", "--output", metavar="OUT.exr", help="default: the scene's name and -guide, right here")
    parser.add_argument("--exposure", type=float, default=0.0, metavar="STOPS", help="of the pictures; default 0")
    parser.add_argument("--quiet", action="store_true", help="print errors only")

    sampling = parser.add_argument_group("sampling")
    sampling.add_argument("--size", type=parse_size, metavar="WxH", help="film size in pixels")
    sampling.add_argument("--spp", type=int, metavar="N", help="samples per pixel; default: the scene's")
    sampling.add_argument("--max-depth", type=int, metavar="N", help="longest path in segments")
    sampling.add_argument("--no-nee", action="store_true", help="no next-event estimation in the guided render")
    sampling.add_argument("--seed", type=int, default=0, metavar="N", help="of the random numbers; default 0")
    sampling.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="change any key")
    sampling.add_argument("--define", action="append", default=[], metavar="NAME=VALUE", help="as of wavefront.render")
    add_guide_options(parser)
    machine = parser.add_argument_group("machine")
    machine.add_argument("--device", default="cpu", help="cpu (default), cuda or cuda:N")
    machine.add_argument("--threads", type=int, metavar="N", help="workers on the CPU device; default: all cores")
    machine.add_argument("--memory", type=parse_memory, default="4G", metavar="SIZE", help="most memory; default 4G")
    # The options of wavefront.render that are not for this.
    parser.set_defaults(preset=None, crop=None, aov=None, half=False, no_rr=False, sampler=None)
    parser.set_defaults(strict=False, profile=False, accel="bvh", paths_in_flight=None)
    return parser


def check(arguments: argparse.Namespace) -> None:
    """Refuses options that say nothing or contradict each other.

    Raises:
        WavefrontError: Names the option and what is allowed.
    """
    if arguments.spp is not None and arguments.spp < 1:
        raise WavefrontError(f"--spp {arguments.spp}; allowed: 1 or more")
    if arguments.vertex < 1:
        raise WavefrontError(f"--vertex {arguments.vertex}; allowed: 1 or more")
    if arguments.rays < 2 or arguments.rays % 2:
        raise WavefrontError(f"--rays {arguments.rays}; allowed: even numbers from 2")
    width, height = arguments.grid
    if not (2 <= width <= LARGEST_MAP and 2 <= height <= LARGEST_MAP):
        raise WavefrontError(f"--grid {width}x{height}; allowed: 2 to {LARGEST_MAP} either way")
    if not math.isfinite(arguments.exposure):
        raise WavefrontError(f"--exposure {arguments.exposure}; allowed: finite numbers")
    if arguments.load_guide is not None:
        for name in ("spp", "train_share", "save_guide"):
            if getattr(arguments, name) is not None:
                option = f"--{name.replace('_', '-')}"
                raise WavefrontError(f"{option} with --load-guide, which is used as it is; allowed: one of them")


def learned(
    guide: Guide, arguments: argparse.Namespace, scene: Scene, console: Console
) -> tuple[np.ndarray | None, int]:
    """Has the guide learn, by a render or from a file.

    Returns:
        The image, None if nothing was rendered; and the number of the signal that interrupted it, or 0.
    """
    renderer = make_renderer(arguments, scene, guide, console)
    if arguments.load_guide is not None:
        load_guide(guide, arguments.load_guide)
        return None, 0
    interrupted = run_with_progress(renderer, console, scene.integrator.spp, None)
    if arguments.save_guide is not None:
        save_guide(guide, arguments.save_guide)
    return renderer.film.image(), interrupted


def compare(
    guide: Guide, worker: VertexWorker, vertex: FoundVertex, directions: DirectionMap, halves: list[list[Side]]
) -> tuple[dict[str, np.ndarray], dict]:
    """The maps, and what is measured on them.

    Args:
        guide: After learning.
        worker: That found the vertex.
        vertex: Where.
        directions: The map.
        halves: From `incident_sides`.

    Returns:
        Maps [height, width] by channel: ``R``, ``G`` and ``B`` of the incident radiance, densities per steradian
        ``learned``, ``target``, ``bsdf`` and ``mixture``, ``visible`` (the share of a cell that the surface scatters
        light from) and ``solid_angle``. And numbers: integrals of the densities; the share of the guide's directions
        that is lost below the surface; KL divergences of the target from the densities, and the part of these that is
        the noise of the traced radiance.

    Raises:
        WavefrontError: No light arrives, or the guide cannot be asked.
    """
    w = directions.directions.reshape(-1, 3)
    f_cos, bsdf_pdf = worker.bsdf(w)
    try:
        density = guide.query(vertex.asked, w)
    except NotImplementedError:
        raise WavefrontError(f"guide {guide.name}: it has no density to ask for") from None
    both = [Side(0.5 * (a.radiance + b.radiance), a.share) for a, b in zip(*halves, strict=True)]
    targets = [
        directions.normalised(target_values(guide.target, directions, sides, f_cos, vertex.asked.normal))
        for sides in (both, *halves)
    ]
    if targets[0] is None:
        raise WavefrontError("no light arrives at the vertex, or the surface scatters none of it; more --rays may help")
    # As `proposals.make_bsdf_share`.
    share = guide.bsdf_share + (1.0 - guide.bsdf_share) * vertex.delta
    learned_density, bsdf_density = directions.means(density), directions.means(bsdf_pdf)
    densities = {
        "learned": learned_density,
        "bsdf": bsdf_density,
        "mixture": share * bsdf_density + (1.0 - share) * learned_density,
    }
    shares = [directions.means(side.share) for side in both]
    radiance = sum(side.radiance * covered[..., None] for side, covered in zip(both, shares, strict=True))
    if len(both) == 1:  # not dimmed where a cell is in part below the surface
        radiance = both[0].radiance * (shares[0] > 0.0)[..., None]
    maps = {name: radiance[..., i] for i, name in enumerate("RGB")}
    maps |= densities | {"target": targets[0], "visible": sum(shares)}
    maps["solid_angle"] = np.broadcast_to(directions.solid_angle, targets[0].shape)
    kl = {name: directions.divergence(targets[0], values) for name, values in densities.items()}
    numbers = {
        "bsdf_share": share,
        "integrals": {name: directions.integral(values) for name, values in densities.items()},
        "lost": directions.integral(learned_density * (1.0 - maps["visible"])),
    }
    return maps, numbers | {"kl": kl, "kl_noise": directions.excess(*targets)}


def account(guide: Guide, arguments: argparse.Namespace, vertex: FoundVertex, spp: int | None, numbers: dict) -> str:
    """The text of OUT.json."""
    t, v = vertex.traced, vertex.asked
    values = {
        "scene": str(arguments.scene),
        "pixel": list(arguments.pixel),
        "guide": {"method": guide.name, "settings": guide.identity(), "statistics": guide.statistics()},
        "guide_file": arguments.load_guide,
        "samples_per_pixel": spp,
        "seed": arguments.seed,
        "vertex": {
            "number": arguments.vertex,
            "depth": t.depth,
            "position": t.position,
            "geometric_normal": t.geometric_normal,
            "normal": t.shading_normal,
            "wo": list(v.wo),
            "roughness": v.roughness,
            "transmits": v.transmits,
            "delta": vertex.delta,
            "shape": t.shape,
            "bsdf": t.bsdf,
        },
        "target": guide.target,
        "grid": list(arguments.grid),
        "rays": arguments.rays,
    }
    kl = {name: value if math.isfinite(value) else str(value) for name, value in numbers["kl"].items()}
    return json.dumps(values | numbers | {"kl": kl}, indent=1, allow_nan=False) + "\n"


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Does what the command line says; returns the exit status.

    Raises:
        WavefrontError: With the one line that the user needs.
    """

    def say(message: str) -> None:
        console.print(message, markup=False, highlight=False, soft_wrap=True)

    def warn(message: str) -> None:
        say(f"warning: {message}")

    check(arguments)
    need_matplotlib()
    output = Path(arguments.output or f"{Path(arguments.scene).stem}-guide.exr")
    check_image_path(output)
    scene = load_scene(arguments.scene, overrides_from(arguments), definitions_from(arguments), warn)
    check_not_read(output_paths(output), arguments.scene, scene)
    guide = make_guide(scene, arguments)
    if guide is None:
        raise WavefrontError("the scene names no guide; allowed: --guide NAME, such as npm-product")
    check_guide_files(arguments, scene, output, None, None)
    if not guide.has_pdf:
        raise WavefrontError(f"guide {guide.name}: it has no density to ask for")

    tracer = make_renderer(arguments, centred(scene), None, console)
    for note in tracer.device_scene.notes:
        warn(note)
    worker = VertexWorker(tracer)
    vertex = worker.find(*arguments.pixel, arguments.vertex)
    image, interrupted = learned(guide, arguments, scene, console)
    if interrupted:
        return EXIT_SIGNAL + interrupted
    spp = scene.integrator.spp if image is not None else None
    if image is None:
        tracer.render(spp=1)
        image = np.stack([tracer.film.channels()[f"albedo.{c}"] for c in "RGB"], axis=-1)
    directions = DirectionMap(*arguments.grid)
    say(f"tracing {directions.width * directions.height * arguments.rays:,} paths from the vertex")

    def unguided(of: Scene) -> Renderer:
        return make_renderer(arguments, of, None, console)

    halves = incident_sides(scene, vertex, directions, arguments.rays, unguided)
    maps, numbers = compare(guide, worker, vertex, directions, halves)

    kl, t = numbers["kl"], vertex.traced
    noise = ""
    if numbers["kl_noise"] is not None:
        noise = f"; of each at least {max(numbers['kl_noise'], 0.0):.3f} is noise of the traced light"
    result = (
        f"KL of {TARGET_WORDS[guide.target]} from the guide {kl['learned']:.3f} nats, from BSDF sampling "
        f"{kl['bsdf']:.3f}, from both at a BSDF share of {numbers['bsdf_share']:.3g} {kl['mixture']:.3f}{noise}"
    )
    where = (
        f"pixel {arguments.pixel[0]},{arguments.pixel[1]}, vertex {arguments.vertex}: {t.shape}, {t.bsdf}, at "
        + " ".join(f"{x:.4g}" for x in t.position)
    )
    window = scene.film.window
    learned_density, target = maps["learned"], maps["target"]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(maps["visible"] > 0.0, learned_density / target, np.nan)
    write_exr(output, {name: np.ascontiguousarray(values, np.float32) for name, values in maps.items()})
    image_path, figure_path, json_path = output_paths(output)
    write_figure(
        figure_path,
        f"{where}\n{in_words(guide)}\n{result}",
        "render" if spp is not None else "albedo",
        image,
        (arguments.pixel[0] - window.x, arguments.pixel[1] - window.y),
        np.stack([maps[c] for c in "RGB"], axis=-1),
        {
            "density of BSDF sampling": maps["bsdf"],
            f"learned density, integral {numbers['integrals']['learned']:.4f}": learned_density,
            f"target {TARGET_WORDS[guide.target]}, normalised": target,
        },
        ratio,
        maps["visible"] > 0.5,
        arguments.exposure,
    )
    with replacing(json_path) as temporary:
        temporary.write_text(account(guide, arguments, vertex, spp, numbers), encoding="utf-8")
    integral = f"learned density: integral {numbers['integrals']['learned']:.5f}, of it {numbers['lost']:.5f} below"
    for line in (where, in_words(guide), integral, result):
        say(line)
    say(f"{figure_path}, {image_path}, {json_path}")
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    arguments = build_parser().parse_args(argv)
    try:
        return run(arguments, Console(stderr=True, quiet=arguments.quiet))
    except WavefrontError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_ERROR
    except KeyboardInterrupt:
        print("interrupted: nothing was written", file=sys.stderr)
        return EXIT_SIGNAL + 2


if __name__ == "__main__":
    sys.exit(main())
