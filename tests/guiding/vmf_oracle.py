"""Von Mises-Fisher lobes and mixtures in float64 NumPy and in mpmath, written apart from the kernels.

Here a lobe is exp(s · w) / integral with s = kappa mu, and the integral 4 pi sinh(|s|) / |s|; angles are by dot products.
In float64 that is exact to 1e-16 kappa.
"""

from __future__ import annotations

import mpmath
import numpy as np
from scipy.special import logsumexp

LOG_KAPPA_LIMIT = 20.0


def unit(v) -> np.ndarray:
    v = np.asarray(v, np.float64)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def log_sinhc(x) -> np.ndarray:
    """log(sinh(x) / x), 0 at 0."""
    x = np.asarray(x, np.float64)
    tiny = x < 1e-4
    safe = np.where(tiny, 1.0, x)
    return np.where(tiny, x * x / 6.0, safe + np.log(-np.expm1(-2.0 * safe) / (2.0 * safe)))


def vmf_log_pdf(mu, kappa, w) -> np.ndarray:
    return kappa * np.sum(unit(mu) * unit(w), axis=-1) - np.log(4.0 * np.pi) - log_sinhc(kappa)


def precise_vmf_log_pdf(mu, kappa, w, digits: int = 60) -> mpmath.mpf:
    """Of one lobe, with `digits` decimals."""
    with mpmath.workdps(digits):
        a, b = ([mpmath.mpf(float(c)) for c in v] for v in (mu, w))
        cosine = mpmath.fdot(a, b) / mpmath.sqrt(mpmath.fdot(a, a) * mpmath.fdot(b, b))
        kappa = mpmath.mpf(float(kappa))
        sinhc = mpmath.sinh(kappa) / kappa if kappa > 0 else mpmath.mpf(1)
        return kappa * cosine - mpmath.log(4 * mpmath.pi * sinhc)


def cdf(kappa, h) -> np.ndarray:
    """Probability of 1 - cos <= h."""
    if kappa == 0.0:
        return np.asarray(h) / 2.0
    return np.expm1(-kappa * np.asarray(h)) / np.expm1(-2.0 * kappa)


def per_lobe(direction: str) -> int:
    return {"angles": 4, "vector": 5}[direction]


def decode(raw, direction: str):
    """log weights [n, K], kappa [n, K] and mu [n, K, 3] of raw outputs [n, K · 4 or 5]."""
    raw = np.asarray(raw, np.float64)
    lobes = raw.reshape(len(raw), -1, per_lobe(direction))
    log_weight = lobes[..., 0] - logsumexp(lobes[..., 0], axis=1, keepdims=True)
    kappa = np.exp(np.clip(lobes[..., 1], -LOG_KAPPA_LIMIT, LOG_KAPPA_LIMIT))
    if direction == "vector":
        return log_weight, kappa, unit(lobes[..., 2:])
    theta = np.pi * 0.5 * (1.0 + np.tanh(lobes[..., 2] / 2.0))
    phi = 2.0 * np.pi * 0.5 * (1.0 + np.tanh(lobes[..., 3] / 2.0))
    mu = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    return log_weight, kappa, mu


def encode(weight, kappa, mu, direction: str) -> np.ndarray:
    """Raw outputs [K · 4 or 5] of a mixture; no direction at a pole or at phi = 0 for angles."""
    columns = [np.log(weight), np.log(kappa)]
    if direction == "vector":
        columns += list(np.moveaxis(unit(mu), -1, 0))
    else:
        x, y, z = np.moveaxis(unit(mu), -1, 0)
        for part in (np.arccos(z) / np.pi, np.mod(np.arctan2(y, x) / (2.0 * np.pi), 1.0)):
            columns.append(np.log(part / (1.0 - part)))
    return np.stack(columns, axis=-1).reshape(-1)


def log_terms(raw, w, direction: str) -> np.ndarray:
    """Logarithms of the weighted densities of lobes [n, K]."""
    log_weight, kappa, mu = decode(raw, direction)
    return log_weight + vmf_log_pdf(mu, kappa, np.asarray(w)[:, None, :])


def log_pdf(raw, w, direction: str) -> np.ndarray:
    return logsumexp(log_terms(raw, w, direction), axis=1)


def product_log_pdf(raw, w, other_mu, other_kappa, direction: str) -> np.ndarray:
    """Of the normalised product with the lobe (other_mu [n, 3], other_kappa [n])."""
    log_weight, kappa, mu = decode(raw, direction)
    other_kappa = np.asarray(other_kappa, np.float64)
    joint = kappa[..., None] * mu + (other_kappa[:, None] * unit(other_mu))[:, None, :]
    mass = log_weight - log_sinhc(kappa) + log_sinhc(np.linalg.norm(joint, axis=-1))
    # without the integral of the other lobe, above and below
    value = log_pdf(raw, w, direction) + other_kappa * np.sum(unit(other_mu) * unit(w), axis=-1)
    return value - logsumexp(mass, axis=1)


def gradient(function, raw, step) -> np.ndarray:
    """Central differences of `function` of raw rows [n, P] -> [n]; `step` [n] or a number."""
    raw = np.asarray(raw, np.float64)
    result = np.zeros_like(raw)
    step = np.broadcast_to(np.asarray(step, np.float64), len(raw))
    for i in range(raw.shape[1]):
        high, low = raw.copy(), raw.copy()
        high[:, i] += step
        low[:, i] -= step
        result[:, i] = (function(high) - function(low)) / (high[:, i] - low[:, i])
    return result


def frame(mu) -> np.ndarray:
    """Rows are a right-handed basis whose last is mu."""
    mu = unit(mu)
    s = unit(np.cross(mu, np.eye(3)[np.argmin(np.abs(mu))]))
    return np.stack([s, np.cross(mu, s), mu])


def quadrature(mu, reach: float, n_h: int, n_phi: int):
    """Nodes w [n, 3] and weights [n] that integrate over the cap h <= reach around mu (Gauss in h, even in azimuth)."""
    x, weight = np.polynomial.legendre.leggauss(n_h)
    h = 0.5 * reach * (x + 1.0)
    phi = 2.0 * np.pi * (np.arange(n_phi) + 0.5) / n_phi
    r = np.sqrt(h * (2.0 - h))
    local = np.stack(
        [r[:, None] * np.cos(phi), r[:, None] * np.sin(phi), np.broadcast_to((1.0 - h)[:, None], (n_h, n_phi))], axis=-1
    )
    area = np.repeat(0.5 * reach * weight * 2.0 * np.pi / n_phi, n_phi)
    return local.reshape(-1, 3) @ frame(mu), area
