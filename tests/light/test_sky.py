"""The sky and the sun: the paper's formulas by another way, Mitsuba's sky for plausibility, and the bake."""

import datetime

import mitsuba as mi
import numpy as np
import pytest

from tests.light.test_envmap import evaluate, on_sphere
from wavefront import Renderer
from wavefront.errors import SceneError
from wavefront.light.sky import _SOLAR, EFFICACY, bake_sky, sky_radiance, sun_position, sun_radiance
from wavefront.scene import description as d
from wavefront.scene.device import upload_scene
from wavefront.scene.images import write_exr
from wavefront.scene.light_upload import baked_sky, sun_disc
from wavefront.scene.validate import validate

LUMINANCE = np.array((0.212671, 0.715160, 0.072169))
TO_XYZ = np.array(
    [(0.4124564, 0.3575761, 0.1804375), (0.2126729, 0.7151522, 0.0721750), (0.0193339, 0.1191920, 0.9503041)]
)
DOWN = (0.3, -1.0, 0.2)


def towards(elevation, azimuth=0.0):
    """With the zenith +Z."""
    e, a = np.radians(elevation), np.radians(azimuth)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def radiance(w, turbidity, sun):
    w = np.atleast_2d(w)
    return sky_radiance(w[:, 2], w @ sun, turbidity, np.arccos(sun[2]))


# --- the sky -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turbidity", [2.0, 3.0, 6.0])
@pytest.mark.parametrize("elevation", [10.0, 45.0, 80.0])
def test_zenith_is_that_of_the_paper(turbidity, elevation):
    """Luminance and chromaticities at the zenith (appendix A.2), written out once more."""
    t, s = turbidity, np.radians(90.0 - elevation)
    kcd = (4.0453 * t - 4.9710) * np.tan((4 / 9 - t / 120) * (np.pi - 2 * s)) - 0.2155 * t + 2.4192
    x = np.polyval([0.00166 * t * t - 0.02903 * t + 0.11693, -0.00375 * t * t + 0.06377 * t - 0.21196], s) * s * s
    x += (0.00209 * t * t - 0.03202 * t + 0.06052) * s + 0.00394 * t + 0.25886
    y = np.polyval([0.00275 * t * t - 0.04214 * t + 0.15346, -0.00610 * t * t + 0.08970 * t - 0.26756], s) * s * s
    y += (0.00317 * t * t - 0.04153 * t + 0.06670) * s + 0.00516 * t + 0.26688
    X, Y, Z = TO_XYZ @ radiance((0.0, 0.0, 1.0), t, towards(elevation))[0]
    assert pytest.approx(kcd, rel=1e-4) == Y * 683.002 * 106.857 / 1000.0
    assert pytest.approx((x, y), rel=1e-4) == (X / (X + Y + Z), Y / (X + Y + Z))


def test_perez_at_a_known_place():
    """Turbidity 3, sun and view at 60 degrees from the zenith, 90 degrees of azimuth apart, so cos(gamma) = 1/4."""
    coefficients = {  # A to E, by hand from the table of the paper
        "Y": (-0.9269, -0.6387, 5.2570, -2.2153, 0.1693),
        "x": (-0.3171, -0.1987, 0.2113, -1.0912, 0.0353),
        "y": (-0.3109, -0.2758, 0.1865, -1.7860, 0.0202),
    }
    sun = towards(30.0)
    values = {}
    for where, w in (("zenith", (0.0, 0.0, 1.0)), ("there", towards(30.0, 90.0))):
        X, Y, Z = TO_XYZ @ radiance(w, 3.0, sun)[0]
        values[where] = {"Y": Y, "x": X / (X + Y + Z), "y": Y / (X + Y + Z)}
    for name, (a, b, c, d_, e) in coefficients.items():
        f = (1 + a * np.exp(b / 0.5)) * (1 + c * np.exp(d_ * np.arccos(0.25)) + e * 0.0625)
        z = (1 + a * np.exp(b)) * (1 + c * np.exp(d_ * np.pi / 3) + e * 0.25)
        assert values["there"][name] / values["zenith"][name] == pytest.approx(f / z, rel=1e-4)


