"""The HTML page of an experiment: one file that needs nothing else. Its parts that are not of Python are in page/."""

from __future__ import annotations

import base64
import dataclasses
import math
from collections.abc import Sequence
from html import escape
from importlib import resources
from string import Template

import msgspec

from tools.false_color import TABLE
from tools.metrics import METRICS, error_map
from tools.report_pixels import encode
from tools.report_plots import COLOURS, curves, figure_words, mark, number, svg
from tools.results import Record, Results, SceneEntry
from tools.summary import Cell, Figure, remarks
from wavefront.errors import WavefrontError

PIXEL_METRICS = tuple(name for name in METRICS if name not in ("trimmed-relmse", "flip"))  # page/pixels.js has them


@dataclasses.dataclass(frozen=True)
class Crop:
    """A region of the images of a scene: a name, and x, y, width and height in pixels."""

    name: str
    x: int
    y: int
    w: int
    h: int


class Pixels:
    """The images of a page, as elements that hold text."""

    def __init__(self):
        self.elements: list[str] = []

    def add(self, pixels) -> dict:
        """Stores an image, [height, width, C]; returns how the page finds it."""
        text, exponent = encode(pixels)
        self.elements.append(f'<script type="text/plain" id="pixels-{len(self.elements)}">{text}</script>')
        return {"pixels": len(self.elements) - 1, "exponent": exponent}


def make_page(
    results: Results, cells: Sequence[Cell], metric: str, crops: dict[str, list[Crop]], images: str
) -> tuple[str, list[str]]:
    """The page.

    Args:
        results: With at least one run; its baseline is that of the speed-ups.
        cells: Its summary.
        metric: That is shown first.
        crops: By scene.
        images: Of which budgets: ``all``, ``largest`` or ``none``.

    Returns:
        HTML, and warnings.

    Raises:
        WavefrontError: An image or reference is missing, damaged or has another size, or a crop leaves an image.
    """
    experiment, pixels, warnings = results.experiment, Pixels(), []
    view_metrics = _view_metrics(experiment.metrics)
    if "flip" in view_metrics and images != "none" and not _has_flip():
        view_metrics.remove("flip")
        warnings.append(
            "flip-evaluator is not installed: the error view has no FLIP; it comes with pip install '.[flip]'"
        )
    scenes = []
    if images != "none":
        for scene in experiment.scenes:
            records = _with_images(results, scene.name, images)
            if records:
                scenes.append(
                    _scene_data(results, scene, records, pixels, crops.get(scene.name, []), "flip" in view_metrics)
                )
    data = {
        "scenes": scenes,
        "methods": [method.name for method in experiment.methods],
        "budgets": [budget.label for budget in experiment.budgets],
        "metrics": view_metrics,
        "labels": {name: METRICS[name].label for name in METRICS},
        "shown": metric,
        "colours": base64.b64encode(TABLE.tobytes()).decode("ascii"),
    }
    total = len(experiment.scenes) * len(experiment.methods) * len(experiment.budgets) * len(experiment.seeds)
    facts = [
        experiment.machine["cpu"],
        f"{experiment.threads} thread{'s' * (experiment.threads != 1)}",
        experiment.device,
        f"{len(results.records)} runs" if len(results.records) == total else f"{len(results.records)} of {total} runs",
        experiment.date.partition("T")[0],
    ]
    notes = "".join(f"<li>{escape(line)}</li>" for line in remarks(results, cells))
    page = Template(_part("report.html")).substitute(
        title=escape(experiment.name),
        description=f"<p>{escape(experiment.description)}</p>" if experiment.description else "",
        facts=escape(" · ".join(fact for fact in facts if fact)),
        metrics="".join(_option(name, METRICS[name].label, name == metric) for name in experiment.metrics),
        tables="".join(table(results, cells, name, name != metric) for name in experiment.metrics),
        remarks=f'<ul class="remarks">{notes}</ul>' if notes else "",
        legend=_legend(results, cells),
        plots="".join(_plots(results, cells, name, name != metric) for name in experiment.metrics),
        setup=_setup(results),
        footer=_footer(bool(scenes), images),
        style=_part("report.css"),
        script="\n".join(map(_part, ("pixels.js", "viewer.js", "table.js", "controls.js"))),
        # In a script element, only "<" could end it.
        data=msgspec.json.encode(data).decode("utf-8").replace("<", "\\u003c"),
        pixels="\n".join(pixels.elements),
    )
    return page, warnings


def _part(name: str) -> str:
    return resources.files("tools").joinpath("page", name).read_text(encoding="utf-8")


