"""The command: what it writes, what it refuses, and how it stops."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from wavefront import __version__
from wavefront.render import build_parser, main, parse_memory
from wavefront.scene.images import write_exr

SCENE = {
    "camera": {"type": "perspective", "fov": 40, "to_world": [{"translate": [0, 0, 4]}]},
    "film": {"width": 24, "height": 16},
    "integrator": {"type": "path", "max_depth": 4, "spp": 4},
    "shapes": [
        {
            "type": "cube",
            "bsdf": {"type": "diffuse", "reflectance": 0.5},
            "flip_normals": True,
            "to_world": [{"scale": 5}],
        },
        {
            "type": "rectangle",
            "emitter": {"type": "area", "radiance": 3},
            "to_world": [{"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0, 4, 0]}],
        },
    ],
}


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(SCENE))
    return path


def run(capsys, *arguments) -> tuple[int, str]:
    """Exit status and what was printed to the error stream."""
    try:
        status = main([str(argument) for argument in arguments])
    except SystemExit as exit_:
        status = exit_.code
    return status, capsys.readouterr().err


def read(path) -> dict[str, np.ndarray]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: np.array(channel.pixels) for name, channel in file.channels().items()}


def test_writes_image_picture_and_account(scene, tmp_path, capsys):
    out = tmp_path / "out.exr"
    status, _ = run(capsys, scene, "-o", out, "--aov", "albedo,normal,depth,variance", "--seed", 3)
    assert status == 0
    channels = read(out)
    assert set(channels) == {
        *"RGB",
        "albedo.R",
        "albedo.G",
        "albedo.B",
        "normal.X",
        "normal.Y",
        "normal.Z",
        "depth.Z",
        "variance.Y",
    }
    assert all(c.shape == (16, 24) and c.dtype == np.float32 and np.isfinite(c).all() for c in channels.values())
    # The camera looks along -Z at the wall z = -5 from z = 4: the depth in the middle is close to 9.
    assert channels["depth.Z"][8, 12] == pytest.approx(9.0, rel=0.01)
    assert channels["normal.Z"][8, 12] == pytest.approx(1.0)
    assert np.allclose(channels["albedo.G"], 0.5)
    assert np.asarray(Image.open(out.with_suffix(".png"))).shape == (16, 24, 3)
    account = json.loads(out.with_suffix(".json").read_text())
    assert account["samples_per_pixel"] == 4
    assert account["paths"] == 4 * 24 * 16
    assert account["settings"]["seed"] == 3
    assert account["settings"]["integrator"]["max_depth"] == 4
    assert account["seconds"]["compile"] >= 0 and account["seconds"]["render"] > 0
    assert account["nonfinite"] == {"emission": 0, "escaped": 0, "direct": 0, "scatter": 0, "accumulate": 0}
    assert account["peak_memory_bytes"] > 1 << 20
    assert len(account["scene_sha256"]) == 64


def test_the_header_says_how_the_image_was_made(scene, tmp_path, capsys):
    def header(name, *arguments):
        assert run(capsys, scene, "-o", tmp_path / name, "--size", "4x4", "--quiet", *arguments) == (0, "")
        with OpenEXR.File(str(tmp_path / name), header_only=True) as file:
            return dict(file.header())

    seed = 2**64 - 1
    one, two = header("a.exr", "--seed", seed, "--spp", 3), header("b.exr", "--spp", 2, "--half")
    assert (one["samplesPerPixel"], one["seed"], one["renderer"]) == (3, str(seed), f"wavefront {__version__}")
    assert (two["samplesPerPixel"], two["seed"]) == (2, "0")
    # Of one scene, whatever the number of samples and how they are written.
    assert one["sceneHash"] == two["sceneHash"] == json.loads((tmp_path / "a.json").read_text())["scene_sha256"]
    assert one["settings"] == two["settings"]
    assert json.loads(one["settings"])["integrator"]["max_depth"] == 4
    assert header("c.exr", "--spp", 2, "--max-depth", 3)["sceneHash"] != one["sceneHash"]


def test_command_line_overrides_the_scene(scene, tmp_path, capsys):
    out = tmp_path / "out.exr"
    arguments = ("--size", "8x6", "--spp", 2, "--max-depth", 3, "--no-nee", "--no-rr", "--half", "--threads", 1)
    arguments += ("--sampler", "sobol")
    assert run(capsys, scene, "-o", out, *arguments, "--set", "integrator.max_depth=2", "--quiet") == (0, "")
    account = json.loads(out.with_suffix(".json").read_text())
    integrator = account["settings"]["integrator"]
    assert (integrator["max_depth"], integrator["nee"], integrator["rr_depth"]) == (2, False, None)
    assert account["features"]["nee"] is False and account["features"]["roulette"] is False
    assert integrator["sampler"] == account["features"]["sampler"] == "sobol"
    assert account["settings"]["threads"] == 1
    channels = read(out)
    assert channels["R"].shape == (6, 8) and channels["R"].dtype == np.float16


def test_scene_hash_follows_the_scene_not_its_place(scene, tmp_path, capsys):
    def digest(name, *arguments):
        assert run(capsys, scene, "-o", tmp_path / name, "--spp", 1, "--size", "4x4", *arguments)[0] == 0
        return json.loads((tmp_path / name).with_suffix(".json").read_text())["scene_sha256"]

    assert digest("a.exr") == digest("b.exr", "--seed", 9)
    assert digest("a.exr") != digest("c.exr", "--set", "shapes[1].emitter.radiance=2.5")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--spp", "0"], "error: --spp 0; allowed: 1 or more"),
        (["--time", "0"], "error: --time 0; allowed: more than 0"),
        (["--device", "cuda:7"], "error: unknown device 'cuda:7'; available: cpu"),
        (["--threads", "0"], "error: 0 threads; allowed: 1 or more"),
        (
            ["--threads", "2", "--paths-in-flight", "2047"],
            "error: 2047 paths in flight on 2 threads; allowed: 2048 or more",
        ),
        (["--seed", "-1"], "error: seed -1 is out of range; allowed: 0 to 2^64 - 1"),
        (["--memory", "10K"], "error: a memory budget of 0 MiB is too small for 384 pixels"),
        (["-o", "missing/out.exr"], "error: missing/out.exr: the folder missing does not exist"),
        (["-o", "out.png"], "error: out.png: the output is an OpenEXR file; allowed: a name that ends in .exr"),
        (["--set", "integrator.max_dept=3"], "integrator: unknown key 'max_dept'"),
        (["--max-depth", "0"], "integrator.max_depth"),
        (["--aov", "albdo"], "film.aovs[0]"),
        (["--define", "x"], "error: --define 'x'; allowed: NAME=VALUE"),
    ],
)
def test_bad_arguments_are_one_line(scene, tmp_path, capsys, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    before = sorted(os.listdir(tmp_path))
    output = () if "-o" in arguments else ("-o", "out.exr")
    status, error = run(capsys, scene, "--quiet", *output, *arguments)
    assert status == 2
    assert message in error
    assert error.count("\n") == 1 and "Traceback" not in error
    assert sorted(os.listdir(tmp_path)) == before


def test_missing_scene_is_one_line(tmp_path, capsys):
    status, error = run(capsys, tmp_path / "none.json", "-o", tmp_path / "o.exr", "--quiet")
    assert (status, error) == (2, f"error: {tmp_path / 'none.json'}: file not found\n")


def test_unwritable_output_is_refused_before_rendering(scene, tmp_path, capsys):
    (tmp_path / "out.json").mkdir()
    status, error = run(capsys, scene, "-o", tmp_path / "out.exr", "--quiet", "--spp", 10**9)
    assert (status, error) == (2, f"error: {tmp_path / 'out.json'}: cannot be written: it is a folder\n")


def test_the_scene_is_never_overwritten(scene, tmp_path, capsys, monkeypatch):
    """The account of a render has the scene's name by default: beside the scene that would replace it."""
    monkeypatch.chdir(tmp_path)
    before = scene.read_text()
    status, error = run(capsys, "scene.json", "--quiet")
    assert status == 2
    assert (
        error == "error: scene.json: would be overwritten, but the scene is read from it; choose another name with -o\n"
    )
    Image.new("RGB", (2, 2)).save(tmp_path / "out.png")
    texture = ("--set", 'shapes[0].bsdf.reflectance={"type": "bitmap", "file": "out.png"}')
    status, error = run(capsys, "scene.json", "-o", "out.exr", "--quiet", *texture)
    assert status == 2
    assert "out.png: would be overwritten" in error
    assert scene.read_text() == before


