"""Meshes: geometry against closed forms and Mitsuba's own loaders, files written by hand, errors."""

import math

import numpy as np
import pytest
import trimesh

from wavefront.errors import SceneError, WavefrontError
from wavefront.scene import description as d
from wavefront.scene import meshes
from wavefront.scene.description import TransformStep

MIRROR = [TransformStep(scale=(-1.0, 2.0, 1.0)), TransformStep(translate=(1.0, 2.0, 3.0))]
SHEAR = [(1.0, 0.5, 0.0, 1.0), (0.0, 2.0, 0.3, 0.0), (0.2, 0.0, 1.0, 4.0), (0.0, 0.0, 0.0, 1.0)]

# A quad and a triangle, two groups, with seams in UVs and normals, polygons of mixed size.
OBJ = """# usemtl comment
o first
v 0 0 0
v 1 0 0
v 1 1 0.5
v 0 1 1
vt 0.1 0.2
vt 0.9 0.2
vt 0.9 0.7
vt 0.1 0.7
vn 0 0 1
vn 0 1 1
vn 1 0 1
g one
usemtl red
f 1/1/1 2/2/2 3/3/3 4/4/1
g two
# usemtl green
usemtl blue
v 2 0 0
f 2/4/1 5/2/3 3/1/2
g three
usemtl red
f 1/2/1 3/3/3 2/1/2
"""


def corners(mesh):
    """Positions, normals and UVs of every corner of every face."""
    arrays = (mesh.vertices, mesh.normals, mesh.uvs)
    return [None if array is None else array[mesh.faces] for array in arrays]


def mitsuba_corners(mi, shape):
    parameters = mi.traverse(shape)
    faces = np.array(parameters["faces"]).reshape(-1, 3)
    found = []
    for name, width in (("vertex_positions", 3), ("vertex_normals", 3), ("vertex_texcoords", 2)):
        values = np.array(parameters[name]).reshape(-1, width) if name in parameters else np.zeros((0, width))
        found.append(values[faces] if len(values) else None)
    return found


@pytest.fixture(scope="module")
def mi():
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def rolled(arrays):
    """The corners of every triangle, turned so that the one with the lowest first coordinates comes first."""
    order = [min(range(3), key=lambda i: tuple(triangle[i])) for triangle in arrays[0]]
    turn = (np.array(order)[:, None] + np.arange(3)) % 3
    return [None if array is None else np.take_along_axis(array, turn[:, :, None], axis=1) for array in arrays]


def assert_same_corners(ours, theirs):
    """Positions, normals and UVs of all corners agree, whichever corner a triangle starts with."""
    ours, theirs = rolled(ours), rolled(theirs)
    for name, a, b in zip(("vertices", "normals", "uvs"), ours, theirs, strict=False):
        assert (a is None) == (b is None), name
        if a is not None:
            np.testing.assert_allclose(a, b, atol=1e-6, err_msg=name)


def face_normals(mesh):
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.faces], 1, 0)
    return np.cross(b - a, c - a)


def area(mesh):
    return 0.5 * np.linalg.norm(face_normals(mesh), axis=1).sum()


def volume(mesh):
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.faces], 1, 0)
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0


# --- primitives ------------------------------------------------------------------------------------------------


def test_areas_and_volumes():
    assert area(meshes.tessellate(d.Rectangle())) == pytest.approx(4.0)
    assert area(meshes.tessellate(d.Disk())) == pytest.approx(np.pi, rel=1e-6)
    assert area(meshes.tessellate(d.Cube())) == pytest.approx(24.0)
    assert volume(meshes.tessellate(d.Cube())) == pytest.approx(8.0)


@pytest.mark.parametrize("transform", [[], MIRROR, SHEAR])
@pytest.mark.parametrize("shape", [d.Rectangle, d.Cube, d.Disk])
@pytest.mark.parametrize("flip", [False, True])
def test_winding_agrees_with_normals_and_outside_stays_outside(shape, transform, flip):
    mesh = meshes.tessellate(shape(to_world=transform, flip_normals=flip))
    normals = mesh.normals[mesh.faces[:, 0]]
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-6)
    unit = face_normals(mesh) / np.linalg.norm(face_normals(mesh), axis=1, keepdims=True)
    np.testing.assert_allclose(unit, normals, atol=5e-5)  # rounding of the thin triangles of the disk
    if shape is d.Cube:
        assert (volume(mesh) < 0.0) == flip
    elif transform is not SHEAR:
        assert (normals[:, 2] < 0.0).all() == flip


