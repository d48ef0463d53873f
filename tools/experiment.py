"""Measures methods against references: methods x scenes x budgets x seeds.

    python -m tools.experiment SPEC.json [--output RESULTS] [--threads N] [--override film.width=160 …]

SPEC.json says what is measured (`tools.experiment_spec.Spec`; ready ones are in tools/experiments/). References are
made first, or taken from the folder `--references` if they are there. Every run is one method on one scene with one
budget and one seed. A budget in seconds is of rendering with all training, which is what a user waits for; loading,
compiling, measuring and writing are measured apart, and all parts add up to the wall time of the run. Errors are also
taken on the way, at powers of two of the samples, with the clock stopped.

RESULTS gets one record per run as soon as it has ended (`tools.results`), and a summary: errors, times, efficiency, and
speed-up over the baseline, with 95 % intervals over the runs (`tools.summary`). An experiment that is killed goes on
with the run in which it was when the command is repeated; runs with budgets in samples give the same images to the last
bit.
"""

from __future__ import annotations

import argparse
import datetime
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from guiding import plain_settings
from tools import summary
from tools.bench_common import machine, require_scipy
from tools.experiment_spec import PlannedScene, Spec, plan, read_spec
from tools.methods import RENDERERS, Engine, Job
from tools.metrics import evaluate
from tools.reference import Reference, available_cores, compare_stored, in_words, make_reference
from tools.reference_render import clock
from tools.results import (
    EXPERIMENT,
    FORMAT,
    RECORDS,
    Budget,
    Experiment,
    MethodEntry,
    Point,
    Record,
    ReferenceEntry,
    Results,
    SceneEntry,
    Seconds,
    append,
    appending,
    commit,
    load_results,
    other_commit,
    read_records,
    slug,
    write_json,
)
from wavefront.errors import WavefrontError
from wavefront.identity import explain_differences, scene_hash, scene_records
from wavefront.scene.images import replacing, write_exr

MOST_SAMPLES = 1 << 24  # that an engine is asked for at once


class Stopwatch:
    """Divides the time since it was made among named parts; what belongs to none is ``other``.

    Args:
        now: The clock.
    """

    def __init__(self, now: Callable[[], float] = time.perf_counter):
        self.now, self.begin, self.parts = now, now(), {}
        self.running: str | None = None

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """What happens inside belongs to this part; parts are not nested."""
        assert self.running is None, f"{name} inside {self.running}"
        self.running, begin = name, self.now()
        try:
            yield
        finally:
            self.parts[name] = self.parts.get(name, 0.0) + self.now() - begin
            self.running = None

    def __getitem__(self, name: str) -> float:
        return self.parts.get(name, 0.0)

    def seconds(self, compiling: float, training: float) -> Seconds:
        """The account: `compiling` is a part of ``load`` and is taken out of it, `training` a part of ``render``."""
        total = self.now() - self.begin
        return Seconds(
            load=self["load"] - compiling,
            compile=compiling,
            render=self["render"],
            training=training,
            measure=self["measure"],
            write=self["write"],
            other=total - sum(self.parts.values()),
            total=total,
        )


# --- one run -----------------------------------------------------------------------------------------------------


def render_budget(
    engine: Engine, budget: Budget, watch: Stopwatch, measure: Callable[[np.ndarray], dict[str, float]]
) -> list[Point]:
    """Renders until the budget is used up.

    Args:
        engine: Without samples.
        budget: Samples per pixel, or seconds of the part ``render`` of `watch`. The last samples may end a little
            later; none begins that would end more than half of its time too late.
        watch: Gets the parts ``render`` and ``measure``.
        measure: From an image to its errors by metric.

    Returns:
        Errors at powers of two of the samples and at the end; the last is that of the image. Of an engine that is
        asked for the `whole` there is the end alone.
    """
    points: list[Point] = []
    next_point = 1
    while True:
        left = None if budget.seconds is None else budget.seconds - watch["render"]
        if engine.samples:
            per_sample = watch["render"] / engine.samples
            over = engine.samples == budget.spp or (left is not None and left < 0.5 * per_sample)
            if over or engine.samples == next_point:
                with watch.part("measure"):
                    points.append(
                        Point(samples=engine.samples, seconds=watch["render"], errors=measure(engine.image()))
                    )
                next_point *= 2
            if over:
                return points
        target = MOST_SAMPLES if engine.whole else next_point
        if budget.spp is not None:
            target = min(target, budget.spp)
        with watch.part("render"):
            engine.add(target - engine.samples, left)


