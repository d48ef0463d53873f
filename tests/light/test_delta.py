"""Lights without extent and the sun: what they give to a surface, in closed form."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

from tests.chi_square import FALSE_ALARM_RATE, histogram, p_value, sidak
from wavefront import Renderer
from wavefront.light.sun import in_sun, sample_sun
from wavefront.light.tables import DistantRecord
from wavefront.scene import description as d
from wavefront.scene.device import upload_scene

ALBEDO = 0.6
UP = [d.TransformStep(scale=20.0), d.TransformStep(rotate=d.Rotate(axis=(1, 0, 0), angle=-90.0))]


def looking_at_the_origin(*emitters, nee=True, shapes=()):
    """The floor y = 0, of which the camera sees a speck at the origin from above."""
    look = d.LookAt(origin=(0.0, 2.0, 0.0), target=(0.0, 0.0, 0.0), up=(0.0, 0.0, -1.0))
    return d.Scene(
        shapes=[d.Rectangle(to_world=UP, bsdf=d.Diffuse(reflectance=ALBEDO)), *shapes],
        camera=d.Perspective(fov=0.01, to_world=[d.TransformStep(look_at=look)]),
        film=d.Film(width=8, height=8),
        emitters=list(emitters),
        integrator=d.PathIntegrator(max_depth=2, nee=nee, rr_depth=None),
    )


def irradiance(scene, spp=1):
    """What the speck receives, by pixel: a diffuse surface sends albedo / pi of it to the camera."""
    return Renderer(scene, seed=2).render(spp).astype(np.float64) * np.pi / ALBEDO


POSITIONS = [(0.0, 1.0, 0.0), (1.0, 2.0, 3.0), (-4.0, 0.5, 0.1), (0.0, 1e3, -1e3)]


@pytest.mark.parametrize("position", POSITIONS)
def test_point(position):
    """I cos / d^2, exactly: one light, one sample, no noise. 1e-4 for the size of the speck."""
    image = irradiance(looking_at_the_origin(d.Point(position=position, intensity=[2.0, 4.0, 0.0])))
    distance = np.linalg.norm(position)
    np.testing.assert_allclose(
        image, np.broadcast_to((2.0, 4.0, 0.0), image.shape) * position[1] / distance**3, rtol=1e-3
    )


@pytest.mark.parametrize("degrees", [0.0, 5.0, 11.9, 12.1, 18.0, 29.0, 30.5, 60.0])
def test_spot(degrees):
    """The point light's irradiance times a ramp from 1 at 12 to 0 at 30 degrees from the axis, which turns."""
    axis = np.radians(degrees)
    spot = d.Spot(
        position=(0.0, 3.0, 0.0),
        direction=(np.sin(axis), -np.cos(axis), 0.0),
        intensity=9.0,
        cutoff_angle=30.0,
        beam_width=12.0,
    )
    expected = np.clip((30.0 - degrees) / 18.0, 0.0, 1.0)
    np.testing.assert_allclose(irradiance(looking_at_the_origin(spot)), expected, atol=1e-3)


def test_beam_width_defaults_to_three_quarters_and_may_be_the_cutoff():
    tilted = {"position": (0.0, 1.0, 0.0), "direction": (np.tan(np.radians(35.0)), -1.0, 0.0), "cutoff_angle": 40.0}
    np.testing.assert_allclose(irradiance(looking_at_the_origin(d.Spot(**tilted))), 0.5, atol=1e-3)
    np.testing.assert_allclose(irradiance(looking_at_the_origin(d.Spot(**tilted, beam_width=40.0))), 1.0, atol=1e-3)


@pytest.mark.parametrize("direction", [(0.0, -1.0, 0.0), (3.0, -1.0, 2.0), (0.0, -0.5, 1.0)])
def test_directional(direction):
    image = irradiance(looking_at_the_origin(d.Directional(direction=direction, irradiance=[1.0, 2.0, 3.0])))
    cosine = -direction[1] / np.linalg.norm(direction)
    np.testing.assert_allclose(image, np.broadcast_to((1.0, 2.0, 3.0), image.shape) * cosine, rtol=1e-5)