@pytest.mark.parametrize("name", ["rectangle", "cube", "disk"])
def test_uvs_are_those_of_mitsuba(mi, name):
    shape = {"rectangle": d.Rectangle, "cube": d.Cube, "disk": d.Disk}[name](to_world=SHEAR)
    mesh = meshes.tessellate(shape)
    scene = mi.load_dict({"type": "scene", "shape": {"type": name, "to_world": mi.ScalarTransform4f(SHEAR)}})
    weights = np.array((0.2, 0.3, 0.5))
    for face, normal in zip(mesh.faces[::5], face_normals(mesh)[::5], strict=True):
        point = weights @ mesh.vertices[face]
        direction = -normal / np.linalg.norm(normal)
        hit = scene.ray_intersect(mi.Ray3f(point - 0.01 * direction, direction))
        assert hit.is_valid()
        # on a disk u is the distance from the centre, which a fan only approximates
        tolerance = 2e-4 if name == "disk" else 2e-5
        np.testing.assert_allclose(weights @ mesh.uvs[face], np.array(hit.uv), atol=tolerance)
        np.testing.assert_allclose(np.array(hit.n), -direction, atol=2e-5)


def test_a_sphere_has_no_triangles():
    with pytest.raises(SceneError, match=r"^shapes\[2\]: a sphere has no triangles"):
        meshes.tessellate(d.Sphere(), "shapes[2]")


# --- files -----------------------------------------------------------------------------------------------------


