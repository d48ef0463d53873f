"""Meshes and images that no one should make: every render ends, is finite, and says what it left out."""

import struct
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from wavefront import Renderer
from wavefront.errors import SceneError
from wavefront.render import main
from wavefront.scene import description as d

NAN, INF = float("nan"), float("inf")
WHITE = d.TwoSided(front=d.Diffuse(reflectance=1.0))
SQUARE = [(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)]
# Always there, far behind, so that all scenes share their kernels: a mesh with normals, and one that emits a little.
FAR = [d.TransformStep(translate=(0.0, 0.0, -50.0))]
REST = [
    d.Mesh(vertices=SQUARE, faces=[(0, 1, 2)], normals=[(0.0, 0.0, 1.0)] * 4, to_world=FAR),
    d.Mesh(vertices=SQUARE, faces=[(0, 2, 3)], to_world=FAR, emitter=d.Area(radiance=1e-6)),
]
CAMERA = d.Perspective(fov=60.0, to_world=[d.TransformStep(translate=(0.0, 0.0, 3.0))])


def scene_of(*shapes, size=8, max_depth=4):
    return d.Scene(
        shapes=[*shapes, *REST],
        camera=CAMERA,
        emitters=[d.Constant(radiance=1.0)],
        film=d.Film(width=size, height=size),
        integrator=d.PathIntegrator(max_depth=max_depth, rr_depth=None),
    )


def render(scene, spp=2):
    """The image, finite, from which nothing was left out, and the warnings."""
    renderer = Renderer(scene, threads=1, seed=3)
    image = renderer.render(spp)
    assert sum(renderer.statistics.nonfinite.values()) == 0
    assert np.isfinite(image).all()
    assert (image >= 0.0).all()
    return image, renderer.warnings


def mesh(vertices, faces, **fields):
    return d.Mesh(vertices=np.asarray(vertices, np.float64), faces=np.asarray(faces), **fields)


# --- meshes that hold anything -----------------------------------------------------------------------------------

SPECIAL = [0.0, 1.0, -1.0, 0.5, 1e-7, 1e-13, 1e-20, 1e-30, 1e-45, 1e11, -1e12, 2e12, 1e19, 1e30, -1e38, 3e38, 1e39]
SPECIAL += [1e300, NAN, INF, -INF]
number = st.one_of(st.sampled_from(SPECIAL), st.floats(-2.0, 2.0))


@st.composite
def anything(draw):
    count = draw(st.integers(1, 12))
    numbers = st.lists(st.tuples(number, number, number), min_size=count, max_size=count)
    index = st.integers(0, count - 1)
    faces = draw(st.lists(st.tuples(index, index, index), min_size=1, max_size=24))
    fields = {"face_normals": draw(st.booleans()), "smooth_normals": draw(st.booleans())}
    if draw(st.booleans()):
        fields["normals"] = draw(numbers)
    if draw(st.booleans()):
        fields["uvs"] = [pair[:2] for pair in draw(numbers)]
    if draw(st.booleans()):
        fields["emitter"] = d.Area(radiance=1.0, two_sided=draw(st.booleans()))
    if draw(st.booleans()):
        fields["to_world"] = [d.TransformStep(scale=draw(st.sampled_from([-1.0, 1e-9, 1e9, (1.0, -1.0, 1e3)])))]
    return d.Mesh(vertices=draw(numbers), faces=faces, bsdf=WHITE, **fields)


