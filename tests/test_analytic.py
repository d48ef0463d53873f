"""Images whose radiance is known in closed form, through the whole renderer.

Where every path has the same value whatever its random numbers, the image is exact to roundings. Elsewhere a z-test
compares the mean over pixels of equal expectation; each test function raises a false alarm with a rate of 1e-4.
"""

import numpy as np
import pytest
from scipy import stats

from tests.chi_square import sidak
from wavefront import Renderer
from wavefront.scene import description as d

ROUNDINGS = 1e-5


def step(**fields):
    return d.TransformStep(**fields)


def look_at(origin, target, up=(0.0, 1.0, 0.0)):
    return [step(look_at=d.LookAt(origin=origin, target=target, up=up))]


def render(shapes, spp, camera=None, emitters=(), size=(16, 16), seed=1, **integrator):
    settings = {"max_depth": 1000, "rr_depth": None} | integrator
    scene = d.Scene(
        shapes=shapes,
        emitters=list(emitters),
        camera=camera or d.Perspective(fov=80.0),
        film=d.Film(width=size[0], height=size[1]),
        integrator=d.PathIntegrator(**settings),
    )
    renderer = Renderer(scene, threads=1, seed=seed)
    image = renderer.render(spp)
    assert sum(renderer.statistics.nonfinite.values()) == 0
    return image.astype(np.float64)


def check_mean(image, expected, tests):
    """z-test of the mean over pixels, all of which have the same expectation; grey scenes, so one channel."""
    values = image[..., 1].ravel()
    error = max(values.std(ddof=1) / np.sqrt(values.size), 3e-6 * expected)
    z = (values.mean() - expected) / error
    assert abs(z) < stats.norm.isf(0.5 * sidak(tests)), (values.mean(), expected, z)


# --- a closed surface that emits -----------------------------------------------------------------------------------


def emitting_room(kind, albedo):
    shape = {"sphere": d.Sphere, "cube": d.Cube}[kind]
    return [shape(flip_normals=True, bsdf=d.Diffuse(reflectance=albedo), emitter=d.Area(radiance=1.0))]


@pytest.mark.parametrize("kind", ["sphere", "cube"])
@pytest.mark.parametrize("albedo", [0.0, 0.5, 0.9])
def test_depth_cuts_the_geometric_series(kind, albedo):
    """Every path collects 1 + albedo + albedo^2 + ..., one term a segment: depth 1 is emission alone, 2 adds direct
    light. Exact without light sampling and roulette."""
    for depth in (1, 2, 3, 4, 10, 40):
        expected = sum(albedo**k for k in range(depth))
        image = render(emitting_room(kind, albedo), 1, max_depth=depth, nee=False)
        np.testing.assert_allclose(image, expected, rtol=ROUNDINGS)


@pytest.mark.parametrize("kind", ["sphere", "cube"])
def test_depth_with_light_sampling(kind):
    """The same in expectation with light sampling: no segment is lost or counted twice."""
    for depth in (1, 2, 3, 5):
        image = render(emitting_room(kind, 0.5), 64, max_depth=depth, nee=True, seed=depth)
        check_mean(image, 2.0 - 0.5 ** (depth - 1), 4)


@pytest.mark.parametrize("kind", ["sphere", "cube"])
@pytest.mark.parametrize("nee", [True, False])
def test_emitting_room(kind, nee):
    """Le / (1 - albedo), with roulette, whatever the albedo."""
    for albedo in (0.2, 0.5, 0.8):
        image = render(emitting_room(kind, albedo), 64, nee=nee, rr_depth=2, seed=int(10 * albedo))
        check_mean(image, 1.0 / (1.0 - albedo), 3)


def test_thousand_bounces():
    """A white room that emits: each of the 1000 segments adds 1."""
    image = render(emitting_room("sphere", 1.0), 1, max_depth=1000, nee=False, size=(8, 8))
    np.testing.assert_allclose(image, 1000.0, rtol=2e-5)


