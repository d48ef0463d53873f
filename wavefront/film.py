"""The film: sums over samples in float64, and images from them."""

from __future__ import annotations

import numpy as np
import warp as wp


@wp.struct
class FilmArrays:
    """Sums over the samples of each pixel, row by row; only what is asked for is allocated."""

    L: wp.array[wp.vec3d]
    luminance_squared: wp.array[wp.float64]
    albedo: wp.array[wp.vec3d]
    normal: wp.array[wp.vec3d]
    depth: wp.array[wp.float64]


LUMINANCE = (0.212671, 0.715160, 0.072169)  # Y of linear Rec. 709 primaries with a D65 white point


@wp.func
def luminance(L: wp.vec3) -> float:
    return 0.212671 * L[0] + 0.715160 * L[1] + 0.072169 * L[2]


class Film:
    """Sums of a render and the number of samples in them.

    Args:
        width, height: Pixels.
        aovs: Subset of ``("albedo", "depth", "normal", "variance")``.
        device: Warp device.
    """

    def __init__(self, width: int, height: int, aovs: tuple[str, ...], device: str):
        self.width, self.height, self.aovs = width, height, aovs
        self.sample_count = 0
        self.arrays = FilmArrays()
        fields = {"L", *aovs} - {"variance"} | ({"luminance_squared"} if "variance" in aovs else set())
        for name in fields:
            dtype = FilmArrays.vars[name].type.dtype
            setattr(self.arrays, name, wp.zeros(width * height, dtype=dtype, device=device))

    @staticmethod
    def bytes_per_pixel(aovs: tuple[str, ...]) -> int:
        """Memory that one pixel of the film takes."""
        return 24 + sum({"albedo": 24, "normal": 24, "depth": 8, "variance": 8}[aov] for aov in aovs)

    def _mean(self, name: str) -> np.ndarray:
        sums = getattr(self.arrays, name).numpy()
        shape = (self.height, self.width, 3) if sums.ndim == 2 else (self.height, self.width)
        return sums.reshape(shape) / max(self.sample_count, 1)

    def image(self) -> np.ndarray:
        """Mean radiance, shape [height, width, 3], float32, linear Rec. 709."""
        return self._mean("L").astype(np.float32)

    def variance(self) -> np.ndarray:
        """Estimated variance of the mean luminance of each pixel, shape [height, width], float32; NaN for one sample.

        Sample variance over n, from the sums of y and y^2 in float64, which leaves some nine digits after the
        subtraction for a pixel whose samples differ by one part in a thousand.
        """
        n = self.sample_count
        mean = self._mean("L") @ np.asarray(LUMINANCE)
        if n < 2:
            return np.full(mean.shape, np.nan, np.float32)
        return (np.maximum(self._mean("luminance_squared") - mean * mean, 0.0) / (n - 1)).astype(np.float32)

    def channels(self) -> dict[str, np.ndarray]:
        """All channels by their EXR names, each [height, width], float32."""
        image = self.image()
        channels = {name: image[..., i] for i, name in enumerate("RGB")}
        for aov in self.aovs:
            if aov == "variance":
                channels["variance.Y"] = self.variance()
            elif aov == "depth":
                channels["depth.Z"] = self._mean("depth").astype(np.float32)
            else:
                values = self._mean(aov).astype(np.float32)
                for i, name in enumerate("RGB" if aov == "albedo" else "XYZ"):
                    channels[f"{aov}.{name}"] = values[..., i]
        return channels