def run_once(
    renderer: str,
    job: Job,
    seed: int,
    budget: Budget,
    reference: Reference,
    metrics: list[str],
    image_path: Path | None,
    now: Callable[[], float] = time.perf_counter,
) -> tuple[Engine, Seconds, list[Point]]:
    """One run, with its image written if `image_path` is given.

    Raises:
        WavefrontError: The renderer fails, or the image cannot be written.
    """
    watch = Stopwatch(now)
    with watch.part("load"):
        engine = RENDERERS[renderer](job, seed)

    def measure(image: np.ndarray) -> dict[str, float]:
        return {metric: evaluate(metric, image, reference.image) for metric in metrics}

    points = render_budget(engine, budget, watch, measure)
    if image_path is not None:
        with watch.part("write"):
            image_path.parent.mkdir(parents=True, exist_ok=True)
            image = np.asarray(engine.image(), np.float32)
            write_exr(image_path, dict(zip("RGB", np.moveaxis(image, 2, 0), strict=True)))
    return engine, watch.seconds(engine.compile_seconds, engine.training_seconds), points


# --- an experiment -----------------------------------------------------------------------------------------------


class Forecast:
    """How long the runs that are left will take, from those that have ended.

    Budgets in seconds say it themselves; samples take the time that they took the same method on the same scene, or
    the mean of all as long as there is none. Overheads are the mean.
    """

    def __init__(self):
        self.rates: dict[tuple[str, str], float] = {}  # seconds per sample and pixel
        self.overheads: list[float] = []

    def learn(self, record: Record) -> None:
        self.rates[record.scene, record.method] = record.seconds.render / record.samples
        self.overheads.append(record.seconds.total - record.seconds.render)

    def left(self, keys: list[tuple[str, str, Budget, int]]) -> float | None:
        """Seconds; None if nothing is known."""
        if not self.rates:
            return None
        mean = sum(self.rates.values()) / len(self.rates)
        total = len(keys) * sum(self.overheads) / len(self.overheads)
        for scene, method, budget, _ in keys:
            total += budget.seconds if budget.spp is None else budget.spp * self.rates.get((scene, method), mean)
        return total


