"""A still life as a glTF file, made of what the format has and our JSON has not: one binary file, quantised meshes,
metalness and roughness packed into one image, an alpha test, punctual lights."""

from __future__ import annotations

import math

import numpy as np

from tools.door_scene import vase_profile
from tools.gltf_writer import GltfBuilder, png
from tools.scene_parts import revolve

QUAD = np.array([(-1, 0, -1), (-1, 0, 1), (1, 0, 1), (1, 0, -1)], np.float64)  # faces +Y
QUAD_UVS = np.array([(0, 0), (0, 1), (1, 1), (1, 0)], np.float64)
QUAD_FACES = [(0, 1, 2), (0, 2, 3)]


def still_life() -> GltfBuilder:
    """A vase of two metals, three leaves cut out by their texture, a painted bowl and a lamp on a checkered floor."""
    b = GltfBuilder()
    b.use("KHR_lights_punctual", "KHR_materials_emissive_strength", "KHR_mesh_quantization", "KHR_texture_transform")
    b.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    squares = b.texture(png(_squares()), magFilter=9728)
    inlay, leaf = b.texture(png(_inlay())), b.texture(png(_leaf()), wrapS=33071, wrapT=33071)
    tiled = {"index": squares, "extensions": {"KHR_texture_transform": {"scale": [8, 8], "rotation": 0.3}}}
    floor = _material(b, "floor", metallic=0, roughness=0.6, baseColorTexture=tiled)
    metal = _material(b, "inlaid metal", color=(1.0, 0.72, 0.36), metallicRoughnessTexture={"index": inlay})
    green = _material(b, "leaf", metallic=0, roughness=0.5, baseColorTexture={"index": leaf})
    b.tree["materials"][green] |= {"alphaMode": "MASK", "doubleSided": True}
    paint = _material(b, "paint", color=(0.5, 0.05, 0.04), metallic=0, roughness=0.25)
    b.tree["materials"][paint]["doubleSided"] = True
    plaster = _material(b, "plaster", color=(0.5, 0.5, 0.5), metallic=0)
    glow = _material(b, "glow", color=(0, 0, 0), metallic=0)
    b.tree["materials"][glow] |= {
        "emissiveFactor": [1.0, 0.85, 0.6],
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 12}},
    }

    quad = {material: _quad(b, material) for material in (floor, green, plaster, glow)}
    bowl = [(0.75 * math.sin(a), 0.75 - 0.75 * math.cos(a)) for a in np.linspace(0.0, 0.55 * math.pi, 9)]
    facing = [math.sqrt(0.5), 0, 0, math.sqrt(0.5)]  # +Y to +Z
    scale, vase = _revolved(b, vase_profile(), 20, metal)
    nodes = [
        b.add("nodes", name="floor", mesh=quad[floor], scale=[4, 1, 4]),
        b.add("nodes", name="wall", mesh=quad[plaster], translation=[0, 2, -4], rotation=facing, scale=[4, 1, 2]),
        b.add("nodes", name="vase", mesh=vase, scale=3 * [1.6 * scale / _height(vase_profile())]),
        b.add("nodes", name="lamp", mesh=quad[glow], translation=[-1, 3, 1], rotation=[1, 0, 0, 0], scale=3 * [0.4]),
    ]
    leaves = []
    for i in range(3):
        turn = math.radians(60.0 + 120.0 * i)
        leaves.append(b.add("nodes", mesh=quad[green], translation=[0.35 * math.sin(turn), 0, 0.35 * math.cos(turn)],
                            rotation=_turned(turn), scale=[0.25, 1, 0.3]))  # fmt: skip
    nodes.append(b.add("nodes", name="leaves", translation=[0, 1.62, 0], children=leaves))
    scale, mesh = _revolved(b, bowl, 20, paint)
    nodes.append(b.add("nodes", name="bowl", mesh=mesh, translation=[1.0, 0, 0.5], scale=3 * [0.55 * scale]))
    nodes += _lights(b)
    camera = b.add("cameras", type="perspective", perspective={"yfov": 0.55, "aspectRatio": 1.25})
    back = math.radians(-14.0)
    nodes.append(
        b.add(
            "nodes", camera=camera, translation=[0.3, 2.2, 5], rotation=[math.sin(back / 2), 0, 0, math.cos(back / 2)]
        )
    )
    b.scene(*nodes, name="A still life in one binary file: the glTF importer with most of what it reads.")
    b.tree["scene"] = 0
    return b


