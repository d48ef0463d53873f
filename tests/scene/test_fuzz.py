"""Scene files with random damage: each is a valid scene or refused with one line, and nothing else can happen."""

from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavefront.errors import SceneError
from wavefront.scene import json_format, load_scene
from wavefront.scene.description import Scene

SCENES = Path(__file__).resolve().parents[2] / "scenes"
EVERYTHING = {
    "description": "every record type",
    "include": ["include/material-stage.json"],
    "camera": {"type": "perspective", "fov": 30, "to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]]},
    "film": {"width": 8, "height": 8, "filter": {"type": "gaussian", "stddev": 0.4}, "aovs": ["albedo", "depth"]},
    "integrator": {"type": "path", "max_depth": 4, "rr_depth": None, "nee": False, "spp": 2},
    "textures": [
        {"type": "bitmap", "name": "tiles", "file": "textures/tiles.png", "wrap": "clamp"},
        {"type": "checkerboard", "name": "checks", "color0": [0.1, 0.2, 0.3], "uv_transform": [[2, 0, 0], [0, 2, 0]]},
    ],
    "bsdfs": [
        {"type": "diffuse", "name": "a", "reflectance": "tiles"},
        {"type": "conductor", "name": "b", "eta": [0.2, 0.9, 1.1], "k": 3},
        {"type": "rough_conductor", "name": "c", "material": "Au", "alpha": "checks"},
        {"type": "dielectric", "name": "d", "int_ior": "water"},
        {"type": "rough_dielectric", "name": "e", "int_ior": 1.5, "alpha": 0.2, "distribution": "beckmann"},
        {"type": "twosided", "name": "f", "front": "a", "back": {"type": "diffuse", "reflectance": 0.3}},
        {"type": "mask", "name": "g", "bsdf": "f", "opacity": {"type": "checkerboard"}},
    ],
    "media": [{"type": "homogeneous", "name": "tea", "sigma_a": [1, 2, 3], "scale": 0.5}],
    "groups": [{"name": "tree", "shapes": [{"type": "sphere", "bsdf": "a"}, {"type": "cube", "exterior": "tea"}]}],
    "instances": [{"group": "tree", "to_world": [{"scale": [1, 2, 3]}]}, {"group": "tree", "name": "second"}],
    "shapes": [
        {"type": "mesh", "file": "meshes/bowl.ply", "bsdf": "g"},
        {
            "type": "mesh",
            "vertices": [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
            "faces": [[0, 1, 2]],
            "normals": [[0, 0, 1], [0, 0, 1], [0, 0, 1]],
            "uvs": [[0, 0], [1, 0], [0, 1]],
        },
        {"type": "rectangle", "emitter": {"type": "area", "radiance": [1, 2, 3]}, "to_world": [{"scale": 2}]},
        {"type": "cube", "to_world": [{"rotate": {"axis": [0, 1, 0], "angle": 20}}, {"translate": [0, 1, 0]}]},
        {"type": "disk", "to_world": [{"look_at": {"origin": [0, 0, 0], "target": [1, 0, 0]}}]},
        {"type": "sphere", "center": [0, 1, 0], "radius": 0.5, "bsdf": "d", "flip_normals": True, "interior": "tea"},
    ],
}
# Numbers that Python's json module does not write, or hypothesis does not print.
SPELLED = {'"@overflow"': "1e999", '"@digits"': "9" * 4400}
VALUES = st.one_of(
    st.sampled_from([None, True, False, "", "a", "g", "none", "\0", "a\nb", "\ud800", "\u2028", "Au", ".", "textures"]),
    st.sampled_from([0, 1, -1, 2**31, 2**63, 2**64, 10**39, 10**400, -(10**400)]),
    st.sampled_from(
        [0.0, -0.0, 0.5, 1e-45, 1e-320, 1e39, 1.8e308, -1e300, float("nan"), float("inf"), "@overflow", "@digits"]
    ),
    st.floats(),
    st.sampled_from(["mesh", "mask", "twosided", "diffuse", "checkerboard", "box", "meshes/vase.ply", "furnace.json"]),
    st.sampled_from([[], {}, [[]], [{}], {"type": "mask"}, {"type": "diffuse"}, {"type": "bitmap", "file": "a.png"}]),
    st.recursive(
        st.one_of(st.none(), st.integers(), st.text(max_size=3)),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
        max_leaves=6,
    ),
)
KEYS = st.one_of(
    st.sampled_from(
        ["type", "name", "file", "bsdf", "front", "vertices", "alpha", "matrix", "include", "Type", "", "$"]
    ),
    st.text(max_size=4),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files that the scenes refer to, and room for the damaged ones."""
    folder = tmp_path_factory.mktemp("fuzz") / "scenes"
    shutil.copytree(SCENES, folder)
    return folder


def originals():
    raw = [json.loads(path.read_text()) for path in sorted(SCENES.glob("*.json"))]
    return [EVERYTHING, EVERYTHING, *raw]


def containers(raw):
    """All lists and objects in `raw` that have something in them."""
    found, stack = [], [raw]
    while stack:
        item = stack.pop()
        if isinstance(item, (dict, list)) and item:
            found.append(item)
            stack.extend(item.values() if isinstance(item, dict) else item)
    return found


def damage(raw, draw):
    """Changes one thing somewhere in `raw`."""
    places = containers(raw)
    if not places:
        return
    holder = places[draw(st.integers(0, len(places) - 1))]
    keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
    key = keys[draw(st.integers(0, len(keys) - 1))]
    what = draw(st.sampled_from(["value", "value", "delete", "repeat", "rename", "wrap", "graft", "deepen"]))
    if what == "value":
        holder[key] = copy.deepcopy(draw(VALUES))  # a copy, because it may be damaged in turn
    elif what == "delete":
        del holder[key]
    elif what == "repeat" and isinstance(holder, list):
        holder[key:key] = [copy.deepcopy(holder[key])] * draw(st.sampled_from([1, 3, 100]))
    elif what in ("rename", "repeat") and isinstance(holder, dict):
        holder[draw(KEYS)] = copy.deepcopy(holder[key]) if what == "repeat" else holder.pop(key)
    elif what == "wrap":
        holder[key] = draw(st.sampled_from([lambda item: [item], lambda item: {"bsdf": item}]))(holder[key])
    elif what == "graft":
        holder[key] = copy.deepcopy(places[draw(st.integers(0, len(places) - 1))])
    elif what == "deepen":
        for _ in range(draw(st.sampled_from([2, 60]))):
            holder[key] = {"type": "mask", "bsdf": holder[key]}


def spell(raw):
    """The bytes of a file."""
    text = json.dumps(raw)
    for mark, number in SPELLED.items():
        text = text.replace(mark, number)
    return text.encode()


def garble(data, draw):
    """Changes bytes of a file."""
    what = draw(st.sampled_from(["none", "none", "none", "cut", "byte", "insert", "twice", "deep"]))
    at = draw(st.integers(0, max(len(data) - 1, 0)))
    if what == "cut":
        return data[:at]
    if what == "byte":
        return data[:at] + bytes([draw(st.integers(0, 255))]) + data[at + 1 :]
    if what == "insert":
        return data[:at] + draw(st.binary(max_size=6) | st.sampled_from([b"NaN", b'"', b"{", b"1e999"])) + data[at:]
    if what == "twice":
        return data.replace(b'"type":', b'"type": "disk", "type":', 1)
    if what == "deep":
        return data.replace(b"[", b"[" * draw(st.sampled_from([30, 3000])), 1)
    return data


def one_line(error):
    text = str(error)
    assert text
    assert len(text.splitlines()) == 1
    assert text.isprintable()
    text.encode()  # could be printed


@settings(max_examples=400, deadline=None, derandomize=True)
@given(data=st.data())
def test_a_damaged_scene_is_refused_or_valid(folder, data):
    raw = copy.deepcopy(data.draw(st.sampled_from(originals()), label="original"))
    for _ in range(data.draw(st.integers(0, 3), label="changes")):
        damage(raw, data.draw)
    content = garble(spell(raw), data.draw)
    path = folder / "damaged.json"
    path.write_bytes(content)
    try:
        scene = load_scene(path)
    except SceneError as error:
        one_line(error)
        return
    assert isinstance(scene, Scene)
    again = folder / "again.json"
    json_format.dump(scene, again)
    assert load_scene(again) == scene


@settings(max_examples=100, deadline=None, derandomize=True)
@given(data=st.data())
def test_a_damaged_included_file_is_refused_or_valid(folder, data):
    raw = json.loads((SCENES / "include" / "material-stage.json").read_text())
    damage(raw, data.draw)
    (folder / "include" / "damaged.json").write_bytes(garble(spell(raw), data.draw))
    (folder / "damaged.json").write_text(json.dumps({"include": ["include/damaged.json"]}))
    try:
        assert isinstance(load_scene(folder / "damaged.json"), Scene)
    except SceneError as error:
        one_line(error)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    path=st.lists(
        st.sampled_from(
            ["integrator", "film", "filter", "type", "shapes", "bsdfs", "[0]", "[1]", "to_world", "x", "\n"]
        ),
        max_size=4,
    ),
    value=VALUES.map(lambda value: value if isinstance(value, str) else json.dumps(value)) | st.text(max_size=5),
)
def test_a_random_override_is_refused_or_valid(folder, path, value):
    override = ".".join(path).replace(".[", "[") + "=" + value
    try:
        assert isinstance(load_scene(folder / "cornell-box.json", [override]), Scene)
    except SceneError as error:
        one_line(error)
