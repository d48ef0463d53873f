"""The sweep behind `tools.trade`: which settings are measured, and what was found of them.

A sweep is an experiment (`tools.experiment`) whose methods are settings of knobs. It begins with the scene's own
settings and every other value of every knob, one at a time. Each further round joins in pairs the methods of which some
budget is on the frontier of the means so far, or on that of the methods without bias, unless both turn a knob to
different values. A sweep that is killed goes on where it was: the rounds follow from the records.

After the last round, the methods that are on the frontier without bias at the largest number of samples may go on with
more (`Plan.more`). The others would take most of the time: more samples remove no bias.

Budgets in samples share runs: the image of a run at a power of two of its samples is to the last bit that of a run
with so many, so that one run of the largest number measures all. Where a knob trains, each number has runs of its own.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from rich.console import Console

from guiding import plain_settings
from tools.experiment import Run, write_summary
from tools.experiment_spec import MethodSpec, PlannedScene, ReferenceSpec, SceneSpec, Spec
from tools.frontier import SQUARES, Setting, Verdict, bias_figure, error_products, joined, pareto, verdicts
from tools.knobs import KNOBS, Knob, Value, label
from tools.methods import Job, load_job, scene_name
from tools.results import EXPERIMENT, Budget, Experiment, Results, write_json
from tools.setting_cost import Cost, measure_all
from tools.summary import Figure
from wavefront.errors import SceneError, WavefrontError
from wavefront.scene.json_format import with_overrides

DEFAULT = "default"  # the method that turns no knob
TOGETHER = "all scenes"

Changes = dict[str, Value]  # by knob, values other than the scene's own


@dataclasses.dataclass
class Plan:
    """What is swept.

    Attributes:
        scenes: As in a spec; their overrides make the reference's image.
        own: By knob, the value of the scenes.
        values: By knob, all values that are swept, the own first.
        unbiased: By knob, the value of the references.
        budgets: Largest last.
        sizes: Samples per pixel that are settings; empty if budgets are seconds.
        more: Samples per pixel for those alone that are on the frontier without bias at the largest of `sizes`.
        seeds: Of the runs.
        metric: Of `tools.metrics`.
        reference: How references are made.
    """

    scenes: list[SceneSpec]
    own: Changes
    values: dict[str, tuple[Value, ...]]
    unbiased: Changes
    budgets: list[Budget]
    sizes: tuple[int, ...]
    seeds: list[int]
    metric: str
    reference: ReferenceSpec
    more: int | None = None

    def overrides(self, changes: Changes) -> list[str]:
        """From a scene of the spec to one with these changes."""
        found = []
        for name, own in self.own.items():
            value = changes.get(name, own)
            if not same(value, self.unbiased[name]):
                found += KNOBS[name].overrides(value)
        return found

    @property
    def all_budgets(self) -> list[Budget]:
        """With that of the methods that go on."""
        return self.budgets + ([Budget(spp=self.more)] if self.more else [])


def same(a: Value, b: Value) -> bool:
    """Equal, and of one type: 1 is not true."""
    return json.dumps(a) == json.dumps(b)


def make_plan(
    paths: Sequence[str | Path],
    knobs: dict[str, tuple[Value, ...]],
    sizes: Sequence[int],
    seconds: Sequence[float],
    seeds: int,
    metric: str,
    reference: ReferenceSpec,
    overrides: Sequence[str] = (),
    parameters: dict[str, str] | None = None,
    more: int | None = None,
) -> Plan:
    """Reads the scenes, and says what will be swept.

    Args:
        paths: Of the scenes.
        knobs: Values by name, without that of the samples.
        sizes: Samples per pixel, or
        seconds: of rendering; one of them is empty.
        seeds: Number of runs of each setting.
        metric: Of `tools.metrics`.
        reference: How references are made.
        overrides: Of all scenes.
        parameters: Of Mitsuba files.
        more: See `Plan`.

    Raises:
        WavefrontError: A scene that cannot be read, a value that it refuses, or scenes that do not have the same
            settings to start from.
    """
    of_guide = [name for name in knobs if KNOBS[name].of_guide]
    if of_guide and "guide" in knobs:
        raise WavefrontError(f"--knob guide together with --knob {of_guide[0]}, which is a setting of one guide")
    jobs = [load_job(Path(path), overrides, parameters, 1) for path in paths]
    own: Changes = {}
    for name in knobs:
        found = [KNOBS[name].own(job.scene) for job in jobs]
        for job, value in zip(jobs, found, strict=True):
            if not same(value, found[0]):
                raise WavefrontError(
                    f"{job.path}: {name} is {label(value)}, but {label(found[0])} in {jobs[0].path}; scenes that are "
                    f"swept together start from the same, as with --override {KNOBS[name].overrides(found[0])[0]}"
                )
        own[name] = found[0]
    values, unbiased = {}, {}
    for name, swept in knobs.items():
        knob = KNOBS[name]
        every = [own[name], *(value for value in swept if not same(value, own[name]))]
        unbiased[name] = knob.least_biased(every)
        if not any(same(value, unbiased[name]) for value in every):
            every.append(unbiased[name])
        for value in every[1:]:
            for job in jobs:
                _check_value(knob, value, job)
        values[name] = tuple(every)
    changed = [name for name in knobs if not same(own[name], unbiased[name])]
    start = [text for name in changed for text in KNOBS[name].overrides(unbiased[name])]
    scenes: list[SceneSpec] = []
    for job in jobs:
        if scene_name(job.path) in [scene.name for scene in scenes]:
            raise WavefrontError(
                f"{job.path}: another scene is called {scene_name(job.path)} too; allowed: different names"
            )
        independent = ["integrator.sampler=independent"] if job.scene.integrator.sampler != "independent" else []
        scenes.append(
            SceneSpec(
                file=str(job.path.resolve()),
                name=scene_name(job.path),
                overrides=[*overrides, *start],
                parameters=parameters or {},
                reference=ReferenceSpec(
                    error=reference.error, seconds=reference.seconds, overrides=[*reference.overrides, *independent]
                ),
            )
        )
    if seconds:
        budgets = [Budget(seconds=value) for value in sorted(seconds)]
    else:
        most, whole = max(sizes), any(KNOBS[name].trains for name in knobs)
        alone = [size for size in sorted(sizes) if size != most and (whole or size & (size - 1))]
        budgets = [Budget(spp=size) for size in [*alone, most]]
    return Plan(
        scenes, own, values, unbiased, budgets, tuple(sorted(sizes)), list(range(1, seeds + 1)), metric, reference, more
    )


def _check_value(knob: Knob, value: Value, job: Job) -> None:
    try:
        plain_settings(with_overrides(job.scene, knob.overrides(value), job.path))
    except SceneError as error:
        raise WavefrontError(f"--knob {knob.name}={label(value)}: {error}") from None


# --- which settings ----------------------------------------------------------------------------------------------


def method_name(changes: Changes) -> str:
    """As in tables."""
    return ", ".join(f"{name}={label(value)}" for name, value in changes.items()) or DEFAULT


def one_at_a_time(plan: Plan) -> list[Changes]:
    """The scene's own settings, and every other value of every knob."""
    return [{}] + [{name: value} for name, values in plan.values.items() for value in values[1:]]


