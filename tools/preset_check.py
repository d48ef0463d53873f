"""Measures the presets of `wavefront.render --preset` again, each among other settings on the same scenes.

All knobs that presets may set are swept (`tools.sweep`) on the scenes below, with the settings of the presets among the
methods; where a preset says nothing, a scene's own setting is the unrestricted one. A preset fails if another setting
dominates it (`tools.frontier`) in the geometric means of time and error over all scenes. A preset that promises no bias
is compared with settings that have none: a little bias is always less error for a while.

A folder that has runs already is gone on with if they are of the same commit, and refused otherwise. With
`--update-presets`, the figures, the frontier, the machine and the commit are written to the presets' files.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from pathlib import Path

import msgspec
import numpy as np
from rich.console import Console
from rich.table import Table

from tools.bench_common import ROOT
from tools.frontier import DOMINATED, FRONTIER, Setting, Verdict
from tools.knobs import KNOBS, SPP, UNRESTRICTED_DEPTH
from tools.metrics import METRICS
from tools.reference import available_cores
from tools.results import Results, other_commit, write_json
from tools.summary import mean_figure
from tools.sweep import Changes, Plan, Section, Sweep, make_plan, method_name, same
from wavefront.errors import WavefrontError
from wavefront.presets import NAMES, Preset, load_preset, preset_path

# What light does in them differs: diffuse reflection, rooms that are lit through a gap, glossy and transparent things.
# Those of the folder WAVEFRONT_SCENES are left out where it is not set.
SCENES = (
    "scenes/cornell-box.json",
    "scenes/door-ajar.json",
    "scenes/still-life.glb",
    "${WAVEFRONT_SCENES}/veach-ajar/scene.xml",
)
OVERRIDES = (
    "film.width=48",
    "film.height=27",
    f'integrator={{"type": "path", "max_depth": {UNRESTRICTED_DEPTH}}}',
)
LEFT_OUT = (SPP, "filter")  # knobs that no preset sets
METRIC = "relmse"


def scenes(console: Console) -> list[str]:
    """The scenes that are there, as in `SCENES`."""
    folder = os.environ.get("WAVEFRONT_SCENES")
    found = [file for file in SCENES if folder or not file.startswith("$")]
    if len(found) < len(SCENES):
        console.print("scenes of the folder WAVEFRONT_SCENES, which is not set, are left out")
    return found


def scene_path(file: str) -> Path:
    """Of an entry of `SCENES`."""
    return ROOT / file.replace("${WAVEFRONT_SCENES}", os.environ.get("WAVEFRONT_SCENES", ""))


def changes_of(preset: Preset) -> tuple[int, Changes]:
    """The samples per pixel of a preset, and what else it changes of the scenes.

    Raises:
        WavefrontError: A setting that is no knob.
    """
    by_key = {knob.key: knob for knob in KNOBS.values()}
    settings = dict(preset.settings)
    spp, changes = settings.pop(KNOBS[SPP].key, None), {}
    for key, value in settings.items():
        if key not in by_key or by_key[key].name in LEFT_OUT:
            raise WavefrontError(f"{preset_path(preset.name)}: settings.{key} is no knob that is swept")
        changes[by_key[key].name] = value
    if spp is None:
        raise WavefrontError(f"{preset_path(preset.name)}: settings has no {KNOBS[SPP].key}")
    return spp, changes


def of_scenes(sections: list[Section]) -> list[Section]:
    """The sections of single scenes; the last one is that of all."""
    return sections[:-1] or sections


@dataclasses.dataclass
class Checked:
    """A preset among the settings of all scenes.

    Attributes:
        preset: It.
        setting: What it is among the settings.
        verdict: On it, of all scenes together.
        of_each: By scene, the verdict on that scene alone.
    """

    preset: Preset
    setting: Setting
    verdict: Verdict
    of_each: dict[str, Verdict]


def turned(changes: Changes, plan: Plan) -> Changes:
    """Of these changes those that differ from the scenes' own settings, in the order of names of methods."""
    return {name: changes[name] for name in plan.values if name in changes and not same(changes[name], plan.own[name])}


def check(presets: list[Preset], sweep: Sweep, sections: list[Section]) -> list[Checked]:
    """Finds every preset among the settings: one that may be biased among all, any other among those without bias.

    Raises:
        WavefrontError: A preset has a bias that it does not name.
    """
    found = []
    for preset in presets:
        spp, changes = changes_of(preset)
        key, places = (method_name(turned(changes, sweep.plan)), spp), {}
        for section in [*of_scenes(sections), sections[-1]]:
            at = [(setting.method, setting.budget.spp) for setting in section.settings].index(key)
            verdict = (section.verdicts if preset.biased_by else section.among_unbiased)[at]
            if verdict is None:
                raise WavefrontError(f"{preset_path(preset.name)}: biased_by is empty; {section.name} finds a bias")
            places[section.name] = section.settings[at], verdict
        setting, verdict = places[sections[-1].name]
        found.append(Checked(preset, setting, verdict, {s.name: places[s.name][1] for s in of_scenes(sections)}))
    return found


