"""Presets: what they change, what wins over them, and that their check finds a preset that is dominated."""

from __future__ import annotations

import functools
import json
import re
import shutil
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from tools import experiment, preset_check, results, trade
from tools.frontier import DOMINATED
from tools.methods import Wavefront
from tools.reference_store import target_records
from wavefront import load_scene, presets
from wavefront.presets import NAMES, load_preset
from wavefront.render import main
from wavefront.scene.lookup import value_at

ROOT = Path(__file__).parent.parent
CORNELL_BOX = ROOT / "scenes" / "cornell-box.json"
SIZE = ("--size", "8x6", "--quiet", "--threads", "1")


def render(tmp_path, name: str, *arguments) -> tuple[np.ndarray, dict]:
    out = tmp_path / f"{name}.exr"
    assert main([str(CORNELL_BOX), "-o", str(out), *SIZE, *map(str, arguments)]) == 0
    with OpenEXR.File(str(out), separate_channels=True) as file:
        pixels = np.stack([np.array(file.channels()[c].pixels) for c in "RGB"], axis=-1)
    return pixels, json.loads(out.with_suffix(".json").read_text())


@pytest.mark.parametrize("name", NAMES)
def test_presets_fit_a_scene(name):
    preset = load_preset(name)
    assert (preset.name, bool(preset.description)) == (name, True)
    scene = load_scene(CORNELL_BOX, preset.overrides)
    assert all(value_at(scene, key) == value for key, value in preset.settings.items())
    # What is said of bias is so: the settings that change the expected image, of a scene of another depth.
    start = load_scene(CORNELL_BOX, ["integrator.max_depth=1000"])
    for key, value in preset.settings.items():
        one = load_scene(CORNELL_BOX, ["integrator.max_depth=1000", f"{key}={json.dumps(value)}"])
        assert (target_records(one) != target_records(start)) == (key in preset.biased_by)
    assert not preset.biased_by or name == "draft"


def test_presets_say_where_they_were_measured():
    for name in NAMES:
        origin = load_preset(name).origin
        assert re.fullmatch(r"[0-9a-f]{40}\+?", origin["commit"])
        assert origin["machine"]["cpu"]
        assert len(origin["scenes"]) >= 3
        for scene in [*origin["scenes"], origin["all_scenes"]]:
            assert scene["seconds"]["mean"] > 0.0 and scene["error"]["mean"] > 0.0
        assert origin["all_scenes"]["verdict"] != DOMINATED
    times = [load_preset(name).origin["all_scenes"]["seconds"]["mean"] for name in NAMES]
    errors = [load_preset(name).origin["all_scenes"]["error"]["mean"] for name in NAMES]
    assert times == sorted(times)
    assert errors == sorted(errors, reverse=True)


def test_a_preset_is_its_settings(tmp_path):
    """To the last bit the image of the same settings, given one by one."""
    preset = load_preset("draft")
    words = [word for override in preset.overrides for word in ("--set", override)]
    image, account = render(tmp_path, "a", "--preset", "draft")
    same, plain = render(tmp_path, "b", *words)
    np.testing.assert_array_equal(image, same)
    other, _ = render(tmp_path, "c", "--spp", preset.settings["integrator.spp"])
    assert (image != other).any()
    assert account["scene_sha256"] == plain["scene_sha256"]
    assert account["settings"] == plain["settings"]
    assert account["preset"] == {
        "name": "draft",
        "settings": preset.settings,
        "overridden": [],
        "biased_by": preset.biased_by,
    }
    assert plain["preset"] is None


def test_options_win_over_presets_and_presets_over_the_scene(tmp_path):
    settings = load_preset("draft").settings
    scene = load_scene(CORNELL_BOX)
    assert any(value_at(scene, key) != value for key, value in settings.items())
    arguments = ("--preset", "draft", "--spp", 3, "--max-depth", 5, "--set", "integrator.rr_depth=7")
    _, account = render(tmp_path, "a", *arguments)
    integrator = account["settings"]["integrator"]
    assert (integrator["spp"], integrator["max_depth"], integrator["rr_depth"]) == (3, 5, 7)
    wanted = {"integrator.spp", "integrator.max_depth", "integrator.rr_depth"} & settings.keys()
    assert set(account["preset"]["overridden"]) == wanted
    assert "integrator.max_depth" not in account["preset"]["biased_by"]  # the option chose it
    # Where neither the preset nor an option says anything, the scene does.
    assert integrator["nee"] == scene.integrator.nee
    _, account = render(tmp_path, "b", "--preset", "draft", "--time", 0.05)
    assert account["preset"]["overridden"] == ["integrator.spp"]


