"""Scales, radiances, shapes and images at the ends of what a scene may hold.

Nothing in the renderer knows an absolute length or radiance, so scaling either by a power of two must not change a
single bit of the image but its exponent.
"""

from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy import stats

from tests.chi_square import sidak
from tests.megakernel import render_megakernel
from wavefront import Renderer, load_scene
from wavefront.scene import description as d

SCENES = Path(__file__).parent.parent / "scenes"


def step(**fields):
    return d.TransformStep(**fields)


def load(name, width=32, height=32, *overrides):
    return load_scene(SCENES / f"{name}.json", [f"film.width={width}", f"film.height={height}", *overrides])


def render(scene, spp=4, seed=1):
    renderer = Renderer(scene, threads=1, seed=seed)
    image = renderer.render(spp)
    assert sum(renderer.statistics.nonfinite.values()) == 0
    assert np.isfinite(image).all()
    return image.astype(np.float64)


def scaled(scene, factor):
    more = [step(scale=factor)]
    scene.shapes = [msgspec.structs.replace(s, to_world=[*s.to_world, *more]) for s in scene.shapes]
    scene.camera.to_world = [*scene.camera.to_world, *more]
    return scene


# --- scale ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cornell-box", "glossy-plates", "material-mask"])
@pytest.mark.parametrize("exponent", [-10, 13])
def test_scale_by_a_power_of_two_changes_nothing(name, exponent):
    """Bit for bit: from millimetres to some ten kilometres."""
    reference = render(load(name))
    image = render(scaled(load(name), 2.0**exponent))
    different = (image != reference).any(axis=2)
    # Matrices go through float64 and rotations; what is left are shapes whose corners rounded differently.
    assert different.mean() <= 1e-3, different.sum()


@pytest.mark.parametrize("name", ["cornell-box", "glossy-plates"])
@pytest.mark.parametrize("factor", [1e-3, 1e4])
def test_scale(name, factor):
    """z-test of the means of 16 tiles against the unscaled scene with other random numbers; false-alarm rate 1e-4."""
    a, b = (
        np.stack([render(scaled(load(name), s), 4, seed=seed + k) for k in range(16)])
        for s, seed in ((1.0, 100), (factor, 200))
    )
    # 16 independent images each give the variance of a tile's mean.
    tiles = [x.mean(axis=3).reshape(16, 4, 8, 4, 8).mean(axis=(2, 4)).reshape(16, 16) for x in (a, b)]
    error = np.sqrt(sum(t.var(axis=0, ddof=1) for t in tiles) / 16)
    t = (tiles[0].mean(axis=0) - tiles[1].mean(axis=0)) / error
    # Student's distribution with the fewest degrees of freedom that Welch's formula can give.
    assert np.abs(t).max() < stats.t.isf(0.5 * sidak(16), 15)


# --- radiance ------------------------------------------------------------------------------------------------------


def with_radiance(scene, factor):
    for shape in scene.shapes:
        if shape.emitter is not None:
            shape.emitter = d.Area(radiance=[float(x) * factor for x in shape.emitter.radiance])
    for emitter in scene.emitters:
        emitter.radiance = [float(x) * factor for x in np.broadcast_to(emitter.radiance, 3)]
    return scene


@pytest.mark.parametrize("name", ["cornell-box", "material-mask"])
def test_radiance_scales_the_image(name):
    """Exact for powers of two; a rounding of the radiance itself for powers of ten."""
    reference = render(load(name))
    for factor in (2.0**-27, 2.0**27):
        np.testing.assert_array_equal(render(with_radiance(load(name), factor)), reference * factor)
    for factor in (1e-8, 1e8):
        np.testing.assert_allclose(render(with_radiance(load(name), factor)), reference * factor, rtol=1e-5)


def test_radiance_that_overflows_is_not_silent():
    """A path that collects 3e38 twice holds more than a float32 can: that is counted, and left out of the film."""
    room = [d.Sphere(flip_normals=True, bsdf=d.Diffuse(reflectance=1.0), emitter=d.Area(radiance=3e38))]
    integrator = d.PathIntegrator(max_depth=2, nee=False)
    renderer = Renderer(d.Scene(shapes=room, film=d.Film(width=4, height=4), integrator=integrator), threads=1)
    image = renderer.render(2)
    assert np.isfinite(image).all()
    assert sum(renderer.statistics.nonfinite.values()) > 0


