"""The scene of coloured glass: absorption in closed bodies, in a liquid around another, and behind a null surface."""

from __future__ import annotations

from tools.scene_parts import box, film, look_at, rectangle
from wavefront.scene.description import (
    Area,
    Constant,
    Dielectric,
    Diffuse,
    Homogeneous,
    Null,
    PathIntegrator,
    Perspective,
    Scene,
    Sphere,
)


def coloured_glass() -> Scene:
    """A ball that light crosses at all lengths, a block, and a block of smoke that holds a ball of denser smoke."""
    return Scene(
        description="A ball of green glass, a block of red glass and a block of smoke around a ball: absorption grows "
        "with the way through, so thick parts are dark and saturated.",
        camera=Perspective(fov=42.0, to_world=look_at((0, 1.7, 4.6), (0, 0.55, 0))),
        film=film(),
        integrator=PathIntegrator(max_depth=16),
        bsdfs=[
            Diffuse(name="floor", reflectance=[0.7, 0.68, 0.62]),
            Dielectric(name="glass", int_ior="bk7"),
            Null(name="nothing"),
        ],
        media=[
            Homogeneous(name="green", sigma_a=[2.0, 0.3, 1.4]),
            Homogeneous(name="red", sigma_a=[0.2, 2.2, 2.6]),
            Homogeneous(name="smoke", sigma_a=0.8),
            Homogeneous(name="dense smoke", sigma_a=0.8, scale=5.0),
        ],
        emitters=[Constant(radiance=[0.45, 0.5, 0.55])],
        shapes=[
            rectangle("floor", (0, 0, 0), "+y", (4.0, 4.0), bsdf="floor"),
            rectangle("lamp", (-1.2, 3.5, 1.0), "-y", (0.7, 0.7), emitter=Area(radiance=[9.0, 8.5, 8.0])),
            Sphere(name="ball", bsdf="glass", interior="green", center=(-1.05, 0.55, 0.1), radius=0.55),
            box("block", (0.0, 0.4, 0.2), (0.3, 0.4, 0.3), turn=30.0, bsdf="glass", interior="red"),
            box("smoke", (1.1, 0.52, 0.0), (0.5, 0.5, 0.5), turn=15.0, bsdf="nothing", interior="smoke"),
            Sphere(
                name="smoke ball",
                bsdf="nothing",
                interior="dense smoke",
                exterior="smoke",
                center=(1.1, 0.52, 0.0),
                radius=0.3,
            ),
        ],
    )
