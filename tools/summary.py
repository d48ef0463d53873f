"""Statistics of the runs of an experiment: means with confidence intervals, efficiency, speed-up.

Runs of a cell (one scene, method and budget) differ in their seeds alone and are independent. Intervals are of 95 %, by
Student's t on the runs, which rests on means of runs being nearly normal: with a handful of runs of a method with rare
bright samples they are too short, and with one run there is none. What the noise of the reference adds to an error is
the same for all runs and in no interval; `Cell.floor` says how much it is. Efficiency, speed-up and ratios are of what
is above it.

The *efficiency* is 1 / (error · time) for errors that are squares, and so fall with 1/time; for others, which fall with
its root, 1 / (error² · time). The *speed-up* over the baseline is the ratio of the efficiencies at the same budget: the
baseline needs so many times the time for the same error. Time is that of rendering, with all training. A method that
makes another image than the reference's (a shorter depth, say) has no speed-up: its error does not fall to zero.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from rich.table import Table

from tools.bench_common import require_scipy
from tools.metrics import METRICS
from tools.results import Budget, Record, Results

CONFIDENCE = 0.95
SQUARES = ("mse", "relmse", "trimmed-relmse", "mrse")  # metrics that fall with 1/time
NOISY_REFERENCE = 0.1  # share of a relMSE that may come from the reference without a word


@dataclasses.dataclass(frozen=True)
class Figure:
    """A mean and its confidence interval, whose ends are NaN where it is not known.

    Attributes:
        mean: Or a ratio of means.
        low, high: Ends of the interval.
    """

    mean: float
    low: float = math.nan
    high: float = math.nan

    def plain(self) -> dict:
        """For JSON: null where there is no number."""
        return {key: value if math.isfinite(value) else None for key, value in dataclasses.asdict(self).items()}

    def __str__(self) -> str:
        if not math.isfinite(self.low):
            return f"{self.mean:.3g}"
        return f"{self.mean:.3g} ({self.low:.3g} to {self.high:.3g})"


def _student(degrees: float) -> float:
    """Half the width of an interval in standard errors."""
    return float(require_scipy().t.isf((1.0 - CONFIDENCE) / 2.0, degrees))


def mean_figure(values: Sequence[float]) -> Figure:
    """Mean of independent values and its interval by Student's t; none for one value."""
    values = np.asarray(values, float)
    n, mean = len(values), float(np.mean(values))
    if n < 2:
        return Figure(mean)
    half = _student(n - 1) * float(values.std(ddof=1)) / math.sqrt(n)
    return Figure(mean, mean - half, mean + half)


def ratio_figure(a: Sequence[float], b: Sequence[float]) -> Figure:
    """Ratio of the means of independent positive values, a over b.

    The interval is that of the logarithm: its variance is (s_a / m_a)^2 / n_a + (s_b / m_b)^2 / n_b to first order,
    with Welch and Satterthwaite's degrees of freedom. None if either has one value alone.
    """
    a, b = np.asarray(a, float), np.asarray(b, float)
    if not (a.mean() > 0.0 and b.mean() > 0.0):
        return Figure(math.nan)
    ratio = float(a.mean() / b.mean())
    if min(len(a), len(b)) < 2:
        return Figure(ratio)
    parts = [(values.std(ddof=1) / values.mean()) ** 2 / len(values) for values in (a, b)]
    variance = sum(parts)
    if variance == 0.0:
        return Figure(ratio, ratio, ratio)
    degrees = variance**2 / sum(part**2 / (len(v) - 1) for part, v in zip(parts, (a, b), strict=True))
    factor = math.exp(_student(degrees) * math.sqrt(variance))
    return Figure(ratio, ratio / factor, ratio * factor)


def errors_above(records: Sequence[Record], metric: str, floor: float) -> np.ndarray:
    """The error of each run, less what the noise of the reference adds."""
    return np.array([record.errors[metric] for record in records]) - floor


def costs(records: Sequence[Record], metric: str, floor: float = 0.0) -> np.ndarray:
    """Error above the floor times time of each run, for a metric that is no square its square times time; 1 / it is the
    efficiency."""
    errors = errors_above(records, metric, floor)
    seconds = np.array([record.seconds.render for record in records])
    return (errors if metric in SQUARES else errors**2) * seconds


@dataclasses.dataclass
class Cell:
    """The runs of one scene, method and budget.

    Attributes:
        scene, method, budget: Which.
        runs: How many.
        samples: Per pixel.
        seconds: Of rendering with training.
        training: Of training alone.
        overhead: Seconds of loading and compiling, mean.
        errors: By metric.
        efficiency: By metric, 1 / mean cost.
        speed_up: Over the baseline, by metric; empty without one, and where there are notes.
        error_ratio: Error of the baseline over this, by metric: what the method gains at the same budget.
        floor: By metric, what the noise of the reference adds to the errors, where it is known.
        notes: Of its runs.
    """

    scene: str
    method: str
    budget: Budget
    runs: int
    samples: Figure
    seconds: Figure
    training: float
    overhead: float
    errors: dict[str, Figure]
    efficiency: dict[str, float]
    speed_up: dict[str, Figure]
    error_ratio: dict[str, Figure]
    floor: dict[str, float]
    notes: list[str]

    def plain(self) -> dict:
        """For JSON."""
        value = {
            "scene": self.scene,
            "method": self.method,
            "budget": {k: v for k, v in (("spp", self.budget.spp), ("seconds", self.budget.seconds)) if v is not None},
            "runs": self.runs,
            "samples": self.samples.plain(),
            "seconds": self.seconds.plain(),
            "training_seconds": self.training,
            "load_and_compile_seconds": self.overhead,
            "efficiency": self.efficiency,
            "reference_floor": self.floor,
            "notes": self.notes,
        }
        for name in ("errors", "speed_up", "error_ratio"):
            value[name] = {metric: figure.plain() for metric, figure in getattr(self, name).items()}
        return value


