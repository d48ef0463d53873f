"""What `tools.trade` prints and writes of a sweep: tables, JSON, and a plot of error against time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from tools.frontier import DOMINATED, FALSE_ALARM_RATE, FRONTIER, OPEN, Setting, Verdict
from tools.knobs import KNOBS, SPP, label
from tools.metrics import METRICS
from tools.results import Results
from tools.summary import NOISY_REFERENCE, Figure, mean_figure, ratio_figure
from tools.sweep import DEFAULT, Plan, Section, Sweep
from wavefront.errors import WavefrontError
from wavefront.scene.images import replacing

FORMAT = 1
PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#666666", "#8c510a")


def bias_share(section: Section, setting: Setting) -> float | None:
    """The part of a setting's error that is bias, from 0 to 1; None where it cannot be told."""
    bias, error = section.biases.get(setting.method), float(np.mean(setting.errors))
    return None if bias is None or error <= 0.0 else min(max(bias.mean, 0.0) / error, 1.0)


def bias_words(bias: Figure | None) -> str:
    """A bias in a table: if its interval has 0, what it is at most; none if chance puts all of the interval below."""
    if bias is None:
        return "?"
    if bias.high <= 0.0:
        return "0" if bias.high == 0.0 else "none found"
    return f"< {bias.high:.2g}" if bias.low <= 0.0 else str(bias)


def frontier_table(section: Section, metric: str) -> Table:
    """The settings on the frontier, by time; and those on the frontier of the settings without bias, with a mark."""
    table = Table(title=f"{section.name}: the frontier, and * that without bias", title_justify="left")
    table.add_column("setting")
    columns = ["time, s (95 % interval)", f"{METRICS[metric].label} (95 % interval)"]
    columns += ["of it bias"] * bool(section.biases)
    for name in columns:
        table.add_column(name, justify="right")
    table.add_column("")
    either = {s.name: s for s in [*frontier(section), *unbiased_frontier(section)]}
    without = {s.name for s in unbiased_frontier(section)}
    for setting in sorted(either.values(), key=lambda setting: np.mean(setting.seconds)):
        row = [setting.name, str(mean_figure(setting.seconds)), str(mean_figure(setting.errors))]
        if section.biases:
            share = bias_share(section, setting)
            row.append("?" if share is None else f"{100.0 * share:.0f} %")
        table.add_row(*row, "*" if setting.name in without else "")
    return table


def _frontier(settings: Sequence[Setting], kinds: Sequence[Verdict | None]) -> list[Setting]:
    kept = [s for s, verdict in zip(settings, kinds, strict=True) if verdict and verdict.kind == FRONTIER]
    return sorted(kept, key=lambda setting: np.mean(setting.seconds))


def frontier(section: Section) -> list[Setting]:
    """The settings on the frontier, by time."""
    return _frontier(section.settings, section.verdicts)


def unbiased_frontier(section: Section) -> list[Setting]:
    """Those on the frontier of the settings without bias."""
    return _frontier(section.settings, section.among_unbiased)


def methods_table(section: Section, plan: Plan) -> Table:
    """Every method beside the scene's own settings, at the largest budget; and the verdicts on all its budgets."""
    budget = plan.budgets[-1]
    table = Table(title=f"{section.name}: at {budget.label}, over {DEFAULT}", title_justify="left")
    table.add_column("method")
    metric = METRICS[plan.metric].label
    columns = ["time (95 % interval)", f"{metric} (95 % interval)"]
    columns += [f"bias of {metric}"] * bool(section.biases)
    columns += ["compile, s", "memory, MiB"] * bool(section.costs)
    for name in [*columns, FRONTIER, OPEN, DOMINATED]:
        table.add_column(name, justify="right")
    table.add_column("most by")
    at_budget = {s.method: s for s in section.settings if s.budget == budget}
    base = at_budget[DEFAULT]
    for method, setting in at_budget.items():
        of_default = method == DEFAULT
        row = [method]
        row += ["1" if of_default else str(ratio_figure(setting.seconds, base.seconds))]
        row += ["1" if of_default else str(ratio_figure(setting.errors, base.errors))]
        if section.biases:
            row.append(bias_words(section.biases[method]))
        if section.costs:
            memory = section.costs[method].peak_memory_bytes
            row += [f"{section.costs[method].compile_seconds:.1f}", "" if memory is None else f"{memory / 2**20:.0f}"]
        found = [v for s, v in zip(section.settings, section.verdicts, strict=True) if s.method == method]
        row += [str(sum(verdict.kind == kind for verdict in found)) for kind in (FRONTIER, OPEN, DOMINATED)]
        dominating = Counter(verdict.by.rpartition(", ")[0] for verdict in found if verdict.by)
        table.add_row(*row, dominating.most_common(1)[0][0] if dominating else "")
    return table


def remarks(sections: list[Section], sweep: Sweep, results: Results) -> list[str]:
    """What a reader of the tables must know."""
    plan = sweep.plan
    lines = [
        "dominated: another setting takes less time and has less error; paired tests over the seeds, at most "
        f"{100.0 * FALSE_ALARM_RATE:.0f} % of settings that are not are called so"
    ]
    if len(plan.seeds) < 2:
        lines.append("one run of each setting says nothing about dominance; --seeds 3 or more does")
    moved = {name: value for name, value in plan.unbiased.items() if value != plan.own[name]}
    if moved:
        words = ", ".join(f"{name}={label(value)}" for name, value in moved.items())
        lines.append(f"errors are against the reference with {words}; what a setting leaves out is its bias")
    for scene in results.experiment.scenes:
        section = next(section for section in sections if section.name == scene.name)
        share = scene.reference.error**2 / min(float(np.mean(s.errors)) for s in section.settings)
        if plan.metric == "relmse" and share > NOISY_REFERENCE:
            lines.append(
                f"{scene.name}: up to {100.0 * min(share, 1.0):.0f} % of a relMSE is the noise of the reference "
                f"(relative standard error {scene.reference.error:.2g})"
            )
        for method, bias in section.biases.items():
            if bias is not None and bias.low > 0.0 and not sweep.is_biased(method, scene.name):
                lines.append(f"{scene.name}, {method}: no knob of it trades bias, but a bias was found: {bias}")
    return lines


