"""Environment maps: an image around the scene, sampled by its luminance.

The image is in latitude and longitude. Longitude is u = atan2(x, -z) / 2 pi in the map's own axes: pixels are cells in
u, their centres at half-integers, and the image repeats. The rows are at the colatitudes pi i / (height - 1), the first
row at the upper pole (+Y) and the last one at the lower pole. In between radiance is interpolated bilinearly. This is
the parameterisation of Mitsuba 3, so that a scene of either looks the same.

Sampling follows the interpolated luminance, not that of single pixels: a *cell* lies between four neighbouring pixels,
and its share is the mean of their luminances times its solid angle. Within the cell the density in (u, v) is bilinear
in the same four luminances, which is inverted in closed form. So the density is positive wherever radiance is, and
radiance / density varies within a row of cells by sin(theta) alone.
"""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from wavefront.film import LUMINANCE

QUANTA = 1 << 24  # steps of the numbers that samples are drawn from (see rng.to_unit_interval)
_DARK = wp.constant(1.0e-30)  # luminance below which float32 has no digits left for ratios: taken as black


@wp.struct
class EnvironmentMap:
    width: wp.int32
    height: wp.int32
    channels: wp.int32  # 1 or 3
    scale: wp.float32
    to_world: wp.mat33  # orthogonal
    bytes: wp.array[wp.uint8]  # pixels of an 8-bit file, sRGB-encoded; or
    halves: wp.array[wp.float16]  # pixels of a file of halves; or
    floats: wp.array[wp.float32]  # pixels of any other file
    srgb_to_linear: wp.array[wp.float32]  # 256 entries, beside bytes
    rows: wp.array[wp.float32]  # upper end of the cumulative probability of each row of cells, [height - 1]
    columns: wp.array2d[wp.float32]  # upper ends within a row, [height - 1, width]


@wp.struct
class EnvironmentSample:
    L: wp.vec3
    pdf: wp.float32  # in solid angle


def quantized_cdf(weights: np.ndarray) -> np.ndarray:
    """Upper ends of cumulative probabilities along the last axis, as multiples of 2^-24.

    A sample is drawn with a multiple of 2^-24, so the difference of two ends is the exact probability of a cell. Every
    positive weight gets one step first, so that none is lost to rounding; the others are shared by weight. All ends are
    0 where all weights are 0.
    """
    positive = weights > 0.0
    sums = np.cumsum(weights, axis=-1, dtype=np.float64)
    share = sums / np.where(sums[..., -1:] > 0.0, sums[..., -1:], 1.0)
    steps = np.cumsum(positive, axis=-1)
    return ((np.rint(share * (QUANTA - steps[..., -1:])) + steps) / QUANTA).astype(np.float32)


