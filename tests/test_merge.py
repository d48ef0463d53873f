"""Combined renders are the image of the joint sample."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from tests.guides import MeanGuide, RampGuide
from tools.merge import combine, main
from wavefront import Renderer, load_scene
from wavefront.film import LUMINANCE
from wavefront.output import describe_render, image_attributes, write_outputs
from wavefront.scene.images import write_exr

CORNELL_BOX = Path(__file__).parent.parent / "scenes" / "cornell-box.json"
AOVS = ["albedo", "normal", "depth", "variance"]
COUNTS = {11: 3, 12: 1, 13: 8}  # samples by seed


def load(*overrides):
    return load_scene(CORNELL_BOX, ["film.width=31", "film.height=23", f"film.aovs={json.dumps(AOVS)}", *overrides])


@pytest.fixture(scope="module")
def renders(tmp_path_factory):
    """Images of three seeds, and the sums of their films in float64."""
    folder = tmp_path_factory.mktemp("merge")
    films = []
    for seed, spp in COUNTS.items():
        r = Renderer(load(), seed=seed, threads=1)
        r.render(spp)
        write_outputs(folder / f"{seed}.exr", r, 0.0, describe_render(r, str(CORNELL_BOX), 0.0))
        films.append(r.film)
    return folder, films


def read(path) -> tuple[dict[str, np.ndarray], dict]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: np.array(c.pixels) for name, c in file.channels().items()}, dict(file.header())


def paths(folder, *seeds):
    return [str(folder / f"{seed}.exr") for seed in seeds or COUNTS]


def merged(out, *images):
    assert main([*map(str, images), "-o", str(out)]) == 0
    return read(out)


def assert_joint(channels, films, roundings=2):
    """Equal to the joint sample in float64, but for rounding: of the images to float32, and of each merge."""
    counts = np.array([film.sample_count for film in films], float)
    n = counts.sum()
    epsilon = roundings * 2.0**-24
    layers = {"L": "R G B", "albedo": "albedo.R albedo.G albedo.B", "normal": "normal.X normal.Y normal.Z"}
    for name, names in (layers | {"depth": "depth.Z"}).items():
        sums = [getattr(film.arrays, name).numpy().reshape(31 * 23, -1) for film in films]
        found = np.stack([channels[channel].ravel() for channel in names.split()], axis=1)
        assert (np.abs(found - sum(sums) / n) <= epsilon * sum(map(np.abs, sums)) / n).all(), name
    totals = np.stack([film.arrays.L.numpy() @ np.asarray(LUMINANCE) for film in films])
    squares = sum(film.arrays.luminance_squared.numpy() for film in films)
    mean, means = totals.sum(axis=0) / n, totals / counts[:, None]
    variance = (squares / n - mean**2) / (n - 1)
    # What a rounding of the means does to the squares of their differences.
    off = epsilon * (means + mean)
    slack = (counts[:, None] * (2.0 * np.abs(means - mean) * off + off**2)).sum(axis=0) / (n * (n - 1))
    # The film squares luminances in float32, whose few roundings an image of one sample does not know.
    slack += 8.0 * 2.0**-24 * squares / (n * (n - 1))
    error = np.abs(channels["variance.Y"].ravel() - variance)
    assert (error <= epsilon * np.abs(variance) + slack).all()
    assert (variance > 0.0).mean() > 0.5


def test_the_joint_sample(renders, tmp_path):
    folder, films = renders
    channels, header = merged(tmp_path / "out.exr", *paths(folder))
    assert_joint(channels, films)
    _, first = read(folder / "11.exr")
    assert (header["samplesPerPixel"], header["seed"]) == (12, "11,12,13")
    assert {k: header[k] for k in ("sceneHash", "settings", "renderer")} == {
        k: first[k] for k in ("sceneHash", "settings", "renderer")
    }
    assert set(channels) == set(read(folder / "11.exr")[0])
    assert os.listdir(tmp_path) == ["out.exr"]


def test_images_of_one_sample(renders, tmp_path):
    """Their own variance is not a number; that of two is what lies between them."""
    folder, films = renders
    single = Renderer(load(), threads=1)
    single.render(1)
    write_exr(tmp_path / "0.exr", single.film.channels(), attributes=image_attributes(single))
    channels, _ = merged(tmp_path / "out.exr", tmp_path / "0.exr", folder / "12.exr")
    assert_joint(channels, [single.film, films[1]])


def test_seeds_of_a_sequence_are_independent(renders, tmp_path, capsys):
    """Renders by the Sobol sampler are combined like others, but not with others."""
    films, files = [], []
    for seed in (21, 22):
        r = Renderer(load("integrator.sampler=sobol"), seed=seed, threads=1)
        r.render(4)
        files.append(tmp_path / f"{seed}.exr")
        write_exr(files[-1], r.film.channels(), attributes=image_attributes(r))
        films.append(r.film)
    channels, _ = merged(tmp_path / "out.exr", *files)
    assert_joint(channels, films)
    capsys.readouterr()
    text = refused(capsys, tmp_path, files[0], *paths(renders[0], 11), "-o", tmp_path / "none.exr")
    assert f'integrator.sampler is null, but "sobol" in {files[0]}' in text
    assert "the same samples twice" in refused(capsys, tmp_path, files[0], files[0], "-o", tmp_path / "none.exr")


def test_merges_of_merges(renders, tmp_path):
    folder, films = renders
    merged(tmp_path / "pair.exr", *paths(folder, 11, 13))
    channels, header = merged(tmp_path / "all.exr", tmp_path / "pair.exr", *paths(folder, 12))
    assert_joint(channels, films, roundings=3)
    assert (header["samplesPerPixel"], header["seed"]) == (12, "11,13,12")


def test_samples_with_weights(tmp_path, capsys):
    """Radiance by the sums of weights, all else by the number of samples, the variance of independent images."""
    films, files = [], []
    for seed, spp, guide in ((1, 4, RampGuide), (2, 7, RampGuide), (3, 2, MeanGuide)):
        r = Renderer(load(), seed=seed, threads=1, guide=guide())
        r.render(spp)
        films.append(r.film)
        files.append(tmp_path / f"{seed}.exr")
        write_exr(files[-1], r.film.channels(), attributes=image_attributes(r))
    weights = [film.weight_sums[0] for film in films]
    assert weights[2] == 2.0 and weights[0] < 3.0
    channels, header = merged(tmp_path / "out.exr", *files)
    assert float(header["sumOfWeights"]) == sum(weights) and header["samplesPerPixel"] == 13
    L = sum(film.arrays.L.numpy() for film in films) / sum(weights)
    np.testing.assert_allclose(np.stack([channels[c].ravel() for c in "RGB"], axis=1), L, rtol=3e-7)
    depth = sum(film.arrays.depth.numpy() for film in films) / 13
    np.testing.assert_allclose(channels["depth.Z"].ravel(), depth, rtol=3e-7)
    squares = sum((w * w * film.variance().astype(np.float64)) for w, film in zip(weights, films, strict=True))
    np.testing.assert_allclose(channels["variance.Y"], squares / sum(weights) ** 2, rtol=3e-7)
    assert (channels["variance.Y"] > 0.0).mean() > 0.5

    merged(tmp_path / "pair.exr", *files[::2])
    again, _ = merged(tmp_path / "again.exr", tmp_path / "pair.exr", files[1])
    assert again.keys() == channels.keys()
    for name in again:
        np.testing.assert_allclose(again[name], channels[name], rtol=1e-6, atol=1e-7, err_msg=name)
    capsys.readouterr()
    for text, message in (("x", "header is damaged"), ("4.5", "a sum of weights of 4.5; allowed"), ("nan", "of nan")):
        write_exr(tmp_path / "bad.exr", channels, attributes=image_attributes(r) | {"sumOfWeights": text})
        assert message in refused(capsys, tmp_path, files[0], tmp_path / "bad.exr", "-o", tmp_path / "none.exr")


def test_rows_in_blocks(renders, tmp_path, monkeypatch):
    folder, _ = renders
    whole, _ = merged(tmp_path / "whole.exr", *paths(folder))
    monkeypatch.setattr("tools.merge.BLOCK_VALUES", 1)
    blocks, _ = merged(tmp_path / "blocks.exr", *paths(folder))
    assert whole.keys() == blocks.keys()
    for name in whole:
        np.testing.assert_array_equal(whole[name], blocks[name])


def test_indices_and_counts_are_no_means():
    names = ["R", "bsdfIndex", "shape_index.I", "sampleCount"]
    a, b = np.array([[1.0, 3.0, 7.0, 3.0]], np.float32), np.array([[4.0, 5.0, 9.0, 1.0]], np.float32)
    assert combine([a, b], [3, 1], names).tolist() == [[1.75, 3.0, 7.0, 4.0]]


def refused(capsys, tmp_path, *arguments) -> str:
    before = sorted(os.listdir(tmp_path))
    assert main([str(a) for a in arguments]) == 2
    text = capsys.readouterr().err
    assert text.startswith("error: ") and text.count("\n") == 1
    assert sorted(os.listdir(tmp_path)) == before
    return text


def test_what_does_not_fit_is_refused(renders, tmp_path, capsys):
    folder, _ = renders
    a, b = paths(folder, 11, 13)
    out = ("-o", tmp_path / "out.exr")

    def other(name, *overrides, channels=None, **attributes):
        scene = load_scene(
            CORNELL_BOX, ["film.width=31", "film.height=23", f"film.aovs={json.dumps(AOVS)}", *overrides]
        )
        r = Renderer(scene, seed=99, threads=1)
        r.render(1)
        data = {k: v for k, v in r.film.channels().items() if channels is None or k in channels}
        kept = {k: v for k, v in (image_attributes(r) | attributes).items() if v is not None}
        write_exr(tmp_path / f"{name}.exr", data, attributes=kept)
        return tmp_path / f"{name}.exr"

    assert f"{a}: has seed 11, as {a} has: the same samples twice" in refused(capsys, tmp_path, a, a, *out)
    text = refused(capsys, tmp_path, a, b, other("seeds", seed="5,13"), *out)
    assert f"seeds.exr: has seed 13, as {b} has" in text
    text = refused(capsys, tmp_path, a, other("depth", "integrator.max_depth=3"), *out)
    assert f"depth.exr: integrator.max_depth is 3, but 8 in {a}" in text
    assert "film.width is 30, but 31" in refused(capsys, tmp_path, a, other("size", "film.width=30"), *out)
    text = refused(capsys, tmp_path, a, other("scene", "camera.fov=33"), *out)
    assert f"scene.exr: is of another scene than {a}" in text
    text = refused(capsys, tmp_path, a, other("channels", channels="RGB"), *out)
    assert "channels.exr: has other channels than" in text and "variance.Y" in text
    text = refused(capsys, tmp_path, a, other("header", samplesPerPixel=None), *out)
    assert "header.exr: its header has no 'samplesPerPixel'; allowed: images of wavefront.render" in text
    assert "header is damaged" in refused(capsys, tmp_path, a, other("seed", seed="x"), *out)
    assert "file not found" in refused(capsys, tmp_path, a, tmp_path / "none.exr", *out)
    (tmp_path / "text.exr").write_text("no image\n")
    assert "text.exr: cannot be read" in refused(capsys, tmp_path, a, tmp_path / "text.exr", *out)
    cut = tmp_path / "cut.exr"
    cut.write_bytes(Path(b).read_bytes()[:-2000])
    assert "cut.exr: cannot be read" in refused(capsys, tmp_path, a, cut, *out)
    assert "two or more" in refused(capsys, tmp_path, a, *out)
    assert "would be overwritten" in refused(capsys, tmp_path, a, b, "-o", b)
    assert "ends in .exr" in refused(capsys, tmp_path, a, b, "-o", tmp_path / "out.png")
    assert "does not exist" in refused(capsys, tmp_path, a, b, "-o", tmp_path / "none" / "out.exr")
