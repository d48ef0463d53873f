"""Error metrics: closed forms, loops in plain Python, another implementation of FLIP, and invariances."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

from tools.false_color import TABLE, false_color
from tools.metrics import METRICS, error_map, evaluate
from wavefront.errors import WavefrontError

POINTWISE = [name for name in METRICS if name != "flip"]
# One pixel, by hand: I = (1, 0, 2), R = (0.5, 0, 3), d = (0.5, 0, -1).
BY_HAND = {
    "mse": (0.25 + 0 + 1) / 3,
    "mae": (0.5 + 0 + 1) / 3,
    "relmse": (0.25 / 0.26 + 0 + 1 / 9.01) / 3,
    "trimmed-relmse": (0.25 / 0.26 + 0 + 1 / 9.01) / 3,
    "mrse": (0.25 / 0.2501 + 0 + 1 / 9.0001) / 3,
    "mape": (0.5 / 0.51 + 0 + 1 / 3.01) / 3,
    "smape": (1 / 1.52 + 0 + 2 / 5.02) / 3,
}


def images(seed=0, height=37, width=53, low=0.0):
    """Radiance of a wide range, some of it black, and an estimate of it."""
    rng = np.random.default_rng(seed)
    reference = np.where(rng.random((height, width, 3)) < 0.1, low, rng.lognormal(-1.0, 1.5, (height, width, 3)) + low)
    return reference * rng.gamma(4.0, 0.25, reference.shape), reference


def needs_flip():
    return pytest.importorskip("flip_evaluator", reason="the package flip-evaluator is not installed")


@pytest.mark.parametrize("name", POINTWISE)
def test_by_hand(name):
    image, reference = np.array([[[1.0, 0.0, 2.0]]]), np.array([[[0.5, 0.0, 3.0]]])
    assert evaluate(name, image, reference) == pytest.approx(BY_HAND[name], rel=1e-14)
    assert error_map(name, image, reference) == pytest.approx(np.array([[BY_HAND[name]]]), rel=1e-14)


def in_plain_python(name, image, reference):
    """The definitions again, over lists and with exact sums."""
    pixels = []
    for i_pixel, r_pixel in zip(image.reshape(-1, 3).tolist(), reference.reshape(-1, 3).tolist(), strict=True):
        terms = []
        for i, r in zip(i_pixel, r_pixel, strict=True):
            d = i - r
            terms.append(
                {
                    "mse": d * d,
                    "mae": abs(d),
                    "relmse": d * d / (r * r + 0.01),
                    "trimmed-relmse": d * d / (r * r + 0.01),
                    "mrse": d * d / (r * r + 0.0001),
                    "mape": abs(d) / (abs(r) + 0.01),
                    "smape": 2.0 * abs(d) / (abs(i) + abs(r) + 0.02),
                }[name]
            )
        pixels.append(math.fsum(terms) / 3.0)
    if name == "trimmed-relmse":
        pixels = sorted(pixels)[: len(pixels) - len(pixels) // 1000]
    return math.fsum(pixels) / len(pixels)


@pytest.mark.parametrize("name", POINTWISE)
def test_definition(name):
    image, reference = images()
    image[3, 4] = -image[3, 4]  # a filter with negative lobes
    assert evaluate(name, image, reference) == pytest.approx(in_plain_python(name, image, reference), rel=1e-12)
    # what files hold
    single = [pixels.astype(np.float32) for pixels in (image, reference)]
    assert evaluate(name, *single) == pytest.approx(in_plain_python(name, *single), rel=1e-12)


@pytest.mark.parametrize(("height", "width", "dropped"), [(1, 999, 0), (1, 1000, 1), (40, 50, 2), (71, 42, 2)])
def test_trimmed_drops_one_pixel_of_a_thousand(height, width, dropped):
    reference = np.ones((height, width, 3))
    image = reference.copy()
    order = np.random.default_rng(1).permutation(height * width)
    image.reshape(-1, 3)[order[:dropped]] += 1e3  # fireflies, all of them dropped
    assert evaluate("trimmed-relmse", image, reference) == 0.0
    image.reshape(-1, 3)[order[dropped], 1] += 0.5  # the next one counts, over the pixels that are left
    expected = 0.25 / 1.01 / 3.0 / (height * width - dropped)
    assert evaluate("trimmed-relmse", image, reference) == pytest.approx(expected, rel=1e-12)
    assert error_map("trimmed-relmse", image, reference).max() == pytest.approx(1e6 / 1.01 if dropped else 0.25 / 3.03)


@pytest.mark.parametrize("name", METRICS)
def test_no_error(name):
    if name == "flip":
        needs_flip()
    _, reference = images()
    assert evaluate(name, reference, reference) == 0.0


@pytest.mark.parametrize("name", POINTWISE)
def test_permutation_of_pixels(name):
    image, reference = images()
    order = np.random.default_rng(2).permutation(image.shape[0] * image.shape[1])
    permuted = [pixels.reshape(-1, 3)[order].reshape(pixels.shape) for pixels in (image, reference)]
    assert evaluate(name, *permuted) == pytest.approx(evaluate(name, image, reference), rel=1e-12)


def test_flip_is_no_mean_over_pixels():
    """So that the test above says something: FLIP sees neighbourhoods."""
    needs_flip()
    image, reference = images()
    permuted = [pixels[:, np.random.default_rng(2).permutation(53)] for pixels in (image, reference)]
    assert evaluate("flip", *permuted) != pytest.approx(evaluate("flip", image, reference), rel=1e-3)


@pytest.mark.parametrize(
    ("name", "low", "bound"),
    # Doubling the exposure changes a term by the factor 1 + e / (R^2 + e) or so at most; R is at least `low`.
    [("relmse", 10.0, 0.01 / 100), ("mrse", 1.0, 1e-4), ("mape", 10.0, 1e-3), ("smape", 10.0, 2e-3)],
)
def test_exposure(name, low, bound):
    image, reference = images(low=low)
    once, twice = evaluate(name, image, reference), evaluate(name, 2.0 * image, 2.0 * reference)
    assert once < twice < once * (1.0 + bound)


@pytest.mark.parametrize(("name", "power"), [("mse", 2), ("mae", 1)])
def test_absolute_errors_scale_with_exposure(name, power):
    image, reference = images()
    expected = 3.0**power * evaluate(name, image, reference)
    assert evaluate(name, 3.0 * image, 3.0 * reference) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("name", ["mse", "mae", "smape"])
def test_symmetric(name):
    image, reference = images()
    assert evaluate(name, reference, image) == pytest.approx(evaluate(name, image, reference), rel=1e-14)


def test_relative_metrics_know_the_reference():
    image, reference = images()
    for name in ("relmse", "mrse", "mape"):
        assert evaluate(name, reference, image) != pytest.approx(evaluate(name, image, reference), rel=0.01)


def test_expected_error_of_noise():
    """Of independent noise of relative standard deviation s, relMSE without epsilon would be s^2: 3 standard errors."""
    rng = np.random.default_rng(3)
    reference = np.full((200, 200, 3), 50.0)
    image = reference * (1.0 + 0.1 * rng.standard_normal(reference.shape))
    expected = 0.01 * 2500.0 / 2500.01
    assert abs(evaluate("relmse", image, reference) - expected) < 3.0 * expected * math.sqrt(2.0 / reference.size)


# --- FLIP --------------------------------------------------------------------------------------------------------


def by_openimageio(image, reference, **settings):
    """FLIP of OpenImageIO, which is not made from its authors' code."""
    import OpenImageIO as oiio

    if not hasattr(oiio.ImageBufAlgo, "FLIP_diff"):
        pytest.skip(f"OpenImageIO {oiio.VERSION_STRING} has no FLIP; 3.2 has")
    buffers = []
    for pixels in (reference, image):
        buffers.append(oiio.ImageBuf(oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, oiio.FLOAT)))
        buffers[-1].set_pixels(oiio.ROI(), np.ascontiguousarray(pixels, np.float32))
    return oiio.ImageBufAlgo.FLIP_diff(*buffers, ppd=67.0206, **settings).get_pixels()[..., 0]


