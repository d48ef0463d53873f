"""Writes the scenes of the folder `scenes`, which are all our own: ``python -m tools.make_scenes [FOLDER]``.

The scenes are made here and not by hand so that where their numbers come from can be read. The files are the same
on every run.
"""

from __future__ import annotations

import argparse
import copy
import math
from pathlib import Path

import numpy as np
from PIL import Image

from tools import camera_scenes, door_scene, glass_scenes, gltf_scene, instance_scenes, light_scenes
from tools.scene_parts import box, film, look_at, place, rectangle, revolve, write_ply
from wavefront.scene import json_format
from wavefront.scene.description import (
    Area,
    Bitmap,
    Blend,
    Bsdf,
    BumpMap,
    Checkerboard,
    Conductor,
    Constant,
    Dielectric,
    Diffuse,
    Disk,
    Mask,
    Mesh,
    NormalMap,
    Null,
    OrenNayar,
    PathIntegrator,
    Perspective,
    Plastic,
    Principled,
    RoughConductor,
    RoughDielectric,
    RoughPlastic,
    Scene,
    Sphere,
    ThinDielectric,
    TwoSided,
)

FOLDER = Path(__file__).resolve().parent.parent / "scenes"


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m tools.make_scenes", description="Write our own scenes.")
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER, help="where to; default: scenes")
    folder = parser.parse_args(arguments).folder
    for name in write(folder):
        print(folder / name)