def cell_weights(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the distribution is made of.

    Args:
        pixels: Linear, [height, width, 1 or 3].

    Returns:
        Mean luminance of the cells, [height - 1, width], and the solid angle of a cell of each row, [height - 1].
    """
    luminance = pixels[:, :, 0].astype(np.float64) if pixels.shape[2] == 1 else _luminances(pixels)
    luminance[luminance <= 1e-30] = 0.0
    across = luminance + np.roll(luminance, -1, axis=1)
    cosines = np.cos(np.linspace(0.0, np.pi, len(pixels)))
    return 0.25 * (across[:-1] + across[1:]), (cosines[:-1] - cosines[1:]) * 2.0 * np.pi / pixels.shape[1]


def _luminances(pixels: np.ndarray) -> np.ndarray:
    """In float64, channel by channel: no copy of all pixels in that type."""
    return sum(np.multiply(pixels[:, :, i], weight, dtype=np.float64) for i, weight in enumerate(LUMINANCE))


@wp.func
def find_interval(ends: wp.array[wp.float32], u: float) -> int:
    """The first entry that is greater than u; entries do not decrease, and the last one is 1."""
    low = int(0)
    high = int(ends.shape[0] - 1)
    while low < high:
        middle = (low + high) // 2
        if ends[middle] > u:
            high = middle
        else:
            low = middle + 1
    return low


@wp.func
def sample_linear(u: float, at_0: float, at_1: float) -> float:
    """A number in [0, 1) with a density that is linear between values at the ends, which are not negative."""
    total = at_0 + at_1
    if total <= 0.0:
        return u
    a = at_0 / total
    b = at_1 / total
    return wp.min(u / wp.max(a + wp.sqrt(a * a + u * (b - a)), 1.0e-12), 0.99999994)


@wp.func
def luminance(rgb: wp.vec3) -> float:
    return wp.dot(rgb, wp.static(wp.vec3(*LUMINANCE)))


def envmap_storage(light_kinds: tuple[str, ...]) -> str | None:
    """How the pixels of a scene's environment map are stored, from the names of its kinds of light; None: no map."""
    found = [kind.removeprefix("envmap_") for kind in light_kinds if kind.startswith("envmap_")]
    return found[0] if found else None


@functools.cache
def make_envmap(storage: str | None, density: bool = True):
    """Functions for an environment map.

    Args:
        storage: ``bytes``, ``halves`` or ``floats``; None where the functions are not called.
        density: Evaluate the density too, else it is 0 and the map needs no tables.

    Returns:
        `eval_envmap(map, wi) -> EnvironmentSample` for a direction towards the environment, and
        `sample_envmap(map, u) -> vec3`, such a direction.
    """

    @wp.func
    def fetch(env: EnvironmentMap, x: int, y: int) -> wp.vec3:
        i = (y * env.width + x) * env.channels
        rgb = wp.vec3(0.0)
        if wp.static(storage == "bytes"):
            r = env.srgb_to_linear[wp.int32(env.bytes[i])]
            rgb = wp.vec3(r)
            if env.channels == 3:
                g = env.srgb_to_linear[wp.int32(env.bytes[i + 1])]
                rgb = wp.vec3(r, g, env.srgb_to_linear[wp.int32(env.bytes[i + 2])])
        elif wp.static(storage == "halves"):
            grey = float(env.halves[i])
            rgb = wp.vec3(grey)
            if env.channels == 3:
                rgb = wp.vec3(grey, float(env.halves[i + 1]), float(env.halves[i + 2]))
        else:
            grey = env.floats[i]
            rgb = wp.vec3(grey)
            if env.channels == 3:
                rgb = wp.vec3(grey, env.floats[i + 1], env.floats[i + 2])
        return rgb

    @wp.func
    def angles(env: EnvironmentMap, wi: wp.vec3) -> wp.vec3:
        """Column and row as real numbers, and the sine of the colatitude."""
        local = wp.transpose(env.to_world) * wi
        u = wp.atan2(local[0], -local[2]) / wp.static(2.0 * wp.pi)
        sine = wp.sqrt(local[0] * local[0] + local[2] * local[2])
        v = wp.atan2(sine, local[1]) / wp.static(wp.pi)
        x = wp.where(u < 0.0, u + 1.0, u) * float(env.width) - 0.5
        return wp.vec3(x, v * float(env.height - 1), sine)

    @wp.func
    def eval_envmap(env: EnvironmentMap, wi: wp.vec3) -> EnvironmentSample:
        at = angles(env, wi)
        left = int(wp.floor(at[0]))
        fx = at[0] - float(left)
        x0 = wp.where(left < 0, left + env.width, wp.min(left, env.width - 1))
        x1 = wp.where(x0 + 1 == env.width, 0, x0 + 1)
        y = wp.clamp(int(at[1]), 0, env.height - 2)
        fy = at[1] - float(y)
        p00 = fetch(env, x0, y)
        p10 = fetch(env, x1, y)
        p01 = fetch(env, x0, y + 1)
        p11 = fetch(env, x1, y + 1)
        rgb = (1.0 - fy) * ((1.0 - fx) * p00 + fx * p10) + fy * ((1.0 - fx) * p01 + fx * p11)
        result = EnvironmentSample()
        result.L = env.scale * rgb
        if wp.static(density):
            mean = 0.25 * luminance(p00 + p10 + p01 + p11)
            if mean > _DARK:
                row = env.rows[y]
                if y > 0:
                    row -= env.rows[y - 1]
                column = env.columns[y, x0]
                if x0 > 0:
                    column -= env.columns[y, x0 - 1]
                # From cells to the unit square, and from there to solid angle: du dv = dw / (2 pi^2 sin(theta)).
                cells = float(env.width) * float(env.height - 1)
                sine = wp.max(at[2], 1.0e-7)
                result.pdf = row * column * (luminance(rgb) / mean) * cells / (wp.static(2.0 * wp.pi * wp.pi) * sine)
        return result

    @wp.func
    def sample_envmap(env: EnvironmentMap, u: wp.vec3) -> wp.vec3:
        """u[0]: row, and what is left of it the height in the cell; u[1]: column; u[2]: place across the cell."""
        y = find_interval(env.rows, u[0])
        row = env.rows[y]
        rest = u[0]
        if y > 0:
            row -= env.rows[y - 1]
            rest -= env.rows[y - 1]
        # The number is one of row * 2^24 equally likely ones: the middles of as many parts of the unit interval.
        rest = wp.min((rest + 2.9802322e-8) / row, 0.99999994)
        x = find_interval(env.columns[y], u[1])
        x1 = wp.where(x + 1 == env.width, 0, x + 1)
        w00 = luminance(fetch(env, x, y))
        w10 = luminance(fetch(env, x1, y))
        w01 = luminance(fetch(env, x, y + 1))
        w11 = luminance(fetch(env, x1, y + 1))
        fy = sample_linear(rest, w00 + w10, w01 + w11)
        fx = sample_linear(u[2], (1.0 - fy) * w00 + fy * w01, (1.0 - fy) * w10 + fy * w11)
        phi = wp.static(2.0 * wp.pi) * ((float(x) + fx + 0.5) / float(env.width))
        theta = wp.static(wp.pi) * ((float(y) + fy) / float(env.height - 1))
        sine = wp.sin(theta)
        local = wp.vec3(wp.sin(phi) * sine, wp.cos(theta), -wp.cos(phi) * sine)
        return wp.normalize(env.to_world * local)

    return eval_envmap, sample_envmap
