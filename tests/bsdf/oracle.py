"""The textbook formulas in float64 NumPy, written independently of the kernels: no rearrangement, no special cases."""

from __future__ import annotations

import numpy as np
from scipy.special import erf

GGX, BECKMANN = 0, 1


def distribution(m: np.ndarray, alpha, kind: int) -> np.ndarray:
    """D(m) in terms of theta and phi: Heitz 2014, equations 80 and 85; alpha is one number, or two."""
    alpha_x, alpha_y = np.broadcast_to(alpha, 2)
    cos2 = m[:, 2] ** 2
    tan2 = (m[:, 0] ** 2 + m[:, 1] ** 2) / cos2
    phi = np.arctan2(m[:, 1], m[:, 0])
    a = tan2 * (np.cos(phi) ** 2 / alpha_x**2 + np.sin(phi) ** 2 / alpha_y**2)
    if kind == GGX:
        return 1.0 / (np.pi * alpha_x * alpha_y * cos2**2 * (1.0 + a) ** 2)
    return np.exp(-a) / (np.pi * alpha_x * alpha_y * cos2**2)


def g1(w: np.ndarray, alpha, kind: int) -> np.ndarray:
    """Smith's masking: Walter et al. 2007, equations 26 and 34 (exact form), with the roughness along the azimuth of w
    (Heitz 2014, section 5.3)."""
    alpha_x, alpha_y = np.broadcast_to(alpha, 2)
    phi = np.arctan2(w[:, 1], w[:, 0])
    alpha = np.hypot(np.cos(phi) * alpha_x, np.sin(phi) * alpha_y)
    tan = np.hypot(w[:, 0], w[:, 1]) / np.abs(w[:, 2])
    with np.errstate(divide="ignore"):
        a = 1.0 / (alpha * tan)
    if kind == GGX:
        return 2.0 / (1.0 + np.sqrt(1.0 + 1.0 / a**2))
    return 2.0 / (1.0 + erf(a) + np.exp(-(a**2)) / (a * np.sqrt(np.pi)))


def fresnel(cos_i: np.ndarray, n: complex | np.ndarray) -> np.ndarray:
    """Unpolarised reflectance for light that meets a medium of complex relative index n, |cos_i| from outside."""
    c = np.abs(cos_i).astype(np.complex128)
    n = np.asarray(n, dtype=np.complex128)
    root = np.sqrt(n * n - 1.0 + c * c)
    r_s = (c - root) / (c + root)
    r_p = (n * n * c - root) / (n * n * c + root)
    return 0.5 * (np.abs(r_s) ** 2 + np.abs(r_p) ** 2)
