"""Lights on the device: every emissive triangle, every emissive sphere and the environment is one light."""

from __future__ import annotations

import numpy as np
import warp as wp

KIND_TRIANGLE = wp.constant(0)
KIND_SPHERE = wp.constant(1)
KIND_CONSTANT = wp.constant(2)
KINDS = {"triangle": 0, "sphere": 1, "constant": 2}


@wp.struct
class Light:
    kind: wp.int32
    primitive: wp.int32  # of the geometry; -1 for the environment
    emitter: wp.int32
    pmf: wp.float32  # probability that the light is selected
    alias_threshold: wp.float32
    alias: wp.int32


@wp.struct
class EmitterRecord:
    radiance: wp.vec3
    radiance_texture: wp.int32


@wp.struct
class LightTables:
    lights: wp.array[Light]
    emitters: wp.array[EmitterRecord]
    environment: wp.int32  # its light; -1: none


def build_alias_table(power: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vose's alias table, which selects light i with probability power[i] / sum(power) in constant time.

    Args:
        power: Non-negative weights with a positive sum, shape [N], float64.

    Returns:
        Probability of each light, threshold and alias of each cell, each of shape [N].
    """
    pmf = power / power.sum()
    scaled = pmf * len(power)
    threshold = np.ones(len(power))
    alias = np.arange(len(power))
    small = list(np.flatnonzero(scaled < 1.0))
    large = list(np.flatnonzero(scaled >= 1.0))
    while small and large:
        s, g = small.pop(), large[-1]
        threshold[s], alias[s] = scaled[s], g
        scaled[g] -= 1.0 - scaled[s]
        if scaled[g] < 1.0:
            small.append(large.pop())
    # What rounding leaves over is full but for rounding, except a light of no power, which must never be chosen.
    brightest = int(np.argmax(pmf))
    for s in small:
        if pmf[s] == 0.0:
            threshold[s], alias[s] = 0.0, brightest
    return pmf, threshold, alias
