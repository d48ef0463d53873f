"""The scenes of the lights: one for each kind of emitter that is no shape, by the end of its name."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tools.scene_parts import box, film, look_at, place, rectangle
from wavefront.scene.description import (
    Diffuse,
    Directional,
    Emitter,
    Envmap,
    PathIntegrator,
    Perspective,
    Point,
    Scene,
    Sphere,
    Spot,
    Sun,
    SunSky,
)
from wavefront.scene.images import write_exr


def scenes(folder: Path) -> dict[str, Scene]:
    """Each light over the same floor, ball and box."""
    sky = Envmap(file=str(folder / "textures" / "sky.exr"), to_world=place(rotate=("y", 30.0)))
    down = (0.55, -1.0, -0.6)
    return {
        "envmap": _scene("an environment map with a bright spot, turned", sky),
        "directional": _scene("parallel, with hard shadows", Directional(direction=down, irradiance=3.0)),
        "point": _scene("a point", Point(position=(-1.6, 2.4, 1.6), intensity=[12.0, 11.0, 9.0])),
        "spot": _scene(
            "a spot that falls off to its rim",
            Spot(
                position=(-1.5, 3.5, 1.5),
                direction=(1.5, -3.2, -1.5),
                intensity=40.0,
                cutoff_angle=24.0,
                beam_width=14.0,
            ),
        ),
        "sun": _scene("a sun 6 degrees wide, with soft shadows", Sun(direction=down, angle=3.0, irradiance=3.0)),
        "sunsky": _scene("a clear sky and its sun", SunSky(direction=down, sky_scale=2.0, sun_scale=2.0)),
    }


def _scene(what: str, emitter: Emitter) -> Scene:
    return Scene(
        description=f"A light: {what}.",
        camera=Perspective(fov=36.0, to_world=look_at((0, 1.9, 4.6), (0, 0.6, 0))),
        film=film(),
        integrator=PathIntegrator(max_depth=6),
        bsdfs=[
            Diffuse(name="floor", reflectance=0.5),
            Diffuse(name="clay", reflectance=[0.7, 0.35, 0.2]),
            Diffuse(name="slate", reflectance=[0.2, 0.3, 0.4]),
        ],
        emitters=[emitter],
        shapes=[
            rectangle("floor", (0, 0, 0), "+y", (4.0, 4.0), bsdf="floor"),
            Sphere(name="ball", bsdf="clay", center=(-0.6, 0.6, 0.0), radius=0.6),
            box("box", (0.8, 0.4, 0.2), (0.4, 0.4, 0.4), turn=25.0, bsdf="slate"),
        ],
    )


def write_sky(path: Path) -> None:
    """An environment map of 64 x 33 pixels: blue above, brown below, and a warm spot 6 degrees wide at 40 degrees."""
    theta, phi = np.meshgrid(np.linspace(0.0, np.pi, 33), (np.arange(64) + 0.5) / 64 * 2.0 * np.pi, indexing="ij")
    up = np.cos(theta)[..., None]
    above = 0.25 + 0.35 * (1.0 - up) * (0.9, 0.95, 1.0) + 0.3 * up * (0.3, 0.5, 1.0)
    sky = np.where(up >= 0.0, above, (0.1, 0.08, 0.06))
    distance2 = (theta - np.radians(50.0)) ** 2 + (np.sin(theta) * (phi - 2.0)) ** 2
    sky = sky + 150.0 * np.exp(-distance2 / (2.0 * np.radians(6.0) ** 2))[..., None] * (1.0, 0.85, 0.6)
    # Rounded, so that the file is the same wherever it is made.
    write_exr(path, {name: np.round(sky[:, :, i].astype(np.float64), 3) for i, name in enumerate("RGB")}, half=True)
