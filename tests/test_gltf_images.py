"""Images of glTF scenes: those of the same scene written by hand, and of what the converter makes of them.

All scenes need the same kernels.
"""

import json

import numpy as np
import pytest

from tools import convert
from tools.gltf_scene import still_life
from tools.gltf_writer import GltfBuilder, png
from wavefront import Renderer, load_scene
from wavefront.identity import scene_records
from wavefront.scene import description as d
from wavefront.scene import json_format, meshes
from wavefront.scene.images import write_png

SMALL = ["film.width=40", "film.height=32", "integrator.spp=4"]
QUAD = [(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)]
UVS = [(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)]
NORMALS = [(0.0, 0.0, 1.0)] * 4
FACES = [(0, 1, 2), (0, 2, 3)]
PIXELS = np.random.default_rng(7).integers(0, 256, (4, 4, 4), np.uint8)


def image(scene):
    return Renderer(scene, seed=3).render(4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("gltf")


@pytest.fixture(scope="module")
def still(folder):
    """The still life of the repository and its image."""
    scene = load_scene(still_life().write(folder / "still.glb"), SMALL)
    return scene, image(scene)


def test_the_same_scene_written_by_hand(folder):
    b = GltfBuilder()
    texture = {"index": b.texture(png(PIXELS), wrapS=33648, wrapT=33648)}
    front = b.add(
        "materials",
        name="front",
        pbrMetallicRoughness={"baseColorTexture": texture, "baseColorFactor": [1, 0.5, 0.75, 1],
                              "metallicRoughnessTexture": texture, "metallicFactor": 0.5},
        alphaMode="MASK", alphaCutoff=0.375, doubleSided=True,
    )  # fmt: skip
    lamp = b.add(
        "materials", name="lamp", pbrMetallicRoughness={"metallicFactor": 0}, emissiveFactor=[1, 0.5, 0.25],
        emissiveTexture=texture, extensions={"KHR_materials_emissive_strength": {"emissiveStrength": 8}},
    )  # fmt: skip
    lights = [{"type": "directional", "intensity": 0.5}, {"type": "spot", "intensity": 9, "color": [0, 1, 0]}]
    b.tree["extensions"] = {"KHR_lights_punctual": {"lights": lights}}
    quads = [b.mesh(QUAD, FACES, NORMALS, UVS, material=material) for material in (front, lamp)]
    camera = b.add("cameras", type="perspective", perspective={"yfov": 0.75, "aspectRatio": 1.25})
    b.scene(
        b.add("nodes", name="a", mesh=quads[0], scale=[1.5, 1, 1]),
        b.add("nodes", name="b", mesh=quads[1], translation=[0, 1.5, 2], rotation=[1, 0, 0, 1]),
        b.add("nodes", extensions={"KHR_lights_punctual": {"light": 0}}),
        b.add("nodes", translation=[0, 0, 3], extensions={"KHR_lights_punctual": {"light": 1}}),
        b.add("nodes", camera=camera, translation=[0, 0, 4]),
    )
    gltf = load_scene(b.write(folder / "a.gltf"), SMALL)

    write_png(folder / "colour.png", PIXELS[:, :, :3])
    # each channel and the alpha in a file of its own, as numbers
    for name, pixels in (("alpha", PIXELS[:, :, 3]), ("rough", PIXELS[:, :, 1]), ("metal", PIXELS[:, :, 2])):
        write_png(folder / f"{name}.png", pixels)
    bitmap = {"type": "bitmap", "wrap": "mirror"}
    mesh = {"type": "mesh", "vertices": QUAD, "faces": FACES, "normals": NORMALS, "uvs": UVS}
    by_hand = {
        "camera": {
            "type": "perspective", "fov": np.degrees(0.75), "fov_axis": "y", "to_world": [{"translate": [0, 0, 4]}]
        },
        "film": {"width": 40, "height": 32},
        "integrator": {"type": "path", "spp": 4},
        "bsdfs": [
            {
                "type": "mask", "name": "front", "opacity": bitmap | {"file": "alpha.png"}, "cutoff": 0.375,
                "bsdf": {
                    "type": "twosided",
                    "front": {
                        "type": "principled",
                        "base_color": bitmap | {"file": "colour.png", "scale": [1, 0.5, 0.75]},
                        "roughness": bitmap | {"file": "rough.png"},
                        "metallic": bitmap | {"file": "metal.png", "scale": 0.5},
                    },
                },
            },
            {"type": "principled", "name": "lamp", "base_color": 1.0, "roughness": 1.0, "metallic": 0.0},
        ],
        "emitters": [
            {"type": "directional", "direction": [0, 0, -1], "irradiance": 0.5},
            {
                "type": "spot", "position": [0, 0, 3], "direction": [0, 0, -1], "intensity": [0, 9, 0],
                "cutoff_angle": 45, "beam_width": 0,
            },
        ],
        "shapes": [
            mesh | {"bsdf": "front", "to_world": [{"scale": [1.5, 1, 1]}]},
            mesh | {
                "bsdf": "lamp",
                "emitter": {"type": "area", "radiance": bitmap | {"file": "colour.png", "scale": [8, 4, 2]}},
                "to_world": [[1, 0, 0, 0], [0, 0, -1, 1.5], [0, 1, 0, 2], [0, 0, 0, 1]],
            },
        ],
    }  # fmt: skip
    (folder / "b.json").write_text(json.dumps(by_hand))
    scene = load_scene(folder / "b.json")
    for ours, other in zip(gltf.shapes, scene.shapes, strict=True):
        a, b = meshes.tessellate(ours), meshes.tessellate(other)
        for name in ("vertices", "faces", "normals", "uvs"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-6)
    # a quarter turn from a quaternion is that of the matrix up to the last bits, where paths may part
    gltf.shapes[1].to_world = scene.shapes[1].to_world
    found, expected = image(gltf), image(scene)
    assert expected.mean() > 0.02 and (expected > 0).mean() > 0.2
    np.testing.assert_array_equal(found, expected)


def test_text_and_binary_are_one_scene(folder, still):
    scene, expected = still
    other = load_scene(still_life().write(folder / "still.gltf"), SMALL)
    assert json_format.dumps(other, folder).replace("still.gltf", "still.glb") == json_format.dumps(scene, folder)
    np.testing.assert_array_equal(image(other), expected)


def test_converted_scene_has_the_same_image(folder, still):
    _, expected = still
    assert convert.main([str(folder / "still.glb"), str(folder / "converted.json"), "--quiet"]) == 0
    names = sorted(path.relative_to(folder).as_posix() for path in folder.glob("converted_*/*"))
    assert names == [f"converted_meshes/still{n}.ply" for n in ("", "_2", "_3", "_4", "_5", "_6")] + [
        f"converted_textures/still_{n}.png" for n in range(3)
    ]
    converted = load_scene(folder / "converted.json", SMALL)
    np.testing.assert_array_equal(image(converted), expected)
    # converting what was converted changes nothing
    assert convert.main([str(folder / "converted.json"), str(folder / "again.json"), "--quiet"]) == 0
    assert scene_records(load_scene(folder / "again.json", SMALL)) == scene_records(converted)


def test_the_still_life_shows_what_it_is_made_of(still):
    scene, expected = still
    assert [type(emitter) for emitter in scene.emitters] == [d.Directional, d.Spot]
    assert sum(shape.emitter is not None for shape in scene.shapes) == 1
    parts = [shape.part.mesh for shape in scene.shapes]
    assert len(parts) - len(set(parts)) == 2  # three leaves from one mesh
    assert np.isfinite(expected).all() and (expected >= 0).all()
    assert 0.05 < expected.mean() < 5.0
    # without the alpha test the leaves are squares
    (leaf,) = (bsdf for bsdf in scene.bsdfs if bsdf.name == "leaf")
    leaf.cutoff, leaf.opacity = None, 1.0
    assert (image(scene) != expected).any(axis=2).mean() > 0.02