def smooth_images():
    """A lamp, shadow edges and colours, from 0 to 1, and the same with noise."""
    y, x = np.mgrid[0:48, 0:64] / 48.0
    reference = np.stack([0.5 + 0.5 * np.sin(9 * x), (x + y > 1.0) * 0.7 + 0.1, 0.2 + 0.5 * y], axis=-1)
    return np.clip(reference * np.random.default_rng(4).gamma(9.0, 1 / 9.0, reference.shape), 0.0, 1.0), reference


def test_ldr_flip():
    needs_flip()
    image, reference = smooth_images()
    expected = by_openimageio(image, reference, hdr=0)
    found = error_map("flip", image, reference, display=True)
    assert np.abs(found - expected).max() < 1e-3
    assert evaluate("flip", image, reference, display=True) == pytest.approx(expected.mean(), rel=1e-4)
    assert expected.mean() > 0.05


def test_hdr_flip():
    needs_flip()
    image, reference = (20.0 * pixels**3 for pixels in smooth_images())
    luminance = reference @ [0.2126, 0.7152, 0.0722]
    limits = {"maxluminance": float(luminance.max()), "medianluminance": float(np.median(luminance))}
    expected = by_openimageio(image, reference, hdr=1, **limits)
    assert evaluate("flip", image, reference) == pytest.approx(expected.mean(), rel=0.01)
    assert evaluate("flip", image, reference) != pytest.approx(evaluate("flip", image, reference, True), rel=0.1)
    # the exposures follow the reference
    brighter = evaluate("flip", 64.0 * image, 64.0 * reference)
    assert brighter == pytest.approx(evaluate("flip", image, reference), rel=1e-3)