def test_obj_against_mitsuba(mi, tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(OBJ)
    for ours, theirs in (({}, {}), ({"flip_v": False}, {"flip_tex_coords": False}), ({"to_world": SHEAR}, {})):
        options = {"to_world": mi.ScalarTransform4f(SHEAR)} if "to_world" in ours else {}
        shape = mi.load_dict({"type": "obj", "filename": str(path), **theirs, **options})
        mesh = meshes.tessellate(d.Mesh(file=str(path), **ours))
        assert len(mesh.faces) == 4
        assert_same_corners(corners(mesh), mitsuba_corners(mi, shape))


def test_obj_with_windows_line_ends_tabs_and_umlauts(tmp_path):
    found = []
    for name, text in {
        "a.obj": OBJ,
        "b.obj": OBJ.replace("\n", "\r\n"),
        "c.obj": OBJ.replace(" ", "\t"),
        "d.obj": OBJ.replace("red", "ÄÖÜ"),
    }.items():
        (tmp_path / name).write_bytes(text.encode("latin-1"))
        found.append(meshes.tessellate(d.Mesh(file=str(tmp_path / name))))
    for other in found[1:]:
        for name in ("vertices", "faces", "normals", "uvs"):
            np.testing.assert_array_equal(getattr(other, name), getattr(found[0], name))


def test_ply_polygons_of_mixed_size_become_fans(tmp_path):
    path = tmp_path / "a.ply"
    points = [(np.cos(t), np.sin(t), 0.0) for t in 2 * np.pi * np.arange(5) / 5]
    lines = ["ply", "format ascii 1.0", "element vertex 5", *(f"property float {name}" for name in "xyz")]
    lines += ["element face 2", "property list uchar int vertex_indices", "end_header"]
    lines += [f"{x} {y} {z}" for x, y, z in points] + ["5 0 1 2 3 4", "3 0 2 1", ""]
    path.write_text("\n".join(lines))
    mesh = meshes.tessellate(d.Mesh(file=str(path)))
    assert len(mesh.faces) == 4
    pentagon, ear = 2.5 * np.sin(2 * np.pi / 5), np.sin(2 * np.pi / 5) - 0.5 * np.sin(4 * np.pi / 5)
    assert area(mesh) == pytest.approx(pentagon + ear, rel=1e-6)


@pytest.mark.parametrize("header", ["s t", "u v"])
def test_ply_against_mitsuba(mi, tmp_path, header):
    path = tmp_path / "a.ply"
    names = ["x", "y", "z", "nx", "ny", "nz", *header.split()]
    rows = np.random.default_rng(5).uniform(-1.0, 1.0, (5, 8)).astype(np.float32)
    lines = ["ply", "format ascii 1.0", "element vertex 5", *(f"property float {name}" for name in names)]
    lines += ["element face 2", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(map(repr, map(float, row))) for row in rows] + ["3 4 1 2", "3 3 2 1", ""]
    path.write_text("\n".join(lines))
    mesh = meshes.tessellate(d.Mesh(file=str(path)))
    np.testing.assert_array_equal(mesh.vertices, rows[:, :3])  # the one that no face uses, too
    np.testing.assert_array_equal(mesh.uvs[1:], rows[1:, 6:])
    shape = mi.load_dict({"type": "ply", "filename": str(path)})
    assert_same_corners(corners(mesh), mitsuba_corners(mi, shape))
    flipped = meshes.tessellate(d.Mesh(file=str(path), flip_v=True))
    shape = mi.load_dict({"type": "ply", "filename": str(path), "flip_tex_coords": True})
    assert_same_corners(corners(flipped), mitsuba_corners(mi, shape))


@pytest.mark.parametrize("transform", [[], SHEAR])
def test_smooth_normals_against_mitsuba(mi, tmp_path, transform):
    path = tmp_path / "a.ply"
    ball = trimesh.creation.icosphere(1)
    meshes.write_ply(path, meshes.TriangleMesh(np.float32(ball.vertices), np.int32(ball.faces), None, None))
    options = {"to_world": mi.ScalarTransform4f(transform)} if transform else {}
    shape = mi.load_dict({"type": "ply", "filename": str(path), **options})
    mesh = meshes.tessellate(d.Mesh(file=str(path), smooth_normals=True, to_world=transform))
    assert_same_corners(corners(mesh)[:2], mitsuba_corners(mi, shape)[:2])
    assert meshes.tessellate(d.Mesh(file=str(path))).normals is None
    assert meshes.tessellate(d.Mesh(file=str(path), smooth_normals=True, face_normals=True)).normals is None


def test_face_normals_leave_out_those_of_the_file(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(OBJ)
    assert meshes.tessellate(d.Mesh(file=str(path), face_normals=True)).normals is None


def test_mirrored_mesh_keeps_its_outside(tmp_path):
    path = tmp_path / "ball.ply"
    ball = trimesh.creation.icosphere(2)
    normals = np.float32(ball.vertices)
    meshes.write_ply(path, meshes.TriangleMesh(np.float32(ball.vertices), np.int32(ball.faces), normals, None))
    for flip in (False, True):
        mesh = meshes.tessellate(d.Mesh(file=str(path), to_world=MIRROR, flip_normals=flip))
        assert np.sign(volume(mesh)) == (-1.0 if flip else 1.0)
        agreement = np.einsum("ij,ij->i", face_normals(mesh), mesh.normals[mesh.faces[:, 0]])
        assert (agreement > 0.0).all()


def test_ply_with_uvs_per_corner(tmp_path):
    path = tmp_path / "a.ply"
    lines = ["ply", "format ascii 1.0", "element vertex 4", *(f"property float {name}" for name in "xyz")]
    lines += ["element face 2", "property list uchar int vertex_indices", "property list uchar float texcoord"]
    lines += ["end_header", "0 0 0", "1 0 0", "1 1 0", "0 1 0"]
    lines += ["3 0 1 2 6 .1 .2 .3 .4 .5 .6", "3 0 2 3 6 .7 .8 .9 .1 .2 .3", ""]
    path.write_text("\n".join(lines))
    found = corners(meshes.tessellate(d.Mesh(file=str(path))))
    np.testing.assert_allclose(found[2].reshape(2, 6), [(0.1, 0.2, 0.3, 0.4, 0.5, 0.6), (0.7, 0.8, 0.9, 0.1, 0.2, 0.3)])
    np.testing.assert_array_equal(found[0][1], [(0, 0, 0), (1, 1, 0), (0, 1, 0)])


@pytest.mark.parametrize("suffix", ["glb", "gltf"])
def test_gltf_node_transforms_and_uvs(tmp_path, suffix):
    uvs = np.array([(0.1, 0.2), (0.9, 0.2), (0.5, 0.8)])
    vertices, faces = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]), np.array([(0, 1, 2)])
    visual = trimesh.visual.TextureVisuals(uv=np.column_stack([uvs[:, 0], 1.0 - uvs[:, 1]]))  # the writer turns v
    part = trimesh.Trimesh(
        vertices, faces, vertex_normals=np.tile((0.0, 0.0, 1.0), (3, 1)), visual=visual, process=False
    )
    scene = trimesh.Scene()
    for i, scale in enumerate(((2.0, 1.0, 1.0), (-1.0, 1.0, 1.0))):
        matrix = np.diag([*scale, 1.0])
        matrix[:3, 3] = (10.0 * i, 0.0, 5.0)
        scene.add_geometry(part, geom_name="part", node_name=f"node{i}", transform=matrix)
    path = tmp_path / f"a.{suffix}"
    if suffix == "glb":
        path.write_bytes(scene.export(file_type="glb", include_normals=True))
    else:
        for name, data in trimesh.exchange.gltf.export_gltf(scene, include_normals=True).items():
            (tmp_path / ("a.gltf" if name == "model.gltf" else name)).write_bytes(data)
    mesh = meshes.tessellate(d.Mesh(file=str(path)))
    assert len(mesh.faces) == 2
    lowest = mesh.vertices[mesh.faces].min(axis=(0, 1))
    np.testing.assert_allclose(lowest, (0.0, 0.0, 5.0), atol=1e-6)
    np.testing.assert_allclose(mesh.vertices[:, 0].max(), 10.0, atol=1e-6)
    np.testing.assert_allclose(area(mesh), 1.0 + 0.5, rtol=1e-6)
    assert (face_normals(mesh)[:, 2] > 0.0).all()  # the mirrored node keeps its front
    np.testing.assert_allclose(mesh.normals, np.tile((0.0, 0.0, 1.0), (6, 1)), atol=1e-6)
    np.testing.assert_allclose(mesh.uvs, np.tile(uvs, (2, 1)), atol=1e-6)


