"""The film: sums over samples in float64, and images from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import warp as wp

from wavefront.scene import description

# Channels by AOV. The EXR name of a channel is that of its AOV, a point and this.
CHANNELS = {
    "albedo": "RGB",
    "normal": "XYZ",
    "geometric_normal": "XYZ",
    "depth": "Z",
    "position": "XYZ",
    "uv": "UV",
    "shape_index": "I",
    "bsdf_index": "I",
    "sample_count": "I",
    "variance": "Y",
}
INTEGERS = ("shape_index.I", "bsdf_index.I", "sample_count.I")  # channels that 16-bit floats would round
BLOCK_PIXELS = 1 << 17  # of a film that is turned into an image block by block


@wp.struct
class FilmArrays:
    """Sums over the samples of each pixel, row by row; only what is asked for is allocated.

    In a film with weights w of samples, `L` has the sum of w L, and `luminance_squared` that of (w Y)^2 with the
    luminance Y. AOVs of the first hit are summed as ever: a guide, for whose sake there are weights, does not change
    what a camera ray hits.
    """

    L: wp.array[wp.vec3d]
    luminance_squared: wp.array[wp.float64]
    weighted_luminance: wp.array[wp.float64]  # the sum of w^2 Y
    weights: wp.array[wp.float64]  # w of the samples that are being added; sums over all so far of w, w^2 and w^3
    albedo: wp.array[wp.vec3d]
    normal: wp.array[wp.vec3d]
    geometric_normal: wp.array[wp.vec3d]
    depth: wp.array[wp.float64]
    position: wp.array[wp.vec3d]
    uv: wp.array[wp.vec2d]
    shape_index: wp.array[wp.int32]  # of the first sample, not a sum; -1 where its ray escaped


# The array that an AOV is made of; `sample_count` needs none.
_ARRAYS = {aov: aov for aov in CHANNELS if aov in FilmArrays.vars} | {
    "bsdf_index": "shape_index",
    "variance": "luminance_squared",
}
# Arrays that the first hit of a camera ray adds to.
FIRST_HIT = tuple(sorted(set(_ARRAYS.values()) - {"luminance_squared"}))

LUMINANCE = (0.212671, 0.715160, 0.072169)  # Y of linear Rec. 709 primaries with a D65 white point


@wp.struct
class FilmWindow:
    """The pixels that are rendered, in the whole film."""

    film_width: wp.int32
    x: wp.int32
    y: wp.int32


@wp.func
def luminance(L: wp.vec3) -> float:
    return 0.212671 * L[0] + 0.715160 * L[1] + 0.072169 * L[2]


def make_window(film: description.Film) -> FilmWindow:
    """The device record of a film's window."""
    window = FilmWindow()
    window.film_width, window.x, window.y = film.width, film.window.x, film.window.y
    return window


def film_arrays(aovs: tuple[str, ...], weighted: bool = False) -> tuple[str, ...]:
    """Arrays with an entry per pixel, beside that of the radiance, that some AOVs need, sorted."""
    needed = {_ARRAYS[aov] for aov in aovs if aov in _ARRAYS}
    return tuple(sorted(needed | ({"weighted_luminance"} if weighted and "variance" in aovs else set())))