def grid(plan: Plan) -> list[Changes]:
    """All combinations."""
    names = list(plan.values)
    return [
        {name: value for name, value in zip(names, chosen, strict=True) if not same(value, plan.own[name])}
        for chosen in itertools.product(*plan.values.values())
    ]


def joined_pairs(parents: Sequence[Changes], there: Sequence[Changes], order: Sequence[str]) -> list[Changes]:
    """The unions of pairs that agree where they meet, without those that are there.

    Args:
        parents: From which pairs are taken.
        there: Measured already.
        order: Of the knobs.
    """
    taken, found = [*there], []
    for a, b in itertools.combinations(parents, 2):
        if any(not same(a[name], b[name]) for name in a.keys() & b.keys()):
            continue
        union = {name: (a | b)[name] for name in order if name in a or name in b}
        if union not in taken:
            taken.append(union)
            found.append(union)
    return found


# --- what was found ----------------------------------------------------------------------------------------------


@dataclasses.dataclass
class Section:
    """What was found on one scene, or on several taken together.

    Attributes:
        name: Of the scene.
        settings: All of them.
        verdicts: Of each, among all.
        unbiased: Methods that make the reference's image.
        among_unbiased: Of each setting, the verdict among those of these methods; None for others.
        biases: By method, the part of the error that is bias; None where it cannot be told. Empty for several scenes.
        costs: By method; empty for several scenes.
    """

    name: str
    settings: list[Setting]
    verdicts: list[Verdict]
    unbiased: set[str]
    among_unbiased: list[Verdict | None]
    biases: dict[str, Figure | None]
    costs: dict[str, Cost]


