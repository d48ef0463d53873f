"""Coordinates for the directions of a lobe, in which a narrow or grazing lobe is as wide as any other.

A direction wi is named by the normal m of the microfacet that reflects (or refracts) wo to wi, its slopes x and y each
divided by its alpha: by their length r as w = 1 / sqrt(1 + r^2), and by their azimuth b. Both are in [0, 1]. An area
element of slopes is alpha_x alpha_y r dr d(phi) = alpha_x alpha_y 2 pi dw db / w^3; from slopes to solid angle the
Jacobian is taken by finite differences, so that no formula is shared with the code under test.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tests.bsdf import harness
from tests.chi_square import cell_sums, histogram, nodes

SHAPE = (31, 17)
PER_CELL = 12


@dataclass(frozen=True)
class Chart:
    """Directions on the side of wo (index None), or on the other side of a boundary with index n_wi / n_wo."""

    wo: np.ndarray
    alpha: np.ndarray  # along x and y
    index: float | None

    def _upper(self) -> np.ndarray:
        return self.wo * [1.0, 1.0, np.sign(self.wo[2])]

    def _direction(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """wi for microfacets with slopes (x, y), wo above; NaN where there is none."""
        o = self._upper()
        m = np.stack([x, y, np.ones_like(x)], axis=1)
        m /= np.linalg.norm(m, axis=1, keepdims=True)
        c = m @ o
        c[c <= 0.0] = np.nan
        if self.index is None:
            wi = 2.0 * c[:, None] * m - o
            wi[wi[:, 2] <= 0.0] = np.nan
        else:
            n = self.index
            square = 1.0 - (1.0 - c * c) / n**2
            square[square <= 0.0] = np.nan
            wi = (c / n - np.sqrt(square))[:, None] * m - o / n
            wi[wi[:, 2] >= 0.0] = np.nan
        return wi

    def directions(self) -> tuple[np.ndarray, np.ndarray]:
        """Directions at the nodes of all cells, and the solid angle of each; zero where there is no direction."""
        w, b, area = nodes(SHAPE, PER_CELL)
        r = np.sqrt((1.0 - w) * (1.0 + w)) / w
        x, y = (a * r * f(2.0 * np.pi * b) for a, f in zip(self.alpha, (np.cos, np.sin), strict=True))
        step = 1e-5 * (self.alpha.min() + np.hypot(x, y))
        wi = self._direction(x, y)
        dx = (self._direction(x + step, y) - self._direction(x - step, y)) / (2.0 * step)[:, None]
        dy = (self._direction(x, y + step) - self._direction(x, y - step)) / (2.0 * step)[:, None]
        jacobian = np.linalg.norm(np.cross(dx, dy), axis=1)
        solid_angle = np.nan_to_num(jacobian) * area * 2.0 * np.pi * self.alpha.prod() / w**3
        wi = np.where(np.isfinite(wi), wi, [0.0, 0.0, 1.0]) * [1.0, 1.0, np.sign(self.wo[2])]
        return wi, solid_angle

    def counts(self, wi: np.ndarray) -> np.ndarray:
        """Samples on this side per cell."""
        o = self._upper()
        i = wi * [1.0, 1.0, np.sign(self.wo[2])]
        i = i[i[:, 2] > 0.0] if self.index is None else self.index * i[i[:, 2] < 0.0]
        h = o + i
        x, y = (h[:, :2] / (self.alpha * h[:, 2:])).T
        azimuth = np.mod(np.arctan2(y, x) / (2.0 * np.pi), 1.0)
        return histogram(1.0 / np.sqrt(1.0 + x**2 + y**2), azimuth, SHAPE)[:-1]


def integrate(name: str, p, wo: np.ndarray, alpha, ior: float) -> tuple[np.ndarray, np.ndarray, list[Chart]]:
    """Probability of all cells of all charts; integral of f |cos| per chart and channel; the charts."""
    alpha = np.broadcast_to(alpha, 2).astype(np.float64)
    charts = [Chart(wo, alpha, None)]
    if name == "rough_dielectric":
        charts.append(Chart(wo, alpha, ior if wo[2] > 0.0 else 1.0 / ior))
    probabilities, values = [], []
    for chart in charts:
        wi, solid_angle = chart.directions()
        e = harness.evaluate(name, p, wo, wi)
        probabilities.append(cell_sums(e.pdf * solid_angle, SHAPE, PER_CELL))
        values.append((e.value * solid_angle[:, None]).sum(axis=0))
    return np.concatenate(probabilities), np.array(values), charts
