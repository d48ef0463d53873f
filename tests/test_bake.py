"""Mitsuba's sky as data: what it was evaluated to is what both renderers then have."""

import json

import numpy as np
import pytest

from tests.light.test_envmap import on_sphere, oracle
from tools import bake, convert
from tools.peers import mitsuba as peer
from wavefront import Renderer, load_scene
from wavefront.errors import WavefrontError
from wavefront.scene import description as d
from wavefront.scene.images import load_image

SCENE = """<scene version="0.6.0">
<default name="haze" value="3"/>
<integrator type="path"><integer name="maxDepth" value="2"/></integrator>
<sensor type="perspective"><float name="fov" value="50"/>
  <transform name="toWorld"><lookat origin="0,3,4" target="0,3,0" up="0,1,0"/></transform></sensor>
<shape type="obj"><string name="filename" value="floor.obj"/>
  <bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.5, 0.5"/></bsdf></shape>
<emitter type="sunsky">
  <transform name="toWorld"><rotate x="1" angle="-90"/></transform>
  <float name="turbidity" value="$haze"/><float name="albedo" value="0.15"/>
  <vector name="sunDirection" x="-0.87" y="0.42" z="-0.28"/>
  <float name="skyScale" value="6"/><float name="sunScale" value="0.1"/><float name="sunAperture" value="8"/>
</emitter>
</scene>
"""
ROWS = 256


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bake")
    (folder / "scene.xml").write_text(SCENE)
    (folder / "floor.obj").write_text("v -9 0 9\nv 9 0 9\nv 9 0 -9\nv -9 0 -9\nf 1 2 3\nf 1 3 4\n")
    (folder / "out").mkdir()
    return folder


@pytest.fixture(scope="module")
def baked(folder):
    return bake.bake_sunsky(folder / "scene.xml", folder / "out", rows=ROWS)


@pytest.fixture(scope="module")
def theirs(folder):
    """Radiance of Mitsuba's own emitter from directions."""
    reason = peer.missing("llvm_ad_rgb")
    if reason is not None:
        pytest.skip(reason)
    mi = peer.use_variant("llvm_ad_rgb")
    emitter = bake._load(mi, folder / "scene.xml", {})

    def radiance(w):
        mi.set_variant("llvm_ad_rgb")
        return bake._evaluate(mi, emitter, w)

    return radiance


def ours(baked, w):
    """Radiance of the baked map and disc, by their definitions."""
    matrix = np.array(baked.sky.to_world)[:3, :3]
    L = oracle(load_image(baked.sky.file), w @ matrix)
    cosine = np.cos(np.radians(baked.sun.angle))
    to_sun = -np.array(baked.sun.direction)
    inside = w @ to_sun / np.linalg.norm(to_sun) >= cosine
    return L + inside[:, None] * np.array(baked.sun.radiance)


def test_radiance(baked, theirs):
    """Everywhere but at the horizon and at the rim of the sun, in whose disc Mitsuba's darkens towards the rim."""
    w = on_sphere(*np.random.default_rng(1).random((2, 200_000)))
    a, b = ours(baked, w), theirs(w)
    horizon = np.abs(w[:, 1]) < np.sin(2 * np.pi / ROWS)
    from_sun = np.degrees(np.arccos(np.clip(w @ -np.array(baked.sun.direction), -1, 1)))
    sky = ~horizon & (from_sun > 4.1)
    np.testing.assert_allclose(a[sky], b[sky], rtol=2e-2, atol=1e-6)
    assert np.abs(a[sky] - b[sky]).sum() < 5e-4 * b[sky].sum()
    assert (a[w[:, 1] < -0.02] == 0.0).all()
    disc = from_sun < 3.9
    assert disc.sum() > 100
    np.testing.assert_allclose(a[disc].mean(axis=0), b[disc].mean(axis=0), rtol=0.05)
    assert baked.sun.angle == pytest.approx(4.0, abs=0.01)


@pytest.mark.parametrize("normal", [(0.0, 1.0, 0.0), (-0.87, 0.42, -0.28), (0.0, 0.0, 1.0), (1.0, 0.2, 0.0)])
def test_irradiance(baked, theirs, normal):
    """Of all the light, on surfaces that face the zenith, the sun, and away from it, by 2 million directions."""
    n = np.array(normal) / np.linalg.norm(normal)
    y, x = np.meshgrid((np.arange(1000) + 0.5) / 1000, (np.arange(2000) + 0.5) / 2000)
    w = on_sphere(x.ravel(), y.ravel())
    cosine = np.maximum(w @ n, 0.0)[:, None]
    a, b = ((f * cosine).mean(axis=0) for f in (ours(baked, w), theirs(w)))
    np.testing.assert_allclose(a, b, rtol=3e-3)


