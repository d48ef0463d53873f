"""Convergence plots of an experiment: error against time and against samples, both axes logarithmic.

Lines are the errors on the way of the runs with the most samples, means over the runs; marks are the ends of the runs
of every budget, which are the figures of the table. Bands and whiskers are 95 % intervals of the mean; where one
reaches zero, it goes to the lower edge.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from tools.metrics import METRICS
from tools.results import Results, slug
from tools.summary import Cell, Figure, mean_figure
from wavefront.errors import WavefrontError
from wavefront.scene.images import replacing

# For light backgrounds; those for dark ones are in page/report.css. Beyond their number, lines are dashed.
COLOURS = ("#1260a8", "#c4450c", "#0a7a55", "#96407f", "#7d6400", "#2389ad", "#555555", "#cc5570")
DASHES = ("", "7 4", "2 3", "9 3 2 3")
MARKS = "osD^vPX*"  # as matplotlib calls them
AXES = {"seconds": "time, s", "samples": "samples per pixel"}


@dataclasses.dataclass(frozen=True)
class Place:
    """A point of a plot: samples per pixel, seconds, and the error there."""

    samples: float
    seconds: float
    error: Figure


@dataclasses.dataclass(frozen=True)
class Curve:
    """What is drawn of a method on a scene.

    Attributes:
        method: Its name.
        number: Its place among the methods, which decides the colour.
        way: Of the runs with the most samples, in the order of the samples; the last is their end.
        ends: Of the runs of every budget, with the label of the budget.
    """

    method: str
    number: int
    way: list[Place]
    ends: list[tuple[str, Place]]


def curves(results: Results, cells: Sequence[Cell], scene: str, metric: str) -> list[Curve]:
    """The curves of a scene, for the methods that have runs.

    Runs of one method and seed with different budgets may share their samples, so that a line is of one budget alone.

    Args:
        results: An experiment.
        cells: Its summary.
        scene: Name.
        metric: One of the experiment.
    """
    runs, found = results.cells(), []
    for number, method in enumerate(results.experiment.methods):
        ends = [cell for cell in cells if (cell.scene, cell.method) == (scene, method.name)]
        if not ends:
            continue
        last = max(ends, key=lambda cell: cell.samples.mean)
        on_the_way = [{point.samples: point for point in r.points[:-1]} for r in runs[scene, method.name, last.budget]]
        way = []
        for samples in sorted(set.intersection(*map(set, on_the_way))):
            points = [run[samples] for run in on_the_way]
            error = mean_figure([point.errors[metric] for point in points])
            way.append(Place(samples, float(np.mean([point.seconds for point in points])), error))
        way.append(_end(last, metric))
        found.append(Curve(method.name, number, way, [(cell.budget.label, _end(cell, metric)) for cell in ends]))
    return found


def _end(cell: Cell, metric: str) -> Place:
    return Place(cell.samples.mean, cell.seconds.mean, cell.errors[metric])


def _visible(places: Sequence[Place], axis: str) -> list[tuple[float, Figure]]:
    """x and y of what a logarithmic plot can show."""
    shown = [(getattr(place, axis), place.error) for place in places]
    return [(x, error) for x, error in shown if x > 0.0 and error.mean > 0.0]


# --- axes --------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class LogAxis:
    """A logarithmic axis from `low` to `high` along a length that begins at `start`; a negative length goes up."""

    low: float
    high: float
    start: float
    length: float

    def __call__(self, value: float) -> float:
        """Where a value is; what lies outside is at the nearer end."""
        share = math.log(max(value, 1e-300) / self.low) / math.log(self.high / self.low)
        return self.start + self.length * min(max(share, 0.0), 1.0)

    def ticks(self) -> list[float]:
        """Values to be labelled: decades, or 1, 2 and 5 of each where there would be fewer than three of them."""
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        for leads in ((1.0,), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)):
            found = [lead * 10.0**k for k in decades for lead in leads if self.low <= lead * 10.0**k <= self.high]
            if len(found) >= 3:
                break
        return found[:: math.ceil(len(found) / 9)] if found else [self.low]


def _ranges(found: Sequence[Curve], axis: str) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Ranges of x and y with all means, and of the intervals what does not squeeze them; None: there is nothing."""
    shown = _visible([place for curve in found for place in (*curve.way, *(place for _, place in curve.ends))], axis)
    if not shown:
        return None
    errors = [error.mean for _, error in shown]
    errors += [error.high for _, error in shown if error.high < 5.0 * error.mean]
    errors += [error.low for _, error in shown if error.low > 0.2 * error.mean]
    return _padded([x for x, _ in shown]), _padded(errors)


