"""glTF scenes: accessors and primitives against arrays written by hand, node transforms, lights, cameras, errors."""

import base64
import itertools
import json
import math
import struct

import numpy as np
import pytest

from tools.gltf_writer import GltfBuilder
from wavefront.errors import SceneError
from wavefront.scene import description as d
from wavefront.scene import gltf, gltf_document, load_scene, meshes
from wavefront.scene.gltf_accessors import read_accessor, read_primitive
from wavefront.scene.gltf_graph import local_matrix, world_nodes

TRIANGLE = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], np.float32)
RANGES = {"int8": 127, "uint8": 255, "int16": 32767, "uint16": 65535}


@pytest.fixture
def builder():
    return GltfBuilder()


def document(builder, tmp_path, suffix=".glb"):
    return gltf_document.Document(tmp_path / f"a{suffix}", builder.glb() if suffix == ".glb" else builder.gltf())


def load(builder, tmp_path, suffix=".glb", **parameters):
    """The scene and its warnings, without what all begin with."""
    path, found = builder.write(tmp_path / f"a{suffix}"), []
    scene = load_scene(path, parameters=parameters, warn=found.append)
    return scene, [message.removeprefix(f"{path}: ") for message in found]


def triangle_scene(builder, **node):
    """A scene of one triangle."""
    builder.scene(builder.add("nodes", mesh=builder.mesh(TRIANGLE, [(0, 1, 2)]), **node))
    return builder


# --- accessors -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize("stride", [False, True])
@pytest.mark.parametrize("kind", ["int8", "uint8", "int16", "uint16", "uint32", "float32"])
def test_accessors_of_every_type(builder, tmp_path, kind, stride, suffix):
    generator = np.random.default_rng(3)
    for width in (1, 2, 3, 4):
        if kind == "float32":
            values = generator.normal(size=(7, width)).astype(kind)
        else:
            values = generator.integers(np.iinfo(kind).min, np.iinfo(kind).max, (7, width), kind, endpoint=True)
        builder.view(b"\1\2\3")  # so that the next does not begin at 0
        index = builder.accessor(values, stride=24 if stride else None)
        found = read_accessor(document(builder, tmp_path, suffix), index, "")
        assert found.dtype == values.dtype
        np.testing.assert_array_equal(found, values)


def test_offset_into_an_interleaved_view(builder, tmp_path):
    table = np.arange(40, dtype=np.float32).reshape(5, 8)
    view = builder.view(table.tobytes(), byteStride=32)
    index = builder.add("accessors", bufferView=view, byteOffset=12, componentType=5126, count=5, type="VEC3")
    np.testing.assert_array_equal(read_accessor(document(builder, tmp_path), index, ""), table[:, 3:6])


@pytest.mark.parametrize("based", [False, True])
@pytest.mark.parametrize("kind", ["uint8", "uint16", "uint32"])
def test_sparse_accessors(builder, tmp_path, kind, based):
    base = np.arange(30, dtype=np.float32).reshape(10, 3) if based else np.zeros((10, 3), np.float32)
    new = np.array([(1, 2, 3), (4, 5, 6)], np.float32)
    at = np.array([2, 9], kind)
    sparse = {
        "count": 2,
        "indices": {
            "bufferView": builder.view(at.tobytes()),
            "componentType": {1: 5121, 2: 5123, 4: 5125}[at.itemsize],
        },
        "values": {"bufferView": builder.view(new.tobytes())},
    }
    if based:
        index = builder.accessor(base, sparse=sparse)
    else:
        index = builder.add("accessors", componentType=5126, count=10, type="VEC3", sparse=sparse)
    expected = base.copy()
    expected[[2, 9]] = new
    np.testing.assert_array_equal(read_accessor(document(builder, tmp_path), index, ""), expected)


