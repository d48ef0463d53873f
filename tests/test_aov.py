"""AOVs of whole renders: against rays traced in NumPy, over windows and blocks, and in the file that is written."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from tests.stages.harness import uniforms
from wavefront import Renderer, film
from wavefront.film import CHANNELS, Film, FilmArrays, row_blocks
from wavefront.rng import PURPOSE_CAMERA
from wavefront.scene import description as d

SIZE, SPP, SEED = (40, 30), 6, 11
CAMERA, FOV = (0.0, 0.0, 6.0), 50.0
BALL, RADIUS = np.array([0.8, 0.3, 0.5]), 1.1
ALL = list(CHANNELS)
TURN = d.Rotate(axis=(0.0, 0.0, 1.0), angle=90.0)


def room(aovs, crop=None):
    """A masked square with smooth normals that cuts a ball, under a sky; BSDFs by name and in place."""
    corners = [(-2.0, -1.5, 0.0), (2.0, -1.5, 0.0), (2.0, 1.5, 0.0), (-2.0, 1.5, 0.0)]
    square = d.Mesh(
        vertices=corners,
        faces=[(0, 1, 2), (0, 2, 3)],
        normals=[(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (0.6, 0.0, 0.8), (0.0, 0.0, 1.0)],
        uvs=[(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)],
        bsdf="veil",
        to_world=[d.TransformStep(translate=(-1.0, -0.5, 0.0))],
    )
    ball = d.Sphere(center=tuple(BALL), radius=RADIUS, bsdf=d.Diffuse(reflectance=[0.2, 0.5, 0.9]), to_world=[])
    far = d.Rectangle(to_world=[d.TransformStep(translate=(90.0, 0.0, 0.0))], emitter=d.Area(radiance=1.0))
    return d.Scene(
        camera=d.Perspective(fov=FOV, to_world=[d.TransformStep(translate=CAMERA)]),
        film=d.Film(width=SIZE[0], height=SIZE[1], aovs=aovs, crop=crop),
        integrator=d.PathIntegrator(max_depth=3),
        bsdfs=[
            d.Diffuse(name="paint", reflectance=[0.7, 0.6, 0.1]),
            d.Mask(name="veil", bsdf="paint", opacity=0.25),
        ],
        emitters=[d.Constant(radiance=[0.3, 0.4, 0.5])],
        shapes=[ball, far, square],  # a sphere before the meshes: indices are those of the list
    )


def oracle():
    """Means of all channels but radiance and variance, float64, from every camera ray."""
    width, height = SIZE
    y, x, sample = (a.ravel() for a in np.mgrid[0:height, 0:width, 0:SPP])
    u = uniforms(SEED, y * width + x, sample, 0, int(PURPOSE_CAMERA))
    pitch = 2.0 * np.tan(np.radians(FOV / 2.0)) / width
    direction = np.stack(
        [(x + u[:, 0] - width / 2) * pitch, (height / 2 - y - u[:, 1]) * pitch, -np.ones(len(x))], axis=1
    )
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = np.array(CAMERA)
    t_square = -origin[2] / direction[:, 2]
    p_square = origin + t_square[:, None] * direction
    s = (p_square[:, 0] + 3.0) / 4.0
    t = (p_square[:, 1] + 2.0) / 3.0
    on_square = (s >= 0.0) & (s <= 1.0) & (t >= 0.0) & (t <= 1.0)
    b = (origin - BALL) @ direction.T
    with np.errstate(invalid="ignore"):
        t_ball = -b - np.sqrt(b * b - np.sum((origin - BALL) ** 2) + RADIUS**2)
    on_ball = t_ball > 0.0
    first_ball = on_ball & (~on_square | (np.nan_to_num(t_ball, nan=np.inf) < t_square))
    first_square = on_square & ~first_ball
    ball, square = first_ball[:, None], first_square[:, None]
    p_ball = origin + np.nan_to_num(t_ball)[:, None] * direction
    n_ball = (p_ball - BALL) / RADIUS
    n_square = np.stack([0.6 * s, 0.0 * s, 1.0 - 0.2 * s], axis=1)
    n_square /= np.linalg.norm(n_square, axis=1, keepdims=True)
    longitude = np.arctan2(n_ball[:, 1], n_ball[:, 0]) / (2.0 * np.pi) % 1.0
    uv_ball = np.stack([longitude, np.arccos(np.clip(n_ball[:, 2], -1.0, 1.0)) / np.pi], axis=1)

    def either(on_ball, on_square):
        values = np.where(ball, on_ball, np.where(square, on_square, 0.0))
        return values.reshape(height, width, SPP, -1).mean(axis=2)

    index = np.where(first_ball, 0, np.where(first_square, 2, -1)).reshape(height, width, SPP)[..., 0]
    return {
        "albedo": either([0.2, 0.5, 0.9], [0.7, 0.6, 0.1]),
        "normal": either(n_ball, n_square),
        "geometric_normal": either(n_ball, [0.0, 0.0, 1.0]),
        "depth": either(t_ball[:, None], t_square[:, None]),
        "position": either(p_ball, p_square),
        "uv": either(uv_ball, np.stack([s, 1.0 - t], axis=1)),
        "shape_index": index[..., None],
        # `bsdfs` come first, then what stands in shapes in their order: the ball's, the default of the lamp.
        "bsdf_index": np.choose(index + 1, [-1, 2, -1, 1])[..., None],
        "sample_count": np.full((height, width, 1), SPP),
    }


@pytest.fixture(scope="module")
def renderer():
    renderer = Renderer(room(ALL), seed=SEED, threads=2)
    renderer.render(2)
    renderer.render(SPP - 2)
    return renderer


def test_against_rays_in_numpy(renderer):
    channels = renderer.film.channels()
    assert set(channels) == set("RGB") | {f"{aov}.{c}" for aov in ALL for c in CHANNELS[aov]}
    expected = oracle()
    assert {-1, 0, 2} == set(np.unique(expected["shape_index"]))
    for aov, values in expected.items():
        for i, component in enumerate(CHANNELS[aov]):
            found = channels[f"{aov}.{component}"]
            assert found.dtype == np.float32
            error = np.abs(found - values[..., i])
            assert (error <= 2e-5 * (1.0 + np.abs(values[..., i]))).all(), (aov, component, np.sort(error.ravel()))


def test_aovs_do_not_change_the_image(renderer):
    """Nor does leaving any of them out change the others."""
    np.testing.assert_array_equal(Renderer(room([]), seed=SEED).render(SPP), renderer.film.image())
    channels = renderer.film.channels()
    assert channels["variance.Y"].max() > 0.0 < channels["R"].min()
    for aovs in (["bsdf_index"], ["uv", "sample_count"], ["position", "variance"]):
        other = Renderer(room(aovs), seed=SEED)
        other.render(SPP)
        for name, values in other.film.channels().items():
            np.testing.assert_array_equal(values, channels[name], err_msg=name)


@pytest.mark.parametrize(("x", "y", "width", "height"), [(0, 0, 40, 1), (13, 7, 11, 17), (39, 29, 1, 1)])
def test_a_crop_equals_the_pixels_of_the_film(renderer, x, y, width, height):
    """To the last bit, in every channel, though tiles, passes and budget are others."""
    crop = d.Crop(x=x, y=y, width=width, height=height)
    other = Renderer(room(ALL, crop), seed=SEED, threads=1, memory=2 << 20)
    assert other.render(SPP).shape == (height, width, 3)
    assert other.capacity != renderer.capacity
    for name, values in other.film.channels().items():
        whole = renderer.film.channels()[name]
        np.testing.assert_array_equal(values, whole[y : y + height, x : x + width], err_msg=name)


# --- memory ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pixels", [1, 40, 97, 4000])
def test_blocks_of_rows_change_nothing(renderer, monkeypatch, pixels):
    before, image, variance = renderer.film.channels(), renderer.film.image(), renderer.film.variance()
    monkeypatch.setattr(film, "BLOCK_PIXELS", pixels)
    for name, values in renderer.film.channels().items():
        np.testing.assert_array_equal(values, before[name])
    np.testing.assert_array_equal(renderer.film.image(), image)
    np.testing.assert_array_equal(renderer.film.variance(), variance)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (7680, 4320), (65536, 65536), (300, 7), (5000, 1000)])
def test_row_blocks_cover_an_image_once(width, height):
    blocks = list(row_blocks(width, height))
    assert blocks[0][0] == 0 and blocks[-1][1] == height
    assert all(before[1] == after[0] for before, after in itertools.pairwise(blocks))
    assert max(last - first for first, last in blocks) * width <= 1 << 17


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("aovs", [(), ("variance",), ("sample_count",), ("shape_index", "bsdf_index"), tuple(ALL)])
def test_bytes_per_pixel_are_what_is_allocated(aovs, weighted):
    film = Film(100, 10, aovs, "cpu", [0], weighted)
    arrays = [getattr(film.arrays, name) for name in FilmArrays.vars]
    allocated = sum(array.capacity for array in arrays if array is not None)
    assert allocated == 1000 * Film.bytes_per_pixel(aovs, weighted) + 4 * 8 * weighted
    more = 8 if weighted and "variance" in aovs else 0
    assert Film.bytes_per_pixel(aovs, weighted) == Film.bytes_per_pixel(aovs) + more
    assert Film.bytes_per_pixel(("sample_count",)) == Film.bytes_per_pixel(()) == 24
    assert Film.bytes_per_pixel(("shape_index", "bsdf_index")) == 28
