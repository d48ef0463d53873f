"""Experiments: the file that says what is measured, the account of the time, and that a kill changes nothing."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest

from tools import experiment, methods
from tools import results as stored
from tools.experiment_spec import plan, read_spec
from tools.methods import load_job
from tools.metrics import evaluate
from tools.reference import Reference, make_reference
from tools.reference_render import Goal
from tools.results import Budget, Record, append, appending, load_results, read_records
from wavefront.errors import SceneError, WavefrontError

ROOT = Path(__file__).parent.parent
CORNELL_BOX = str(ROOT / "scenes" / "cornell-box.json")
SPEC = {
    "scenes": [{"file": CORNELL_BOX}],
    "overrides": ["film.width=12", "film.height=10", "film.filter.type=box", "integrator.max_depth=3"],
    "methods": [
        {"name": "path tracing"},
        {"name": "no NEE", "overrides": ["integrator.nee=false"]},
    ],
    "budgets": [{"spp": 200}],
    "seeds": [1, 2, 3, 4],
    "metrics": ["relmse", "mape"],
    "reference": {"spp": 64},
    "images": "run",
}


def write(folder: Path, **changes) -> Path:
    path = folder / "spec.json"
    path.write_text(json.dumps(SPEC | changes))
    return path


def command(spec: Path, folder: Path, *words: str) -> int:
    return experiment.main([str(spec), "-o", str(folder), "--threads", "1", *words])


# --- what is measured --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"methods": []}, "methods: expected a list"),
        ({"budget": []}, "unknown key 'budget'; did you mean 'budgets'?"),
        ({"seeds": [1, -1]}, "seeds[1]: expected an integer >= 0 and < 128; found -1"),
        ({"seeds": [3, 3]}, "seeds[1]: 3 is as seeds[0] is"),
        ({"seeds": "many"}, "seeds: expected a list of integers >= 0 and < 128; found the string 'many'"),
        ({"budgets": [{"spp": 4, "seconds": 1}]}, "budgets[0]: allowed: either spp or seconds"),
        ({"budgets": [{}]}, "budgets[0]: allowed: either spp or seconds"),
        ({"budgets": [{"spp": 0}]}, "budgets[0].spp: expected an integer >= 1 and <= 2147483647 or null; found 0"),
        ({"budgets": [{"seconds": -1.0}]}, "budgets[0].seconds: expected a number > 0"),
        ({"metrics": ["psnr"]}, "metrics[0]: unknown name 'psnr'; allowed: mse, "),
        ({"baseline": "pt"}, "baseline: unknown name 'pt'; allowed: path tracing, no NEE"),
        ({"images": "all"}, "images: expected 'cell', 'none' or 'run'; found the string 'all'"),
        ({"methods": [{"name": "a", "renderer": "pbrt"}]}, "methods[0].renderer: unknown name 'pbrt'; allowed: wave"),
        ({"methods": [{"name": "a b"}, {"name": "a-b"}]}, "methods[1]: 'a-b' is as methods[0] is"),
        ({"methods": [{"name": "a", "overrides": ["film.width=9"]}]}, "a method does not change 'film.width'"),
        ({"methods": [{"name": "a", "overrides": ["integrator.x=9"]}]}, "methods[0]: "),
        ({"methods": [{"name": "a", "overrides": ["integrator.x=9"]}]}, "unknown key 'x'"),
        ({"scenes": [{"file": "missing.json"}]}, "scenes[0]: "),
        ({"scenes": [{"file": "missing.json"}]}, "file not found"),
        ({"scenes": [{"file": "${NO_SUCH_SCENES}/a/scene.xml"}]}, "scenes[0].file: the environment variable NO_SUCH_"),
        ({"scenes": [{"file": CORNELL_BOX}] * 2}, "scenes[1]: 'cornell-box' is as scenes[0] is"),
        ({"scenes": [{"file": CORNELL_BOX, "parameters": 3}]}, "scenes[0].parameters: expected an object; found 3"),
        ({"reference": {}}, "reference: no limit; allowed: at least one of error, spp, seconds"),
        ({"reference": {"spp": 9, "renderers": ["pbrt"]}}, "reference.renderers[0]: unknown name 'pbrt'"),
        ({"reference": {"spp": 9, "renderers": ["cycles"]}}, "unknown name 'cycles'; allowed: wavefront, mitsuba"),
        ({"reference": {"spp": 9, "overrides": ["integrator.max_depth=9"]}}, "change integrator.max_depth"),
    ],
)
def test_errors_of_the_spec(changes, message, tmp_path, capsys):
    path = write(tmp_path, **changes)
    assert command(path, tmp_path / "results") == 2
    error = capsys.readouterr().err
    assert f"error: {path}: " in error
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "results").exists()


def test_not_json(tmp_path, capsys):
    path = tmp_path / "spec.json"
    path.write_text('{"scenes": [,]}')
    assert command(path, tmp_path / "results") == 2
    assert "spec.json: line 1, column 13: not JSON" in capsys.readouterr().err


@pytest.mark.parametrize("path", sorted((ROOT / "tools" / "experiments").glob("*.json")), ids=lambda path: path.stem)
def test_ready_specs_can_be_read(path):
    spec = read_spec(path)
    assert spec.description
    if path.stem == "small":
        scenes = plan(spec, path)
        assert [scene.name for scene in scenes] == ["cornell-box", "glossy-plates"]


def test_a_method_that_wants_another_image_is_noted(tmp_path):
    path = write(tmp_path, methods=[{"name": "short", "overrides": ["integrator.max_depth=2", "integrator.nee=false"]}])
    (scene,) = plan(read_spec(path), path)
    assert scene.notes == {"short": ["integrator.max_depth is 2, but 3 in the reference"]}


# --- time --------------------------------------------------------------------------------------------------------


class Clock:
    """Time that passes only where it is said to."""

    def __init__(self):
        self.time = 100.0

    def __call__(self) -> float:
        return self.time


class Fake:
    """A renderer of which all times are known: each sample takes 0.25 s, and 0.125 s of that is training."""

    clock: Clock
    image_seconds = 3.0

    def __init__(self, job, seed):
        self.whole, self.compile_seconds, self.training_seconds, self.samples = False, 2.0, 0.0, 0
        self.clock.time += 5.0

    def add(self, spp, seconds=None):
        begin = self.clock.time
        for _ in range(spp):
            self.samples += 1
            self.clock.time += 0.25
            self.training_seconds += 0.125
            if seconds is not None and self.clock.time - begin >= seconds:
                break

    def image(self):
        self.clock.time += self.image_seconds
        return np.full((2, 3, 3), 1.0 + 1.0 / self.samples)

    def account(self):
        return {}


@pytest.mark.parametrize(
    ("budget", "samples"),
    [
        (Budget(seconds=2.0), 8),
        (Budget(seconds=2.1), 8),  # a ninth would end 0.15 s late
        (Budget(seconds=2.2), 9),
        (Budget(seconds=0.01), 1),
        (Budget(spp=11), 11),
        (Budget(spp=1), 1),
    ],
)
def test_the_parts_of_the_time_add_up(budget, samples, monkeypatch, tmp_path):
    clock = Clock()
    monkeypatch.setattr(Fake, "clock", clock, raising=False)
    monkeypatch.setitem(methods.RENDERERS, "fake", Fake)
    reference = Reference(tmp_path, np.ones((2, 3, 3), np.float32), np.zeros((2, 3), np.float32), None)
    engine, seconds, points = experiment.run_once(
        "fake", None, 0, budget, reference, ["mse", "mae"], tmp_path / "a" / "b.exr", clock
    )
    assert engine.samples == samples
    powers = [1 << k for k in range(samples.bit_length())]
    assert [point.samples for point in points] == sorted({*powers, samples})
    # What it takes to look at the image is not rendering.
    np.testing.assert_allclose([p.seconds for p in points], [0.25 * p.samples for p in points])
    np.testing.assert_allclose([p.errors["mae"] for p in points], [1.0 / p.samples for p in points])
    np.testing.assert_allclose([p.errors["mse"] for p in points], [1.0 / p.samples**2 for p in points])
    assert seconds.render == pytest.approx(0.25 * samples)
    assert seconds.training == pytest.approx(0.125 * samples)
    assert (seconds.load, seconds.compile) == (3.0, 2.0)
    assert seconds.measure == pytest.approx(3.0 * len(points))
    assert seconds.write == pytest.approx(3.0)
    assert seconds.other == pytest.approx(0.0, abs=1e-9)
    assert seconds.total == pytest.approx(clock.time - 100.0)
    parts = (seconds.load, seconds.compile, seconds.render, seconds.measure, seconds.write, seconds.other)
    assert sum(parts) == pytest.approx(seconds.total)


# --- results -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def at_once(tmp_path_factory):
    """Results of an experiment that nothing interrupted."""
    folder = tmp_path_factory.mktemp("experiment")
    assert command(write(folder), folder / "results") == 0
    return load_results(folder / "results")


def deterministic(record: Record) -> dict:
    """A record without what depends on the clock."""
    plain = msgspec.to_builtins(record)
    del plain["seconds"], plain["account"]["stage_seconds"]
    for point in plain["points"]:
        del point["seconds"]
    return plain


def test_records_say_what_was_measured(at_once):
    assert len(at_once.records) == 8
    assert [len(records) for records in at_once.cells().values()] == [4, 4]
    reference = at_once.reference("cornell-box")
    for record in at_once.records:
        image = at_once.image(record)
        assert image.shape == (10, 12, 3)
        for metric, error in record.errors.items():
            assert error == pytest.approx(evaluate(metric, image, reference.image), rel=1e-6)
        assert record.samples == 200
        assert record.account["paths"] == 200 * 120
        assert [point.samples for point in record.points] == [1, 2, 4, 8, 16, 32, 64, 128, 200]
        s = record.seconds
        parts = (s.load, s.compile, s.render, s.measure, s.write, s.other)
        assert min(parts) >= 0.0
        assert sum(parts) == pytest.approx(s.total, rel=1e-9)
    seeds = {record.renderer_seed for record in at_once.records}
    assert len(seeds) == 8  # runs of different methods are independent too
    assert 0 not in seeds  # as of the reference
    images = [at_once.image(record) for record in at_once.records]
    assert all((a != b).any() for i, a in enumerate(images) for b in images[:i])


def test_resumes_after_a_kill(at_once, tmp_path):
    """SIGKILL between two records, and in a record that is being written."""
    spec, folder = write(tmp_path), tmp_path / "results"
    process = subprocess.Popen(
        [sys.executable, "-m", "tools.experiment", str(spec), "-o", str(folder), "--threads", "1"],
        cwd=ROOT,
        stderr=subprocess.DEVNULL,
    )
    try:
        deadline = time.monotonic() + 120.0
        while time.monotonic() < deadline:
            if (folder / "results.jsonl").exists() and (folder / "results.jsonl").read_bytes().count(b"\n") >= 2:
                break
            time.sleep(0.002)
    finally:
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    killed = read_records(folder / "results.jsonl")
    assert 2 <= len(killed) < 8
    line = (folder / "results.jsonl").read_bytes().splitlines()[0]
    with open(folder / "results.jsonl", "ab") as file:
        file.write(line[: len(line) // 2])
    assert len(load_results(folder).records) == len(killed)
    assert command(spec, folder) == 0
    resumed = load_results(folder)
    assert [deterministic(a) for a in resumed.records] == [deterministic(b) for b in at_once.records]
    for a, b in zip(resumed.records, at_once.records, strict=True):
        np.testing.assert_array_equal(resumed.image(a), at_once.image(b))
    # The runs that had ended were not made again.
    kept = {record.key: record for record in resumed.records}
    assert all(kept[record.key] == record for record in killed)


def test_other_settings_are_refused(at_once, tmp_path, capsys):
    spec, folder = write(tmp_path), tmp_path / "results"
    assert command(spec, folder) == 0
    records = (folder / "results.jsonl").read_bytes()
    assert command(write(tmp_path, metrics=["mape"]), folder) == 2
    assert "other results of cornell-box, path tracing: metrics" in capsys.readouterr().err
    # Another seed is no other setting.
    assert command(write(tmp_path, seeds=[1, 2, 3, 4, 5]), folder) == 0
    assert (folder / "results.jsonl").read_bytes().startswith(records)
    assert len(load_results(folder).records) == 10


def test_runs_of_another_commit_are_told(tmp_path, capsys, monkeypatch):
    spec, folder = write(tmp_path, budgets=[{"spp": 1}], images="none"), tmp_path / "results"
    for commit, words in (
        ("a", ""),
        ("a", ""),
        ("b", "another commit, a, are not made again"),
        (None, "commit, b, are"),
    ):
        monkeypatch.setattr(stored, "commit", lambda commit=commit: commit)
        monkeypatch.setattr(experiment, "commit", stored.commit)
        assert command(spec, folder) == 0
        error = capsys.readouterr().err
        assert words in error
        assert ("another commit" in error) == bool(words)


def test_a_reference_that_is_there_is_used(tmp_path):
    """Whatever its seed is and how its noise was made, if it is good enough."""
    made = make_reference(
        load_job(Path(CORNELL_BOX), [*SPEC["overrides"], "integrator.nee=false"], None, 1),
        Goal(spp=100),
        tmp_path / "references",
        seed=5,
    )
    spec = write(tmp_path, budgets=[{"spp": 1}], seeds=[1], images="none")
    assert command(spec, tmp_path / "results", "--references", str(tmp_path / "references")) == 0
    results = load_results(tmp_path / "results")
    assert results.reference("cornell-box").account == made.account
    assert results.image(results.records[0]) is None
    made.path.unlink()
    with pytest.raises(WavefrontError, match="file not found"):
        results.reference("cornell-box")


def test_two_processes_are_refused(at_once, tmp_path):
    path = tmp_path / "results.jsonl"
    with (
        appending(path) as file,
        pytest.raises(WavefrontError, match="another process"),
        appending(path),
    ):
        pass
    with appending(path) as file:
        append(file, at_once.records[0])
    assert read_records(path) == at_once.records[:1]


def test_damage_is_told(at_once, tmp_path):
    with pytest.raises(WavefrontError, match=r"experiment.json: cannot be read"):
        load_results(tmp_path)
    path = tmp_path / "results.jsonl"
    path.write_bytes(msgspec.json.encode(at_once.records[0]) + b"\n{}\n")
    with pytest.raises(WavefrontError, match="line 2: not a record"):
        read_records(path)


def test_ready_spec_needs_the_folder_of_scenes(monkeypatch):
    monkeypatch.delenv("WAVEFRONT_SCENES", raising=False)
    path = ROOT / "tools" / "experiments" / "npm.json"
    with pytest.raises(SceneError, match=r"scenes\[0\].file: the environment variable WAVEFRONT_SCENES is not set"):
        plan(read_spec(path), path)