def test_the_whole_range_is_finite_positive_and_symmetric():
    w = on_sphere(*np.random.default_rng(1).random((2, 20_000)))
    w[:, 2] = np.abs(w[:, 2])
    for turbidity in np.linspace(2.0, 10.0, 9):
        for elevation in (1e-6, 0.1, 5.0, 30.0, 60.0, 90.0):
            sun = towards(elevation)
            L = radiance(w, turbidity, sun)
            assert np.isfinite(L).all()
            assert (L >= 0.0).all()
            assert L.max() < 50.0
            np.testing.assert_allclose(L, radiance(w * (1, -1, 1), turbidity, sun), rtol=1e-9)
            assert np.isfinite(sun_radiance(turbidity, np.pi / 2 - np.radians(elevation))).all()


def mitsubas(elevation, turbidity, **scales):
    mi.set_variant("scalar_rgb")
    fields = {"turbidity": turbidity, "sun_direction": towards(elevation).tolist(), "albedo": 0.15, **scales}
    return mi.load_dict({"type": "sunsky", **fields})


def peer_radiance(emitter, directions):
    si, found = mi.SurfaceInteraction3f(), []
    for w in directions:
        si.wi = mi.Vector3f(*(-w).tolist())
        found.append(np.array(emitter.eval(si)).ravel())
    return np.array(found)


@pytest.mark.parametrize(("turbidity", "elevation"), [(3.0, 25.0), (3.0, 45.0), (3.0, 70.0), (5.0, 25.0), (8.0, 25.0)])
def test_the_sky_is_as_bright_and_as_blue_as_mitsubas(turbidity, elevation):
    """Another model: within what is known of how the two differ. Mean luminance, and the share of blue in it."""
    w = on_sphere(*np.random.default_rng(2).random((2, 3000)))
    w[:, 2] = np.abs(w[:, 2])
    theirs = peer_radiance(mitsubas(elevation, turbidity, sun_scale=0.0), w).mean(axis=0)
    ours = radiance(w, turbidity, towards(elevation)).mean(axis=0)
    assert 0.9 < ours @ LUMINANCE / (theirs @ LUMINANCE) < 1.6
    assert 0.75 < (ours[2] / ours.sum()) / (theirs[2] / theirs.sum()) < 1.25


# --- the sun -----------------------------------------------------------------------------------------------------


def test_the_sun_outside_the_atmosphere():
    """Illuminance of the table: 120 to 135 klx at the mean distance of the earth."""
    efficiency = np.array(mi_efficiency(np.arange(380.0, 751.0, 10.0)))
    klx = 683.002 * (efficiency @ _SOLAR) * 10.0 * np.pi * np.sin(np.radians(0.2665)) ** 2 / 1000.0
    assert 120.0 < klx < 135.0


def mi_efficiency(wavelengths):
    mi.set_variant("scalar_rgb")
    return [mi.cie1931_xyz(float(x))[1] for x in wavelengths]


@pytest.mark.parametrize(("turbidity", "elevation"), [(2.0, 30.0), (2.0, 60.0), (3.0, 60.0)])
def test_the_sun_is_as_bright_as_mitsubas(turbidity, elevation):
    theirs = peer_radiance(mitsubas(elevation, turbidity, sky_scale=0.0), disc(towards(elevation)))
    ours = sun_radiance(turbidity, np.radians(90.0 - elevation))
    assert ours @ LUMINANCE == pytest.approx(theirs.mean(axis=0) @ LUMINANCE, rel=0.15)
    assert ours[0] > ours[1] > ours[2]


def disc(axis):
    rng = np.random.default_rng(3)
    s = np.cross(axis, (0.0, 1.0, 0.0))
    s /= np.linalg.norm(s)
    t = np.cross(axis, s)
    r, phi = np.sin(np.radians(0.2665)) * np.sqrt(rng.random(400)), 2 * np.pi * rng.random(400)
    w = axis + r[:, None] * (
        np.cos(phi)[:, None] * s / np.linalg.norm(s) + np.sin(phi)[:, None] * t / np.linalg.norm(t)
    )
    return w / np.linalg.norm(w, axis=1, keepdims=True)


