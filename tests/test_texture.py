"""Texture lookups against a float64 oracle, at ordinary and at extreme coordinates."""

import numpy as np
import pytest
import warp as wp

from wavefront.texture import (
    IMAGE_TYPES,
    KINDS,
    WRAP_MODES,
    TextureRecord,
    TextureTables,
    make_eval_gradient,
    make_eval_texture,
    make_prefetch_texture,
    srgb_to_linear,
)

DEVICE = "cpu"
eval_texture = make_eval_texture(tuple(sorted(KINDS)))
prefetch_texture = make_prefetch_texture(tuple(sorted(KINDS)))


@wp.kernel(enable_backward=False, module="unique")
def texture_kernel(
    tables: TextureTables,
    texture: int,
    uv: wp.array(dtype=wp.vec2),
    # outputs
    values: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    prefetch_texture(tables, texture, uv[i])  # may change nothing, whatever the coordinates
    values[i] = eval_texture(tables, texture, uv[i])


eval_gradient = make_eval_gradient(("bytes", "checkerboard", "floats"))


@wp.kernel(enable_backward=False, module="unique")
def gradient_kernel(
    tables: TextureTables,
    texture: int,
    uv: wp.array(dtype=wp.vec2),
    # outputs
    values: wp.array(dtype=wp.vec2),
):
    i = wp.tid()
    values[i] = eval_gradient(tables, texture, uv[i])


RNG = np.random.default_rng(1)
IMAGES = {
    "rgb": RNG.integers(0, 256, (5, 8, 3), np.uint8),
    "grey": RNG.integers(0, 256, (7, 3, 1), np.uint8),
    "one pixel": np.array([[[10, 200, 255]]], np.uint8),
    "one grey pixel": np.array([[[77]]], np.uint8),
    "wide": RNG.integers(0, 256, (1, 16384, 3), np.uint8),
    "tall": RNG.integers(0, 256, (16384, 1, 1), np.uint8),
    "float rgb": RNG.exponential(size=(6, 4, 3)).astype(np.float32),
    "float grey": RNG.exponential(size=(2, 9, 1)).astype(np.float32),
    "half rgb": RNG.exponential(size=(3, 7, 3)).astype(np.float16),
    "half grey": RNG.exponential(size=(1, 5, 1)).astype(np.float16),
    "short rgb": RNG.integers(0, 65536, (4, 3, 3), np.uint16),
    "short grey": RNG.integers(0, 65536, (9, 2, 1), np.uint16),
    "wide shorts": RNG.integers(0, 65536, (1, 16384, 1), np.uint16),
    "tall halves": RNG.exponential(size=(16384, 1, 3)).astype(np.float16),
}
COLORS = (0.1, 0.5, 2.0), (0.7, 0.0, 0.3)


def upload(name, srgb=False, nearest=False, wrap="repeat", rows=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), scale=1.0):
    """All images in one table, as in a scene, so that a wrong offset would be seen; and the index of `name`."""
    host = np.zeros(len(IMAGES) + 1, dtype=TextureRecord.numpy_dtype())
    parts = {kind: [] for kind in IMAGE_TYPES}
    for record, pixels in zip(host, IMAGES.values(), strict=False):
        kind = next(name for name, dtype in IMAGE_TYPES.items() if dtype == pixels.dtype)
        record["first"] = sum(part.size for part in parts[kind])
        parts[kind].append(pixels.ravel())
        record["kind"], record["scale"] = KINDS[kind], scale
        record["height"], record["width"], record["channels"] = pixels.shape
        record["srgb"], record["nearest"], record["wrap"] = srgb, nearest, WRAP_MODES[wrap]
        record["uv_row0"], record["uv_row1"] = rows
    host[-1]["kind"], host[-1]["color0"], host[-1]["color1"] = 0, *COLORS
    host[-1]["uv_row0"], host[-1]["uv_row1"] = rows
    tables = TextureTables()
    tables.records = wp.array(host, dtype=TextureRecord, device=DEVICE)
    for kind, arrays in parts.items():
        setattr(tables, kind, wp.array(np.concatenate(arrays), device=DEVICE))
    tables.srgb_to_linear = wp.array(srgb_to_linear(np.arange(256) / 255.0), dtype=wp.float32, device=DEVICE)
    tables.srgb16_to_linear = wp.array(srgb_to_linear(np.arange(65536) / 65535.0), dtype=wp.float32, device=DEVICE)
    return tables, (len(IMAGES) if name == "checkerboard" else list(IMAGES).index(name))


