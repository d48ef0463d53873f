"""The files of a render: header, window and precision of OUT.exr, the picture of a window, and a disk that is full."""

from __future__ import annotations

import json
import subprocess
import sys

import msgspec
import numpy as np
import OpenEXR
import pytest
from PIL import Image

import wavefront
from tests.test_aov import ALL, room
from wavefront import Renderer
from wavefront import film as film_module
from wavefront.identity import scene_hash
from wavefront.output import describe_render, write_outputs
from wavefront.render import main, parse_crop
from wavefront.scene import description as d
from wavefront.scene import json_format

CROP = d.Crop(x=13, y=7, width=11, height=17)
SEED = 2**63 + 5


def rendered(crop=None, aovs=ALL, **film):
    scene = room(aovs, crop)
    scene.film = msgspec.structs.replace(scene.film, **film)
    renderer = Renderer(scene, seed=SEED, threads=1)
    renderer.render(2)
    return renderer


def write(renderer, folder, exposure=0.0):
    write_outputs(folder / "out.exr", renderer, exposure, describe_render(renderer, "scene.json", 0.0))
    with OpenEXR.File(str(folder / "out.exr"), separate_channels=True) as file:
        return dict(file.header()), {name: np.array(channel.pixels) for name, channel in file.channels().items()}


@pytest.fixture(scope="module")
def renderer():
    return rendered(CROP, pixel_aspect=1.25)


def test_header_and_channels(renderer, tmp_path, monkeypatch):
    monkeypatch.setattr(film_module, "BLOCK_PIXELS", 50)  # blocks of four rows
    header, channels = write(renderer, tmp_path)
    low, high = (corner.tolist() for corner in header["dataWindow"])
    assert (low, high) == ([13, 7], [23, 23])
    low, high = (corner.tolist() for corner in header["displayWindow"])
    assert (low, high) == ([0, 0], [39, 29])
    assert header["pixelAspectRatio"] == 1.25
    assert header["samplesPerPixel"] == 2
    assert header["seed"] == str(SEED)
    assert header["sceneHash"] == scene_hash(renderer.scene_records)
    assert header["renderer"] == f"wavefront {wavefront.__version__}"
    assert "capDate" not in header
    expected = renderer.film.channels()
    assert set(channels) == set(expected)
    for name, values in expected.items():
        assert channels[name].dtype == np.float32
        np.testing.assert_array_equal(channels[name], values, err_msg=name)
    account = json.loads((tmp_path / "out.json").read_text())
    assert account["settings"]["film"]["crop"] == {"x": 13, "y": 7, "width": 11, "height": 17}
    assert account["bytes_per_pixel"] == renderer.bytes_per_pixel


def test_a_file_is_the_same_every_time(renderer, tmp_path):
    write(renderer, tmp_path)
    before = [(tmp_path / name).read_bytes() for name in ("out.exr", "out.png")]
    write(renderer, tmp_path)
    assert before == [(tmp_path / name).read_bytes() for name in ("out.exr", "out.png")]


def test_half_rounds_neither_indices_nor_counts(tmp_path):
    renderer = rendered(precision="half")
    renderer.film.sample_count = 4097
    renderer.film.arrays.shape_index.fill_(2)
    renderer.film.bsdf_of_shape = [0, 0, 70001]
    _, channels = write(renderer, tmp_path)
    kept = {"shape_index.I", "bsdf_index.I", "sample_count.I"}
    assert {name for name, values in channels.items() if values.dtype == np.float32} == kept
    assert all(values.dtype == np.float16 for name, values in channels.items() if name not in kept)
    assert (channels["sample_count.I"] == 4097).all() and (channels["bsdf_index.I"] == 70001).all()
    np.testing.assert_array_equal(channels["position.X"], renderer.film.channels()["position.X"].astype(np.float16))


def test_the_picture_shows_the_window(renderer, tmp_path, monkeypatch):
    write(renderer, tmp_path, exposure=8.0)
    whole = np.asarray(Image.open(tmp_path / "out.png"))
    linear = np.clip(renderer.film.image().astype(np.float64) * 256.0, 0.0, 1.0)
    assert whole.shape == (17, 11, 3) and linear.max() > 0.1
    expected = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055) * 255.0
    assert np.abs(whole - expected).max() <= 0.5 + 1e-6
    monkeypatch.setattr(film_module, "BLOCK_PIXELS", 30)
    write(renderer, tmp_path, exposure=8.0)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "out.png")), whole)


def test_crop_on_the_command_line(tmp_path, capsys):
    json_format.dump(room(["sample_count"]), tmp_path / "scene.json")
    arguments = [str(tmp_path / "scene.json"), "-o", str(tmp_path / "out.exr"), "--spp", "3", "--quiet", "--crop"]
    assert main([*arguments, "11x17+13+7"]) == 0
    assert main([*arguments, "11x17+30+7"]) == 2
    error = capsys.readouterr().err
    assert "film.crop: expected a window inside the film of 40x30 pixels; found 11x17 at (30, 7)" in error
    with OpenEXR.File(str(tmp_path / "out.exr"), separate_channels=True) as file:
        pixels = file.channels()["sample_count.I"].pixels
    assert pixels.shape == (17, 11) and (pixels == 3.0).all()


@pytest.mark.parametrize("text", ["11x17", "11x17+3", "+3+4", "ax7+1+1", "1x1+-1+0"])
def test_a_crop_that_is_none(text):
    with pytest.raises(Exception, match="is not a window; allowed: WIDTHxHEIGHT"):
        parse_crop(text)


FULL_DISK = """
import resource, signal, sys
import numpy as np
from wavefront.scene.images import write_exr, write_png
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
noise = np.random.default_rng(1).integers(0, 256, (200, 200, 3), np.uint8)
try:
    if sys.argv[1].endswith("png"):
        write_png(sys.argv[1], noise)
    else:
        write_exr(sys.argv[1], {"Y": np.random.default_rng(1).random((200, 200))})
except Exception as error:
    print(type(error).__name__, error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits of file size are POSIX")
@pytest.mark.parametrize("name", ["a.png", "a.exr"])
def test_a_disk_that_is_full_is_an_error_and_keeps_the_old_file(tmp_path, name):
    """A limit of the size of files stands for the disk."""
    path = tmp_path / name
    path.write_text("old")
    command = [sys.executable, "-c", FULL_DISK, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.stdout.startswith(f"WavefrontError {path}: cannot be written: "), done
    assert done.stdout.count("\n") == 1
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