def expected_to_stay(shape):
    """How many triangles can be rendered: finite, within 1e12, of some size, with an area in exact arithmetic."""
    scale = np.broadcast_to(shape.to_world[0].scale if shape.to_world else 1.0, 3)
    with np.errstate(over="ignore"):
        points = (np.asarray(shape.vertices, np.float64) * scale).astype(np.float32).astype(np.float64)
    stays = 0
    for face in shape.faces:
        corners = points[list(face)]
        if not (np.abs(corners) <= 1e12).all():
            continue
        a, b, c = ([Fraction(float(x)) for x in corner] for corner in corners)
        e, f = ([x - y for x, y in zip(corner, a, strict=True)] for corner in (b, c))
        area = any(e[i] * f[(i + 1) % 3] != e[(i + 1) % 3] * f[i] for i in range(3))
        stays += area and max(map(abs, e + f)) >= Fraction(1e-13)
    return stays


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(anything())
def test_any_mesh_ends_in_an_image_or_in_one_line(shape):
    stays = expected_to_stay(shape)
    if stays == 0:
        with pytest.raises(SceneError, match=r"^shapes\[0\]: empty mesh: no triangle can be rendered \([^\n]*\)$"):
            render(scene_of(shape))
        return
    _, warnings = render(scene_of(shape), spp=1)
    left_out = len(shape.faces) - stays
    assert any(f"{left_out} triangles are left out" in warning for warning in warnings) == (left_out > 0)


# --- one trouble at a time ---------------------------------------------------------------------------------------

BAD = [(NAN, 0.0, 0.5), (0.0, INF, 0.5), (1e30, 0.0, 0.5), (0.0, 0.0, -3e38), (1e39, 0.0, 0.0)]
TENT = [*SQUARE, (0.0, 0.0, 0.8)]
SIDES = [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)]


def test_what_is_left_out_changes_nothing_else():
    """Bit for bit the image of the mesh without those triangles: they reach neither the tree nor the light table."""
    emitter = d.Area(radiance=[1.0, 2.0, 3.0])
    clean, warnings = render(scene_of(mesh(TENT, SIDES, bsdf=WHITE, emitter=emitter)))
    assert not warnings
    faces = [*SIDES[:2], (5, 0, 1), (6, 1, 2), *SIDES[2:], (7, 8, 2), (9, 0, 1), (0, 0, 1)]
    image, warnings = render(scene_of(mesh(TENT + BAD, faces, bsdf=WHITE, emitter=emitter)))
    assert warnings == [
        "shapes[0]: 5 triangles are left out (3 with a coordinate that is not finite, 1 that reach beyond 1e+12 m, "
        "1 without area)"
    ]
    np.testing.assert_array_equal(image, clean)


def test_a_ply_file_of_nan(tmp_path):
    points = np.float32([*SQUARE, (NAN, 0.0, 0.0), (0.0, INF, 0.0)])
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    faces = b"".join(struct.pack("<B3i", 3, *face) for face in ((0, 1, 2), (0, 2, 3), (0, 1, 4), (4, 5, 0)))
    path = tmp_path / "a.ply"
    path.write_bytes(header.encode() + points.tobytes() + faces)
    image, warnings = render(scene_of(d.Mesh(file=str(path), bsdf=WHITE)))
    assert warnings == ["shapes[0]: 2 triangles are left out (2 with a coordinate that is not finite)"]
    np.testing.assert_array_equal(image, render(scene_of(mesh(SQUARE, [(0, 1, 2), (0, 2, 3)], bsdf=WHITE)))[0])


@pytest.mark.parametrize("normal", [(0.0, 0.0, 0.0), (NAN, 0.0, 0.0), (0.0, INF, 0.0), (1e300, 0.0, 0.0)])
def test_normals_without_a_direction_are_those_of_the_faces(normal):
    smooth = render(scene_of(mesh(TENT, SIDES, bsdf=WHITE, smooth_normals=True)))[0]
    image, warnings = render(scene_of(mesh(TENT, SIDES, bsdf=WHITE, normals=[normal] * 5)))
    np.testing.assert_array_equal(image, smooth)
    assert len(warnings) == (0 if normal == (0.0, 0.0, 0.0) else 1)


def test_inverted_normals():
    """Of the file against the winding: the side that the normals say is the front, as for a flipped mesh."""
    up, down = ([(0.0, 0.0, z)] * 4 for z in (1.0, -1.0))
    front = d.Diffuse(reflectance=0.5)
    kept = render(scene_of(mesh(SQUARE, [(0, 1, 2), (0, 2, 3)], bsdf=front, normals=up)))[0]
    turned = render(scene_of(mesh(SQUARE, [(2, 1, 0), (3, 2, 0)], bsdf=front, normals=up)))[0]
    black = render(scene_of(mesh(SQUARE, [(0, 1, 2), (0, 2, 3)], bsdf=front, normals=down)))[0]
    assert kept[4, 4].min() > 0.0
    assert turned[4, 4].min() > 0.0
    assert black[4, 4].max() == 0.0


