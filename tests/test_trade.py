"""The command that sweeps knobs: what it sweeps, what it refuses, what it finds, and that a kill changes nothing."""

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

from guiding import guide_of
from tools import setting_cost, sweep, trade
from tools.experiment import run_once
from tools.experiment_spec import MethodSpec, ReferenceSpec, SceneSpec, Spec
from tools.experiment_spec import plan as plan_experiment
from tools.knobs import KNOBS, TRADES, UNRESTRICTED_DEPTH, Knob, label, parse_knob
from tools.methods import load_job
from tools.reference_store import target_records
from tools.results import Budget, load_results, read_records
from tools.setting_cost import Cost
from tools.summary import Figure
from tools.sweep import joined_pairs, make_plan, method_name, one_at_a_time
from tools.trade_report import bias_words
from wavefront import load_scene
from wavefront.errors import WavefrontError
from wavefront.integrator import make_features
from wavefront.scene.device import upload_scene

ROOT = Path(__file__).parent.parent
CORNELL_BOX = ROOT / "scenes" / "cornell-box.json"
SMALL = ["film.width=12", "film.height=10", "film.filter.type=box", "integrator.max_depth=4"]
REFERENCE = ReferenceSpec(error=0.5)
GUIDED = ["--override", 'integrator.guide={"preset": "npm-product"}']
VALUES = [(knob, value) for knob in KNOBS.values() for value in knob.values]


# --- knobs -------------------------------------------------------------------------------------------------------


def guided(knob: Knob) -> list[str]:
    """What a scene needs to have a knob."""
    return ['integrator.guide={"preset": "npm-product"}'] if knob.of_guide else []


@pytest.mark.parametrize(("knob", "value"), VALUES, ids=[f"{knob.name}={label(value)}" for knob, value in VALUES])
def test_the_scene_takes_every_value(knob, value):
    for start in ([], ['film.filter={"type": "gaussian", "stddev": 0.7}', "integrator.rr_depth=null"]):
        scene = load_scene(CORNELL_BOX, [*start, *guided(knob), *knob.overrides(value)])
        assert knob.own(scene) == value
    assert parse_knob(f"{knob.name}={label(value)}") == (knob, (value,))


@pytest.mark.parametrize("knob", KNOBS.values(), ids=KNOBS)
def test_knobs_trade_what_they_say(knob):
    """A bias is another expected image; kernels and buffers follow from the features and the guide's network."""
    assert set(knob.trades) <= set(TRADES)
    scenes = [load_scene(CORNELL_BOX, [*guided(knob), *knob.overrides(value)]) for value in knob.values]
    targets = [json.dumps(target_records(scene)) for scene in scenes]
    assert (len(set(targets)) > 1) == ("bias" in knob.trades)
    built = set()
    for scene in scenes:
        guide = guide_of(scene)
        network = guide and (guide.settings.n_outputs, json.dumps(guide.settings.model()))
        built.add((make_features(scene, upload_scene(scene, "cpu"), guide), network))
    assert (len(built) > 1) == ("compile" in knob.trades)


def test_values_of_the_reference():
    assert KNOBS["max_depth"].least_biased((4, 2, 8)) == UNRESTRICTED_DEPTH
    assert KNOBS["max_depth"].least_biased((4, 200)) == 200
    assert KNOBS["filter"].least_biased(("tent", "box")) == "tent"


# --- what is swept -----------------------------------------------------------------------------------------------


def plan_of(**changes):
    wanted = {
        "paths": [CORNELL_BOX],
        "knobs": {"max_depth": (2, 4), "nee": (True, False)},
        "sizes": (2, 8),
        "seconds": (),
        "seeds": 3,
        "metric": "relmse",
        "reference": REFERENCE,
        "overrides": SMALL,
    }
    return make_plan(**(wanted | changes))


def test_plan_by_hand():
    plan = plan_of()
    assert plan.own == {"max_depth": 4, "nee": True}
    assert plan.unbiased == {"max_depth": 64, "nee": True}
    assert plan.values == {"max_depth": (4, 2, 64), "nee": (True, False)}
    assert one_at_a_time(plan) == [{}, {"max_depth": 2}, {"max_depth": 64}, {"nee": False}]
    assert plan.scenes[0].overrides == [*SMALL, "integrator.max_depth=64"]
    # From the reference's settings to those of a method.
    assert plan.overrides({}) == ["integrator.max_depth=4"]
    assert plan.overrides({"max_depth": 64, "nee": False}) == ["integrator.nee=false"]
    assert len(sweep.grid(plan)) == 6
    assert [method_name(changes) for changes in sweep.grid(plan)][:3] == ["default", "nee=false", "max_depth=2"]
    assert plan.budgets == [Budget(spp=8)]
    assert plan_of(sizes=(2, 3, 8)).budgets == [Budget(spp=3), Budget(spp=8)]
    assert plan_of(sizes=(), seconds=(2.0, 1.0)).budgets == [Budget(seconds=1.0), Budget(seconds=2.0)]


