"""Generate: which slot holds which pixel and sample, and the ray of each filter."""

import numpy as np
import pytest
import warp as wp
from scipy import special

from tests.stages.harness import Counters, array, launch, paths, uniforms, unit
from wavefront import queues
from wavefront.camera import camera_kind, make_camera
from wavefront.film import make_window
from wavefront.rng import PURPOSE_CAMERA
from wavefront.scene import description as d
from wavefront.stages.generate import make_generate

WIDTH, HEIGHT = 40, 30
SEED = 2**40 + 7
TILE = (5, 7, 6, 4, 3, 2)  # x, y, width, height, first sample, samples
COUNT = 6 * 4 * 2
ORIGIN, TARGET = np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.5, -1.0])


LOOK_AT = [d.TransformStep(look_at=d.LookAt(origin=tuple(ORIGIN), target=tuple(TARGET)))]


def generate(kind, scale, fov_axis="x", transmission=False, tile=TILE, camera=None, crop=None):
    camera = camera or d.Perspective(fov=50.0, fov_axis=fov_axis, to_world=LOOK_AT)
    film = d.Film(width=WIDTH, height=HEIGHT, crop=crop)
    record = make_camera(camera, film)
    counters = Counters(depth=9)
    capacity = COUNT + 10
    stale = dict.fromkeys(("origin", "direction", "beta", "L", "pdf"), np.nan)
    p = paths(capacity, **stale, eta=-1.0, pixel=77777, sample=7)
    rays = counters.queue("rays", capacity=capacity)
    counters.array.numpy()[:] = 5
    arguments = [record, array(np.array(tile, np.int32), wp.int32), make_window(film), scale, wp.uint64(SEED)]
    kernel = make_generate(camera_kind(camera), kind, transmission)
    launch(kernel, capacity, *arguments, p, rays, counters.struct, counters.totals)
    return p, rays, counters


def expected_slots(tile=TILE):
    x0, y0, width, height, first, samples = tile
    slot = np.arange(width * height * samples)
    local = slot // samples
    return x0 + local % width, y0 + local // width, first + slot % samples


def offsets(kind, scale, u):
    if kind == "box":
        return u - 0.5
    if kind == "tent":
        return scale * np.where(u < 0.5, np.sqrt(2.0 * u) - 1.0, 1.0 - np.sqrt(2.0 - 2.0 * u))
    return scale * np.sqrt(2.0) * special.erfinv((2.0 * u - 1.0) * special.erf(4.0 / np.sqrt(2.0)))


@pytest.mark.parametrize("fov_axis", ["x", "y", "diagonal", "smaller", "larger"])
@pytest.mark.parametrize(("kind", "scale"), [("box", 0.5), ("tent", 1.5), ("gaussian", 0.6)])
def test_rays(kind, scale, fov_axis):
    """Directions from the field of view in float64."""
    p, _, _ = generate(kind, scale, fov_axis)
    x, y, sample = expected_slots()
    u = uniforms(SEED, y * WIDTH + x, sample, 0, int(PURPOSE_CAMERA))
    shift = offsets(kind, scale, u[:, :2])
    tan = np.tan(np.radians(25.0))
    axis = {"x": WIDTH, "y": HEIGHT, "diagonal": np.hypot(WIDTH, HEIGHT), "smaller": HEIGHT, "larger": WIDTH}[fov_axis]
    # Metres per pixel at a distance of one.
    pitch = 2.0 * tan / axis
    forward = unit(TARGET - ORIGIN)
    right = unit(np.cross(forward, [0.0, 1.0, 0.0]))
    up = np.cross(right, forward)
    dx = (x + 0.5 + shift[:, 0] - WIDTH / 2) * pitch
    dy = (y + 0.5 + shift[:, 1] - HEIGHT / 2) * pitch
    expected = unit(forward + dx[:, None] * right - dy[:, None] * up)
    np.testing.assert_allclose(p.direction.numpy()[:COUNT], expected, atol=2e-6)
    np.testing.assert_allclose(p.origin.numpy()[:COUNT], np.broadcast_to(ORIGIN, (COUNT, 3)))


@pytest.mark.parametrize("transmission", [False, True])
def test_slots(transmission):
    """Samples of a pixel are neighbours; the state of a path is new; slots beyond the tile are not touched."""
    p, rays, _ = generate("box", 0.5, transmission=transmission)
    x, y, sample = expected_slots()
    np.testing.assert_array_equal(p.pixel.numpy()[:COUNT], y * WIDTH + x)
    np.testing.assert_array_equal(p.sample.numpy()[:COUNT], sample)
    assert (p.beta.numpy()[:COUNT] == 1.0).all()
    assert (p.L.numpy()[:COUNT] == 0.0).all()
    assert (p.pdf.numpy()[:COUNT] == 0.0).all()
    assert (p.eta.numpy()[:COUNT] == (1.0 if transmission else -1.0)).all()
    np.testing.assert_array_equal(rays.slots.numpy()[:COUNT], np.arange(COUNT))
    assert (p.pixel.numpy()[COUNT:] == 77777).all()
    assert np.isnan(p.direction.numpy()[COUNT:]).all()
    assert (rays.slots.numpy()[COUNT:] == -7).all()


def test_counters():
    """All that a pass counts starts anew; what outlives a pass stays."""
    _, _, counters = generate("box", 0.5)
    assert counters[queues.RAYS] == COUNT
    for index in (queues.HITS, queues.ESCAPED, queues.EMISSIVE, queues.SHADOW, queues.DEPTH):
        assert counters[index] == 0
    assert counters[queues.CONTINUE] == 1
    for index in (queues.STATUS, *queues.NONFINITE_STAGES.values()):
        assert counters[index] == 5
    assert counters.totals.numpy().tolist() == [0, 0, COUNT]


CROP = d.Crop(x=3, y=2, width=20, height=25)


@pytest.mark.parametrize("lens", [False, True])
def test_a_window_holds_pixels_of_the_whole_film(lens):
    """The same rays and keys to the last bit."""
    place = {"fov": 50.0, "to_world": LOOK_AT}
    camera = d.ThinLens(aperture_radius=0.3, focus_distance=2.0, **place) if lens else d.Perspective(**place)
    whole, _, _ = generate("box", 0.5, camera=camera)
    moved = (TILE[0] - CROP.x, TILE[1] - CROP.y, *TILE[2:])
    window, _, _ = generate("box", 0.5, camera=camera, tile=moved, crop=CROP)
    for name in ("origin", "direction", "pixel", "sample"):
        np.testing.assert_array_equal(getattr(window, name).numpy(), getattr(whole, name).numpy())
    assert (len(np.unique(whole.origin.numpy()[:COUNT], axis=0)) > 1) == lens


def test_the_lens_has_its_own_numbers():
    """The third and fourth of the camera's random numbers: a point of the lens goes with the numbers it was mapped from
    by the concentric map, whose radius is the larger of the two coordinates of the square."""
    camera = d.ThinLens(fov=50.0, aperture_radius=0.3, focus_distance=2.0, to_world=LOOK_AT)
    p, _, _ = generate("box", 0.5, camera=camera)
    x, y, sample = expected_slots()
    u = uniforms(SEED, y * WIDTH + x, sample, 0, int(PURPOSE_CAMERA))
    lens = p.origin.numpy()[:COUNT] - ORIGIN
    radius = 0.3 * np.abs(2.0 * u[:, 2:] - 1.0).max(axis=1)
    np.testing.assert_allclose(np.linalg.norm(lens, axis=1), radius, atol=2e-6)
    np.testing.assert_allclose(lens @ unit(TARGET - ORIGIN), 0.0, atol=1e-6)
