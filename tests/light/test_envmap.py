"""Environment maps: what they show, that sampling has the density it claims, and that nothing that shines is missed."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

from tests.chi_square import FALSE_ALARM_RATE, cell_sums, histogram, nodes, p_value, sidak
from wavefront import Renderer
from wavefront.errors import SceneError
from wavefront.light.envmap import QUANTA, EnvironmentMap, make_envmap, quantized_cdf
from wavefront.scene import description as d
from wavefront.scene.device import upload_scene
from wavefront.scene.images import load_image, write_exr
from wavefront.scene.transforms import to_matrix

DEVICE = "cpu"
N = 200_000
TURN = [d.TransformStep(rotate=d.Rotate(axis=(1.0, 2.0, -0.5), angle=67.0))]
LUMINANCE = np.array((0.212671, 0.715160, 0.072169))

eval_envmap, sample_envmap = make_envmap("floats")
eval_halves, _ = make_envmap("halves")
eval_bytes, _ = make_envmap("bytes")


@wp.kernel(enable_backward=False, module="unique")
def eval_kernel(
    env: EnvironmentMap,
    storage: int,
    w: wp.array(dtype=wp.vec3),
    # outputs
    radiance: wp.array(dtype=wp.vec3),
    pdf: wp.array(dtype=float),
):
    i = wp.tid()
    if storage == 1:
        found = eval_bytes(env, w[i])
        radiance[i] = found.L
        pdf[i] = found.pdf
    elif storage == 2:
        found = eval_halves(env, w[i])
        radiance[i] = found.L
        pdf[i] = found.pdf
    else:
        found = eval_envmap(env, w[i])
        radiance[i] = found.L
        pdf[i] = found.pdf


@wp.kernel(enable_backward=False, module="unique")
def sample_kernel(
    env: EnvironmentMap,
    u: wp.array(dtype=wp.vec3),
    # outputs
    w: wp.array(dtype=wp.vec3),
):
    w[wp.tid()] = sample_envmap(env, u[wp.tid()])


def noise(height, width, channels=3, seed=0, black=0.0):
    """Pixels over four orders of magnitude, a share of them black."""
    rng = np.random.default_rng(seed)
    pixels = np.exp(rng.normal(scale=1.5, size=(height, width, channels)))
    return (pixels * (rng.random((height, width, 1)) >= black)).astype(np.float32)


def sun(height, width, row, column):
    """One bright pixel in the dark."""
    pixels = np.full((height, width, 3), 1e-3, np.float32)
    pixels[row, column] = 1e4
    return pixels


def lone(height, width, row, column):
    pixels = np.zeros((height, width, 3), np.float32)
    pixels[row, column] = (0.0, 0.0, 2.0)
    return pixels


MAPS = {
    "noise": noise(7, 12),
    "grey": noise(5, 9, channels=1),
    "mostly black": noise(9, 16, black=0.7, seed=3),
    "sun": sun(9, 16, 3, 5),
    "sun at the seam": sun(9, 16, 4, 15),
    "only the upper pole": lone(6, 8, 0, 3),
    "only the lower pole": lone(6, 8, 5, 7),
    "one pixel at the seam": lone(6, 8, 2, 0),
    "two rows": noise(2, 3, seed=5),
    "one column": noise(4, 1, seed=6),
    "constant": np.full((4, 8, 3), 0.5, np.float32),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("maps")


def write(folder, pixels, name="map.exr"):
    names = "Y" if pixels.shape[2] == 1 else "RGB"
    write_exr(folder / name, {c: pixels[:, :, i] for i, c in enumerate(names)})
    return str(folder / name)


def upload(folder, name, **fields):
    file = write(folder, MAPS[name], name.replace(" ", "-") + ".exr")
    return upload_scene(d.Scene(emitters=[d.Envmap(file=file, **fields)]), DEVICE).lights


def evaluate(env, w, storage=0):
    w = wp.array(np.ascontiguousarray(w, np.float32), dtype=wp.vec3, device=DEVICE)
    L, pdf = wp.zeros(len(w), dtype=wp.vec3, device=DEVICE), wp.zeros(len(w), dtype=float, device=DEVICE)
    wp.launch(eval_kernel, dim=len(w), inputs=[env, storage, w], outputs=[L, pdf], device=DEVICE)
    return L.numpy().astype(np.float64), pdf.numpy().astype(np.float64)


def sample(env, n=N, seed=1):
    u = (np.random.default_rng(seed).integers(0, 2**24, (n, 3)) / 2.0**24).astype(np.float32)
    w = wp.zeros(n, dtype=wp.vec3, device=DEVICE)
    u = wp.array(u, dtype=wp.vec3, device=DEVICE)
    wp.launch(sample_kernel, dim=n, inputs=[env, u], outputs=[w], device=DEVICE)
    return w.numpy().astype(np.float64)


def oracle(pixels, w):
    """Radiance in float64, from the definition in the map's own axes."""
    height, width, _ = pixels.shape
    u = np.arctan2(w[:, 0], -w[:, 2]) / (2.0 * np.pi)
    x, y = (u - np.floor(u)) * width - 0.5, np.arccos(np.clip(w[:, 1], -1.0, 1.0)) / np.pi * (height - 1)
    x0, y0 = np.floor(x).astype(int), np.minimum(y.astype(int), height - 2)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    p = np.broadcast_to(pixels, (height, width, 3)).astype(np.float64)
    top = (1 - fx) * p[y0, x0 % width] + fx * p[y0, (x0 + 1) % width]
    bottom = (1 - fx) * p[y0 + 1, x0 % width] + fx * p[y0 + 1, (x0 + 1) % width]
    return (1 - fy) * top + fy * bottom


