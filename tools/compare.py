"""How far an image is from its reference: ``python -m tools.compare A REF``, for images of any renderer.

Prints the error metrics of `tools.metrics`, and tests for bias where the files have variances (`tools.bias_test`).
OpenEXR files are radiance; 8-bit and 16-bit pictures are decoded from sRGB, and two of them are compared by LDR-FLIP,
anything else by HDR-FLIP. Exit status: 0; 1 with --bias-test, where a tile differs; 2 after an error.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.table import Table

from tools.false_color import false_color
from tools.image_reader import LoadedImage, read_image
from tools.metrics import METRICS, error_map, find_metric
from wavefront.errors import WavefrontError
from wavefront.output import check_writable
from wavefront.scene.images import replacing, write_png

if TYPE_CHECKING:
    from tools.bias_test import BiasTest

ERROR_METRIC = "relmse"
SCALE_PERCENTILE = 99.0  # of the errors of pixels: the end of the scale of an error image
FAILURES_SHOWN = 10


@dataclasses.dataclass
class Outcome:
    """What is known of two images.

    Attributes:
        image, reference: The files.
        errors: By metric.
        drawn: The errors of pixels, [h, w], of the metric that is drawn, or none.
        bias: A `bias_test.BiasTest`, or none.
        notes: What was left out, and why.
    """

    image: LoadedImage
    reference: LoadedImage
    errors: dict[str, float] = dataclasses.field(default_factory=dict)
    drawn: np.ndarray | None = None
    bias: BiasTest | None = None
    notes: list[str] = dataclasses.field(default_factory=list)

    @property
    def display(self) -> bool:
        """Whether both images were made for a display."""
        return self.image.display and self.reference.display

    def figures(self) -> dict:
        """For a JSON file."""
        height, width = self.image.pixels.shape[:2]
        return {
            "image": str(self.image.path),
            "reference": str(self.reference.path),
            "width": width,
            "height": height,
            "display": self.display,
            "metrics": self.errors,
            "bias_test": self.bias and self.bias.figures(),
            "notes": self.notes,
        }


def check_alike(image: LoadedImage, reference: LoadedImage) -> None:
    """Refuses images of different pixels.

    Raises:
        WavefrontError: Names both files and their windows.
    """
    windows = [(*reversed(one.pixels.shape[:2]), *one.origin) for one in (image, reference)]
    if windows[0] != windows[1]:
        texts = ["{}x{} pixels from ({}, {})".format(*window) for window in windows]
        raise WavefrontError(
            f"{image.path}: has {texts[0]}, but {reference.path} has {texts[1]}; allowed: images of the same pixels"
        )


def measure(image: LoadedImage, reference: LoadedImage, names: Sequence[str], drawn: str | None = None) -> Outcome:
    """The errors of an image.

    Args:
        image, reference: Of the same pixels.
        names: Metrics; if empty, all that can be evaluated.
        drawn: The metric whose map is kept, one of those evaluated.

    Raises:
        WavefrontError: Images of different pixels, or a metric that was asked for and cannot be evaluated.
    """
    check_alike(image, reference)
    outcome = Outcome(image, reference)
    for name in names or METRICS:
        try:
            pixels = error_map(name, image.pixels, reference.pixels, outcome.display)
        except WavefrontError as error:
            if names:
                raise
            outcome.notes.append(str(error))
            continue
        outcome.errors[name] = METRICS[name].mean(pixels)
        if name == drawn:
            outcome.drawn = pixels
    return outcome


def find_bias(outcome: Outcome, settings: dict, required: bool) -> None:
    """Adds the bias test, or a note why there is none.

    Args:
        outcome: Of two images.
        settings: Of `bias_test.find_bias`.
        required: Whether it is an error if there is none.

    Raises:
        WavefrontError: There is none, and it is required.
    """
    try:
        try:
            from tools import bias_test  # here, because nothing else needs scipy
        except ImportError as error:
            raise WavefrontError(
                f"no bias test: the package {error.name} is not installed; it comes with pip install '.[measure]'"
            ) from None
        outcome.bias = bias_test.find_bias(outcome.image, outcome.reference, **settings)
    except WavefrontError as error:
        if required:
            raise
        outcome.notes.append(str(error))


# --- what is shown -----------------------------------------------------------------------------------------------


def metric_table(outcome: Outcome) -> Table:
    """The errors."""
    table = Table("metric", "error", "definition")
    for name, value in outcome.errors.items():
        metric = METRICS[name]
        formula = metric.formula
        if name == "flip":
            formula = f"{'LDR' if outcome.display else 'HDR'}-FLIP: {formula}"
        table.add_row(metric.label, f"{value:.6g}", formula)
    return table


def bias_lines(bias: BiasTest) -> list[str]:
    """The outcome of the bias test in words."""
    comparison = bias.comparison
    rows, columns = comparison.error.shape[:2]
    height, width = (np.diff(edges).max() for edges in bias.edges)
    count, what = rows * columns, "luminance" if bias.channels == "Y" else "R, G, B"
    lines = [
        f"bias test of {what}: {bias.failing_tiles or 'none'} of {count} tiles "
        f"{'differs' if bias.failing_tiles == 1 else 'differ'} ({columns}x{rows}, of {width}x{height} pixels or less; "
        f"false alarm rate {bias.rate:g} in all); smallest p, corrected: {comparison.smallest_p:.2g}"
    ]
    ratio = bias.ratio()
    if ratio:
        value, (low, high) = ratio
        lines.append(
            f"ratio of means {value:.5f}, 95 % interval {low:.5f} to {high:.5f}; "
            f"a difference of {100.0 * comparison.detectable():.2g} % would be found in a tile"
        )
    lines += [f"{path} has no variances: it is taken as exact" for path in bias.exact]
    return lines


def failure_table(failures: list[dict]) -> Table:
    """The worst tiles."""
    table = Table("tile, pixels", "channel", "mean", "reference", "difference", "standard errors", "p")
    for one in failures[:FAILURES_SHOWN]:
        difference = one["mean"] - one["reference_mean"]
        table.add_row(
            f"({one['x']}, {one['y']}) to ({one['x'] + one['width'] - 1}, {one['y'] + one['height'] - 1})",
            one["channel"],
            f"{one['mean']:.5g}",
            f"{one['reference_mean']:.5g}",
            f"{100.0 * difference / one['reference_mean']:+.2f} %" if one["reference_mean"] else f"{difference:+.3g}",
            f"{difference / one['standard_error']:+.1f}" if one["standard_error"] else "no error",
            f"{one['p']:.1e}",
        )
    return table


def show(outcome: Outcome) -> None:
    """Prints everything."""
    console = Console(width=None if sys.stdout.isatty() else 160, highlight=False, markup=False, soft_wrap=True)
    console.print(f"{outcome.image.path} against {outcome.reference.path}")
    if outcome.errors:
        console.print(metric_table(outcome))
    if outcome.bias:
        console.print("\n".join(bias_lines(outcome.bias)))
        failures = outcome.bias.failures()
        if failures:
            console.print(failure_table(failures))
        if len(failures) > FAILURES_SHOWN:
            console.print(f"and {len(failures) - FAILURES_SHOWN} more (all with --json)")
    for note in outcome.notes:
        console.print(f"note: {note}")


def write_error_image(path: Path, metric: str, pixels: np.ndarray, scale: float | None) -> dict:
    """Writes a map of errors in false colours; returns what they mean."""
    if scale is None:
        scale = float(np.percentile(pixels, SCALE_PERCENTILE)) or float(pixels.max()) or 1.0
    write_png(path, false_color(pixels, scale))
    return {"file": str(path), "metric": metric, "black": 0.0, "white": scale}


# --- the command -------------------------------------------------------------------------------------------------


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.compare", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("image", type=Path, metavar="A", help="OpenEXR, PNG, Radiance HDR, TIFF, JPEG")
    parser.add_argument("reference", type=Path, metavar="REF")
    parser.add_argument(
        "--metric", nargs="+", action="extend", default=[], metavar="NAME", help=f"of {', '.join(METRICS)}; default all"
    )
    parser.add_argument("--layer", metavar="NAME", help="of A, if it is an OpenEXR file with several")
    parser.add_argument("--reference-layer", metavar="NAME", help="of REF")
    parser.add_argument(
        "--error-image",
        type=Path,
        metavar="FILE.png",
        help=f"errors of pixels in false colours, of the first --metric or {ERROR_METRIC}",
    )
    parser.add_argument(
        "--error-scale",
        type=float,
        metavar="E",
        help=f"error that is white in it; default: that which {SCALE_PERCENTILE:g} %% of pixels do not exceed",
    )
    parser.add_argument("--bias-test", action="store_true", help="exit with 1 if a tile differs; needs variances")
    parser.add_argument("--tile", type=int, metavar="N", help="pixels along a tile of the bias test; default 16")
    parser.add_argument("--false-alarm-rate", type=float, metavar="P", help="of the whole bias test; default 0.0001")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also writes the figures")
    return parser


def check_options(options: argparse.Namespace) -> None:
    """Refuses bad values, and outputs that cannot be written, before anything is read.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    for name in options.metric:
        find_metric(name)
    if options.tile is not None and options.tile < 1:
        raise WavefrontError(f"--tile {options.tile}; allowed: 1 or more")
    if options.false_alarm_rate is not None and not 0.0 < options.false_alarm_rate < 1.0:
        raise WavefrontError(f"--false-alarm-rate {options.false_alarm_rate:g}; allowed: between 0 and 1")
    if options.error_scale is not None:
        if not (options.error_scale > 0.0 and math.isfinite(options.error_scale)):
            raise WavefrontError(f"--error-scale {options.error_scale:g}; allowed: above 0")
        if options.error_image is None:
            raise WavefrontError("--error-scale says what is white in --error-image, which is missing")
    if options.error_image is not None and options.error_image.suffix.lower() != ".png":
        raise WavefrontError(f"{options.error_image}: the error image is a PNG; allowed: a name that ends in .png")
    inputs = {os.path.realpath(path) for path in (options.image, options.reference)}
    for path in (options.error_image, options.json):
        if path is not None:
            if os.path.realpath(path) in inputs:
                raise WavefrontError(f"{path}: would be overwritten, but is one of the images")
            check_writable(path)


def run(options: argparse.Namespace) -> int:
    """Compares and prints; returns the exit status.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    check_options(options)
    image = read_image(options.image, options.layer)
    reference = read_image(options.reference, options.reference_layer)
    drawn = (options.metric or [ERROR_METRIC])[0] if options.error_image else None
    outcome = measure(image, reference, options.metric, drawn)
    settings = {"tile": options.tile, "rate": options.false_alarm_rate}
    find_bias(outcome, {name: value for name, value in settings.items() if value is not None}, options.bias_test)
    show(outcome)
    figures = outcome.figures()
    if drawn:
        legend = write_error_image(options.error_image, drawn, outcome.drawn, options.error_scale)
        figures["error_image"] = legend
        print(f"{legend['file']}: {METRICS[drawn].label} of pixels, black 0, white {legend['white']:.4g} and more")
    if options.json:
        with replacing(options.json) as temporary:
            temporary.write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return int(options.bias_test and outcome.bias.failing_tiles > 0)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status: 0, 1 where --bias-test fails, or 2 after an error, printed in one line."""
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