def look_up(tables, texture, uv):
    values = wp.zeros(len(uv), dtype=wp.vec3, device=DEVICE)
    inputs = [tables, texture, wp.array(uv, dtype=wp.vec2, device=DEVICE)]
    wp.launch(texture_kernel, dim=len(uv), inputs=inputs, outputs=[values], device=DEVICE)
    return values.numpy()


def wrapped(i, size, mode):
    """The definition of each mode, in integers of any size."""
    if mode == "clamp":
        return np.clip(i, 0, size - 1)
    if mode == "repeat":
        return i % size
    m = i % (2 * size)
    return np.where(m < size, m, 2 * size - 1 - m)


def linear_pixels(name, srgb):
    pixels = IMAGES[name]
    values = pixels.astype(np.float64)
    if pixels.dtype.kind == "u":
        values /= np.iinfo(pixels.dtype).max
        if srgb:  # IEC 61966-2-1, written out
            values = np.where(values <= 0.04045, values / 12.92, np.power((values + 0.055) / 1.055, 2.4))
    return np.broadcast_to(values, (*values.shape[:2], 3))


def oracle(name, uv, srgb, nearest, mode):
    pixels = linear_pixels(name, srgb)
    height, width, _ = pixels.shape
    # Two periods taken off, exactly, so that the pixel fits an integer.
    uv = np.clip(uv.astype(np.float64), -9.0, 9.0) if mode == "clamp" else np.mod(uv.astype(np.float64), 2.0)
    x, y = uv[:, 0] * width, uv[:, 1] * height

    def fetch(i, j):
        return pixels[wrapped(j, height, mode), wrapped(i, width, mode)]

    if nearest:
        return fetch(np.floor(x).astype(np.int64), np.floor(y).astype(np.int64))
    x, y = x - 0.5, y - 0.5
    i, j = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - i)[:, None], (y - j)[:, None]
    top = (1 - fx) * fetch(i, j) + fx * fetch(i + 1, j)
    bottom = (1 - fx) * fetch(i, j + 1) + fx * fetch(i + 1, j + 1)
    return (1 - fy) * top + fy * bottom


def coordinates(seed, count=4000):
    """Random inside the unit square and far outside, and every pair of special values."""
    rng = np.random.default_rng(seed)
    special = [0.0, 1.0, -1.0, 0.5, 2.0, -0.25, -1e-9, 1e-9, 1.0 - 2.0**-24, 1e6, -1e6, 1e6 + 0.25, 3e9, -7e20]
    special = np.float32(special)
    pairs = np.stack(np.meshgrid(special, special), axis=-1).reshape(-1, 2)
    inside, outside = rng.random((count, 2)), rng.uniform(-50.0, 50.0, (count, 2))
    return np.concatenate([inside, outside, pairs]).astype(np.float32)


def roundings(name, uv, mode):
    """Bound of the roundings of a coordinate in pixels: of u in [-1, 2], and of its product with the size."""
    height, width, _ = IMAGES[name].shape
    reduced = np.full(uv.shape, 2.0) if mode != "clamp" else np.clip(np.abs(uv), 0.5, 2.0)
    return 2.0**-23 * reduced * (width, height) + 1e-6


@pytest.mark.parametrize("wrap", WRAP_MODES)
@pytest.mark.parametrize("name", IMAGES)
def test_bilinear(name, wrap):
    uv = coordinates(1)
    tables, texture = upload(name, srgb=True, wrap=wrap)
    expected = oracle(name, uv, True, False, wrap)
    values = look_up(tables, texture, uv)
    # A value is off by the rounding of the coordinate times the largest difference between pixels.
    tolerance = roundings(name, uv, wrap).sum(axis=1) * np.ptp(linear_pixels(name, True)) + 2e-6 * expected.max()
    error = np.abs(values - expected).max(axis=1)
    assert (error <= tolerance).all(), (uv[np.argmax(error - tolerance)], (error - tolerance).max())


