"""From media to their table on the device, and to what lies on either side of each shape."""

from __future__ import annotations

import numpy as np
import warp as wp

from wavefront.accel.geometry import Geometry
from wavefront.scene import description
from wavefront.scene.lookup import resolve_medium
from wavefront.scene.texture_upload import rgb


class MediumUpload:
    """Collects media, each once. Medium 0 is vacuum, which stands for every medium that does not absorb."""

    def __init__(self, scene: description.Scene):
        self.scene = scene
        self.sigma_a: list[tuple[float, ...]] = [(0.0, 0.0, 0.0)]
        self.camera = self._index(scene.camera.medium)

    @property
    def absorbing(self) -> bool:
        """Whether any medium does, so that kernels must know of media."""
        return len(self.sigma_a) > 1

    def sides(self, shape: description.Shape) -> dict[str, int]:
        """Fields of a shape's record: the media on either side, -1 if it bounds none."""
        if shape.interior is None and shape.exterior is None:
            return {"exterior": -1, "interior": -1}
        return {"exterior": self._index(shape.exterior), "interior": self._index(shape.interior)}

    def upload(self, geometry: Geometry, device: str) -> None:
        """Fills in the media of `geometry`, if any absorbs."""
        if self.absorbing:
            geometry.sigma_a = wp.array(np.array(self.sigma_a, np.float32), dtype=wp.vec3, device=device)
            geometry.camera_medium = self.camera

    def _index(self, ref) -> int:
        medium = resolve_medium(self.scene, ref)
        sigma_a = (0.0, 0.0, 0.0) if medium is None else tuple((medium.scale * rgb(medium.sigma_a)).tolist())
        if sigma_a not in self.sigma_a:
            self.sigma_a.append(sigma_a)
        return self.sigma_a.index(sigma_a)