def test_a_knob_that_trains_has_runs_of_its_own(monkeypatch):
    monkeypatch.setitem(KNOBS, "nee", Knob("nee", "integrator.nee", (True, False), ("time",), trains=True))
    assert plan_of().budgets == [Budget(spp=2), Budget(spp=8)]


def test_the_reference_of_a_sobol_scene_takes_independent_samples():
    plan = plan_of(overrides=[*SMALL, "integrator.sampler=sobol"])
    assert plan.scenes[0].reference.overrides == ["integrator.sampler=independent"]


def test_scenes_start_from_the_same():
    with pytest.raises(WavefrontError, match=r"max_depth is 6, but 8 in .*--override integrator.max_depth=8"):
        plan_of(paths=[CORNELL_BOX, ROOT / "scenes" / "glossy-plates.json"], overrides=[])


def test_scenes_have_names_of_their_own():
    with pytest.raises(WavefrontError, match="another scene is called cornell-box too"):
        plan_of(paths=[CORNELL_BOX, CORNELL_BOX])


def test_pairs_by_hand():
    order = ["a", "b", "c"]
    there = [{}, {"a": 1}, {"a": 2}, {"b": 1}, {"a": 2, "b": 1}]
    assert joined_pairs([{"a": 1}, {"a": 2}, {"b": 1}], there, order) == [{"a": 1, "b": 1}]
    # Those that agree where they meet; each union once, whatever it came from.
    parents = [{"c": 1}, {"a": 1, "b": 1}, {"b": 1}, {"b": 2, "c": 1}]
    found = joined_pairs(parents, [], order)
    assert found == [{"a": 1, "b": 1, "c": 1}, {"b": 1, "c": 1}, {"b": 2, "c": 1}, {"a": 1, "b": 1}]
    assert list(found[0]) == order


