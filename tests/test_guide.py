"""Guided paths: guides that mislead change the noise of an image, not the image.

z-tests of tiles have a false alarm rate of 1e-4 per comparison (see `tools.image_test`); seeds are fixed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import warp as wp

from guiding.npm import NpmGuide, NpmSettings
from tests.guides import HistogramGuide, LobeGuide, MeanGuide, RampGuide, ResamplingGuide
from tools.image_test import Comparison, Estimate
from wavefront import Renderer, WavefrontError, load_scene, renderer
from wavefront.checkpoint import CheckpointError
from wavefront.film import LUMINANCE
from wavefront.guide import DIRECTIONS, LIGHTS, Guide, GuideState
from wavefront.guided import GuidedWorker
from wavefront.proposals import MIN_SHARE
from wavefront.scene import description as d

SCENES = Path(__file__).parent.parent / "scenes"
CONE = {"axis": (0.6, 0.0, 0.8), "one_minus_cos": 0.3}
GUIDES = {
    "sphere": LobeGuide,
    "cone": lambda: LobeGuide(**CONE, varied_share=True),
    "histogram": HistogramGuide,
    "resampling 1": lambda: ResamplingGuide(1),
    "resampling 2": lambda: ResamplingGuide(2, from_bsdf=True),
    "resampling 3": lambda: ResamplingGuide(3),
    "resampling 4": lambda: ResamplingGuide(4, from_bsdf=True),
}


def small_npm() -> NpmGuide:
    """Neural parametric mixtures with a grid of few parameters, all that depends on threads included."""
    grid = {"n_levels": 2, "n_features": 2, "base_resolution": 4, "per_level_scale": 2.0, "n_neurons": 32}
    settings = NpmSettings(**grid, product=True, n_lobes=4, train_share=0.5, brightness_cells=4, learned_share=True)
    return NpmGuide(settings, seed=4)


def load(name, *overrides, size=24):
    return load_scene(SCENES / f"{name}.json", [f"film.width={size}", f"film.height={size}", *overrides])


def film(r, spp):
    r.render(spp)
    assert sum(r.statistics.nonfinite.values()) == 0
    return r.film.arrays.L.numpy()


# --- unbiased --------------------------------------------------------------------------------------------------------


def estimate(scene, spp, seed, guide=None) -> Estimate:
    r = Renderer(scene, seed=seed, guide=guide)
    film(r, spp)
    image, variance = (
        a.astype(np.float64)[..., None] for a in (r.film.image() @ np.array(LUMINANCE), r.film.variance())
    )
    return Estimate.from_variance(image, variance, (4, 4))


REFERENCES: dict = {}


def check_unbiased(name, nee, guide, spp=256):
    key = name, nee
    scene = load(name, f"integrator.nee={nee}", "integrator.max_depth=5", 'film.aovs=["variance"]')
    if key not in REFERENCES:
        REFERENCES[key] = estimate(scene, 4 * spp, 1)
    comparison = Comparison(estimate(scene, spp, 2, guide), REFERENCES[key])
    assert comparison.p_values.min() > comparison.level(), f"tiles differ: {comparison}"
    ratio, error = comparison.ratio()
    assert abs(ratio - 1.0) < 4.0 * error, f"the means differ: {comparison}"
    assert error < 0.05, "the test is too weak to find anything"


@pytest.mark.parametrize("guide", GUIDES)
@pytest.mark.parametrize("nee", ["true", "false"])
@pytest.mark.parametrize("name", ["cornell-box", "coloured-glass", "material-plastic"])
def test_misleading_guides_are_unbiased(name, nee, guide):
    check_unbiased(name, nee, GUIDES[guide]())


@pytest.mark.slow
@pytest.mark.parametrize("guide", ["sphere", "cone", "histogram", "resampling 2", "resampling 4"])
@pytest.mark.parametrize("nee", ["true", "false"])
@pytest.mark.parametrize(
    "name",
    [
        "material-blend",
        "material-mask",
        "material-rough-dielectric",
        "material-principled",
        "material-bump-map",
        "material-normal-map",
        "material-twosided",
        "material-rough-plastic",
    ],
)
def test_misleading_guides_are_unbiased_with_all_materials(name, nee, guide):
    check_unbiased(name, nee, GUIDES[guide](), spp=1024)


@pytest.mark.parametrize("nee", ["true", "false"])
def test_a_guide_that_learns_is_unbiased(nee):
    """While it trains, and after."""
    check_unbiased("cornell-box", nee, MeanGuide(0.2, one_minus_cos=0.3))


@pytest.mark.parametrize("nee", ["true", "false"])
def test_weights_of_samples_leave_it_unbiased(nee):
    check_unbiased("cornell-box", nee, RampGuide(0.2, 0.5, one_minus_cos=0.3))


# --- the BSDF alone --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("nee", ["true", "false"])
@pytest.mark.parametrize("name", ["cornell-box", "material-plastic", "material-mask"])
def test_with_all_samples_from_the_bsdf_nothing_changes(name, nee):
    """A share of 1, the guide's density being what it may: bit for bit what an unguided render gives."""
    scene = load(name, f"integrator.nee={nee}")
    expected = film(Renderer(scene, threads=1, seed=3), 4)
    for guide in (LobeGuide(**CONE, bsdf_share=1.0), ResamplingGuide(2, bsdf_share=1.0)):
        np.testing.assert_array_equal(film(Renderer(scene, threads=1, seed=3, guide=guide), 4), expected)