def test_haze_and_a_longer_way_dim_and_redden_the_sun():
    for a, b in ((sun_radiance(3.0, 0.5), sun_radiance(5.0, 0.5)), (sun_radiance(3.0, 0.5), sun_radiance(3.0, 1.2))):
        assert (b < a).all()
        assert b[2] / b[0] < a[2] / a[0]


def test_a_larger_disc_gives_the_same_light():
    small, large = (sun_disc(d.SunSky(direction=DOWN, sun_angle=angle)) for angle in (0.2665, 5.0))
    assert small.irradiance == large.irradiance
    cosine = 1.0 / np.linalg.norm(DOWN)
    projected = np.pi * np.sin(np.radians(0.2665)) ** 2
    np.testing.assert_allclose(small.irradiance, sun_radiance(3.0, np.arccos(cosine)) * projected, rtol=1e-12)


@pytest.mark.parametrize("month", [1, 4, 7, 10])
@pytest.mark.parametrize("hour", [7.5, 12.0, 16.25])
@pytest.mark.parametrize("place", [(35.6894, 139.6917, 9.0), (-33.9, 18.4, 2.0), (51.5, 0.0, 0.0)])
def test_position_of_the_sun(month, hour, place):
    """Mitsuba's (Blanco-Muriel et al. 2001; +X south, +Y west) within 0.05 degrees: other formulas, and a parallax."""
    mi.set_variant("scalar_rgb")
    fields = dict(zip(("latitude", "longitude", "timezone"), place, strict=True))
    when = {"year": 2024, "month": month, "day": 9, "hour": hour}
    theirs = np.array(mi.traverse(mi.load_dict({"type": "sunsky", **fields, **when}))["sun_direction"]).ravel()
    minutes = round(hour * 60)
    ours = sun_position(datetime.datetime(2024, month, 9, minutes // 60, minutes % 60), *place)
    south, west, up = theirs / np.linalg.norm(theirs)
    assert ours @ (-west, -south, up) > np.cos(np.radians(0.05))


# --- the bake ----------------------------------------------------------------------------------------------------


def turned(vector):
    """From a zenith of +Z to the one of `emitter_of`."""
    return np.asarray(vector) @ AXES.T


AXES = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]


def emitter_of(elevation=35.0, **fields):
    sun = turned(towards(elevation, 50.0))
    return d.SunSky(direction=tuple(-sun * 2.0), up=tuple(AXES[:, 2] * 3.0), **fields)


def test_the_map_is_the_sky():
    """Looked up on the device, in any orientation: the formula between the pixels, and black below the horizon."""
    env = upload_scene(d.Scene(emitters=[emitter_of(sky_scale=2.0, turbidity=4.0)]), "cpu").lights.envmap
    w = on_sphere(*np.random.default_rng(5).random((2, 50_000)))
    L, _ = evaluate(env, turned(w))
    row = np.pi / 255.0
    above, below = w[:, 2] > np.sin(2.0 * row), w[:, 2] < -np.sin(row)
    assert (L[below] == 0.0).all()
    expected = 2.0 * radiance(w[above], 4.0, towards(35.0, 50.0))
    assert np.abs(L[above] / expected - 1.0).max() < 0.03  # at the horizon, where the sky changes fast
    assert np.abs(L[above] / expected - 1.0).mean() < 1e-3


def test_irradiance_of_the_map():
    """On the ground and on a wall: within 0.5 % of the formula's integral, the ramp at the horizon included."""
    sun = towards(35.0, 50.0)
    z, phi = np.meshgrid((np.arange(1000) + 0.5) / 1000, 2 * np.pi * (np.arange(1000) + 0.5) / 1000)
    r = np.sqrt(1 - z**2)
    w = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1).reshape(-1, 3)
    L = radiance(w, 3.0, sun)
    pixels, to_world = bake_sky(3.0, sun, np.array([0.0, 0.0, 1.0]), 256)
    theta, phi = np.linspace(0, np.pi, 256)[:, None], np.pi * (np.arange(512) + 0.5) / 256
    local = np.stack(
        np.broadcast_arrays(np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)), axis=-1
    )
    weights = np.sin(theta) * (np.pi / 255) * (np.pi / 256)
    for normal in ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)):
        exact = 2 * np.pi * (L * np.maximum(w @ normal, 0.0)[:, None]).mean(axis=0)
        cosine = np.maximum(local @ to_world.T @ normal, 0.0) * weights
        np.testing.assert_allclose((pixels * cosine[:, :, None]).sum(axis=(0, 1)), exact, rtol=5e-3)


