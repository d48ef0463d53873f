"""The scenes of the cameras: one for each kind but the pinhole, by the end of its name."""

from __future__ import annotations

from tools.scene_parts import box, film, look_at, rectangle
from wavefront.scene.description import (
    Area,
    Camera,
    Checkerboard,
    Constant,
    Diffuse,
    Orthographic,
    PathIntegrator,
    Scene,
    Sphere,
    ThinLens,
)


def scenes() -> dict[str, Scene]:
    """Each camera before the same row of balls and posts, from near to far."""
    view = look_at((0.0, 1.6, 4.0), (0.0, 0.7, 0.0))
    distance = 4.1  # to the middle of the row
    return {
        "thin-lens": _scene(
            "a thin lens that is focused on the third of five balls",
            ThinLens(fov=42.0, aperture_radius=0.12, focus_distance=distance, to_world=view),
        ),
        "orthographic": _scene(
            "parallel projection, in which near and far are of one size",
            Orthographic(width=5.2, to_world=look_at((2.0, 3.0, 4.0), (0.0, 0.4, -0.3))),
        ),
    }


def _scene(what: str, camera: Camera) -> Scene:
    places = [(-0.9, 1.8), (-0.45, 0.9), (0.0, 0.0), (0.55, -1.1), (1.2, -2.6)]
    colours = [[0.7, 0.2, 0.15], [0.7, 0.5, 0.15], [0.25, 0.6, 0.25], [0.2, 0.4, 0.7], [0.5, 0.3, 0.65]]
    return Scene(
        description=f"A camera: {what}.",
        camera=camera,
        film=film(),
        integrator=PathIntegrator(max_depth=5),
        textures=[
            Checkerboard(name="checks", color0=0.6, color1=0.25, uv_transform=((16.0, 0.0, 0.0), (0.0, 16.0, 0.0)))
        ],
        bsdfs=[Diffuse(name="floor", reflectance="checks"), Diffuse(name="post", reflectance=0.6)],
        emitters=[Constant(radiance=[0.35, 0.4, 0.5])],
        shapes=[
            rectangle("floor", (0, 0, 0), "+y", (5.0, 5.0), bsdf="floor"),
            rectangle("lamp", (-2.0, 4.5, 2.0), "-y", (0.7, 0.7), emitter=Area(radiance=[16.0, 15.0, 13.0])),
            *(
                Sphere(name=f"ball {i + 1}", center=(x, 0.8, z), radius=0.3, bsdf=Diffuse(reflectance=colour))
                for i, ((x, z), colour) in enumerate(zip(places, colours, strict=True))
            ),
            *(box(f"post {i + 1}", (x, 0.25, z), (0.1, 0.25, 0.1), bsdf="post") for i, (x, z) in enumerate(places)),
        ],
    )
