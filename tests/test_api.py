"""The Python API: scenes built from objects, passes, callbacks, and the film's statistics."""

from __future__ import annotations

import numpy as np
import pytest

import wavefront
from wavefront.film import LUMINANCE
from wavefront.scene import description as d


def lit_floor(**film) -> d.Scene:
    """A floor from NumPy arrays under a rectangular light, seen from above at a slant."""
    vertices = np.array([[-2, 0, -2], [2, 0, -2], [2, 0, 2], [-2, 0, 2]], np.float32)
    faces = np.array([[0, 2, 1], [0, 3, 2]], np.int32)
    return d.Scene(
        camera=d.Perspective(to_world=[d.TransformStep(look_at=d.LookAt(origin=(0, 2, 3), target=(0, 0, 0)))]),
        film=d.Film(**({"width": 16, "height": 12} | film)),
        integrator=d.PathIntegrator(max_depth=3, rr_depth=None, spp=8),
        shapes=[
            d.Mesh(vertices=vertices, faces=faces, bsdf=d.Diffuse(reflectance=0.7)),
            d.Rectangle(
                emitter=d.Area(radiance=(3.0, 2.0, 1.0)),
                to_world=[
                    d.TransformStep(rotate=d.Rotate(axis=(1, 0, 0), angle=90)),
                    d.TransformStep(translate=(0, 3, 0)),
                ],
            ),
        ],
    )


def test_render_returns_the_image_of_objects():
    renderer = wavefront.Renderer(lit_floor())
    image = renderer.render()
    assert image.shape == (12, 16, 3)
    assert image.dtype == np.float32
    assert renderer.sample_count == 8
    # All light has one colour and bounces off grey: the channels stay in proportion.
    lit = image[..., 2] > 0
    assert lit.mean() > 0.5
    np.testing.assert_allclose(image[lit][:, 0] / image[lit][:, 2], 3.0, rtol=1e-4)


def test_callback_sees_every_pass_and_can_stop():
    renderer = wavefront.Renderer(lit_floor())
    seen = []
    renderer.render(spp=1000, callback=lambda r: seen.append(r.sample_count) or len(seen) == 4)
    assert seen == sorted(set(seen))
    assert len(seen) == 4
    assert renderer.sample_count == seen[-1] < 1000


def test_statistics_count_paths_and_rays():
    renderer = wavefront.Renderer(lit_floor())
    renderer.render(spp=5)
    s = renderer.statistics
    assert s.paths == 5 * 16 * 12
    # At most two more segments after the camera ray, and one shadow ray at each of two vertices.
    assert s.paths < s.rays <= 3 * s.paths
    assert 0 < s.shadow_rays <= 2 * s.paths
    assert set(s.stage_seconds) >= {"generate", "intersect", "emission", "direct", "shadow", "scatter", "accumulate"}


def test_variance_of_the_mean_is_calibrated():
    """Over 64 independent renders of 64 samples, the estimated variance of the mean luminance agrees with the spread
    of the means: chi-square with 63 degrees of freedom a pixel, summed over pixels (false-alarm rate about 1e-4)."""
    means, variances = [], []
    for seed in range(64):
        renderer = wavefront.Renderer(lit_floor(aovs=["variance"]), seed=seed, threads=1)
        means.append(renderer.render(spp=64).astype(np.float64) @ np.asarray(LUMINANCE))
        variances.append(renderer.film.variance())
    estimated = np.mean(variances, axis=0)
    noisy = estimated > 1e-8
    assert noisy.mean() > 0.3
    ratio = (np.var(means, axis=0, ddof=1)[noisy] / estimated[noisy]).mean()
    # Standard deviation of one ratio is sqrt(2 / 63); the pixels are independent.
    assert abs(ratio - 1.0) < 4.0 * np.sqrt(2.0 / 63.0 / noisy.sum())


def test_a_second_renderer_does_not_disturb_the_first():
    first = wavefront.Renderer(lit_floor())
    first.render(spp=2)
    second = wavefront.Renderer(lit_floor(width=8), seed=5)
    second.render(spp=2)
    whole = wavefront.Renderer(lit_floor())
    np.testing.assert_array_equal(first.render(spp=2), whole.render(spp=4))


@pytest.mark.parametrize("arguments", [{"spp": 0}, {"spp": -3}, {"seconds": 0.0}, {"seconds": float("nan")}])
def test_budget_must_be_positive(arguments):
    with pytest.raises(wavefront.WavefrontError, match="allowed"):
        wavefront.Renderer(lit_floor()).render(**arguments)


def test_memory_budget_bounds_the_path_state():
    small = wavefront.Renderer(lit_floor(), memory=1 << 20, threads=2)
    assert small.capacity * small.bytes_per_path * 2 + 16 * 12 * small.bytes_per_pixel <= 1 << 20
    large = wavefront.Renderer(lit_floor(), threads=2)
    assert small.capacity < large.capacity
    np.testing.assert_array_equal(small.render(spp=200), large.render(spp=200))


def test_objects_are_checked_as_a_file_is():
    scene = lit_floor()
    scene.shapes[0].bsdf.reflectance = 1.5
    with pytest.raises(wavefront.SceneError, match=r"^shapes\[0\]\.bsdf\.reflectance: .*1\.5"):
        wavefront.Renderer(scene)


def test_a_renderer_keeps_its_scene():
    scene = lit_floor()
    renderer = wavefront.Renderer(scene)
    scene.film.width = 99
    assert renderer.render(spp=1).shape == (12, 16, 3)
