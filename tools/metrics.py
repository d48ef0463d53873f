"""Error metrics of an image I against a reference R, in linear Rec. 709 radiance.

Each is a mean over pixels of the error of a pixel, which is the mean over its channels R, G and B (FLIP alone sees
colours). With d = I - R:

- ``mse``, d²: Wüst 2023.
- ``mae``, |d|.
- ``relmse``, d² / (R² + 0.01): Rousselle, Knaus and Zwicker 2011; Dong, Wang and Li 2023 (NPM).
- ``trimmed-relmse``, the same without the 0.1 % of pixels that have the largest errors: Figueiredo, He and Kalantari
  2025 (DF).
- ``mrse``, d² / (R² + 0.0001): Hart et al. 2020 report an MRSE; the epsilon is that of the JERI image viewer.
- ``mape``, |d| / (|R| + 0.01): Müller et al. 2019 (NIS), with this epsilon; Figueiredo et al. 2025.
- ``smape``, 2 |d| / (|I| + |R| + 0.02), from 0 to 2: the JERI viewer.
- ``flip``, the difference that is seen when two images alternate, from 0 to 1: LDR-FLIP of Andersson et al. 2020, and
  HDR-FLIP of Andersson et al. 2021 for radiance; Figueiredo et al. 2025.

Figures of different programs compare only where these details agree. What the published code of Dong et al. and of
Figueiredo et al. shows as relMSE has no epsilon, and channels with R = 0 count as 0 (nearer to ``mrse``); other
programs trim channels instead of pixels, or leave out the 2 of SMAPE.

The relative metrics change little with exposure where R² (or R) is large beside epsilon, and HDR-FLIP chooses its
exposures by the reference. All but FLIP stay the same when the pixels of both images are permuted.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from wavefront.errors import WavefrontError
from wavefront.film import LUMINANCE

RELMSE_EPSILON = 0.01
MRSE_EPSILON = 1e-4
MAPE_EPSILON = 0.01
TRIMMED = 1000  # one pixel of so many is dropped
FLIP_DARKEST = 1e-6  # luminance of the brightest pixel of a reference that HDR-FLIP can expose


class MissingPackageError(WavefrontError):
    """A metric needs a package that is not installed."""


@dataclasses.dataclass(frozen=True)
class Metric:
    """One metric.

    Attributes:
        name: As in `METRICS`.
        label: As papers write it.
        formula: In one line.
        pixels: From I, R, float64 [h, w, 3], and whether they were made for a display, to the error of every pixel,
            [h, w].
        trimmed: Whether the largest errors are left out of the mean.
    """

    name: str
    label: str
    formula: str
    pixels: Callable[[np.ndarray, np.ndarray, bool], np.ndarray]
    trimmed: bool = False

    def mean(self, pixels: np.ndarray) -> float:
        """The figure of an image from the errors of its pixels; 1 in 1000 of them, rounded down, may be dropped."""
        values = pixels.ravel()
        if self.trimmed:
            kept = values.size - values.size // TRIMMED
            values = np.partition(values, kept - 1)[:kept]
        return float(values.mean())


def _of_channels(error: Callable[[np.ndarray, np.ndarray], np.ndarray]):
    """The error of a pixel from that of a channel: the mean over channels."""
    return lambda image, reference, display: error(image, reference).mean(axis=2)


def _relmse(image, reference):
    return (image - reference) ** 2 / (reference**2 + RELMSE_EPSILON)


def _mape(image, reference):
    return np.abs(image - reference) / (np.abs(reference) + MAPE_EPSILON)


def _smape(image, reference):
    return np.abs(image - reference) / (0.5 * (np.abs(image) + np.abs(reference)) + MAPE_EPSILON)


def _flip(image: np.ndarray, reference: np.ndarray, display: bool) -> np.ndarray:
    """LDR-FLIP of images made for a display, HDR-FLIP of radiance, for the viewer that its authors assume."""
    try:
        import flip_evaluator
    except ImportError:
        raise MissingPackageError(
            "flip: the package flip-evaluator is not installed; it comes with pip install '.[flip]'"
        ) from None
    brightest = (np.maximum(reference, 0.0) @ np.asarray(LUMINANCE)).max()
    if not display and brightest < FLIP_DARKEST:  # the library would end the process
        raise WavefrontError(
            f"flip: the reference has luminance {brightest:g} at most; needed: {FLIP_DARKEST:g}, to choose exposures"
        )
    # Neither form is defined outside of these ranges; a filter with negative lobes leaves them.
    pair = [np.clip(pixels, 0.0, 1.0 if display else None).astype(np.float32) for pixels in (reference, image)]
    kind = "LDR" if display else "HDR"
    return flip_evaluator.evaluate(*pair, kind, inputsRGB=False, applyMagma=False)[0][:, :, 0].astype(np.float64)


METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric("mse", "MSE", "d²", _of_channels(lambda i, r: (i - r) ** 2)),
        Metric("mae", "MAE", "|d|", _of_channels(lambda i, r: np.abs(i - r))),
        Metric("relmse", "relMSE", "d² / (R² + 0.01)", _of_channels(_relmse)),
        Metric("trimmed-relmse", "trimmed relMSE", "relMSE without the worst 0.1 %", _of_channels(_relmse), True),
        Metric("mrse", "MRSE", "d² / (R² + 0.0001)", _of_channels(lambda i, r: (i - r) ** 2 / (r**2 + MRSE_EPSILON))),
        Metric("mape", "MAPE", "|d| / (|R| + 0.01)", _of_channels(_mape)),
        Metric("smape", "SMAPE", "2 |d| / (|I| + |R| + 0.02)", _of_channels(_smape)),
        Metric("flip", "FLIP", "perceived difference, 0 to 1", _flip),
    )
}


def find_metric(name: str) -> Metric:
    """The metric of this name.

    Raises:
        WavefrontError: There is none.
    """
    if name not in METRICS:
        raise WavefrontError(f"there is no metric {name!r}; allowed: {', '.join(METRICS)}")
    return METRICS[name]


def check_finite(
    pixels: np.ndarray, what: object, channels: Sequence[str] = "RGB", origin: tuple[int, int] = (0, 0)
) -> None:
    """Refuses values that are not finite.

    Args:
        pixels: [h, w, C].
        what: Named by the error: a file, or which image.
        channels: Names along the last axis.
        origin: Pixel x, y of the first one.

    Raises:
        WavefrontError: Names the first such pixel and channel.
    """
    bad = ~np.isfinite(pixels)
    if bad.any():
        y, x, c = np.unravel_index(bad.argmax(), bad.shape)
        raise WavefrontError(
            f"{what}: pixel ({x + origin[0]}, {y + origin[1]}), channel {channels[c]}: {pixels[y, x, c]} "
            f"({bad.sum()} values are not finite); allowed: finite numbers"
        )


def _checked(image, reference):
    image, reference = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    for what, pixels in (("the image", image), ("the reference", reference)):
        if pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size:
            raise WavefrontError(f"{what} is an array of shape {pixels.shape}; allowed: (height, width, 3)")
    if image.shape != reference.shape:
        raise WavefrontError(f"the image has shape {image.shape}, but the reference {reference.shape}")
    check_finite(image, "the image")
    check_finite(reference, "the reference")
    return image, reference


def error_map(name: str, image: np.ndarray, reference: np.ndarray, display: bool = False) -> np.ndarray:
    """The error of every pixel.

    Args:
        name: Of a metric.
        image, reference: Linear Rec. 709 radiance, shape [h, w, 3].
        display: Both were made for a display and decoded from it, with values from 0 to 1: FLIP is then LDR-FLIP.

    Returns:
        Shape [h, w], float64. That of `trimmed-relmse` has all pixels.

    Raises:
        WavefrontError: No such metric, arrays of other or different shapes, a value that is not finite, or a
            reference too dark for HDR-FLIP.
        MissingPackageError: FLIP is not installed.
    """
    metric = find_metric(name)
    return metric.pixels(*_checked(image, reference), display)


def evaluate(name: str, image: np.ndarray, reference: np.ndarray, display: bool = False) -> float:
    """The error of an image: the mean of `error_map`, whose arguments and errors these are."""
    return find_metric(name).mean(error_map(name, image, reference, display))
