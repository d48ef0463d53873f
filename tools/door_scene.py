"""The scene with a door left ajar: two rooms, the lamp in the one, the camera in the other."""

from __future__ import annotations

from pathlib import Path

from tools.scene_parts import box, film, look_at, place, rectangle
from wavefront.scene.description import (
    Area,
    Checkerboard,
    Conductor,
    Cube,
    Dielectric,
    Diffuse,
    Mesh,
    PathIntegrator,
    Perspective,
    RoughConductor,
    Scene,
    Sphere,
)

# The opening in the wall between the rooms: its sides, its height, and the thickness of the wall, which lies behind
# z = 0. The camera is where z > 0.
LEFT, RIGHT, TOP, WALL = -0.5, 0.4, 2.1, 0.12
WIDTH, HEIGHT, FRONT, BACK = 2.2, 2.6, 4.4, -3.2
ANGLE = 25.0


def door_ajar(folder: Path) -> Scene:
    """No surface that the camera sees is lit by the lamp itself.

    The lamp hangs higher than the opening, so its light falls, and cannot pass above the door; it hangs far on the
    side of the door's free edge, so its light that enters the opening hits the door from behind. What comes through
    the gap has been reflected in the other room before, and goes to the right, where the camera does not stand.
    """
    return Scene(
        description="A room lit only through a door left ajar, from a lamp in the next room: no surface in view is "
        "lit directly, so light sampling is of no use. Hard for a path tracer without guiding, on purpose.",
        camera=Perspective(fov=62.0, to_world=look_at((-1.3, 1.5, 4.1), (0.55, 0.95, 0.6))),
        film=film(320, 192),
        integrator=PathIntegrator(max_depth=16, rr_depth=8),
        textures=[Checkerboard(name="tiles", color0=0.6, color1=0.35, uv_transform=((5.5, 0.0, 0.0), (0.0, 9.5, 0.0)))],
        bsdfs=[
            Diffuse(name="plaster", reflectance=[0.75, 0.72, 0.66]),
            Diffuse(name="tiles", reflectance="tiles"),
            Diffuse(name="paint", reflectance=[0.55, 0.62, 0.6]),
            Diffuse(name="wood", reflectance=[0.42, 0.25, 0.13]),
            Diffuse(name="clay", reflectance=[0.62, 0.28, 0.17]),
            RoughConductor(name="copper", material="Cu", alpha=0.12),
            RoughConductor(name="brass", eta=[0.44, 0.53, 1.09], k=[3.7, 2.77, 1.83], alpha=0.05),
            Conductor(name="mirror", material="Ag"),
            Dielectric(name="glass", int_ior="bk7"),
        ],
        shapes=[*_rooms(), *_door(), *_table(folder), _lamp()],
    )


def vase_profile() -> list[tuple[float, float]]:
    """Radius and height of a thick-walled vase 0.3 m high: up its outside, over the rim, down its inside."""
    outside = [(0.0, 0.0), (0.055, 0.0), (0.085, 0.04), (0.1, 0.1), (0.085, 0.17), (0.05, 0.23), (0.055, 0.29)]
    rim = [(0.05, 0.3)]
    inside = [(0.042, 0.285), (0.038, 0.23), (0.07, 0.17), (0.083, 0.1), (0.065, 0.04), (0.0, 0.02)]
    return outside + rim + inside


def _lamp():
    return rectangle("lamp", (1.5, 2.55, -0.9), "-y", (0.4, 0.25), emitter=Area(radiance=[2200.0, 2000.0, 1700.0]))


def _rooms():
    middle, half = (FRONT + BACK) / 2, (FRONT - BACK) / 2
    left, right = (LEFT + WIDTH) / 2, (WIDTH - RIGHT) / 2
    wall, high = -WALL / 2, HEIGHT / 2
    return [
        rectangle("floor", (0, 0, middle), "+y", (WIDTH, half), bsdf="tiles"),
        rectangle("ceiling", (0, HEIGHT, middle), "-y", (WIDTH, half), bsdf="plaster"),
        rectangle("left wall", (-WIDTH, high, middle), "+x", (half, high), bsdf="plaster"),
        rectangle("right wall", (WIDTH, high, middle), "-x", (half, high), bsdf="plaster"),
        rectangle("front wall", (0, high, FRONT), "-z", (WIDTH, high), bsdf="plaster"),
        rectangle("back wall", (0, high, BACK), "+z", (WIDTH, high), bsdf="plaster"),
        box("wall left of the door", (LEFT - left, high, wall), (left, high, WALL / 2), bsdf="paint"),
        box("wall right of the door", (RIGHT + right, high, wall), (right, high, WALL / 2), bsdf="paint"),
        box(
            "wall above the door",
            ((LEFT + RIGHT) / 2, (TOP + HEIGHT) / 2, wall),
            ((RIGHT - LEFT) / 2, (HEIGHT - TOP) / 2, WALL / 2),
            bsdf="paint",
        ),
    ]


def _door():
    """The door turns about the left side of the opening, into the camera's room."""
    inset, width = 0.1, RIGHT - LEFT  # the hinge end is sunk into the wall and the lower one into the floor: no slits
    hinge = place(rotate=("y", -ANGLE), translate=(LEFT, 0.0, 0.0))

    def part(name, low, high, bsdf):
        half = [round((b - a) / 2, 4) for a, b in zip(low, high, strict=True)]
        middle = [round((a + b) / 2, 4) for a, b in zip(low, high, strict=True)]
        return Cube(name=name, bsdf=bsdf, to_world=[*place(half, None, middle), *hinge])

    handle = width - 0.08
    return [
        part("door", (-inset, -0.01, -0.02), (width, TOP, 0.02), "wood"),
        part("door handle stem", (handle - 0.01, 1.0, 0.02), (handle + 0.01, 1.02, 0.07), "brass"),
        part("door handle", (handle - 0.12, 1.0, 0.07), (handle + 0.01, 1.02, 0.09), "brass"),
    ]


def _table(folder):
    x, z, top = 0.95, 1.7, 0.72
    legs = [
        box(f"table leg {i + 1}", (x + dx, top / 2 - 0.02, z + dz), (0.03, top / 2 - 0.02, 0.03), bsdf="wood")
        for i, (dx, dz) in enumerate(((-0.5, -0.3), (0.5, -0.3), (-0.5, 0.3), (0.5, 0.3)))
    ]
    vases = [
        Mesh(
            name=f"{bsdf} vase",
            file=str(folder / "meshes" / "vase.ply"),
            bsdf=bsdf,
            to_world=place(scale, None, (x + dx, top + 0.0005, z + dz)),
        )
        for bsdf, scale, dx, dz in (
            ("glass", (1.2, 1.2, 1.2), -0.38, 0.1),
            ("copper", (1.5, 1.25, 1.5), 0.1, -0.12),
            ("clay", (1.0, 0.9, 1.0), 0.4, 0.12),
        )
    ]
    return [
        box("table top", (x, top - 0.02, z), (0.6, 0.02, 0.38), bsdf="wood"),
        *legs,
        *vases,
        Sphere(name="glass ball", bsdf="glass", center=(x - 0.05, top + 0.0805, z + 0.2), radius=0.08),
        Sphere(name="silver ball", bsdf="mirror", center=(x + 0.22, top + 0.0605, z + 0.22), radius=0.06),
        box("picture frame", (1.4, 1.55, 0.015), (0.42, 0.32, 0.015), bsdf="copper"),
        box("picture", (1.4, 1.55, 0.025), (0.36, 0.26, 0.01), bsdf="clay"),
    ]