def account(sections: list[Section], sweep: Sweep, results: Results) -> dict:
    """All that was found, as plain values."""
    plan, experiment = sweep.plan, results.experiment
    knobs = [
        {
            "name": name,
            "own": plan.own[name],
            "reference": plan.unbiased[name],
            "values": list(values),
            "trades": list(KNOBS[name].trades),
        }
        for name, values in plan.values.items()
    ]
    if plan.sizes:
        knobs.append({"name": SPP, "values": list(plan.sizes), "trades": list(KNOBS[SPP].trades)})
    return {
        "format": FORMAT,
        "metric": plan.metric,
        "confidence": {"intervals": 0.95, "false_alarm_rate_of_dominated": FALSE_ALARM_RATE},
        "seeds": plan.seeds,
        "scenes": experiment.scenes,
        "knobs": knobs,
        "machine": experiment.machine,
        "threads": experiment.threads,
        "device": experiment.device,
        "commit": experiment.commit,
        "date": experiment.date,
        "sections": [_section(section, sweep) for section in sections],
        "remarks": remarks(sections, sweep, results),
    }


def _section(section: Section, sweep: Sweep) -> dict:
    settings = []
    kinds = zip(section.settings, section.verdicts, section.among_unbiased, strict=True)
    for setting, verdict, among_unbiased in kinds:
        bias, cost = section.biases.get(setting.method), section.costs.get(setting.method)
        settings.append(
            {
                "name": setting.name,
                "changes": sweep.methods[setting.method],
                "budget": setting.budget,
                "seconds": mean_figure(setting.seconds).plain(),
                "error": mean_figure(setting.errors).plain(),
                "bias": bias and bias.plain(),
                "bias_share": bias_share(section, setting),
                "compile_seconds": cost and cost.compile_seconds,
                "peak_memory_bytes": cost and cost.peak_memory_bytes,
                "verdict": verdict.kind,
                "dominated_by": verdict.by,
                "among_unbiased": among_unbiased
                and {"verdict": among_unbiased.kind, "dominated_by": among_unbiased.by},
            }
        )
    return {
        "name": section.name,
        "settings": settings,
        "frontier": [setting.name for setting in frontier(section)],
        "frontier_without_bias": [setting.name for setting in unbiased_frontier(section)],
    }


# --- plot --------------------------------------------------------------------------------------------------------


def check_plots() -> None:
    """Refuses, before hours of measuring, to plot without the library.

    Raises:
        WavefrontError: It is not installed.
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise WavefrontError(
            "the plot needs matplotlib, which comes with pip install '.[measure]'; or add --no-plot"
        ) from None


def plot(sections: list[Section], metric: str, path: Path) -> None:
    """Error against time of all settings: those on the frontier joined, those dominated faint, intervals as bars.

    Raises:
        WavefrontError: The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    canvas = Canvas(figsize=(9.0 * len(sections), 5.0), layout="constrained")
    FigureCanvasAgg(canvas)
    axes = canvas.subplots(1, len(sections), squeeze=False)[0]
    for axis, section in zip(axes, sections, strict=True):
        _plot_section(axis, section, metric)
    with replacing(path) as temporary:
        canvas.savefig(temporary, format="png", dpi=130)


def _plot_section(axis, section: Section, metric: str) -> None:
    best, unbiased = frontier(section), unbiased_frontier(section)
    for settings, style, words in ((best, "-", "frontier"), (unbiased, ":", "frontier without bias")):
        seconds, errors = ([np.mean(getattr(s, name)) for s in settings] for name in ("seconds", "errors"))
        axis.plot(seconds, errors, color="black", linewidth=1.0, linestyle=style, zorder=1, label=words)
    # Methods with most of the frontier get a colour of their own.
    kept = [method for method, _ in Counter(s.method for s in [*best, *unbiased]).most_common(len(PALETTE))]
    named = set()
    for setting, verdict in zip(section.settings, section.verdicts, strict=True):
        seconds, errors = mean_figure(setting.seconds), mean_figure(setting.errors)
        color = PALETTE[kept.index(setting.method)] if setting.method in kept else "#aaaaaa"
        called = setting.method if setting.method in kept else "other settings"
        # Logarithmic axes have no room for an end below zero.
        bars = [np.nan_to_num([[min(f.mean - f.low, 0.9 * f.mean)], [f.high - f.mean]]) for f in (seconds, errors)]
        axis.errorbar(
            seconds.mean,
            errors.mean,
            xerr=bars[0],
            yerr=bars[1],
            fmt="o" if verdict.kind == FRONTIER else "s" if verdict.kind == OPEN else "x",
            markersize=5.0,
            elinewidth=0.7,
            color=color,
            alpha=0.4 if verdict.kind == DOMINATED else 1.0,
            label=None if called in named else called,
            zorder=3 if verdict.kind == FRONTIER else 2,
        )
        named.add(called)
    axis.set(xscale="log", yscale="log", xlabel="time, s", ylabel=METRICS[metric].label, title=section.name)
    axis.grid(True, which="both", linewidth=0.3)
    title = "circle: on the frontier\nsquare: not separated\ncross: dominated"
    axis.legend(fontsize=7, title=title, title_fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