def test_write_ply_round_trip(tmp_path):
    random = np.random.default_rng(3)
    normals = random.normal(size=(9, 3))
    mesh = meshes.TriangleMesh(
        random.normal(size=(9, 3)).astype(np.float32),
        np.arange(9, dtype=np.int32).reshape(3, 3),
        (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        random.uniform(-2.0, 2.0, (9, 2)).astype(np.float32),
    )
    path = tmp_path / "a.ply"
    meshes.write_ply(path, mesh)
    assert [file.name for file in tmp_path.iterdir()] == ["a.ply"]
    back = meshes.tessellate(d.Mesh(file=str(path)))
    for name in ("vertices", "faces", "uvs"):
        np.testing.assert_array_equal(getattr(back, name), getattr(mesh, name))
    np.testing.assert_allclose(back.normals, mesh.normals, atol=1e-7)
    with pytest.raises(WavefrontError, match="cannot be written"):
        meshes.write_ply(tmp_path / "missing" / "a.ply", mesh)


def test_a_changed_file_is_read_again(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    shape = d.Mesh(file=str(path))
    assert area(meshes.tessellate(shape)) == 0.5
    path.write_text("v 0 0 0\nv 10 0 0\nv 0 10 0\nf 1 2 3\n")
    assert area(meshes.tessellate(shape)) == 50.0


NAN = float("nan")


def test_degenerate_triangles_are_dropped_and_counted():
    triangle = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (2.0, 0.0, 0.0)]
    mesh = meshes.tessellate(d.Mesh(vertices=triangle, faces=[(0, 1, 2), (0, 1, 3), (1, 1, 2)]))
    assert mesh.dropped == 2
    np.testing.assert_array_equal(mesh.faces, [(0, 1, 2)])


def test_what_cannot_be_rendered_is_counted_by_reason():
    vertices = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (NAN, 0.0, 0.0), (0.0, 1e30, 0.0), (1e-20, 0.0, 0.0)]
    vertices += [(0.0, 1e-20, 0.0), (1e300, 0.0, 0.0), (0.0, 0.0, -1.001e12)]
    faces = [(0, 1, 2), (0, 0, 1), (0, 1, 3), (3, 4, 1), (4, 1, 2), (0, 5, 6), (7, 1, 2), (8, 1, 2), (2, 1, 0)]
    uvs = [(0.0, 0.0)] * 8 + [(0.0, NAN)]
    normals = [(0.0, 0.0, 1.0)] * 7 + [(math.inf, 0.0, 1.0), (0.0, NAN, 0.0)]
    mesh = meshes.tessellate(d.Mesh(vertices=vertices, faces=faces, uvs=uvs, normals=normals))
    np.testing.assert_array_equal(mesh.faces, [(0, 1, 2), (2, 1, 0)])
    assert mesh.dropped == 7
    assert mesh.notes == (
        "2 normals that are not finite are replaced by those of the faces",
        "1 UVs that are not finite are replaced by (0, 0)",
        "7 triangles are left out (3 with a coordinate that is not finite, 2 that reach beyond 1e+12 m, 1 without "
        "area, 1 smaller than 1e-13 m)",
    )
    for array in (mesh.vertices, mesh.normals, mesh.uvs):
        assert np.isfinite(array).all()
    assert np.abs(mesh.vertices).max() == 1.0  # what is left out does not reach the bounds