def test_both_renderers_see_the_same_baked_light(folder, baked, theirs):
    """Ours of the records and Mitsuba of the rewritten XML, z-test of the mean; false-alarm rate 1e-4.

    And Mitsuba's own sky gives that light too, up to what the disc's limb and the map's rows take: 1 %."""
    path = bake.baked_xml(folder / "scene.xml", baked, folder / "out" / "baked.xml")
    scene = bake.replace_records(load_scene(folder / "scene.xml", warn=lambda text: None), baked)
    scene.film.width = scene.film.height = 16
    scene.film.filter = d.BoxFilter()
    scene.integrator.rr_depth = None
    image = Renderer(scene, threads=1, seed=5).render(1024).astype(np.float64)
    peer.use_variant("llvm_ad_rgb")
    others = [peer.render(peer.load_xml(file, 16, 16), 1024, max_depth=2) for file in (path, folder / "scene.xml")]
    # The floor is evenly lit, so its pixels differ by noise alone; the upper rows see the sky.
    floor = [x[13:].reshape(-1, 3) for x in (image, *others)]
    means = [x.mean() for x in floor]
    errors = [x.mean(axis=1).std() / np.sqrt(len(x)) for x in floor]
    assert abs(means[0] - means[1]) < 3.89 * np.hypot(errors[0], errors[1])
    assert max(errors[:2]) < 2.5e-3 * means[0]  # so that 1.4 % would be seen
    assert means[1] == pytest.approx(means[2], rel=1e-2)
    for other in others:  # places in a pixel are random, and the sky differs by a tenth across one
        np.testing.assert_allclose(image[:7], other[:7], rtol=1e-2)
        np.testing.assert_allclose(image[:7].mean(axis=(0, 1)), other[:7].mean(axis=(0, 1)), rtol=1e-3)


def test_parts_that_are_off(folder, tmp_path):
    for off, name in (("skyScale", "sky"), ("sunScale", "sun")):
        text = SCENE.replace(f'name="{off}" value="6"', f'name="{off}" value="0"')
        (tmp_path / "scene.xml").write_text(text.replace(f'name="{off}" value="0.1"', f'name="{off}" value="0"'))
        found = bake.bake_sunsky(tmp_path / "scene.xml", tmp_path, rows=16)
        assert getattr(found, name) is None
        assert getattr(found, {"sky": "sun", "sun": "sky"}[name]) is not None


def test_convert(folder, tmp_path, capsys):
    out = tmp_path / "room.json"
    assert convert.main([str(folder / "scene.xml"), str(out), "--bake-emitters", "-D", "haze=5"]) == 0
    assert "our own sky" not in capsys.readouterr().err
    scene = load_scene(out)
    sky, sun = scene.emitters
    assert sky.file == str(tmp_path / "room_textures" / "sunsky.exr")
    assert load_image(sky.file).shape == (bake.ROWS, 2 * bake.ROWS, 3)
    assert isinstance(sun, d.Sun)
    plain = tmp_path / "plain.json"
    assert convert.main([str(folder / "scene.xml"), str(plain), "-D", "haze=5"]) == 0
    assert "our own sky" in capsys.readouterr().err
    (own,) = load_scene(plain).emitters
    assert own == d.SunSky(
        direction=own.direction, up=own.up, turbidity=5.0, sky_scale=6.0, sun_scale=0.1, sun_angle=4.0
    )
    assert json.loads(plain.read_text())["emitters"][0]["type"] == "sunsky"


@pytest.mark.parametrize(
    ("change", "arguments", "words"),
    [
        (('type="sunsky"', 'type="constant"'), [], "needs one emitter 'sunsky'"),
        (('name="turbidity"', 'name="turbidities"'), [], "turbidities"),
        ((' value="8"', ' value="0"'), [], "aperture"),
    ],
)
def test_errors_are_one_line_and_leave_nothing(folder, tmp_path, capsys, change, arguments, words):
    (tmp_path / "floor.obj").write_text((folder / "floor.obj").read_text())
    text = SCENE.replace(*change)
    if "constant" in change[1]:
        text = text[: text.index('  <transform name="toWorld"><rotate')] + "</emitter></scene>"
    (tmp_path / "scene.xml").write_text(text)
    out = tmp_path / "out.json"
    assert convert.main([str(tmp_path / "scene.xml"), str(out), "--bake-emitters", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["floor.obj", "scene.xml"]


def test_what_baking_needs(folder, tmp_path, capsys, monkeypatch):
    (tmp_path / "scene.json").write_text("{}")
    assert convert.main([str(tmp_path / "scene.json"), str(tmp_path / "out.json"), "--bake-emitters"]) == 2
    assert "--bake-emitters needs a Mitsuba scene" in capsys.readouterr().err
    monkeypatch.setitem(__import__("sys").modules, "mitsuba", None)
    with pytest.raises(WavefrontError, match=r"pip install '\.\[mitsuba\]'"):
        bake.bake_sunsky(folder / "scene.xml", tmp_path)