def test_unknown_preset(tmp_path, capsys):
    assert main([str(CORNELL_BOX), "-o", str(tmp_path / "a.exr"), "--preset", "fast", "--quiet"]) == 2
    error = capsys.readouterr().err
    assert error == "error: unknown preset 'fast'; allowed: draft, balanced, reference\n"
    assert not any(tmp_path.iterdir())


# --- the check ---------------------------------------------------------------------------------------------------

SETTINGS = {
    "draft": ({"integrator.spp": 4, "integrator.max_depth": 2}, ["integrator.max_depth"]),
    "balanced": ({"integrator.spp": 16}, []),
    "reference": ({"integrator.spp": 128}, []),
}


class ClockOfWork:
    """Counts what was asked for, as seconds: to render 12 by 10 pixels takes too little time to measure it."""

    def __init__(self):
        self.seconds = 0.0

    def __call__(self) -> float:
        return self.seconds

    def patched(self, add):
        def counted(engine: Wavefront, spp: int, seconds: float | None = None):
            add(engine, spp, seconds)
            integrator = engine.renderer.scene.integrator
            self.seconds += spp * min(integrator.max_depth, integrator.rr_depth or 20) * (1.0 + integrator.nee)

        return counted


@pytest.fixture
def work(monkeypatch):
    clock = ClockOfWork()
    monkeypatch.setattr(Wavefront, "add", clock.patched(Wavefront.add))
    monkeypatch.setattr(experiment, "run_once", functools.partial(experiment.run_once, now=clock))


def check(tmp_path, monkeypatch, *arguments, **changes) -> int:
    """The check with presets of a few samples and one small scene."""
    folder = tmp_path / "presets"
    folder.mkdir(exist_ok=True)
    for name, (settings, biased_by) in (SETTINGS | changes).items():
        preset = {"name": name, "description": "-", "settings": settings, "biased_by": biased_by, "origin": {}}
        (folder / f"{name}.json").write_text(json.dumps(preset))
    monkeypatch.setattr(presets, "FOLDER", folder)
    monkeypatch.setattr(preset_check, "SCENES", ("scenes/cornell-box.json", "${WAVEFRONT_SCENES}/a.xml"))
    monkeypatch.delenv("WAVEFRONT_SCENES", raising=False)
    command = ["--check-presets", "--seeds", "4", "--rounds", "0", "--threads", "1", "--reference-error", "0.05"]
    command += ["--override", "film.width=12", "film.height=10", "film.filter.type=box", "--no-plot"]
    return trade.main([*command, "-o", str(tmp_path / "results"), *arguments])


def test_check_of_presets(tmp_path, monkeypatch, capsys, work):
    assert check(tmp_path, monkeypatch, "--update-presets") == 0
    assert "WAVEFRONT_SCENES, which is not set, are left out" in capsys.readouterr().err
    origin = json.loads((tmp_path / "presets" / "reference.json").read_text())["origin"]
    assert [scene["file"] for scene in origin["scenes"]] == ["scenes/cornell-box.json"]
    assert origin["runs"] == 4
    assert origin["all_scenes"]["verdict"] != DOMINATED
    setting = {"setting", "seconds", "error"}
    assert origin["frontier"] and all(set(one) == setting for one in origin["frontier"])
    # What has been measured is there. A preset without light samples is far behind one with them and with less time.
    slow = ({"integrator.spp": 128, "integrator.nee": False}, [])
    assert check(tmp_path, monkeypatch, reference=slow) == 1
    assert "reference is dominated by " in capsys.readouterr().out
    # One that claims to have no bias.
    assert check(tmp_path, monkeypatch, draft=(SETTINGS["draft"][0], [])) == 2
    assert "draft.json: biased_by is empty; cornell-box finds a bias" in capsys.readouterr().err
    # Runs of other code say nothing of this one.
    made_by = json.loads((tmp_path / "results" / "experiment.json").read_text())["commit"]
    monkeypatch.setattr(results, "commit", lambda: "f" * 40)
    assert check(tmp_path, monkeypatch) == 2
    assert f"results: has runs of another commit, {made_by}; choose another --output" in capsys.readouterr().err


def test_a_preset_that_is_no_knob(tmp_path, monkeypatch, capsys):
    assert check(tmp_path, monkeypatch, draft=({"integrator.spp": 4, "film.width": 3}, [])) == 2
    assert "draft.json: settings.film.width is no knob that is swept" in capsys.readouterr().err
    assert check(tmp_path, monkeypatch, draft=({"integrator.max_depth": 3}, [])) == 2
    assert "draft.json: settings has no integrator.spp" in capsys.readouterr().err


@pytest.mark.slow
def test_no_preset_is_dominated(tmp_path):
    """Measures the presets again, as `python -m tools.trade --check-presets`: half an hour on two cores."""
    try:
        assert trade.main(["--check-presets", "--no-plot", "--output", str(tmp_path / "results")]) == 0
    finally:
        shutil.rmtree(tmp_path, ignore_errors=True)
