"""The file that says what an experiment measures: `Spec`, how it is read, and what follows from it."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from tools.methods import RENDERERS, SEEDS, Job, load_job, scene_name
from tools.metrics import METRICS
from tools.reference_render import MAKERS, Goal
from tools.reference_store import target_records
from tools.results import Budget, Struct, slug
from wavefront.errors import SceneError, WavefrontError
from wavefront.identity import differences
from wavefront.scene.description import GuideChoice
from wavefront.scene.explain import explain
from wavefront.scene.json_format import parse_object, printable_path

# What a method may change of a scene; all else would be another scene.
METHOD_KEYS = ("integrator.", "film.filter")
GUIDE_KEY = "integrator.guide"
_VARIABLE = re.compile(r"\$\{(\w+)\}")

Name = Annotated[str, Meta(min_length=1, max_length=80)]
Seed = Annotated[int, Meta(ge=0, lt=SEEDS)]


class ReferenceSpec(Struct):
    """How the reference of a scene is made: as `tools.reference` says; at least one limit."""

    error: Annotated[float, Meta(gt=0.0)] | None = None
    spp: Annotated[int, Meta(ge=2, le=2**31 - 1)] | None = None
    seconds: Annotated[float, Meta(gt=0.0)] | None = None
    renderers: Annotated[list[str], Meta(min_length=1)] = msgspec.field(default_factory=lambda: ["wavefront"])
    overrides: list[str] = []


class SceneSpec(Struct):
    """A scene: ``file`` is relative to the spec, and ``${NAME}`` in it is an environment variable."""

    file: Annotated[str, Meta(min_length=1)]
    name: str = ""
    overrides: list[str] = []
    parameters: dict[str, str] = {}
    reference: ReferenceSpec | None = None


class MethodSpec(Struct):
    """A method: a renderer, what it changes of a scene's integrator or reconstruction filter, and its guide.

    Without a `guide` of its own a method has that of the scene, if there is one; other renderers ignore that.
    """

    name: Name
    renderer: str = "wavefront"
    overrides: list[str] = []
    guide: GuideChoice | None = None

    @property
    def all_overrides(self) -> list[str]:
        """With that of the guide."""
        guide = [] if self.guide is None else [f"{GUIDE_KEY}={json.dumps(msgspec.to_builtins(self.guide))}"]
        return [*self.overrides, *guide]


class Spec(Struct):
    """An experiment: every method on every scene with every budget and every seed.

    Attributes:
        description: For readers.
        scenes: What is rendered.
        methods: What renders.
        budgets: What a run may take.
        seeds: One run of each cell for each.
        metrics: Of `tools.metrics`; tables show the first.
        baseline: Name of the method that speed-ups are over; default: the first.
        overrides: Of all scenes, before their own.
        reference: Of all scenes that say nothing else.
        images: Which images are kept: of every run, of the first run of a cell, or none.
    """

    scenes: Annotated[list[SceneSpec], Meta(min_length=1)]
    methods: Annotated[list[MethodSpec], Meta(min_length=1)]
    budgets: Annotated[list[Budget], Meta(min_length=1)]
    seeds: Annotated[list[Seed], Meta(min_length=1)] = msgspec.field(default_factory=lambda: [1])
    description: str = ""
    metrics: Annotated[list[str], Meta(min_length=1)] = msgspec.field(default_factory=lambda: ["relmse", "mse"])
    baseline: str | None = None
    overrides: list[str] = []
    reference: ReferenceSpec = msgspec.field(default_factory=lambda: ReferenceSpec(error=0.02))
    images: Literal["run", "cell", "none"] = "cell"


def read_spec(path: str | os.PathLike) -> Spec:
    """Reads the file of an experiment.

    Raises:
        SceneError: Names the file, the place in it, what was found and what is allowed.
    """
    path = Path(path)
    try:
        raw = parse_object(path.read_bytes(), path)
    except OSError as error:
        raise SceneError(f"cannot be read: {error.strerror or error}", path) from None
    try:
        spec = msgspec.convert(raw, Spec)
    except (msgspec.ValidationError, ValueError, OverflowError) as error:
        steps, message, _ = explain(raw, error, Spec)
        raise SceneError(message, path, printable_path(steps)) from None
    check_spec(spec, path)
    return spec


def check_spec(spec: Spec, path: Path) -> None:
    """What types do not say.

    Raises:
        SceneError: As of `read_spec`.
    """

    def refuse(where: str, message: str):
        raise SceneError(message, path, where)

    def one_of(where: str, value: str, allowed: Sequence[str]):
        if value not in allowed:
            refuse(where, f"unknown name {value!r}; allowed: {', '.join(allowed)}")

    def distinct(where: str, values: Sequence, key: Callable = lambda value: value):
        taken: dict = {}
        for i, value in enumerate(values):
            if key(value) in taken:
                refuse(f"{where}[{i}]", f"{value!r} is as {where}[{taken[key(value)]}] is; allowed: different ones")
            taken[key(value)] = i

    for i, metric in enumerate(spec.metrics):
        one_of(f"metrics[{i}]", metric, tuple(METRICS))
    for i, method in enumerate(spec.methods):
        one_of(f"methods[{i}].renderer", method.renderer, tuple(RENDERERS))
        guided = any(override.strip().startswith(GUIDE_KEY) for override in method.all_overrides)
        if guided and method.renderer != "wavefront":
            refuse(f"methods[{i}]", f"a guide for {method.renderer}; allowed: for wavefront")
        for j, override in enumerate(method.overrides):
            if not override.strip().startswith(METHOD_KEYS):
                refuse(
                    f"methods[{i}].overrides[{j}]",
                    f"a method does not change {override.partition('=')[0]!r}; allowed: integrator.… and film.filter; "
                    "overrides of scenes change the rest",
                )
    for i, budget in enumerate(spec.budgets):
        if (budget.spp is None) == (budget.seconds is None):
            refuse(f"budgets[{i}]", "allowed: either spp or seconds")
    references = [("reference", spec.reference)]
    references += [(f"scenes[{i}].reference", s.reference) for i, s in enumerate(spec.scenes) if s.reference]
    for where, reference in references:
        if reference.error is None and reference.spp is None and reference.seconds is None:
            refuse(where, "no limit; allowed: at least one of error, spp, seconds")
        for j, renderer in enumerate(reference.renderers):
            one_of(f"{where}.renderers[{j}]", renderer, tuple(MAKERS))
        distinct(f"{where}.renderers", reference.renderers)
    if spec.baseline is not None:
        one_of("baseline", spec.baseline, [method.name for method in spec.methods])
    distinct("metrics", spec.metrics)
    distinct("seeds", spec.seeds)
    distinct("budgets", [budget.label for budget in spec.budgets])
    distinct("methods", [method.name for method in spec.methods], slug)
    distinct("scenes", [scene.name or scene_name(scene.file) for scene in spec.scenes], slug)


# --- what follows ------------------------------------------------------------------------------------------------


@dataclasses.dataclass
class PlannedScene:
    """A scene of an experiment, read.

    Attributes:
        name: Of the scene.
        job: It, as the reference sees it but for the overrides of the reference.
        target: `reference.target_records` of it.
        reference: How its reference is made.
        reference_job: What that renders.
        jobs: By name of the method.
        notes: By name of the method, in what it wants another image.
    """

    name: str
    job: Job
    target: dict
    reference: ReferenceSpec
    reference_job: Job
    jobs: dict[str, Job]
    notes: dict[str, list[str]]

    @property
    def goal(self) -> Goal:
        """When the reference is good enough."""
        return Goal(self.reference.error, self.reference.spp, self.reference.seconds)


def expand(file: str, base: Path, where: str, spec_path: Path) -> Path:
    """The file of a scene: environment variables are put in, and what is relative is beside the spec.

    Raises:
        SceneError: A variable that is not set.
    """
    for name in _VARIABLE.findall(file):
        if not os.environ.get(name):
            inside = file.partition("}")[2].lstrip("/")
            raise SceneError(
                f"the environment variable {name} is not set; it names the folder of {inside}",
                spec_path,
                where,
            )
    return base / _VARIABLE.sub(lambda match: os.environ[match[1]], file)


def plan(
    spec: Spec,
    path: Path,
    overrides: Sequence[str] = (),
    threads: int = 1,
    device: str = "cpu",
    warn: Callable[[str], object] | None = None,
) -> list[PlannedScene]:
    """Reads all scenes as all methods see them, so that no error waits for the middle of an experiment.

    Args:
        spec: From `read_spec`.
        path: Its file.
        overrides: Of all scenes, after their own.
        threads, device: Of all methods.
        warn: Called with warnings of scenes.

    Raises:
        SceneError: A scene, an override, or a method that cannot render a scene, with its place in the spec.
    """
    scenes = []
    for i, entry in enumerate(spec.scenes):
        where = f"scenes[{i}]"
        file = expand(entry.file, path.parent, f"{where}.file", path)
        ours = [*spec.overrides, *entry.overrides, *overrides]

        def load(place: str, *more: str, file=file, ours=ours, entry=entry, warn=None) -> Job:
            try:
                return load_job(file, [*ours, *more], entry.parameters, threads, device, warn)
            except SceneError as error:
                raise SceneError(str(error), path, place) from None

        job = load(where, warn=warn)
        target = target_records(job.scene)
        reference = entry.reference or spec.reference
        reference_job = load(f"{where}.reference", *reference.overrides)
        changed = differences(target_records(reference_job.scene), target)
        if changed:
            message = f"its overrides change {changed[0][0]}; allowed: what changes the noise of an image, not its mean"
            raise SceneError(message, path, f"{where}.reference")
        for renderer in reference.renderers:
            _check(RENDERERS[renderer], reference_job, path, f"{where}.reference")
        jobs, notes = {}, {}
        for j, method in enumerate(spec.methods):
            jobs[method.name] = one = load(f"methods[{j}]", *method.all_overrides)
            _check(RENDERERS[method.renderer], one, path, f"methods[{j}] on {where}")
            notes[method.name] = [
                f"{key} is {_said(value)}, but {_said(other)} in the reference"
                for key, value, other in differences(target_records(one.scene), target)
            ]
        name = entry.name or scene_name(file)
        scenes.append(PlannedScene(name, job, target, reference, reference_job, jobs, notes))
    return scenes


def _said(value: object) -> str:
    return "its default" if value is None else json.dumps(value)


def _check(renderer, job: Job, path: Path, where: str) -> None:
    try:
        renderer.check(job)
        renderer.versions(job.device)
    except WavefrontError as error:
        raise SceneError(str(error), path, where) from None
