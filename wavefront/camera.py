"""Cameras: from a position on the film, and on the lens, to a ray."""

from __future__ import annotations

import functools
import math

import numpy as np
import warp as wp

from wavefront.scene import description
from wavefront.scene.transforms import to_matrix
from wavefront.warp_samples import square_to_disk


@wp.struct
class Camera:
    """World-space vectors of any kind of camera; film positions (x, y) are in pixels from the upper left corner.

    A perspective ray starts at `origin` and points along `corner` + x `du` + y `dv`; an orthographic one starts at
    `origin` + x `du` + y `dv` and points along `corner`. A spherical one looks along `corner` in the middle of its
    film, with `du` to the right and `dv` upwards.
    """

    origin: wp.vec3
    corner: wp.vec3
    du: wp.vec3
    dv: wp.vec3
    lens_x: wp.vec3  # radii of the lens
    lens_y: wp.vec3
    focus_scale: wp.float32  # length of `corner` + x `du` + y `dv` over the distance to the plane of focus on that line
    turn: wp.vec2  # longitude and latitude of a pixel of the spherical camera, radians


@wp.struct
class CameraRay:
    origin: wp.vec3
    direction: wp.vec3  # unit length


def camera_kind(camera: description.Camera) -> str:
    return type(camera).__struct_config__.tag


@functools.cache
def make_camera_ray(kind: str):
    """`camera_ray(camera, x, y, u) -> CameraRay` through film position (x, y).

    Every ray has the same weight. `u` is a point of the unit square, mapped to a lens that is sampled uniformly by area
    (Cook, Porter and Carpenter 1984, "Distributed Ray Tracing"); a camera without a lens does not read it.

    Args:
        kind: ``perspective``, ``thin_lens``, ``orthographic`` or ``spherical``.
    """

    @wp.func
    def camera_ray(camera: Camera, x: float, y: float, u: wp.vec2) -> CameraRay:
        ray = CameraRay()
        ray.origin = camera.origin
        if wp.static(kind == "orthographic"):
            ray.origin = camera.origin + (x * camera.du + y * camera.dv)
            ray.direction = camera.corner
        if wp.static(kind == "perspective"):
            ray.direction = wp.normalize(camera.corner + x * camera.du + y * camera.dv)
        if wp.static(kind == "thin_lens"):
            p = square_to_disk(u)
            lens = p[0] * camera.lens_x + p[1] * camera.lens_y
            ray.origin = camera.origin + lens
            focus = camera.corner + x * camera.du + y * camera.dv
            ray.direction = wp.normalize(focus - camera.focus_scale * lens)
        if wp.static(kind == "spherical"):  # beyond an edge it goes on over the pole, or around
            longitude = x * camera.turn[0] - wp.static(math.pi)
            polar = y * camera.turn[1]
            level = wp.sin(longitude) * camera.du + wp.cos(longitude) * camera.corner
            ray.direction = wp.normalize(wp.sin(polar) * level + wp.cos(polar) * camera.dv)
        return ray

    return camera_ray


def make_camera(camera: description.Camera, film: description.Film) -> Camera:
    """The device record of a camera. Local axes: -Z forward, +X right, +Y up."""
    matrix = to_matrix(camera.to_world)
    right, up, back, origin = matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3]
    if isinstance(camera, description.Orthographic):
        width, height = film.width, film.height
        half_width = camera.width / 2.0
        half_height = half_width * height / (width * film.pixel_aspect)
        record = Camera()
        record.origin = wp.vec3(*(origin - half_width * right + half_height * up))
        record.corner = wp.vec3(*(-back / np.linalg.norm(back)))
        record.du = wp.vec3(*(right * (2.0 * half_width / width)))
        record.dv = wp.vec3(*(up * (-2.0 * half_height / height)))
        return record
    if isinstance(camera, description.Spherical):
        # Only the direction matters; scaled so that tiny and huge transforms keep float32's digits.
        scale = 1.0 / np.abs(matrix[:3, :3]).max()
        record = Camera()
        record.origin = wp.vec3(*origin)
        record.corner = wp.vec3(*(-back * scale))
        record.du = wp.vec3(*(right * scale))
        record.dv = wp.vec3(*(up * scale))
        record.turn = wp.vec2(2.0 * math.pi / film.width, math.pi / film.height)
        return record
    half_width, half_height = half_extent(camera, film)
    x, y = camera.principal_point_offset
    corner = (2.0 * x - 1.0) * half_width * right + (1.0 - 2.0 * y) * half_height * up - back
    # As above.
    scale = 1.0 / max(np.abs(corner).max(), np.finfo(np.float64).tiny)
    record = Camera()
    record.origin = wp.vec3(*origin)
    record.corner = wp.vec3(*(corner * scale))
    record.du = wp.vec3(*(right * (2.0 * half_width / film.width * scale)))
    record.dv = wp.vec3(*(up * (-2.0 * half_height / film.height * scale)))
    if isinstance(camera, description.ThinLens):
        record.lens_x = wp.vec3(*(right * camera.aperture_radius))
        record.lens_y = wp.vec3(*(up * camera.aperture_radius))
        record.focus_scale = scale / camera.focus_distance
    return record


def half_extent(camera: description.Perspective, film: description.Film) -> tuple[float, float]:
    """Half the width and height of the film at a distance of one."""
    width, height = film.width * film.pixel_aspect, film.height
    axis = camera.fov_axis
    if axis == "smaller":
        axis = "x" if width < height else "y"
    elif axis == "larger":
        axis = "x" if width > height else "y"
    half = math.tan(math.radians(camera.fov) / 2.0)
    half_width = {"x": half, "y": half * width / height, "diagonal": half * width / math.hypot(width, height)}[axis]
    return half_width, half_width * height / width