class Run:
    """All that an experiment needs while it runs.

    Args:
        spec: What is measured.
        path: Its file.
        folder: Of the results.
        references: Folder of references.
        overrides: Of all scenes, after their own.
        threads, device: Of all methods.
        console: For progress.
    """

    def __init__(
        self,
        spec: Spec,
        path: Path,
        folder: Path,
        references: Path,
        overrides: list[str],
        threads: int,
        device: str,
        console: Console,
    ):
        self.spec, self.path, self.folder, self.references = spec, path, folder, references
        self.threads, self.device, self.console = threads, device, console
        require_scipy()  # now, and not after the last run; so are the metrics
        for metric in spec.metrics:
            evaluate(metric, np.ones((16, 16, 3)), np.ones((16, 16, 3)))
        self.scenes = plan(spec, path, overrides, threads, device, lambda message: console.print(f"warning: {message}"))
        self.machine = machine()
        self.images: dict[str, Reference] = {}
        self.settings_sha256 = {
            (scene.name, method): scene_hash(scene_records(job.scene))
            for scene in self.scenes
            for method, job in scene.jobs.items()
        }

    def go(self) -> Results:
        """Makes references, runs what has not ended yet, and writes the summary.

        Raises:
            WavefrontError: A renderer fails, a file cannot be written, or the folder has results of other settings.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with appending(self.folder / RECORDS) as file:
            entries = [self._reference(scene) for scene in self.scenes]
            done = self._done()
            if done and (before := other_commit(self.folder)):
                self.console.print(f"warning: {self.folder}: runs of another commit, {before}, are not made again")
            write_json(self.folder / EXPERIMENT, self._experiment(entries))
            # Seeds in the outer loop: an experiment that is stopped has some runs of all, and a slow minute of the
            # machine hits all methods alike.
            keys = [
                (scene.name, method.name, budget, seed)
                for seed in self.spec.seeds
                for scene in self.scenes
                for budget in self.spec.budgets
                for method in self.spec.methods
            ]
            self._run_all([key for key in keys if key not in done], len(keys), done, file)
        return write_summary(self.folder)

    def _reference(self, scene: PlannedScene) -> SceneEntry:
        """Makes or finds the references of a scene; the first renderer's is what errors are measured with."""
        made, job, folder = [], scene.reference_job, self.references
        for renderer in scene.reference.renderers:
            self.console.print(f"{scene.name}: reference by {renderer}")
            made.append(make_reference(job, scene.goal, folder, renderer, console=self.console, exact=False))
        reference = self.images[scene.name] = made[0]
        comparisons = compare_stored(reference)
        for comparison in comparisons:
            self.console.print(f"{scene.name}: {in_words(comparison)}")
        account, film = reference.account, scene.job.scene.film
        return SceneEntry(
            name=scene.name,
            file=str(scene.job.path),
            width=film.window.width,
            height=film.window.height,
            overrides=list(scene.job.overrides),
            parameters=dict(scene.job.parameters),
            target_sha256=account.target_sha256,
            reference=ReferenceEntry(
                image=os.path.relpath(reference.path, self.folder),
                sha256=account.image_sha256,
                renderer=account.renderer,
                samples=account.samples_per_pixel,
                error=account.error,
                comparisons=comparisons,
            ),
        )

    def _experiment(self, scenes: list[SceneEntry]) -> Experiment:
        spec = self.spec
        return Experiment(
            format=FORMAT,
            name=self.path.stem,
            description=spec.description,
            scenes=scenes,
            methods=[
                MethodEntry(
                    name=method.name,
                    renderer=method.renderer,
                    overrides=method.all_overrides,
                    versions=RENDERERS[method.renderer].versions(self.device),
                )
                for method in spec.methods
            ],
            budgets=spec.budgets,
            seeds=spec.seeds,
            metrics=spec.metrics,
            baseline=spec.baseline or spec.methods[0].name,
            threads=self.threads,
            device=self.device,
            machine=self.machine,
            commit=commit(),
            date=datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
            spec=msgspec.to_builtins(spec),
        )

    def _made(self, scene: PlannedScene, method: str, renderer: str) -> dict:
        """What a run depends on besides its key."""
        guide = plain_settings(scene.jobs[method].scene) if renderer == "wavefront" else None
        return {
            "settings_sha256": self.settings_sha256[scene.name, method],
            "overrides": list(scene.jobs[method].overrides),
            "renderer": renderer,
            "versions": RENDERERS[renderer].versions(self.device),
            "reference_sha256": self.images[scene.name].account.image_sha256,
            "metrics": self.spec.metrics,
            "threads": self.threads,
            "device": self.device,
            "cpu": self.machine["cpu"],
        } | ({"guide": guide} if guide else {})

    def _done(self) -> set:
        """The runs that need not be made again.

        Raises:
            WavefrontError: A record of this experiment that was made otherwise, with what differs.
        """
        renderers = {method.name: method.renderer for method in self.spec.methods}
        scenes = {scene.name: scene for scene in self.scenes}
        done = set()
        for record in read_records(self.folder / RECORDS):
            if record.scene not in scenes or record.method not in renderers:
                continue
            made = self._made(scenes[record.scene], record.method, renderers[record.method])
            differs = explain_differences(made, record.made, "the record")
            if differs:
                raise WavefrontError(
                    f"{self.folder / RECORDS}: has other results of {record.scene}, {record.method}: {differs}; choose "
                    "another --output or remove it"
                )
            if record.image is None or (self.folder / record.image).is_file():
                done.add(record.key)
        return done

    def _run_all(self, keys: list, total: int, done: set, file) -> None:
        forecast = Forecast()
        for record in read_records(self.folder / RECORDS):
            if record.key in done:
                forecast.learn(record)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]} left"),
        )
        with Progress(*columns, console=self.console) as progress:
            task = progress.add_task("", total=total, completed=total - len(keys), left="?")
            for i, key in enumerate(keys):
                scene, method, budget, seed = key
                left = forecast.left(keys[i:])
                words = f"{scene}, {method}, {budget.label}, seed {seed}"
                progress.update(task, description=words, left="?" if left is None else clock(left))
                record = self._run(*key)
                append(file, record)
                forecast.learn(record)
                progress.advance(task)
            progress.update(task, description=self.path.stem, left=clock(0.0))

    def _run(self, scene_name: str, method_name: str, budget: Budget, seed: int) -> Record:
        scene = next(scene for scene in self.scenes if scene.name == scene_name)
        method = next(method for method in self.spec.methods if method.name == method_name)
        renderer_seed = RENDERERS[method.renderer].run_seed((scene_name, method_name), seed)
        keep = self.spec.images == "run" or (self.spec.images == "cell" and seed == self.spec.seeds[0])
        image = None
        if keep:
            image = Path("images", slug(scene_name), slug(method_name), f"{slug(budget.label)}-{seed}.exr")
        engine, seconds, points = run_once(
            method.renderer,
            scene.jobs[method_name],
            renderer_seed,
            budget,
            self.images[scene_name],
            self.spec.metrics,
            image and self.folder / image,
        )
        return Record(
            scene=scene_name,
            method=method_name,
            budget=budget,
            seed=seed,
            renderer_seed=renderer_seed,
            samples=engine.samples,
            seconds=seconds,
            errors=points[-1].errors,
            points=points,
            image=image and image.as_posix(),
            made=self._made(scene, method_name, method.renderer),
            notes=scene.notes[method_name],
            account=engine.account(),
        )


