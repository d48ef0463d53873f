"""Images with the Sobol sampler: the same in the mean as with independent samples, less noise, and no other kernels
than those which draw numbers."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from tools.image_test import Comparison, Estimate, tile_means
from wavefront import Renderer, load_scene
from wavefront.rng import uniform4
from wavefront.sampler import SAMPLERS

SCENES = Path(__file__).parent.parent / "scenes"
SEEDS = 32
PATHS = ("integrator.max_depth=4", "integrator.rr_depth=2")  # every decision, and few fireflies
# What draws numbers, in a scene that has every stage.
DRAWING = {"generate", "direct", "scatter"}


def renderer(name, sampler, seed=0, *overrides):
    size = ["film.width=24", "film.height=24", f"integrator.sampler={sampler}", *overrides]
    return Renderer(load_scene(SCENES / f"{name}.json", size), seed=seed)


def images(name, sampler, spp, first_seed=0, *overrides):
    """Of independent randomisations, [SEEDS, 24, 24, 3] float64."""
    seeds = range(first_seed, first_seed + SEEDS)
    return np.stack([renderer(name, sampler, seed, *overrides).render(spp) for seed in seeds]).astype(np.float64)


@pytest.mark.parametrize("name", ["principled-lobes", "light-envmap", "camera-thin-lens"])
def test_the_same_image_in_the_mean(name):
    """t-test of 16 tiles in three channels at a false-alarm rate of 1e-4, and of the mean of the image at 1e-3; from
    renders of 12 samples, no power of two."""
    estimates = [
        Estimate.from_batches([tile_means(image, (4, 4)) for image in images(name, sampler, 12, first, *PATHS)])
        for sampler, first in (("sobol", 0), ("independent", 1000))
    ]
    comparison = Comparison(*estimates)
    print(comparison)
    assert comparison.p_values.min() > comparison.level(), comparison
    low, high = comparison.interval(0.999)
    assert low <= 1.0 <= high, comparison
    assert high - low < 0.03  # it would find a difference


@pytest.mark.parametrize("name", ["cornell-box", "light-envmap"])
def test_less_noise(name):
    """The variance of a pixel of direct light, in the mean over pixels, estimated from 32 renders of each. Its standard
    error is below 25 % even if all of it came from one pixel; the bound is far from what is measured."""
    independent, sobol = (
        images(name, sampler, 64, 0, "integrator.max_depth=2").var(axis=0, ddof=1).mean() for sampler in SAMPLERS
    )
    print(name, independent / sobol)
    assert sobol < 0.5 * independent


def test_kernels_that_draw_no_numbers_are_shared():
    assert SAMPLERS["independent"] is uniform4  # and the others draw as if there were no choice
    kernels = [renderer("light-envmap", sampler).kernels for sampler in SAMPLERS]
    fields = [field.name for field in dataclasses.fields(kernels[0]) if getattr(kernels[0], field.name) is not None]
    assert {f for f in fields if getattr(kernels[0], f) is not getattr(kernels[1], f)} == DRAWING