# --- roughness -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["material-rough-conductor-ggx", "material-rough-dielectric"])
def test_least_and_largest_roughness(name):
    """Finite, nothing left out, and as bright as the smooth surface within what roughness explains."""
    means = {}
    for alpha in (1e-4, 1.0):
        scene = load(name)
        subject = next(s for s in scene.shapes if s.name == "subject")
        subject.bsdf.alpha = alpha
        means[alpha] = render(scene, 16).mean()
    assert 0.2 < means[1.0] / means[1e-4] < 2.0


def test_least_roughness_is_a_mirror():
    """alpha = 1e-4 reflects a checkered floor like a smooth conductor: z-test of the mean, false-alarm rate 1e-4.

    Without light sampling, whose few lucky samples have no useful variance on so narrow a lobe."""
    images = []
    for bsdf in (d.Conductor(material="Au"), d.RoughConductor(material="Au", alpha=1e-4)):
        scene = load("material-rough-conductor-ggx")
        scene.integrator.nee = False
        scene.integrator.rr_depth = None
        next(s for s in scene.shapes if s.name == "subject").bsdf = bsdf
        images.append(np.stack([render(scene, 4, seed=30 + 16 * len(images) + k).mean() for k in range(16)]))
    error = np.sqrt(sum(x.var(ddof=1) for x in images) / 16)
    assert abs(images[0].mean() - images[1].mean()) / error < stats.t.isf(0.5e-4, 15)


# --- geometry ------------------------------------------------------------------------------------------------------

SKY = [d.Constant(radiance=1.0)]
FLAT = [step(rotate=d.Rotate(axis=(1.0, 0.0, 0.0), angle=-90.0))]
WHITE = d.Diffuse(reflectance=1.0)


def furnace(shapes, camera, spp=4, size=(32, 32), **integrator):
    settings = {"max_depth": 50, "rr_depth": None, "nee": False} | integrator
    scene = d.Scene(
        shapes=shapes,
        emitters=SKY,
        camera=camera,
        film=d.Film(width=size[0], height=size[1]),
        integrator=d.PathIntegrator(**settings),
    )
    return render(scene, spp)


def view(origin, target, fov=40.0):
    return d.Perspective(fov=fov, to_world=[step(look_at=d.LookAt(origin=origin, target=target))])


@pytest.mark.parametrize("height", [1e-4, 1e-2, 10.0])
@pytest.mark.parametrize("extent", [1e-2, 1.0, 1e4])
def test_grazing_camera_over_a_white_floor(extent, height):
    """Every path leaves the floor at once and brings back 1: no self-intersection, no leak."""
    floor = d.Rectangle(bsdf=WHITE, to_world=[step(scale=extent), *FLAT])
    camera = view((0.0, height * extent, extent), (0.0, 0.0, -extent))
    np.testing.assert_allclose(furnace([floor], camera), 1.0, rtol=1e-5)


@pytest.mark.parametrize("angle", [0.0, 17.0, 90.0])
def test_tilted_plane_far_from_the_origin(angle):
    """At a distance of 1e4 a float32 position is off by a millimetre; the offset follows."""
    there = (7000.0, 3000.0, -5000.0)
    plane = d.Rectangle(
        bsdf=WHITE,
        to_world=[step(rotate=d.Rotate(axis=(1.0, 0.3, 0.2), angle=angle)), step(translate=there)],
    )
    # In front of the plane, whatever its angle, is along its normal.
    axis = np.array([1.0, 0.3, 0.2]) / np.linalg.norm([1.0, 0.3, 0.2])
    a = np.radians(angle)
    z = np.array([0.0, 0.0, 1.0])
    normal = z * np.cos(a) + np.cross(axis, z) * np.sin(a) + axis * (axis @ z) * (1.0 - np.cos(a))
    camera = view(tuple(np.add(there, 3.0 * normal)), there)
    np.testing.assert_allclose(furnace([plane], camera), 1.0, rtol=1e-5)


