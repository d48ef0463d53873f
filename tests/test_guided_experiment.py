"""Experiments and references with guides: what identifies a guided run, and who ignores a guide."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from guiding import guide_of
from tests.guides import MEAN_PRESET, use_mean_preset
from tools import experiment, gallery, trade
from tools.experiment_spec import ReferenceSpec, plan, read_spec
from tools.methods import Mitsuba, Wavefront, load_job
from tools.peers.cycles_scene import check_scene
from tools.reference_render import WavefrontMaker
from tools.reference_store import target_records
from tools.results import load_results
from tools.sweep import make_plan
from wavefront import Renderer, load_scene
from wavefront.errors import WavefrontError
from wavefront.scene import json_format

CORNELL_BOX = Path(__file__).parent.parent / "scenes" / "cornell-box.json"
SMALL = ["film.width=12", "film.height=10", "film.filter.type=box", "integrator.max_depth=3"]
GUIDE = {"preset": "mean", "train_share": 0.25, "settings": {"mean.one_minus_cos": 0.5}}
GUIDED = f"integrator.guide={json.dumps(GUIDE)}"
RESOLVED = {"method": "mean", "settings": {"one_minus_cos": 0.5, "train_share": 0.25, "bsdf_share": 0.5}}
SPEC = {
    "scenes": [{"file": str(CORNELL_BOX)}],
    "overrides": SMALL,
    "methods": [{"name": "path tracing"}, {"name": "mean", "guide": GUIDE}],
    "budgets": [{"spp": 8}],
    "seeds": [1, 2],
    "metrics": ["relmse"],
    "reference": {"spp": 64},
    "images": "run",
}


@pytest.fixture
def presets(monkeypatch, tmp_path):
    folder = tmp_path / "presets"
    folder.mkdir()
    use_mean_preset(monkeypatch, folder)
    return folder


def write(folder: Path, **changes) -> Path:
    path = folder / "spec.json"
    path.write_text(json.dumps(SPEC | changes))
    return path


def command(spec: Path, folder: Path) -> int:
    return experiment.main([str(spec), "-o", str(folder), "--threads", "1"])


def test_a_method_with_a_guide(presets, tmp_path, capsys):
    spec, folder = write(tmp_path), tmp_path / "results"
    assert command(spec, folder) == 0
    results = load_results(folder)
    for record in results.records:
        if record.method == "mean":
            assert record.made["guide"] == RESOLVED
            scene = load_scene(CORNELL_BOX, [*SMALL, GUIDED])
            guide = guide_of(scene, record.renderer_seed)
            r = Renderer(scene, threads=1, seed=record.renderer_seed, guide=guide)
            # All samples at once: a guide that is given them a few at a time would learn in other passes.
            np.testing.assert_array_equal(results.image(record), r.render(8))
            assert record.account["guide"] == guide.statistics() != {"records": 0}
            assert [point.samples for point in record.points] == [8]
            assert 0.0 < record.seconds.training < record.seconds.render
        else:
            assert "guide" not in record.made and "guide" not in record.account
            assert len(record.points) == 4 and record.seconds.training == 0.0
    assert results.experiment.methods[1].overrides == [GUIDED]

    # The settings of the preset belong to the method, too.
    preset = json.loads(json.dumps(MEAN_PRESET))
    preset["settings"]["bsdf_share"] = 0.25
    (presets / "mean.json").write_text(json.dumps(preset))
    capsys.readouterr()
    assert command(spec, folder) == 2
    assert "other results of cornell-box, mean: guide.settings.bsdf_share is 0.25, but 0.5" in capsys.readouterr().err


def test_a_guide_with_a_budget_in_seconds(presets):
    """A share of the time is of all of it."""
    engine = Wavefront(load_job(CORNELL_BOX, [*SMALL, GUIDED], None, 1), 0)
    train, passes = engine.renderer.guide.train, []

    def noted(records):
        passes.append(engine.samples)
        train(records)

    engine.renderer.guide.train = noted
    engine.add(1 << 24, 1.0)
    assert passes == list(range(len(passes)))
    assert 0 < len(passes) < engine.samples < 1 << 24


@pytest.mark.parametrize(
    ("method", "message"),
    [
        ({"guide": {"preset": "npm"}}, "integrator.guide.preset: unknown preset 'npm'; allowed: mean"),
        ({"guide": {"preset": "mean", "settings": {"lobes": 1}}}, "integrator.guide.settings: unknown key 'lobes'"),
        ({"guide": {"preset": "mean", "train_share": 2}}, "methods[0].guide.train_share: expected a number >= 0 and"),
        ({"guide": "mean"}, "methods[0].guide: expected an object or null; found the string 'mean'"),
        (
            {"guide": {"preset": "mean"}, "renderer": "mitsuba"},
            "methods[0]: a guide for mitsuba; allowed: for wavefront",
        ),
        ({"overrides": [GUIDED], "renderer": "cycles"}, "methods[0]: a guide for cycles; allowed: for wavefront"),
    ],
)
def test_errors_of_the_spec(presets, tmp_path, capsys, method, message):
    path = write(tmp_path, methods=[{"name": "a"} | method])
    assert command(path, tmp_path / "results") == 2
    error = capsys.readouterr().err
    assert f"error: {path}: methods[0]" in error and message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "results").exists()


def test_the_guide_of_a_scene_is_not_part_of_its_image(presets, tmp_path):
    """Methods may turn it off; references and peers do without it."""
    scene = load_scene(CORNELL_BOX, [*SMALL, GUIDED])
    assert target_records(scene) == target_records(load_scene(CORNELL_BOX, SMALL))
    methods = [{"name": "guided"}, {"name": "plain", "overrides": ["integrator.guide=null"]}]
    path = write(tmp_path, overrides=[*SMALL, GUIDED], methods=methods)
    (planned,) = plan(read_spec(path), path)
    assert planned.jobs["guided"].scene.integrator.guide is not None
    assert planned.jobs["plain"].scene.integrator.guide is None
    assert planned.notes == {"guided": [], "plain": []}
    maker = WavefrontMaker(planned.reference_job, 0)
    assert maker.renderer.guide is None
    Mitsuba.check(planned.reference_job)
    scene.integrator.nee = True
    scene.film.width, scene.film.height = 64, 64
    check_scene(scene)
    json_format.dump(scene, tmp_path / "guided.json")
    assert np.asarray(gallery.tile(tmp_path / "guided.json", 1)).any()


def test_a_sweep_of_guides(presets):
    """Each number of samples has a run of its own, in which the guide learns in its share of them."""

    def planned(**knobs):
        reference = ReferenceSpec(error=0.5)
        return make_plan([CORNELL_BOX], knobs, (4, 8), (), 3, "relmse", reference, overrides=SMALL)

    found = planned(guide=(None, "mean"))
    assert found.own == {"guide": None} and found.values == {"guide": (None, "mean")}
    assert found.overrides({"guide": "mean"}) == ['integrator.guide={"preset": "mean"}']
    assert [budget.spp for budget in found.budgets] == [4, 8]
    with pytest.raises(WavefrontError, match=r"^--knob guide=npm: integrator\.guide\.preset: unknown preset 'npm'"):
        planned(guide=("npm",))
    arguments = trade.build_parser().parse_args([str(CORNELL_BOX)])
    assert "guide" not in trade.plan_of(arguments).values
