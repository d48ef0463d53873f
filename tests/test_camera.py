"""Cameras: rays against Mitsuba and against geometry, and the blur of a lens against its circle of confusion."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from wavefront import Renderer
from wavefront.camera import Camera, camera_kind, make_camera, make_camera_ray
from wavefront.scene import description as d
from wavefront.scene import mitsuba
from wavefront.scene.transforms import to_matrix

KERNELS = {}


def kernel_of(kind):
    if kind not in KERNELS:
        camera_ray = make_camera_ray(kind)

        @wp.kernel(enable_backward=False, module="unique")
        def rays(
            camera: Camera,
            position: wp.array(dtype=wp.vec2),
            u: wp.array(dtype=wp.vec2),
            # out
            origin: wp.array(dtype=wp.vec3),
            direction: wp.array(dtype=wp.vec3),
        ):
            i = wp.tid()
            ray = camera_ray(camera, position[i][0], position[i][1], u[i])
            origin[i] = ray.origin
            direction[i] = ray.direction

        KERNELS[kind] = rays
    return KERNELS[kind]


def trace(camera, film, positions, u=(0.5, 0.5)):
    """Origins and directions through film positions in pixels, float64 [N, 3]."""
    positions = np.asarray(positions, np.float32)
    u = np.broadcast_to(np.asarray(u, np.float32), positions.shape)
    outputs = [wp.zeros(len(positions), dtype=wp.vec3, device="cpu") for _ in range(2)]
    inputs = [make_camera(camera, film)] + [wp.array(a, dtype=wp.vec2, device="cpu") for a in (positions, u)]
    wp.launch(kernel_of(camera_kind(camera)), len(positions), inputs, outputs, device="cpu")
    return tuple(output.numpy().astype(np.float64) for output in outputs)


# --- against Mitsuba ---------------------------------------------------------------------------------------------

LOOK_AT = '<lookat origin="1 2 3" target="-4 0.5 9" up="0.1 1 -0.2"/>'
PLACE = f'<transform name="to_world">{LOOK_AT}</transform>'
LENS = '<float name="aperture_radius" value="0.4"/><float name="focus_distance" value="3"/>'
OFFSET = '<float name="principal_point_offset_x" value="0.2"/><float name="principal_point_offset_y" value="-0.1"/>'
SENSORS = {
    "principal point": ("perspective", f'<float name="fov" value="40"/>{OFFSET}{PLACE}'),
    "thin lens": ("thinlens", f'<float name="fov" value="40"/>{LENS}{PLACE}'),
    "thin lens, fov_axis y": (
        "thinlens",
        f'<float name="fov" value="40"/><string name="fov_axis" value="y"/>{LENS}{PLACE}',
    ),
    "thin lens, focal length": ("thinlens", f'<string name="focal_length" value="35mm"/>{LENS}'),
    "thin lens, default focus": ("thinlens", '<float name="fov" value="40"/><float name="aperture_radius" value="2"/>'),
    "orthographic": ("orthographic", PLACE),
    "orthographic, scaled": (
        "orthographic",
        f'<transform name="to_world"><scale x="3" y="3"/><rotate z="1" angle="20"/>{LOOK_AT}</transform>',
    ),
    "orthographic, stretched": (
        "orthographic",
        f'<transform name="to_world"><scale x="3" y="0.5" z="4"/>{LOOK_AT}</transform>',
    ),
}
CROPS = {"whole": (0, 0, 320, 180), "crop": (37, 21, 64, 100)}


@pytest.mark.parametrize("crop", CROPS)
@pytest.mark.parametrize("name", SENSORS)
def test_rays_are_those_of_mitsuba(tmp_path, name, crop):
    """Through the importer and the kernel, for points all over the window and the lens."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    kind, body = SENSORS[name]
    x, y, width, height = CROPS[crop]
    numbers = {"width": 320, "height": 180}
    if crop != "whole":
        numbers |= {"crop_offset_x": x, "crop_offset_y": y, "crop_width": width, "crop_height": height}
    film = "".join(f'<integer name="{key}" value="{value}"/>' for key, value in numbers.items())
    text = f'<sensor type="{kind}" {{}}>{body}<film type="hdrfilm">{film}</film></sensor>'
    path = tmp_path / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{text.format("")}</scene>')
    scene = mitsuba.load(path, warn=lambda message: None)
    sensor = mi.load_string(text.format('version="3.0.0"'))
    rng = np.random.default_rng(1)
    relative = np.concatenate([rng.random((12, 2)), [(0, 0), (1, 1), (0.5, 0.5)]])
    pixels = np.array([x, y]) + relative * [width, height]
    origins, directions = trace(scene.camera, scene.film, pixels, rng.random((15, 2)))
    # Where on the lens they start, in the local axes of Mitsuba's camera, whose +X points to the left.
    to_local = np.linalg.inv(to_matrix(scene.camera.to_world))
    local = (origins @ to_local[:3, :3].T + to_local[:3, 3]) * [-1.0, 1.0, -1.0]
    for position, origin, direction, start in zip(relative, origins, directions, local, strict=True):
        aperture = (0.5, 0.5)
        if kind == "thinlens":
            assert abs(start[2]) < 1e-5
            radius = scene.camera.aperture_radius
            aperture = mi.warp.uniform_disk_to_square_concentric(mi.Point2f(*(start[:2] / radius)))
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(*position), mi.Point2f(*aperture))
        np.testing.assert_allclose(np.array(ray.d), direction, atol=2e-6)
        # Mitsuba's ray starts on the near plane.
        assert np.linalg.norm(np.cross(np.array(ray.o) - origin, direction)) < 1e-5