def test_coincident_triangles():
    """The same square three times, cut along other diagonals and with other corners: one white surface all the same.

    Paths may meet several copies, but none may get caught behind one."""
    corners = [(-1.0, 0.0, -1.0), (-1.0, 0.0, 1.0), (1.0, 0.0, 1.0), (1.0, 0.0, -1.0)]
    squares = [
        d.Mesh(vertices=corners, faces=[(0, 1, 2), (0, 2, 3)], bsdf=WHITE),
        d.Mesh(vertices=corners, faces=[(0, 1, 3), (1, 2, 3)], bsdf=WHITE),
        d.Mesh(vertices=[(0.0, 0.0, 0.0), *corners], faces=[(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1)], bsdf=WHITE),
    ]
    camera = view((0.3, 1.0, 2.0), (0.0, 0.0, 0.0))
    for turn in (0.0, 33.0):
        turned = [step(rotate=d.Rotate(axis=(1.0, 2.0, 3.0), angle=turn))]
        shapes = [msgspec.structs.replace(s, to_world=turned) for s in squares]
        moved = d.Perspective(fov=40.0, to_world=[*camera.to_world, *turned])
        np.testing.assert_allclose(furnace(shapes, moved, spp=16), 1.0, rtol=1e-5)


def test_degenerate_triangles():
    """Triangles without area are left out with a note; needles next to them do no harm."""
    vertices = [(-1.0, 0.0, -1.0), (-1.0, 0.0, 1.0), (1.0, 0.0, 1.0), (1.0, 0.0, -1.0)]
    vertices += [(0.0, 0.0, 1e-7), (0.0, 0.0, 0.0)]
    faces = [(0, 1, 2), (0, 2, 3), (0, 0, 1), (2, 2, 2), (0, 5, 2), (1, 4, 5), (0, 2, 4)]
    mesh = d.Mesh(vertices=vertices, faces=faces, bsdf=d.TwoSided(front=WHITE))
    scene = d.Scene(shapes=[mesh], emitters=SKY, camera=view((0.3, 1.0, 2.0), (0.0, 0.0, 0.0)))
    scene.film = d.Film(width=32, height=32)
    scene.integrator = d.PathIntegrator(max_depth=50, rr_depth=None, nee=False)
    renderer = Renderer(scene, threads=1)
    assert any("without area" in note for note in renderer.warnings)
    np.testing.assert_allclose(renderer.render(16), 1.0, rtol=1e-5)


@pytest.mark.parametrize("size", [1e-6, 1e-4, 1e6])
def test_tiny_and_huge_meshes(size):
    """A white cube of a micrometre and one of a thousand kilometres."""
    cube = d.Cube(bsdf=WHITE, to_world=[step(scale=size)])
    camera = view((1.5 * size, 2.0 * size, 4.0 * size), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(furnace([cube], camera), 1.0, rtol=1e-5)


@pytest.mark.parametrize("size", [1e-12, 1e12])
def test_sizes_whose_squares_leave_the_range_of_floats(size):
    """The cross product of two edges is some size^2, and its squared length size^4: neither is a length of a scene."""
    cube = d.Cube(bsdf=WHITE, to_world=[step(scale=size)])
    camera = view((1.5 * size, 2.0 * size, 4.0 * size), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(furnace([cube], camera), 1.0, rtol=1e-5)


# --- images and paths ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "height"), [(1, 1), (4001, 3), (3, 1501), (1, 40)])
def test_image_shapes(width, height):
    """Every pixel is there once and in its place: against the megakernel."""
    scene = load("cornell-box", width, height, "integrator.max_depth=3")
    renderer = Renderer(scene, threads=1, seed=9)
    image = renderer.render(1)
    assert image.shape == (height, width, 3)
    expected = render_megakernel(renderer, 1)
    error = np.abs(image - expected).max(axis=2)
    assert (error > 1e-5 * np.maximum(expected.max(axis=2), 1e-3)).mean() <= 1e-3


@pytest.mark.parametrize("spp", [1, 2, 1025])
def test_sample_counts(spp):
    """A path is counted once: a room where each brings back 1.5."""
    room = [d.Cube(flip_normals=True, bsdf=d.Diffuse(reflectance=0.5), emitter=d.Area(radiance=1.0))]
    integrator = d.PathIntegrator(max_depth=2, nee=False)
    renderer = Renderer(d.Scene(shapes=room, film=d.Film(width=5, height=3), integrator=integrator), threads=1)
    np.testing.assert_allclose(renderer.render(spp), 1.5, rtol=1e-6)
    assert renderer.statistics.paths == 15 * spp
    assert renderer.statistics.rays == 2 * 15 * spp
    assert renderer.statistics.sample_count == spp
