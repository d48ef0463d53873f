"""From groups and instances to the device: one acceleration structure a group, and a hierarchy of instances above."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
import warp as wp

from wavefront.accel.geometry import Geometry
from wavefront.accel.instance import Group, Instance, no_shapes
from wavefront.scene import description
from wavefront.scene.transforms import to_matrix
from wavefront.surface import POSITION_ERROR


@dataclasses.dataclass
class Part:
    """Consecutive triangles and spheres that are traced together: those of the scene itself, or of a group."""

    first_triangle: int
    triangle_count: int
    first_sphere: int
    sphere_count: int
    group: Group = dataclasses.field(default_factory=no_shapes)
    spheres: np.ndarray | None = None  # centre and radius, [N, 4] float32
    bounds: np.ndarray = dataclasses.field(default_factory=lambda: np.array([np.full(3, np.inf), np.full(3, -np.inf)]))

    def enclose(self, points: Iterable[np.ndarray]) -> None:
        """Grows the bounds to include points, arrays of [N, 3]."""
        for array in points:
            self.bounds[0] = np.minimum(self.bounds[0], array.min(axis=0))
            self.bounds[1] = np.maximum(self.bounds[1], array.max(axis=0))


class InstanceUpload:
    """Puts groups into the scene.

    Args:
        scene: Valid records.
        device: Where to.
    """

    def __init__(self, scene: description.Scene, device: str):
        self.device = device
        used = {instance.group for instance in scene.instances}
        self.names = [group.name for group in scene.groups if group.name in used]  # the others are not uploaded
        index = {name: i for i, name in enumerate(self.names)}
        self.group_of = np.array([index[instance.group] for instance in scene.instances], np.int32)
        matrices = [to_matrix(item.to_world, f"instances[{i}].to_world") for i, item in enumerate(scene.instances)]
        self.matrices = np.array(matrices).reshape(-1, 4, 4)

    def boxes(self, parts: list[Part], own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corners of the box of each instance, [N, 3] float32.

        They are grown by the roundings of a ray from anywhere in the scene on its way to local space, so that what it
        meets there lies in the box. With M = `to_world`, these are some units in the last place of |M^-1| times the way
        of the ray from the translation, component by component, and in the world |M| times that.

        Args:
            parts: Of each group.
            own: Bounds of the scene's own shapes, [2, 3]; infinite and inside out if there are none.
        """
        bounds = np.array([part.bounds for part in parts])[self.group_of]
        linear, translation = self.matrices[:, :3, :3], self.matrices[:, :3, 3]
        spread = np.abs(linear) @ np.abs(np.linalg.inv(linear))
        center = np.einsum("nij,nj->ni", linear, bounds.mean(axis=1)) + translation
        half = np.einsum("nij,nj->ni", np.abs(linear), 0.5 * (bounds[:, 1] - bounds[:, 0]))
        way = np.einsum("nij,nj->ni", np.abs(linear), np.abs(bounds).max(axis=1))
        way += np.maximum((center + half).max(axis=0), own[1]) - np.minimum((center - half).min(axis=0), own[0])
        half += float(POSITION_ERROR) * (np.einsum("nij,nj->ni", spread, way) + np.abs(translation))
        return tuple((center + sign * half).astype(np.float32) for sign in (-1.0, 1.0))

    def upload(self, geometry: Geometry, parts: list[Part]) -> None:
        """Fills in the instances of `geometry`, all but the hierarchy of their boxes."""
        host = np.zeros(len(self.matrices), Instance.numpy_dtype())
        # The inverse is that of the rounded matrix.
        host["to_world"], host["translation"] = self.matrices[:, :3, :3], self.matrices[:, :3, 3]
        host["to_local"] = np.linalg.inv(host["to_world"].astype(np.float64))
        host["group"] = self.group_of
        geometry.instances = wp.array(host, dtype=Instance, device=self.device)
        geometry.groups = wp.array([part.group for part in parts], dtype=Group, device=self.device)