def table(checked: list[Checked]) -> Table:
    """One row per preset."""
    view = Table(title="presets, geometric means over the scenes", title_justify="left")
    view.add_column("preset")
    view.add_column("setting")
    for name in ("time, s (95 % interval)", f"{METRICS[METRIC].label} (95 % interval)"):
        view.add_column(name, justify="right")
    view.add_column("of all scenes")
    view.add_column("of each")
    for one in checked:
        words = one.verdict.kind + (f" by {one.verdict.by}" if one.verdict.by else "")
        of_each = "; ".join(f"{name}: {v.kind}" + (f" by {v.by}" if v.by else "") for name, v in one.of_each.items())
        seconds, errors = mean_figure(one.setting.seconds), mean_figure(one.setting.errors)
        view.add_row(one.preset.name, one.setting.name, str(seconds), str(errors), words, of_each)
    return view


def origin(checked: Checked, sections: list[Section], files: list[str], sweep: Sweep, results: Results) -> dict:
    """Where a preset was measured, for its file."""
    experiment, together = results.experiment, sections[-1]

    def figures(setting: Setting) -> dict:
        return {"seconds": mean_figure(setting.seconds).plain(), "error": mean_figure(setting.errors).plain()}

    def rounded(value):
        if isinstance(value, dict):
            return {key: rounded(one) for key, one in value.items()}
        return float(f"{value:.4g}") if isinstance(value, float) else value

    measured = []
    for file, section in zip(files, of_scenes(sections), strict=True):
        setting = next(s for s in section.settings if s.name == checked.setting.name)
        bias = section.biases.get(setting.method)
        entry = {"file": file, **figures(setting), "bias": bias and bias.plain()}
        measured.append({**rounded(entry), "verdict": checked.of_each[section.name].kind})
    kinds = together.verdicts if checked.preset.biased_by else together.among_unbiased
    pairs = zip(together.settings, kinds, strict=True)
    frontier = sorted((s for s, v in pairs if v and v.kind == FRONTIER), key=lambda s: np.mean(s.seconds))
    return {
        "commit": experiment.commit,
        "date": experiment.date,
        "machine": {**experiment.machine, "threads": experiment.threads, "device": experiment.device},
        "metric": METRIC,
        "runs": len(sweep.plan.seeds),
        "overrides": list(sweep.plan.scenes[0].overrides),
        "scenes": measured,
        "all_scenes": {**rounded(figures(checked.setting)), "verdict": checked.verdict.kind},
        "frontier": [
            {
                "setting": s.name,
                "seconds": rounded(float(np.mean(s.seconds))),
                "error": rounded(float(np.mean(s.errors))),
            }
            for s in frontier
        ],
    }


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Measures; returns the exit status: 1 if a preset is dominated.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    for option in ("scenes", "knob", "grid", "spp", "seconds", "more_spp", "metric", "define", "json"):
        if getattr(arguments, option):
            what = "a scene" if option == "scenes" else f"--{option.replace('_', '-')}"
            raise WavefrontError(f"{what} together with --check-presets, which has scenes and settings of its own")
    from tools.trade import reference_of

    presets = [load_preset(name) for name in NAMES]
    wanted = [changes_of(preset) for preset in presets]
    *small, most = sorted(spp for spp, _ in wanted)
    sizes = sorted({1 << k for k in range(2, small[-1].bit_length())} | {*small})
    files = scenes(console)
    plan = make_plan(
        [scene_path(file) for file in files],
        {name: knob.values for name, knob in KNOBS.items() if not (name in LEFT_OUT or knob.on_request)},
        sizes,
        (),
        arguments.seeds,
        METRIC,
        reference_of(arguments),
        [*OVERRIDES, *arguments.override],
        more=most,
    )
    folder = arguments.output or Path("results") / "presets"
    if before := other_commit(folder):
        raise WavefrontError(f"{folder}: has runs of another commit, {before}; choose another --output or remove it")
    sweep = Sweep(
        plan,
        "presets",
        folder,
        arguments.references or folder / "references",
        arguments.threads or available_cores(),
        arguments.device,
        console,
        [turned(changes, plan) for _, changes in wanted],
    )
    results = sweep.go(arguments.rounds)
    sections = sweep.sections(results, with_costs=False)
    checked = check(presets, sweep, sections)
    from tools import trade_report

    account = trade_report.account(sections, sweep, results)
    write_json(folder / "trade.json", account)
    if not arguments.no_plot:
        trade_report.plot(sections, METRIC, folder / "frontier.png")
    out = Console(width=None if sys.stdout.isatty() else 200, highlight=False)
    out.print(trade_report.methods_table(sections[-1], plan))
    out.print(trade_report.frontier_table(sections[-1], METRIC))
    out.print(table(checked))
    for line in account["remarks"]:
        out.print(line)
    if arguments.update_presets:
        for one in checked:
            preset = msgspec.structs.replace(one.preset, origin=origin(one, sections, files, sweep, results))
            write_json(preset_path(preset.name), preset)
    failed = [one for one in checked if one.verdict.kind == DOMINATED]
    for one in failed:
        out.print(f"{one.preset.name} is dominated by {one.verdict.by}")
    return int(bool(failed))
