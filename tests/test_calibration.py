"""Whether intervals from the variance channel cover what they should: many independent renders of one scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tools.image_test import tile_areas, tile_sums
from tools.methods import load_job
from tools.reference_render import WavefrontMaker
from wavefront.film import LUMINANCE

CORNELL_BOX = Path(__file__).parent.parent / "scenes" / "cornell-box.json"
SETTINGS = ["film.width=32", "film.height=32", "film.filter.type=box", "integrator.max_depth=3", "camera.fov=30"]
RENDERS = 200
TILE = 8  # pixels along a side
NORMAL = 1.959964  # 97.5 % quantile


def estimate(job, seed: int, spp: int) -> tuple[np.ndarray, np.ndarray]:
    """Luminance and its variance, [h, w, 1] each."""
    maker = WavefrontMaker(job, seed)
    maker.add(spp, None, lambda: False)
    image, variance = maker.estimate()
    return (image.astype(np.float64) @ LUMINANCE)[..., None], variance.astype(np.float64)[..., None]


def coverage(job, spp: int, seed: int, reference, variance) -> tuple[float, float]:
    """Share of tiles, and of single pixels, whose 95 % interval covers the reference; that of its noise is added."""
    tiles = (reference.shape[0] // TILE, reference.shape[1] // TILE)
    area = tile_areas(reference.shape, tiles)
    of_tiles, of_pixels = [], []
    for i in range(RENDERS):
        image, spread = estimate(job, seed + i, spp)
        difference, total = image - reference, spread + variance
        of_pixels.append(np.abs(difference) <= NORMAL * np.sqrt(total))
        of_tiles.append(np.abs(tile_sums(difference, tiles) / area) <= NORMAL * np.sqrt(tile_sums(total, tiles)) / area)
    return float(np.mean(of_tiles)), float(np.mean(of_pixels))


@pytest.mark.slow
def test_intervals_of_tiles_are_calibrated():
    """200 renders of 256 samples: the 95 % intervals of 8x8 tiles cover in 94 to 96 % of cases, of which there are
    3,200, with a standard error of 0.4 %. Single pixels, whose samples are few and skew, are reported as they are."""
    job = load_job(CORNELL_BOX, SETTINGS, None, threads=2)
    reference, variance = estimate(job, 10_000, 1 << 14)
    tiles, pixels = coverage(job, 256, 1, reference, variance)
    few_tiles, few_pixels = coverage(job, 4, 1_000, reference, variance)
    print(f"256 spp: tiles {tiles:.4f}, pixels {pixels:.4f}; 4 spp: tiles {few_tiles:.4f}, pixels {few_pixels:.4f}")
    assert 0.94 <= tiles <= 0.96
    assert few_pixels < pixels < 0.96  # too sure of themselves with few samples
