"""glTF files with random damage: each is a scene whose parts can be read or is refused with one line."""

from __future__ import annotations

import copy
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scene.test_fuzz import containers, damage, garble, one_line
from tools.gltf_scene import still_life
from tools.gltf_writer import GltfBuilder
from wavefront.errors import SceneError
from wavefront.scene import description as d
from wavefront.scene import json_format, load_scene, meshes
from wavefront.scene.lookup import walk
from wavefront.scene.texture_upload import load_bitmap


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("gltf")


@pytest.fixture(scope="module")
def original():
    """The still life, and in it one of each that it has not."""
    b = still_life()
    quad = b.tree["meshes"][0]["primitives"][0]
    values = {"bufferView": b.view(bytes(12))}
    sparse = {"count": 1, "indices": {"bufferView": b.view(b"\1"), "componentType": 5121}, "values": values}
    b.tree["accessors"][quad["attributes"]["POSITION"]]["sparse"] = sparse
    b.tree["materials"][0]["normalTexture"] = {"index": 0, "scale": 0.5}
    b.tree["materials"][0]["extensions"] = {
        "KHR_materials_ior": {"ior": 1.4},
        "KHR_materials_clearcoat": {"clearcoatFactor": 0.5},
        "KHR_materials_transmission": {"transmissionFactor": 0.5},
    }
    b.add("nodes", matrix=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], mesh=0, children=[0])
    b.tree["scenes"].append({"nodes": [len(b.tree["nodes"]) - 1]})
    return b


def read_all(path):
    """Everything that rendering would read."""
    scene = load_scene(path)
    for i, shape in enumerate(scene.shapes):
        meshes.tessellate(shape, f"shapes[{i}]")
    for place, record in walk(scene):
        if isinstance(record, d.Bitmap):
            load_bitmap(record, place)
    return scene


def renumber(tree, draw):
    """Changes one integer: an index, an offset, a count, a type."""
    places = [
        (item, key) for item in containers(tree) for key in (item if isinstance(item, dict) else range(len(item)))
    ]
    places = [(item, key) for item, key in places if type(item[key]) is int]
    item, key = places[draw(st.integers(0, len(places) - 1))]
    item[key] = draw(st.sampled_from([0, 1, 2, 3, 4, 5, 6, 8, 16, 5121, 5123, 5126, item[key] - 1, item[key] + 1, 99]))


@settings(max_examples=150, deadline=None, derandomize=True)
@given(data=st.data())
@pytest.mark.parametrize("change", [damage, renumber])
def test_a_damaged_tree_is_refused_or_valid(folder, original, change, data):
    damaged = GltfBuilder()
    damaged.data, damaged.tree = original.data, copy.deepcopy(original.tree)
    for _ in range(data.draw(st.integers(1, 3))):
        change(damaged.tree, data.draw)
    path = folder / data.draw(st.sampled_from(["a.glb", "a.gltf"]))
    try:
        content = damaged.glb() if path.suffix == ".glb" else damaged.gltf()
    except (TypeError, AttributeError, ValueError):  # the writer wants a list of buffers
        content = json.dumps(damaged.tree).encode()
    path.write_bytes(content)
    meshes.clear_cache()
    try:
        scene = read_all(path)
    except SceneError as error:
        one_line(error)
        return
    again = folder / "again.json"
    json_format.dump(scene, again)
    assert load_scene(again) == scene


@settings(max_examples=150, deadline=None, derandomize=True)
@given(data=st.data())
def test_damaged_bytes_are_refused_or_valid(folder, original, data):
    content = original.glb()
    for _ in range(data.draw(st.integers(1, 3))):
        content = garble(content, data.draw)
    path = folder / "bytes.glb"
    path.write_bytes(content)
    meshes.clear_cache()
    try:
        assert read_all(path).shapes
    except SceneError as error:
        one_line(error)
