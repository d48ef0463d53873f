"""Transform records to 4x4 matrices (float64, acting on column vectors)."""

from __future__ import annotations

import numpy as np

from wavefront.errors import SceneError
from wavefront.scene.description import LookAt, Rotate, Transform, TransformStep

_KEYS = ("translate", "rotate", "scale", "look_at", "matrix")


def to_matrix(transform: Transform, where: str = "") -> np.ndarray:
    """Matrix of a transform record.

    Args:
        transform: Four rows of a matrix, or steps of which the first is applied first. Empty: identity.
        where: Record path that an error names, such as ``shapes[3].to_world``.

    Returns:
        (4, 4) float64: finite, affine (last row 0 0 0 1) and invertible.

    Raises:
        SceneError: Rows and steps mixed, a step without exactly one key, a zero rotation axis, a degenerate look-at,
            a number that is not finite, a projective or a singular matrix.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is reported by the checks
        if transform and not any(isinstance(item, TransformStep) for item in transform):
            matrix = _rows(transform, where)
        else:
            matrix = _product(transform, where)
    check_affine(matrix, where)
    check_invertible(matrix, where)
    return matrix


def check_affine(matrix: np.ndarray, where: str = "") -> None:
    """Raises SceneError unless all 16 numbers are finite and the last row is 0 0 0 1."""
    if not np.isfinite(matrix).all():
        raise SceneError("the transform has a number that is not finite", path=where)
    if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
        raise SceneError(f"the last row of a transform must be 0 0 0 1, not {_text(matrix[3])}", path=where)


def check_invertible(matrix: np.ndarray, where: str = "") -> None:
    """Raises SceneError where the linear part flattens space: smallest singular value below 1e-12 of the largest."""
    singular = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if not singular[2] > 1e-12 * singular[0]:
        raise SceneError("the transform is not invertible (it flattens space); check for a scale of 0", path=where)


def rows(matrix: np.ndarray) -> list[tuple[float, ...]]:
    """A matrix as a transform record."""
    return [tuple(float(value) + 0.0 for value in row) for row in matrix]  # + 0.0: no minus zeros


def is_mirror(matrix: np.ndarray) -> bool:
    """Whether the (4, 4) matrix turns a right-handed frame into a left-handed one."""
    return bool(np.linalg.slogdet(matrix[:3, :3])[0] < 0.0)


def look_at(origin, target, up, where: str = "") -> np.ndarray:
    """(4, 4) right-handed frame at `origin`: -Z to `target`, +Y leaning to `up`, +X to the right.

    Raises SceneError where origin and target coincide, or up is zero or parallel to the line of sight.
    """
    origin, target, up = (np.asarray(v, np.float64) for v in (origin, target, up))
    back = origin - target
    if not np.linalg.norm(back) > 0.0:
        raise SceneError("look_at: origin and target are the same point", path=where)
    back /= np.linalg.norm(back)
    right = np.cross(up, back)
    if not np.linalg.norm(right) > 1e-12 * max(np.linalg.norm(up), 1e-300):
        raise SceneError("look_at: up is zero or parallel to the line of sight", path=where)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = right, np.cross(back, right), back, origin
    return matrix


def rotate(axis, angle: float, where: str = "") -> np.ndarray:
    """(4, 4) rotation by `angle` degrees, counter-clockwise seen against `axis` (Rodrigues' formula)."""
    axis = np.asarray(axis, np.float64)
    length = np.linalg.norm(axis)
    if not length > 0.0:
        raise SceneError("the rotation axis is zero", path=where)
    x, y, z = axis / length
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    theta = np.radians(angle)
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(theta) * cross + (1.0 - np.cos(theta)) * (cross @ cross)
    return matrix


def _product(steps, where):
    matrix = np.eye(4)
    for i, step in enumerate(steps):
        if not isinstance(step, TransformStep):
            raise SceneError("matrix rows and steps cannot be mixed in one transform", path=where)
        factor = _step(step, f"{where}[{i}]")
        check_affine(factor, f"{where}[{i}]")
        matrix = factor @ matrix
    return matrix


def _step(step: TransformStep, where: str) -> np.ndarray:
    given = [key for key in _KEYS if getattr(step, key) is not None]
    if len(given) != 1:
        found = " and ".join(given) or "none"
        raise SceneError(f"a transform step has exactly one of {', '.join(_KEYS)}; found {found}", path=where)
    value = getattr(step, given[0])
    where = f"{where}.{given[0]}"
    if isinstance(value, LookAt):
        return look_at(value.origin, value.target, value.up, where)
    if isinstance(value, Rotate):
        return rotate(value.axis, value.angle, where)
    matrix = np.eye(4)
    if given[0] == "translate":
        matrix[:3, 3] = value
    elif given[0] == "scale":
        matrix[[0, 1, 2], [0, 1, 2]] = value
    else:
        matrix = _rows(value, where)
    return matrix


def _rows(rows, where: str) -> np.ndarray:
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        raise SceneError(f"a matrix has four rows of four numbers; found {len(rows)} rows", path=where)
    return np.array(rows, np.float64)


def _text(numbers) -> str:
    return " ".join(f"{number:g}" for number in numbers)
