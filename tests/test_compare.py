"""The command that compares two images: reading files of any renderer, the bias test, outputs and errors."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import sys

import numpy as np
import OpenEXR
import pytest
from PIL import Image
from scipy import stats

from tools.bias_test import find_bias
from tools.compare import main
from tools.false_color import false_color
from tools.image_reader import LoadedImage, read_image
from tools.image_test import Comparison, Estimate, tile_means
from tools.metrics import METRICS, error_map, evaluate
from wavefront.errors import WavefrontError
from wavefront.film import LUMINANCE
from wavefront.scene.images import write_exr, write_exr_blocks, write_png

HEIGHT, WIDTH = 24, 40
HAS_FLIP = importlib.util.find_spec("flip_evaluator") is not None


def radiance(seed=0, shape=(HEIGHT, WIDTH)):
    return np.random.default_rng(seed).lognormal(-1.0, 1.0, (*shape, 3)).astype(np.float32)


def layers(pixels, names=("R", "G", "B"), **more):
    """Channels of an EXR file: colours, and others by name."""
    return {name: pixels[..., c] for c, name in enumerate(names)} | more


def save(path, *arguments, **more):
    write_exr(path, layers(*arguments, **more))
    return path


@pytest.fixture
def pair(tmp_path):
    """Two EXR files, of which the second is the reference."""
    a, b = radiance(0), radiance(1)
    return save(tmp_path / "a.exr", a), save(tmp_path / "b.exr", b), a, b


def command(capsys, *arguments):
    """Exit status, standard output and standard error."""
    status = main([str(a) for a in arguments])
    return status, *capsys.readouterr()


def error_of(capsys, *arguments):
    """The one line of an error."""
    status, out, err = command(capsys, *arguments)
    assert status == 2 and out == "" and err.startswith("error: ") and err.count("\n") == 1, (status, out, err)
    return err[len("error: ") : -1]


# --- the figures -------------------------------------------------------------------------------------------------


def test_all_metrics(pair, tmp_path, capsys):
    a, b, image, reference = pair
    status, out, _ = command(capsys, a, b, "--json", tmp_path / "out.json")
    figures = json.loads((tmp_path / "out.json").read_text())
    assert status == 0
    assert (figures["width"], figures["height"], figures["bias_test"]) == (WIDTH, HEIGHT, None)
    assert list(figures["metrics"]) == [name for name in METRICS if name != "flip" or HAS_FLIP]
    for name, value in figures["metrics"].items():
        assert value == evaluate(name, image, reference)
        assert METRICS[name].label in out and f"{value:.6g}" in out
    assert "neither file has variances" in out


def test_chosen_metrics(pair, tmp_path, capsys):
    a, b, image, reference = pair
    picture = tmp_path / "error.png"
    status, out, _ = command(capsys, a, b, "--metric", "smape", "mse", "--error-image", picture)
    assert status == 0 and "SMAPE" in out and "MSE" in out and "MAE" not in out
    errors = error_map("smape", image, reference)
    scale = np.percentile(errors, 99.0)
    assert f"{picture}: SMAPE of pixels, black 0, white {scale:.4g} and more" in out
    np.testing.assert_array_equal(np.asarray(Image.open(picture)), false_color(errors, scale))
    assert command(capsys, a, b, "--error-image", picture, "--error-scale", 0.5)[0] == 0
    np.testing.assert_array_equal(
        np.asarray(Image.open(picture)), false_color(error_map("relmse", image, reference), 0.5)
    )


@pytest.mark.skipif(not HAS_FLIP, reason="the package flip-evaluator is not installed")
def test_flip_of_files(tmp_path, capsys):
    """Pictures are compared as a display shows them, by what flip-evaluator makes of the files themselves."""
    import flip_evaluator

    rng = np.random.default_rng(3)
    a, b = (rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8) for _ in range(2))
    write_png(tmp_path / "a.png", a)
    write_png(tmp_path / "b.png", b)
    assert command(capsys, tmp_path / "a.png", tmp_path / "b.png", "--json", tmp_path / "out.json")[0] == 0
    figures = json.loads((tmp_path / "out.json").read_text())
    expected = flip_evaluator.evaluate(str(tmp_path / "b.png"), str(tmp_path / "a.png"), "LDR")[1]
    assert figures["display"] and figures["metrics"]["flip"] == pytest.approx(expected, rel=1e-5)
    assert "made for a display" in figures["notes"][0]
    radiances = [read_image(tmp_path / name).pixels for name in ("a.png", "b.png")]
    assert figures["metrics"]["mse"] == pytest.approx(np.mean((radiances[0] - radiances[1]) ** 2), rel=1e-12)


def test_without_optional_packages(pair, capsys, monkeypatch, tmp_path):
    a, b, *_ = pair
    noisy = save(tmp_path / "v.exr", radiance(), **{"variance.Y": np.ones((HEIGHT, WIDTH), np.float32)})
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    monkeypatch.setitem(sys.modules, "scipy", None)
    for name in ("tools.bias_test", "tools.image_test"):
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr("tools.bias_test", raising=False)
    status, out, _ = command(capsys, noisy, b)
    assert (
        status == 0 and "'.[flip]'" in out and "scipy is not installed; it comes with pip install '.[measure]'" in out
    )
    assert "flip-evaluator is not installed" in error_of(capsys, a, b, "--metric", "flip")
    assert "scipy is not installed" in error_of(capsys, noisy, b, "--bias-test")


# --- files of any renderer ---------------------------------------------------------------------------------------


def test_layers(tmp_path, capsys):
    image, normals = radiance(), radiance(5)
    more = {f"nn.{c}": normals[..., i] for i, c in enumerate("RGB")} | {"depth.Z": normals[..., 0]}
    plain = read_image(save(tmp_path / "plain.exr", image, **more, A=normals[..., 0]))
    np.testing.assert_array_equal(plain.pixels, image)
    blender = save(tmp_path / "blender.exr", image, [f"ViewLayer.Combined.{c}" for c in "RGB"], **more)
    np.testing.assert_array_equal(read_image(blender).pixels, image)
    np.testing.assert_array_equal(read_image(blender, "nn").pixels, normals)
    two = save(tmp_path / "two.exr", image, [f"first.{c}" for c in "RGB"], **more)
    assert error_of(capsys, two, blender) == f"{two}: it has layers first, nn; choose one with --layer"
    assert command(capsys, two, blender, "--layer", "first", "--reference-layer", "nn")[0] == 0
    message = f"{two}: has layers 'first', 'nn'; needed: a layer 'x'"
    assert error_of(capsys, two, blender, "--layer", "x") == message
    write_exr(tmp_path / "xy.exr", {"X": image[..., 0], "Q": image[..., 1]})
    assert error_of(capsys, tmp_path / "xy.exr", two) == f"{tmp_path}/xy.exr: has channels Q, X; needed: R, G, B"


def test_grey_and_half(tmp_path):
    image = radiance()
    write_exr(tmp_path / "grey.exr", {"Y": image[..., 0], "A": image[..., 1]}, half=True)
    grey = read_image(tmp_path / "grey.exr")
    assert grey.half and not grey.display
    np.testing.assert_array_equal(grey.pixels, np.repeat(image[..., :1].astype(np.float16), 3, axis=2))


def test_parts(tmp_path):
    image, other = radiance(), radiance(1)
    parts = [OpenEXR.Part({}, layers(np.ascontiguousarray(p)), name) for p, name in ((image, "one"), (other, "two"))]
    for part in parts:
        part.channels = {n: OpenEXR.Channel(n, np.ascontiguousarray(c.pixels)) for n, c in part.channels.items()}
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    np.testing.assert_array_equal(read_image(tmp_path / "parts.exr").pixels, image)
    np.testing.assert_array_equal(read_image(tmp_path / "parts.exr", "two").pixels, other)


def test_pictures_are_decoded(tmp_path):
    codes = np.arange(256, dtype=np.uint8).reshape(1, 256)
    write_png(tmp_path / "grey.png", codes)
    picture = read_image(tmp_path / "grey.png")
    c = codes / 255.0
    expected = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(picture.pixels, np.repeat(expected[:, :, None], 3, axis=2), rtol=1e-14)
    assert picture.display
    with pytest.raises(WavefrontError, match=r"grey\.png: has no layer 'x'; allowed: layers of OpenEXR files"):
        read_image(tmp_path / "grey.png", "x")


def test_names_of_variances(tmp_path):
    image, values = radiance(), radiance(7)
    ours = read_image(save(tmp_path / "y.exr", image, **{"variance.Y": values[..., 0]}))
    np.testing.assert_array_equal(ours.variance, values[..., :1].astype(np.float64))
    for name, power in (("variance", 1), ("se", 2)):
        more = {f"{name}.{c}": values[..., i] for i, c in enumerate("RGB")}
        found = read_image(save(tmp_path / f"{name}.exr", image, **more)).variance
        np.testing.assert_array_equal(found, values.astype(np.float64) ** power)
    pbrt = save(tmp_path / "pbrt.exr", image, **{f"Variance.{c}": values[..., 0] for c in "RGB"})
    assert read_image(pbrt).variance is None


def test_one_sample_has_no_variance(tmp_path, capsys):
    nan = np.full((HEIGHT, WIDTH), np.nan, np.float32)
    a = save(tmp_path / "a.exr", radiance(), **{"variance.Y": nan})
    status, out, _ = command(capsys, a, a)
    assert status == 0 and f"no bias test: {a}: variance.Y is NaN, as it is for one sample a pixel" in out
    assert "variance.Y is NaN" in error_of(capsys, a, a, "--bias-test")


# --- the bias test -----------------------------------------------------------------------------------------------


def loaded(pixels, variance=None, **more):
    return LoadedImage("image.exr", pixels, variance, **more)


def draw(rng, mean, variance, samples):
    """An image of normal samples: its pixels, and the estimates of their variances."""
    estimated = variance * rng.chisquare(samples - 1, variance.shape) / (samples - 1)
    return loaded(mean + np.sqrt(variance) * rng.standard_normal(mean.shape), estimated)


def scene(seed=11, spread=0.5):
    """Expected values and variances of pixels that differ."""
    rng = np.random.default_rng(seed)
    mean = 1.0 + rng.random((HEIGHT, WIDTH, 3))
    return mean, 1e-3 * rng.lognormal(0.0, spread, mean.shape)


@pytest.mark.parametrize("exact", [False, True])
def test_false_alarms(exact):
    """Of equal images, at most the stated share fails, and not much less: each bound is wrong with 1e-4."""
    rng, (mean, variance), rate, count = np.random.default_rng(12), scene(), 0.1, 1500
    reference = loaded(mean) if exact else None
    alarms = sum(
        find_bias(
            draw(rng, mean, variance, 64), reference or draw(rng, mean, 0.3 * variance, 64), 8, rate
        ).failing_tiles
        > 0
        for _ in range(count)
    )
    # Finite degrees of freedom cost some power: the tiles have some 50.
    assert stats.binom.ppf(1e-4, count, 0.6 * rate) <= alarms <= stats.binom.isf(1e-4, count, rate)


def test_p_values_are_uniform():
    """Of large tiles, whose variances are known: Kolmogorov and Smirnov, at 1e-3."""
    rng, (mean, variance) = np.random.default_rng(13), scene()
    p = [
        find_bias(draw(rng, mean, variance, 64), draw(rng, mean, variance, 64), 24).comparison.p_values.ravel()
        for _ in range(300)
    ]
    assert stats.kstest(np.concatenate(p), "uniform").pvalue > 1e-3


def test_fireflies_are_no_bias():
    """A path of probability 1e-4 and value 200: most tiles miss it and are too dark, but none may be sure of that."""
    rng, failing, count = np.random.default_rng(14), 0, 200
    for _ in range(count):
        images = []
        for _ in range(2):
            rare = rng.binomial(64, 1e-4, (HEIGHT, WIDTH, 3))
            pixels = 1.0 + 200.0 * rare / 64 + 0.01 * rng.standard_normal(rare.shape)
            images.append(loaded(pixels, 1e-4 + (200.0**2 * rare / 64 - (200.0 * rare / 64) ** 2) / 63))
        failing += find_bias(*images, 8, 0.01).failing_tiles > 0
    assert failing <= stats.binom.isf(1e-4, count, 0.01)


def test_planted_bias_is_found():
    """A difference of the size that is said to be found with 90 % is found so often, and where it is."""
    rng, (mean, variance), count = np.random.default_rng(15), scene(spread=0.1), 300
    detectable = find_bias(draw(rng, mean, variance, 64), loaded(mean), 8).comparison.detectable(0.9)
    biased, found = mean.copy(), 0
    biased[8:16, 24:32, 1] *= 1.0 + detectable
    for _ in range(count):
        image = dataclasses.replace(draw(rng, biased, variance, 64), origin=(100, 50))  # of a crop window
        failures = find_bias(image, loaded(mean), 8).failures()
        found += any((one["x"], one["y"], one["channel"]) == (124, 58, "G") for one in failures)
    # The tile is as good as the median one, up to a tenth: between 0.8 and 0.97 of power, each bound wrong with 1e-4.
    assert stats.binom.ppf(1e-4, count, 0.8) <= found <= stats.binom.isf(1e-4, count, 0.97)


def test_ratio_of_means():
    """The 95 % intervals cover the truth in 95 % of cases: 4 standard errors of that share."""
    rng, (mean, variance), count = np.random.default_rng(16), scene(), 1000
    # of luminance: the errors of three channels are added as if they were one, which makes their interval wider
    variance_of_luminance = (variance @ np.square(LUMINANCE))[..., None]
    covered = 0
    for _ in range(count):
        image = loaded(draw(rng, 1.25 * mean, variance, 64).pixels, variance_of_luminance)
        low, high = find_bias(image, loaded(mean)).ratio()[1]
        covered += low < 1.25 < high
    assert abs(covered / count - 0.95) < 4.0 * np.sqrt(0.95 * 0.05 / count)


def test_luminance_of_channels_that_err_together():
    """The bound of the variance is reached by noise that is the same in all channels."""
    rng = np.random.default_rng(17)
    variance = np.repeat(rng.random((HEIGHT, WIDTH, 1)), 3, axis=2)
    by_channel, by_luminance = loaded(radiance(), variance), loaded(radiance(), variance[..., :1])
    test = find_bias(by_channel, by_luminance, 8)
    assert test.channels == "Y"
    weights = sum(LUMINANCE)
    np.testing.assert_allclose(test.comparison.a.variance, weights**2 * test.comparison.b.variance, rtol=1e-12)


def test_black_images():
    """No light, no noise: nothing differs, and there is no ratio."""
    black = np.zeros((HEIGHT, WIDTH, 3))
    test = find_bias(loaded(black, black), loaded(black))
    assert test.failing_tiles == 0 and test.ratio() is None and test.figures()["ratio_of_means"] is None
    assert find_bias(loaded(black + 0.1, black), loaded(black)).failing_tiles == 2 * 2  # exact, and another image


def test_half_precision_is_no_bias():
    """Rounding to 16 bits moves all pixels of a flat tile to the same side."""
    flat = np.full((HEIGHT, WIDTH, 3), 1.0004)
    exact, rounded = loaded(flat, np.full_like(flat, 1e-12)), flat.astype(np.float16)
    assert find_bias(exact, loaded(rounded, half=True)).failing_tiles == 0
    assert find_bias(exact, loaded(rounded)).failing_tiles > 0


def test_uneven_tiles():
    """Every pixel counts once, in tiles of sizes that differ by one."""
    image, variance = radiance(shape=(23, 41)).astype(np.float64), radiance(1, (23, 41)).astype(np.float64)
    estimate = Estimate.from_variance(image, variance, (3, 5))
    rows, columns = np.array([0, 7, 15, 23]), np.array([0, 8, 16, 24, 32, 41])
    for i in range(3):
        for j in range(5):
            tile = np.s_[rows[i] : rows[i + 1], columns[j] : columns[j + 1]]
            v = variance[tile].reshape(-1, 3)
            np.testing.assert_allclose(estimate.tiles[i, j], image[tile].mean(axis=(0, 1)))
            np.testing.assert_allclose(estimate.variance[i, j], v.sum(axis=0) / len(v) ** 2)
            np.testing.assert_allclose(estimate.degrees[i, j], v.sum(axis=0) ** 2 / (v**2).sum(axis=0))
    np.testing.assert_allclose(estimate.means[:3], image.mean(axis=(0, 1)))
    np.testing.assert_allclose(estimate.errors[:3], np.sqrt(variance.sum(axis=(0, 1))) / (23 * 41))
    assert tile_means(image, (23, 41)) == pytest.approx(image)


def test_smallest_p_is_corrected():
    estimate = Estimate.from_batches(np.random.default_rng(18).normal(1.0, 0.1, (16, 2, 3, 3)))
    exact = Estimate.from_variance(np.ones((2, 3, 3)), np.zeros((2, 3, 3)), (2, 3))
    comparison = Comparison(estimate, exact, 0.0)
    t = (estimate.tiles - 1.0) / np.sqrt(estimate.variance)
    expected = 1.0 - (1.0 - 2.0 * stats.t.sf(np.abs(t), 15).min()) ** 18
    assert comparison.smallest_p == pytest.approx(expected, rel=1e-9)
    # a test at the level fails just where the corrected p is below the rate
    assert (comparison.p_values.min() < comparison.level(1.01 * expected)) is np.True_
    assert (comparison.p_values.min() < comparison.level(0.99 * expected)) is np.False_


def test_exit_status_and_report_of_a_bias(tmp_path, capsys):
    mean = np.ones((HEIGHT, WIDTH, 3), np.float32)
    variance = {"variance.Y": np.full((HEIGHT, WIDTH), 1e-4, np.float32)}
    biased = mean.copy()
    biased[:12, 20:] *= 1.05
    a, b = save(tmp_path / "a.exr", biased, **variance), save(tmp_path / "b.exr", mean)
    out = tmp_path / "out.json"
    arguments = ("--tile", 12, "--false-alarm-rate", 1e-3, "--metric", "mse", "--json", out)
    status, text, _ = command(capsys, a, b, "--bias-test", *arguments)
    assert status == 1
    assert "2 of 6 tiles differ (3x2, of 14x12 pixels or less; false alarm rate 0.001 in all)" in text
    assert f"{b} has no variances: it is taken as exact" in text and "(26, 0) to (39, 11)" in text and "+5.00 %" in text
    figures = json.loads(out.read_text())["bias_test"]
    assert figures["failing_tiles"] == len(figures["failures"]) == 2 and figures["taken_as_exact"] == [str(b)]
    first = figures["failures"][0]
    assert (first["x"], first["y"], first["width"], first["height"]) == (26, 0, 14, 12)
    assert first["standard_error"] == pytest.approx(0.01 / np.sqrt(12 * 14), rel=1e-5)
    expected = 1.0 + 0.05 * 12 * 20 / (HEIGHT * WIDTH)
    assert figures["ratio_of_means"] == pytest.approx(expected, rel=1e-6)
    assert command(capsys, a, b, *arguments)[0] == 0
    assert command(capsys, b, a, "--bias-test", *arguments)[0] == 1
    assert command(capsys, a, a, "--bias-test", *arguments)[0] == 0


# --- errors ------------------------------------------------------------------------------------------------------


def test_files_that_cannot_be_read(pair, tmp_path, capsys):
    a, *_ = pair
    assert error_of(capsys, a, tmp_path / "no.exr") == f"{tmp_path}/no.exr: file not found"
    assert error_of(capsys, tmp_path, a) == f"{tmp_path}: not a file"
    for name in ("text.exr", "text.png"):
        (tmp_path / name).write_text("no image")
        assert error_of(capsys, a, tmp_path / name).startswith(f"{tmp_path}/{name}: cannot be read: ")
    (tmp_path / "cut.exr").write_bytes(a.read_bytes()[:2000])
    assert error_of(capsys, a, tmp_path / "cut.exr").startswith(f"{tmp_path}/cut.exr: cannot be read: ")


def test_images_of_other_pixels(pair, tmp_path, capsys):
    a, *_ = pair
    small = save(tmp_path / "small.exr", radiance(0, (HEIGHT, 12)))
    expected = (
        f"{small}: has 12x24 pixels from (0, 0), but {a} has 40x24 pixels from (0, 0); allowed: images of the same"
    )
    assert error_of(capsys, small, a) == f"{expected} pixels"
    crop = tmp_path / "crop.exr"
    write_exr_blocks(crop, (3, 4, WIDTH, HEIGHT), (90, 90), dict.fromkeys("RGB", "float"), [layers(radiance())])
    assert "crop.exr: has 40x24 pixels from (3, 4), but" in error_of(capsys, crop, a)
    assert command(capsys, crop, crop)[0] == 0


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pixel_that_is_not_finite(pair, tmp_path, capsys, value):
    a, _, image, _ = pair
    image[5, 7, 2] = value
    bad = save(tmp_path / "bad.exr", image)
    expected = f"{bad}: pixel (7, 5), channel B: {value} (1 values are not finite); allowed: finite numbers"
    assert error_of(capsys, bad, a) == error_of(capsys, a, bad) == expected
    crop = tmp_path / "crop.exr"  # pixels are counted in the image, not in the window
    write_exr_blocks(crop, (30, 40, WIDTH, HEIGHT), (90, 90), dict.fromkeys("RGB", "float"), [layers(image)])
    assert error_of(capsys, a, crop).startswith(f"{crop}: pixel (37, 45), channel B: {value}")


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (np.nan, "nan (1 values are not finite); allowed: finite numbers"),
        (-0.5, "-0.5; allowed: 0 or more"),
    ],
)
def test_a_variance_that_is_none(pair, tmp_path, capsys, value, expected):
    a, _, image, _ = pair
    variance = np.ones((HEIGHT, WIDTH), np.float32)
    variance[2, 9] = value
    bad = save(tmp_path / "bad.exr", image, **{"variance.Y": variance})
    assert error_of(capsys, a, bad) == f"{bad}: pixel (9, 2), channel variance.Y: {expected}"


def test_options(pair, tmp_path, capsys):
    a, b, *_ = pair
    before = a.read_bytes()
    for arguments, expected in (
        (("--metric", "psnr"), "there is no metric 'psnr'; allowed: mse, mae,"),
        (("--tile", 0), "--tile 0; allowed: 1 or more"),
        (("--false-alarm-rate", 1), "--false-alarm-rate 1; allowed: between 0 and 1"),
        (("--error-scale", 1), "--error-scale says what is white in --error-image"),
        (("--error-image", tmp_path / "e.png", "--error-scale", "nan"), "--error-scale nan; allowed: above 0"),
        (("--error-image", tmp_path / "e.jpg"), f"{tmp_path}/e.jpg: the error image is a PNG"),
        (("--error-image", tmp_path / "no" / "e.png"), f"{tmp_path}/no/e.png: the folder"),
        (("--json", a), f"{a}: would be overwritten, but is one of the images"),
        (("--json", tmp_path), f"{tmp_path}: cannot be written: it is a folder"),
        (("--bias-test",), "no bias test: neither file has variances"),
        (("--layer", "x"), f"{a}: has layers ''; needed: a layer 'x'"),
    ):
        assert error_of(capsys, a, b, *arguments).startswith(expected)
    assert a.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "b.exr"]  # nothing half-written
