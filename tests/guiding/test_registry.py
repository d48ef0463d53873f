"""Guides by name: presets that say where their values are from, changes of their settings, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from guiding import guide_of, make_guide, plain_settings, preset_names, registry
from tests.guides import MEAN_PRESET, ChosenMeanGuide, use_mean_preset
from wavefront.errors import SceneError, WavefrontError
from wavefront.guide import check_guide
from wavefront.scene import description
from wavefront.scene.json_format import checked

CORNELL_BOX = Path(__file__).parent.parent.parent / "scenes" / "cornell-box.json"


@pytest.fixture
def mean(monkeypatch, tmp_path):
    use_mean_preset(monkeypatch, tmp_path)


@pytest.mark.parametrize("name", preset_names())
def test_every_setting_of_a_preset_has_a_source(name):
    """And every setting of its method is in it, so that a default which changes later changes no preset."""
    preset = registry.load_preset(name)
    assert preset.description and "\n" not in preset.description
    assert preset.sources.keys() == preset.settings.keys()
    _, settings = registry.guide_settings(name)
    assert set(settings.__struct_fields__) == preset.settings.keys()
    guide = make_guide(name, seed=7)
    check_guide(guide)
    assert guide.name == preset.method and guide.seed == 7
    assert guide.identity() == {"seed": 7} | msgspec.to_builtins(settings)


def test_settings_replace_those_of_the_preset(mean):
    assert isinstance(make_guide("mean"), ChosenMeanGuide)
    settings = {"mean.one_minus_cos": 2, "train_share": 0.25}
    expected = {"one_minus_cos": 2.0, "train_share": 0.25, "bsdf_share": 0.5}
    assert make_guide("mean", settings, seed=3).identity() == {"seed": 3} | expected
    assert make_guide("mean").identity() == {"seed": 0} | MEAN_PRESET["settings"]


@pytest.mark.parametrize(
    ("preset", "settings", "message"),
    [
        ("meen", {}, "here.preset: unknown preset 'meen'; did you mean 'mean'? allowed: mean"),
        ("x", {}, "here.preset: unknown preset 'x'; allowed: mean"),
        ("mean", {"share": 1}, "here.settings: unknown key 'share'; did you mean 'bsdf_share' or 'train_share'? valid"),
        ("mean", {"one_minus_cos": 3.0}, "here.settings.one_minus_cos: expected a number > 0 and <= 2; found 3.0"),
        (
            "mean",
            {"mean.one_minus_cos": 0},
            "here.settings.mean.one_minus_cos: expected a number > 0 and <= 2; found 0",
        ),
        ("mean", {"train_share": None}, "here.settings.train_share: expected a number >= 0 and <= 1; found null"),
        ("mean", {"train_share": {}}, "here.settings.train_share: expected a number >= 0 and <= 1; found an object"),
        ("mean", {"train_share": float("nan")}, "here.settings.train_share: expected a finite number; found nan"),
        ("mean", {"npm.train_share": 0.5}, "here.settings: 'npm.train_share' is no setting of mean; allowed: a name, "),
        (
            "mean",
            {"train_share": 0.5, "mean.train_share": 0.5},
            "here.settings.mean.train_share: is given twice, as 't",
        ),
    ],
)
def test_what_is_refused(mean, preset, settings, message):
    with pytest.raises(WavefrontError) as error:
        make_guide(preset, settings, where="here")
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


def scene_with(**choice) -> description.Scene:
    guide = description.GuideChoice(**choice) if choice else None
    return description.Scene(integrator=description.PathIntegrator(guide=guide))


def test_the_guide_of_a_scene(mean):
    assert guide_of(scene_with()) is plain_settings(scene_with()) is None
    # The shares have keys of their own, which win over settings of that name.
    settings = {"mean.train_share": 0.75, "bsdf_share": 0.125, "one_minus_cos": 0.5}
    scene = scene_with(preset="mean", train_share=0.0, settings=settings)
    expected = {"one_minus_cos": 0.5, "train_share": 0.0, "bsdf_share": 0.125}
    assert guide_of(scene, seed=9).identity() == {"seed": 9} | expected
    assert plain_settings(scene) == {"method": "mean", "settings": expected}
    with pytest.raises(SceneError, match=r"^integrator\.guide\.preset: unknown preset 'npm'"):
        guide_of(scene_with(preset="npm"))


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ({"preset": ""}, "integrator.guide.preset: expected a string that is not empty; found the string ''"),
        ({"preset": "a", "train_share": 1.5}, "integrator.guide.train_share: expected a number >= 0 and <= 1 or null"),
        ({"preset": "a", "bsdf_share": 0}, "integrator.guide.bsdf_share: expected a number > 0 and <= 1 or null"),
        ({"preset": "a", "settings": 3}, "integrator.guide.settings: expected an object; found 3"),
    ],
)
def test_a_scene_refuses_what_no_guide_can_have(choice, message):
    with pytest.raises(SceneError) as error:
        checked(scene_with(**choice))
    assert str(error.value).startswith(message)


def test_methods_are_imported_when_they_are_needed(tmp_path):
    """Nothing of guides and networks without one, and no method for the names of presets."""
    code = """
import sys
from wavefront.render import main
def imported(): return sorted(m for m in sys.modules if m.partition(".")[0] in ("guiding", "nn"))
scene, out = sys.argv[1:]
arguments = [scene, "--quiet", "--spp", "1", "--size", "4x4", "--threads", "1", "-o", out]
assert main(arguments) == 0
assert imported() == [], imported()
assert main([*arguments, "--guide", "no such preset"]) == 2
assert imported() == ["guiding", "guiding.registry"], imported()
"""
    command = [sys.executable, "-c", code, str(CORNELL_BOX), str(tmp_path / "o.exr")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