def floor_scene(*emitters):
    floor = d.Rectangle(to_world=[d.TransformStep(rotate=d.Rotate(axis=(1.0, 0.0, 0.0), angle=-90.0))])
    camera = d.Perspective(to_world=[d.TransformStep(look_at=d.LookAt(origin=(0.0, 2.0, 4.0), target=(0.0, 0.0, 0.0)))])
    return d.Scene(shapes=[floor], camera=camera, emitters=list(emitters), film=d.Film(width=24, height=16))


def test_a_sky_is_its_map_and_its_sun(tmp_path):
    """Bit for bit: by hand as an image and a disc."""
    sky = d.SunSky(direction=DOWN, sun_angle=4.0, sky_scale=1.5, sun_scale=0.5, resolution=64)
    pixels, to_world = baked_sky(sky)
    write_exr(tmp_path / "sky.exr", dict(zip("RGB", np.moveaxis(pixels, 2, 0), strict=True)))
    matrix = np.eye(4)
    matrix[:3, :3] = to_world
    envmap = d.Envmap(file=str(tmp_path / "sky.exr"), scale=1.5, to_world=[tuple(row) for row in matrix.tolist()])
    images = [Renderer(floor_scene(*e), threads=1).render(8) for e in ((sky,), (envmap, sun_disc(sky)))]
    np.testing.assert_array_equal(*images)
    assert images[0][8:].mean() > 0.0


def test_parts_that_are_not_there_are_not_compiled():
    kinds = {
        (1.0, 1.0): ("envmap_floats", "sun"),
        (0.0, 1.0): ("sun",),
        (1.0, 0.0): ("envmap_floats",),
    }
    for (sky, sun), expected in kinds.items():
        scene = d.Scene(emitters=[d.SunSky(direction=DOWN, sky_scale=sky, sun_scale=sun)])
        assert upload_scene(scene, "cpu").light_kinds == expected


@pytest.mark.parametrize(
    ("emitters", "message"),
    [
        (
            [d.SunSky(direction=(0.0, 0.1, 1.0))],
            r"emitters\[0\]\.direction: .* the sun -5\.7 degrees above",
        ),
        ([d.SunSky(direction=(1.0, 0.0, 0.0))], r"the sun -?0\.0 degrees above the horizon"),
        ([d.SunSky(direction=(0.0, 0.0, 0.0))], r"emitters\[0\]\.direction: the direction is zero"),
        ([d.SunSky(direction=DOWN, up=(0.0, 0.0, 0.0))], r"emitters\[0\]\.up: the direction is zero"),
        ([d.Constant(), d.SunSky(direction=DOWN)], r"emitters\[1\]: a scene has at most one environment"),
    ],
)
def test_skies_that_make_no_sense(emitters, message):
    with pytest.raises(SceneError, match=message):
        validate(d.Scene(emitters=emitters))


def test_a_sun_alone_goes_with_an_environment():
    validate(d.Scene(emitters=[d.Constant(), d.SunSky(direction=DOWN, sky_scale=0.0)]))


def test_efficacy():
    """cd / m^2 of a radiance of 1 W / (m^2 sr nm): 683 lm / W times the integral of the efficiency."""
    total = sum(mi_efficiency(np.arange(360.0, 831.0, 5.0))) * 5.0
    assert pytest.approx(683.002 * total, rel=1e-4) == EFFICACY