def test_from_below_and_behind_an_occluder_there_is_no_light():
    roof = d.Rectangle(to_world=[*UP, d.TransformStep(translate=(0.0, 1.5, 5.0 + 20.0))])
    lights = [
        d.Directional(direction=(0.0, 1.0, 0.0)),
        d.Point(position=(0.0, -1.0, 0.0)),
        d.Spot(position=(0.0, -1.0, 0.0), direction=(0.0, 1.0, 0.0)),
    ]
    assert (irradiance(looking_at_the_origin(*lights), spp=8) == 0.0).all()
    blocked = [d.Point(position=(0.0, 2.5, 20.0)), d.Directional(direction=(0.0, -1.0, -12.0))]
    scene = looking_at_the_origin(*blocked, shapes=[roof])
    assert (irradiance(scene, spp=8) == 0.0).all()
    scene.shapes = scene.shapes[:1]
    assert (irradiance(scene, spp=8) > 0.0).any()


def test_light_between_occluders():
    """A shadow ray to a point light ends there: what lies beyond it casts no shadow."""
    roof = d.Rectangle(to_world=[*UP, d.TransformStep(translate=(30.0, 1.5, 0.0))])
    scene = looking_at_the_origin(d.Point(position=(15.0, 1.0, 0.0), intensity=226.0), shapes=[roof])
    np.testing.assert_allclose(irradiance(scene), 226.0 / 226.0**1.5, rtol=1e-3)


@pytest.mark.parametrize("nee", [True, False])
def test_without_light_sampling_they_add_nothing(nee):
    scene = looking_at_the_origin(d.Point(position=(0.0, 1.0, 0.0)), nee=nee)
    assert (irradiance(scene).max() > 0.0) == nee


def test_many_lights_of_different_power():
    """z-test of the mean against the sum in closed form; false-alarm rate 1e-4. The weights are bounded."""
    lights = [d.Point(position=(x, 1.0 + 0.3 * x, 0.2), intensity=0.5 + x) for x in (0.0, 1.0, 2.0)]
    lights += [d.Directional(direction=(0.2, -1.0, 0.1), irradiance=0.01)]
    lights += [d.Spot(position=(0.0, 2.0, 1.0), direction=(0.0, -2.0, -1.0), intensity=2.0)]
    expected = sum(
        light.intensity * light.position[1] / np.linalg.norm(light.position) ** 3
        for light in lights
        if not isinstance(light, d.Directional)
    )
    expected += 0.01 / np.sqrt(1.05)
    values = irradiance(looking_at_the_origin(*lights), spp=256)[:, :, 0]
    assert abs(values.mean() - expected) < stats.norm.isf(0.5 * FALSE_ALARM_RATE) * values.std() / 8.0


# --- sun ---------------------------------------------------------------------------------------------------------

SUNS = {
    "small": (0.2665, (0.5, -1.0, 0.3)),
    "wide": (25.0, (0.0, -1.0, 0.2)),
    "half of the sky": (90.0, (0.0, -1.0, 0.0)),
}


@pytest.mark.parametrize(("name", "nee"), [(n, nee) for n in SUNS for nee in (True, False) if nee or n != "small"])
def test_sun(name, nee):
    """E cos, since the projected solid angle of a cone above the horizon is pi sin^2(angle) cos(tilt): z-test of the
    mean, false-alarm rate 1e-4 over the cases. One ray in 50000 finds the small one: light sampling only."""
    angle, direction = SUNS[name]
    values = irradiance(
        looking_at_the_origin(d.Sun(direction=direction, angle=angle, irradiance=2.0), nee=nee), spp=256
    )
    expected = -2.0 * direction[1] / np.linalg.norm(direction)
    error = max(values[:, :, 0].std() / 8.0, 1e-5)
    assert abs(values[:, :, 0].mean() - expected) < stats.norm.isf(0.5 * sidak(5)) * error


