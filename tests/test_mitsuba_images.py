"""Images against Mitsuba 3, an independent renderer, of the same XML files.

Every comparison has two parts (see `tests.image_test`): no tile differs, at a false alarm rate of 1e-4 for the whole
image, and the 95 % confidence interval of the ratio of image means lies within 1 ± 0.005. Samples are taken until the
ratio is known to 0.1 %, so a difference of 0.4 % in the mean, or of a few percent in one tile, fails.

The variant of Mitsuba is `llvm_ad_rgb` where LLVM is installed, because it is faster, else `scalar_rgb`; the environment
variable WAVEFRONT_PEER_VARIANT chooses another one.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from tests import mitsuba_scenes as scenes
from tests.image_test import Comparison, compare
from wavefront.renderer import Renderer
from wavefront.scene import description, load_scene

mi = pytest.importorskip("mitsuba")
from tools.peers import mitsuba as peer  # noqa: E402

OWN_SCENES = sorted((Path(__file__).parent.parent / "scenes").glob("*.json"))
REAL_SCENES = os.environ.get("WAVEFRONT_SCENES")
needs_real_scenes = pytest.mark.skipif(not REAL_SCENES, reason="WAVEFRONT_SCENES names no folder of real scenes")
SPP = 32  # of a batch; 32 x 32 pixels then take some hundredths of a second
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


def our_batches(scene: description.Scene, spp: int, seed: int = 1):
    """Means of consecutive samples of one render, which are independent."""
    renderer = Renderer(scene, seed=seed)
    before = np.zeros(1)
    while True:
        renderer.render(spp=spp)
        assert not any(renderer.statistics.nonfinite.values()), renderer.statistics.nonfinite
        total = renderer.film.arrays.L.numpy().copy()  # float64 sums
        yield ((total - before) / spp).reshape(renderer.film.height, renderer.film.width, 3)
        before = total


def their_batches(scene, max_depth: int, spp: int):
    seed = 0
    while True:
        yield peer.render(scene, spp, seed, max_depth)
        seed += 1


def read(path: Path, width: int, height: int, max_depth: int, nee: bool = True) -> description.Scene:
    """Our scene with a film and an integrator as those of the peer."""
    scene = load_scene(path)
    scene.film = description.Film(width=width, height=height)
    scene.integrator = description.PathIntegrator(max_depth=max_depth, rr_depth=None, nee=nee)
    return scene


def compare_xml(
    path: Path,
    size: tuple[int, int],
    max_depth: int = scenes.MAX_DEPTH,
    spp: int = SPP,
    tiles: tuple[int, int] = TILES,
    nee: bool = True,
    **settings,
) -> Comparison:
    """Renders a Mitsuba file with both; `settings` are those of `image_test.compare`."""
    ours = our_batches(read(path, *size, max_depth, nee), spp)
    theirs = their_batches(peer.load_xml(path, *size), max_depth, spp)
    return compare(ours, theirs, tiles, **settings)


def report(name: str, comparison: Comparison) -> None:
    print(f"{name}: {comparison}")  # shown with -s, or when the test fails
    comparison.check()


# --- small scenes ------------------------------------------------------------------------------------------------


def check_small(folder: Path, name: str, text: str, size=(scenes.SIZE, scenes.SIZE), **settings) -> None:
    path = folder / "scene.xml"
    path.write_text(text, encoding="utf-8")
    comparison = compare_xml(path, size, **settings)
    report(name, comparison)
    assert comparison.detectable() < 0.1, "the tiles are too noisy to find anything"


@pytest.mark.parametrize("name", scenes.PLAIN)
def test_plain(folder, name):
    check_small(folder, name, scenes.document(scenes.PLAIN[name], everything=False))


@pytest.mark.parametrize("name", scenes.MIXED)
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
    scene = read(path, *size, scenes.MAX_DEPTH, nee)
    scene.shapes = [shape for shape in scene.shapes if shape.emitter is None]
    sun = description.Sun(direction=scenes.SUN_DIRECTION, angle=scenes.SUN_ANGLE, radiance=list(scenes.SUN_RADIANCE))
    scene.emitters = [sun]
    theirs = their_batches(peer.load_xml(path, *size), scenes.MAX_DEPTH, SPP)
    report("sun", compare(our_batches(scene, SPP), theirs, TILES))


@pytest.mark.parametrize("axis", scenes.CAMERAS)
def test_camera(folder, axis):
    camera, size = scenes.CAMERAS[axis]
    text = scenes.document(scenes.PLAIN["diffuse"], everything=False, camera=camera, size=size)
    check_small(folder, axis, text, size)
