"""Records: what a guide learns from is what the film got, and does not depend on how the pass was cut."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from tests.guides import MeanGuide
from wavefront import Renderer, WavefrontError, load_scene, renderer
from wavefront.recording import RecordRequest
from wavefront.scene import description as d

SCENES = Path(__file__).parent.parent / "scenes"


def load(name, *overrides, size=24):
    return load_scene(SCENES / f"{name}.json", [f"film.width={size}", f"film.height={size}", *overrides])


def record(scene, spp=1, seed=3, threads=1, **options):
    """The renderer after passes of training, and the records of each."""
    guide = MeanGuide(train_share=1.0, keep=True, **({"one_minus_cos": 2.0} | options))
    r = Renderer(scene, threads=threads, seed=seed, guide=guide)
    r.render(spp)
    assert sum(r.statistics.nonfinite.values()) == 0
    assert len(guide.passes) == spp
    return r, guide.passes


def check_recursion(scene, **options):
    """The recursion back to the camera gives the path's radiance; the sum over passes is that of the film."""
    r, passes = record(scene, spp=3, **options)
    image = r.film.arrays.L.numpy()
    camera = sum(p["camera"].astype(np.float64) for p in passes)
    assert image.max() > 0.0
    np.testing.assert_allclose(camera, image, rtol=2e-5, atol=1e-7 * image.max())
    return passes


@pytest.mark.parametrize("nee", ["true", "false"])
@pytest.mark.parametrize("name", ["cornell-box", "coloured-glass", "material-mask", "light-envmap"])
def test_recursion(name, nee):
    scene = load(name, f"integrator.nee={nee}", "integrator.rr_depth=2", "integrator.max_depth=8")
    for depth in (16, 2, 1):
        passes = check_recursion(scene, depth=depth)
        assert max(p["depth"].max() for p in passes) < depth
    crop = 'film.crop={"width": 7, "height": 9, "x": 10, "y": 8}'
    scene = load(name, f"integrator.nee={nee}", crop)
    check_recursion(scene)


def test_deeper_paths_than_records_have_the_same_first_records():
    scene = load("cornell-box", "integrator.rr_depth=2", "integrator.max_depth=8")
    deep, shallow = (record(scene, depth=depth)[1][0] for depth in (16, 2))
    first = deep["depth"] < 2
    for name, values in shallow.items():
        if name == "camera":
            continue
        np.testing.assert_allclose(deep[name][first], values, rtol=2e-5, atol=1e-6, err_msg=name)


def test_taken_is_zero_without_light_sampling():
    _, (p,) = record(load("cornell-box", "integrator.nee=false"))
    assert (p["taken"] == 0.0).all()
    _, (p,) = record(load("cornell-box"))
    assert (p["taken"] > 0.0).any()
    assert (p["taken"] >= 0.0).all()


# --- what is in them -------------------------------------------------------------------------------------------------

ALBEDO = 0.6


def furnace(nee, max_depth, rr_depth=None):
    """A closed diffuse sphere that emits 1, around the camera."""
    sphere = d.Sphere(flip_normals=True, radius=1.3, bsdf=d.Diffuse(reflectance=ALBEDO), emitter=d.Area())
    return d.Scene(
        shapes=[sphere],
        camera=d.Perspective(fov=80.0),
        film=d.Film(width=64, height=64),
        integrator=d.PathIntegrator(max_depth=max_depth, rr_depth=rr_depth, nee=nee),
    )


@pytest.mark.parametrize("rr_depth", [None, 1])
@pytest.mark.parametrize("nee", [True, False])
def test_incident_radiance_in_a_furnace(nee, rr_depth):
    """1 + a + a^2 + ..., as many terms as the path may have segments left; whatever the direction.

    A z-test per depth, false alarm rate 1e-4 together.
    """
    max_depth = 5
    _, passes = record(furnace(nee, max_depth, rr_depth), spp=8, bsdf_share=0.4)
    for depth in range(max_depth - 1):
        values = []
        for p in passes:
            at = p["depth"] == depth
            values.append((p["radiance"] + p["taken"])[at].mean(axis=1, dtype=np.float64))
        values = np.concatenate(values)
        expected = sum(ALBEDO**k for k in range(max_depth - 1 - depth))
        error = values.std(ddof=1) / np.sqrt(len(values))
        assert len(values) > 500
        assert abs(values.mean() - expected) <= stats.norm.isf(1e-4 / 8) * error + 1e-5 * expected, depth
        assert error < 0.1


