"""References: their stated error, when they are refused, and that a kill does not change them."""

from __future__ import annotations

import hashlib
import json
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tools.methods import load_job
from tools.peers import mitsuba as peer
from tools.reference import compare_stored, find_reference, load_reference, main, make_reference
from tools.reference_render import (
    BATCH,
    EPSILON,
    MAKERS,
    Goal,
    is_stop,
    median_relative_error,
    next_stop,
    relative_error,
)
from wavefront.errors import WavefrontError
from wavefront.film import LUMINANCE
from wavefront.scene import load_scene

ROOT = Path(__file__).parent.parent
CORNELL_BOX = ROOT / "scenes" / "cornell-box.json"
TINY = ["film.width=12", "film.height=10", "film.filter.type=box", "integrator.max_depth=3"]
EVEN = ["film.width=32", "film.height=24", "camera.fov=24"]  # the lamp, which has most of the noise, is not seen
NO_MITSUBA = peer.missing("scalar_rgb")
needs_mitsuba = pytest.mark.skipif(NO_MITSUBA is not None, reason=NO_MITSUBA or "")
BOTH = ["wavefront", pytest.param("mitsuba", marks=needs_mitsuba)]


def job(*overrides):
    return load_job(CORNELL_BOX, [*TINY, *overrides], None, threads=1)


def command(*words):
    return main([str(CORNELL_BOX), "--override", *TINY, "--threads", "1", *map(str, words)])


@pytest.fixture(scope="module")
def longer():
    """An image of 2^12 samples per pixel, and its variance."""
    maker = MAKERS["wavefront"](job(*EVEN), seed=99)
    maker.add(1 << 12, None, lambda: False)
    return maker.estimate()


# --- errors ------------------------------------------------------------------------------------------------------


def test_relative_error_by_hand():
    image = np.array([[[0.0, 0.0, 0.0], [2.0, 2.0, 2.0]]])  # luminances 0 and 2
    variance = np.array([[0.0004, 0.1]])
    # sqrt((0.0004 / 0.01 + 0.1 / 4.01) / 2)
    assert relative_error(image, variance) == pytest.approx(np.sqrt((0.04 + 0.1 / 4.01) / 2.0), rel=1e-6)
    assert median_relative_error(image, variance) == pytest.approx(np.sqrt(0.1) / 2.0, rel=1e-6)


@pytest.mark.parametrize("renderer", BOTH)
def test_the_stated_error_is_the_actual_one(renderer, longer, tmp_path):
    """E^2 against the squared distance to an image of 16 times the samples.

    For normal means d of variance v, sum(w d^2) has mean sum(w v) and variance sum(2 w^2 v^2); of the estimates of v,
    the spread 2 v^2 / degrees comes on top, and kurtosis, which 256 samples leave little of. |z| < 4 has a false alarm
    rate of 1e-4.
    """
    samples = 256
    reference = make_reference(job(*EVEN), Goal(spp=samples), tmp_path, renderer, seed=1)
    image, variance = longer
    luminance = [one.astype(np.float64) @ LUMINANCE for one in (reference.image, image)]
    weight = 1.0 / (luminance[0] ** 2 + EPSILON)
    stated = reference.variance.astype(np.float64) + variance
    degrees = samples - 1 if renderer == "wavefront" else samples / BATCH - 1
    spread = np.sqrt((2.0 * weight**2 * stated**2 * (1.0 + 1.0 / degrees)).sum())
    z = ((weight * (luminance[0] - luminance[1]) ** 2).sum() - (weight * stated).sum()) / spread
    assert abs(z) < 4.0
    assert 4.0 * spread < 0.35 * (weight * stated).sum()  # an E that is wrong by a fifth would be found
    assert reference.account.error**2 == pytest.approx((weight * reference.variance).mean(), rel=1e-5)
    assert reference.account.error > 0.01