def furnace(*shapes, size=8, spp=2):
    """White surfaces in an even light: whatever their shape, every path brings back 1 if none is caught."""
    scene = scene_of(*shapes, size=size, max_depth=1000)
    scene.shapes = scene.shapes[: -len(REST)]
    scene.integrator.nee = False
    image, _ = render(scene, spp)
    np.testing.assert_allclose(image, 1.0, rtol=2e-5)


def test_non_manifold():
    """Five triangles at one edge, one of them twice and one turned; a vertex where two cones touch; a T-junction."""
    turns = np.linspace(0.0, 5.0, 5)
    points = [(0.0, -1.0, 0.0), (0.0, 1.0, 0.0), *((np.cos(t), 0.0, np.sin(t)) for t in turns)]
    fan = [(0, 1, 2 + i) for i in range(5)] + [(0, 1, 3), (1, 0, 4)]
    cones = [*SIDES, *((a + 5, b + 5, 4) for a, b, _ in SIDES)]
    other = [(x, y, 1.6) for x, y, _ in SQUARE]
    junction = [(0.0, -1.0, 0.3), (0.0, 1.0, 0.3), (1.0, 0.0, 0.3), (0.0, 0.0, 0.3), (-1.0, 0.0, 0.3)]
    furnace(
        mesh(points, fan, bsdf=WHITE),
        mesh([*TENT, *other], [*cones[:4], *((a, b, c) for a, b, c in cones[4:])], bsdf=WHITE),
        mesh(junction, [(0, 1, 2), (0, 3, 4), (3, 1, 4)], bsdf=WHITE),
    )


def test_a_square_a_thousand_times():
    faces = [(0, 1, 2), (0, 2, 3), (1, 2, 3), (0, 1, 3)] * 250
    furnace(mesh(SQUARE, faces, bsdf=WHITE))
    points = np.tile(SQUARE, (250, 1))  # not only the same triangles, but other vertices
    furnace(mesh(points, np.arange(1000).reshape(250, 4)[:, [0, 1, 2]], bsdf=WHITE))


def slivers(count, seed=1):
    """Needles of lengths around 1 and widths of 1e-9 to 1e-3, in the ball around the origin."""
    rng = np.random.default_rng(seed)
    a = rng.normal(scale=0.5, size=(count, 3))
    b = a + rng.normal(scale=0.5, size=(count, 3))
    c = a + rng.random((count, 1)) * (b - a) + 10.0 ** rng.uniform(-9, -3, (count, 1)) * rng.normal(size=(count, 3))
    return np.stack([a, b, c], axis=1).reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def test_slivers():
    furnace(mesh(*slivers(3000), bsdf=WHITE))


def test_emissive_slivers():
    """Each is a light: all are sampled and found, and the two agree within noise that ends."""
    image, _ = render(scene_of(mesh(*slivers(3000), bsdf=WHITE, emitter=d.Area(radiance=1.0, two_sided=True))), spp=8)
    assert image.max() < 1e3


@pytest.mark.slow
def test_a_million_slivers():
    vertices, faces = slivers(1_000_000)
    furnace(mesh(vertices, faces, bsdf=WHITE), size=4, spp=1)


@pytest.mark.slow
def test_a_hundred_thousand_emissive_slivers():
    shape = mesh(*slivers(100_000), bsdf=WHITE, emitter=d.Area(radiance=1.0, two_sided=True))
    render(scene_of(shape, size=4), spp=1)