# --- geometry ----------------------------------------------------------------------------------------------------

FILM = d.Film(width=40, height=30)
TO_WORLD = [
    d.TransformStep(rotate=d.Rotate(axis=(0.3, 1.0, 0.2), angle=50.0)),
    d.TransformStep(translate=(4.0, -2.0, 1.0)),
]


def local_rays(camera, film, positions, u=(0.5, 0.5)):
    """Rays in the camera's own axes."""
    matrix = np.linalg.inv(to_matrix(camera.to_world))
    origins, directions = trace(camera, film, positions, u)
    return origins @ matrix[:3, :3].T + matrix[:3, 3], directions @ matrix[:3, :3].T


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e6])
@pytest.mark.parametrize("focus", [0.5, 20.0])
def test_lens(focus, scale):
    """All rays of a film position meet in one point of the plane of focus, and start evenly from the lens."""
    to_world = [d.TransformStep(scale=scale), *TO_WORLD] if scale != 1.0 else TO_WORLD
    camera = d.ThinLens(fov=60.0, aperture_radius=0.25, focus_distance=focus, to_world=to_world)
    u = np.random.default_rng(2).random((1 << 14, 2))
    origins, directions = local_rays(camera, FILM, np.tile((31.0, 7.0), (len(u), 1)), u)
    pitch = 2.0 * np.tan(np.radians(30.0)) / FILM.width
    sharp = focus * np.array([(31.0 - 20.0) * pitch, (15.0 - 7.0) * pitch, -1.0])
    t = -focus / directions[:, 2]
    # The translation costs float32's digits where the scene is small.
    rounding = 2e-6 * max(focus, 5.0 / scale)
    np.testing.assert_allclose(origins + t[:, None] * directions, np.broadcast_to(sharp, (len(u), 3)), atol=rounding)
    np.testing.assert_allclose(origins[:, 2], 0.0, atol=5e-7 * max(1.0, 5.0 / scale))
    radius2 = np.sum(origins[:, :2] ** 2, axis=1) / 0.25**2
    assert radius2.max() <= 1.0 + 1e-3
    # Even by area: the square of the radius is uniform. False alarms: 1 in 10^4.
    assert abs(radius2.mean() - 0.5) < 3.9 * np.sqrt(1.0 / 12.0 / len(u)) + 1e-3 / scale**0.5
    assert np.abs(origins[:, :2].mean(axis=0)).max() < 0.25 * 4.1 * np.sqrt(0.25 / len(u))