def test_with_all_samples_from_the_bsdf_media_change_roundings():
    scene = load("coloured-glass")
    expected = film(Renderer(scene, threads=1, seed=3), 4)
    image = film(Renderer(scene, threads=1, seed=3, guide=LobeGuide(bsdf_share=1.0)), 4)
    np.testing.assert_allclose(image, expected, rtol=1e-5, atol=1e-6 * expected.mean())


def test_nothing_of_guiding_without_a_guide():
    scene = load("cornell-box")
    plain, guided = Renderer(scene, threads=1), Renderer(scene, threads=1, guide=LobeGuide())
    assert plain.bytes_per_path == 184 < guided.bytes_per_path
    assert not plain.features.guided
    for name in ("guided", "lit", "proposed", "smooth"):
        assert plain.workers[0].queues[name].slots.shape[0] == 0
        assert guided.workers[0].queues[name].slots.shape[0] == guided.capacity
    for stage in ("generate", "intersect", "emission", "shadow", "drain", "accumulate"):
        assert getattr(plain.kernels, stage) is getattr(guided.kernels, stage)
    assert guided.kernels.scatter is guided.kernels.direct is None


def test_what_is_seen_through_a_mask_keeps_its_samples():
    """A surface that is not there declines its vertices: bit for bit what an unguided render gives."""
    scene = load("material-conductor")
    for shape in scene.shapes:
        shape.bsdf = d.Mask(bsdf=d.TwoSided(front=d.Diffuse()), opacity=0.0)
    guide = LobeGuide()
    calls = spy_on(guide)
    image = film(Renderer(scene, threads=1, guide=guide), 2)
    np.testing.assert_array_equal(image, film(Renderer(scene, threads=1), 2))
    assert image.max() > 0.0
    assert not calls


def test_a_guide_without_records_allocates_none():
    learning = Renderer(load("cornell-box"), threads=1, guide=MeanGuide())
    still = Renderer(load("cornell-box"), threads=1, guide=LobeGuide())
    inputs = 2 * 4
    assert still.bytes_per_path == learning.bytes_per_path - 5 * 12 - 4 - inputs
    assert not still.workers[0].scratch.beta
    assert still.kernels.emission is learning.kernels.emission


@pytest.mark.parametrize("nee", ["true", "false"])
@pytest.mark.parametrize("guide", [HistogramGuide, MeanGuide, lambda: ResamplingGuide(1), small_npm])
def test_bytes_per_path_are_what_is_allocated(guide, nee):
    """The state of the guide itself included."""
    r = Renderer(load("coloured-glass", f"integrator.nee={nee}"), threads=1, guide=guide())
    w = r.workers[0]
    structs = [w.paths, w.ray_hits, w.surfaces, w.shadow_rays, w.proposals, w.light_proposals, w.scratch]
    arrays = [getattr(struct, name) for struct in structs for name in struct._cls.vars]
    arrays += [queue.slots for queue in w.queues.queues.values()]
    arrays += [array for array in vars(w.state).values() if isinstance(array, wp.array)]
    allocated = sum(array.capacity for array in arrays if array is not None and array.size)
    assert allocated == r.bytes_per_path * r.capacity


