"""Pinhole camera: from a position on the film to a ray."""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from wavefront.scene.description import Film, Perspective
from wavefront.scene.transforms import to_matrix


@wp.struct
class Camera:
    """World-space vectors: the ray through film position (x, y), in pixels, points along corner + x du + y dv."""

    origin: wp.vec3
    corner: wp.vec3
    du: wp.vec3
    dv: wp.vec3


@wp.func
def camera_ray(camera: Camera, x: float, y: float) -> wp.vec3:
    """Unit direction of the ray through film position (x, y), from the upper left corner, in pixels."""
    return wp.normalize(camera.corner + x * camera.du + y * camera.dv)


def make_camera(camera: Perspective, film: Film) -> Camera:
    """The device record of a camera. Local axes: -Z forward, +X right, +Y up."""
    width, height = film.width, film.height
    axis = camera.fov_axis
    if axis == "smaller":
        axis = "x" if width < height else "y"
    elif axis == "larger":
        axis = "x" if width > height else "y"
    half = math.tan(math.radians(camera.fov) / 2.0)
    half_width = {"x": half, "y": half * width / height, "diagonal": half * width / math.hypot(width, height)}[axis]
    half_height = half_width * height / width
    matrix = to_matrix(camera.to_world)
    right, up, back = matrix[:3, 0], matrix[:3, 1], matrix[:3, 2]
    record = Camera()
    record.origin = wp.vec3(*matrix[:3, 3])
    corner = -half_width * right + half_height * up - back
    # Only the direction matters; scaled so that tiny and huge transforms keep float32's digits.
    scale = 1.0 / max(np.abs(corner).max(), np.finfo(np.float64).tiny)
    record.corner = wp.vec3(*(corner * scale))
    record.du = wp.vec3(*(right * (2.0 * half_width / width * scale)))
    record.dv = wp.vec3(*(up * (-2.0 * half_height / height * scale)))
    return record
