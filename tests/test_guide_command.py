"""The command with a guide: how it is asked for, what it leaves behind, and files of what it has learned."""

from __future__ import annotations

import io
import json
import os
import signal

import numpy as np
import OpenEXR
import pytest
import warp as wp
from rich.console import Console
from rich.progress import Progress

import wavefront
from guiding import make_guide, registry
from tests.guides import ChosenMeanGuide, use_mean_preset
from wavefront import Renderer, load_scene, render
from wavefront.checkpoint import write_checkpoint
from wavefront.errors import WavefrontError
from wavefront.guide_file import KIND, guide_identity, load_guide, save_guide
from wavefront.scene import description, json_format

SIZE, SPP = 12, 8
FOLDER = registry.FOLDER
SCENE = {
    "camera": {"type": "perspective", "fov": 60, "to_world": [{"translate": [0, 0, 3]}]},
    "film": {"width": SIZE, "height": SIZE},
    "integrator": {"type": "path", "max_depth": 4, "spp": SPP},
    "shapes": [
        {"type": "cube", "bsdf": {"type": "diffuse"}, "flip_normals": True, "to_world": [{"scale": 4}]},
        {"type": "sphere", "radius": 0.5, "center": [2, 2, 0], "emitter": {"type": "area", "radiance": 9}},
    ],
}
GUIDED = SCENE | {"integrator": SCENE["integrator"] | {"guide": {"preset": "mean", "settings": {"one_minus_cos": 0.5}}}}


@pytest.fixture(autouse=True)
def place(monkeypatch, tmp_path):
    """A folder with a scene that names no guide and one that does; presets are elsewhere."""
    presets, folder = tmp_path / "presets", tmp_path / "renders"
    presets.mkdir()
    folder.mkdir()
    use_mean_preset(monkeypatch, presets)
    monkeypatch.chdir(folder)
    for name, scene in (("plain", SCENE), ("guided", GUIDED)):
        (folder / f"{name}-scene.json").write_text(json.dumps(scene))


def run(capsys, scene, *arguments) -> tuple[int, str]:
    """Exit status and what was printed to the error stream."""
    try:
        status = render.main([f"{scene}-scene.json", "-o", "out.exr", "--threads", "1", *map(str, arguments)])
    except SystemExit as exit_:
        status = exit_.code
    return status, capsys.readouterr().err


def image() -> np.ndarray:
    with OpenEXR.File("out.exr", separate_channels=True) as file:
        return np.stack([np.array(file.channels()[name].pixels) for name in "RGB"], axis=-1)


def account() -> dict:
    with open("out.json", encoding="utf-8") as file:
        return json.load(file)


def renderer(seed=0, **settings) -> Renderer:
    scene = load_scene("plain-scene.json")
    return Renderer(scene, threads=1, seed=seed, guide=make_guide("mean", settings, seed=seed))


# --- how it is asked for ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scene", "arguments", "settings"),
    [
        ("plain", [], None),
        ("plain", ["--guide", "mean"], {}),
        ("guided", [], {"one_minus_cos": 0.5}),
        ("guided", ["--guide", "none"], None),
        ("guided", ["--guide", "mean"], {}),
        ("guided", ["--train-share", 0.25], {"one_minus_cos": 0.5, "train_share": 0.25}),
        (
            "guided",
            ["--guide-set", "mean.one_minus_cos=2", "--bsdf-share", 0.75],
            {"one_minus_cos": 2, "bsdf_share": 0.75},
        ),
        (
            "plain",
            ["--guide", "mean", "--guide-set", "one_minus_cos=1", "--guide-set", "one_minus_cos=2"],
            {"one_minus_cos": 2},
        ),
        ("guided", ["--set", "integrator.guide.train_share=0.125"], {"one_minus_cos": 0.5, "train_share": 0.125}),
    ],
)
def test_the_guide_that_is_asked_for_renders(capsys, scene, arguments, settings):
    """The image is that of the same guide in Python, and OUT.json says which it was."""
    status, error = run(capsys, scene, *arguments, "--seed", 4)
    assert status == 0, error
    found = account()
    if settings is None:
        expected = Renderer(load_scene("plain-scene.json"), threads=1, seed=4)
        assert "guide" not in found and "guide mean" not in error
        assert found["settings"]["integrator"]["guide"] is None
    else:
        expected = renderer(seed=4, **settings)
    np.testing.assert_array_equal(image(), expected.render(SPP))
    if settings is not None:
        statistics = expected.guide.statistics()
        assert statistics["records"] > 0
        assert found["guide"] == {"method": "mean", "settings": expected.guide.identity(), "statistics": statistics}
        assert found["settings"]["integrator"]["guide"]["preset"] == "mean"
        assert f"guide mean: records {statistics['records']:,}\n" in error
    assert found["scene_sha256"] == account_of_the_plain_scene(capsys)


