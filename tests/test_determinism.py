"""An image is a function of scene, seed and samples: not of threads, memory, passes, or who launches the kernels."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from wavefront import Renderer, load_scene
from wavefront.integrator import plan_tiles
from wavefront.scene import device

SCENES = Path(__file__).parent.parent / "scenes"
SPP = 8


def load(name="material-mask", width=61, height=47):
    name, _, sampler = name.partition(", ")
    sampler = sampler or "independent"
    # Sizes without common factors, so that tiles are cut off at the right and at the bottom.
    overrides = [f"film.width={width}", f"film.height={height}", f"integrator.sampler={sampler}"]
    return load_scene(SCENES / f"{name}.json", overrides)


def film(r, spp=SPP):
    """The sums in float64, not the image rounded to float32."""
    r.render(spp)
    return r.film.arrays.L.numpy()


@pytest.fixture(scope="module", params=["cornell-box", "material-mask", "material-bump-map", "cornell-box, sobol"])
def name(request):
    return request.param


@pytest.fixture(scope="module")
def reference(name):
    return film(Renderer(load(name), threads=1, seed=5))


@pytest.mark.parametrize("threads", [2, 3, 5])
def test_number_of_threads(name, reference, threads):
    # A small capacity, so that there are tiles for all.
    r = Renderer(load(name), threads=threads, seed=5, paths_in_flight=1024 * threads)
    assert len(r.workers) == threads
    np.testing.assert_array_equal(film(r), reference)
    assert np.isfinite(reference).all()


@pytest.mark.parametrize("capacity", [1024, 1025, 3000, 10_007])
def test_memory(name, reference, capacity):
    """A budget for the film and for these paths, and nothing more."""
    probe = Renderer(load(name), threads=1)
    budget = 61 * 47 * probe.bytes_per_pixel + capacity * probe.bytes_per_path
    r = Renderer(load(name), threads=1, seed=5, memory=budget)
    assert r.capacity == capacity
    np.testing.assert_array_equal(film(r), reference)


def test_capacity_of_a_whole_pass(name, reference):
    """One tile holds the whole film, as on CUDA."""
    r = Renderer(load(name), threads=1, seed=5, paths_in_flight=1 << 16)
    assert r.capacity == 1 << 16
    assert len(plan_tiles(61, 47, r.capacity, 0, SPP)) == 1
    np.testing.assert_array_equal(film(r), reference)


def test_fetching_ahead(name, reference, monkeypatch):
    """As for scenes that fit no cache; of the queues of a small capacity, the last entries have none after them."""
    monkeypatch.setattr(device, "CACHE_BYTES", 0)
    r = Renderer(load(name), threads=1, seed=5, paths_in_flight=1024)
    assert r.features.ahead
    np.testing.assert_array_equal(film(r), reference)


def test_samples_in_parts(name, reference):
    """The film adds samples in their order, so float64 sums do not depend on where a call ends."""
    r = Renderer(load(name), threads=2, seed=5)
    film(r, 5)
    np.testing.assert_array_equal(film(r, 3), reference)
    assert r.sample_count == SPP


def test_one_sample_at_a_time(name, reference):
    r = Renderer(load(name), threads=1, seed=5)
    for _ in range(SPP):
        r.render(1)
    np.testing.assert_array_equal(r.film.arrays.L.numpy(), reference)


def test_callback_that_ends_and_resumes(name, reference):
    r = Renderer(load(name), threads=1, seed=5)
    r.render(SPP, callback=lambda _: True)
    assert r.sample_count < SPP
    r.render(SPP - r.sample_count)
    np.testing.assert_array_equal(r.film.arrays.L.numpy(), reference)


@pytest.mark.parametrize("seed", [0, 6, 5 + 2**32, 2**64 - 1])
def test_other_seeds_differ(name, reference, seed):
    """In nearly every pixel that light reaches, whichever half of the seed differs."""
    other = film(Renderer(load(name), threads=1, seed=seed))
    lit = reference.sum(axis=1) > 0.0
    assert (other[lit] != reference[lit]).any(axis=1).mean() > 0.9


def test_samples_and_pixels_differ(name):
    """Neighbours do not share random numbers: no two of the first samples are equal where light is found."""
    r = Renderer(load(name), threads=1, seed=5)
    first = film(r, 1).copy()
    second = film(r, 1) - first
    both = (first.sum(axis=1) > 0.0) & (second.sum(axis=1) > 0.0)
    assert both.any()
    assert (first[both] != second[both]).any(axis=1).mean() > 0.9


@pytest.mark.parametrize("capacity", [1024, 1 << 14])
def test_captured_graph(name, reference, capacity):
    """A recorded pass, replayed with nothing but the tile changed, gives the same bits: the bounce loop ends by what
    the device counts, and no launch depends on what the host has read."""
    r = Renderer(load(name), threads=1, seed=5, paths_in_flight=capacity)
    worker = r.workers[0]
    graph = worker.capture()
    tiles = plan_tiles(61, 47, worker.capacity, 0, SPP)
    assert len({(t.width, t.height, t.sample_count) for t in tiles}) > 1
    for tile in tiles:
        worker.tile.numpy()[:] = np.array(dataclasses.astuple(tile), np.int32)
        wp.capture_launch(graph)
    r.film.sample_count = SPP
    np.testing.assert_array_equal(r.film.arrays.L.numpy(), reference)
    worker.check_status()


def test_repeated(name, reference):
    """Twice in one process, so that nothing is left behind by the first."""
    np.testing.assert_array_equal(film(Renderer(load(name), threads=1, seed=5)), reference)
