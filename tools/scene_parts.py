"""Parts that the scenes of `tools.make_scenes` are put together from."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from wavefront.scene.description import Cube, Film, LookAt, Rectangle, Rotate, TentFilter, TransformStep

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
# What turns the +Z side of a rectangle to a direction.
_FACING = {"+x": ("y", 90.0), "-x": ("y", -90.0), "+y": ("x", -90.0), "-y": ("x", 90.0), "+z": None, "-z": ("y", 180.0)}


def film(width: int = 256, height: int = 256) -> Film:
    """The film of all our scenes."""
    return Film(width=width, height=height, filter=TentFilter())


def look_at(origin: tuple, target: tuple) -> list[TransformStep]:
    """The transform of a camera at `origin`."""
    return [TransformStep(look_at=LookAt(origin=_floats(origin), target=_floats(target)))]


def place(scale=None, rotate: tuple[str, float] | None = None, translate=None) -> list[TransformStep]:
    """A transform that scales, then turns about an axis, then moves."""
    steps = []
    if scale is not None and tuple(scale) != (1, 1, 1):
        steps.append(TransformStep(scale=_floats(scale)))
    if rotate is not None:
        steps.append(TransformStep(rotate=Rotate(axis=_AXES[rotate[0]], angle=rotate[1])))
    if translate is not None and any(translate):
        steps.append(TransformStep(translate=_floats(translate)))
    return steps


def rectangle(name: str, middle: tuple, facing: str, half_size: tuple[float, float], **fields) -> Rectangle:
    """A rectangle that faces along an axis. `half_size` is along x (z if it faces along x) and y (z if along y)."""
    return Rectangle(name=name, to_world=place((*half_size, 1.0), _FACING[facing], middle), **fields)


def box(name: str, middle: tuple, half_size: tuple, turn: float | None = None, **fields) -> Cube:
    """A box, turned by `turn` degrees about the vertical."""
    return Cube(name=name, to_world=place(half_size, turn and ("y", turn), middle), **fields)


def revolve(profile: list[tuple[float, float]], segments: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A surface of revolution about Y, facing away from the axis where the profile rises.

    Args:
        profile: (radius, height) from the bottom up; a radius of 0 at an end is a pole.
        segments: Steps around the axis.

    Returns:
        Vertices, normals, UVs and faces. The seam is doubled so that u runs from 0 to 1.
    """
    points = np.array(profile)
    along = np.gradient(points, axis=0)
    outward = np.stack((along[:, 1], -along[:, 0]), axis=1)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    angles = np.arange(segments + 1) * (2.0 * math.pi / segments)
    around = np.stack((np.sin(angles), np.cos(angles)), axis=1)

    def spin(values):
        flat = values[:, None, 0, None] * around
        return np.stack((flat[..., 0], np.broadcast_to(values[:, None, 1], flat.shape[:2]), flat[..., 1]), axis=-1)

    count = segments + 1
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    v = 1.0 - np.concatenate(((0.0,), np.cumsum(length))) / length.sum()
    uvs = np.stack(np.broadcast_arrays(np.arange(count)[None, :] / segments, v[:, None]), axis=-1)
    faces = []
    for row in range(len(profile) - 1):
        for column in range(segments):
            a, b = row * count + column, (row + 1) * count + column
            if points[row, 0] > 0.0:
                faces.append((a, a + 1, b + 1))
            if points[row + 1, 0] > 0.0:
                faces.append((a, b + 1, b))
    return spin(points).reshape(-1, 3), spin(outward).reshape(-1, 3), uvs.reshape(-1, 2), np.array(faces)


def write_ply(path: Path, vertices: np.ndarray, normals: np.ndarray, uvs: np.ndarray, faces: np.ndarray) -> None:
    """Writes an ASCII PLY with five decimals, which are the same on every machine."""
    table = np.concatenate((vertices, normals, uvs), axis=1).round(5) + 0.0  # + 0.0: no negative zeros
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    lines = [
        "ply",
        "format ascii 1.0",
        "comment made by tools/make_scenes.py",
        f"element vertex {len(table)}",
        *(f"property float {name}" for name in names),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        *(" ".join(f"{value:.5f}".rstrip("0").rstrip(".") for value in row) for row in table),
        *(f"3 {a} {b} {c}" for a, b, c in faces.tolist()),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")


def _floats(values: tuple) -> tuple:
    return tuple(float(value) for value in values)