def write(folder: Path) -> list[str]:
    """Writes everything below `folder` and returns the file names, relative to it."""
    folder = folder.absolute()
    for name in ("meshes", "textures", "include"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    names = ["meshes/bowl.ply", "meshes/vase.ply", "textures/tiles.png"]
    write_ply(folder / names[0], *revolve(_bowl_profile(), 32))
    write_ply(folder / names[1], *revolve(door_scene.vase_profile(), 24))
    Image.fromarray(tiles()).save(folder / names[2], optimize=True)
    names.append("textures/sky.exr")
    light_scenes.write_sky(folder / names[3])
    names.append("still-life.glb")
    gltf_scene.still_life().write(folder / names[4])
    for name, pixels in (("textures/dents.png", dents()), ("textures/scales.png", scales())):
        Image.fromarray(pixels).save(folder / name, optimize=True)
        names.append(name)
    scenes = {
        "cornell-box.json": cornell_box(),
        "furnace.json": furnace(),
        "glossy-plates.json": glossy_plates(),
        "glass-caustic.json": glass_caustic(),
        "coloured-glass.json": glass_scenes.coloured_glass(),
        "door-ajar.json": door_scene.door_ajar(folder),
        "principled-lobes.json": principled_lobes(folder),
        "instances.json": instance_scenes.spiral(folder),
        "include/material-stage.json": material_stage(),
        **{f"camera-{name}.json": scene for name, scene in camera_scenes.scenes().items()},
        **{f"light-{name}.json": scene for name, scene in light_scenes.scenes(folder).items()},
        **{f"material-{name}.json": scene for name, scene in material_balls(folder).items()},
    }
    for name, scene in scenes.items():
        json_format.dump(scene, folder / name)
    return names + list(scenes)


def cornell_box() -> Scene:
    """A room 2.2 m wide, 2 m high and deep; the camera stands before its open side."""
    return Scene(
        description="A closed room with coloured walls, two boxes and one lamp: diffuse transport at its plainest.",
        camera=Perspective(fov=38.0, to_world=look_at((0, 1, 4.2), (0, 1, 0))),
        film=film(),
        integrator=PathIntegrator(max_depth=8),
        bsdfs=[
            Diffuse(name="white", reflectance=[0.72, 0.71, 0.68]),
            Diffuse(name="red", reflectance=[0.6, 0.07, 0.06]),
            Diffuse(name="green", reflectance=[0.13, 0.46, 0.1]),
        ],
        shapes=[
            rectangle("floor", (0, 0, 0), "+y", (1.1, 1.0), bsdf="white"),
            rectangle("ceiling", (0, 2, 0), "-y", (1.1, 1.0), bsdf="white"),
            rectangle("back", (0, 1, -1), "+z", (1.1, 1.0), bsdf="white"),
            rectangle("left", (-1.1, 1, 0), "+x", (1.0, 1.0), bsdf="red"),
            rectangle("right", (1.1, 1, 0), "-x", (1.0, 1.0), bsdf="green"),
            box("tall box", (-0.4, 0.6, -0.35), (0.29, 0.6, 0.29), turn=18.0, bsdf="white"),
            box("short box", (0.42, 0.3, 0.3), (0.3, 0.3, 0.3), turn=-20.0, bsdf="white"),
            rectangle("lamp", (0, 1.99, 0), "-y", (0.26, 0.2), emitter=Area(radiance=[17.0, 12.5, 7.5])),
        ],
    )


def furnace() -> Scene:
    """What is reflected equals what would be seen without the sphere, so that it cannot be told apart.

    Without next-event estimation each path has the weight 1 and ends in the environment: there is no noise at all.
    """
    return Scene(
        description="White furnace: a sphere that absorbs nothing, in an environment of radiance 1. Every pixel is 1, "
        "whatever the number of samples; with next-event estimation on, that is the mean.",
        camera=Perspective(fov=30.0, to_world=look_at((0, 0, 5), (0, 0, 0))),
        film=film(),
        integrator=PathIntegrator(max_depth=8, rr_depth=None, nee=False),
        emitters=[Constant(radiance=1.0)],
        shapes=[Sphere(name="sphere", bsdf=Diffuse(reflectance=1.0))],
    )


def glossy_plates() -> Scene:
    """Each plate is tilted so that the camera sees the row of lights mirrored in its middle."""
    camera, lights = np.array((0.0, 2.6, 8.0)), np.array((0.0, 3.0, -2.4))
    shapes = [
        rectangle("floor", (0, 0, 0), "+y", (6.0, 6.0), bsdf="grey"),
        rectangle("wall", (0, 3, -4), "+z", (6.0, 3.0), bsdf="grey"),
    ]
    for i, (height, depth) in enumerate(((0.35, 2.6), (0.6, 1.4), (1.0, 0.3), (1.55, -0.7))):
        middle = np.array((0.0, height, depth))
        half = _unit(camera - middle) + _unit(lights - middle)
        lean = math.degrees(math.atan2(half[2], half[1]))
        plate = box(f"plate {i + 1}", (0, height, depth), (2.0, 0.03, 0.45), bsdf=f"gloss {i + 1}")
        plate.to_world = place(scale=(2.0, 0.03, 0.45), rotate=("x", round(lean, 2)), translate=(0.0, height, depth))
        shapes.append(plate)
    for i, radius in enumerate((0.025, 0.08, 0.25, 0.7)):
        # Of the same power, hence radiance falls with the square of the radius.
        radiance = round(0.5 / radius**2, 3)
        at = (round(-1.95 + 1.3 * i - (0.1 if i < 3 else 0), 3), float(lights[1]), float(lights[2]))
        shapes.append(Sphere(name=f"light {i + 1}", center=at, radius=radius, emitter=Area(radiance=radiance)))
    return Scene(
        description="Four plates from nearly mirror to rough under four spherical lights of equal power and different "
        "size: light sampling is good in one corner, BSDF sampling in the opposite one, their combination in all.",
        camera=Perspective(fov=40.0, to_world=look_at(tuple(camera), (0, 1.25, 0))),
        film=film(320, 256),
        integrator=PathIntegrator(max_depth=6),
        bsdfs=[
            Diffuse(name="grey", reflectance=0.35),
            *(
                RoughConductor(name=f"gloss {i + 1}", material="Cr", alpha=alpha)
                for i, alpha in enumerate((0.006, 0.02, 0.06, 0.18))
            ),
        ],
        shapes=shapes,
    )


def glass_caustic() -> Scene:
    """The light is small, so a path tracer finds the caustic only when BSDF sampling happens to hit it."""
    return Scene(
        description="A glass ball focuses a small lamp onto a diffuse floor: a caustic, which only paths that hit the "
        "lamp by chance can find.",
        camera=Perspective(fov=35.0, to_world=look_at((0.3, 2.0, 3.6), (0.1, 0.35, 0))),
        film=film(),
        integrator=PathIntegrator(max_depth=12),
        bsdfs=[Diffuse(name="floor", reflectance=[0.7, 0.68, 0.62]), Dielectric(name="glass", int_ior="bk7")],
        emitters=[Constant(radiance=0.02)],
        shapes=[
            rectangle("floor", (0, 0, 0), "+y", (4.0, 4.0), bsdf="floor"),
            Sphere(name="ball", bsdf="glass", center=(-0.1, 0.62, 0.0), radius=0.5),
            Disk(
                name="lamp",
                emitter=Area(radiance=[160.0, 150.0, 130.0]),
                to_world=place(scale=(0.14, 0.14, 1.0), rotate=("x", 90.0), translate=(-1.1, 3.0, -0.5)),
            ),
        ],
    )


# --- material balls --------------------------------------------------------------------------------------------


def material_stage() -> Scene:
    """Floor, backdrop and light that the material scenes share."""
    return Scene(
        description="The stage of the material balls: a checkered floor, a backdrop, a lamp, a dim environment.",
        textures=[
            Checkerboard(name="stage checks", color0=0.55, color1=0.3, uv_transform=((8.0, 0.0, 0.0), (0.0, 8.0, 0.0)))
        ],
        bsdfs=[
            Diffuse(name="stage floor", reflectance="stage checks"),
            Diffuse(name="stage backdrop", reflectance=0.4),
        ],
        emitters=[Constant(name="stage sky", radiance=[0.15, 0.17, 0.2])],
        shapes=[
            rectangle("stage floor", (0, 0, 0), "+y", (4.0, 4.0), bsdf="stage floor"),
            rectangle("stage backdrop", (0, 2, -4), "+z", (4.0, 2.0), bsdf="stage backdrop"),
            rectangle("stage lamp", (-1.5, 3.9, 1.5), "-y", (0.8, 0.8), emitter=Area(radiance=[14.0, 13.0, 11.5])),
        ],
    )


def material_balls(folder: Path) -> dict[str, Scene]:
    """One scene per BSDF, by the end of its name."""
    tiles = Bitmap(file=str(folder / "textures" / "tiles.png"))
    stripes = Checkerboard(color0=1.0, color1=0.0, uv_transform=((8.0, 0.0, 0.0), (0.0, 4.0, 0.0)))
    bowl = Mesh(
        file=str(folder / "meshes" / "bowl.ply"),
        to_world=place(rotate=("x", 35.0), translate=(0.0, 0.75, 0.0)),
    )
    scenes = {
        "diffuse": ("diffuse reflection", Diffuse(reflectance=[0.7, 0.25, 0.12]), None),
        "diffuse-bitmap": ("diffuse reflection from an image", Diffuse(reflectance=tiles), None),
        "oren-nayar": ("rough diffuse clay", OrenNayar(reflectance=[0.7, 0.25, 0.12], roughness=0.9), None),
        "conductor": ("a smooth metal, gold", Conductor(material="Au"), None),
        "rough-conductor-ggx": ("a rough metal, GGX", RoughConductor(material="Cu", alpha=0.2), None),
        "rough-conductor-beckmann": (
            "a rough metal, Beckmann",
            RoughConductor(material="Cu", alpha=0.2, distribution="beckmann"),
            None,
        ),
        "rough-conductor-anisotropic": (
            "brushed metal, in circles about the axis",
            RoughConductor(material="Al", alpha_u=0.05, alpha_v=0.35),
            None,
        ),
        "dielectric": ("clear glass", Dielectric(int_ior="bk7"), None),
        "rough-dielectric": ("ground glass", RoughDielectric(int_ior="bk7", alpha=0.15), None),
        "thin-dielectric": ("a soap bubble's wall: a thin sheet of glass", ThinDielectric(int_ior="bk7"), None),
        "null": ("a ball that is not there; the image shows the stage alone", Null(), None),
        "plastic": ("a red base below a smooth coating", Plastic(diffuse_reflectance=[0.6, 0.08, 0.05]), None),
        "rough-plastic": (
            "an image below a rough coating, with colours that saturate",
            RoughPlastic(diffuse_reflectance=tiles, alpha=0.15, nonlinear=True),
            None,
        ),
        "principled": (
            "the principled BSDF: an image under a lacquer",
            Principled(base_color=tiles, roughness=0.6, clearcoat=1.0, clearcoat_gloss=0.9),
            None,
        ),
        "blend": (
            "stripes of gold on blue paint",
            Blend(
                first=Diffuse(reflectance=[0.15, 0.3, 0.6]),
                second=RoughConductor(material="Au", alpha=0.2),
                weight=stripes,
            ),
            None,
        ),
        "normal-map": (
            "a rough coating with a pattern of scales in an image of normals",
            NormalMap(
                bsdf=RoughPlastic(diffuse_reflectance=[0.1, 0.35, 0.2], alpha=0.1),
                normal=Bitmap(
                    file=str(folder / "textures" / "scales.png"), uv_transform=((12.0, 0.0, 0.0), (0.0, 6.0, 0.0))
                ),
            ),
            None,
        ),
        "bump-map": (
            "a bowl of hammered copper, by a height field",
            BumpMap(
                bsdf=TwoSided(front=RoughConductor(material="Cu", alpha=0.15)),
                height=Bitmap(
                    file=str(folder / "textures" / "dents.png"), uv_transform=((4.0, 0.0, 0.0), (0.0, 2.0, 0.0))
                ),
                scale=0.04,
            ),
            bowl,
        ),
        "twosided": (
            "a bowl that is metal outside and diffuse inside",
            TwoSided(front=RoughConductor(material="Au", alpha=0.15), back=Diffuse(reflectance=[0.1, 0.3, 0.6])),
            bowl,
        ),
        "mask": (
            "a ball with holes that shows its inside",
            Mask(bsdf=TwoSided(front=Diffuse(reflectance=[0.2, 0.5, 0.25])), opacity=stripes),
            None,
        ),
    }
    return {name: _on_stage(folder, *parts) for name, parts in scenes.items()}


def _on_stage(folder: Path, what: str, bsdf: Bsdf, shape: Mesh | None) -> Scene:
    # The poles of a sphere lie on its Z axis: turned upright.
    subject = copy.copy(shape) or Sphere(radius=0.8, to_world=place(rotate=("x", -90.0), translate=(0.0, 0.8, 0.0)))
    subject.name, subject.bsdf = "subject", bsdf
    return Scene(
        description=f"A material: {what}.",
        include=[str(folder / "include" / "material-stage.json")],
        camera=Perspective(fov=32.0, to_world=look_at((0, 1.9, 4.6), (0, 0.75, 0))),
        film=film(),
        integrator=PathIntegrator(max_depth=12),
        shapes=[subject],
    )


def principled_lobes(folder: Path) -> Scene:
    """Eight balls; each shows what one parameter of the principled BSDF does."""
    red, gold, blue = [0.7, 0.1, 0.06], [0.95, 0.7, 0.3], [0.15, 0.3, 0.7]
    brushed = Checkerboard(color0=0.9, color1=0.0, uv_transform=((2.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    balls = {
        "plain": Principled(base_color=red, roughness=0.3),
        "clearcoat": Principled(base_color=red, roughness=0.8, clearcoat=1.0, clearcoat_gloss=1.0),
        "metal": Principled(base_color=gold, roughness=0.3, metallic=1.0),
        "brushed metal": Principled(base_color=gold, roughness=0.4, metallic=1.0, anisotropic=brushed),
        "cloth": Principled(base_color=blue, roughness=1.0, specular=0.1, sheen=1.0, sheen_tint=0.7),
        "wax": Principled(base_color=[0.85, 0.65, 0.4], roughness=0.6, flatness=1.0, spec_tint=0.8),
        "half glass": Principled(base_color=blue, roughness=0.2, spec_trans=0.6, eta=1.4),
        "glass": Principled(base_color=[0.6, 0.9, 0.7], roughness=0.15, spec_trans=1.0, eta=1.5),
    }
    shapes = []
    for i, (name, bsdf) in enumerate(balls.items()):
        at = (round(-1.2 + 0.8 * (i % 4), 3), 0.36, -0.7 if i < 4 else 0.4)
        place_at = place(rotate=("x", -90.0), translate=at)
        shapes.append(Sphere(name=name, radius=0.36, to_world=place_at, bsdf=bsdf))
    return Scene(
        description="Eight balls of the principled BSDF: plastic, lacquer, metal, brushed metal (half of the ball); "
        "cloth, wax, half glass, glass.",
        include=[str(folder / "include" / "material-stage.json")],
        camera=Perspective(fov=38.0, to_world=look_at((0, 2.4, 5.0), (0, 0.3, -0.1))),
        film=film(320, 192),
        integrator=PathIntegrator(max_depth=12),
        shapes=shapes,
    )


def tiles() -> np.ndarray:
    """A texture of 96 x 96 8-bit sRGB pixels: bordered tiles whose hue tells u and whose brightness tells v."""
    size = 96
    v, u = np.mgrid[0:size, 0:size] / (size - 1)
    hue = 0.5 + 0.5 * np.cos(2 * np.pi * (u[..., None] + np.array((0.0, 1 / 3, 2 / 3))))
    colour = (0.25 + 0.75 * hue) * (1.0 - 0.6 * v[..., None])
    row, column = np.mgrid[0:size, 0:size]
    border = (row % 16 < 2) | (column % 16 < 2)
    colour[border] = 0.15
    return np.rint(255 * colour).astype(np.uint8)


def dents() -> np.ndarray:
    """Heights of a hammered sheet, 64 x 64 8-bit pixels that repeat: what is deepest of round dents."""
    size = 64
    y, x = np.mgrid[0:size, 0:size] / size
    depth = np.zeros((size, size))
    for i, (u, v) in enumerate(np.random.default_rng(7).random((24, 2))):
        radius = 0.12 + 0.05 * (i % 3)
        dx, dy = ((a - b + 0.5) % 1.0 - 0.5 for a, b in ((x, u), (y, v)))
        depth = np.maximum(depth, 1.0 - (dx**2 + dy**2) / radius**2)
    return np.rint(255 * (1.0 - 0.8 * depth)).astype(np.uint8)


def scales() -> np.ndarray:
    """Normals of a round scale, 48 x 48 8-bit pixels that repeat; y is up where v, as rows, grows down."""
    size = 48
    y, x = np.mgrid[0:size, 0:size] / size * 2.0 - 1.0
    r2 = x**2 + y**2
    inside = (r2 < 0.81)[..., None]
    bulge = np.stack([0.6 * x, -0.6 * y, np.sqrt(np.maximum(1.0 - 0.36 * r2, 0.0))], axis=-1)
    normal = np.where(inside, bulge, (0.0, 0.0, 1.0))
    return np.rint(255 * (0.5 + 0.5 * normal)).astype(np.uint8)


def _bowl_profile() -> list[tuple[float, float]]:
    """Radius and height from the bottom to the rim of three quarters of a half sphere."""
    angles = np.linspace(0.0, 0.62 * math.pi, 20)
    return [(0.75 * math.sin(a), -0.75 * math.cos(a)) for a in angles]


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


if __name__ == "__main__":
    main()
