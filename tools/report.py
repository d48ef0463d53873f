"""A page that shows the results of an experiment: ``python -m tools.report RESULTS [-o FILE.html]``.

RESULTS is a folder of `tools.experiment`, whose experiment may still run. The page has the table of errors, times,
efficiencies and speed-ups with their 95 % intervals, convergence plots, and a viewer of the images: methods and
reference in turn by keys, a wipe between two of them, side by side, zoom, exposure, false colours of the error, crops.
It is one HTML file without scripts, styles or images from elsewhere, and opens from the disk.

Images are in it with all of their dynamic range, at about 5 bytes for each pixel of each image: ``--images largest``
takes those of the largest budget alone, ``--images none`` leaves the viewer out.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from msgspec import structs

from tools.metrics import find_metric
from tools.report_page import Crop, make_page
from tools.report_plots import write_plots
from tools.results import Results, load_results
from tools.summary import summarise
from wavefront.errors import WavefrontError
from wavefront.output import check_writable
from wavefront.scene.images import replacing

CROP = re.compile(r"(?:(?P<scene>.+?):)?(?P<name>.+)=(?P<w>\d+)x(?P<h>\d+)\+(?P<x>\d+)\+(?P<y>\d+)")


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.report", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path, metavar="RESULTS", help="folder of tools.experiment")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.html", help="default: RESULTS/report.html")
    parser.add_argument("--baseline", metavar="METHOD", help="of the speed-ups; default: that of the experiment")
    parser.add_argument(
        "--metric", metavar="NAME", help="shown first and in PNG plots; default: the experiment's first"
    )
    parser.add_argument(
        "--crop", action="append", default=[], metavar="[SCENE:]NAME=WxH+X+Y", help="a region to begin with; repeatable"
    )
    parser.add_argument(
        "--images", choices=("all", "largest", "none"), default="all", help="of which budgets; default: all"
    )
    parser.add_argument("--plots", type=Path, metavar="FOLDER", help="also write the plots as PNG files (matplotlib)")
    return parser


def choose(results: Results, baseline: str | None, metric: str | None) -> tuple[Results, str]:
    """The results with a baseline, and the name of the metric that is shown first.

    Raises:
        WavefrontError: No run has ended, or no method or metric has this name.
    """
    experiment = results.experiment
    if not results.records:
        raise WavefrontError(f"{results.folder}: no run has ended yet, so that there is nothing to show")
    for name in experiment.metrics:
        find_metric(name)
    if metric is not None and metric not in experiment.metrics:
        raise WavefrontError(f"--metric {metric}: was not measured; allowed: {', '.join(experiment.metrics)}")
    methods = [method.name for method in experiment.methods]
    if baseline is not None and baseline not in methods:
        raise WavefrontError(f"--baseline {baseline}: is no method of the experiment; allowed: {', '.join(methods)}")
    if baseline is not None:
        results = Results(results.folder, structs.replace(experiment, baseline=baseline), results.records)
    return results, metric or experiment.metrics[0]


def read_crops(words: list[str], results: Results) -> dict[str, list[Crop]]:
    """The crops of a command line, by scene; one without a scene is for all.

    Raises:
        WavefrontError: Words of another form, an empty crop, or no such scene.
    """
    scenes = [scene.name for scene in results.experiment.scenes]
    crops: dict[str, list[Crop]] = {name: [] for name in scenes}
    for word in words:
        match = CROP.fullmatch(word)
        if not match or not int(match["w"]) or not int(match["h"]):
            raise WavefrontError(f"--crop {word}: allowed: [SCENE:]NAME=WxH+X+Y in pixels, such as lamp=64x48+10+20")
        if match["scene"] is not None and match["scene"] not in scenes:
            raise WavefrontError(f"--crop {word}: there is no scene {match['scene']!r}; allowed: {', '.join(scenes)}")
        for scene in scenes if match["scene"] is None else [match["scene"]]:
            crops[scene].append(Crop(match["name"], *(int(match[key]) for key in "xywh")))
    return crops


def run(arguments: argparse.Namespace) -> int:
    """Writes a page; returns the exit status.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    results, metric = choose(load_results(arguments.results), arguments.baseline, arguments.metric)
    crops = read_crops(arguments.crop, results)
    output = arguments.output or arguments.results / "report.html"
    check_writable(output)
    cells = summarise(results)
    page, warnings = make_page(results, cells, metric, crops, arguments.images)
    for warning in warnings:
        print(f"warning: {warning}", file=sys.stderr)
    plots = [] if arguments.plots is None else write_plots(results, cells, metric, arguments.plots)
    with replacing(output) as temporary:
        temporary.write_text(page, encoding="utf-8")
    print(f"{output}: {len(results.records)} runs, {output.stat().st_size / 1e6:.1f} MB")
    for path in plots:
        print(path)
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status: 0, or 2 after an error, of which one line is printed."""
    try:
        return run(build_parser().parse_args(argv))
    except (WavefrontError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