def account_of_the_plain_scene(capsys) -> str:
    """A guide changes the noise of an image, and not what it is an image of."""
    assert run(capsys, "plain", "--spp", 1)[0] == 0
    return account()["scene_sha256"]


@pytest.mark.parametrize(
    ("scene", "arguments", "message"),
    [
        ("plain", ["--train-share", "0.5"], "--train-share is for a guide, and there is none; allowed"),
        ("plain", ["--bsdf-share", "0.5"], "--bsdf-share is for a guide"),
        ("plain", ["--guide-set", "a=1"], "--guide-set is for a guide"),
        ("plain", ["--load-guide", "a"], "--load-guide is for a guide"),
        ("guided", ["--guide", "none", "--save-guide", "a"], "--save-guide is for a guide"),
        (
            "plain",
            ["--guide", "npm"],
            "integrator.guide.preset: unknown preset 'npm'; allowed: mean (set by '--guide npm')",
        ),
        ("guided", ["--train-share", "1.5"], "--train-share 1.5; allowed: 0 to 1"),
        ("guided", ["--train-share", "nan"], "--train-share nan; allowed: 0 to 1"),
        ("guided", ["--bsdf-share", "0"], "--bsdf-share 0; allowed: more than 0, up to 1"),
        ("guided", ["--guide-set", "one_minus_cos"], "--guide-set 'one_minus_cos'; allowed: KEY=VALUE, such"),
        ("guided", ["--guide-set", "=3"], "--guide-set '=3'; allowed: KEY=VALUE"),
        (
            "guided",
            ["--guide-set", "one_minus_cos=3"],
            "expected a number > 0 and <= 2; found 3 (set by '--guide-set one_minus_cos=3')",
        ),
        ("guided", ["--guide-set", "one_minus_cos=NaN"], "expected a number > 0 and <= 2; found the string 'NaN'"),
        ("guided", ["--guide-set", "one_minus_cos=1e999"], "one_minus_cos: expected a finite number; found inf"),
        (
            "guided",
            ["--guide-set", "lobes=3"],
            "guided-scene.json: integrator.guide.settings: unknown key 'lobes'; valid",
        ),
        (
            "guided",
            ["--set", "integrator.guide.train_share=2"],
            "guide.train_share: expected a number >= 0 and <= 1 or null; found 2",
        ),
        ("guided", ["--strict"], "allowed: a guide (mean) or a strict render"),
        ("guided", ["--pixel", "1,1"], "a path of a render that a guide (mean) leads cannot be traced again"),
        ("guided", ["--load-guide", "a"], "a: there is no such guide file to load"),
        ("guided", ["--load-guide", "plain-scene.json"], "plain-scene.json: not a guide file, or a damaged one: "),
        ("guided", ["--save-guide", "out.json"], "out.json: the guide file would replace the image or a checkpoint"),
        ("guided", ["--save-guide", "c", "--checkpoint", "c"], "c: the guide file would replace"),
        ("guided", ["--save-guide", "guided-scene.json"], "guided-scene.json: would be overwritten, but"),
        ("guided", ["--save-guide", "missing/a"], "missing/a: the folder missing does not exist"),
    ],
)
def test_bad_arguments_are_one_line(capsys, scene, arguments, message):
    before = sorted(os.listdir())
    status, error = run(capsys, scene, "--quiet", *arguments)
    assert status == 2
    assert message in error and error.startswith("error: ")
    assert error.count("\n") == 1 and "Traceback" not in error
    assert sorted(os.listdir()) == before


def test_a_path_of_a_guided_scene_without_its_guide(capsys):
    assert run(capsys, "guided", "--guide", "none", "--pixel", "1,1", "--quiet") == (0, "")


def test_the_progress_line_shows_training(monkeypatch):
    """While it lasts, and not later."""
    shown = []

    class Spy(Progress):
        def update(self, task, **fields):
            shown.append((fields["completed"], fields["guide"]))
            super().update(task, **fields)
            self.refresh()

    monkeypatch.setattr(render, "Progress", Spy)
    r, text = renderer(train_share=0.375), io.StringIO()
    render.run_with_progress(r, Console(file=text, force_terminal=True, width=160), SPP, None)
    assert [samples for samples, words in shown if words] == [1, 2, 3]
    assert shown[2][1] == f"records so far {r.guide.statistics()['records']}"
    assert all(words in text.getvalue() for _, words in shown)


# --- files of guides -------------------------------------------------------------------------------------------------