def test_a_lens_without_radius_is_a_pinhole():
    place = {"fov": 35.0, "fov_axis": "diagonal", "principal_point_offset": (0.1, -0.2), "to_world": TO_WORLD}
    lens = d.ThinLens(aperture_radius=0.0, focus_distance=3.0, **place)
    positions = np.random.default_rng(3).random((50, 2)) * [40, 30]
    for one, other in zip(
        trace(lens, FILM, positions, positions / 50.0), trace(d.Perspective(**place), FILM, positions), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_orthographic():
    camera = d.Orthographic(width=6.0, to_world=TO_WORLD)
    positions = np.array([(0, 0), (40, 0), (40, 30), (20, 15), (7.5, 22.0)])
    origins, directions = local_rays(camera, FILM, positions)
    x, y = positions.T
    expected = np.stack([(x - 20.0) * 0.15, (15.0 - y) * 0.15, 0.0 * x], axis=1)
    np.testing.assert_allclose(origins, expected, atol=1e-6)
    np.testing.assert_allclose(directions, np.broadcast_to((0.0, 0.0, -1.0), (5, 3)), atol=2e-7)


def test_spherical():
    """Longitude grows to the right from -Z in the middle, the polar angle downwards from +Y; also beyond the edges."""
    half = np.sqrt(0.5)
    expected = {
        (20, 15): (0, 0, -1),
        (30, 15): (1, 0, 0),
        (10, 15): (-1, 0, 0),
        (0, 15): (0, 0, 1),
        (40, 15): (0, 0, 1),
        (7, 0): (0, 1, 0),
        (33, 30): (0, -1, 0),
        (30, 7.5): (half, half, 0),
        (25, 22.5): (0.5, -half, -0.5),
        (20, -7.5): (0, half, half),  # over the pole
        (50, 15): (-1, 0, 0),  # around
    }
    origins, directions = local_rays(d.Spherical(to_world=TO_WORLD), FILM, list(expected))
    np.testing.assert_allclose(origins, 0.0, atol=1e-6)
    np.testing.assert_allclose(directions, list(expected.values()), atol=1e-6)


@pytest.mark.parametrize("scale", [1.0, 1e-20, 1e20])
def test_spherical_camera_sees_a_ball(scale):
    """A ball of radiance 3 and half angle 0.5, anywhere: its solid angle and its direction, from the map.

    Some 90 pixels at the rim are known to half a radiance over sqrt(spp) each: 0.2 % of the sum of 250 or more. Even by
    angle is not even by solid angle within a pixel, which cancels over the rim but for its square, 0.1 %.
    """
    film, spp = d.Film(width=64, height=32), 256
    theta = np.pi * (np.arange(32) + 0.5) / 32
    phi = 2.0 * np.pi * ((np.arange(64) + 0.5) / 64 - 0.5)
    cosine = np.cos(np.linspace(0.0, np.pi, 33))
    solid_angle = (cosine[:-1] - cosine[1:])[:, None] * (2.0 * np.pi / 64)
    sine = np.sin(theta)[:, None]
    on_map = np.stack(
        np.broadcast_arrays(sine * np.sin(phi), np.cos(theta)[:, None], -sine * np.cos(phi)), axis=-1
    )  # [row, column, xyz]
    for direction in np.array([(0, 0, 1), (0.3, 0.9, 0.1), (-0.6, -0.2, 0.7)]):
        direction = direction / np.linalg.norm(direction)
        place = np.array([1.0, -2.0, 0.5])
        ball = d.Sphere(center=tuple(place + 4.0 * direction), radius=4.0 * np.sin(0.5), emitter=d.Area(radiance=3.0))
        to_world = [d.TransformStep(scale=scale), d.TransformStep(translate=tuple(place))]
        scene = d.Scene(shapes=[ball], camera=d.Spherical(to_world=to_world), film=film)
        weight = Renderer(scene, seed=2).render(spp)[..., 1] * solid_angle
        assert weight.sum() == pytest.approx(3.0 * 2.0 * np.pi * (1.0 - np.cos(0.5)), rel=0.01)
        mean = np.tensordot(weight, on_map, 2)
        assert np.arccos(mean @ direction / np.linalg.norm(mean)) < 0.01


@pytest.mark.parametrize("fov_axis", ["x", "y", "diagonal", "smaller", "larger"])
@pytest.mark.parametrize("kind", ["perspective", "thin_lens", "orthographic"])
def test_a_pixel_of_aspect_two_covers_two_square_ones(kind, fov_axis):
    """18x30 pixels of aspect 2 are 36x30 square ones, also in what is the larger side."""
    camera = {
        "perspective": d.Perspective(fov=50.0, fov_axis=fov_axis, principal_point_offset=(0.1, 0.0)),
        "thin_lens": d.ThinLens(fov=50.0, fov_axis=fov_axis, aperture_radius=0.1, focus_distance=2.0),
        "orthographic": d.Orthographic(),
    }[kind]
    positions = np.random.default_rng(4).random((30, 2)) * [18, 30]
    wide = trace(camera, d.Film(width=18, height=30, pixel_aspect=2.0), positions, positions / 30.0)
    square = trace(camera, d.Film(width=36, height=30), positions * [2, 1], positions / 30.0)
    for one, other in zip(wide, square, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


# --- blur --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("distance", [2.0, 4.0, 7.0])
def test_circle_of_confusion(distance):
    """A small bright ball becomes an even disc of radius R |z - f| / (z f), at a distance of one.

    Its size is taken from the second moment of the image per axis: a quarter of the squared radii of disc and ball, and
    a twelfth of a square pixel. N samples that hit the ball know N to sqrt(N), the moment to 1 / sqrt(N) and the centre
    to its root over sqrt(N). All are held to 4.5 standard errors (false alarms: 1 in 10^5), which is 3 % of the moment;
    a focus that is off by 3 % changes it by more than 5 %.
    """
    focus, radius = 4.0, 0.3
    ball = distance * (0.04 if distance == focus else 0.02)
    camera = d.ThinLens(fov=20.0, aperture_radius=radius, focus_distance=focus)
    scene = d.Scene(
        shapes=[d.Sphere(center=(0.0, 0.0, -distance), radius=ball, emitter=d.Area(radiance=1.0))],
        camera=camera,
        film=d.Film(width=64, height=64),
        integrator=d.PathIntegrator(max_depth=1, rr_depth=None),
    )
    image = Renderer(scene, seed=1).render(512)[..., 1].astype(np.float64)
    pitch = 2.0 * np.tan(np.radians(10.0)) / 64
    confusion = radius * abs(distance - focus) / (distance * focus) / pitch
    seen = ball / distance / pitch
    y, x = np.mgrid[0:64, 0:64] - 31.5
    weight, hits = image / image.sum(), 512.0 * image.sum()
    error = 4.5 / np.sqrt(hits)
    assert error < 0.035
    # As much light as a pinhole gets: the disc has the solid angle of the ball.
    assert image.sum() == pytest.approx(np.pi * seen**2, rel=error)
    expected = confusion**2 / 4.0 + seen**2 / 4.0 + 1.0 / 12.0
    for axis in (x, y):
        assert abs((weight * axis).sum()) < error * np.sqrt(expected)
        assert (weight * axis**2).sum() == pytest.approx(expected, rel=error)
    reach = np.hypot(x, y)
    assert image[reach > confusion + seen + 1.0].max() == 0.0
    if confusion > seen + 3.0:
        inside = image[reach < confusion - seen - 1.5]
        assert inside.std() < 6.0 * np.sqrt(inside.mean() / 512.0)