def _option(value: str, label: str, selected: bool) -> str:
    return f'<option value="{escape(value)}"{" selected" * selected}>{escape(label)}</option>'


# --- images ------------------------------------------------------------------------------------------------------


def _view_metrics(metrics: Sequence[str]) -> list[str]:
    """Metrics of the error view: those of the experiment first. FLIP is there only if it was measured."""
    first = [name for name in metrics if name in PIXEL_METRICS or name in ("flip", "trimmed-relmse")]
    return first + [name for name in PIXEL_METRICS if name not in first]


def _has_flip() -> bool:
    try:
        import flip_evaluator  # noqa: F401 (looked for before images are read)
    except ImportError:
        return False
    return True


def _with_images(results: Results, scene: str, images: str) -> list[Record]:
    """Of each method and budget of a scene, the first run whose image was kept."""
    chosen: dict = {}
    for record in results.records:
        if record.scene == scene and record.image is not None:
            key = (record.method, record.budget) if images == "all" else record.method
            known = chosen.get(key)
            if known is None or (record.samples > known.samples and record.budget != known.budget):
                chosen[key] = record
    return list(chosen.values())


def _scene_data(
    results: Results, scene: SceneEntry, records: list[Record], pixels: Pixels, crops: list[Crop], flip: bool
) -> dict:
    experiment = results.experiment
    reference = results.reference(scene.name).image
    height, width = reference.shape[:2]
    for crop in crops:
        if crop.x + crop.w > width or crop.y + crop.h > height:
            raise WavefrontError(
                f"crop {crop.name!r}: {crop.w}x{crop.h}+{crop.x}+{crop.y} leaves the image of {scene.name}, which has "
                f"{width}x{height} pixels"
            )
    methods = [method.name for method in experiment.methods]
    words = f"{scene.reference.renderer}, {scene.reference.samples} spp"
    data = {
        "name": scene.name,
        "width": width,
        "height": height,
        "reference": pixels.add(reference) | {"words": words},
        "images": [],
        "crops": [dataclasses.asdict(crop) for crop in crops],
    }
    for record in records:
        image = results.image(record)
        if image.shape != reference.shape:
            raise WavefrontError(
                f"{results.folder / record.image}: has {image.shape[1]}x{image.shape[0]} pixels; the reference has "
                f"{width}x{height}"
            )
        entry = {
            "method": methods.index(record.method),
            "budget": experiment.budgets.index(record.budget),
            "errors": record.errors,
        }
        if flip:
            entry["flip"] = pixels.add(error_map("flip", image, reference)[..., None])
        data["images"].append(entry | pixels.add(image))
    return data


# --- the table ---------------------------------------------------------------------------------------------------


def table(results: Results, cells: Sequence[Cell], metric: str, hidden: bool = False) -> str:
    """The summary by one metric; attributes ``data-value`` have all digits."""
    baseline = results.experiment.baseline
    heads = ["method", "runs", METRICS[metric].label, "95 %", "time,\u00a0s", "95 %", "spp", "efficiency"]
    heads += [f"speed-up over {baseline}", "95 %"] if baseline else []
    rows, before = [], None
    for cell in cells:
        if before != (cell.scene, cell.budget):
            before = cell.scene, cell.budget
            group = f"{escape(cell.scene)} · {escape(cell.budget.label)}"
            rows.append(f'{"</tbody>" * bool(rows)}<tbody><tr><th class="group" scope="rowgroup" '
                        f'colspan="{len(heads)}">{group}</th></tr>')  # fmt: skip
        rows.append(_row(results, cell, metric))
    names = "".join(
        f'<th scope="col" class="{"name" if i == 0 else "interval" if head == "95 %" else ""}">{escape(head)}</th>'
        for i, head in enumerate(heads)
    )
    return (
        f'<div class="scroll" data-metric="{escape(metric)}"{" hidden" * hidden}><table class="results">'
        f"<thead><tr>{names}</tr></thead>{''.join(rows)}</tbody></table></div>"
    )


def _row(results: Results, cell: Cell, metric: str) -> str:
    baseline = results.experiment.baseline
    name = f"{_key(results, cell.method)}{escape(cell.method)}{' *' * bool(cell.notes)}"
    parts = [f'<tr><th class="name" scope="row">{name}</th>', _value("runs", cell.runs)]
    parts += [_figure("error", cell.errors[metric]), _figure("time", cell.seconds)]
    parts += [_value("spp", cell.samples.mean), _value("efficiency", cell.efficiency.get(metric))]
    if baseline:
        if cell.method == baseline:
            parts.append('<td class="baseline">1</td><td class="interval"></td>')
        else:
            parts.append(_figure("speed-up", cell.speed_up.get(metric, Figure(math.nan)), strong_without=1.0))
    return "".join([*parts, "</tr>"])