def test_coloured_room():
    """Channels do not mix, and roulette by the largest channel is unbiased in the others."""
    albedo = np.array([0.7, 0.4, 0.0])
    room = [
        d.Sphere(flip_normals=True, bsdf=d.Diffuse(reflectance=list(albedo)), emitter=d.Area(radiance=[1.0, 2.0, 3.0]))
    ]
    image = render(room, 64, nee=False, rr_depth=1)
    expected = np.array([1.0, 2.0, 3.0]) / (1.0 - albedo)
    for i in range(3):
        check_mean(np.repeat(image[..., i : i + 1], 3, axis=2), expected[i], 3)


# --- direct light --------------------------------------------------------------------------------------------------

DOWN = [step(rotate=d.Rotate(axis=(1.0, 0.0, 0.0), angle=90.0))]
UP = [step(rotate=d.Rotate(axis=(1.0, 0.0, 0.0), angle=-90.0))]
HEIGHT = 1.3


def rectangle_form_factor(a, b, h):
    """From a point to a parallel rectangle of half sides a, b centred above it (Siegel and Howell, C-11, times 4)."""
    x, y = a / h, b / h
    s, t = np.hypot(1.0, x), np.hypot(1.0, y)
    return 2.0 / np.pi * (x / s * np.arctan(y / s) + y / t * np.arctan(x / t))


EMITTER = d.Area(radiance=2.0)
LIGHTS = {
    "rectangle": (
        d.Rectangle(emitter=EMITTER, to_world=[step(scale=(0.7, 0.4, 1.0)), *DOWN, step(translate=(0.0, HEIGHT, 0.0))]),
        rectangle_form_factor(0.7, 0.4, HEIGHT),
    ),
    "small rectangle": (
        d.Rectangle(emitter=EMITTER, to_world=[step(scale=0.01), *DOWN, step(translate=(0.0, HEIGHT, 0.0))]),
        rectangle_form_factor(0.01, 0.01, HEIGHT),
    ),
    "disk": (
        d.Disk(emitter=EMITTER, to_world=[step(scale=0.6), *DOWN, step(translate=(0.0, HEIGHT, 0.0))]),
        0.6**2 / (0.6**2 + HEIGHT**2),
    ),
    "sphere": (d.Sphere(emitter=EMITTER, center=(0.0, HEIGHT, 0.0), radius=0.5), (0.5 / HEIGHT) ** 2),
    "near sphere": (
        d.Sphere(emitter=EMITTER, center=(0.0, HEIGHT, 0.0), radius=HEIGHT - 0.01),
        (1.0 - 0.01 / HEIGHT) ** 2,
    ),
}


@pytest.mark.parametrize("nee", [True, False])
@pytest.mark.parametrize("name", LIGHTS)
def test_direct_light_on_a_plane(name, nee):
    """albedo Le F for the form factor F of the light from the point that a very narrow camera looks at."""
    light, form_factor = LIGHTS[name]
    floor = d.Rectangle(bsdf=d.Diffuse(reflectance=0.6), to_world=[step(scale=3.0), *UP])
    # From the side, below the light; almost along the floor where a sphere hangs just above it.
    eye = (2.0, 0.004 if name == "near sphere" else 0.3, 0.0)
    camera = d.Perspective(fov=1e-3, to_world=look_at(eye, (0.0, 0.0, 0.0)))
    spp = 64 if nee else 256
    if name == "small rectangle" and not nee:
        spp = 4096
    image = render([floor, light], spp, camera, max_depth=2, nee=nee, seed=len(name))
    check_mean(image, 0.6 * 2.0 * form_factor, len(LIGHTS) * 2)


@pytest.mark.parametrize("nee", [True, False])
def test_light_through_a_black_veil(nee):
    """A veil of opacity 0.3 lets 0.7 of the light pass. It blocks shadow rays, so what passes must come in full from
    paths that go straight through, and none of it twice. Depth 3: camera to floor, floor to veil, veil to lamp."""
    light, form_factor = LIGHTS["rectangle"]
    floor = d.Rectangle(bsdf=d.Diffuse(reflectance=0.6), to_world=[step(scale=3.0), *UP])
    black = d.Mask(bsdf=d.TwoSided(front=d.Diffuse(reflectance=0.0)), opacity=0.3)
    veil = d.Rectangle(bsdf=black, to_world=[step(scale=2.9), *DOWN, step(translate=(0.0, 0.7, 0.0))])
    camera = d.Perspective(fov=1e-3, to_world=look_at((2.0, 0.3, 0.0), (0.0, 0.0, 0.0)))
    image = render([floor, veil, light], 256, camera, max_depth=3, nee=nee, seed=3)
    check_mean(image, 0.7 * 0.6 * 2.0 * form_factor, 2)
    assert (render([floor, veil, light], 4, camera, max_depth=2, nee=nee) == 0.0).all()