@pytest.mark.parametrize("wrap", WRAP_MODES)
@pytest.mark.parametrize("name", IMAGES)
def test_nearest(name, wrap):
    """Exact, but for coordinates within a rounding of the edge of a pixel."""
    uv = coordinates(2)
    tables, texture = upload(name, nearest=True, wrap=wrap)
    values = look_up(tables, texture, uv)
    height, width, _ = IMAGES[name].shape
    position = uv.astype(np.float64) * (width, height)
    near_edge = (np.abs(position - np.rint(position)) <= roundings(name, uv, wrap)) & (position != np.rint(position))
    check = ~near_edge.any(axis=1)
    expected = oracle(name, uv, False, True, wrap)
    assert check.mean() > 0.9
    np.testing.assert_allclose(values[check], expected[check], rtol=1e-6)
    # Where an edge is close, it is the pixel on one side of it or the other.
    pixels = linear_pixels(name, False).reshape(-1, 3)
    distance = np.abs(values[~check][:, None] - pixels[None, :4096]).max(axis=2).min(axis=1)
    assert len(pixels) > 4096 or (distance < 1e-6).all()


def test_srgb_table_is_exact():
    """Every byte through a nearest lookup of a 256-pixel row, against the standard's formula in float64."""
    value = np.arange(256) / 255.0
    expected = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(srgb_to_linear(value), expected, rtol=1e-14)
    tables, texture = upload("wide", srgb=True, nearest=True)
    x = np.arange(16384)
    uv = np.stack([(x + 0.5) / 16384, np.full(16384, 0.5)], axis=1).astype(np.float32)
    np.testing.assert_allclose(look_up(tables, texture, uv), expected[IMAGES["wide"][0]], rtol=1e-6)


def test_srgb_table_of_16_bit_is_exact():
    tables, texture = upload("wide shorts", srgb=True, nearest=True)
    x = np.arange(16384)
    uv = np.stack([(x + 0.5) / 16384, np.full(16384, 0.5)], axis=1).astype(np.float32)
    np.testing.assert_allclose(look_up(tables, texture, uv), linear_pixels("wide shorts", True)[0], rtol=1e-6)


@pytest.mark.parametrize("name", ["rgb", "short grey", "half rgb", "float rgb"])
@pytest.mark.parametrize("nearest", [False, True])
def test_scale_multiplies_the_linear_values(name, nearest):
    uv = coordinates(5)
    tables, texture = upload(name, srgb=True, nearest=nearest)
    scaled, _ = upload(name, srgb=True, nearest=nearest, scale=4.0)
    np.testing.assert_array_equal(look_up(scaled, texture, uv), 4.0 * look_up(tables, texture, uv))
    coloured, _ = upload(name, srgb=True, nearest=nearest, scale=(4.0, 0.5, 0.0))
    np.testing.assert_array_equal(
        look_up(coloured, texture, uv), np.float32((4.0, 0.5, 0.0)) * look_up(tables, texture, uv)
    )


def test_mirrored_nearest_at_the_edges():
    """On both sides of every border the mirror repeats the border pixel; by hand, where the pixel is not in doubt."""
    pixels = IMAGES["rgb"][:, :, 0] / 255.0
    tables, texture = upload("rgb", nearest=True, wrap="mirror")
    height, width = pixels.shape
    for edge in range(-4, 5):
        for side in (-0.25, 0.25):
            u = edge + side / width
            column = 0 if edge % 2 == 0 else width - 1
            found = look_up(tables, texture, np.float32([[u, 0.5 / height], [u, -0.5 / height]]))
            np.testing.assert_allclose(found[:, 0], pixels[0, column], rtol=1e-6)


def test_pixel_centres_are_exact():
    """Bilinear at the centre of a pixel is the pixel; (0, 0) of the coordinates is the upper left corner."""
    tables, texture = upload("rgb")
    height, width, _ = IMAGES["rgb"].shape
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    uv = np.stack([(x + 0.5) / width, (y + 0.5) / height], axis=-1).reshape(-1, 2).astype(np.float32)
    np.testing.assert_allclose(look_up(tables, texture, uv), IMAGES["rgb"].reshape(-1, 3) / 255.0, atol=1e-6)


