"""Von Mises-Fisher lobes and mixtures in float64 NumPy and in mpmath, written apart from the kernels.

Here a lobe is exp(s · w) over its integral, 4 pi sinh(|s|) / |s|, with s = kappa mu, and angles are by dot products. In
float64 that is exact to 1e-16 kappa.
"""

from __future__ import annotations

import mpmath
import numpy as np

LOG_KAPPA_LIMIT = 20.0


def log_sum(x) -> np.ndarray:
    """log of the sum of exponentials along the last axis."""
    highest = np.max(np.real(x), axis=-1, keepdims=True)
    return np.log(np.sum(np.exp(x - highest), axis=-1)) + highest[..., 0]


def length(v) -> np.ndarray:
    return np.sqrt(np.sum(v * v, axis=-1))


def unit(v) -> np.ndarray:
    v = np.asarray(v)
    v = v.astype(np.result_type(v, np.float64))
    return v / length(v)[..., None]


def log_sinhc(x) -> np.ndarray:
    """log(sinh(x) / x), 0 at 0."""
    x = np.asarray(x)
    tiny = np.real(x) < 1e-3
    safe = np.where(tiny, 1.0, x)
    small = x * x / 6.0 - x**4 / 180.0
    return np.where(tiny, small, safe + np.log(-np.expm1(-2.0 * safe) / (2.0 * safe)))


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
    raw = np.asarray(raw)
    raw = raw.astype(np.result_type(raw, np.float64))
    lobes = raw.reshape(len(raw), -1, per_lobe(direction))
    log_weight = lobes[..., 0] - log_sum(lobes[..., 0])[:, None]
    log_kappa = lobes[..., 1]
    outside = np.abs(np.real(log_kappa)) > LOG_KAPPA_LIMIT
    kappa = np.exp(np.where(outside, np.copysign(LOG_KAPPA_LIMIT, np.real(log_kappa)), log_kappa))
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


# Of decoded mixtures, (log weights [n, K], kappa [n, K], mu [n, K, 3]), and directions w [n, 3]:


def log_terms(mixture, w) -> np.ndarray:
    """Logarithms of the weighted densities of lobes [n, K]."""
    log_weight, kappa, mu = mixture
    return log_weight + vmf_log_pdf(mu, kappa, np.asarray(w)[:, None, :])


def log_pdf(mixture, w) -> np.ndarray:
    return log_sum(log_terms(mixture, w))


def product_log_masses(mixture, other_mu, other_kappa) -> np.ndarray:
    """Logarithms [n, K] of the masses of the lobes times the lobe (other_mu [n, 3], other_kappa [n]).

    All but for the integral of exp(s · w) of that lobe, which all share.
    """
    log_weight, kappa, mu = mixture
    joint = kappa[..., None] * unit(mu) + (np.asarray(other_kappa)[:, None] * unit(other_mu))[:, None, :]
    return log_weight - log_sinhc(kappa) + log_sinhc(length(joint))


def product_log_pdf(mixture, w, other_mu, other_kappa) -> np.ndarray:
    """Of the normalised product with the lobe."""
    other = np.asarray(other_kappa) * np.sum(unit(other_mu) * unit(w), axis=-1)
    return log_pdf(mixture, w) + other - log_sum(product_log_masses(mixture, other_mu, other_kappa))


def derivatives(raw, direction: str, at=None):
    """For each raw output i the mixture with its derivatives along i times 1e-30 as imaginary parts.

    So the imaginary part of a function of it, times 1e30, is a difference without cancellation (Squire and Trapp 1998).
    `at`: (kappa, mu) to differentiate at, as decoded in float32.
    """
    raw = np.asarray(raw, np.float64)
    for i in range(raw.shape[1]):
        step = np.zeros(raw.shape[1], complex)
        step[i] = 1e-30j
        log_weight, kappa, mu = decode(raw + step, direction)
        if at is not None:
            kappa = at[0] + 1j * kappa.imag
            mu = unit(at[1]) + 1j * mu.imag
        yield log_weight, kappa, mu


def gradient(function, raw, direction: str, at=None) -> np.ndarray:
    """Of a function of mixtures [n], with respect to raw outputs [n, P]."""
    return np.stack([function(mixture).imag * 1e30 for mixture in derivatives(raw, direction, at)], axis=1)


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