# --- errors ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "error: a scene is missing: python -m tools.trade SCENE"),
        (["missing.json"], "error: missing.json: file not found"),
        ([CORNELL_BOX, "--knob", "depth"], "error: there is no knob 'depth'; allowed: spp, max_depth, rr_depth, nee, "),
        ([CORNELL_BOX, "--knob", "nee="], "error: --knob nee=: allowed: different values with commas between them"),
        ([CORNELL_BOX, "--knob", "nee=false,false"], "allowed: different values with commas between them"),
        ([CORNELL_BOX, "--knob", "nee", "--knob", "nee=false"], "error: --knob nee=false: nee is there twice"),
        ([CORNELL_BOX, "--knob", "max_depth=0"], "error: --knob max_depth=0: "),
        ([CORNELL_BOX, "--knob", "max_depth=0"], "integrator.max_depth: expected an integer >= 1"),
        ([CORNELL_BOX, "--knob", "filter=mitchell"], "film.filter.type: "),
        ([CORNELL_BOX, "--knob", "spp=0"], "error: --knob spp 0; allowed: different positive numbers"),
        ([CORNELL_BOX, "--knob", "spp=4", "--spp", "4"], "error: --knob spp together with --spp or --seconds"),
        ([CORNELL_BOX, "--spp", "4,x"], "error: --spp 4,x; allowed: different positive numbers"),
        ([CORNELL_BOX, "--spp", "4,4"], "error: --spp 4,4; allowed: different positive numbers"),
        ([CORNELL_BOX, "--seconds", "nan"], "error: --seconds nan; allowed: different positive numbers"),
        (
            [CORNELL_BOX, "--spp", "4", "--more-spp", "4"],
            "error: --more-spp 4; allowed: more than the largest of --spp",
        ),
        ([CORNELL_BOX, "--metric", "psnr"], "error: --metric psnr; allowed: mse, "),
        (
            [CORNELL_BOX, "--knob", "n_neurons"],
            "error: --knob n_neurons: the scene names no guide; one is chosen as by",
        ),
        ([CORNELL_BOX, "--knob", "guide", "--knob", "train_share"], "error: --knob guide together with --knob train"),
        ([CORNELL_BOX, *GUIDED, "--knob", "n_neurons=48"], "integrator.guide.settings.n_neurons: "),
        ([CORNELL_BOX, "--seeds", "0"], "error: --seeds 0; allowed: 1 to 127"),
        ([CORNELL_BOX, "--rounds", "-1"], "error: --rounds -1; allowed: 0 or more"),
        ([CORNELL_BOX, "--threads", "0"], "error: --threads 0; allowed: 1 or more"),
        ([CORNELL_BOX, "--reference-error", "0"], "error: --reference-error 0; allowed: more than 0"),
        ([CORNELL_BOX, "--define", "x"], "error: --define 'x'; allowed: NAME=VALUE"),
        ([CORNELL_BOX, "--override", "film.x=1"], "unknown key 'x'"),
        ([CORNELL_BOX, "--update-presets"], "error: --update-presets is for --check-presets, which is missing"),
        ([CORNELL_BOX, "--check-presets"], "error: a scene together with --check-presets"),
        (["--check-presets", "--spp", "4"], "error: --spp together with --check-presets"),
    ],
)
def test_errors_are_one_line(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert trade.main([str(argument) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_without_matplotlib(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert trade.main([str(CORNELL_BOX)]) == 2
    assert "pip install '.[measure]'; or add --no-plot" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


# --- what is found -----------------------------------------------------------------------------------------------

COMMAND = [str(CORNELL_BOX), "--knob", "max_depth=2,4", "--knob", "nee", "--spp", "2,32", "--more-spp", "64"]
COMMAND += ["--seeds", "3", "--threads", "1", "--reference-error", "0.05", "--override", *SMALL]


def fake_cost(job):
    return Cost(1.5, 2 << 20)


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A folder of a sweep that nothing interrupted, and what was printed."""
    folder = tmp_path_factory.mktemp("trade") / "results"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(setting_cost, "measure", fake_cost)
        assert trade.main([*COMMAND, "--output", str(folder)]) == 0
    return folder


def test_what_a_sweep_finds(swept):
    found = json.loads((swept / "trade.json").read_text())
    (section,) = found["sections"]
    settings = {setting["name"]: setting for setting in section["settings"]}
    assert {"default, 2 spp", "default, 32 spp", "max_depth=2, 2 spp", "max_depth=64, 64 spp"} <= set(settings)
    assert not {"default, 64 spp", "max_depth=2, 64 spp"} & set(settings)  # they have a bias
    assert [knob["name"] for knob in found["knobs"]] == ["max_depth", "nee", "spp"]
    assert (swept / "frontier.png").read_bytes().startswith(b"\x89PNG")
    for setting in settings.values():
        assert setting["compile_seconds"] == 1.5 and setting["peak_memory_bytes"] == 2 << 20
        assert setting["error"]["low"] < setting["error"]["mean"] < setting["error"]["high"]
        assert setting["verdict"] in ("frontier", "not separated", "dominated")
        assert (setting["verdict"] == "dominated") == (setting["dominated_by"] is not None)
    assert set(section["frontier"]) == {s["name"] for s in settings.values() if s["verdict"] == "frontier"}
    # Direct light alone leaves out much of the light of a closed room; the unrestricted setting nothing.
    short, unrestricted = settings["max_depth=2, 32 spp"], settings["max_depth=64, 32 spp"]
    assert short["bias"]["low"] > 0.0
    assert short["bias_share"] > 0.3
    assert unrestricted["bias_share"] == 0.0
    assert settings["nee=false, 32 spp"]["bias"]["low"] < short["bias"]["low"]
    results = load_results(swept)
    assert {record.budget.spp for record in results.records} == {32, 64}
    reference = results.reference("cornell-box").account
    assert reference.settings["integrator"]["max_depth"] == UNRESTRICTED_DEPTH


def test_points_of_a_run_are_runs(swept):
    """What is taken for runs of 2 samples is what such runs give."""
    results, plan = load_results(swept), plan_of(sizes=(2, 32), more=64)
    settings = {s.name: s for s in sweep.settings_of(results, "cornell-box", plan)}
    records = [r for r in results.records if (r.method, r.budget.spp) == ("default", 32)]
    assert settings["default, 32 spp"].errors == tuple(record.errors["relmse"] for record in records)
    job, reference = load_job(CORNELL_BOX, SMALL, None, 1), results.reference("cornell-box")
    for record, error in zip(records, settings["default, 2 spp"].errors, strict=True):
        _, _, points = run_once("wavefront", job, record.renderer_seed, Budget(spp=2), reference, ["relmse"], None)
        assert points[-1].errors == {"relmse": error}


def test_resumes_after_a_kill(swept, tmp_path, monkeypatch):
    folder = tmp_path / "results"
    process = subprocess.Popen(
        [sys.executable, "-m", "tools.trade", *COMMAND, "--output", str(folder)], cwd=ROOT, stderr=subprocess.DEVNULL
    )
    try:
        deadline = time.monotonic() + 120.0
        while time.monotonic() < deadline:
            if (folder / "results.jsonl").exists() and (folder / "results.jsonl").read_bytes().count(b"\n") >= 3:
                break
            time.sleep(0.002)
    finally:
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    killed = read_records(folder / "results.jsonl")
    assert len(killed) >= 3
    assert not (folder / "trade.json").exists()
    monkeypatch.setattr(setting_cost, "measure", fake_cost)
    assert trade.main([*COMMAND, "--output", str(folder)]) == 0
    resumed = {record.key: record for record in load_results(folder).records}
    assert all(resumed[record.key] == record for record in killed)  # they were not made again
    # Rounds follow from times, which differ; what both have measured is the same.
    others = {record.key: record for record in load_results(swept).records}
    common = resumed.keys() & others.keys()
    assert len({key[1] for key in common}) >= 4
    assert all(resumed[key].errors == others[key].errors for key in common)


def test_json_is_printed(swept, capsys, monkeypatch):
    monkeypatch.setattr(setting_cost, "measure", fake_cost)
    assert trade.main([*COMMAND, "--output", str(swept), "--json", "--no-plot"]) == 0
    assert json.loads(capsys.readouterr().out)["sections"] == json.loads((swept / "trade.json").read_text())["sections"]


def test_equal_time_and_a_grid(tmp_path, capsys, monkeypatch):
    """Budgets in seconds, all combinations, a metric without bias, two scenes."""
    monkeypatch.setattr(setting_cost, "measure", fake_cost)
    second = tmp_path / "second.json"
    second.write_text(CORNELL_BOX.read_text())
    command = [str(CORNELL_BOX), str(second), "--knob", "max_depth=2", "--knob", "rr_depth=2", "--grid", "--metric"]
    command += ["mape", "--seconds", "0.02,0.01", "--seeds", "2", "--reference-error", "0.5", "--threads", "1"]
    folder = tmp_path / "results"
    assert trade.main([*command, "-o", str(folder), "--override", *SMALL]) == 0
    found = json.loads((folder / "trade.json").read_text())
    assert [section["name"] for section in found["sections"]] == ["cornell-box", "second", "all scenes"]
    for section in found["sections"]:
        assert len(section["settings"]) == 3 * 2 * 2  # depths (2, 4, 64) x roulette (2, 5) x seconds
        assert {setting["bias"] for setting in section["settings"]} == {None}
    one, two, both = ([s["seconds"]["mean"] for s in section["settings"]] for section in found["sections"])
    assert (np.minimum(one, two) * 0.5 < both).all() and (both < np.maximum(one, two) * 2.0).all()
    assert "max_depth=2, rr_depth=2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("bias", "words"),
    [
        (None, "?"),
        (Figure(0.0, 0.0, 0.0), "0"),
        (Figure(0.5, 0.25, 0.75), "0.5 (0.25 to 0.75)"),
        (Figure(0.25, -0.25, 0.75), "< 0.75"),
        (Figure(-0.5, -0.75, -0.25), "none found"),
    ],
)
def test_words_for_a_bias(bias, words):
    assert bias_words(bias) == words


GUIDED_METHODS = [
    MethodSpec(name=name, overrides=[GUIDED[1], f"integrator.guide.settings.n_neurons={n}"])
    for name, n in (("narrow", 32), ("wide", 64))
]


def test_cost_of_a_setting(tmp_path, monkeypatch):
    """In a process of its own, once for all settings with the same kernels; the file keeps it."""
    path = tmp_path / "spec"
    spec = Spec(
        scenes=[SceneSpec(file=str(CORNELL_BOX), overrides=SMALL)],
        methods=[MethodSpec(name="a"), MethodSpec(name="b", overrides=["integrator.max_depth=3"])],
        budgets=[Budget(spp=1)],
    )
    (scene,) = plan_experiment(spec, path)
    said = []
    costs = setting_cost.measure_all(scene, {"a": "same", "b": "same"}, tmp_path, said.append)
    assert said == ["cornell-box, a: compile time and memory"]
    assert costs["a"] == costs["b"]
    assert costs["a"].compile_seconds > 0.2  # nothing was cached
    assert 50 << 20 < costs["a"].peak_memory_bytes < 4 << 30
    assert setting_cost.measure_all(scene, {"b": "same"}, tmp_path, said.append) == {"b": costs["b"]}
    assert len(said) == 1
    # Networks are not among the features.
    monkeypatch.setattr(setting_cost, "measure", fake_cost)
    (guided_scene,) = plan_experiment(msgspec.structs.replace(spec, methods=GUIDED_METHODS), path)
    setting_cost.measure_all(guided_scene, {"narrow": "same", "wide": "same"}, tmp_path, said.append)
    assert said[1:] == [f"cornell-box, {name}: compile time and memory" for name in ("narrow", "wide")]
    (tmp_path / "costs.json").write_text("{")
    with pytest.raises(WavefrontError, match=r"costs.json: damaged"):
        setting_cost.measure_all(scene, {"b": "same"}, tmp_path, said.append)
