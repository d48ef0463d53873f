"""Images against Mitsuba 3, an independent renderer, of the same XML files.

Every comparison has two parts (see `tools.image_test`): no tile differs, at a false alarm rate of 1e-4 for the whole
image, and the 95 % confidence interval of the ratio of image means lies within 1 ± 0.005. Samples are taken until the
ratio is known to 0.1 %, so a difference of 0.4 % in the mean, or of a few percent in one tile, fails.

The variant of Mitsuba is `llvm_ad_rgb` where LLVM is installed, because it is faster, else `scalar_rgb`; the
environment variable WAVEFRONT_PEER_VARIANT chooses another one.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from scipy import stats

from tests import mitsuba_scenes as scenes
from tools.image_test import RATIO_TOLERANCE, Comparison, Estimate, collect, compare
from tools.peers.images import like_the_peer, our_batches, rounding_of, their_batches
from wavefront.scene import description, load_scene

mi = pytest.importorskip("mitsuba")
from tools.peers import mitsuba as peer  # noqa: E402

OWN_SCENES = sorted((Path(__file__).parent.parent / "scenes").glob("*.json"))
REAL_SCENES = os.environ.get("WAVEFRONT_SCENES")
needs_real_scenes = pytest.mark.skipif(not REAL_SCENES, reason="WAVEFRONT_SCENES names no folder of real scenes")
TILES = (4, 4)


@pytest.fixture(scope="module", autouse=True)
def variant():
    """Chooses the variant; other test modules choose theirs."""
    name = os.environ.get("WAVEFRONT_PEER_VARIANT")
    if name is None:
        name = "llvm_ad_rgb" if peer.missing("llvm_ad_rgb") is None else "scalar_rgb"
    previous = mi.variant()
    peer.use_variant(name)
    yield name
    if previous is not None:
        mi.set_variant(previous)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes")
    scenes.write_files(path)
    return path


def compare_xml(name: str, path: Path, size: tuple[int, int], max_depth: int, spp: int, tiles, nee=True, **settings):
    """Renders a Mitsuba file with both; `settings` are those of `image_test.compare`."""
    ours = our_batches(like_the_peer(load_scene(path), *size, max_depth, nee), spp, name)
    return compare(ours, their_batches(peer.load_xml(path, *size), max_depth, spp), tiles, **settings)


def check(name: str, comparison: Comparison, tolerance: float = RATIO_TOLERANCE) -> None:
    print(f"{name}: {comparison}")  # shown with -s, or when the test fails
    comparison.check(tolerance)


# --- small scenes ------------------------------------------------------------------------------------------------


def check_small(folder: Path, name: str, text: str, size=(scenes.SIZE, scenes.SIZE), nee: bool = True) -> None:
    path = folder / "scene.xml"
    path.write_text(text, encoding="utf-8")
    comparison = compare_xml(name, path, size, scenes.MAX_DEPTH, 32, TILES, nee)
    check(name, comparison)
    assert comparison.detectable() < 0.1, "the tiles are too noisy to find anything"


@pytest.mark.parametrize("name", scenes.PLAIN)
def test_plain(folder, name):
    check_small(folder, name, scenes.document(scenes.PLAIN[name], everything=False))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in scenes.VARIANTS)) for name in scenes.MIXED]
)
def test_mixed(folder, name):
    check_small(folder, name, scenes.document(scenes.MIXED[name], everything=True))


@pytest.mark.parametrize("nee", [True, False])
@pytest.mark.parametrize("name", scenes.AROUND)
def test_around(folder, name, nee):
    check_small(folder, name, scenes.document(scenes.AROUND[name], everything=False), nee=nee)


@pytest.mark.parametrize("name", scenes.DELTA)
def test_delta(folder, name):
    check_small(folder, name, scenes.document(scenes.DELTA[name], everything=False))


@pytest.mark.parametrize("nee", [True, False])
def test_sun(folder, nee):
    """Against a ball far away; from within 5 m its disc is the same to 5e-5 of its size and direction."""
    path = folder / "scene.xml"
    path.write_text(scenes.document(scenes.SUN, everything=False), encoding="utf-8")
    size = (scenes.SIZE, scenes.SIZE)
    scene = like_the_peer(load_scene(path), *size, scenes.MAX_DEPTH, nee)
    scene.shapes = [shape for shape in scene.shapes if shape.emitter is None]
    sun = description.Sun(direction=scenes.SUN_DIRECTION, angle=scenes.SUN_ANGLE, radiance=list(scenes.SUN_RADIANCE))
    scene.emitters = [sun]
    theirs = their_batches(peer.load_xml(path, *size), scenes.MAX_DEPTH, 64)
    check("sun", compare(our_batches(scene, 64, f"sun {nee}"), theirs, TILES))


@pytest.mark.parametrize("axis", scenes.CAMERAS)
def test_camera(folder, axis):
    camera, size = scenes.CAMERAS[axis]
    text = scenes.document(scenes.PLAIN["diffuse"], everything=False, camera=camera, size=size)
    check_small(folder, axis, text, size)


@pytest.mark.parametrize("name", scenes.SENSORS)
def test_sensor(folder, name):
    check_small(folder, name, scenes.with_sensor(scenes.document(scenes.PLAIN["smooth mesh"], everything=False), name))


def test_records_of_a_thin_lens_and_a_window(folder):
    """Mitsuba's image of our records, of a window of the film, and ours."""
    path = folder / "scene.xml"
    path.write_text(scenes.with_sensor(scenes.document(scenes.PLAIN["diffuse"], everything=False), "thin lens"))
    scene = like_the_peer(load_scene(path), 60, 50, scenes.MAX_DEPTH)
    scene.film.crop = description.Crop(x=20, y=7, width=32, height=32)
    theirs = their_batches(peer.load_records(scene), scenes.MAX_DEPTH, 32)
    check("window", compare(our_batches(scene, 32, "window"), theirs, TILES))


