"""Absorbing media: closed forms through the whole renderer, and what may not cost anything where there are none.

Where every path has the same value the image is exact to roundings; elsewhere a z-test compares means, with a false
alarm rate of 1e-4 for each test function.
"""

import msgspec
import numpy as np
import pytest

from tests.test_analytic import ROUNDINGS, check_mean, look_at, step
from wavefront import Renderer
from wavefront.errors import SceneError
from wavefront.integrator import skipped_arrays
from wavefront.queues import Paths, Surfaces
from wavefront.scene import description as d
from wavefront.scene import json_format, load_scene, validate

SIGMA = np.array([0.5, 0.0, 2.0])
TINT = d.Homogeneous(sigma_a=list(SIGMA))
NEEDLE = d.Perspective(fov=1e-3)  # at the origin, along -Z: all rays are alike
GREY = d.Homogeneous(sigma_a=0.7)


def render(shapes, spp=1, camera=NEEDLE, emitters=(), size=4, media=(), seed=1, **integrator):
    settings = {"max_depth": 1000, "rr_depth": None, "nee": False} | integrator
    scene = d.Scene(
        shapes=shapes,
        emitters=list(emitters),
        media=list(media),
        camera=camera,
        film=d.Film(width=size, height=size),
        integrator=d.PathIntegrator(**settings),
    )
    renderer = Renderer(scene, threads=1, seed=seed)
    image = renderer.render(spp).astype(np.float64)
    assert sum(renderer.statistics.nonfinite.values()) == 0
    assert np.isfinite(image).all()
    return image


def at(*position, scale=(1.0, 1.0, 1.0)):
    return [step(scale=scale), step(translate=position)]


def slab(bsdf, thickness, medium, z=-3.0):
    return d.Cube(bsdf=bsdf, interior=medium, to_world=at(0.0, 0.0, z, scale=(1.0, 1.0, 0.5 * thickness)))


def lamp(z=-8.0, radiance=1.0):
    return d.Rectangle(emitter=d.Area(radiance=radiance), bsdf=d.Diffuse(reflectance=0.0), to_world=at(0.0, 0.0, z))


SKY = [d.Constant(radiance=1.0)]

# --- boundaries that bend nothing ------------------------------------------------------------------------------------

OPEN = {
    "null": d.Null(),
    "mask": d.Mask(bsdf=d.Null(), opacity=0.3),
    "thin": d.ThinDielectric(int_ior=1.0, ext_ior=1.0),
    "glass": d.Dielectric(int_ior=1.0, ext_ior=1.0),
}


@pytest.mark.parametrize("bsdf", OPEN)
def test_slab(bsdf):
    """exp(-sigma d) of what is behind, a lamp or the sky; sides of the slab are found from either of its faces."""
    for thickness in (1e-3, 0.4, 3.0):
        image = render([slab(OPEN[bsdf], thickness, TINT)], emitters=SKY)
        np.testing.assert_allclose(image, np.broadcast_to(np.exp(-SIGMA * thickness), image.shape), rtol=ROUNDINGS)


def test_slabs_multiply_and_the_scale_multiplies_the_coefficient():
    scaled = d.Homogeneous(sigma_a=0.25, scale=3.0)
    image = render([slab(d.Null(), 1.0, TINT), slab(d.Null(), 0.5, scaled, z=-5.0), lamp(radiance=2.0)])
    expected = 2.0 * np.exp(-SIGMA - 0.375)
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), rtol=ROUNDINGS)


def test_chords_of_a_sphere():
    """Past the centre at a distance b, the way through is 2 sqrt(r^2 - b^2)."""
    for b in (0.0, 0.3, 0.9, 1.2):
        camera = d.Perspective(fov=1e-5, to_world=look_at((b, 0.0, 4.0), (b, 0.0, 0.0)))
        image = render([d.Sphere(bsdf=d.Null(), interior=TINT)], camera=camera, emitters=SKY)
        expected = np.exp(-SIGMA * 2.0 * np.sqrt(max(1.0 - b * b, 0.0)))
        np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), rtol=2e-5)


def test_nested_media():
    """A ball of one medium in a box of another, which is said by the ball's exterior."""
    shapes = [
        d.Cube(bsdf=d.Null(), interior="thin", to_world=at(0.0, 0.0, -4.0, scale=(2.0, 2.0, 2.0))),
        d.Sphere(bsdf=d.Null(), interior="thick", exterior="thin", center=(0.0, 0.0, -4.0), radius=0.75),
    ]
    media = [d.Homogeneous(name="thin", sigma_a=[0.1, 0.2, 0.3]), d.Homogeneous(name="thick", sigma_a=SIGMA.tolist())]
    image = render(shapes, emitters=SKY, media=media)
    expected = np.exp(-2.5 * np.array([0.1, 0.2, 0.3]) - 1.5 * SIGMA)
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), rtol=ROUNDINGS)


