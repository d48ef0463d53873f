"""Rays against scenes of triangles, spheres and instances: the portable traversal and streams agree bit for bit, also
where several things are equally far.

What they find is compared with float64 brute force in `tests.test_instance_rays`.
"""

import numpy as np
import pytest

from tests.accel.soups import SOUPS
from tests.accel.tracing import FAR, check_bounds, compare, make_kernels
from tests.test_instance_rays import TRANSFORMS, random_matrices
from wavefront.scene import description as d
from wavefront.scene.device import upload_scene

GROUPS = {"both": ("spheres", "triangles"), "meshes": ("triangles",), "balls": ("spheres",)}
OWN = {"nothing": (False, False), "meshes": (True, False), "balls": (False, True), "both": (True, True)}


def meshes(rng, n):
    corners = SOUPS["scattered"](rng, n).reshape(-1, 3)
    return [d.Mesh(vertices=rows(corners), faces=rows(np.arange(len(corners)).reshape(-1, 3), int))]


def balls(rng, n):
    return [d.Sphere(center=tuple(rng.normal(size=3)), radius=rng.uniform(0.05, 0.6)) for _ in range(n)]


def rows(array, kind=float):
    return [tuple(map(kind, row)) for row in array]


def matrix(linear, translation=(0.0, 0.0, 0.0)):
    return rows(np.vstack([np.column_stack([linear, translation]), (0.0, 0.0, 0.0, 1.0)]))


def shapes(rng, n, triangles, spheres):
    return (meshes(rng, n) if triangles else []) + (balls(rng, 5) if spheres else [])


def rays(rng, n, places):
    """From near one instance to near another, of any length; a tenth along axes, a tenth in planes of two, and a few
    without length."""
    places = np.asarray(places)
    ends = places[rng.integers(0, len(places), (2, n))] + rng.normal(size=(2, n, 3)) * [[[3.0]], [[0.7]]]
    direction = (ends[1] - ends[0]) * 10.0 ** rng.uniform(-2.0, 2.0, (n, 1))
    along, axis = rng.integers(0, 10, n), rng.integers(0, 3, n)
    zero = np.where(rng.random((n, 3)) < 0.5, -0.0, 0.0)
    is_axis = np.arange(3) == axis[:, None]
    direction = np.where((along == 0)[:, None] & ~is_axis | (along == 1)[:, None] & is_axis, zero, direction)
    direction[::97] *= 0.0
    return np.float32(ends[0]), np.float32(direction)


def check(scene, own, groups, origin, direction):
    """Both ways agree; returns what they find, and the kernels."""
    kernels = make_kernels(*OWN[own], GROUPS[groups])
    geometry = upload_scene(scene, "cpu").geometry
    hits = compare(kernels, geometry, origin, direction)
    assert ((hits.primitive >= 0) | (hits.instance == -1)).all()
    check_bounds(kernels, geometry, origin, direction, hits)
    return hits


@pytest.mark.parametrize("groups", GROUPS)
@pytest.mark.parametrize("own", OWN)
def test_both_ways_find_the_same(own, groups):
    """Of instances that overlap, of every kind of transform, some far from the origin."""
    figures = []
    for seed, kind in enumerate(TRANSFORMS):
        rng = np.random.default_rng([seed, *map(ord, own + groups)])
        triangles, spheres = ("triangles" in GROUPS[groups]), ("spheres" in GROUPS[groups])
        members = [d.Group(name=name, shapes=shapes(rng, n, triangles, spheres)) for name, n in (("a", 1), ("b", 60))]
        linear = random_matrices(rng, 30, kind)
        linear /= np.abs(np.linalg.det(linear))[:, None, None] ** (1.0 / 3.0)
        place = np.array((0.0, 100.0, 1e4)[seed] * rng.normal(size=3) + 2.0 * rng.normal(size=(30, 3)))
        instances = [
            d.Instance(group="ab"[i % 2], to_world=matrix(*pair))
            for i, pair in enumerate(zip(linear, place, strict=True))
        ]
        scene = d.Scene(shapes=shapes(rng, 20, *OWN[own]), groups=members, instances=instances)
        hits = check(scene, own, groups, *rays(rng, 3000, place))
        figures.append([(hits.instance >= 0).mean(), (hits.primitive >= 0).mean(), len(set(hits.instance))])
    met, hit, seen = np.mean(figures, axis=0)
    assert met > 0.3 and hit < 0.99 and seen > 25


@pytest.mark.parametrize("groups", GROUPS)
@pytest.mark.parametrize("kind", TRANSFORMS)
def test_of_equal_distances_the_first_instance_wins_and_the_scene_itself_before_all(kind, groups):
    """Five copies of each of six instances in a mixed order, one of which is where the scene itself has the same. Some
    have a speck beside them, so that rays come to their larger boxes first."""
    rng = np.random.default_rng(7)
    own = groups
    common = shapes(rng, 30, *OWN[own])
    linear, place = random_matrices(rng, 6, kind), rng.normal(size=(6, 3))
    linear /= np.abs(np.linalg.det(linear))[:, None, None] ** (1.0 / 3.0)
    linear[0], place[0] = np.eye(3), 0.0
    order = np.concatenate([rng.permutation(6) for _ in range(5)])
    names = rng.choice(["plain", "specked"], len(order))
    instances = [
        d.Instance(group=name, to_world=matrix(linear[k], place[k])) for k, name in zip(order, names, strict=True)
    ]
    speck = d.Mesh(vertices=[(5.0, 5.0, 5.0), (5.0, 5.0, 5.0001), (5.0, 5.0001, 5.0)], faces=[(0, 1, 2)])
    if groups == "balls":
        speck = d.Sphere(center=(5.0, 5.0, 5.0), radius=1e-4)
    members = [d.Group(name="plain", shapes=common), d.Group(name="specked", shapes=[*common, speck])]
    scene = d.Scene(shapes=common, groups=members, instances=instances)
    origin, direction = rays(rng, 10000, place)
    hits = check(scene, own, groups, origin, direction)
    first = np.array([np.flatnonzero(order == order[k])[0] for k in range(len(order))])
    inside = hits.instance >= 0
    assert inside.mean() > 0.1 and ((hits.primitive >= 0) & ~inside).mean() > 0.02
    assert (hits.instance[inside] == first[hits.instance[inside]]).all()
    assert (order[hits.instance[inside]] != 0).all()


@pytest.mark.parametrize("groups", GROUPS)
@pytest.mark.parametrize("own", ["nothing", "both"])
def test_rays_without_length_and_bounds_without_extent_hit_nothing(own, groups):
    rng = np.random.default_rng(3)
    triangles, spheres = ("triangles" in GROUPS[groups]), ("spheres" in GROUPS[groups])
    group = d.Group(name="g", shapes=shapes(rng, 30, triangles, spheres))
    place = rng.normal(size=(20, 3))
    instances = [d.Instance(group="g", to_world=matrix(np.eye(3), p)) for p in place]
    scene = d.Scene(shapes=shapes(rng, 30, *OWN[own]), groups=[group], instances=instances)
    kernels = make_kernels(*OWN[own], GROUPS[groups])
    geometry = upload_scene(scene, "cpu").geometry
    origin, direction = rays(rng, 100, place)
    for zero in (0.0, -0.0):
        hits = compare(kernels, geometry, origin, np.full_like(origin, zero))
        assert (hits.primitive == -1).all() and (hits.t == np.float32(FAR)).all() and not hits.blocked.any()
    for bound in (0.0, -1.0):
        assert not compare(kernels, geometry, origin, direction, np.full(len(origin), bound)).blocked.any()