def test_without_light_sampling(folder):
    """The mean is the same; Mitsuba always samples lights."""
    check_small(folder, "no light sampling", scenes.document(scenes.MIXED["sky"], everything=True), nee=False)


def test_older_dialect(folder):
    """Mitsuba upgrades the file in its own way."""
    text = scenes.document(scenes.MIXED["rough dielectric, GGX"], everything=True)
    check_small(folder, "dialect 0.6", scenes.in_dialect_0_6(text))


@pytest.mark.parametrize(
    "name",
    ["cube and disk", "rough dielectric, Beckmann", "principled, half glass", "opacity bitmap", "bitmap, mirror"],
)
def test_records_of_a_file(folder, name):
    """Mitsuba's image of our records of a file is that of the file itself."""
    path = folder / "scene.xml"
    mixed = name in scenes.MIXED
    path.write_text(
        scenes.document((scenes.MIXED if mixed else scenes.PLAIN)[name], everything=mixed), encoding="utf-8"
    )
    before = {file: file.read_bytes() for file in folder.iterdir()}
    size = (scenes.SIZE, scenes.SIZE)
    records = like_the_peer(load_scene(path), *size, scenes.MAX_DEPTH)
    ours = their_batches(peer.load_records(records), scenes.MAX_DEPTH, 64, seed=1000)
    check(name, compare(ours, their_batches(peer.load_xml(path, *size), scenes.MAX_DEPTH, 64), TILES))
    assert {file: file.read_bytes() for file in folder.iterdir()} == before, "the peer wrote into the scene's folder"


# --- our own scenes, through our records -------------------------------------------------------------------------


# Of these Mitsuba has no counterpart, or (`test_mitsuba_media`, `test_mitsuba_instances`) not with the same settings.
OURS_ALONE = ("light-sun", "light-sunsky", "material-oren-nayar", "coloured-glass", "instances")
# Caustics and indirect light alone: 0.1 % would take hours.
NOISY = ("door-ajar", "glass-caustic", "glossy-plates")


@pytest.mark.slow
@pytest.mark.parametrize("path", [p for p in OWN_SCENES if p.stem not in OURS_ALONE], ids=lambda path: path.stem)
def test_own_scene(path):
    scene = load_scene(path)
    film = scene.film
    like_the_peer(scene, film.width, film.height, scene.integrator.max_depth)
    theirs = their_batches(peer.load_records(scene), scene.integrator.max_depth, 4)
    noisy = path.stem in NOISY
    comparison = compare(our_batches(scene, 4, path.stem), theirs, (8, 8), error=0.004 if noisy else 0.001)
    check(path.stem, comparison, 0.02 if noisy else RATIO_TOLERANCE)


# --- real scenes -------------------------------------------------------------------------------------------------