def write_summary(folder: Path) -> Results:
    """Writes ``summary.json`` and ``summary.md`` of a folder of results.

    Raises:
        WavefrontError: The results cannot be read, or a file cannot be written.
    """
    results = load_results(folder)
    cells = summary.summarise(results)
    write_json(folder / "summary.json", [cell.plain() for cell in cells])
    with replacing(folder / "summary.md") as temporary:
        temporary.write_text(summary.markdown(results, cells), encoding="utf-8")
    return results


# --- the command -------------------------------------------------------------------------------------------------


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.experiment", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("spec", type=Path, metavar="SPEC.json", help="what is measured")
    parser.add_argument("-o", "--output", type=Path, metavar="RESULTS", help="folder; default: results/NAME-OF-SPEC")
    parser.add_argument("--references", type=Path, metavar="FOLDER", help="default: references in RESULTS")
    parser.add_argument(
        "--override", action="extend", nargs="+", default=[], metavar="KEY=VALUE", help="change keys of all scenes"
    )
    parser.add_argument("--threads", type=int, metavar="N", help="of all methods; default: all cores")
    parser.add_argument("--device", default="cpu", help="of all methods: cpu (default), cuda or cuda:N")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Runs an experiment; returns the exit status.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    if arguments.threads is not None and arguments.threads < 1:
        raise WavefrontError(f"--threads {arguments.threads}; allowed: 1 or more")
    spec = read_spec(arguments.spec)
    folder = arguments.output or Path("results") / arguments.spec.stem
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    threads = arguments.threads or available_cores()
    references = arguments.references or folder / "references"
    experiment = Run(spec, arguments.spec, folder, references, arguments.override, threads, arguments.device, console)
    results = experiment.go()
    cells = summary.summarise(results)
    # A pipe or a file has no width; the widest table needs this much.
    out = Console(width=None if sys.stdout.isatty() else 180, highlight=False)
    out.print(summary.table(results, cells))
    for line in summary.remarks(results, cells):
        out.print(line)
    parts = {name: sum(getattr(record.seconds, name) for record in results.records) for name in ("load", "compile")}
    out.print(
        f"apart from the times above: loading {parts['load']:.1f} s, compiling {parts['compile']:.1f} s, measuring and "
        f"writing {sum(r.seconds.measure + r.seconds.write for r in results.records):.1f} s, of all runs together"
    )
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status: 0, or 2 after an error, of which one line is printed."""
    try:
        return run(build_parser().parse_args(argv))
    except (WavefrontError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; the same command goes on with the run that was interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