@pytest.mark.parametrize(
    ("faces", "words"),
    [
        ([(0, 1, 4)], "expected vertex indices from 0 to 3; found 4"),
        ([(0, -1, 2)], "found -1"),
        ([], "the mesh is empty"),
    ],
)
def test_indices_that_name_no_vertex_and_no_triangles_at_all(faces, words):
    with pytest.raises(SceneError, match=words):
        Renderer(scene_of(d.Mesh(vertices=SQUARE, faces=faces)))


def test_the_command_says_so_in_one_line(tmp_path, capsys):
    (tmp_path / "a.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    scene = tmp_path / "scene.json"
    scene.write_text('{"shapes": [{"type": "mesh", "file": "a.obj"}]}')
    assert main([str(scene), "-o", str(tmp_path / "out.exr"), "--quiet"]) == 2
    error = capsys.readouterr().err
    assert "empty mesh: no triangle can be rendered (1 with a coordinate that is not finite)" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out.exr").exists()


@pytest.mark.parametrize(
    "sphere", [{"radius": 1e-30}, {"radius": 1e30}, {"center": (0.0, -1e30, 0.0)}, {"center": (2e12, 0.0, 0.0)}]
)
def test_spheres_that_no_ray_can_hit(sphere):
    with pytest.raises(SceneError, match=r"shapes\[0\]: a sphere that 32-bit rays cannot hit") as caught:
        Renderer(scene_of(d.Sphere(**sphere)))
    assert "\n" not in str(caught.value)


def test_a_camera_too_far_away():
    scene = scene_of()
    scene.camera = d.Perspective(to_world=[d.TransformStep(translate=(0.0, 0.0, 1e30))])
    with pytest.raises(SceneError, match=r"camera\.to_world: the camera is beyond 1e\+13 m"):
        Renderer(scene)


@pytest.mark.parametrize("size", [1e-12, 1e11])
def test_the_ends_of_what_is_rendered(size):
    """Scaled with its camera: the triangles of the smallest and of the largest size are all there."""
    scale = [d.TransformStep(scale=size)]
    scene = scene_of(mesh(SQUARE, [(0, 1, 2), (0, 2, 3)], bsdf=d.Diffuse(reflectance=0.0), to_world=scale))
    scene.camera = d.Perspective(fov=30.0, to_world=[d.TransformStep(translate=(0.0, 0.0, 3.0)), *scale])
    scene.shapes = scene.shapes[:1]
    image, _ = render(scene)
    np.testing.assert_array_equal(image, 0.0)


# --- images of extreme shapes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(1, 1), (1, 16384), (16384, 1)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_textures_of_extreme_shapes(tmp_path, shape, dtype):
    """Seen directly, one pixel of the image along the texture's length: means of what the texture holds there."""
    values = np.random.default_rng(5).integers(0, np.iinfo(dtype).max, shape).astype(dtype)
    Image.fromarray(values).save(tmp_path / "a.png")
    texture = d.Bitmap(file=str(tmp_path / "a.png"), color_space="linear", filter="nearest")
    uvs = [(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)]
    black = d.Diffuse(reflectance=0.0)
    shapes = [mesh(SQUARE, [(0, 1, 2), (0, 2, 3)], uvs=uvs, bsdf=black, emitter=d.Area(radiance=texture))]
    camera = d.Perspective(fov=90.0, to_world=[d.TransformStep(translate=(0.0, 0.0, 1.0))])
    scene = d.Scene(shapes=shapes, camera=camera, film=d.Film(width=8, height=8))
    scene.integrator = d.PathIntegrator(max_depth=1)
    image, _ = render(scene, spp=512)
    linear = values / np.iinfo(dtype).max
    pixels = [part.mean() for part in np.array_split(linear.ravel(), 8)] if max(shape) > 1 else [linear.item()] * 8
    expected = np.broadcast_to(pixels, (8, 8)) if shape[0] == 1 else np.broadcast_to(pixels, (8, 8)).T
    # The mean of 512 even draws of variance 1/12 stays within 6 deviations.
    np.testing.assert_allclose(image[:, :, 0], expected, atol=6 * np.sqrt(1 / 12 / 512) if max(shape) > 1 else 1e-6)