def test_a_loaded_guide_is_used_from_the_first_pass(capsys):
    assert run(capsys, "guided", "--save-guide", "a.guide")[0] == 0
    expected = renderer(one_minus_cos=0.5, seed=1, train_share=0)
    load_guide(expected.guide, "a.guide")
    learned = expected.guide.statistics()["records"]
    assert learned > 0 and abs(np.linalg.norm(expected.guide.axis) - 1.0) < 1e-6

    use = ["--seed", 1, "--load-guide", "a.guide"]  # shares and seeds may be others
    assert run(capsys, "guided", *use, "--train-share", 0, "--bsdf-share", 0.5, "--save-guide", "b.guide")[0] == 0
    np.testing.assert_array_equal(image(), expected.render(SPP))
    assert (image() != renderer(one_minus_cos=0.5, seed=1, train_share=0).render(SPP)).any()
    assert account()["guide"]["statistics"]["records"] == learned
    same = renderer(one_minus_cos=0.5)
    load_guide(same.guide, "b.guide")
    np.testing.assert_array_equal(same.guide.sum.numpy(), expected.guide.sum.numpy())

    assert (
        run(capsys, "guided", *use, "--save-guide", "a.guide")[0] == 0
    )  # learns on; the file that was read is replaced
    more = account()["guide"]["statistics"]["records"]
    assert more > learned
    load_guide(same.guide, "a.guide")
    assert same.guide.statistics()["records"] == more


def test_networks_are_kept_whole(tmp_path, monkeypatch):
    """Parameters, averages, and the state of the optimiser: learning goes on as it would have."""
    small = {"n_lobes": 2, "n_levels": 2, "n_features": 1, "n_neurons": 16, "train_share": 1.0}
    monkeypatch.setattr(registry, "FOLDER", FOLDER)
    first, second = (
        Renderer(load_scene("plain-scene.json"), threads=1, guide=make_guide("npm-radiance", small, seed=seed))
        for seed in (1, 2)
    )
    first.render(3)
    save_guide(first.guide, tmp_path / "a.guide")
    load_guide(second.guide, tmp_path / "a.guide")
    save_guide(second.guide, tmp_path / "b.guide")
    first.render(2)
    second.film.sample_count = 3  # the same samples as the first one
    second.render(2)
    for name, array in first.guide.arrays().items():
        np.testing.assert_array_equal(second.guide.arrays()[name].numpy(), array.numpy(), err_msg=name)
    assert second.guide.statistics() == first.guide.statistics()
    load_guide(first.guide, tmp_path / "b.guide")
    assert first.guide.statistics()["training_passes"] == 3


def test_a_guide_file_is_an_npz(capsys):
    assert run(capsys, "guided", "--save-guide", "a.guide")[0] == 0
    with open("a.guide", "rb") as file, np.load(file, allow_pickle=False) as archive:
        assert set(archive) == {"about.json", "guide/sum"}
        about = json.loads(archive["about.json"])
        assert archive["guide/sum"].shape == (4,)
    assert about["kind"] == KIND
    assert about["identity"] == {
        "method": "mean",
        "settings": {"one_minus_cos": 0.5},
        "wavefront": wavefront.__version__,
    }
    assert about["statistics"] == account()["guide"]["statistics"]


def test_an_interrupted_render_saves_its_guide(capsys, monkeypatch):
    train = ChosenMeanGuide.train

    def interrupted(guide, records):
        train(guide, records)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(ChosenMeanGuide, "train", interrupted)
    status, error = run(capsys, "guided", "--save-guide", "a.guide")
    assert status == 130 and "1 samples per pixel" in error
    r = renderer(one_minus_cos=0.5)
    load_guide(r.guide, "a.guide")
    assert r.guide.statistics() == account()["guide"]["statistics"] != {"records": 0}


def test_a_guide_that_cannot_be_saved_costs_no_image(capsys, monkeypatch):
    def fail(path, about, sections, kind="checkpoint"):
        raise render.CheckpointError(f"{path}: cannot be written: No space left on device")

    monkeypatch.setattr("wavefront.guide_file.write_checkpoint", fail)
    status, error = run(capsys, "guided", "--save-guide", "a.guide", "--quiet")
    assert (status, error) == (2, "error: a.guide: cannot be written: No space left on device\n")
    np.testing.assert_array_equal(image(), renderer(one_minus_cos=0.5).render(SPP))