def _material(b, name, color=(1.0, 1.0, 1.0), metallic=1.0, roughness=1.0, **textures) -> int:
    pbr = {"baseColorFactor": [*color, 1.0], "metallicFactor": metallic, "roughnessFactor": roughness} | textures
    return b.add("materials", name=name, pbrMetallicRoughness=pbr)


def _quad(b, material) -> int:
    return b.mesh(QUAD, QUAD_FACES, np.tile((0.0, 1.0, 0.0), (4, 1)), QUAD_UVS, material=material)


def _revolved(b, profile, segments, material) -> tuple[float, int]:
    """A surface of revolution in 16-bit integers, and what its node must scale it by."""
    vertices, normals, uvs, faces = revolve(profile, segments)
    scale = float(np.abs(vertices).max())
    stored = np.rint(32767 * vertices / scale).astype(np.int16)
    bounds = {"min": (stored.min(axis=0)).tolist(), "max": (stored.max(axis=0)).tolist()}
    attributes = {
        "POSITION": b.accessor(stored, stride=8, normalized=True, **bounds),
        "NORMAL": b.accessor(np.rint(127 * normals).astype(np.int8), stride=4, normalized=True),
        "TEXCOORD_0": b.accessor(np.rint(65535 * uvs).astype(np.uint16), normalized=True),
    }
    indices = b.accessor(np.asarray(faces, np.uint16).ravel())
    return scale, b.add("meshes", primitives=[{"attributes": attributes, "indices": indices, "material": material}])


def _lights(b) -> list[int]:
    b.tree["extensions"] = {
        "KHR_lights_punctual": {
            "lights": [
                {"type": "directional", "name": "moon", "color": [0.6, 0.75, 1.0], "intensity": 0.7},
                {"type": "spot", "name": "spot", "intensity": 25,
                 "spot": {"innerConeAngle": 0.2, "outerConeAngle": 0.35}},
            ]
        }
    }  # fmt: skip
    down = [-math.sqrt(0.5), 0, 0, math.sqrt(0.5)]
    tilted = [-math.sin(0.4), 0, 0, math.cos(0.4)]
    return [
        b.add("nodes", rotation=tilted, extensions={"KHR_lights_punctual": {"light": 0}}),
        b.add("nodes", translation=[1, 4, 0.5], rotation=down, extensions={"KHR_lights_punctual": {"light": 1}}),
    ]


def _turned(angle: float) -> list[float]:
    """A turn about the vertical, after one that lifts the far end of a leaf."""
    lift = -0.6
    y, w = math.sin(angle / 2), math.cos(angle / 2)
    x, u = math.sin(lift / 2), math.cos(lift / 2)
    return [w * x, y * u, -y * x, w * u]


def _height(profile) -> float:
    return max(height for _, height in profile)


def _squares() -> np.ndarray:
    light, dark = (205, 196, 180), (92, 74, 66)
    return np.array([[light, dark], [dark, light]], np.uint8)


def _inlay() -> np.ndarray:
    """Roughness in G and metalness in B: bands of polished metal and of something like clay."""
    row, column = np.mgrid[0:16, 0:32]
    metal = (row + (column // 4) % 2 * 2) % 8 < 5
    return np.stack([np.zeros(metal.shape), np.where(metal, 70, 220), np.where(metal, 255, 0)], 2).astype(np.uint8)


def _leaf() -> np.ndarray:
    v, u = np.mgrid[0:24, 0:24] / 23.0
    across = np.abs(2.0 * u - 1.0)
    alpha = np.clip(0.5 + 6.0 * (np.sin(np.pi * v) - across), 0.0, 1.0)
    vein = np.where(across < 0.1, 1.6, 1.0)[..., None]
    return np.rint(255 * np.dstack([vein * (0.22, 0.4, 0.12), alpha])).astype(np.uint8)