def test_camera_in_a_medium():
    """From the centre of a ball that ends at its surface; without `camera.medium`, the camera is in vacuum there."""
    ball = d.Sphere(bsdf=d.Null(), interior=TINT, radius=1.5)
    wide = d.Perspective(fov=100.0)
    image = render([ball], camera=msgspec.structs.replace(wide, medium=TINT), emitters=SKY)
    np.testing.assert_allclose(image, np.broadcast_to(np.exp(-1.5 * SIGMA), image.shape), rtol=ROUNDINGS)
    np.testing.assert_array_equal(render([ball], camera=wide, emitters=SKY), 1.0)


def test_nothing_comes_from_infinity_through_a_medium():
    """But the channel that is not absorbed; by light sampling and by BSDF sampling, and from a directional light."""
    camera = d.Perspective(fov=1e-3, to_world=look_at((0.0, 1.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), medium=TINT)
    floor = d.Rectangle(
        bsdf=d.Diffuse(reflectance=1.0),
        to_world=[step(rotate=d.Rotate(axis=(1.0, 0.0, 0.0), angle=-90.0)), step(scale=9.0)],
    )
    for nee in (False, True):
        image = render([floor], 256, camera, SKY, nee=nee)
        assert (image[..., [0, 2]] == 0.0).all()
        check_mean(image, 1.0, 2)
    sun = [d.Directional(direction=(0.0, -1.0, 0.0), irradiance=np.pi)]
    image = render([floor], 1, camera, sun, nee=True)
    np.testing.assert_allclose(image, np.broadcast_to([0.0, 1.0, 0.0], image.shape), rtol=ROUNDINGS)


# --- boundaries that reflect -----------------------------------------------------------------------------------------


def test_glass_slab_with_internal_reflection():
    """What passes a plate at normal incidence is (1 - F)^2 a / (1 - F^2 a^2), with a = exp(-sigma d) per crossing, and
    what returns F + (1 - F)^2 F a^2 / (1 - F^2 a^2)."""
    glass = d.Dielectric(int_ior=1.8, ext_ior=1.0)
    fresnel = (0.8 / 2.8) ** 2
    turned = msgspec.structs.replace(lamp(), to_world=facing(2.0))
    for sigma in (0.0, 0.2, 1.5):
        plate = slab(glass, 0.8, d.Homogeneous(sigma_a=sigma))
        a = np.exp(-0.8 * sigma)
        series = (1.0 - fresnel) ** 2 / (1.0 - fresnel**2 * a**2)
        image = render([plate, lamp()], 512, size=16)
        check_mean(image, series * a, 6)
        image = render([plate, lamp(), turned], 512, size=16)
        check_mean(image, series * a + fresnel + series * fresnel * a * a, 6)


def facing(z):
    """Behind the camera, towards -Z."""
    return [step(rotate=d.Rotate(axis=(0.0, 1.0, 0.0), angle=180.0)), step(translate=(0.0, 0.0, z))]


@pytest.mark.parametrize("nee", [True, False])
def test_room_full_of_a_medium(nee):
    """In a diffuse sphere that emits 1, a cosine-distributed chord lets pass q = 2 (1 - (1 + k) exp(-k)) / k^2 with k =
    2 sigma r; so the centre sees exp(-sigma r) / (1 - albedo q). Depth 2 is the first two terms of that series."""
    albedo, radius, sigma = 0.6, 1.3, 0.7
    k = 2.0 * sigma * radius
    q = 2.0 * (1.0 - (1.0 + k) * np.exp(-k)) / k**2
    camera = d.Perspective(fov=80.0, medium=GREY)
    for exterior in (None, GREY):  # the side the normal points to is the inside here
        room = d.Sphere(
            flip_normals=True, radius=radius, bsdf=d.Diffuse(reflectance=albedo), emitter=d.Area(), exterior=exterior
        )
        for depth, expected in ((1, 1.0), (2, 1.0 + albedo * q), (1000, 1.0 / (1.0 - albedo * q))):
            image = render([room], 32, camera, size=16, nee=nee, max_depth=depth, seed=depth)
            check_mean(image, np.exp(-sigma * radius) * expected, 6)


def test_lights_without_extent_in_a_medium():
    """A point light above a floor, all in a medium: both ways are absorbed."""
    camera = d.Perspective(fov=1e-4, to_world=look_at((0.0, 2.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), medium=TINT)
    floor = d.Rectangle(
        bsdf=d.Diffuse(reflectance=0.5), to_world=[step(rotate=d.Rotate(axis=(1.0, 0.0, 0.0), angle=-90.0))]
    )
    image = render([floor], 1, camera, [d.Point(position=(0.0, 1.0, 1.5), intensity=np.pi)], nee=True)
    distance = np.hypot(1.0, 1.5)
    expected = 0.5 / distance**3 * np.exp(-SIGMA * (2.0 + distance))
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), rtol=2e-5)


