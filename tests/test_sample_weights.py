"""Weights of samples that a guide gives: the image is the weighted mean, and its variance is known.

Statistical tests are z-tests of fixed seeds, with a false alarm rate of 6e-5 each (4 standard errors).
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from tests.guides import LobeGuide, MeanGuide, RampGuide
from tests.stages.harness import Counters, array, launch, paths
from wavefront import Renderer, WavefrontError, load_scene
from wavefront.checkpoint import CheckpointError, film_sections
from wavefront.film import LUMINANCE, Film
from wavefront.guide import MIN_SAMPLE_WEIGHT
from wavefront.output import describe_render, image_attributes
from wavefront.stages.accumulate import make_accumulate

CORNELL_BOX = Path(__file__).parent.parent / "scenes" / "cornell-box.json"
AOVS = ["albedo", "depth", "normal", "sample_count", "shape_index", "variance"]
SPP = 8


def renderer(guide=None, *overrides, **settings):
    scene = load_scene(CORNELL_BOX, ["film.width=21", "film.height=17", f"film.aovs={json.dumps(AOVS)}", *overrides])
    return Renderer(scene, guide=guide, **({"seed": 7, "threads": 1} | settings))


def sums(film) -> dict[str, np.ndarray]:
    return {name: array.numpy().copy() for name, array in film_sections(film)["film"].items()}


def assert_same(a, b):
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def ramp(spp=SPP, full=0.75):
    return np.clip(np.arange(spp) / spp / full, MIN_SAMPLE_WEIGHT, 1.0)


# --- the mean --------------------------------------------------------------------------------------------------------


def single_samples(guide, spp=SPP) -> tuple[np.ndarray, Renderer]:
    """Radiance of each sample, [spp, pixels, 3]: an unweighted render whose film is emptied after every pass."""
    r, samples = renderer(guide), []

    def take(r):
        samples.append(r.film.arrays.L.numpy().copy())
        r.film.arrays.L.zero_()

    r.render(spp, callback=take)
    assert len(samples) == spp, "a pass had several samples"
    return np.stack(samples), r


def test_the_image_is_the_weighted_mean_of_single_samples():
    """The same paths, of a guide that learns all the time: weights change nothing but the mean."""
    samples, plain = single_samples(MeanGuide(1.0, one_minus_cos=0.5))
    w = ramp()
    assert len(set(w)) == 7
    r = renderer(RampGuide(1.0, one_minus_cos=0.5))
    r.render(SPP)
    mean = np.einsum("s,spc->pc", w, samples) / w.sum()
    np.testing.assert_allclose(r.film.arrays.L.numpy() / w.sum(), mean, rtol=1e-13)
    np.testing.assert_allclose(r.film.image().reshape(-1, 3), mean, rtol=1e-7)
    # The variance, in two passes over the samples and by shares of the weights.
    y, p = samples @ np.asarray(LUMINANCE), w / w.sum()
    squares = np.einsum("s,sp->p", p**2, (y - p @ y) ** 2)
    variance = squares / (1.0 - 2.0 * (p**3).sum() / (p**2).sum() + (p**2).sum())
    np.testing.assert_allclose(r.film.variance().ravel(), variance, rtol=1e-5, atol=1e-6 * (p @ y).max() ** 2 / SPP)
    # What camera rays hit is the mean over all samples alike.
    expected, found = plain.film.channels(), r.film.channels()
    for name in expected.keys() - {"R", "G", "B", "variance.Y"}:
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
    assert (found["sample_count.I"] == SPP).all()


def test_a_single_sample():
    """--spp 1: the weight of the only sample, however small, is that of the whole image."""
    r, plain = renderer(RampGuide()), renderer(MeanGuide())
    np.testing.assert_allclose(r.render(1), plain.render(1), rtol=1e-7)
    assert r.film.weight_sums[0] == MIN_SAMPLE_WEIGHT
    assert np.isnan(r.film.variance()).all()


def test_weights_of_one_change_roundings_of_the_variance_alone():
    class Ones(MeanGuide):
        weighted = True

    r, plain = renderer(Ones(0.5)), renderer(MeanGuide(0.5))
    np.testing.assert_array_equal(r.render(SPP), plain.render(SPP))
    assert r.film.weight_sums == (SPP, SPP, SPP) and r.film.effective_samples == SPP
    image = plain.film.image() @ np.asarray(LUMINANCE, np.float32)
    np.testing.assert_allclose(r.film.variance(), plain.film.variance(), rtol=1e-5, atol=1e-6 * image.max() ** 2 / SPP)


def test_without_weights_there_is_nothing_of_them():
    plain, unweighted, weighted = renderer(), renderer(MeanGuide()), renderer(RampGuide())
    for r in (plain, unweighted):
        assert not r.features.weighted and r.film.arrays.weights is r.film.arrays.weighted_luminance is None
    assert plain.kernels.accumulate is unweighted.kernels.accumulate is not weighted.kernels.accumulate
    assert plain.kernels.aov is weighted.kernels.aov
    assert plain.bytes_per_pixel == unweighted.bytes_per_pixel == weighted.bytes_per_pixel - 8
    silent = renderer(RampGuide())
    silent.guide.weighted = False  # now `sample_weight` is not asked
    assert silent._guiding.sample_weight(0.0) == 1.0


def test_passes_are_of_one_sample_until_the_weight_is_one():
    """So that the image does not depend on the length of passes, which is that of a time."""
    asked, counts = [], []

    class Ramp(LobeGuide):
        weighted = True

        def sample_weight(self, progress):
            asked.append(progress)
            return min(0.1 + progress, 1.0)

    r = renderer(Ramp(), "film.width=4", "film.height=4")
    r.render(40, callback=lambda r: counts.append(r.sample_count))
    assert counts[:36] == list(range(1, 37)) and counts[-1] == 40
    np.testing.assert_allclose(asked[:37], np.arange(37) / 40.0)
    w = np.minimum(0.1 + np.arange(40) / 40.0, 1.0)
    np.testing.assert_allclose(r.film.weight_sums, (w.sum(), (w**2).sum(), (w**3).sum()), rtol=1e-14)


def test_a_render_with_a_time_limit():
    """The weight follows the share of the time; what is left of it is in the sums."""
    r = renderer(RampGuide(1.0, full=1e-6), "film.width=4", "film.height=4")
    r.render(seconds=0.2)
    n = r.sample_count
    assert n - 1.0 < r.film.weight_sums[0] <= n
    assert np.isfinite(r.film.image()).all()


@pytest.mark.parametrize("weight", [float("nan"), 0.0, -0.5, MIN_SAMPLE_WEIGHT / 2.0, 1.5, float("inf")])
def test_a_weight_out_of_range_is_refused(weight):
    class Bad(MeanGuide):
        weighted = True

        def sample_weight(self, progress):
            return 1.0 if progress < 0.25 else weight

    r = renderer(Bad(1.0))
    with pytest.raises(WavefrontError) as error:
        r.render(8)
    assert str(error.value) == f"guide mean: a sample weight of {weight} at progress 0.25; allowed: 0.001 to 1"
    assert r.sample_count == 2 and np.isfinite(r.film.image()).all()


# --- the variance ----------------------------------------------------------------------------------------------------


def estimates(w, sigma, repeats=40, pixels=1 << 14) -> tuple[np.ndarray, np.ndarray]:
    """Means and estimated variances of films of grey samples 5 + sigma_k * noise with weights w_k, one pass each."""
    rng, tile = np.random.default_rng(3), array(np.array((0, 0, pixels, 1, 0, 1), np.int32), wp.int32)
    counters, means, variances = Counters(), [], []
    for _ in range(repeats):
        film = Film(pixels, 1, ("variance",), "cpu", weighted=True)
        for weight, spread in zip(w, sigma, strict=True):
            # Skew noise of variance 1, as that of a path tracer: 3 with probability 1/10, else -1/3.
            noise = np.where(rng.random(pixels) < 0.1, 3.0, -1.0 / 3.0)
            L = np.repeat((5.0 + spread * noise)[:, None], 3, axis=1).astype(np.float32)
            film.begin_pass(weight)
            launch(make_accumulate(True, True), pixels, paths(pixels, L=L), tile, pixels, film.arrays, counters.struct)
            film.end_pass(1)
        means.append(film.image()[..., 0].ravel().astype(np.float64))
        variances.append(film.variance().ravel().astype(np.float64))
    return np.concatenate(means), np.concatenate(variances)


def check_mean(values, expected, what):
    error = values.std(ddof=1) / np.sqrt(values.size)
    assert abs(values.mean() - expected) < 4.0 * error, f"{what}: {values.mean()} ± {error}, expected {expected}"
    assert error < 0.005 * expected, "the test is too weak to find anything"


def expected_estimate(w, sigma) -> tuple[float, float]:
    """Variance of the weighted mean of independent samples, and the expected value of its estimate, exactly: the
    quadratic form y^T A y with A = (I - 1 p^T)^T D (I - 1 p^T) / c has the mean tr(A Sigma)."""
    p = w / w.sum()
    residual = np.eye(len(w)) - np.outer(np.ones(len(w)), p)
    form = residual.T @ np.diag(p**2) @ residual
    form *= (p**2).sum() / np.trace(form)  # without bias for equal variances
    return float((p * p) @ sigma**2), float(np.diag(form) @ sigma**2)


@pytest.mark.parametrize("name", ["equal", "ramp", "two", "extreme"])
def test_the_variance_is_unbiased_for_samples_that_do_not_differ(name):
    w = {"equal": np.full(4, 0.5), "ramp": ramp(8), "two": np.array([0.3, 1.0]), "extreme": ramp(5, 0.2)}[name]
    sigma = np.full(len(w), 2.0)
    variance, expected = expected_estimate(w, sigma)
    assert expected == pytest.approx(variance, rel=1e-12)
    means, estimated = estimates(w, sigma)
    check_mean(estimated, variance, "estimated variance")
    check_mean((means - 5.0) ** 2, variance, "squared error of the mean")


def test_the_variance_where_early_samples_are_noisier():
    """And have lower weights: on the safe side, by less than the share of a sample."""
    w = ramp(16)
    sigma = 1.0 + 4.0 * (1.0 - w)
    variance, expected = expected_estimate(w, sigma)
    assert 1.0 < expected / variance < 1.0 + 1.0 / 16.0
    means, estimated = estimates(w, sigma, repeats=60)
    check_mean(estimated, expected, "estimated variance")
    check_mean((means - 5.0) ** 2, variance, "squared error of the mean")
    # The first order of the bias, as `Film.variance` states it.
    s1, s2, s3 = (w**k @ np.ones(16) for k in (1, 2, 3))
    bias = 2.0 * (s3 / s2 - (w**3 @ sigma**2) / (w**2 @ sigma**2)) / s1
    assert expected / variance - 1.0 == pytest.approx(bias, rel=0.2)


class FadingGuide(RampGuide):
    """Misleads at first: the BSDF gets a twentieth of the samples, later all but a few."""

    def trains(self, progress):
        self.share = 0.05 if progress < self.train_share else 0.9
        return super().trains(progress)

    def make_state(self, context):
        state = super().make_state(context)
        state.prepare = lambda guided, count: context.proposals.share.fill_(self.share)
        return state

    def point(self):
        pass  # learns nothing


def test_the_variance_is_that_of_renders():
    """Over pairs of renders a and b, (m_a - m_b)^2 - V_a - V_b has the mean zero, but for the stated bias of V, which
    is less than 2 S3 / (S1 S2). Film means of it, one for each of 60 pairs."""
    differences, variances = [], []
    for pair in range(60):
        images = []
        for seed in (2 * pair, 2 * pair + 1):
            guide = FadingGuide(0.25, 0.25, one_minus_cos=0.2)
            overrides = "film.width=24", "film.height=24", "integrator.max_depth=2", "integrator.nee=false"
            r = renderer(guide, *overrides, "film.filter.type=box", 'film.aovs=["variance"]', seed=100 + seed)
            r.render(16)
            images.append((r.film.image().astype(np.float64) @ np.asarray(LUMINANCE), r.film.variance()))
        (a, va), (b, vb) = images
        differences.append(((a - b) ** 2).mean())
        variances.append((va + vb).mean())
    s1, s2, s3 = r.film.weight_sums
    spread = np.subtract(differences, variances)
    error = spread.std(ddof=1) / np.sqrt(len(spread))
    bias = 2.0 * s3 / (s1 * s2) * np.mean(variances)
    print(f"{np.mean(differences):.4g} {np.mean(variances):.4g} ± {error:.2g}, bias < {bias:.2g}")
    assert -bias - 4.0 * error < spread.mean() < 4.0 * error
    assert 4.0 * error < 0.3 * np.mean(variances), "the test is too weak to find anything"


# --- accounts and checkpoints ----------------------------------------------------------------------------------------


def test_the_account_has_the_weights():
    r = renderer(RampGuide())
    r.render(SPP)
    w, account = ramp(), describe_render(r, "scene.json", 0.0)["guide"]
    assert account["sum_of_weights"] == pytest.approx(w.sum(), rel=1e-14)
    assert account["effective_samples_per_pixel"] == pytest.approx(w.sum() ** 2 / (w**2).sum(), rel=1e-14)
    assert account["method"] == "ramp" and account["statistics"]["records"] > 0
    assert float(image_attributes(r)["sumOfWeights"]) == r.film.weight_sums[0]
    plain = renderer(MeanGuide())
    plain.render(1)
    assert "sumOfWeights" not in image_attributes(plain)
    assert set(describe_render(plain, "scene.json", 0.0)["guide"]) == {"method", "settings", "statistics"}


@pytest.mark.parametrize("stop", [1, 5, 6])
def test_a_render_that_was_interrupted(tmp_path, stop):
    """While it trains, before weights are 1, and after: all sums and channels have the bits of an uninterrupted one."""
    whole = renderer(RampGuide())
    whole.render(SPP)
    first = renderer(RampGuide(), threads=2)
    first.render(SPP, callback=lambda r: r.sample_count >= stop)
    first.save_checkpoint(tmp_path / "c")
    second = renderer(RampGuide())
    second.load_checkpoint(tmp_path / "c")
    assert (second.sample_count, second.film.weight_sums) == (first.sample_count, first.film.weight_sums)
    assert second.sample_count < SPP
    second.render(SPP - second.sample_count)
    assert_same(sums(second.film), sums(whole.film))
    assert {"weights", "weighted_luminance"} < set(sums(whole.film))
    assert_same(second.film.channels(), whole.film.channels())
    with pytest.raises(CheckpointError, match=r"guide\.settings\.full is 0\.5, but 0\.75 in the checkpoint"):
        renderer(RampGuide(full=0.5)).load_checkpoint(tmp_path / "c")
