"""Triangles and rays that are hard: soups of all kinds, and closed meshes."""

from __future__ import annotations

import numpy as np
import trimesh


def scattered(rng, n):
    return rng.normal(size=(n, 1, 3)) + 0.4 * rng.normal(size=(n, 3, 3))


def slivers(rng, n):
    """Long, and up to 1e7 times less wide."""
    corners = scattered(rng, n)
    along = corners[:, 1] - corners[:, 0]
    width = 10.0 ** rng.uniform(-7.0, -1.0, (n, 1))
    corners[:, 2] = corners[:, 0] + rng.random((n, 1)) * along + width * rng.normal(size=(n, 3))
    return corners


def coplanar(rng, n):
    """In one plane that is not that of two axes, but for roundings."""
    plane = rng.normal(size=(2, 3))
    return scattered(rng, n)[..., :2] @ plane + (0.3, 0.2, 0.1)


def axis_aligned(rng, n):
    """Halves of squares on the planes of a grid; many coincide, share edges, or overlap in one plane."""
    low, axis = rng.integers(-2, 3, (n, 3)).astype(float), rng.integers(0, 3, n)
    half = rng.integers(0, 2, n)
    out = np.repeat(low[:, None], 3, axis=1)
    rows = np.arange(n)
    out[rows, 1, (axis + 1) % 3] += 1.0
    out[rows, 1, (axis + 2) % 3] += half
    out[rows, 2, (axis + 1) % 3] += 1 - half
    out[rows, 2, (axis + 2) % 3] += 1.0
    return out


def duplicated(rng, n):
    few = scattered(rng, max(n // 8, 1))
    few[::2] = axis_aligned(rng, len(few[::2]))
    copies = few[rng.integers(0, len(few), n)]
    turn = rng.integers(0, 3, n)
    return copies[np.arange(n)[:, None], (np.arange(3) + turn[:, None]) % 3]


def degenerate(rng, n):
    """Points and segments among triangles."""
    corners = scattered(rng, n)
    kind = rng.integers(0, 4, n)
    corners[kind == 0] = corners[kind == 0][:, :1]
    corners[kind == 1, 2] = corners[kind == 1, 0]
    corners[kind == 2, 2] = 0.5 * (corners[kind == 2, 0] + corners[kind == 2, 1])
    return corners


def all_sizes(rng, n):
    """From 1e-5 to 10, about a point."""
    return scattered(rng, n) * 10.0 ** rng.uniform(-5.0, 1.0, (n, 1, 1))


SOUPS = {f.__name__: f for f in (scattered, slivers, coplanar, axis_aligned, duplicated, degenerate, all_sizes)}


def on_triangles(rng, corners, n):
    """Points on triangles: a third inside, a third on edges, a third vertices; in float64."""
    weights = rng.dirichlet((1.0, 1.0, 1.0), n)
    weights[n // 3 :, 0] = 0.0
    weights[n // 3 : 2 * n // 3 : 4] = (0.0, 0.5, 0.5)
    weights[2 * n // 3 :] = (0.0, 0.0, 1.0)
    weights = weights / weights.sum(axis=1, keepdims=True)
    turn = (np.arange(3) + rng.integers(0, 3, (n, 1))) % 3
    chosen = np.asarray(corners, np.float64)[rng.integers(0, len(corners), n)]
    return np.einsum("nk,nkx->nx", weights, chosen[np.arange(n)[:, None], turn])


def hard_rays(rng, corners, n):
    """Origins and directions, float32 [N, 3]: at and from points on triangles, along edges and axes, in planes; some
    of no length."""
    corners = np.asarray(corners, np.float64)
    center = corners.mean(axis=(0, 1))
    size = max(np.abs(corners - center).max(), 1e-30)
    origin = center + size * rng.normal(size=(n, 3))
    target = on_triangles(rng, corners, n)
    chosen = corners[rng.integers(0, len(corners), n)]
    kind = rng.integers(0, 10, n)
    origin[kind == 1] = on_triangles(rng, corners, (kind == 1).sum())
    direction = target - origin
    # Through targets and along axes; the zeros of either sign.
    axes = np.where(rng.random((n, 3)) < 0.5, -0.0, 0.0)
    axes[np.arange(n), rng.integers(0, 3, n)] = rng.choice([-1.0, 1.0], n)
    k = (kind == 2) | (kind == 3)
    direction[k] = axes[k]
    target = target.astype(np.float32)  # so that coordinates across the axis are those of the target
    origin[k] = np.where(axes[k] == 0.0, target[k], target[k] - 2.0 * size * axes[k])
    k = kind == 4  # one zero
    lost = rng.integers(0, 3, k.sum())
    origin[np.flatnonzero(k), lost] = target[k, lost]
    direction[k] = target[k] - origin[k]
    edge = chosen[:, 1] - chosen[:, 0]
    k = kind == 5  # along edges
    origin[k], direction[k] = (chosen[:, 0] - rng.integers(0, 3, (n, 1)) * edge)[k], edge[k]
    k = kind == 6  # in planes
    other = chosen[:, 2] - chosen[:, 0]
    direction[k] = (edge * rng.normal(size=(n, 1)) + other)[k]
    origin[k] = (chosen[:, 0] + rng.normal(size=(n, 1)) * edge)[k]
    direction *= 10.0 ** rng.uniform(-2.0, 2.0, (n, 1))
    direction[kind == 7] /= np.maximum(np.linalg.norm(direction[kind == 7], axis=1, keepdims=True), 1e-30)
    direction[::97] *= 0.0
    return origin.astype(np.float32), direction.astype(np.float32)


# --- closed meshes: vertices [N, 3] and faces [M, 3], which wind about the origin ----------------------------------


def icosphere():
    mesh = trimesh.creation.icosphere(subdivisions=4)
    return np.array(mesh.vertices), np.array(mesh.faces)


def displaced_sphere():
    """Rough, and such that each direction from near the center meets it once."""
    vertices, faces = icosphere()
    roughness = np.random.default_rng(3).uniform(0.7, 1.0, (len(vertices), 1))
    return vertices * roughness, faces


def box():
    """Squares of a grid of 8 by 8 on each side of a cube from -1 to 1; all coordinates are multiples of 1/4."""
    side = np.linspace(-1.0, 1.0, 9)
    corners = []
    for axis in range(3):
        for at in (-1.0, 1.0):
            u, v = (a.ravel() for a in np.meshgrid(side[:-1], side[:-1]))
            square = np.empty((len(u), 4, 3))
            square[..., axis] = at
            square[..., (axis + 1) % 3] = u[:, None] + (0.0, 0.25, 0.25, 0.0)
            square[..., (axis + 2) % 3] = v[:, None] + (0.0, 0.0, 0.25, 0.25)
            corners += [square[:, [0, 1, 2]], square[:, [0, 2, 3]]]
    vertices, faces = np.unique(np.concatenate(corners).reshape(-1, 3), axis=0, return_inverse=True)
    return vertices, faces.reshape(-1, 3)


CLOSED = {f.__name__: f for f in (icosphere, displaced_sphere, box)}