def test_fields_of_a_diffuse_vertex():
    """f |cos| / p with p = share cos / pi + (1 - share) / (4 pi), at points of the sphere."""
    share = 0.4
    _, passes = record(furnace(True, 4), bsdf_share=share)
    p = passes[0]
    cosine = np.sum(p["normal"] * p["wi"], axis=1)
    assert (cosine > 0.0).all()
    assert (np.sum(p["normal"] * p["wo"], axis=1) > 0.0).all()
    for name in ("normal", "wi", "wo"):
        np.testing.assert_allclose(np.linalg.norm(p[name], axis=1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(p["position"], -1.3 * p["normal"], atol=1e-5)
    np.testing.assert_allclose(p["guide_pdf"], 0.25 / np.pi, rtol=1e-5)
    pdf = share * cosine / np.pi + (1.0 - share) * 0.25 / np.pi
    np.testing.assert_allclose(p["pdf"], pdf, rtol=1e-4)
    np.testing.assert_allclose(p["weight"], np.repeat((ALBEDO / np.pi * cosine / pdf)[:, None], 3, 1), rtol=1e-3)
    assert (p["survival"] == 1.0).all()
    # The direction of a path leads to its next record.
    following = (p["pixel"][1:] == p["pixel"][:-1]) & (p["depth"][1:] == p["depth"][:-1] + 1)
    assert following.sum() > 100
    step = p["position"][1:] - p["position"][:-1]
    along = step / np.linalg.norm(step, axis=1, keepdims=True)
    np.testing.assert_allclose(along[following], p["wi"][:-1][following], atol=2e-3)
    np.testing.assert_allclose(p["wo"][1:][following], -p["wi"][:-1][following], atol=1e-6)


def test_records_of_survivors_say_with_which_probability():
    _, (p,) = record(furnace(True, 6, rr_depth=2))
    assert (p["survival"][p["depth"] < 1] == 1.0).all()
    later = p["survival"][p["depth"] >= 1]
    assert ((later > 0.0) & (later <= 0.95)).all()


# --- which paths, and in which order ---------------------------------------------------------------------------------


def test_order_and_independence(monkeypatch):
    scene = load("coloured-glass", size=40)
    _, expected = record(scene, spp=2)
    for p in expected:
        order = p["pixel"].astype(np.int64) * 100 + p["depth"]
        assert (np.diff(order) > 0).all()
    for threads, capacity in ((2, 1024), (1, 1025), (2, 1 << 16)):
        monkeypatch.setattr(renderer, "CPU_CAPACITY", capacity)
        _, passes = record(scene, spp=2, threads=threads)
        for a, b in zip(passes, expected, strict=True):
            for name in a:
                np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def test_every_kth_path():
    """Little memory: another k-th of the pixels in every pass, with the records that all paths would give."""
    scene = load("cornell-box")
    _, (whole, *_) = record(scene)
    r, passes = record(scene, spp=4, memory=80_000, one_minus_cos=2.0)
    k = r._guiding.recorder.stride
    assert k > 2
    assert r._guiding.recorder.nbytes <= 80_000
    for sample, p in enumerate(passes):
        assert len(p["pixel"]) > 20
        assert (p["pixel"] % k == sample % k).all()
    chosen = whole["pixel"] % k == 0
    for name in ("position", "radiance", "pdf", "depth"):
        np.testing.assert_array_equal(passes[0][name], whole[name][chosen])


@pytest.mark.parametrize("max_depth", [1, 2])
def test_paths_that_do_not_scatter_leave_no_records(max_depth):
    passes = check_recursion(load("cornell-box", f"integrator.max_depth={max_depth}"))
    assert all((len(p["pdf"]) > 0) == (max_depth == 2) for p in passes)


def test_no_light_no_harm():
    scene = furnace(True, 4)
    scene.shapes[0].emitter = None
    _, (p,) = record(scene)
    assert len(p["pdf"]) > 1000
    assert (p["radiance"] == 0.0).all()


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        (RecordRequest(("position", "colour")), "colour"),
        (RecordRequest(()), "missing"),
        (RecordRequest(("wi",), depth=0), "depth"),
    ],
)
def test_bad_requests_are_refused(request_, message):
    guide = MeanGuide()
    guide.records = request_
    with pytest.raises(WavefrontError, match=message):
        Renderer(load("cornell-box"), guide=guide)
