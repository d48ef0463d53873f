"""Densities of directions on a map of the sphere in longitude and latitude, and how far they are apart.

The map is the image of the spherical camera without a transform: -Z is in the middle, +X to the right of it, +Y on top.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from wavefront.guide import PRODUCT, RADIANCE


@dataclasses.dataclass(frozen=True)
class DirectionMap:
    """A map of ``width`` x ``height`` cells, each with ``parts`` x ``parts`` directions of equal solid angle.

    Functions of the direction are known by their means over cells, so what varies within a cell is not seen: the KL
    divergence of means is a lower bound of that of the functions (the log-sum inequality).
    """

    width: int = 256
    height: int = 128
    parts: int = 4

    @functools.cached_property
    def solid_angle(self) -> np.ndarray:
        """Of the cells, steradians, float64 [height, 1]."""
        cosine = np.cos(np.linspace(0.0, np.pi, self.height + 1))
        return (cosine[:-1] - cosine[1:])[:, None] * (2.0 * np.pi / self.width)

    @functools.cached_property
    def directions(self) -> np.ndarray:
        """Unit vectors, float32 [height, width, parts^2, 3]."""
        n = self.parts
        middles = (np.arange(n) + 0.5) / n
        cosine = np.cos(np.linspace(0.0, np.pi, self.height + 1))
        y = cosine[:-1, None] + (cosine[1:] - cosine[:-1])[:, None] * middles  # [height, n]
        turn = 2.0 * np.pi * ((np.arange(self.width)[:, None] + middles) / self.width - 0.5)  # [width, n]
        shape = self.height, self.width, n, n
        sine = np.broadcast_to(np.sqrt(1.0 - y * y)[:, None, :, None], shape)
        turn = np.broadcast_to(turn[None, :, None, :], shape)
        up = np.broadcast_to(y[:, None, :, None], shape)
        vectors = np.stack([sine * np.sin(turn), up, -sine * np.cos(turn)], axis=-1)
        return vectors.reshape(self.height, self.width, n * n, 3).astype(np.float32)

    def means(self, values: np.ndarray) -> np.ndarray:
        """Means over cells, float64 [height, width, ...], of values by direction, [height width parts^2, ...]."""
        values = np.asarray(values)
        shape = self.height, self.width, self.parts**2, *values.shape[1:]
        return values.reshape(shape).mean(axis=2, dtype=np.float64)

    def integral(self, values: np.ndarray) -> float:
        """Over the sphere, of means over cells [height, width]."""
        return float((values * self.solid_angle).sum())

    def normalised(self, values: np.ndarray) -> np.ndarray | None:
        """The density that is proportional to `values`; None where they are zero everywhere."""
        total = self.integral(values)
        return values / total if total > 0.0 else None

    def divergence(self, target: np.ndarray, density: np.ndarray) -> float:
        """KL(target || density) in nats, the integral of target log(target / density): infinite where the density is
        zero and the target is not."""
        seen = target > 0.0
        t, q = target[seen], density[seen]
        if (q <= 0.0).any():
            return float("inf")
        return float((np.broadcast_to(self.solid_angle, target.shape)[seen] * t * np.log(t / q)).sum())

    def excess(self, both: np.ndarray, *halves: np.ndarray | None) -> float | None:
        """By how much noise in a target raises its divergence from anything, in the mean, in nats.

        The entropy of what is noisy is too low by a term that falls as one over the number of samples (Miller 1955,
        "Note on the bias of information estimates"), so that half of the samples have twice of it.
        Of few samples it is more than this says.

        Args:
            both, halves: The density of the target by all samples, and by either half of them; None for one that is
                zero everywhere.

        Returns:
            None where a half is None.
        """
        if any(half is None for half in halves):
            return None
        ones = np.ones_like(both)
        return float(np.mean([self.divergence(half, ones) for half in halves])) - self.divergence(both, ones)


@dataclasses.dataclass(frozen=True)
class Side:
    """What arrives on one side of a surface.

    Attributes:
        radiance: Mean over each cell, [height, width, 3].
        share: Of each direction, 1 on this side and 0 on the other, [height width parts^2].
    """

    radiance: np.ndarray
    share: np.ndarray


def target_values(kind: str, directions: DirectionMap, sides: list[Side], f_cos: np.ndarray, normal) -> np.ndarray:
    """What a guide's density should be proportional to, means over cells and colour channels, [height, width].

    Args:
        kind: One of `wavefront.guide.TARGETS`.
        directions: The map.
        sides: Where light is taken from.
        f_cos: f |cos| by direction, [height width parts^2, 3].
        normal: Shading normal.
    """
    if kind == PRODUCT:
        factor = f_cos
    elif kind == RADIANCE:
        factor = np.ones((len(f_cos), 1))
    else:
        factor = np.abs(directions.directions.reshape(-1, 3) @ np.asarray(normal))[:, None]
    total = np.zeros((directions.height, directions.width))
    for side in sides:
        total += (directions.means(factor * side.share[:, None]) * side.radiance).mean(axis=-1)
    return total