# --- deterministic ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["histogram", "resampling", "mean", "ramp", "npm"])
def make_guide(request):
    return {
        "histogram": HistogramGuide,
        "resampling": lambda: ResamplingGuide(2, from_bsdf=True),
        "mean": lambda: MeanGuide(0.5, one_minus_cos=0.5),
        "ramp": lambda: RampGuide(0.5, one_minus_cos=0.5),
        "npm": small_npm,
    }[request.param]


@pytest.fixture(scope="module")
def single(make_guide):
    return film(Renderer(load("cornell-box", size=47), threads=1, seed=5, guide=make_guide()), 8)


@pytest.mark.parametrize(("threads", "capacity"), [(2, 1024), (3, 1500), (1, 1025), (2, 1 << 16)])
def test_threads_and_tiles(monkeypatch, make_guide, single, threads, capacity):
    monkeypatch.setattr(renderer, "CPU_CAPACITY", capacity)
    r = Renderer(load("cornell-box", size=47), threads=threads, seed=5, guide=make_guide())
    assert r.capacity == capacity
    np.testing.assert_array_equal(film(r, 8), single)


def test_launches_that_do_not_know_the_length_of_queues(monkeypatch, make_guide, single):
    """As on CUDA: every stage and the guide stop at what the device has counted."""
    dark = load("cornell-box", "integrator.nee=false")
    expected = film(Renderer(dark, threads=1, seed=5, guide=make_guide()), 4)
    monkeypatch.setattr(GuidedWorker, "_threads", lambda self, queue: self.capacity)
    r = Renderer(load("cornell-box", size=47), threads=1, seed=5, guide=make_guide())
    np.testing.assert_array_equal(film(r, 8), single)
    np.testing.assert_array_equal(film(Renderer(dark, threads=1, seed=5, guide=make_guide()), 4), expected)


def test_interrupted(tmp_path, make_guide, single):
    """While it trains, or later: a checkpoint has the guide, and the number of threads may change."""
    scene = load("cornell-box", size=47)
    for stop in (1, 3, 6):
        first = Renderer(scene, threads=2, seed=5, guide=make_guide())
        first.render(8, callback=lambda r, stop=stop: r.sample_count >= stop)
        assert first.sample_count < 8
        first.save_checkpoint(tmp_path / "c")
        second = Renderer(scene, threads=1, seed=5, guide=make_guide())
        second.load_checkpoint(tmp_path / "c")
        np.testing.assert_array_equal(film(second, 8 - second.sample_count), single)
        for name, array in first.guide.arrays().items():
            assert array.shape == second.guide.arrays()[name].shape


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (None, "guide is null"),
        (LobeGuide(bsdf_share=0.25), "guide.settings.bsdf_share is 0.25, but 0.5"),
        (HistogramGuide(), 'guide.name is "histogram", but "lobe"'),
    ],
)
def test_the_checkpoint_of_another_guide_is_refused(tmp_path, other, message):
    scene = load("cornell-box")
    r = Renderer(scene, threads=1, guide=LobeGuide())
    r.render(1)
    r.save_checkpoint(tmp_path / "c")
    with pytest.raises(CheckpointError) as error:
        Renderer(scene, threads=1, guide=other).load_checkpoint(tmp_path / "c")
    assert message in str(error.value)


# --- what a guide is asked -------------------------------------------------------------------------------------------


class SpyState(GuideState):
    """Does what another state does, and tells of it."""

    def __init__(self, state, calls):
        self.state, self.calls = state, calls

    def note(self, queue, count, *what):
        assert count == queue.count.numpy()[0] > 0
        self.calls.append((*what, set(queue.slots.numpy()[:count].tolist())))

    def prepare(self, guided, count):
        self.note(guided, count, "prepare")
        self.state.prepare(guided, count)

    def propose(self, proposed, count, round):
        self.note(proposed, count, "propose", round)
        self.state.propose(proposed, count, round)

    def evaluate(self, queue, count, directions, pdfs, purpose):
        self.note(queue, count, "evaluate", purpose)
        self.state.evaluate(queue, count, directions, pdfs, purpose)