def _value(name: str, value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return f'<td data-name="{name}"></td>'
    return f'<td data-name="{name}" data-value="{value!r}">{number(value)}</td>'


def _figure(name: str, figure: Figure, strong_without: float | None = None) -> str:
    if not math.isfinite(figure.mean):
        return f'<td data-name="{name}"></td><td class="interval"></td>'
    text, interval, ends = number(figure.mean), "", ""
    if math.isfinite(figure.low):
        interval = f"{number(figure.low)} – {number(figure.high)}"
        ends = f' data-low="{figure.low!r}" data-high="{figure.high!r}"'
        if strong_without is not None and not figure.low <= strong_without <= figure.high:
            text = f"<strong>{text}</strong>"
    return (
        f'<td data-name="{name}" data-value="{figure.mean!r}"{ends} title="{escape(figure_words(figure))}">{text}</td>'
        f'<td class="interval">{interval}</td>'
    )


# --- the rest ----------------------------------------------------------------------------------------------------


def _key(results: Results, method: str) -> str:
    """The mark of a method, in its colour."""
    place = [entry.name for entry in results.experiment.methods].index(method)
    colour = f"--colour:var(--m{place % len(COLOURS)})"
    return f'<svg class="key" viewBox="-7 -7 14 14" style="{colour}" aria-hidden="true">{mark(place, 0, 0)}</svg>'


def _legend(results: Results, cells: Sequence[Cell]) -> str:
    seen = {cell.method for cell in cells}
    items = [
        f"<li>{_key(results, method.name)}{escape(method.name)}</li>"
        for method in results.experiment.methods
        if method.name in seen
    ]
    return f'<ul class="legend">{"".join(items)}</ul>'


def _plots(results: Results, cells: Sequence[Cell], metric: str, hidden: bool) -> str:
    parts = [f'<div class="plots" data-metric="{escape(metric)}"{" hidden" * hidden}>']
    for scene in results.experiment.scenes:
        found = curves(results, cells, scene.name, metric)
        if found:
            label = METRICS[metric].label
            parts.append(f"<h3>{escape(scene.name)}</h3>")
            parts.append(svg(found, "seconds", metric, f"{scene.name}: {label} against time"))
            parts.append(svg(found, "samples", metric, f"{scene.name}: {label} against samples per pixel"))
    return "".join([*parts, "</div>"])


def _setup(results: Results) -> str:
    experiment = results.experiment
    scenes = [
        [
            scene.name,
            f"{scene.width} × {scene.height}",
            f"{scene.reference.renderer}, {scene.reference.samples} spp, relative standard error "
            f"{number(scene.reference.error)}",
            " ".join([*scene.overrides, *(f"{key}={value}" for key, value in scene.parameters.items())]),
        ]
        for scene in experiment.scenes
    ]
    methods = [
        [
            method.name,
            method.renderer,
            " ".join(method.overrides),
            ", ".join(f"{key} {value}" for key, value in method.versions.items()),
        ]
        for method in experiment.methods
    ]
    machine = [[key, value if isinstance(value, str) else msgspec.json.encode(value).decode()]
               for key, value in experiment.machine.items()]  # fmt: skip
    machine += [["threads", str(experiment.threads)], ["device", experiment.device], ["date", experiment.date]]
    machine += [["commit", experiment.commit]] if experiment.commit else []
    machine += [["seeds", ", ".join(map(str, experiment.seeds))]]
    return (
        _plain_table(["scene", "size", "reference", "settings"], scenes)
        + _plain_table(["method", "renderer", "settings", "versions"], methods)
        + f"<details><summary>Machine and date</summary>{_plain_table([], machine)}</details>"
    )


def _plain_table(heads: list[str], rows: list[list[str]]) -> str:
    head = f"<thead><tr>{''.join(f'<th scope=col>{escape(h)}</th>' for h in heads)}</tr></thead>" if heads else ""
    body = "".join(f"<tr>{''.join(f'<td>{escape(str(text))}</td>' for text in row)}</tr>" for row in rows)
    return f'<div class="scroll"><table class="setup">{head}<tbody>{body}</tbody></table></div>'


def _footer(has_images: bool, images: str) -> str:
    if not has_images:
        return "Made by tools.report."
    return (
        "Made by tools.report. Images are those of the first seed"
        + (", of the budget with the most samples alone" if images == "largest" else "")
        + ". Their pixels are 16-bit floats here, with an error of at most 0.05 %: errors of pixels and crops may "
        "differ from the table in the fourth digit, and mean nothing where an image is that close to its reference."
    )
