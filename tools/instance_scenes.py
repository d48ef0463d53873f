"""The scene of instances: one vase and one fruit, stored once, in a spiral of many."""

from __future__ import annotations

import math
from pathlib import Path

from tools.scene_parts import film, look_at, rectangle
from wavefront.scene.description import (
    Area,
    Constant,
    Diffuse,
    Group,
    Instance,
    Mesh,
    PathIntegrator,
    Perspective,
    Plastic,
    Rotate,
    Scene,
    Sphere,
    TransformStep,
    TwoSided,
)

COUNT = 60


def spiral(folder: Path) -> Scene:
    """Vases at golden angles, the outer ones larger; every third is a mirror image and every fourth stretched."""
    return Scene(
        description=f"A spiral of {COUNT} instances of a vase with a fruit on it: the mesh is in memory once; some are "
        "mirrored, some stretched, so that fruits become ellipsoids.",
        camera=Perspective(fov=36.0, to_world=look_at((0, 2.6, 4.1), (0, 0.1, 0.15))),
        film=film(),
        integrator=PathIntegrator(max_depth=8),
        bsdfs=[
            Diffuse(name="floor", reflectance=0.45),
            TwoSided(name="clay", front=Diffuse(reflectance=[0.62, 0.3, 0.16])),
            Plastic(name="peel", diffuse_reflectance=[0.75, 0.5, 0.05]),
        ],
        emitters=[Constant(radiance=[0.3, 0.33, 0.38])],
        groups=[
            Group(
                name="vase",
                shapes=[
                    Mesh(file=str(folder / "meshes" / "vase.ply"), bsdf="clay"),
                    Sphere(center=(0.09, 0.06, 0.02), radius=0.06, bsdf="peel"),
                ],
            )
        ],
        instances=[Instance(group="vase", to_world=_place(i)) for i in range(COUNT)],
        shapes=[
            rectangle("floor", (0, 0, 0), "+y", (4.0, 4.0), bsdf="floor"),
            rectangle("lamp", (-1.5, 3.9, 1.5), "-y", (0.8, 0.8), emitter=Area(radiance=[11.0, 10.0, 9.0])),
        ],
    )


def _place(i: int) -> list[TransformStep]:
    angle, distance = i * 137.508, 0.24 * math.sqrt(i + 0.5)
    size = 1.2 + 0.1 * distance
    scale = (-size if i % 3 == 0 else size, 1.4 * size if i % 4 == 0 else size, size)
    x, z = distance * math.cos(math.radians(angle)), distance * math.sin(math.radians(angle))
    return [
        TransformStep(scale=tuple(round(value, 4) for value in scale)),
        TransformStep(rotate=Rotate(axis=(0.0, 1.0, 0.0), angle=round(angle % 360.0, 3))),
        TransformStep(translate=(round(x, 4), 0.0, round(z, 4))),
    ]
