"""Mitsuba XML elements, and the numbers, points and transforms that are written in them."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from wavefront.errors import SceneError
from wavefront.scene import transforms

STEP_TAGS = ("translate", "rotate", "scale", "lookat", "matrix")


@dataclass
class Element:
    """One XML element and where it starts."""

    tag: str
    attributes: dict[str, str]
    file: Path
    line: int
    children: list[Element] = field(default_factory=list)

    def error(self, message: str) -> SceneError:
        """An error at this element's line."""
        message = message if len(message) <= 400 else message[:400] + "..."
        return SceneError(message, self.file, f"line {self.line}")

    def where(self) -> str:
        """File and line, for a warning."""
        return f"{self.file}: line {self.line}"

    def attribute(self, name: str) -> str:
        """The value of an attribute that must be there."""
        if name not in self.attributes:
            raise self.error(f"<{self.tag}> needs the attribute {name!r}")
        return self.attributes[name]

    def check_attributes(self, *allowed: str) -> None:
        """Raises SceneError for an attribute that is not in `allowed`."""
        for name in self.attributes:
            if name not in allowed:
                raise self.error(f"<{self.tag}> has no attribute {name!r}; {nearest(name, allowed)}")


def nearest(name: str, allowed) -> str:
    """The allowed names, led by the one that `name` may have meant."""
    allowed = sorted(allowed)
    close = difflib.get_close_matches(name, allowed, 1)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"{hint}allowed: {', '.join(allowed) or 'none'}"


# --- values ----------------------------------------------------------------------------------------------------


def to_number(element: Element, text: str) -> float:
    """A finite number from text. Raises SceneError at the element."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise element.error(f"{text!r} is not a finite number")
    return value


def to_numbers(element: Element, text: str) -> list[float]:
    """Numbers that white space or commas separate."""
    return [to_number(element, part) for part in text.replace(",", " ").split()]


def to_xyz(element: Element, default: float) -> tuple[float, float, float]:
    """x, y and z from attributes of that name, or from `value` with one or three numbers."""
    if "value" in element.attributes:
        if any(axis in element.attributes for axis in "xyz"):
            raise element.error(f"<{element.tag}> has either value or x, y, z")
        numbers = to_numbers(element, element.attributes["value"])
        if len(numbers) not in (1, 3):
            raise element.error(f"<{element.tag}> needs one or three numbers; found {len(numbers)}")
        return tuple(numbers * (3 // len(numbers)))
    return tuple(to_number(element, element.attributes.get(axis, repr(default))) for axis in "xyz")


def to_matrix(element: Element) -> np.ndarray:
    """The (4, 4) matrix of a <transform>, the first step applied first."""
    matrix = np.eye(4)
    for step in element.children:
        matrix = _step_matrix(step) @ matrix
    return matrix


def _step_matrix(step):
    tag = step.tag
    if tag == "matrix":
        step.check_attributes("value")
        numbers = to_numbers(step, step.attribute("value"))
        if len(numbers) not in (9, 16):
            raise step.error(f"<matrix> needs 9 or 16 numbers; found {len(numbers)}")
        size = 3 if len(numbers) == 9 else 4
        matrix = np.eye(4)
        matrix[:size, :size] = np.reshape(numbers, (size, size))
        return matrix
    if tag == "lookat":
        step.check_attributes("origin", "target", "up")
        return _look_at(step)
    if tag not in STEP_TAGS:
        raise step.error(f"<{tag}> cannot stand inside a <transform>; {nearest(tag, STEP_TAGS)}")
    step.check_attributes("x", "y", "z", "value", *(["angle"] if tag == "rotate" else []))
    matrix = np.eye(4)
    if tag == "rotate":
        angle = to_number(step, step.attribute("angle"))
        try:
            # an axis of any length is a direction, as in Mitsuba 0.6; Mitsuba 3.9 would also scale by it
            return transforms.rotate(to_xyz(step, 0.0), angle)
        except SceneError as error:
            raise step.error(error.message) from None
    if tag == "translate":
        matrix[:3, 3] = to_xyz(step, 0.0)
    else:
        matrix[[0, 1, 2], [0, 1, 2]] = to_xyz(step, 1.0)
    return matrix


def _look_at(step):
    """Mitsuba's look-at frame: +Z to the target, +X to the left of the viewer. Without up, any upright is chosen."""
    points = []
    for name in ("origin", "target", "up"):
        if name == "up" and not step.attributes.get("up", "").strip():
            points.append([0.0, 0.0, 0.0])
            continue
        numbers = to_numbers(step, step.attribute(name))
        if len(numbers) != 3:
            raise step.error(f"{name} of <lookat> needs three numbers; found {len(numbers)}")
        points.append(numbers)
    origin, target, up = np.array(points)
    if not up.any():
        up = _some_upright(target - origin)
    try:
        return transforms.look_at(origin, target, up) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    except SceneError as error:
        raise step.error(error.message) from None


def _some_upright(direction):
    """The first tangent of Duff et al., *Building an Orthonormal Basis, Revisited* (2017): what Mitsuba takes as up."""
    x, y, z = direction / max(np.linalg.norm(direction), 1e-300)
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    return np.array([1.0 + sign * x * x * a, sign * x * y * a, -sign * x])