def test_flip_of_darkness():
    """The library would end the process."""
    needs_flip()
    with pytest.raises(WavefrontError, match="the reference has luminance 0 at most; needed: 1e-06"):
        evaluate("flip", np.ones((4, 4, 3)), np.zeros((4, 4, 3)))
    with pytest.raises(WavefrontError, match=r"has luminance 1\.4"):
        evaluate("flip", np.ones((4, 4, 3)), np.full((4, 4, 3), [0.0, 0.0, 2e-6]))
    assert 0.0 < evaluate("flip", np.full((4, 4, 3), 2e-6), np.full((4, 4, 3), 1e-6)) <= 1.0
    assert 0.0 < evaluate("flip", np.ones((4, 4, 3)), np.zeros((4, 4, 3)), display=True) <= 1.0


def test_flip_without_its_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(WavefrontError, match=r"flip-evaluator is not installed; .*\[flip\]"):
        evaluate("flip", *images())


# --- bad input ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("name", METRICS)
def test_a_value_that_is_not_finite_is_named(name, which, value):
    pair = images()
    pair[which][5, 7, 1] = value
    pair[which][6, 0, 0] = np.nan
    what = ("the image", "the reference")[which]
    with pytest.raises(
        WavefrontError, match=rf"^{what}: pixel \(7, 5\), channel G: -?(nan|inf) \(2 values are not finite"
    ):
        evaluate(name, *pair)


def test_shapes_and_names():
    image, reference = images()
    with pytest.raises(WavefrontError, match=r"shape \(37, 52, 3\), but the reference \(37, 53, 3\)"):
        evaluate("mse", image[:, 1:], reference)
    with pytest.raises(WavefrontError, match=r"shape \(37, 53\); allowed: \(height, width, 3\)"):
        evaluate("mse", image[..., 0], reference)
    with pytest.raises(WavefrontError, match="no metric 'psnr'; allowed: mse, mae, relmse"):
        evaluate("psnr", image, reference)


# --- false colours -----------------------------------------------------------------------------------------------


def lab(rgb8):
    """CIE L*a*b* of 8-bit sRGB, by the definition of Rec. 709 chromaticities and D65."""
    c = rgb8 / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    corners = np.array([[0.64, 0.30, 0.15], [0.33, 0.60, 0.06], [0.03, 0.10, 0.79]])
    white = np.array([0.3127, 0.3290, 0.3583]) / 0.3290
    t = linear @ (corners * np.linalg.solve(corners, white)).T / white
    f = np.where(t > 216.0 / 24389.0, np.cbrt(t), (24389.0 / 27.0 * t + 16.0) / 116.0)
    return np.stack([116.0 * f[:, 1] - 16.0, 500.0 * (f[:, 0] - f[:, 1]), 200.0 * (f[:, 1] - f[:, 2])], axis=1)


def test_false_colors_are_perceptually_uniform():
    colors = lab(TABLE.astype(np.float64))
    assert np.abs(colors[:, 0] - np.linspace(0.0, 100.0, 256)).max() < 0.5  # 8 bits
    steps = np.linalg.norm(np.diff(colors[::15], axis=0), axis=1)
    assert steps.max() / steps.min() < 1.2


def test_false_color_scale():
    colors = false_color(np.array([[0.0, 0.5, 1.0, 7.0]]), 1.0)
    assert colors.shape == (1, 4, 3) and colors.dtype == np.uint8
    assert colors[0, 0].tolist() == [0, 0, 0]
    assert colors[0, 2].tolist() == colors[0, 3].tolist() == [255, 255, 255]
    np.testing.assert_array_equal(false_color(np.array([[21.0]]), 42.0), colors[:, 1:2])