def row_blocks(width: int, height: int) -> Iterator[tuple[int, int]]:
    """First row and row after the last of blocks that cover an image from the top, of whole EXR chunks if possible."""
    rows = max(1, BLOCK_PIXELS // width)
    rows = rows // 16 * 16 or rows
    for first in range(0, height, rows):
        yield first, min(height, first + rows)


class Film:
    """Sums of a render and the number of samples in them.

    Args:
        width, height: Pixels that are rendered.
        aovs: Subset of the keys of `CHANNELS`.
        device: Warp device.
        bsdf_of_shape: Index of the BSDF of each shape; needed for ``bsdf_index``.
        weighted: Samples have weights. Then `begin_pass` tells that of each pass.
    """

    def __init__(
        self,
        width: int,
        height: int,
        aovs: tuple[str, ...],
        device: str,
        bsdf_of_shape: Sequence[int] = (),
        weighted: bool = False,
    ):
        self.width, self.height, self.aovs, self.weighted = width, height, aovs, weighted
        self.bsdf_of_shape = bsdf_of_shape
        self.sample_count = 0
        self.arrays = FilmArrays()
        for name in ("L", *film_arrays(aovs, weighted)):
            dtype = FilmArrays.vars[name].type.dtype
            setattr(self.arrays, name, wp.zeros(width * height, dtype=dtype, device=device))
        if weighted:
            self.arrays.weights = wp.zeros(4, dtype=wp.float64, device=device)

    @staticmethod
    def bytes_per_pixel(aovs: tuple[str, ...], weighted: bool = False) -> int:
        """Memory that one pixel of the film takes."""
        dtypes = (FilmArrays.vars[name].type.dtype for name in ("L", *film_arrays(aovs, weighted)))
        return sum(wp.types.type_size_in_bytes(dtype) for dtype in dtypes)

    def begin_pass(self, weight: float) -> None:
        """Sets the weight of the samples that are added next, in a film with weights."""
        self.arrays.weights[:1].fill_(weight)

    def end_pass(self, samples: int) -> None:
        """Counts samples that were added to every pixel."""
        self.sample_count += samples
        if self.weighted:
            weights = self.arrays.weights.numpy().copy()
            weights[1:] += samples * weights[0] ** np.arange(1, 4)
            self.arrays.weights.assign(weights)

    @property
    def weight_sums(self) -> tuple[float, float, float]:
        """Sums over the samples of a pixel of their weights, and of the second and third powers of these."""
        if not self.weighted:
            return (float(self.sample_count),) * 3
        return tuple(self.arrays.weights.numpy()[1:].tolist())

    @property
    def effective_samples(self) -> float:
        """Samples of equal weight, of the same variance as these, whose mean is as sure (Kish 1965); 0 for none."""
        total, squares, _ = self.weight_sums
        return total * total / squares if squares else 0.0

    def _rows(self, name: str, first: int, last: int) -> np.ndarray:
        """Rows of an array, on the host: [rows, width] or [rows, width, components]."""
        values = getattr(self.arrays, name)[first * self.width : last * self.width].numpy()
        return values.reshape(last - first, self.width, *values.shape[1:])

    def _mean(self, name: str, first: int, last: int) -> np.ndarray:
        total = self.weight_sums[0] if name == "L" else self.sample_count
        return self._rows(name, first, last) / (total if self.sample_count else 1)

    def _whole(self, rows) -> np.ndarray:
        """An image from the function that gives its rows, without copies of the whole film in between."""
        image = None
        for first, last in row_blocks(self.width, self.height):
            block = rows(first, last)
            if image is None:
                image = np.empty((self.height, *block.shape[1:]), np.float32)
            image[first:last] = block
        return image

    def image_rows(self, first: int, last: int) -> np.ndarray:
        """Rows of `image`: [rows, width, 3], float32."""
        return self._mean("L", first, last).astype(np.float32)

    def image(self) -> np.ndarray:
        """Mean radiance, by the weights of the samples, shape [height, width, 3], float32, linear Rec. 709."""
        return self._whole(self.image_rows)

    def variance(self) -> np.ndarray:
        """Estimated variance of the mean luminance of each pixel, shape [height, width], float32; NaN for one sample.

        Sample variance over n, from the sums of y and y^2 in float64, which leaves some nine digits after the
        subtraction for a pixel whose samples differ by one part in a thousand.

        With weights, whose sums of powers are S1, S2 and S3, the mean m = sum(w y) / S1 has the variance
        sum(w^2 var y) / S1^2, where samples may differ in their variances: those of a guide that has learned are
        smaller. With y_i - m for what is not known, E[(y_i - m)^2] = (1 - 2 w_i / S1) var y_i + var m. So

            var m ~ sum(w^2 (y - m)^2) / (S1^2 - 2 S1 S3 / S2 + S2)

        is without bias if samples do not differ, whatever their weights, and is sample variance over n if weights do
        not either. If they do differ, its relative bias is 2 (S3 / S2 - sum(w^3 var y) / sum(w^2 var y)) / S1 to first
        order: of the order of 1 / n, and towards caution where a larger weight goes with a smaller variance.
        """
        return self._whole(self._variance)

    def _variance(self, first: int, last: int) -> np.ndarray:
        n = self.sample_count
        mean = self._mean("L", first, last) @ np.asarray(LUMINANCE)
        if n < 2:
            return np.full(mean.shape, np.nan)
        if not self.weighted:
            return np.maximum(self._mean("luminance_squared", first, last) - mean * mean, 0.0) / (n - 1)
        s1, s2, s3 = self.weight_sums
        squares = self._rows("luminance_squared", first, last) + s2 * mean * mean
        squares -= 2.0 * mean * self._rows("weighted_luminance", first, last)
        return np.maximum(squares, 0.0) / (s1 * s1 - 2.0 * s1 * s3 / s2 + s2)

    def _aov(self, aov: str, first: int, last: int) -> np.ndarray:
        if aov == "variance":
            return self._variance(first, last)
        if aov == "sample_count":
            return np.full((last - first, self.width), self.sample_count)
        if aov in ("shape_index", "bsdf_index"):
            shape = self._rows("shape_index", first, last)
            return shape if aov == "shape_index" else np.append(self.bsdf_of_shape, -1)[shape]
        return self._mean(aov, first, last)

    def rows(self, first: int, last: int) -> dict[str, np.ndarray]:
        """All channels by their EXR names, of the rows from `first` to before `last`: [rows, width], float32.

        Means over the samples of a pixel, to which a ray that escapes adds zero; but indices are those of the first
        sample, -1 where its ray escaped.
        """
        image = self.image_rows(first, last)
        channels = {name: image[..., i] for i, name in enumerate("RGB")}
        for aov in self.aovs:
            values = np.atleast_3d(self._aov(aov, first, last).astype(np.float32))
            channels |= {f"{aov}.{name}": values[..., i] for i, name in enumerate(CHANNELS[aov])}
        return channels

    def channels(self) -> dict[str, np.ndarray]:
        """All channels of the film as `rows` gives them, each [height, width], float32."""
        blocks = [self.rows(first, last) for first, last in row_blocks(self.width, self.height)]
        return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