# File, size, depth, samples per batch. Films are large and batches of few samples: a pixel is a stratum, and the edges
# of small bright lights make most of the noise.
REAL = {
    "cornell-box": ("cornell-box/scene.xml", (256, 256), 8, 8),
    "cornell-box, original": ("cornell-box/original.xml", (256, 256), 8, 8),
    "veach-mis": ("veach-mis/scene.xml", (1280, 720), 3, 2),
    "veach-ajar": ("veach-ajar/scene.xml", (320, 180), 10, 8),
}


@needs_real_scenes
@pytest.mark.slow
@pytest.mark.parametrize("name", REAL)
def test_real_scene(name):
    file, size, max_depth, spp = REAL[name]
    tiles = (9, 16) if size[0] * 9 == size[1] * 16 else (8, 8)
    settings = {"most": 1024, "rounding": rounding_of(name)}
    check(name, compare_xml(name, Path(REAL_SCENES) / file, size, max_depth, spp, tiles, **settings))


@needs_real_scenes
@pytest.mark.slow
@pytest.mark.parametrize("name", ["veach-ajar", "bathroom"])
def test_reference(name):
    """Against an image of thousands of samples per pixel that Mitsuba made once."""
    file = Path(REAL_SCENES).parent / "references" / f"{name}.exr"
    if not file.exists():
        pytest.skip(f"there is no reference {file}")
    channels = OpenEXR.File(str(file), separate_channels=True).channels()
    image, error = (
        np.stack([channels[prefix + c].pixels for c in "RGB"], axis=-1).astype(np.float64) for prefix in ("", "se.")
    )
    account = json.loads(file.with_suffix(".json").read_text(encoding="utf-8"))
    width, height, max_depth = (account[key] for key in ("width", "height", "max_depth"))
    ours = our_batches(
        like_the_peer(load_scene(Path(REAL_SCENES) / name / "scene.xml"), width, height, max_depth), 8, name
    )
    tiles = (9, 16) if width * 9 == height * 16 else (8, 8)
    theirs = Estimate.from_variance(image, error**2, tiles)
    check(f"{name}, reference", compare(ours, theirs, tiles, most=1024))


# --- the peer itself ---------------------------------------------------------------------------------------------

READ_AFTER_RENDER = """
import sys
import mitsuba as mi, numpy as np
from tools.peers import mitsuba as peer
peer.use_variant("scalar_rgb", threads=1)
mi.Bitmap(np.ones((64, 64, 3), np.float32)).write(sys.argv[1])
scene = mi.load_dict({**mi.cornell_box(), "sensor": {**mi.cornell_box()["sensor"], "film": {"type": "hdrfilm",
    "width": 8, "height": 8}}})
assert peer.render(scene, 1).shape == (8, 8, 3)
mi.load_dict({"type": "bitmap", "filename": sys.argv[1]})
"""


def test_one_thread_reads_openexr(tmp_path):
    """With one thread Mitsuba 3.9 waits forever for an OpenEXR file: only while it renders there is but one."""
    command = [sys.executable, "-c", READ_AFTER_RENDER, str(tmp_path / "a.exr")]
    subprocess.run(command, check=True, timeout=120, cwd=Path(__file__).parent.parent)


# --- the test itself ---------------------------------------------------------------------------------------------


def test_tiles_are_calibrated(folder):
    """Ours against ours: the p-values of tiles are uniform, and a difference of 3 % in the image is found."""
    path = folder / "scene.xml"
    path.write_text(scenes.document(scenes.PLAIN["diffuse"], everything=False), encoding="utf-8")
    scene = like_the_peer(load_scene(path), scenes.SIZE, scenes.SIZE, scenes.MAX_DEPTH)
    p_values, batches = [], our_batches(scene, 16, "calibration")
    for _ in range(8):
        a, b = (Estimate.from_batches(collect(batches, 16, TILES)) for _ in range(2))
        p_values.append(Comparison(a, b).p_values[..., 1].ravel())  # channels err together: one of them
    # Its own false alarm rate is 1e-3.
    assert stats.kstest(np.concatenate(p_values), "uniform").pvalue > 1e-3
    brighter = dataclasses.replace(a, tiles=1.03 * a.tiles, means=1.03 * a.means)
    with pytest.raises(AssertionError, match="tiles differ"):
        Comparison(brighter, b).check()
    slightly = dataclasses.replace(a, means=1.006 * a.means)
    with pytest.raises(AssertionError, match="means differ"):
        Comparison(slightly, b).check()