def test_what_is_no_file_of_this_guide_is_refused(tmp_path):
    r, path = renderer(one_minus_cos=0.5), tmp_path / "a.guide"
    r.render(2)
    save_guide(r.guide, path)
    whole = path.read_bytes()

    def refused(guide_of, message):
        before = guide_of.guide.sum.numpy().copy()
        with pytest.raises(WavefrontError) as error:
            load_guide(guide_of.guide, path)
        assert str(error.value).startswith(f"{path}: {message}")
        assert "\n" not in str(error.value)
        np.testing.assert_array_equal(guide_of.guide.sum.numpy(), before)

    other = renderer(one_minus_cos=0.25)
    refused(other, "is a guide file of another guide: settings.one_minus_cos is 0.25, but 0.5 in the guide file")
    other.guide.name = "npm"
    refused(other, 'is a guide file of another guide: method is "npm", but "mean" in the guide file; settings.one_')
    for damaged in (whole[:-40], whole[: len(whole) // 2], whole.replace(whole[150:154], b"\0\1\2\3"), b"", b"\0" * 99):
        path.write_bytes(damaged)
        refused(r, "not a guide file, or a damaged one: ")
    sums = {"sum": wp.zeros(5, dtype=wp.float64, device="cpu")}
    write_checkpoint(path, {"identity": guide_identity(r.guide)}, {"guide": sums}, KIND)
    refused(r, "not a guide file, or a damaged one: guide/sum.npy is float64 (5,)")
    r.save_checkpoint(path)
    refused(r, "is a checkpoint; allowed: a guide file")
    save_guide(r.guide, path)
    with pytest.raises(WavefrontError, match="is a guide file; allowed: a checkpoint"):
        renderer().load_checkpoint(path)
    path.unlink()
    refused(r, "cannot be read: No such file or directory")


# --- with checkpoints ------------------------------------------------------------------------------------------------


def test_a_checkpoint_has_the_guide_once(capsys):
    """A scene that names its guide and the same guide asked for are one render; another guide is another one."""
    assert run(capsys, "guided", "--spp", 4, "--checkpoint", "c", "--train-share", 1)[0] == 0
    asked = ["--guide", "mean", "--guide-set", "one_minus_cos=0.5", "--train-share", 1]
    assert run(capsys, "plain", "--spp", SPP, "--resume", "c", *asked)[0] == 0
    np.testing.assert_array_equal(image(), renderer(one_minus_cos=0.5, train_share=1).render(SPP))
    status, error = run(capsys, "guided", "--resume", "c", "--quiet")
    assert status == 2
    assert "guide.settings.train_share is 0.5, but 1.0 in the checkpoint" in error
    assert "integrator" not in error
    status, error = run(capsys, "plain", "--resume", "c", "--quiet")
    assert status == 2 and "is a checkpoint of another render: guide is null" in error


def test_loading_and_resuming(capsys):
    """A checkpoint has a guide of its own; the command that is repeated until a render is done may load one."""
    assert run(capsys, "guided", "--save-guide", "a.guide", "--checkpoint", "c")[0] == 0
    status, error = run(capsys, "guided", "--load-guide", "a.guide", "--resume", "c", "--quiet")
    assert (status, error) == (2, "error: --load-guide with --resume, and c holds a guide too; allowed: one of them\n")
    repeated = ["--seed", 1, "--train-share", 0, "--load-guide", "a.guide", "--checkpoint", "d", "--resume", "d"]
    for spp in (4, SPP):
        assert run(capsys, "guided", "--spp", spp, *repeated)[0] == 0
    expected = renderer(one_minus_cos=0.5, seed=1, train_share=0)
    load_guide(expected.guide, "a.guide")
    np.testing.assert_array_equal(image(), expected.render(SPP))


# --- in Python -------------------------------------------------------------------------------------------------------


def test_a_scene_that_names_a_guide_is_not_silently_unguided():
    scene = load_scene("guided-scene.json")
    with pytest.raises(WavefrontError, match=r"^integrator.guide names 'mean', .*guide=guiding.guide_of\(scene\), or"):
        Renderer(scene, threads=1)
    without = Renderer(scene, threads=1, guide=None)
    assert without.guide is None and not without.features.guided
    assert without.scene.integrator.guide is None and scene.integrator.guide is not None
    plain = Renderer(load_scene("plain-scene.json"), threads=1)
    np.testing.assert_array_equal(without.render(2), plain.render(2))
    assert without.scene_records == plain.scene_records == renderer().scene_records
    assert without.training is renderer().training is False


def test_a_scene_keeps_its_guide_when_it_is_written(tmp_path):
    choice = description.GuideChoice(preset="mean", train_share=0.5, settings={"one_minus_cos": 0.5, "a.b": [1, None]})
    scene = load_scene("guided-scene.json")
    scene.integrator.guide = choice
    json_format.dump(scene, tmp_path / "again.json")
    assert load_scene(tmp_path / "again.json").integrator.guide == choice
    scene.integrator.guide = None
    json_format.dump(scene, tmp_path / "again.json")
    assert "guide" not in (tmp_path / "again.json").read_text()