@pytest.mark.parametrize(("kind", "normalized"), list(itertools.product(RANGES, [False, True])))
def test_quantised_attributes(builder, tmp_path, kind, normalized):
    builder.use("KHR_mesh_quantization")
    largest = RANGES[kind]
    lowest = -largest - 1 if kind.startswith("int") else 0
    corners = np.array([(lowest, 0, 0), (largest, 0, 1), (0, largest, 0)], kind)
    primitive = {"attributes": {"POSITION": builder.accessor(corners, stride=8, normalized=normalized)}}
    primitive["attributes"]["TEXCOORD_0"] = builder.accessor(corners[:, :2], stride=4, normalized=normalized)
    if normalized and kind.startswith("int"):
        primitive["attributes"]["NORMAL"] = builder.accessor(corners, stride=8, normalized=True)
    builder.add("meshes", primitives=[primitive])
    found = read_primitive(document(builder, tmp_path), 0, 0)
    # lowest / largest is a little below -1 for signed types, where the standard says -1
    expected = np.maximum(corners.astype(float) / largest, -1.0) if normalized else corners.astype(float)
    np.testing.assert_allclose(found.vertices, expected, rtol=1e-7)
    np.testing.assert_allclose(found.uvs, expected[:, :2], rtol=1e-7)
    assert (found.normals is None) == ("NORMAL" not in primitive["attributes"])


# --- primitives ------------------------------------------------------------------------------------------------

MODES = {
    4: [(0, 1, 2), (3, 4, 5)],
    5: [(0, 1, 2), (1, 3, 2), (2, 3, 4), (3, 5, 4)],
    6: [(1, 2, 0), (2, 3, 0), (3, 4, 0), (4, 5, 0)],
}


@pytest.mark.parametrize("kind", [None, "uint8", "uint16", "uint32"])
@pytest.mark.parametrize("mode", MODES)
def test_modes_and_indices(builder, tmp_path, mode, kind):
    primitive = {"attributes": {"POSITION": builder.accessor(np.zeros((6, 3), np.float32))}, "mode": mode}
    order = np.arange(6)
    if kind is not None:
        order = np.array([5, 0, 3, 1, 4, 2])
        primitive["indices"] = builder.accessor(order.astype(kind))
    builder.add("meshes", primitives=[primitive])
    found = read_primitive(document(builder, tmp_path), 0, 0)
    np.testing.assert_array_equal(found.faces, order[MODES[mode]])