def settings_of(results: Results, scene: str, plan: Plan) -> list[Setting]:
    """The settings of a scene of which there are runs: method by method, and in each by budget."""
    runs: dict = {}
    for record in results.records:
        if record.scene == scene:
            runs.setdefault(record.method, {}).setdefault(record.budget, []).append(record)
    found = []
    for method, by_budget in runs.items():
        if not plan.sizes:
            for budget in plan.budgets:
                records = by_budget[budget]
                seconds = tuple(record.seconds.render for record in records)
                found.append(Setting(method, budget, seconds, tuple(r.errors[plan.metric] for r in records)))
            continue
        # Runs with more samples may be left of an earlier sweep that was stopped; some of the seeds are no setting.
        went_on = len(by_budget.get(Budget(spp=plan.more), ())) == len(plan.seeds)
        for size in [*plan.sizes, *([plan.more] if went_on else [])]:
            budget = Budget(spp=size)
            records = by_budget.get(budget, by_budget[plan.budgets[-1]])
            points = [next(point for point in record.points if point.samples == size) for record in records]
            errors = tuple(point.errors[plan.metric] for point in points)
            found.append(Setting(method, budget, tuple(point.seconds for point in points), errors))
    return found


def find_biases(results: Results, scene: PlannedScene, plan: Plan) -> dict[str, Figure | None]:
    """The bias of every method, see `tools.frontier`; from the images of the largest budget that all have."""
    control = next((name for name, notes in scene.notes.items() if not notes), None)
    if plan.metric not in SQUARES or control is None:
        return dict.fromkeys(scene.notes)
    reference = results.reference(scene.name).image
    products = {}
    for name in scene.notes:
        records = [r for r in results.records if (r.scene, r.method, r.budget) == (scene.name, name, plan.budgets[-1])]
        products[name] = error_products([results.image(record) for record in records], reference, plan.metric)
    return {name: bias_figure(products[name], products[control]) for name in products if name != control} | {
        control: Figure(0.0, 0.0, 0.0)
    }


