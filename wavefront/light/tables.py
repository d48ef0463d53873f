"""Lights on the device: every emissive triangle, every emissive sphere and every other emitter is one light."""

from __future__ import annotations

import numpy as np
import warp as wp

from wavefront.light.envmap import QUANTA, EnvironmentMap

KIND_TRIANGLE = wp.constant(0)
KIND_SPHERE = wp.constant(1)
KIND_CONSTANT = wp.constant(2)
KIND_ENVMAP_BYTES = wp.constant(3)
KIND_ENVMAP_FLOATS = wp.constant(4)
KIND_DIRECTIONAL = wp.constant(5)
KIND_POINT = wp.constant(6)
KIND_SPOT = wp.constant(7)
KIND_SUN = wp.constant(8)
KIND_ENVMAP_HALVES = wp.constant(9)
KINDS = {
    "triangle": 0,
    "sphere": 1,
    "constant": 2,
    "envmap_bytes": 3,
    "envmap_floats": 4,
    "directional": 5,
    "point": 6,
    "spot": 7,
    "sun": 8,
    "envmap_halves": 9,
}
DELTA = ("directional", "point", "spot")  # those that no ray can find
AREA = ("triangle", "sphere")  # those that are shapes
ENVIRONMENT = ("constant", "envmap_bytes", "envmap_halves", "envmap_floats")  # of which a scene has one at most


@wp.struct
class Light:
    kind: wp.int32
    primitive: wp.int32  # of the geometry; -1 where it is no shape
    emitter: wp.int32  # index in the table of its kind
    pmf: wp.float32  # probability that the light is selected
    alias_threshold: wp.float32  # numbers below select this light, others of its cell the alias
    alias: wp.int32


@wp.struct
class EmitterRecord:
    """An area light or a constant environment."""

    radiance: wp.vec3
    radiance_texture: wp.int32


@wp.struct
class DistantRecord:
    """A directional light or a sun."""

    direction: wp.vec3  # towards the light, unit length
    one_minus_cos: wp.float32  # of the sun's angular radius
    emitted: wp.vec3  # irradiance of a directional light, radiance of a sun


@wp.struct
class PointRecord:
    """A point or a spot light."""

    position: wp.vec3
    intensity: wp.vec3
    direction: wp.vec3  # of a spot: its axis, unit length
    beam_width: wp.float32  # radians
    cutoff_angle: wp.float32


@wp.struct
class LightTables:
    lights: wp.array[Light]
    emitters: wp.array[EmitterRecord]
    environment: wp.int32  # its light; -1: none
    envmap: EnvironmentMap
    distant: wp.array[DistantRecord]
    points: wp.array[PointRecord]
    first_sun: wp.int32  # suns are consecutive lights
    sun_count: wp.int32


def build_alias_table(power: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vose's alias table, which selects light i with a probability close to power[i] / sum(power) in constant time.

    A light is selected with one of the 2^24 numbers of `rng.to_unit_interval`. The table deals out these numbers, so
    the probabilities are exact, also with so many lights that a cell has few numbers: a light of any power gets one at
    least (as long as they suffice), the others are shared by power.

    Measured on one thread of a CPU with 10 and with 10^5 emissive triangles of random place and size: a light sample
    (selection, point on the light, BSDF and MIS weight) takes 0.07 and 0.7 us. What grows is the time that memory takes
    to reach a random light and its corners. The table of 10^5 lights is built in 0.2 s.

    Args:
        power: Non-negative weights with a positive sum, shape [N], float64.

    Returns:
        Probability of each light, threshold and alias of each cell, each of shape [N]. Cell c = floor(u N) is that of
        a number u, and its light is c if u is less than the threshold, else the alias.
    """
    n = len(power)
    positive = power > 0.0
    least = positive if positive.sum() <= QUANTA // 2 else np.zeros(n, bool)
    share = np.cumsum(power / power.max())
    ends = np.rint(share / share[-1] * (QUANTA - least.sum())) + np.cumsum(least)
    quanta = np.diff(ends, prepend=0.0).astype(np.int64)
    # The first number of each cell, by the arithmetic of the device: rounding may bring it one number forward.
    first = np.ceil(np.arange(n) * (QUANTA / n))
    first -= np.float32((first - 1.0) / QUANTA) * np.float32(n) >= np.arange(n, dtype=np.float32)
    first = np.maximum(first, 0.0).astype(np.int64)
    room = np.diff(first, append=QUANTA).tolist()
    left = quanta.tolist()
    threshold = np.minimum(quanta, room)
    alias = np.arange(n)
    small = [i for i in range(n) if left[i] < room[i]]
    large = [i for i in range(n) if left[i] > room[i]]
    while small:  # the numbers that its own light leaves over go to a light that has too many
        s, g = small.pop(), large[-1]
        threshold[s], alias[s] = left[s], g
        left[g] -= room[s] - left[s]
        if left[g] <= room[g]:
            large.pop()
            if left[g] < room[g]:
                small.append(g)
            threshold[g] = left[g]
    return quanta / QUANTA, (first + threshold) / QUANTA, alias