def test_radiance_of_the_disc_is_seen():
    """Rays that escape into the disc see its radiance, and beside it nothing."""
    sun = d.Sun(direction=(0.0, -1.0, 0.0), angle=10.0, radiance=[1.0, 2.0, 3.0])
    for degrees, seen in ((0.0, 1.0), (9.9, 1.0), (10.1, 0.0), (170.0, 0.0)):
        scene = looking_at_the_origin(sun)
        a = np.radians(degrees)
        look = d.LookAt(origin=(0.0, 2.0, 0.0), target=(np.sin(a), 2.0 + np.cos(a), 0.0), up=(0.0, 0.0, 1.0))
        scene.camera.to_world = [d.TransformStep(look_at=look)]
        scene.shapes = [d.Sphere(center=(0.0, 2.0, 900.0), bsdf=d.Diffuse())]
        np.testing.assert_array_equal(Renderer(scene).render(1), np.full((8, 8, 3), (1.0, 2.0, 3.0)) * seen)


@wp.kernel(enable_backward=False, module="unique")
def sun_kernel(
    suns: wp.array(dtype=DistantRecord),
    u: wp.array(dtype=wp.vec2),
    # outputs
    w: wp.array(dtype=wp.vec3),
    inside: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    w[i] = sample_sun(suns[0], u[i])
    if in_sun(suns[0], w[i]):
        inside[i] = 1


@pytest.mark.parametrize("name", SUNS)
def test_sun_directions_are_uniform(name):
    """Chi-square over 1 - cos and the angle around the axis; false-alarm rate 1e-4 over the cases. A sampled direction
    is one that an escaped ray finds, but for roundings at the rim."""
    angle, direction = SUNS[name]
    n = 100_000
    suns = upload_scene(
        d.Scene(shapes=[d.Cube()], emitters=[d.Sun(direction=direction, angle=angle)]), "cpu"
    ).lights.distant
    u = wp.array((np.random.default_rng(3).integers(0, 2**24, (n, 2)) / 2.0**24).astype(np.float32), dtype=wp.vec2)
    w, inside = wp.zeros(n, dtype=wp.vec3, device="cpu"), wp.zeros(n, dtype=wp.int32, device="cpu")
    wp.launch(sun_kernel, dim=n, inputs=[suns, u], outputs=[w, inside], device="cpu")
    w = w.numpy().astype(np.float64)
    axis = -np.asarray(direction) / np.linalg.norm(direction)
    s = np.cross(axis, (0.48, 0.6, 0.64))
    s /= np.linalg.norm(s)
    h = 0.5 * np.sum((w - axis) ** 2, axis=1) / (2.0 * np.sin(np.radians(angle / 2.0)) ** 2)
    around = np.arctan2(w @ np.cross(axis, s), w @ s) / (2.0 * np.pi) + 0.5
    counts = histogram(np.minimum(h, 1.0), np.clip(around, 0.0, 1.0), (8, 8))
    assert p_value(counts, np.full(64, 1 / 64)) > sidak(len(SUNS))
    assert h.max() < 1.001
    assert inside.numpy().mean() > 0.999


# --- area lights -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("nee", [True, False])
@pytest.mark.parametrize("front", [True, False])
def test_a_two_sided_lamp_shines_from_its_back(front, nee):
    """A square lamp of half width 1 at height 1, of which E / L is known (the configuration factor of a rectangle seen
    from below its middle, Howell C-11): z-test of the mean, false-alarm rate 1e-4 over the cases."""
    turn = [] if front else [d.TransformStep(rotate=d.Rotate(axis=(1, 0, 0), angle=180.0))]
    down = [*turn, d.TransformStep(rotate=d.Rotate(axis=(1, 0, 0), angle=90.0))]
    lamp = d.Rectangle(
        to_world=[*down, d.TransformStep(translate=(0.0, 1.0, 0.0))],
        emitter=d.Area(radiance=1.0, two_sided=True),
        bsdf=d.Diffuse(reflectance=0.0),
    )
    scene = looking_at_the_origin(nee=nee, shapes=[lamp])
    look = d.LookAt(origin=(0.0, 0.5, 0.0), target=(0.0, 0.0, 0.0), up=(0.0, 0.0, -1.0))
    scene.camera.to_world = [d.TransformStep(look_at=look)]
    values = irradiance(scene, spp=256)[:, :, 0]
    a = 1.0 / np.sqrt(2.0)
    expected = 4.0 * 0.5 * (a * np.arctan(a) + a * np.arctan(a))
    assert abs(values.mean() - expected) < stats.norm.isf(0.5 * sidak(4)) * values.std() / 8.0