def on_sphere(x, y):
    """Directions of the unit square, areas kept."""
    z, phi = 1.0 - 2.0 * y, 2.0 * np.pi * x
    r = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def in_map(u, v):
    """Directions in the map's axes at a place of the image."""
    phi, theta = 2.0 * np.pi * u, np.pi * v
    return np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], axis=-1)


# --- what it shows -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MAPS)
def test_radiance_is_that_of_the_definition(folder, name):
    """In float64, turned and scaled; float32 knows a direction to some 1e-7, hence a place in the map of pixels to
    1e-5, and radiance to that times the contrast."""
    w = on_sphere(*np.random.default_rng(2).random((2, 20_000))).astype(np.float32).astype(np.float64)
    lights = upload(folder, name, scale=3.0, to_world=TURN)
    matrix = to_matrix(TURN)[:3, :3]
    expected = 3.0 * oracle(MAPS[name], w @ matrix)  # the inverse of a rotation is its transpose
    L, _ = evaluate(lights.envmap, w)
    np.testing.assert_allclose(L, expected, atol=3e-5 * expected.max())


def test_axes():
    """The middle of the image is at -Z, a quarter further right +X, the first row +Y: by hand, with pixels of names."""
    pixels = np.arange(5 * 8, dtype=np.float32).reshape(5, 8, 1)
    # Longitude 0 lies between the last and the first column.
    at = {(0, 0, -1): (2, (7, 0)), (1, 0, 0): (2, (1, 2)), (0, 0, 1): (2, (3, 4)), (-1, 0, 0): (2, (5, 6))}
    for w, (row, columns) in at.items():
        expected = pixels[row, list(columns)].mean()
        assert oracle(pixels, np.array([w], float))[0, 0] == pytest.approx(expected)
    assert 0 <= oracle(pixels, np.array([[0.0, 1.0, 0.0]]))[0, 0] <= 7
    assert 32 <= oracle(pixels, np.array([[0.0, -1.0, 0.0]]))[0, 0] <= 39