def test_checkerboard():
    uv = coordinates(3)
    rows = ((8.0, 0.0, 0.25), (0.0, 4.0, 0.0))
    tables, texture = upload("checkerboard", rows=rows)
    values = look_up(tables, texture, uv)
    # The oracle starts from the transformed coordinates rounded to float32: beyond, float32 cannot tell squares apart.
    u = (uv[:, 0] * np.float32(8.0) + np.float32(0.25)).astype(np.float64)
    v = (uv[:, 1] * np.float32(4.0)).astype(np.float64)
    same = (u - np.floor(u) < 0.5) == (v - np.floor(v) < 0.5)
    expected = np.where(same[:, None], COLORS[0], COLORS[1])
    edge = np.minimum(np.abs(2 * u - np.rint(2 * u)), np.abs(2 * v - np.rint(2 * v)))
    exact = (edge == 0.0) | (edge > 1e-5)
    np.testing.assert_allclose(values[exact], expected[exact], rtol=1e-6)


def test_uv_transform_rotates_scales_and_moves():
    """Rows act on (u, v, 1), first row gives u."""
    rows = ((0.5, -2.0, 0.3), (1.5, 0.25, -0.7))
    uv = coordinates(4, 2000)[:4000]
    tables, texture = upload("float rgb", rows=rows)
    matrix = np.array(rows)
    moved = uv.astype(np.float64) @ matrix[:, :2].T + matrix[:, 2]
    expected = oracle("float rgb", moved, False, False, "repeat")
    # Coordinates up to 125 are off by some 1e-5, in pixels 1e-4, of a texture that varies by about 4 a pixel.
    np.testing.assert_allclose(look_up(tables, texture, uv), expected, atol=1e-3)


@pytest.mark.parametrize("name", ["rgb", "short rgb", "half rgb", "float grey", "checkerboard"])
def test_coordinates_that_are_not_finite_give_black(name):
    tables, texture = upload(name)
    uv = np.float32([[np.nan, 0.0], [0.0, np.inf], [-np.inf, 0.5], [3e38, 3e38]])
    values = look_up(tables, texture, uv)
    assert (values[:3] == 0.0).all()
    assert np.isfinite(values).all()


@pytest.mark.parametrize("wrap", WRAP_MODES)
@pytest.mark.parametrize("name", ["rgb", "grey", "float rgb", "float grey", "one pixel", "checkerboard"])
def test_gradients_are_differences_of_the_luminance(name, wrap):
    """Of lookups that float32 has no part in but its own rounding: within a cell between pixel centres the texture is
    bilinear, so central differences are exact. The transform turns, and scales u and v each in its own way."""
    rows = ((0.7, -0.4, 0.1), (0.3, 0.5, -0.2))
    tables, texture = upload(name, srgb=name == "rgb", wrap=wrap, rows=rows)
    rng = np.random.default_rng(3)
    uv = rng.uniform(-1.0, 1.0, (4000, 2)).astype(np.float32)
    out = wp.zeros(len(uv), dtype=wp.vec2, device=DEVICE)
    inputs = [tables, texture, wp.array(uv, dtype=wp.vec2, device=DEVICE)]
    wp.launch(gradient_kernel, dim=len(uv), inputs=inputs, outputs=[out], device=DEVICE)
    found = out.numpy()
    if name in ("one pixel", "checkerboard"):
        assert not found.any()
        return
    h = 2.0**-9
    height, width, _ = IMAGES[name].shape
    pixel = (uv.astype(np.float64) @ np.array(rows)[:, :2].T + np.array(rows)[:, 2]) * (width, height) - 0.5
    inside = (np.abs(pixel - np.floor(pixel) - 0.5) < 0.5 - 2.0 * h * max(width, height)).all(axis=1)
    assert inside.mean() > 0.8
    for axis in (0, 1):
        step = np.zeros(2, np.float32)
        step[axis] = h
        difference = (look_up(tables, texture, uv + step) - look_up(tables, texture, uv - step)).astype(np.float64)
        expected = difference @ (0.212671, 0.715160, 0.072169) / (2.0 * h)
        np.testing.assert_allclose(found[inside, axis], expected[inside], atol=2e-3)