class Sweep:
    """A sweep in progress.

    Args:
        plan: What is swept.
        name: Of the experiment.
        folder: Of the results.
        references: Folder of references.
        threads, device: Of all settings.
        console: For progress.
        extra: Methods to measure besides.
    """

    def __init__(
        self,
        plan: Plan,
        name: str,
        folder: Path,
        references: Path,
        threads: int,
        device: str,
        console: Console,
        extra: Sequence[Changes] = (),
    ):
        self.plan, self.name, self.folder, self.references = plan, name, folder, references
        self.threads, self.device, self.console = threads, device, console
        self.extra = list(extra)
        self.methods: dict[str, Changes] = {}
        self.planned: list[PlannedScene] = []
        self.experiment: Experiment | None = None

    def go(self, rounds: int, whole: bool = False) -> Results:
        """Measures all.

        Args:
            rounds: Of joining pairs, after the first.
            whole: The grid of all values instead.

        Raises:
            WavefrontError: A renderer fails, or a file cannot be written.
        """
        chosen = grid(self.plan) if whole else one_at_a_time(self.plan)
        extra = [changes for changes in self.extra if changes not in chosen]
        results = self._measure([*chosen, *extra], "all combinations" if whole else "one at a time")
        for number in range(0 if whole else rounds):
            on_frontier = self._on_frontiers(results, [method_name(changes) for changes in chosen])
            parents = [changes for changes in chosen if changes and method_name(changes) in on_frontier]
            new = joined_pairs(parents, chosen, list(self.plan.values))
            if not new:
                break
            chosen += new
            extra = [changes for changes in self.extra if changes not in chosen]
            results = self._measure([*chosen, *extra], f"round {number + 1} of pairs from the frontier")
        if self.plan.more:
            unbiased = [name for name in self.methods if not self.is_biased(name)]
            largest = self._on_frontiers(results, unbiased, self.plan.budgets[-1])
            last = [changes for changes in chosen if method_name(changes) in largest]
            last += [changes for changes in self.extra if changes not in last]
            results = self._measure(last, f"{self.plan.more} spp", more=True)
        return results

    def is_biased(self, method: str, scene: str | None = None) -> bool:
        """Whether a method makes another image than the reference's, of a scene or of any."""
        return any(planned.notes[method] for planned in self.planned if scene in (None, planned.name))

    def _on_frontiers(self, results: Results, methods: Sequence[str], budget: Budget | None = None) -> set[str]:
        """Methods with a setting on a frontier of the means, of all scenes together: that of these methods alone, and
        that of those among them without bias.

        Args:
            results: So far.
            methods: That are compared.
            budget: Only settings with this one; None: with any.
        """
        settings = [
            setting
            for setting in self._together(results)
            if setting.method in methods and budget in (None, setting.budget)
        ]
        found = set()
        for some in (settings, [setting for setting in settings if not self.is_biased(setting.method)]):
            kept = pareto([np.mean(s.seconds) for s in some], [np.mean(s.errors) for s in some])
            found |= {setting.method for setting, on in zip(some, kept, strict=True) if on}
        return found

    def _together(self, results: Results) -> list[Setting]:
        return joined([settings_of(results, scene.name, self.plan) for scene in self.plan.scenes])

    def _measure(self, chosen: Sequence[Changes], words: str, more: bool = False) -> Results:
        chosen_methods = {method_name(changes): changes for changes in chosen}
        self.methods |= chosen_methods
        self.console.print(f"{self.name}: {words}: {len(chosen)} methods")
        spec = Spec(
            scenes=self.plan.scenes,
            methods=[MethodSpec(name=n, overrides=self.plan.overrides(c)) for n, c in chosen_methods.items()],
            budgets=self.plan.all_budgets[-1:] if more else self.plan.budgets,
            seeds=self.plan.seeds,
            metrics=[self.plan.metric],
            baseline=DEFAULT,
            description="A sweep of knobs: " + ", ".join(self.plan.values),
            images="run" if self.plan.metric in SQUARES else "none",
        )
        run = Run(spec, Path(self.name), self.folder, self.references, [], self.threads, self.device, self.console)
        if not more:
            self.planned, results = run.scenes, run.go()
            self.experiment = results.experiment
            return results
        run.go()
        # The folder tells of all methods, and not of the last alone.
        write_json(self.folder / EXPERIMENT, msgspec.structs.replace(self.experiment, budgets=self.plan.all_budgets))
        return write_summary(self.folder)

    def sections(self, results: Results, with_costs: bool = True) -> list[Section]:
        """What was found: scene by scene, and last of all scenes together if there are several.

        Raises:
            WavefrontError: An image is missing, or a process that measures costs failed.
        """
        found = []
        for scene in self.planned:
            settings = settings_of(results, scene.name, self.plan)
            biases = find_biases(results, scene, self.plan)
            costs = {}
            if with_costs:
                features = {r.method: r.account["features"] for r in results.records if r.scene == scene.name}
                costs = measure_all(scene, features, self.folder, self.console.print)
            found.append(self._section(scene.name, settings, biases, costs))
        if len(found) > 1:
            found.append(self._section(None, self._together(results), {}, {}))
        return found

    def _section(self, scene: str | None, settings: list[Setting], biases: dict, costs: dict) -> Section:
        unbiased = {method for method in self.methods if not self.is_biased(method, scene)}
        among = iter(verdicts([setting for setting in settings if setting.method in unbiased]))
        among_unbiased = [next(among) if setting.method in unbiased else None for setting in settings]
        return Section(scene or TOGETHER, settings, verdicts(settings), unbiased, among_unbiased, biases, costs)