def test_zero_normals_become_those_of_the_faces():
    vertices = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]
    normals = [(0.0, 0.0, 0.0), (0.0, 3.0, 4.0), (0.0, 0.0, 1.0)]
    mesh = meshes.tessellate(d.Mesh(vertices=vertices, faces=[(0, 1, 2)], normals=normals))
    np.testing.assert_allclose(mesh.normals, [(0.0, 0.0, 1.0), (0.0, 0.6, 0.8), (0.0, 0.0, 1.0)], atol=1e-7)


# --- errors ----------------------------------------------------------------------------------------------------

TRIANGLE = {"vertices": [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)], "faces": [(0, 1, 2)]}


@pytest.mark.parametrize(
    ("changes", "path", "words"),
    [
        ({"faces": [(0, 1, 3)]}, "s.faces", "index out of range: faces[0] is 0, 1, 3 and there are 3 vertices"),
        ({"faces": [(0, 1, -1)]}, "s.faces", "index out of range"),
        ({"faces": []}, "s", "empty mesh"),
        ({"vertices": []}, "s", "empty mesh"),
        ({"faces": None}, "s", "needs both vertices and faces"),
        ({"faces": None, "vertices": None}, "s", "found neither"),
        ({"file": "a.ply"}, "s", "found both"),
        ({"faces": [(0, 0, 1)]}, "s", "empty mesh: no triangle can be rendered (1 without area)"),
        (
            {"vertices": [(0.0, NAN, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]},
            "s",
            "(1 with a coordinate that is not fin",
        ),
        ({"vertices": [(0.0, 1e300, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]}, "s", "(1 with a coordinate that is not"),
        ({"vertices": [(0.0, 2e12, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]}, "s", "(1 that reach beyond 1e+12 m)"),
        ({"vertices": [(0.0, 0.0, 0.0), (1e-14, 0.0, 0.0), (0.0, 1e-14, 0.0)]}, "s", "(1 smaller than 1e-13 m)"),
        ({"normals": [(0.0, 0.0, 1.0)]}, "s.normals", "1 normals for 3 vertices"),
        ({"uvs": [(0.0, 0.0)] * 4}, "s.uvs", "4 uvs for 3 vertices"),
        ({"to_world": [TransformStep(scale=0.0)]}, "s.to_world", "not invertible"),
    ],
)
def test_inline_errors(changes, path, words):
    with pytest.raises(SceneError) as caught:
        meshes.tessellate(d.Mesh(**{**TRIANGLE, **changes}), "s")
    assert str(caught.value).startswith(path + ": ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


PLY_HEAD = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
PLY_FACE = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.obj", None, "file not found"),
        ("a.stl", "x", "not a mesh file; allowed: .ply, .obj, .gltf, .glb"),
        ("a.obj", "", "empty mesh"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "empty mesh"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "index out of range"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/2\n", "texture coordinates of its faces"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//1\nf 1 2 3\n", "normals of its faces"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\n", "relative (negative) indices"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "(1 with a coordinate that is not finite)"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 x 0\nf 1 2 3\n", "not a readable OBJ file"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0\nf 1/1 2/1 3/1\n", "uvs do not have 2 numbers each"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no triangle can be rendered (1 without area)"),
        ("a.ply", "not a ply", "not a readable PLY file"),
        ("a.ply", PLY_HEAD + "end_header\n0 0 0\n1 0 0\n0 1 0\n", "empty mesh"),
        ("a.ply", PLY_HEAD + PLY_FACE + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "index out of range"),
        ("a.ply", PLY_HEAD + PLY_FACE + "0 0 0\n1 0 0\n0 inf 0\n3 0 1 2\n", "(1 with a coordinate that is not finite)"),
        ("a.gltf", "{", "line 1, column 2: not JSON"),
        ("a.gltf", '{"asset": {"version": "2.0"}}', "empty mesh"),
        ("a.glb", "glTF", "not a GLB file"),
    ],
)
def test_file_errors(tmp_path, name, text, words):
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(SceneError) as caught:
        meshes.tessellate(d.Mesh(file=str(tmp_path / name)), "shapes[3]")
    assert str(caught.value).startswith(f"shapes[3].file: {tmp_path / name}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
