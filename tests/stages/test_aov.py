"""AOV stage alone: sums per pixel against NumPy, rays that escaped, the sample that an index is of."""

import numpy as np
import pytest
import warp as wp

from tests.stages.harness import array, launch, materials, no_textures, paths, surfaces, unit
from wavefront.film import FIRST_HIT, Film
from wavefront.stages.aov import make_aov

WIDTH, HEIGHT = 9, 6
TILE = (2, 1, 4, 3, 0, 5)  # x, y, width, height, first sample, samples
COUNT, SPARE = 4 * 3 * 5, 7
KINDS = ("conductor", "diffuse")
DIFFUSE, MIRROR = 0, 1
REFLECTANCE, MIRROR_REFLECTANCE = np.array([0.8, 0.4, 0.1]), np.array([0.9, 0.8, 0.7])
AOVS = ("albedo", "normal", "geometric_normal", "depth", "position", "uv", "shape_index")


@pytest.fixture(scope="module")
def state():
    """Random vertices; in every third slot the ray escaped, and what an earlier path left there is no number."""
    rng = np.random.default_rng(7)
    n = COUNT + SPARE
    escaped = rng.random(n) < 1.0 / 3.0
    escaped[:5] = True  # of the first pixel all

    def values(v):
        return np.where(escaped[:, None], np.nan, v)

    fields = {
        "position": values(rng.normal(size=(n, 3)) * 10.0),
        "shading_normal": values(unit(rng.normal(size=(n, 3)))),
        "geometric_normal": values(unit(rng.normal(size=(n, 3)))),
        "uv": values(rng.normal(size=(n, 2))),
        "material": np.where(escaped, -1, rng.integers(0, 2, n)),
        "shape": np.where(escaped, 77, rng.integers(0, 5, n)),
    }
    fields = {name: v.astype(np.float32) if v.dtype == float else v for name, v in fields.items()}
    origin = rng.normal(size=(n, 3)).astype(np.float32)
    direction = unit(rng.normal(size=(n, 3))).astype(np.float32)
    return (
        surfaces(n, **fields),
        paths(n, origin=origin, direction=direction),
        fields
        | {
            "origin": origin,
            "direction": direction,
        },
    )


def run(state, film, arrays, tile=TILE):
    table = materials(
        diffuse=[{"reflectance": REFLECTANCE}],
        conductor=[{"eta": 0.0, "k": 1.0, "reflectance": MIRROR_REFLECTANCE}],
    )
    kernel = make_aov(arrays, KINDS, False, (), "uv" in arrays)
    tile = array(np.array(tile, np.int32), wp.int32)
    launch(kernel, COUNT + SPARE, table, no_textures(), state[1], state[0], tile, WIDTH, film.arrays)


def samples(fields):
    """What every sample of the tile adds, [pixels, samples, components], float64; zero where its ray escaped."""
    hit = fields["material"] >= 0
    cosine = -np.sum(fields["shading_normal"].astype(float) * fields["direction"], axis=1)
    albedo = np.where((fields["material"] == DIFFUSE)[:, None], REFLECTANCE, MIRROR_REFLECTANCE)
    result = {
        "albedo": np.where((cosine >= 0.0)[:, None], albedo, 0.0),  # both are black on their back
        "normal": fields["shading_normal"],
        "geometric_normal": fields["geometric_normal"],
        "depth": np.linalg.norm(fields["position"].astype(float) - fields["origin"], axis=1)[:, None],
        "position": fields["position"],
        "uv": fields["uv"],
    }
    return {name: np.where(hit[:, None], v.astype(float), 0.0)[:COUNT].reshape(12, 5, -1) for name, v in result.items()}


def on_film(values):
    """Values of the pixels of the tile, in the film."""
    film = np.zeros((HEIGHT, WIDTH, *values.shape[1:]))
    x, y, width, height = TILE[:4]
    film[y : y + height, x : x + width] = values.reshape(height, width, *values.shape[1:])
    return film


def film_values(film, name):
    values = getattr(film.arrays, name).numpy()
    return values.reshape(HEIGHT, WIDTH, -1)


def test_sums(state):
    """Twice, of which the second must add."""
    film = Film(WIDTH, HEIGHT, AOVS, "cpu")
    assert {name for name in FIRST_HIT if getattr(film.arrays, name) is not None} == set(AOVS)
    run(state, film, FIRST_HIT)
    run(state, film, FIRST_HIT)
    for name, expected in samples(state[2]).items():
        np.testing.assert_allclose(
            film_values(film, name), on_film(2.0 * expected.sum(axis=1)), rtol=1e-6, atol=1e-6, err_msg=name
        )
    assert (film.arrays.L.numpy() == 0.0).all()
    film.sample_count = 10
    channels = film.channels()
    for i, component in enumerate("XYZ"):
        expected = on_film(samples(state[2])["position"].mean(axis=1))[..., i]
        np.testing.assert_allclose(channels[f"position.{component}"], expected, rtol=1e-5, atol=1e-6)


def test_indices_are_those_of_the_first_sample(state):
    film = Film(WIDTH, HEIGHT, ("shape_index", "bsdf_index"), "cpu", bsdf_of_shape=[3, 1, 4, 1, 5])
    run(state, film, ("shape_index",))
    first = np.where(state[2]["material"] >= 0, state[2]["shape"], -1)[:COUNT].reshape(12, 5)[:, 0]
    expected = on_film(first)
    np.testing.assert_array_equal(film_values(film, "shape_index")[..., 0], expected)
    later = (*TILE[:4], 5, 5)
    film.arrays.shape_index.fill_(9)
    run(state, film, ("shape_index",), later)
    assert (film.arrays.shape_index.numpy() == 9).all()
    film.arrays.shape_index.assign(expected.ravel().astype(np.int32))
    film.sample_count = 3
    channels = film.channels()
    np.testing.assert_array_equal(channels["shape_index.I"], expected)
    table = np.array([3, 1, 4, 1, 5, -1])
    np.testing.assert_array_equal(channels["bsdf_index.I"], table[expected.astype(int)])
    assert {-1, 0, 4} <= set(np.unique(expected))


@pytest.mark.parametrize("name", ["albedo", "shape_index"])
def test_one_alone(state, name):
    """Arrays that are not asked for do not exist, and are not written."""
    film = Film(WIDTH, HEIGHT, (name,), "cpu")
    assert [other for other in FIRST_HIT if getattr(film.arrays, other) is not None] == [name]
    run(state, film, (name,))
    expected = samples(state[2])["albedo"].sum(axis=1) if name == "albedo" else None
    if expected is not None:
        np.testing.assert_allclose(film_values(film, "albedo"), on_film(expected), rtol=1e-6, atol=1e-7)
    else:
        assert (film_values(film, "shape_index") != 0).any()