def test_error_is_reached_at_a_stop(tmp_path):
    reference = make_reference(job(), Goal(error=0.05), tmp_path)
    assert reference.account.error <= 0.05
    assert reference.account.reached
    assert is_stop(reference.account.samples_per_pixel)
    assert reference.account.error > 0.05 * 0.7  # no more than the steps of the stops allow


def test_stops_are_whole_batches_and_double_in_four_steps():
    stops = [next_stop(0)]
    while stops[-1] < 5000:
        stops.append(next_stop(stops[-1]))
    assert stops[:5] == [64, 80, 96, 112, 128]
    assert stops == sorted(set(stops))
    assert all(stop % BATCH == 0 for stop in stops)
    assert {1024, 2048, 4096} <= set(stops)
    assert [n for n in range(60, 130) if is_stop(n)] == stops[:5]


# --- use ---------------------------------------------------------------------------------------------------------


def test_is_found_and_refused_for_other_settings(tmp_path):
    made = make_reference(job(), Goal(spp=8), tmp_path)
    found = find_reference(CORNELL_BOX, [*TINY, "integrator.nee=false", "integrator.rr_depth=null"], folder=tmp_path)
    assert found.account == made.account  # the noise may differ, the image is the same
    np.testing.assert_array_equal(found.image, made.image)
    with pytest.raises(WavefrontError, match=r"settings: integrator.max_depth is 4, but 3 in .*wavefront.exr$"):
        find_reference(CORNELL_BOX, [*TINY, "integrator.max_depth=4"], folder=tmp_path)
    with pytest.raises(WavefrontError, match=r"other settings: film.width is 13, but 12 in the reference"):
        load_reference(made.path, load_scene(CORNELL_BOX, [*TINY, "film.width=13"]))
    with pytest.raises(WavefrontError, match=r"bsdfs\[0\].reflectance.* is 0.5, but"):
        load_reference(made.path, load_scene(CORNELL_BOX, [*TINY, "bsdfs[0].reflectance=0.5"]))
    with pytest.raises(WavefrontError, match="none of this scene"):
        find_reference(ROOT / "scenes" / "furnace.json", folder=tmp_path)


def test_next_event_estimation_counts_where_lights_have_no_extent(tmp_path):
    scene = ROOT / "scenes" / "light-point.json"
    make_reference(load_job(scene, TINY, None, 1), Goal(spp=2), tmp_path)
    with pytest.raises(WavefrontError, match=r"integrator.nee is false"):
        find_reference(scene, [*TINY, "integrator.nee=false"], folder=tmp_path)


def test_image_and_account_belong_together(tmp_path):
    made = make_reference(job(), Goal(spp=8), tmp_path / "a")
    other = make_reference(job(), Goal(spp=8), tmp_path / "b", seed=2)
    made.path.write_bytes(other.path.read_bytes())
    with pytest.raises(WavefrontError, match=r"is not the image that .* tells of"):
        load_reference(made.path)
    assert make_reference(job(), Goal(spp=8), tmp_path / "a").account.samples_per_pixel == 8  # from the checkpoint
    load_reference(made.path)


def test_is_used_again_continued_or_refused(tmp_path, capsys):
    assert command("--spp", 16, "-o", tmp_path) == 0
    (path,) = tmp_path.glob("*.exr")
    before = path.stat().st_mtime_ns
    assert command("--spp", 9, "-o", tmp_path) == 0
    assert path.stat().st_mtime_ns == before
    assert command("--spp", 48, "-o", tmp_path) == 0
    at_once = make_reference(job(), Goal(spp=48), tmp_path / "other")
    assert load_reference(path).account.image_sha256 == at_once.account.image_sha256
    assert command("--spp", 48, "--seed", 7, "-o", tmp_path) == 2
    assert "made otherwise: seed is 7, but 0" in capsys.readouterr().err
    assert make_reference(job(), Goal(spp=48), tmp_path, seed=7, exact=False).account.seed == 0
    with pytest.raises(WavefrontError, match="made otherwise"):
        make_reference(job(), Goal(spp=49), tmp_path, seed=7, exact=False)