def _padded(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    margin = (high / low) ** 0.05 if high / low > 1.2 else 1.2
    return low / margin, high * margin


def number(value: float) -> str:
    """A number with three digits, for a reader."""
    if value != 0.0 and not 1e-4 <= abs(value) < 1e6:
        mantissa, _, exponent = f"{value:.2e}".partition("e")
        digits = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        mantissa = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
        return f"10{digits}" if mantissa == "1" else f"{mantissa}·10{digits}"
    return np.format_float_positional(value, precision=3, unique=False, fractional=False, trim="-")


# --- in a page ---------------------------------------------------------------------------------------------------

WIDTH, HEIGHT = 560, 360
LEFT, RIGHT, TOP, BOTTOM = 62, 14, 12, 46


def svg(found: Sequence[Curve], axis: str, metric: str, title: str) -> str:
    """A plot as an SVG element; its colours are the variables ``--m0`` … of the page.

    Args:
        found: See `curves`.
        axis: A key of `AXES`.
        metric: Of the errors.
        title: For those who cannot see it.
    """
    ranges = _ranges(found, axis)
    if ranges is None:
        return f'<p class="muted">{escape(title)}: nothing to draw, all errors are zero.</p>'
    x = LogAxis(*ranges[0], LEFT, WIDTH - LEFT - RIGHT)
    y = LogAxis(*ranges[1], HEIGHT - BOTTOM, -(HEIGHT - TOP - BOTTOM))
    parts = [f'<svg class="plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">']
    parts += _grid(x, y, axis, METRICS[metric].label)
    for curve in found:
        parts += [f'<g class="curve" style="--colour:var(--m{curve.number % len(COLOURS)})">']
        parts += [*_lines(curve, axis, x, y), *_marks(curve, axis, x, y), "</g>"]
    return "".join([*parts, "</svg>"])


def _grid(x: LogAxis, y: LogAxis, axis: str, label: str) -> list[str]:
    bottom, right = HEIGHT - BOTTOM, WIDTH - RIGHT
    parts = ['<g class="grid">']
    parts += [f'<path d="M{x(value):.1f} {TOP}V{bottom}"/>' for value in x.ticks()]
    parts += [f'<path d="M{LEFT} {y(value):.1f}H{right}"/>' for value in y.ticks()]
    parts += [f'</g><path class="frame" d="M{LEFT} {TOP}V{bottom}H{right}"/>']
    parts += [f'<text x="{x(v):.1f}" y="{bottom + 17}" text-anchor="middle">{number(v)}</text>' for v in x.ticks()]
    parts += [f'<text x="{LEFT - 7}" y="{y(v) + 4:.1f}" text-anchor="end">{number(v)}</text>' for v in y.ticks()]
    parts += [f'<text class="axis" x="{(LEFT + right) / 2}" y="{HEIGHT - 8}" text-anchor="middle">{AXES[axis]}</text>']
    middle = (TOP + bottom) / 2
    parts += [f'<text class="axis" transform="translate(14 {middle}) rotate(-90)" text-anchor="middle">{label}</text>']
    return parts


def _lines(curve: Curve, axis: str, x: LogAxis, y: LogAxis) -> list[str]:
    way = _visible(curve.way, axis)
    if len(way) < 2:
        return []
    parts = []
    band = [(value, error) for value, error in way if math.isfinite(error.low)]
    if len(band) > 1:
        edge = [f"{x(value):.1f} {y(error.high):.1f}" for value, error in band]
        edge += [f"{x(value):.1f} {y(error.low):.1f}" for value, error in reversed(band)]
        parts.append(f'<path class="band" d="M{"L".join(edge)}Z"/>')
    points = "L".join(f"{x(value):.1f} {y(error.mean):.1f}" for value, error in way)
    dash = DASHES[curve.number // len(COLOURS) % len(DASHES)]
    return [*parts, f'<path class="line" stroke-dasharray="{dash or "none"}" d="M{points}"/>']


def _marks(curve: Curve, axis: str, x: LogAxis, y: LogAxis) -> list[str]:
    parts = []
    for budget, place in curve.ends:
        for value, error in _visible([place], axis):
            if math.isfinite(error.low):
                parts.append(f'<path class="whisker" d="M{x(value):.1f} {y(error.low):.1f}V{y(error.high):.1f}"/>')
            words = f"{curve.method}, {budget}: {figure_words(error)}; {number(value)} {AXES[axis].partition(',')[0]}"
            parts.append(mark(curve.number, x(value), y(error.mean), f"<title>{escape(words)}</title>"))
    return parts


def mark(method: int, x: float, y: float, content: str = "") -> str:
    """The mark of a method, by its place among them, as an SVG element around x, y."""
    shapes = {
        "o": "M-4 0A4 4 0 1 0 4 0A4 4 0 1 0-4 0Z",
        "s": "M-3.6-3.6H3.6V3.6H-3.6Z",
        "D": "M0-5L5 0L0 5L-5 0Z",
        "^": "M0-4.8L4.6 3.4H-4.6Z",
        "v": "M0 4.8L4.6-3.4H-4.6Z",
        "P": "M-1.7-4.6H1.7V-1.7H4.6V1.7H1.7V4.6H-1.7V1.7H-4.6V-1.7H-1.7Z",
        "X": "M0-2.4L2.6-5L5-2.6L2.4 0L5 2.6L2.6 5L0 2.4L-2.6 5L-5 2.6L-2.4 0L-5-2.6L-2.6-5Z",
        "*": "M0-5.6L1.4-1.9L5.3-1.7L2.2.7L3.3 4.5L0 2.3L-3.3 4.5L-2.2.7L-5.3-1.7L-1.4-1.9Z",
    }
    path = shapes[MARKS[method % len(MARKS)]]
    return f'<path class="mark" transform="translate({x:.1f} {y:.1f})" d="{path}">{content}</path>'


def figure_words(figure: Figure) -> str:
    """A figure with its interval, in one line."""
    if not math.isfinite(figure.low):
        return number(figure.mean)
    return f"{number(figure.mean)} ({number(figure.low)} to {number(figure.high)})"


# --- as PNG files ------------------------------------------------------------------------------------------------


def write_plots(results: Results, cells: Sequence[Cell], metric: str, folder: Path) -> list[Path]:
    """Writes one PNG file for each scene that has runs, with both plots; returns their paths.

    Raises:
        WavefrontError: matplotlib is not installed, or a file cannot be written.
    """
    try:
        from matplotlib.figure import Figure as Canvas  # here, because nothing else needs it
    except ImportError:
        raise WavefrontError("matplotlib is not installed; it comes with pip install '.[measure]'") from None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WavefrontError(f"{folder}: cannot be made: {error.strerror or error}") from None
    paths = []
    for scene in results.experiment.scenes:
        found = curves(results, cells, scene.name, metric)
        if not found:
            continue
        canvas = Canvas(figsize=(10.0, 4.2), layout="constrained")
        for axes, axis in zip(canvas.subplots(1, 2), AXES, strict=True):
            _draw(axes, found, axis, metric)
        canvas.axes[0].legend(frameon=False)
        canvas.suptitle(f"{scene.name.replace('$', chr(92) + '$')}")  # a dollar would begin a formula
        paths.append(folder / f"{slug(scene.name)}.png")
        with replacing(paths[-1]) as temporary:
            canvas.savefig(temporary, dpi=150)
    return paths


def _draw(axes, found: Sequence[Curve], axis: str, metric: str) -> None:
    """One plot of matplotlib."""
    axes.set(xscale="log", yscale="log", xlabel=AXES[axis], ylabel=METRICS[metric].label)
    axes.grid(True, which="major", linewidth=0.5, alpha=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    ranges = _ranges(found, axis)
    if ranges is None:
        return
    axes.set(xlim=ranges[0], ylim=ranges[1])
    for curve in found:
        colour = COLOURS[curve.number % len(COLOURS)]
        style = (0, [float(word) for word in DASHES[curve.number // len(COLOURS) % len(DASHES)].split()] or None)
        way, ends = _visible(curve.way, axis), _visible([place for _, place in curve.ends], axis)
        label = curve.method.replace("$", r"\$").lstrip("_")  # with a line in front, matplotlib leaves it out
        axes.plot([x for x, _ in way], [e.mean for _, e in way], color=colour, linestyle=style, linewidth=1.4)
        band = [(x, e) for x, e in way if math.isfinite(e.low)]
        lows = [max(e.low, ranges[1][0]) for _, e in band]
        axes.fill_between([x for x, _ in band], lows, [e.high for _, e in band], color=colour, alpha=0.15, linewidth=0)
        mark_style = MARKS[curve.number % len(MARKS)]
        axes.plot([x for x, _ in ends], [e.mean for _, e in ends], mark_style, color=colour, label=label)
        for x, e in ends:
            if math.isfinite(e.low):
                axes.plot([x, x], [max(e.low, ranges[1][0]), e.high], color=colour, linewidth=1.0)