# --- extremes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.0, 1e-45, 1e-30, 1e10, 3e38])
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e9])
def test_extremes(sigma, size):
    """Any optical depth: finite, and the exponential of it; nothing from the sky but where nothing absorbs."""
    slab = d.Cube(bsdf=d.Null(), interior=d.Homogeneous(sigma_a=[sigma, 0.0, sigma]), to_world=at(scale=(size,) * 3))
    slab.to_world = [step(scale=size), step(translate=(0.0, 0.0, -3.0 * size))]
    image = render([slab], emitters=SKY)
    # Numbers below 1e-38 may be taken as zero.
    depth = 2.0 * size * sigma
    expected = np.exp(-depth) if depth < 700.0 else 0.0
    np.testing.assert_allclose(image[..., 0], expected, rtol=2e-5, atol=1e-38)
    np.testing.assert_array_equal(image[..., 1], 1.0)
    inside = d.Perspective(fov=90.0, medium=slab.interior)
    far = [d.Sphere(center=(0.0, 0.0, 2.0 * size), radius=0.5 * size)]  # behind the camera
    image = render(far, camera=inside, emitters=SKY, nee=True)
    np.testing.assert_array_equal(image[..., 0], 0.0 if sigma > 1e-37 else image[..., 0])
    assert set(np.unique(image[..., 0])) <= {0.0, 1.0}


# --- what it costs, and what is refused ------------------------------------------------------------------------------


def test_no_cost_without_absorption():
    """A medium of no absorption is vacuum: the same features, hence the same kernels and the same memory."""
    plain = d.Scene(shapes=[d.Sphere(bsdf=d.Null())], emitters=SKY)
    clear = d.Scene(shapes=[d.Sphere(bsdf=d.Null(), interior=d.Homogeneous(sigma_a=5.0, scale=0.0))], emitters=SKY)
    tinted = d.Scene(shapes=[d.Sphere(bsdf=d.Null(), interior=TINT)], emitters=SKY)
    a, b, c = (Renderer(scene, threads=1) for scene in (plain, clear, tinted))
    assert a.features == b.features
    assert a.bytes_per_path == b.bytes_per_path == c.bytes_per_path - 12
    assert "medium" in skipped_arrays(a.features)[Paths]
    assert "media" in skipped_arrays(a.features)[Surfaces]
    assert a.kernels.scatter is b.kernels.scatter
    assert a.kernels.scatter is not c.kernels.scatter
    assert a.kernels.generate is c.kernels.generate
    assert not a.device_scene.geometry.sigma_a  # not allocated


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shapes": [{"type": "sphere", "interior": "teh"}]}, "shapes[0].interior: unknown medium 'teh'; did you mean"),
        ({"shapes": [{"type": "sphere", "exterior": 3}]}, "shapes[0].exterior: expected a name"),
        ({"camera": {"medium": "air"}}, "camera.medium: unknown medium 'air'"),
        ({"media": [{"type": "fog"}]}, "media[0].type: unknown type 'fog'; allowed: 'homogeneous'"),
        ({"media": [{"type": "homogeneous", "sigma_s": 1}]}, "media[0]: unknown key 'sigma_s'"),
        ({"media": [{"type": "homogeneous", "sigma_a": -1}]}, "media[0].sigma_a: expected a number >= 0"),
        (
            {"media": [{"type": "homogeneous", "sigma_a": 1e30, "scale": 1e30}]},
            "media[0].sigma_a[0]: expected a number",
        ),
        ({"media": [{"type": "homogeneous", "name": "a"}] * 2}, "media[1].name: the name 'a' is taken"),
    ],
)
def test_bad_media_are_refused(tmp_path, change, message):
    raw = {"media": [{"type": "homogeneous", "name": "tea", "sigma_a": [1, 2, 3]}]} | change
    (tmp_path / "s.json").write_bytes(msgspec.json.encode(raw))
    with pytest.raises(SceneError) as error:
        load_scene(tmp_path / "s.json")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_media_are_written_and_read_back(tmp_path):
    scene = d.Scene(
        media=[d.Homogeneous(name="tea", sigma_a=[1.0, 2.0, 3.0]), d.Homogeneous(name="clear")],
        camera=d.Perspective(medium="tea"),
        shapes=[d.Sphere(interior="tea", exterior=d.Homogeneous(sigma_a=0.5, scale=2.0)), d.Cube(exterior="clear")],
        emitters=SKY,
    )
    assert validate(scene) == []
    json_format.dump(scene, tmp_path / "s.json")
    assert json_format.load(tmp_path / "s.json") == scene
    (tmp_path / "outer.json").write_text('{"include": ["s2.json"]}')
    scene.camera = d.Perspective()
    json_format.dump(scene, tmp_path / "s2.json")
    assert load_scene(tmp_path / "outer.json").media == scene.media