# --- white furnace -------------------------------------------------------------------------------------------------

WHITE = {
    "diffuse": d.Diffuse(reflectance=1.0),
    "dielectric": d.Dielectric(int_ior=1.5, ext_ior=1.0),
    "mirror": d.Conductor(eta=0.0, k=1.0),
    "twosided": d.TwoSided(front=d.Diffuse(reflectance=1.0)),
    "mask": d.Mask(bsdf=d.TwoSided(front=d.Diffuse(reflectance=1.0)), opacity=0.5),
}
SKY = [d.Constant(radiance=1.0)]
FRONT_CAMERA = d.Perspective(fov=60.0, to_world=look_at((0.0, 0.0, 5.0), (0.0, 0.0, 0.0)))


def spheres_in_a_row(bsdfs):
    first = 0.5 - 0.5 * len(bsdfs)
    return [d.Sphere(center=(first + i, 0.0, 0.0), radius=0.45, bsdf=b) for i, b in enumerate(bsdfs)]


def test_white_furnace_is_exact():
    """Things that absorb nothing are invisible: without light sampling and roulette every path brings back 1."""
    image = render(spheres_in_a_row(WHITE.values()), 16, FRONT_CAMERA, SKY, size=(60, 12), nee=False)
    np.testing.assert_allclose(image, 1.0, rtol=ROUNDINGS)


@pytest.mark.parametrize("rr_depth", [1, 3])
@pytest.mark.parametrize("nee", [True, False])
def test_white_furnace_in_expectation(nee, rr_depth):
    """The same with light sampling and roulette."""
    image = render(spheres_in_a_row(WHITE.values()), 64, FRONT_CAMERA, SKY, size=(60, 12), nee=nee, rr_depth=rr_depth)
    check_mean(image, 1.0, 4)


ROUGH = {
    # BSDF, and the least albedo: single scattering loses what would leave after further bounces in the surface.
    "dielectric 0.1": (d.RoughDielectric(int_ior=1.5, ext_ior=1.0, alpha=0.1), 0.97),
    "dielectric 0.5": (d.RoughDielectric(int_ior=1.5, ext_ior=1.0, alpha=0.5, distribution="beckmann"), 0.75),
    "conductor 0.1": (d.RoughConductor(eta=0.0, k=1.0, alpha=0.1), 0.97),
    "conductor 0.5": (d.RoughConductor(eta=0.0, k=1.0, alpha=0.5, distribution="beckmann"), 0.8),
}


def test_rough_furnace_is_bounded():
    """Every factor of a path is at most 1, so no pixel is brighter than 1, and few paths are lost."""
    row = spheres_in_a_row([bsdf for bsdf, _ in ROUGH.values()])
    image = render(row, 64, FRONT_CAMERA, SKY, size=(60, 12), nee=False)
    assert image.max() <= 1.0 + ROUNDINGS
    for name, shape, (_, least) in zip(ROUGH, row, ROUGH.values(), strict=True):
        camera = d.Perspective(fov=6.0, to_world=look_at((shape.center[0], 0.0, 5.0), shape.center))
        alone = render([shape], 64, camera, SKY, nee=False)
        assert alone.max() <= 1.0 + ROUNDINGS, name
        assert alone.mean() > least, (name, alone.mean())


def test_rough_furnace_does_not_depend_on_light_sampling():
    """With and without: z-test of the difference of two independent images."""
    row = spheres_in_a_row([bsdf for bsdf, _ in ROUGH.values()])
    a, b = (render(row, 64, FRONT_CAMERA, SKY, size=(60, 12), nee=nee, seed=2 + nee) for nee in (True, False))
    difference = (a - b)[..., 1]
    z = difference.mean() / (difference.std(ddof=1) / np.sqrt(difference.size))
    assert abs(z) < stats.norm.isf(0.5e-4)
