"""The multiresolution grid (Müller, Evans, Schied and Keller 2022): levels, look-up and its gradients.

Level l has scale s = base_resolution · per_level_scale^l - 1 and resolution ⌈s⌉ + 1. A point x lies at s x + 1/2 in
units of cells: the half staggers the levels, and lets the last vertices of a dense level wrap around to its first
ones. Outside the unit cube indices go on wrapping; a coordinate beyond 2^30 cells uses vertex 0, and NaN stays NaN.
"""

import functools
import math

import numpy as np
import warp as wp

from nn import config as c
from nn.errors import ConfigError

_MOST_ENTRIES = 1 << 31


@wp.struct
class Levels:
    """Tables of a grid, one entry per level."""

    scale: wp.array[wp.float32]
    stride: wp.array2d[wp.uint32]  # index step per dimension; zero where the schema leaves a dimension out
    size: wp.array[wp.uint32]  # entries
    offset: wp.array[wp.int32]  # first entry
    hashed: wp.array[wp.int32]


class GridLayout:
    """Sizes of the levels of a grid.

    Args:
        cfg: The grid.
        n_dims: Dimensions of its input, 1 to 4.
        path: Of `cfg` in the configuration, for messages.
    """

    def __init__(self, cfg: c.Grid, n_dims: int, path: str = "encoding"):
        if not 1 <= n_dims <= 4:
            raise ConfigError(f"{path}.n_dims_to_encode", f"found {n_dims}; a grid encodes 1 to 4 dimensions")
        octave = np.float32(math.log2(cfg.per_level_scale))
        offset = 0
        self.scales, self.resolutions, self.strides, self.sizes, self.offsets, self.hashed = [], [], [], [], [], []
        for level in range(cfg.n_levels):
            scale = np.float32(np.exp2(np.float32(level) * octave) * np.float32(cfg.base_resolution) - np.float32(1))
            resolution = math.ceil(float(scale)) + 1
            size = -(-(resolution**n_dims) // 8) * 8
            if cfg.type == "Tiled":
                size = min(size, cfg.base_resolution**n_dims)
            elif cfg.type == "Hash":
                size = min(size, 1 << cfg.log2_hashmap_size)
            strides, stride = [], 1
            for _ in range(n_dims):
                strides.append(stride if stride <= size else 0)
                stride = stride * resolution if stride <= size else stride
            self.hashed.append(cfg.type == "Hash" and size < stride)
            self.scales.append(float(scale))
            self.resolutions.append(resolution)
            self.strides.append(strides + [0] * (4 - n_dims))
            self.sizes.append(size)
            self.offsets.append(offset)
            offset += size
            if offset * cfg.n_features_per_level >= _MOST_ENTRIES:
                raise ConfigError(
                    path,
                    f"found {offset * cfg.n_features_per_level:.2g} parameters up to level {level}; allowed: < 2^31",
                )
        self.n_entries = offset

    def upload(self, device) -> Levels:
        """The tables on `device`."""
        levels = Levels()
        levels.scale = wp.array(self.scales, dtype=wp.float32, device=device)
        levels.stride = wp.array(np.array(self.strides, np.uint32), dtype=wp.uint32, device=device)
        levels.size = wp.array(np.array(self.sizes, np.uint32), dtype=wp.uint32, device=device)
        levels.offset = wp.array(self.offsets, dtype=wp.int32, device=device)
        levels.hashed = wp.array(np.array(self.hashed, np.int32), dtype=wp.int32, device=device)
        return levels


@wp.func_native("return fmaf(a, b, c);")
def fused_multiply_add(a: wp.float32, b: wp.float32, c: wp.float32) -> wp.float32: ...


@functools.cache
def make_grid_kernels(n_dims: int, n_features: int, interpolation: str, hashed: bool):
    """Kernels of one kind of grid.

    Args:
        n_dims: Dimensions, 1 to 4.
        n_features: Features per level.
        interpolation: ``Linear``, ``Smoothstep`` or ``Nearest``.
        hashed: Some level may be a hash table.

    Returns:
        forward and backward to parameters, which adds by atomics (one thread per level and row), and backward to inputs
        (one thread per row).
    """
    corners = 1 if interpolation == "Nearest" else 1 << n_dims
    smooth = interpolation == "Smoothstep"
    Feature = wp.types.vector(n_features, wp.float32)
    Point = wp.types.vector(n_dims, wp.float32)
    Cell = wp.types.vector(n_dims, wp.uint32)
    kernel = wp.kernel(
        enable_backward=False, module=f"nn.encodings.grid_{n_dims}_{n_features}_{interpolation}_{int(hashed)}"
    )

    @wp.struct
    class Place:
        low: Cell  # index term of the lower vertex, per dimension
        high: Cell
        t: Point  # position in the cell, 0 to 1
        size: wp.uint32
        offset: wp.int32
        hashed: wp.bool

    @wp.func
    def find_place(levels: Levels, level: int, x: wp.array2d[wp.float32], row: int, first_dim: int):
        scale = levels.scale[level]
        place = Place()
        place.size = levels.size[level]
        place.offset = levels.offset[level]
        if wp.static(hashed):
            place.hashed = levels.hashed[level] != 0
        for d in range(wp.static(n_dims)):
            # The rounding of x · scale would be magnified by the differences between vertices, or miss the cell.
            v = x[row, first_dim + d]
            whole = wp.floor(v * scale + 0.5)
            t = v - v
            cell = wp.uint32(0)
            if wp.abs(whole) < 1073741824.0:  # false for NaN
                t = fused_multiply_add(v, scale, 0.5 - whole)
                whole += wp.where(t < 0.0, -1.0, wp.where(t >= 1.0, 1.0, 0.0))
                t = fused_multiply_add(v, scale, 0.5 - whole)
                cell = wp.uint32(wp.int32(whole))
            place.t[d] = t
            factor = levels.stride[level, d]
            if wp.static(hashed):
                if place.hashed:
                    factor = wp.uint32(1)
                    if d == 1:
                        factor = wp.static(wp.uint32(2654435761))
                    if d == 2:
                        factor = wp.static(wp.uint32(805459861))
                    if d == 3:
                        factor = wp.static(wp.uint32(3674653429))
            place.low[d] = cell * factor
            place.high[d] = (cell + wp.uint32(1)) * factor
        return place

    @wp.func
    def entry(place: Place, corner: int):
        """Index of a corner in the whole table."""
        index = wp.uint32(0)
        for d in range(wp.static(n_dims)):
            term = wp.where((corner >> d) & 1 == 1, place.high[d], place.low[d])
            if wp.static(hashed):
                index = wp.where(place.hashed, index ^ term, index + term)
            else:
                index = index + term
        if wp.static(hashed):
            if place.hashed:
                index = index & (place.size - wp.uint32(1))  # hash tables have a power of two entries
        if index >= place.size:
            index = index % place.size
        return place.offset + wp.int32(index)

    @wp.func
    def fade(t: wp.float32):
        if wp.static(smooth):
            return t * t * (3.0 - 2.0 * t)
        return t

    @wp.func
    def weight(t: Point, corner: int):
        """Product of the weights of a corner; t has been through `fade`."""
        w = wp.float32(1.0)
        for d in range(wp.static(n_dims)):
            w = w * wp.where((corner >> d) & 1 == 1, t[d], 1.0 - t[d])
        return w

    @wp.func
    def faded(place: Place):
        t = place.t
        for d in range(wp.static(n_dims)):
            t[d] = fade(t[d])
        return t

    @kernel
    def forward(
        x: wp.array2d[wp.float32],
        first_row: int,
        first_dim: int,
        levels: Levels,
        features: wp.array[Feature],
        # out
        encoded: wp.array2d[wp.float32],
        column: int,
    ):
        level, i = wp.tid()
        row = first_row + i
        place = find_place(levels, level, x, row, first_dim)
        value = Feature()
        if wp.static(interpolation == "Nearest"):
            value = features[entry(place, 0)] + Feature(place.t[0] - place.t[0])  # the sum keeps NaN
        else:
            t = faded(place)
            for corner in range(wp.static(corners)):
                value += weight(t, corner) * features[entry(place, corner)]
        for f in range(wp.static(n_features)):
            encoded[row, column + level * wp.static(n_features) + f] = value[f]

    @wp.func
    def upstream(dL_dencoded: wp.array2d[wp.float32], row: int, column: int):
        g = Feature()
        for f in range(wp.static(n_features)):
            g[f] = dL_dencoded[row, column + f]
        return g

    @kernel
    def backward_parameters(
        x: wp.array2d[wp.float32],
        first_dim: int,
        levels: Levels,
        dL_dencoded: wp.array2d[wp.float32],
        column: int,
        # out
        sums: wp.array[wp.float64],
    ):
        level, row = wp.tid()
        place = find_place(levels, level, x, row, first_dim)
        g = upstream(dL_dencoded, row, column + level * wp.static(n_features))
        t = faded(place)
        for corner in range(wp.static(corners)):
            w = wp.float32(1.0)
            if wp.static(corners > 1):
                w = weight(t, corner)
            first = entry(place, corner) * wp.static(n_features)
            for f in range(wp.static(n_features)):
                wp.atomic_add(sums, first + f, wp.float64(w * g[f]))

    @kernel
    def backward_inputs(
        x: wp.array2d[wp.float32],
        first_row: int,
        first_dim: int,
        levels: Levels,
        n_levels: int,
        features: wp.array[Feature],
        dL_dencoded: wp.array2d[wp.float32],
        column: int,
        # out
        dL_dx: wp.array2d[wp.float32],
    ):
        row = first_row + wp.tid()
        total = Point()
        if wp.static(interpolation != "Nearest"):
            for level in range(n_levels):
                place = find_place(levels, level, x, row, first_dim)
                t = faded(place)
                g = upstream(dL_dencoded, row, column + level * wp.static(n_features))
                for corner in range(wp.static(corners)):
                    s = wp.dot(g, features[entry(place, corner)]) * levels.scale[level]
                    for d in range(wp.static(n_dims)):
                        slope = wp.float32(1.0)
                        if wp.static(smooth):
                            slope = 6.0 * place.t[d] * (1.0 - place.t[d])
                        for o in range(wp.static(n_dims)):
                            if o != d:
                                slope = slope * wp.where((corner >> o) & 1 == 1, t[o], 1.0 - t[o])
                        total[d] += wp.where((corner >> d) & 1 == 1, s * slope, -s * slope)
        for d in range(wp.static(n_dims)):
            dL_dx[row, first_dim + d] = dL_dx[row, first_dim + d] + total[d]

    return forward, backward_parameters, backward_inputs