def test_half_overflow_is_an_error_and_loses_nothing(scene, tmp_path, capsys):
    out = tmp_path / "out.exr"
    status, error = run(
        capsys, scene, "-o", out, "--half", "--spp", 1, "--set", "shapes[1].emitter.radiance=1e7", "--quiet"
    )
    assert status == 2
    assert "half precision ends at 65504; nothing is lost" in error
    assert error.count("\n") == 1
    assert read(out)["R"].dtype == np.float32 and read(out)["R"].max() > 65504.0


def test_no_emitter_is_a_warning(scene, tmp_path, capsys):
    black = dict(SCENE, shapes=SCENE["shapes"][:1])
    scene.write_text(json.dumps(black))
    status, error = run(capsys, scene, "-o", tmp_path / "out.exr", "--spp", 1)
    assert status == 0
    assert "warning: " in error and "emitter" in error
    assert read(tmp_path / "out.exr")["G"].max() == 0.0


def test_schema_is_json(capsys):
    assert main(["--schema"]) == 0
    schema = json.loads(capsys.readouterr().out)
    assert "$schema" in schema


def test_time_budget(scene, tmp_path, capsys):
    out = tmp_path / "out.exr"
    assert run(capsys, scene, "-o", out, "--time", "0.5", "--quiet")[0] == 0
    account = json.loads(out.with_suffix(".json").read_text())
    # A pass may end late, but never starts late.
    assert 0.5 <= account["seconds"]["render"] < 10.0
    assert account["samples_per_pixel"] > 1


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
def test_interrupt_saves_what_there_is(scene, tmp_path):
    out = tmp_path / "out.exr"
    command = [sys.executable, "-m", "wavefront.render", str(scene), "-o", str(out), "--time", "120"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        # The scene is small, so a second after the start some samples are there.
        while "rendering" not in (line := process.stderr.readline()) and line:
            pass
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130, error
    account = json.loads(out.with_suffix(".json").read_text())
    assert f"{account['samples_per_pixel']} samples per pixel" in error.replace("\n", " ")
    assert "interrupted" in error
    assert read(out)["R"].mean() > 0.0
    assert account["seconds"]["render"] < 60.0


@pytest.mark.parametrize(("text", "value"), [("512M", 512 << 20), ("2G", 2 << 30), ("1.5k", 1536), ("4096", 4096)])
def test_parse_memory(text, value):
    assert parse_memory(text) == value


def test_png_is_srgb_of_the_image(scene, tmp_path, capsys):
    out = tmp_path / "out.exr"
    assert run(capsys, scene, "-o", out, "--spp", 1, "--exposure", "-1", "--quiet")[0] == 0
    linear = np.stack([read(out)[c] for c in "RGB"], axis=-1).astype(np.float64) / 2.0
    linear = np.clip(linear, 0.0, 1.0)
    expected = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055) * 255.0
    assert np.abs(np.asarray(Image.open(out.with_suffix(".png"))) - expected).max() <= 0.5 + 1e-6


def test_help_names_every_option_of_the_readme(capsys):
    text = build_parser().format_help()
    for option in (
        "--spp",
        "--time",
        "--size",
        "--max-depth",
        "--no-nee",
        "--no-rr",
        "--device",
        "--threads",
        "--seed",
    ):
        assert option in text


def test_write_exr_leaves_nothing_behind_after_an_error(tmp_path):
    target = tmp_path / "folder.exr"
    target.mkdir()
    with pytest.raises(Exception, match="cannot be written"):
        write_exr(target, {"R": np.zeros((2, 2), np.float32)})
    assert os.listdir(tmp_path) == ["folder.exr"]