@pytest.mark.parametrize("mode", [5, 6])
def test_strips_and_fans_face_one_way(builder, tmp_path, mode):
    """A flat strip of which every triangle is seen from the same side; the vertex order is that of the standard."""
    if mode == 5:
        vertices = np.array([(i // 2, i % 2, 0) for i in range(8)], np.float32)
    else:
        turn = np.linspace(0.0, 4.0, 8)
        vertices = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1).astype(np.float32)
        vertices[0] = 0
    builder.add("meshes", primitives=[{"attributes": {"POSITION": builder.accessor(vertices)}, "mode": mode}])
    mesh = read_primitive(document(builder, tmp_path), 0, 0)
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    up = np.cross(b - a, c - a)[:, 2]
    assert len({*np.sign(up)}) == 1 and len(up) == 6


def test_the_second_set_of_coordinates(builder, tmp_path):
    mesh = builder.mesh(TRIANGLE, uvs=TRIANGLE[:, :2])
    other = np.array([(0, 255), (51, 0), (255, 102)], np.uint8)
    attributes = builder.tree["meshes"][mesh]["primitives"][0]["attributes"]
    attributes["TEXCOORD_1"] = builder.accessor(other, stride=4, normalized=True)
    file = document(builder, tmp_path)
    np.testing.assert_array_equal(read_primitive(file, 0, 0, 0).uvs, TRIANGLE[:, :2])
    np.testing.assert_allclose(read_primitive(file, 0, 0, 1).uvs, [(0, 1), (0.2, 0), (1, 0.4)], rtol=1e-7)


def test_primitives_that_share_vertices_keep_their_own(builder, tmp_path):
    vertices = np.random.default_rng(4).normal(size=(9, 3)).astype(np.float32)
    mesh = builder.mesh(vertices, [(7, 2, 5), (2, 8, 7)], normals=-vertices, uvs=vertices[:, :2])
    found = read_primitive(document(builder, tmp_path), mesh, 0)
    used = [2, 5, 7, 8]
    np.testing.assert_array_equal(found.faces, [(2, 0, 1), (0, 3, 2)])
    for array, expected in ((found.vertices, vertices), (found.normals, -vertices), (found.uvs, vertices[:, :2])):
        np.testing.assert_array_equal(array, expected[used])


# --- nodes -----------------------------------------------------------------------------------------------------


def test_translation_rotation_scale(builder, tmp_path):
    """A quarter turn about Y takes +X to -Z; the scale acts first, the translation last."""
    builder.add("nodes", translation=[1, 2, 3], rotation=[0, math.sqrt(0.5), 0, math.sqrt(0.5)], scale=[2, 3, 4])
    found = local_matrix(document(builder, tmp_path), 0)
    expected = [[0, 0, 4, 1], [0, 3, 0, 2], [-2, 0, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(found, expected, atol=1e-15)


def test_rotations_are_those_of_rodrigues(builder, tmp_path):
    axis, angle = np.array([1.0, -2.0, 0.5]), 40.0
    unit = axis / np.linalg.norm(axis)
    half = math.radians(angle) / 2
    quaternion = [*(math.sin(half) * unit), math.cos(half)]
    expected = meshes.to_matrix([d.TransformStep(rotate=d.Rotate(axis=tuple(axis), angle=angle))])
    for scale in (1.0, 1e-30, 1e30):  # of any length
        builder.tree["nodes"] = [{"rotation": [scale * q for q in quaternion]}]
        np.testing.assert_allclose(local_matrix(document(builder, tmp_path), 0), expected, atol=1e-15)


def test_a_tree_of_matrices(builder, tmp_path):
    """The columns come first; a child is placed by its parent."""
    turn = [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]  # X to Y, Y to -X, then moved
    builder.add("nodes", matrix=turn, children=[1])
    builder.add("nodes", translation=[1, 0, 0])
    builder.scene(0)
    (_, first), (_, second) = world_nodes(document(builder, tmp_path))
    np.testing.assert_array_equal(first, [[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])
    np.testing.assert_array_equal(second @ (0, 0, 0, 1), (5, 7, 7, 1))


def test_a_mesh_used_twice_and_a_mirrored_one(builder, tmp_path):
    mesh = builder.mesh(TRIANGLE, name="part")
    builder.scene(
        builder.add("nodes", mesh=mesh, translation=[0, 0, 5]), builder.add("nodes", mesh=mesh, scale=[-1, 1, 1])
    )
    scene, _ = load(builder, tmp_path)
    assert [shape.name for shape in scene.shapes] == ["part", "part 2"]
    for shape in scene.shapes:
        triangles = meshes.tessellate(shape)
        a, b, c = triangles.vertices[triangles.faces[0]]
        assert np.cross(b - a, c - a)[2] > 0  # outside stays outside
    np.testing.assert_array_equal(meshes.tessellate(scene.shapes[0]).vertices, TRIANGLE + np.float32((0, 0, 5)))


def test_a_large_mesh_used_often_is_stored_once(builder, tmp_path):
    """As instances, where the same nodes with a small mesh give copies; both are the same triangles."""
    count = gltf.INSTANCED_TRIANGLES // 2
    places = [[0, 0, 5], [0, 2, 0], [-3, 0, 0]]
    for triangles in (count, count - 1):
        points = np.tile(TRIANGLE, (triangles, 1)) + np.repeat(np.arange(triangles, dtype=np.float32), 3)[:, None]
        mesh = builder.mesh(points, name="part")
        nodes = [builder.add("nodes", mesh=mesh, translation=place, scale=[-1, 2, 1]) for place in places]
        builder.scene(*nodes, name=str(triangles))
    many, few = (load(builder, tmp_path, scene=str(n))[0] for n in (count, count - 1))
    assert (len(many.groups), len(many.instances), len(many.shapes)) == (1, 3, 0)
    assert (len(few.groups), len(few.instances), len(few.shapes)) == (0, 0, 3)
    (shape,) = many.groups[0].shapes
    assert shape.to_world == [] and shape.part.mesh == 0
    for instance, copy, place in zip(many.instances, few.shapes, places, strict=True):
        assert instance.group == many.groups[0].name
        assert instance.to_world == copy.to_world
        np.testing.assert_array_equal(np.array(instance.to_world)[:3, 3], place)


def test_a_large_mesh_that_emits_is_copied(builder, tmp_path):
    material = builder.add("materials", emissiveFactor=[1, 1, 1])
    mesh = builder.mesh(np.tile(TRIANGLE, (gltf.INSTANCED_TRIANGLES, 1)), material=material)
    builder.scene(builder.add("nodes", mesh=mesh), builder.add("nodes", mesh=mesh, translation=[0, 0, 1]))
    scene, _ = load(builder, tmp_path)
    assert len(scene.shapes) == 2 and not scene.groups


def test_orthographic_camera(builder, tmp_path):
    view = {"xmag": 3.0, "ymag": 1.5, "znear": 0.1, "zfar": 9}
    camera = builder.add("cameras", type="orthographic", orthographic=view)
    builder.scene(builder.add("nodes", camera=camera, translation=[1, 2, 3], scale=[5, 5, 5]))
    scene, _ = load(builder, tmp_path)
    assert isinstance(scene.camera, d.Orthographic)
    assert scene.camera.width == 6.0
    assert (scene.film.width, scene.film.height) == (512, 256)
    np.testing.assert_array_equal(np.array(scene.camera.to_world)[:, 3], (1, 2, 3, 1))
    np.testing.assert_allclose(np.array(scene.camera.to_world)[:3, :3], np.eye(3), atol=1e-12)


def test_scenes_are_chosen_by_name_or_number(builder, tmp_path):
    for x in range(3):
        builder.scene(builder.add("nodes", mesh=builder.mesh(TRIANGLE), translation=[x + 1, 0, 0]), name=f"s{x}")
    builder.tree["scene"] = 1
    where = [load(builder, tmp_path, **p)[0].shapes[0].to_world[0][3] for p in ({}, {"scene": "s2"}, {"scene": "0"})]
    assert where == [2.0, 3.0, 1.0]
    with pytest.raises(SceneError, match=r"unknown scene 's9'; known: 's0', 's1', 's2'"):
        load(builder, tmp_path, scene="s9")
    del builder.tree["scene"]
    assert load(builder, tmp_path)[0].description == "s0"


def test_a_file_without_scenes(builder, tmp_path):
    triangle_scene(builder)
    builder.add("nodes", children=[0], translation=[0, 3, 0])
    del builder.tree["scenes"]
    scene, _ = load(builder, tmp_path)
    assert [shape.to_world[1][3] for shape in scene.shapes] == [3.0]


# --- lights ----------------------------------------------------------------------------------------------------


def light(builder, node=None, **fields):
    builder.use("KHR_lights_punctual")
    lights = builder.tree.setdefault("extensions", {}).setdefault("KHR_lights_punctual", {"lights": []})["lights"]
    lights.append(fields)
    return builder.add("nodes", extensions={"KHR_lights_punctual": {"light": len(lights) - 1}}, **(node or {}))


def test_lights(builder, tmp_path):
    down = {"rotation": [-math.sqrt(0.5), 0, 0, math.sqrt(0.5)], "translation": [1, 2, 3]}  # -Z to -Y
    builder.scene(
        light(builder, down, type="directional", intensity=3, name="sun"),
        light(builder, down, type="point", color=[1, 0.5, 0.25], intensity=8, range=10),
        light(builder, down | {"scale": [3, 3, 3]}, type="spot", spot={"innerConeAngle": 0.1, "outerConeAngle": 0.5}),
        light(builder, None, type="spot"),
    )
    scene, warnings = load(builder, tmp_path)
    sun, point, spot, plain = scene.emitters
    assert (sun.name, sun.irradiance, point.position, point.intensity) == ("sun", 3.0, (1, 2, 3), [8.0, 4.0, 2.0])
    np.testing.assert_allclose(sun.direction, (0, -1, 0), atol=1e-12)
    np.testing.assert_allclose(spot.direction, (0, -3, 0), atol=1e-12)  # lengths have no meaning
    np.testing.assert_allclose((spot.beam_width, spot.cutoff_angle), np.degrees((0.1, 0.5)))
    assert (plain.direction, plain.cutoff_angle, plain.beam_width) == ((0, 0, -1), 45.0, 0.0)
    assert any("lights[1]: range is left out" in message for message in warnings)


# --- cameras ---------------------------------------------------------------------------------------------------


def camera(builder, node=None, name="", **perspective):
    fields = {"name": name} if name else {}
    index = builder.add("cameras", type="perspective", perspective={"yfov": 0.5} | perspective, **fields)
    return builder.add("nodes", camera=index, **(node or {}))


def test_cameras(builder, tmp_path):
    triangle_scene(builder)
    nodes = builder.tree["scenes"][0]["nodes"]
    nodes.append(camera(builder, {"translation": [0, 0, 9], "scale": [2, 5, 2]}, aspectRatio=1.6, name="front"))
    nodes.append(camera(builder, name="back", aspectRatio=0.5))
    scene, warnings = load(builder, tmp_path)
    assert warnings[0] == "cameras: the scene has 2 cameras; the first is used, 'front'"
    np.testing.assert_allclose((scene.camera.fov, scene.film.width, scene.film.height), (math.degrees(0.5), 512, 320))
    assert scene.camera.fov_axis == "y"
    np.testing.assert_array_equal(scene.camera.to_world, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 9], [0, 0, 0, 1]])
    for wanted in ("back", "1"):
        scene, warnings = load(builder, tmp_path, camera=wanted)
        assert (scene.camera.to_world, scene.film.width, scene.film.height) == ([], 256, 512)
        assert not any("camera" in message for message in warnings)
    with pytest.raises(SceneError, match=r"unknown camera 'bak'; did you mean 'back'\? known: 'back', 'front'"):
        load(builder, tmp_path, camera="bak")
    with pytest.raises(SceneError, match="unknown parameter 'kamera'; did you mean 'camera'"):
        load(builder, tmp_path, kamera="1")


def test_a_camera_is_made_where_there_is_none(builder, tmp_path):
    scene, warnings = load(triangle_scene(builder, translation=[100, 0, 0]), tmp_path)
    assert "cameras: the scene has no camera; one is put where it sees all meshes" in warnings
    matrix = np.array(scene.camera.to_world)
    corners = TRIANGLE + np.array((100, 0, 0)) - matrix[:3, 3]
    assert (np.abs(corners[:, :2]) <= -corners[:, 2:] * math.tan(math.radians(scene.camera.fov / 2))).all()


# --- what is left out ------------------------------------------------------------------------------------------


def test_warnings(builder, tmp_path):
    mesh = builder.mesh(TRIANGLE)
    primitive = builder.tree["meshes"][mesh]["primitives"][0]
    primitive["attributes"]["COLOR_0"] = primitive["attributes"]["POSITION"]
    primitive["targets"] = [{"POSITION": 0}]
    builder.tree["meshes"][mesh]["primitives"].append({"attributes": primitive["attributes"], "mode": 1})
    builder.tree["meshes"][mesh]["primitives"].append({"attributes": {}})
    builder.use("EXT_something")
    builder.tree["animations"] = [{}]
    builder.add("skins", joints=[0])
    builder.scene(
        builder.add("nodes", mesh=mesh, skin=0, weights=[0.5]),
        builder.add("nodes", mesh=mesh, scale=[0, 1, 1]),
        builder.add("nodes", mesh=mesh, weights=[0.5]),  # what is left out of the mesh is said once
    )
    scene, warnings = load(builder, tmp_path)
    assert len(scene.shapes) == 2
    for words in (
        "extensionsUsed[0]: EXT_something is not supported and left out",
        "animations: animations are left out",
        "nodes[0].skin: skins are not supported",
        "meshes[0]: morph targets are not supported",
        "meshes[0].primitives[0]: vertex colours are left out",
        "meshes[0].primitives[1]: points and lines are left out",
        "meshes[0].primitives[2]: has no POSITION",
        "nodes[1]: is scaled to nothing",
    ):
        assert len([message for message in warnings if message.startswith(words)]) == 1, words


# --- files -----------------------------------------------------------------------------------------------------


def test_external_buffers_with_odd_names(builder, tmp_path):
    triangle_scene(builder)
    (tmp_path / "sub folder").mkdir()
    (tmp_path / "sub folder" / "100% ü.bin").write_bytes(builder.data)
    for uri in ("sub%20folder/100%25%20%C3%BC.bin", "sub folder/100%25 ü.bin"):
        builder.tree["buffers"] = [{"uri": uri, "byteLength": len(builder.data)}]
        (tmp_path / "a.gltf").write_text(json.dumps(builder.tree))
        scene = load_scene(tmp_path / "a.gltf")
        np.testing.assert_array_equal(meshes.tessellate(scene.shapes[0]).vertices, TRIANGLE)


def test_data_uris(builder, tmp_path):
    triangle_scene(builder)
    data = bytes(builder.data)
    percent = "".join(f"%{byte:02x}" for byte in data)
    for uri in (f"data:;base64,{base64.b64encode(data).decode()}", f"data:application/gltf-buffer,{percent}"):
        builder.tree["buffers"] = [{"uri": uri, "byteLength": len(data)}]
        (tmp_path / "a.gltf").write_text(json.dumps(builder.tree))
        meshes.clear_cache()
        mesh = meshes.tessellate(load_scene(tmp_path / "a.gltf").shapes[0])
        np.testing.assert_array_equal(mesh.vertices, TRIANGLE)


def changed(steps, value):
    """A change of the tree: the value at `steps`; None takes it away."""

    def change(tree):
        for step in steps[:-1]:
            tree = tree[step]
        if value is None:
            del tree[steps[-1]]
        else:
            tree[steps[-1]] = value

    return change


PRIMITIVE = ["meshes", 0, "primitives", 0]
ERRORS = [
    (["asset", "version"], "1.0", "asset.version: version '1.0' is not supported"),
    (["extensionsRequired"], ["KHR_draco_mesh_compression"], "extensionsRequired[0]: the extension"),
    (["nodes", 0, "mesh"], 7, "nodes[0].mesh: index 7 is out of range; meshes has 1"),
    (["nodes", 0, "mesh"], -1, "nodes[0].mesh: expected an integer >= 0 or null; found -1"),
    (["nodes", 0, "camera"], 0, "nodes[0].camera: index 0 is out of range; cameras has 0"),
    (["nodes", 0, "children"], [0], "nodes[0].children: node 0 is reached twice"),
    (["nodes", 0, "children"], [3], "nodes[0].children[0]: index 3 is out of range"),
    (["nodes", 0, "rotation"], [0, 0, 0, 0], "nodes[0].rotation: the quaternion is zero"),
    (["nodes", 0, "matrix"], [1] * 16, "nodes[0].matrix: the last row of a transform must be 0 0 0 1"),
    (["nodes", 0, "matrix"], [1] * 9, "nodes[0].matrix: expected a list of 16 numbers or null"),
    (["nodes", 0, "translation"], [1e39, 0, 0], "nodes[0].translation: expected a number of at most"),
    (["nodes", 0, "extensions"], {"KHR_lights_punctual": {"light": 0}}, "lights has 0"),
    (["scene"], 4, "scene: index 4 is out of range; scenes has 1"),
    (["scenes", 0, "nodes"], [0, 0], "scenes[0].nodes[1]: node 0 is reached twice"),
    ([*PRIMITIVE, "material"], 2, "meshes[0].primitives[0].material: index 2 is out of range; materials has 0"),
]
GEOMETRY_ERRORS = [
    ([*PRIMITIVE, "indices"], 9, "meshes[0].primitives[0].indices: index 9 is out of range; accessors has 2"),
    ([*PRIMITIVE, "attributes", "POSITION"], 1, "expected VEC3 of float (5126); found SCALAR of unsigned int (5125)"),
    ([*PRIMITIVE, "indices"], 0, "indices: expected SCALAR of unsigned byte (5121)"),
    ([*PRIMITIVE, "attributes", "NORMAL"], 2, "attributes.NORMAL: index 2 is out of range"),
    ([*PRIMITIVE, "attributes", "TEXCOORD_0"], 0, "attributes.TEXCOORD_0: expected VEC2 of float (5126), normalized"),
    (["accessors", 1, "count"], 2, "triangles need a multiple of three corners; found 2"),
    (["accessors", 0, "count"], 2, "index out of range: 2, and there are 2 vertices"),
    (["accessors", 0, "count"], 9, "accessors[0]: 9 elements of 12 bytes do not fit into bufferViews[0] of 36 bytes"),
    (["accessors", 0, "count"], 10**30, "do not fit into bufferViews[0]"),
    (["accessors", 0, "bufferView"], 5, "accessors[0].bufferView: index 5 is out of range; bufferViews has 2"),
    (["accessors", 0, "byteOffset"], 4, "do not fit"),
    (["bufferViews", 0, "byteStride"], 8, "bufferViews[0].byteStride: byteStride is 8, but an element"),
    (["bufferViews", 0, "byteLength"], 999, "bufferViews[0]: ends at byte 999, but buffers[0] has 48 bytes"),
    (["bufferViews", 0, "buffer"], 1, "bufferViews[0].buffer: index 1 is out of range; buffers has 1"),
    (["accessors", 0, "sparse"], {"count": 4, "indices": {"bufferView": 1, "componentType": 5121},
      "values": {"bufferView": 0}}, "accessors[0].sparse.count: expected at most 3; found 4"),
    (["accessors", 0, "sparse"], {"count": 2, "indices": {"bufferView": 0, "componentType": 5121},
      "values": {"bufferView": 0}}, "accessors[0].sparse.indices: expected ascending indices below 3"),
]  # fmt: skip


@pytest.mark.parametrize(("steps", "value", "words"), ERRORS)
def test_errors_of_the_scene(builder, tmp_path, steps, value, words):
    changed(steps, value)(triangle_scene(builder).tree)
    with pytest.raises(SceneError) as caught:
        load(builder, tmp_path)
    assert str(caught.value).startswith(f"{tmp_path / 'a.glb'}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("steps", "value", "words"), GEOMETRY_ERRORS)
def test_errors_of_the_geometry(builder, tmp_path, steps, value, words):
    changed(steps, value)(triangle_scene(builder).tree)
    scene, _ = load(builder, tmp_path)
    with pytest.raises(SceneError) as caught:
        meshes.tessellate(scene.shapes[0], "shapes[0]")
    assert str(caught.value).startswith(f"shapes[0].file: {tmp_path / 'a.glb'}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("uri", "words"),
    [
        ("none.bin", "buffers[0].uri: file not found: 'none.bin'"),
        ("http://example.org/a.bin", "buffers[0].uri: 'http://example.org/a.bin' is not supported"),
        ("data:;base64,#", "buffers[0].uri: not base64"),
        ("data:;base64", "buffers[0].uri: a data URI without a comma"),
        ("data:;base64,AAAA", "buffers[0].byteLength: 48 bytes are declared; found 3"),
        ("%00", "buffers[0].uri: '%00' is not a path"),
        (None, "buffers[0]: has no uri, and the file has no binary chunk for it"),
    ],
)
def test_errors_of_buffers(builder, tmp_path, uri, words):
    triangle_scene(builder)
    builder.tree["buffers"] = [{"byteLength": 48} if uri is None else {"byteLength": 48, "uri": uri}]
    (tmp_path / "a.gltf").write_text(json.dumps(builder.tree))
    with pytest.raises(SceneError) as caught:
        meshes.tessellate(load_scene(tmp_path / "a.gltf").shapes[0])
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[:10], "not a GLB file: it ends after 10 bytes, in its header"),
        (lambda data: data[:-7], "the GLB file is truncated: it has"),
        (lambda data: data[:4] + struct.pack("<I", 1) + data[8:], "GLB version 1 is not supported"),
        (lambda data: data[:12] + struct.pack("<I", 10**6) + data[16:], "a chunk of 1000000 bytes at byte 12 passes"),
        (lambda data: data[:16] + b"BIN\0" + data[20:], "its first chunk is not JSON"),
        (lambda data: data[:20] + b"[" + data[21:], "not JSON"),
        (lambda data: data[:30] + b"\xff" + data[31:], "not UTF-8"),
        (lambda data: b"", "not JSON"),
    ],
)
def test_errors_of_containers(builder, tmp_path, change, words):
    (tmp_path / "a.glb").write_bytes(change(triangle_scene(builder).glb()))
    with pytest.raises(SceneError) as caught:
        load_scene(tmp_path / "a.glb")
    assert str(caught.value).startswith(f"{tmp_path / 'a.glb'}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
