"""Coordinates on the sphere of directions in which a narrow lobe is as wide as any other.

A chart is centred on a direction and has a width kappa. With theta the angle from the centre, tan(theta / 2) = kappa r,
its coordinates in the unit square are w = 1 / sqrt(1 + r^2) and the azimuth b around the centre. It covers the whole
sphere, half of it within theta = 2 atan(kappa). With t = tan(theta / 2),
    d(omega) = 2 d(t^2) d(phi) / (1 + t^2)^2,   d(t^2) = kappa^2 2 dw / w^3,   d(phi) = 2 pi db.
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
    """One half of the sphere of directions, z > 0 or z < 0, seen from the middle of a lobe."""

    centre: np.ndarray
    kappa: float
    upper: bool

    def basis(self) -> np.ndarray:
        c = self.centre / np.linalg.norm(self.centre)
        s = np.cross(c, [0.0, 1.0, 0.0] if abs(c[0]) > 0.5 else [1.0, 0.0, 0.0])
        s /= np.linalg.norm(s)
        return np.stack([s, np.cross(c, s), c])

    def directions(self) -> tuple[np.ndarray, np.ndarray]:
        """Directions at the nodes of all cells, and the solid angle of each, zero in the other half."""
        w, b, area = nodes(SHAPE, PER_CELL)
        t2 = self.kappa**2 * (1.0 - w) * (1.0 + w) / w**2
        phi = 2.0 * np.pi * b
        z = (1.0 - t2) / (1.0 + t2)
        r = 2.0 * np.sqrt(t2) / (1.0 + t2)
        wi = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1) @ self.basis()
        solid_angle = area * 8.0 * np.pi * self.kappa**2 / (w**3 * (1.0 + t2) ** 2)
        return wi, np.where((wi[:, 2] > 0.0) == self.upper, solid_angle, 0.0)

    def counts(self, wi: np.ndarray) -> np.ndarray:
        """Samples of this half per cell."""
        wi = wi[(wi[:, 2] > 0.0) == self.upper]
        local = wi @ self.basis().T
        distance2 = np.sum((wi - self.basis()[2]) ** 2, axis=1)  # 4 sin^2(theta / 2): exact for tiny angles
        sin2 = np.minimum(0.25 * distance2, 1.0)
        # 1 + r^2 = 1 + sin2 / (kappa^2 (1 - sin2))
        k2 = self.kappa**2
        w = np.sqrt(k2 * (1.0 - sin2) / (k2 * (1.0 - sin2) + sin2))
        azimuth = np.mod(np.arctan2(local[:, 1], local[:, 0]) / (2.0 * np.pi), 1.0)
        return histogram(w, azimuth, SHAPE)[:-1]


def charts(name: str, wo: np.ndarray, alpha: float, ior: float) -> list[Chart]:
    """Charts for the reflected and, where there is one, the transmitted lobe."""
    if name == "diffuse":
        return [Chart(np.array([0.0, 0.0, 1.0]), 1.0, True)]
    reflected = Chart(wo * [-1.0, -1.0, 1.0], alpha, bool(wo[2] > 0.0))
    if name == "rough_conductor":
        return [reflected]
    n = ior if wo[2] > 0.0 else 1.0 / ior
    # Under total reflection the lobe that some microfacets transmit lies near the horizon.
    cos_t = np.sqrt(max(1.0 - (1.0 - wo[2] ** 2) / n**2, 1e-4))
    refracted = np.array([-wo[0] / n, -wo[1] / n, -np.sign(wo[2]) * cos_t])
    kappa = 0.5 * alpha * abs(1.0 - 1.0 / n)
    return [reflected, Chart(refracted, kappa, bool(wo[2] < 0.0))]


def integrate(name: str, p, wo: np.ndarray, alpha: float, ior: float) -> tuple[np.ndarray, np.ndarray, list[Chart]]:
    """pdf of all cells of all charts; integral of f |cos| per chart and channel; the charts."""
    all_charts = charts(name, wo, alpha, ior)
    probabilities, values = [], []
    for chart in all_charts:
        wi, solid_angle = chart.directions()
        e = harness.evaluate(name, p, wo, wi)
        probabilities.append(cell_sums(e.pdf * solid_angle, SHAPE, PER_CELL))
        values.append((e.value * solid_angle[:, None]).sum(axis=0))
    return np.concatenate(probabilities), np.array(values), all_charts
