"""What an experiment leaves behind, and the one function that reads it.

A folder of results holds

- ``experiment.json``: what was measured and on which machine (`Experiment`);
- ``results.jsonl``: one `Record` per run, appended as a line when the run has ended. A run that is killed leaves no
  record; of a line that was being written, what is there is left out when reading and cut off before the next one;
- ``images/SCENE/METHOD/BUDGET-seed.exr``: images of the runs;
- ``references/``: see `tools.reference`, unless they are elsewhere;
- ``summary.json``, ``summary.md``: see `tools.summary`; made from the others.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Annotated

import msgspec
import numpy as np
from msgspec import Meta

from tools.bench_common import ROOT
from tools.image_reader import read_image
from tools.reference_store import Reference, load_reference
from wavefront.errors import WavefrontError
from wavefront.scene.images import replacing

FORMAT = 1
EXPERIMENT, RECORDS = "experiment.json", "results.jsonl"


class Struct(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """Base of the records: keyword-only, unknown keys refused."""


class Budget(Struct, frozen=True, omit_defaults=True):
    """What a run may take: samples per pixel, or seconds of rendering with all training."""

    spp: Annotated[int, Meta(ge=1, le=2**31 - 1)] | None = None
    seconds: Annotated[float, Meta(gt=0.0, le=1e7)] | None = None

    @property
    def label(self) -> str:
        """For tables and file names."""
        return f"{self.spp} spp" if self.spp is not None else f"{self.seconds:g} s"


class Seconds(Struct):
    """Wall time of a run, divided so that the parts add up to `total`.

    Attributes:
        load: Building what rendering needs (upload, BVH), without compiling.
        compile: Kernels; none if they are cached.
        render: All samples and all training; what a budget in seconds is of.
        training: The part of `render` that was training.
        measure: Errors of the image, at the end and at the points on the way.
        write: The image file.
        other: All else.
        total: From the start of the run to its record.
    """

    load: float
    compile: float
    render: float
    training: float
    measure: float
    write: float
    other: float
    total: float


class Point(Struct):
    """A point of the convergence of a run.

    Attributes:
        samples: Per pixel, so far.
        seconds: Of rendering and training, so far.
        errors: By metric.
    """

    samples: int
    seconds: float
    errors: dict[str, float]


class Record(Struct):
    """A run: one method, scene, budget and seed.

    Attributes:
        scene: Its name.
        method: Its name.
        budget: What it might take.
        seed: Of the experiment.
        renderer_seed: What the renderer was given.
        samples: Per pixel.
        seconds: Wall time.
        errors: Of the image, by metric.
        points: At powers of two of the samples, and the end.
        image: File, relative to the results; null: it was not kept.
        made: What the run depends on: a record is used again if this is the same.
        notes: In what the method wants another image than the reference's.
        account: Figures of the renderer.
    """

    scene: str
    method: str
    budget: Budget
    seed: int
    renderer_seed: int
    samples: int
    seconds: Seconds
    errors: dict[str, float]
    points: list[Point]
    image: str | None
    made: dict
    notes: list[str]
    account: dict

    @property
    def key(self) -> tuple[str, str, Budget, int]:
        """Which run it is."""
        return self.scene, self.method, self.budget, self.seed


class ReferenceEntry(Struct):
    """The reference of a scene.

    Attributes:
        image: EXR file, relative to the results or absolute.
        sha256: Of the file.
        renderer: That made it.
        samples: Per pixel.
        error: Relative standard error, see `tools.reference`.
        comparisons: With other renderers' references, see `tools.reference.compare_stored`.
    """

    image: str
    sha256: str
    renderer: str
    samples: int
    error: float
    comparisons: list[dict] = []


class SceneEntry(Struct):
    """A scene of an experiment: name, file, size in pixels, all overrides, hash of the target, reference."""

    name: str
    file: str
    width: int
    height: int
    overrides: list[str]
    parameters: dict[str, str]
    target_sha256: str
    reference: ReferenceEntry


class MethodEntry(Struct):
    """A method of an experiment: name, renderer, its own overrides, versions of the renderer."""

    name: str
    renderer: str
    overrides: list[str]
    versions: dict[str, str]


class Experiment(Struct):
    """What was measured. `spec` is the file as it was read; `commit` that of the repository, if it is one."""

    format: int
    name: str
    description: str
    scenes: list[SceneEntry]
    methods: list[MethodEntry]
    budgets: list[Budget]
    seeds: list[int]
    metrics: list[str]
    baseline: str | None
    threads: int
    device: str
    machine: dict
    commit: str | None
    date: str
    spec: dict


@dataclasses.dataclass
class Results:
    """A folder of results.

    Attributes:
        folder: It.
        experiment: What was measured.
        records: The runs that have ended, in the order of the experiment; of runs made again, the last.
    """

    folder: Path
    experiment: Experiment
    records: list[Record]

    def cells(self) -> dict[tuple[str, str, Budget], list[Record]]:
        """The runs of each scene, method and budget, by seed; cells without runs are left out."""
        found: dict = {}
        for record in self.records:
            found.setdefault(record.key[:3], []).append(record)
        return found

    def image(self, record: Record) -> np.ndarray | None:
        """The image of a run, [height, width, 3] float32; None if it was not kept.

        Raises:
            WavefrontError: The file is missing or damaged.
        """
        return None if record.image is None else read_image(self.folder / record.image).pixels

    def reference(self, scene: str) -> Reference:
        """The reference of a scene, by its name.

        Raises:
            WavefrontError: No such scene, or a file that is missing, damaged or another than was measured with.
        """
        for entry in self.experiment.scenes:
            if entry.name == scene:
                reference = load_reference(self.folder / entry.reference.image)
                if reference.account.image_sha256 != entry.reference.sha256:
                    raise WavefrontError(f"{reference.path}: is another reference than the errors were measured with")
                return reference
        names = ", ".join(entry.name for entry in self.experiment.scenes)
        raise WavefrontError(f"{self.folder}: there is no scene {scene!r}; found: {names}")


# --- reading -----------------------------------------------------------------------------------------------------


def load_results(folder: str | os.PathLike) -> Results:
    """Reads a folder of results, of an experiment that has ended or not.

    Raises:
        WavefrontError: No such folder, or a damaged file, with the line.
    """
    folder = Path(folder)
    path = folder / EXPERIMENT
    try:
        experiment = msgspec.json.decode(path.read_bytes(), type=Experiment)
    except OSError as error:
        raise WavefrontError(f"{path}: cannot be read: {error.strerror or error}; allowed: results of "
                             "tools.experiment") from None  # fmt: skip
    except msgspec.MsgspecError as error:
        raise WavefrontError(f"{path}: damaged: {error}") from None
    if experiment.format != FORMAT:
        raise WavefrontError(f"{path}: format {experiment.format}; this version reads {FORMAT}")
    records = {record.key: record for record in read_records(folder / RECORDS)}
    order = [
        (scene.name, method.name, budget, seed)
        for scene in experiment.scenes
        for budget in experiment.budgets
        for method in experiment.methods
        for seed in experiment.seeds
    ]
    return Results(folder, experiment, [records[key] for key in order if key in records])


def read_records(path: Path) -> list[Record]:
    """The whole lines of a file of records; none if there is no file.

    Raises:
        WavefrontError: A line that is no record.
    """
    try:
        data = path.read_bytes() if path.exists() else b""
    except OSError as error:
        raise WavefrontError(f"{path}: cannot be read: {error.strerror or error}") from None
    records = []
    for number, line in enumerate(data[: data.rfind(b"\n") + 1].splitlines(), 1):
        try:
            records.append(msgspec.json.decode(line, type=Record))
        except msgspec.MsgspecError as error:
            raise WavefrontError(f"{path}: line {number}: not a record of a run: {error}") from None
    return records


# --- writing -----------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def appending(path: Path) -> Iterator[IO[bytes]]:
    """The file of records, to be given to `append`; what a killed process left of a line is cut off.

    Raises:
        WavefrontError: It cannot be written, or another process writes to it.
    """
    try:
        file = open(path, "a+b")  # noqa: SIM115 (its errors are told apart)
    except OSError as error:
        raise WavefrontError(f"{path}: cannot be written: {error.strerror or error}") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise WavefrontError(f"{path}: another process runs this experiment") from None
        file.seek(0)
        file.truncate(file.read().rfind(b"\n") + 1)
        yield file


def append(file: IO[bytes], record: Record) -> None:
    """Adds a record and forces it to the disk."""
    file.write(msgspec.json.encode(record) + b"\n")
    file.flush()
    os.fsync(file.fileno())


def write_json(path: Path, value: object) -> None:
    """Replaces a file by the JSON of a value.

    Raises:
        WavefrontError: It cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n")


def slug(name: str) -> str:
    """A name as part of a file name."""
    return re.sub(r"[^A-Za-z0-9._+-]+", "-", name).strip("-.") or "-"


def commit() -> str | None:
    """The commit of the repository, with ``+`` if files differ from it; None outside of one."""
    try:
        words = ["git", "-C", str(ROOT), "describe", "--always", "--abbrev=40", "--dirty=+", "--exclude=*"]
        done = subprocess.run(words, capture_output=True, encoding="utf-8", check=False)
    except OSError:
        return None
    return done.stdout.strip() or None


def other_commit(folder: Path) -> str | None:
    """The commit that the runs of a folder are of, if it is another than now; None if not, and where there are none."""
    now = commit()
    before = load_results(folder).experiment.commit if (folder / EXPERIMENT).exists() else now
    return None if before == now else before or "unknown"