def summarise(results: Results) -> list[Cell]:
    """The cells of an experiment that have runs, in its order."""
    cells, experiment = results.cells(), results.experiment
    floors = {scene.name: {"relmse": scene.reference.error**2} for scene in experiment.scenes}
    summary = []
    for (scene, method, budget), records in cells.items():
        baseline = cells.get((scene, experiment.baseline, budget)) if experiment.baseline else None
        errors = {metric: [record.errors[metric] for record in records] for metric in experiment.metrics}
        notes = sorted({note for record in records for note in record.notes})
        speed_up, error_ratio, floor = {}, {}, {m: floors[scene][m] for m in experiment.metrics if m in floors[scene]}
        if baseline and method != experiment.baseline:
            for metric in experiment.metrics:
                if not notes:
                    speed_up[metric] = ratio_figure(
                        *(costs(r, metric, floor.get(metric, 0.0)) for r in (baseline, records))
                    )
                error_ratio[metric] = ratio_figure(
                    *(errors_above(r, metric, floor.get(metric, 0.0)) for r in (baseline, records))
                )
        mean_costs = {metric: float(costs(records, metric, floor.get(metric, 0.0)).mean()) for metric in errors}
        summary.append(
            Cell(
                scene,
                method,
                budget,
                len(records),
                mean_figure([record.samples for record in records]),
                mean_figure([record.seconds.render for record in records]),
                float(np.mean([record.seconds.training for record in records])),
                float(np.mean([record.seconds.load + record.seconds.compile for record in records])),
                {metric: mean_figure(values) for metric, values in errors.items()},
                {metric: 1.0 / cost for metric, cost in mean_costs.items() if cost > 0.0},
                speed_up,
                error_ratio,
                floor,
                notes,
            )
        )
    return summary


# --- tables ------------------------------------------------------------------------------------------------------


def _columns(results: Results) -> list[str]:
    error, baseline = METRICS[results.experiment.metrics[0]].label, results.experiment.baseline
    columns = ["scene", "budget", "method", "runs", f"{error} (95 % interval)", "time, s", "spp", "efficiency"]
    return columns + ([f"speed-up over {baseline} (95 % interval)"] if baseline else [])


def _cells(cell: Cell, metric: str, baseline: str | None) -> list[str]:
    row = [cell.scene, cell.budget.label, cell.method + " *" * bool(cell.notes), str(cell.runs)]
    row += [str(cell.errors[metric]), f"{cell.seconds.mean:.3g}", f"{cell.samples.mean:.4g}"]
    row.append(f"{cell.efficiency[metric]:.3g}" if metric in cell.efficiency else "")
    if baseline:
        speed_up = cell.speed_up.get(metric, Figure(math.nan))  # not a number if an error is all noise of the reference
        row.append("1" if cell.method == baseline else str(speed_up) if math.isfinite(speed_up.mean) else "")
    return row


def table(results: Results, cells: Sequence[Cell]) -> Table:
    """The summary by the first metric, for a terminal."""
    experiment = results.experiment
    threads = f"{experiment.threads} thread{'s' * (experiment.threads != 1)}"
    title = f"{experiment.name}: {threads}, {experiment.machine['cpu']}"
    view = Table(title=title, title_justify="left")
    for i, name in enumerate(_columns(results)):
        view.add_column(name, justify="left" if i < 3 else "right")
    before = None
    for cell in cells:
        if before not in (None, (cell.scene, cell.budget)):
            view.add_section()
        before = cell.scene, cell.budget
        view.add_row(*_cells(cell, experiment.metrics[0], experiment.baseline))
    return view


def markdown(results: Results, cells: Sequence[Cell]) -> str:
    """The summary by the first metric, for a README, with its remarks."""
    columns = _columns(results)
    lines = [columns, ["---"] * 3 + ["---:"] * (len(columns) - 3)]
    lines += [_cells(cell, results.experiment.metrics[0], results.experiment.baseline) for cell in cells]
    text = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    return text + "".join(f"\n{line}\n" for line in remarks(results, cells))


def remarks(results: Results, cells: Sequence[Cell]) -> list[str]:
    """What a reader of the table must know: notes, noisy references, references that two renderers disagree on."""
    lines = []
    for note in sorted({f"* {cell.method}, {cell.scene}: {note}" for cell in cells for note in cell.notes}):
        lines.append(note)
    for scene in results.experiment.scenes:
        shares = [
            scene.reference.error**2 / cell.errors["relmse"].mean
            for cell in cells
            if cell.scene == scene.name and "relmse" in cell.errors and cell.errors["relmse"].mean > 0.0
        ]
        if shares and max(shares) > NOISY_REFERENCE:
            lines.append(
                f"{scene.name}: up to {100.0 * min(max(shares), 1.0):.0f} % of a relMSE is the noise of the reference "
                f"(relative standard error {scene.reference.error:.2g}); efficiency and speed-up leave it out"
            )
        for comparison in scene.reference.comparisons:
            if comparison["verdict"] != "same":
                noisy = comparison["verdict"] == "noisy"
                words = "are too noisy to be compared" if noisy else "differ"
                lines.append(f"{scene.name}: the references of two renderers {words}")
    return lines