def test_bytes_are_srgb(folder):
    """An 8-bit file gives the radiance and the density of a float file with its linear values."""
    from PIL import Image

    encoded = np.random.default_rng(4).integers(0, 256, (6, 11, 3), dtype=np.uint8)
    Image.fromarray(encoded).save(folder / "bytes.png")
    value = encoded / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)
    device_scenes = [
        upload_scene(d.Scene(emitters=[d.Envmap(file=file)]), DEVICE)
        for file in (str(folder / "bytes.png"), write(folder, linear, "linear.exr"))
    ]
    assert [scene.light_kinds for scene in device_scenes] == [("envmap_bytes",), ("envmap_floats",)]
    assert device_scenes[0].lights.envmap.bytes.shape == (6 * 11 * 3,)
    w = on_sphere(*np.random.default_rng(5).random((2, 5000)))
    (a, pdf_a), (b, pdf_b) = (evaluate(s.lights.envmap, w, 1 - i) for i, s in enumerate(device_scenes))
    np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(pdf_a, pdf_b, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("channels", [1, 3])
def test_halves_stay_halves(folder, channels):
    """A file of halves takes two bytes a channel, and gives bit for bit what a file of the same floats gives."""
    values = noise(7, 12, channels=channels).astype(np.float16)
    names = "RGB" if channels == 3 else "Y"
    planes = {c: values[:, :, i] for i, c in enumerate(names)}
    files = [folder / "halves.exr", folder / "floats.exr"]
    for file, half in zip(files, (True, False), strict=True):
        write_exr(file, planes, half=half)
    scenes = [upload_scene(d.Scene(emitters=[d.Envmap(file=str(file), scale=3.0)]), DEVICE) for file in files]
    assert [scene.light_kinds for scene in scenes] == [("envmap_halves",), ("envmap_floats",)]
    maps = [scene.lights.envmap for scene in scenes]
    assert maps[0].halves.capacity == values.nbytes
    assert maps[1].floats.capacity == 2 * values.nbytes
    w = on_sphere(*np.random.default_rng(5).random((2, 5000)))
    for a, b in zip(evaluate(maps[0], w, 2), evaluate(maps[1], w, 0), strict=True):
        np.testing.assert_array_equal(a, b)


# --- sampling ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(1,), (5,), (3, 40), (2, 4096)])
@pytest.mark.parametrize("spread", [0.5, 8.0])
def test_cumulative_probabilities_are_steps_of_the_numbers_drawn(shape, spread):
    """Exact: multiples of 2^-24 that end in 1, positive exactly where the weight is, near to its share."""
    rng = np.random.default_rng(len(shape))
    weights = np.exp(rng.normal(scale=spread, size=shape)) * (rng.random(shape) < 0.7)
    weights[..., 0] = 1e-30
    ends = quantized_cdf(weights).astype(np.float64)
    steps = np.diff(ends, axis=-1, prepend=0.0) * QUANTA
    assert (steps == np.rint(steps)).all()
    assert (ends[..., -1] == 1.0).all()
    assert ((steps > 0) == (weights > 0)).all()
    share = weights / weights.sum(axis=-1, keepdims=True) * QUANTA
    # A step for each weight, taken from all in proportion, and a rounding of both ends.
    assert (np.abs(steps - share) <= 2.0 + share * shape[-1] / QUANTA).all()


def test_black_rows_have_no_probabilities():
    ends = quantized_cdf(np.array([[1.0, 2.0], [0.0, 0.0]]))
    assert (ends[1] == 0.0).all()


@pytest.mark.parametrize("name", MAPS)
def test_density(folder, name):
    """Chi-square of directions against the density, which integrates to one; false-alarm rate 1e-4 over the maps."""
    env = upload(folder, name, to_world=TURN).envmap
    matrix = to_matrix(TURN)[:3, :3]
    shape, per_cell = (16, 12), 48
    u, v, area = nodes(shape, per_cell)
    _, pdf = evaluate(env, in_map(u, v) @ matrix.T)
    # In the image the density is bounded, which it is not on the sphere at the poles.
    mass = cell_sums(2.0 * np.pi**2 * np.sin(np.pi * v) * pdf * area, shape, per_cell)
    assert mass.sum() == pytest.approx(1.0, abs=1e-3)
    w = sample(env)
    np.testing.assert_allclose(np.linalg.norm(w, axis=1), 1.0, atol=1e-6)
    local = w @ matrix
    place = np.arctan2(local[:, 0], -local[:, 2]) / (2.0 * np.pi) % 1.0, np.arccos(np.clip(local[:, 1], -1, 1)) / np.pi
    assert p_value(histogram(*place, shape), mass / mass.sum()) > sidak(len(MAPS))


@pytest.mark.parametrize("name", MAPS)
def test_density_is_positive_where_there_is_radiance(folder, name):
    env = upload(folder, name).envmap
    L, pdf = evaluate(env, on_sphere(*np.random.default_rng(7).random((2, 200_000))))
    shines = L.max(axis=1) > 0.0
    assert shines.any()
    assert (pdf[shines] > 0.0).all()
    assert (pdf[~shines] == 0.0).all()


@pytest.mark.parametrize("name", MAPS)
def test_flux(folder, name):
    """z-test of the mean of radiance / density against an integral in float64; false-alarm rate 1e-4 over the maps.

    The ratio varies by the sine of the colatitude within a row of cells and, in colour, by hue: bounded.
    """
    env = upload(folder, name).envmap
    w = sample(env, seed=3)
    L, pdf = evaluate(env, w)
    assert (pdf > 0.0).all()
    height, width, _ = MAPS[name].shape
    # Midpoints in (u, v), cells of the map times 64, against the exact weight of their rings.
    k = 64 if width * height < 100 else 32
    v = np.linspace(0.0, np.pi, (height - 1) * k + 1)
    rings = np.cos(v[:-1]) - np.cos(v[1:])
    theta, u = np.meshgrid(0.5 * (v[:-1] + v[1:]), (np.arange(width * k) + 0.5) / (width * k), indexing="ij")
    grid = in_map(u, theta / np.pi).reshape(-1, 3)
    values = oracle(MAPS[name], grid).reshape(*theta.shape, 3).mean(axis=1)
    expected = 2.0 * np.pi * (values * rings[:, None]).sum(axis=0)
    limit = stats.norm.isf(0.5 * sidak(3 * len(MAPS)))
    for channel in range(3):
        ratio = L[:, channel] / pdf
        error = max(ratio.std() / np.sqrt(N), 2e-4 * expected[channel])
        assert abs(ratio.mean() - expected[channel]) <= limit * error, channel
    assert (L @ LUMINANCE / pdf).max() <= 3.05 * (expected @ LUMINANCE), "bounded: 2 by the sine, 3/2 at a pole"


# --- renders -----------------------------------------------------------------------------------------------------


def floor_scene(file, nee, **fields):
    up = [d.TransformStep(scale=50.0), d.TransformStep(rotate=d.Rotate(axis=(1, 0, 0), angle=-90.0))]
    look = [d.TransformStep(look_at=d.LookAt(origin=(0.0, 2.0, 0.0), target=(0.0, 0.0, 0.0), up=(0.0, 0.0, -1.0)))]
    return d.Scene(
        shapes=[d.Rectangle(to_world=up, bsdf=d.Diffuse(reflectance=0.5))],
        camera=d.Perspective(to_world=look),
        film=d.Film(width=16, height=16),
        emitters=[d.Envmap(file=file, **fields)],
        integrator=d.PathIntegrator(max_depth=2, nee=nee, rr_depth=None),
    )


@pytest.mark.parametrize("nee", [True, False])
def test_irradiance_in_closed_form(folder, nee):
    """A map of one bright ring at colatitude pi/4 of five rows: hat functions in theta, integrated by hand.

    E = 2 pi integral of hat(theta) cos(theta) sin(theta), hat from 0 over pi/4 to pi/2: pi integral hat sin(2 theta)
    = pi * (4/pi) * integral over [0, pi/4] of t sin(2t) dt * 2 (it is symmetric about pi/4) = 8 * 1/4 = 2.
    z-test over 256 pixels; false-alarm rate 1e-4 of each case.
    """
    pixels = np.zeros((5, 4, 3), np.float32)
    pixels[1] = (1.0, 2.0, 3.0)
    image = Renderer(floor_scene(write(folder, pixels, "ring.exr"), nee), seed=5).render(256)
    for channel, value in enumerate((1.0, 2.0, 3.0)):
        values = image[:, :, channel].ravel() / value
        z = (values.mean() - 0.5 * 2.0 / np.pi) / (values.std() / 16.0)
        assert abs(z) < stats.norm.isf(0.5 * sidak(3)), z


def test_light_sampling_agrees_with_none(folder):
    """z-test of the means of both, on a map with a bright spot; false-alarm rate 1e-4. And it has far less noise."""
    file = write(folder, sun(17, 32, 4, 10), "spot.exr")
    a, b = (Renderer(floor_scene(file, nee, to_world=TURN), seed=6).render(256) for nee in (True, False))
    z = (a.mean() - b.mean()) / np.sqrt(a.var() / 256 + b.var() / 256)
    assert abs(z) < stats.norm.isf(0.5 * FALSE_ALARM_RATE)
    assert a.var() < 0.01 * b.var()


def test_tables_exist_only_with_light_sampling(folder):
    lights = upload_scene(floor_scene(write(folder, MAPS["noise"]), False), DEVICE).lights
    assert lights.envmap.rows is None or lights.envmap.rows.shape == (0,)


# --- files -------------------------------------------------------------------------------------------------------


def test_a_file_of_radiance_hdr(folder):
    """Pixels by the definition of the format: (m / 256) 2^(e - 128) of the mantissa's middle or its foot."""
    rng = np.random.default_rng(8)
    pixels = rng.integers(1, 256, (3, 5, 4), dtype=np.uint8)
    pixels[:, :, :3] |= 128  # normalised
    pixels[:, :, 3] = rng.integers(120, 137, (3, 5))
    (folder / "a.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 3 +X 5\n" + pixels.tobytes())
    read = load_image(folder / "a.hdr")
    assert read.dtype == np.float16
    assert read.shape == (3, 5, 3)
    expected = pixels[:, :, :3] * 2.0 ** (pixels[:, :, 3:].astype(float) - 136)
    step = 2.0 ** (pixels[:, :, 3:].astype(float) - 136)
    assert (np.abs(read - expected) <= step).all()
    pixels[1, 2, 3] = 150  # beyond the largest half
    (folder / "b.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 3 +X 5\n" + pixels.tobytes())
    large = load_image(folder / "b.hdr")
    assert large.dtype == np.float32
    assert large[1, 2].max() >= 2.0**21
    np.testing.assert_array_equal(large[0], read[0])
    (folder / "bad.hdr").write_bytes(b"not one")
    with pytest.raises(SceneError, match=r"bad\.hdr: cannot be read"):
        load_image(folder / "bad.hdr")


@pytest.mark.parametrize(
    ("pixels", "message"),
    [(np.ones((1, 4, 3)), "at least 2 rows"), (np.full((2, 4, 3), np.inf), r"pixel \(0, 0\) is not finite")],
)
def test_what_is_no_environment_map(folder, pixels, message):
    with pytest.raises(SceneError, match=message) as error:
        upload_scene(d.Scene(emitters=[d.Envmap(file=write(folder, pixels.astype(np.float32)))]), DEVICE)
    assert error.value.path == "emitters[0].file"


def test_negative_pixels_are_black_and_noted(folder):
    pixels = MAPS["noise"].copy()
    pixels[2, 3] = (-1.0, -1.0, -1.0)
    device_scene = upload_scene(d.Scene(emitters=[d.Envmap(file=write(folder, pixels))]), DEVICE)
    assert device_scene.lights.envmap.floats.numpy().min() == 0.0
    assert any("1 pixels" in note for note in device_scene.notes)