@needs_mitsuba
def test_two_renderers_are_compared(tmp_path, capsys):
    assert command("--spp", 512, "-o", tmp_path) == 0
    assert command("--spp", 512, "-o", tmp_path, "--with", "mitsuba") == 0
    assert "against" in capsys.readouterr().out
    (stored,) = tmp_path.glob("*.comparison.json")
    (outcome,) = json.loads(stored.read_text())
    assert outcome["verdict"] in ("same", "noisy")
    assert outcome["samples_per_pixel"] == [512, 512]
    # And one that is half as bright again is found.
    (path,) = tmp_path.glob("*.mitsuba.exr")
    brighter = MAKERS["mitsuba"](job(), 0)
    brighter.add(512, None, lambda: False)
    for sums, factor in (("L", 1.5), ("luminance_squared", 1.5**2)):
        brighter.sums[sums] *= factor
    brighter.write(path)
    account = json.loads(path.with_suffix(".json").read_text())
    account["image_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    path.with_suffix(".json").write_text(json.dumps(account))
    assert compare_stored(load_reference(path))[0]["verdict"] == "differs"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--spp", "1"], "1 samples per pixel; allowed: 2 to"),
        (["--error", "0"], "error of 0; allowed: more than 0"),
        (["--seconds", "nan"], "allowed: more than 0"),
        (["--define", "x"], "allowed: NAME=VALUE"),
        (["--threads", "0"], "allowed: 1 or more"),
        (["--every", "0"], "allowed: more than 0"),
        (["--with", "mitsuba", "--override", "integrator.nee=false"], "integrator.nee is false; mitsuba has only true"),
        (["--with", "mitsuba", "--override", "film.filter.type=tent"], "with mitsuba: box"),
        (["--with", "mitsuba", "--seed", "128"], "allowed: 0 to 127"),
    ],
)
def test_bad_input_is_one_line(words, message, tmp_path, capsys):
    if "mitsuba" in words and NO_MITSUBA:
        pytest.skip(NO_MITSUBA)
    assert command("-o", tmp_path, *words) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.glob("*.exr"))


# --- kills -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("renderer", BOTH)
def test_resumes_after_a_kill(renderer, tmp_path):
    """SIGKILL after a checkpoint; the rest in this process. Samples are the same as without, ours to the last bit."""
    words = ["--spp", "3000", "--with", renderer, "--every", "0.05", "-o", str(tmp_path / "killed")]
    process = subprocess.Popen(
        [sys.executable, "-m", "tools.reference", str(CORNELL_BOX), "--override", *TINY, "--threads", "1", *words],
        cwd=ROOT,
        stderr=subprocess.DEVNULL,
    )
    try:
        deadline = time.monotonic() + 120.0
        while not list((tmp_path / "killed").glob("*.checkpoint")) and time.monotonic() < deadline:
            time.sleep(0.01)
    finally:
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    assert not list((tmp_path / "killed").glob("*.exr"))
    (checkpoint,) = (tmp_path / "killed").glob("*.checkpoint")
    about = json.loads(zipfile.ZipFile(checkpoint).read("about.json"))
    assert (
        0
        < (about.get("progress") or about["statistics"])["samples" if renderer == "mitsuba" else "sample_count"]
        < 3000
    )
    resumed = make_reference(job(), Goal(spp=3000), tmp_path / "killed", renderer)
    at_once = make_reference(job(), Goal(spp=3000), tmp_path / "at-once", renderer)
    if renderer == "wavefront":
        assert resumed.account.image_sha256 == at_once.account.image_sha256
    else:  # it adds samples up in float32, in no fixed order
        np.testing.assert_allclose(resumed.image, at_once.image, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(resumed.variance, at_once.variance, rtol=1e-3, atol=1e-9)
    assert resumed.account.details.get("paths") == at_once.account.details.get("paths")
    assert resumed.account.details.get("batches") == at_once.account.details.get("batches")