def spy_on(guide):
    calls, make_state = [], guide.make_state
    guide.make_state = lambda context: SpyState(make_state(context), calls)
    return calls


@pytest.mark.parametrize("nee", ["true", "false"])
def test_the_order_of_a_bounce(nee):
    """Two rounds, lights only where they are sampled, each question only for vertices that were prepared."""
    guide = HistogramGuide()
    calls = spy_on(guide)
    film(Renderer(load("cornell-box", f"integrator.nee={nee}", "integrator.max_depth=4"), threads=1, guide=guide), 1)
    lights = [("evaluate", LIGHTS)] if nee == "true" else []
    bounce = [("prepare",), *lights, ("propose", 0), ("propose", 1), ("evaluate", DIRECTIONS)]
    assert [call[:-1] for call in calls] == 3 * bounce
    for k in range(0, len(calls), len(bounce)):
        slots = {call[:-1]: call[-1] for call in calls[k : k + len(bounce)]}
        assert all(found <= slots[("prepare",)] for found in slots.values())
        assert slots["propose", 0] == slots["propose", 1] < slots["evaluate", DIRECTIONS]


def test_a_guide_without_a_density_is_not_asked_for_one():
    guide = ResamplingGuide(2)
    calls = spy_on(guide)
    film(Renderer(load("cornell-box"), threads=1, guide=guide), 1)
    assert {call[0] for call in calls} == {"prepare", "propose"}


def test_mirrors_need_no_guide():
    guide = LobeGuide()
    calls = spy_on(guide)
    scene = load("material-conductor")
    for shape in scene.shapes:
        shape.bsdf = d.Conductor(material="Cu")
    film(Renderer(scene, threads=1, guide=guide), 1)
    assert not calls


# --- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.0, -0.5, 1.5, float("nan")])
def test_a_bsdf_share_out_of_range_is_refused(share):
    with pytest.raises(WavefrontError, match="BSDF share"):
        Renderer(load("cornell-box"), guide=LobeGuide(bsdf_share=share))


def test_a_guided_render_is_neither_strict_nor_traced():
    with pytest.raises(WavefrontError, match="strict render"):
        Renderer(load("cornell-box"), strict=True, guide=LobeGuide())
    with pytest.raises(WavefrontError, match="cannot be traced again"):
        Renderer(load("cornell-box"), threads=1, guide=LobeGuide()).trace(1, 1)


class ShareGuide(LobeGuide):
    """Asks for one share everywhere."""

    def __init__(self, share):
        super().__init__()
        self.share = share

    def make_state(self, context):
        state = super().make_state(context)
        state.prepare = lambda guided, count: context.proposals.share.fill_(self.share)
        return state


@pytest.mark.parametrize(
    ("share", "least"), [(0.0, MIN_SHARE), (float("nan"), MIN_SHARE), (-1.0, MIN_SHARE), (7.0, 1.0)]
)
def test_the_bsdf_keeps_its_share(share, least):
    """What a guide asks for is brought into range."""
    scene = load("cornell-box")
    expected = film(Renderer(scene, threads=1, guide=LobeGuide(bsdf_share=float(least))), 2)
    np.testing.assert_array_equal(film(Renderer(scene, threads=1, guide=ShareGuide(share)), 2), expected)


def test_a_broken_guide_is_counted_not_rendered():
    """Directions and densities that are not numbers."""
    r = Renderer(load("cornell-box"), threads=1, guide=LobeGuide(one_minus_cos=float("nan")))
    assert np.isfinite(r.render(2)).all()
    assert r.statistics.nonfinite["scatter"] > 0


class NoDensity(LobeGuide):
    """Denies its own directions."""

    def make_state(self, context):
        state = super().make_state(context)
        state.evaluate = lambda queue, count, directions, pdfs, purpose: pdfs.zero_()
        return state


def test_a_guide_that_denies_its_directions_ends_paths():
    r = Renderer(load("cornell-box"), threads=1, guide=NoDensity())
    assert np.isfinite(film(r, 2)).all()


def test_the_protocol_has_no_more_than_a_guide_needs():
    """What must be implemented."""
    assert Guide.__abstractmethods__ == {"bind", "modules", "make_state"}
