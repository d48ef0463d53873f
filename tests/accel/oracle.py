"""Rays against triangles by brute force in float64, with bounds of what float32 may find.

A watertight test in float32 decides exactly, but for vertices that it has moved by roundings: each coordinate x of a
vertex in the sheared frame of the ray, x = (p_x - o_x) - s_x z, by at most `EPSILON` (2 |p_x - o_x| + 4 |s_x z|). The
same edge functions in float64 therefore tell which triangles float32 must hit, which it may hit (those of which an edge
passes the ray within that bound), and the interval in which the distance must lie. So no tolerance is tuned, and a
borderline ray is one whose edge function is smaller than its bound of error.
"""

from __future__ import annotations

import dataclasses

import numpy as np

EPSILON = 2.0**-24  # half an ulp of 1
TINY = 1e-44  # underflow of the products


@dataclasses.dataclass
class Verdict:
    """Of each ray with each triangle, [N, M].

    Attributes:
        sure, possible: Whether float32 must, or may, find this triangle, of unbounded rays.
        low, high: Where the distance must lie.
        weights: Of the three vertices, [N, M, 3].
        weight_error: Bound of their errors.
    """

    sure: np.ndarray
    possible: np.ndarray
    low: np.ndarray
    high: np.ndarray
    weights: np.ndarray
    weight_error: np.ndarray


def judge(corners, origin, direction) -> Verdict:
    """Rays [N, 3] and triangles [M, 3, 3] as float32 has them."""
    o, d, p = (np.asarray(a, np.float32).astype(np.float64) for a in (origin, direction, corners))
    n = len(o)
    kz = np.abs(d).argmax(axis=1)
    rows = np.arange(n)
    turned = d[rows, kz] < 0.0
    first, second = (kz + 1) % 3, (kz + 2) % 3
    axes = np.where(turned, second, first), np.where(turned, first, second), kz
    with np.errstate(all="ignore"):
        relative = [p[None, :, :, :].transpose(0, 3, 1, 2)[0][axis] - o[rows, axis][:, None, None] for axis in axes]
        z = relative[2]
        planar, moved = [], []
        for k in range(2):
            sheared = (d[rows, axes[k]] / d[rows, kz])[:, None, None] * z
            planar.append(relative[k] - sheared)
            moved.append(EPSILON * (2.0 * np.abs(relative[k]) + 4.0 * np.abs(sheared)) + TINY)
        (x, y), (ex, ey) = planar, moved
        edges, errors = [], []
        for i, j in ((2, 1), (0, 2), (1, 0)):
            a, b = x[..., i] * y[..., j], y[..., i] * x[..., j]
            edges.append(a - b)
            error = ex[..., i] * (np.abs(y[..., j]) + ey[..., j]) + ex[..., j] * (np.abs(y[..., i]) + ey[..., i])
            error += ey[..., i] * np.abs(x[..., j]) + ey[..., j] * np.abs(x[..., i])
            errors.append(error + EPSILON * 2.0 * (np.abs(a) + np.abs(b)) + TINY)
        edges, errors = np.stack(edges, -1), np.stack(errors, -1)
        det, doubt = edges.sum(-1), errors.sum(-1)
        inside, outside = edges > errors, edges < -errors
        sure = inside.all(-1) | outside.all(-1)
        possible = ~(inside.any(-1) & outside.any(-1))
        scale = 1.0 / d[rows, kz][:, None, None]
        weights = edges / det[..., None]
        flat = ~(np.abs(det) > 2.0 * doubt)
        weight_error = np.where(flat, np.inf, 2.0 * doubt / (np.abs(det) - doubt)) + 4.0 * EPSILON
        distances = scale * z
        least, greatest = distances.min(-1), distances.max(-1)
        rounding = 12.0 * EPSILON * np.abs(distances).max(-1) + TINY
        t = np.where(flat, 0.0, (weights * distances).sum(-1))
        error = weight_error * (greatest - least)
        low = np.maximum(np.where(flat, -np.inf, t - error), least) - rounding
        high = np.minimum(np.where(flat, np.inf, t + error), greatest) + rounding
    valid = d[rows, kz] != 0.0
    sure &= valid[:, None] & (low > 0.0)
    possible &= valid[:, None] & (high > 0.0)
    return Verdict(sure, possible, low, high, weights, weight_error)


def check(verdict: Verdict, hits, first_triangle: int = 0) -> float:
    """Asserts that hits are what float32 may find, and returns the part of rays of which only one answer is right."""
    found = hits.primitive >= 0
    must_end = np.where(verdict.sure, verdict.high, np.inf).min(axis=1)
    assert found[np.isfinite(must_end)].all(), np.flatnonzero(~found & np.isfinite(must_end))[:5]
    assert (hits.primitive[~found] == -1).all()
    row, number = np.flatnonzero(found), hits.primitive[found] - first_triangle
    assert (number >= 0).all() and (number < verdict.sure.shape[1]).all()
    t = hits.t[found].astype(np.float64)
    low, high = verdict.low[row, number], verdict.high[row, number]
    for right in (verdict.possible[row, number], t > 0.0, t >= low, t <= high, t <= must_end[found]):
        assert right.all(), (row[~right][:5], number[~right][:5], t[~right][:5], low[~right][:5], high[~right][:5])
    u, v = hits.uv[found].astype(np.float64).T
    slack = 4.0 * EPSILON
    assert (u >= 0.0).all() and (v >= 0.0).all() and (u + v <= 1.0 + slack).all()
    known = np.isfinite(verdict.weight_error[row, number])
    error = np.abs(np.stack([u, v], -1) - verdict.weights[row, number, :2]).max(axis=-1)
    assert (error <= verdict.weight_error[row, number] + slack)[known].all()
    # One answer: nothing is possible, or what must be hit lies before all else that may be.
    nearest = np.where(verdict.sure, verdict.high, np.inf).argmin(axis=1)
    low = np.where(verdict.possible, verdict.low, np.inf)
    low[np.arange(len(low)), nearest] = np.inf
    certain = np.isfinite(must_end) & (low.min(axis=1) > must_end)
    assert (hits.primitive[certain] == nearest[certain] + first_triangle).all()
    return float((certain | ~verdict.possible.any(axis=1)).mean())
