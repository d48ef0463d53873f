"""Rays against instances: hits against float64 brute force, vertices against float64 transforms, and rays that leave
a surface, which must not meet it again under any transform."""

import numpy as np
import pytest
import warp as wp

from tests.accel import tracing
from tests.test_surface import (
    DEVICE,
    Soup,
    cloud,
    leaving_directions,
    random_barycentrics,
    random_spheres,
    shapes,
    unit,
)
from wavefront.accel.bvh import BoxBvh, TriangleBvh, place
from wavefront.accel.geometry import Geometry, InstanceHit
from wavefront.accel.instance import Group, Instance, no_shapes
from wavefront.accel.intersector import make_intersector
from wavefront.accel.spheres import sphere_boxes
from wavefront.surface import Vertex, make_vertex, spawn_origin

N = 40_000
CHUNK = 200  # triangles of one group
KINDS = ("spheres", "triangles")

closest, occluded = make_intersector(False, False, KINDS)[:2]
vertex_of = make_vertex(False, False, True, True, False, False, KINDS)


@wp.kernel(enable_backward=False, module="unique")
def trace_kernel(
    geometry: Geometry,
    origin: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    t_max: wp.array(dtype=float),
    # outputs
    hits: wp.array(dtype=InstanceHit),
    vertices: wp.array(dtype=Vertex),
    blocked: wp.array(dtype=int),
):
    i = wp.tid()
    hit = closest(geometry, origin[i], direction[i])
    hits[i] = hit
    if hit.primitive >= 0:
        vertices[i] = vertex_of(geometry, origin[i], direction[i], hit)
    # Of another length, with the same end.
    if occluded(geometry, origin[i], 0.3 * direction[i], t_max[i] / 0.3):
        blocked[i] = 1


@wp.kernel(enable_backward=False, module="unique")
def leave_kernel(
    geometry: Geometry,
    given: wp.array(dtype=InstanceHit),
    origin: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    leaving: wp.array(dtype=wp.vec3),
    # outputs
    vertices: wp.array(dtype=Vertex),
    next_hits: wp.array(dtype=InstanceHit),
):
    """The vertex of a given hit, and what a ray that leaves it meets."""
    i = wp.tid()
    vertex = vertex_of(geometry, origin[i], direction[i], given[i])
    vertices[i] = vertex
    start = spawn_origin(vertex.position, vertex.geometric_normal, vertex.offset, leaving[i])
    next_hits[i] = closest(geometry, start, leaving[i])


class World(Soup):
    """One group, of triangles without order and of spheres, and its instances."""

    def __init__(self, corners, matrices, translations, spheres=(), **arrays):
        super().__init__(corners, **arrays)
        g, count = self.geometry, len(corners)
        self.spheres = np.asarray(spheres, np.float32).reshape(-1, 4)
        total = count + len(self.spheres)
        g.shape_of = wp.array(np.arange(total) >= count, dtype=wp.int32, device=DEVICE)
        if not arrays:
            g.shapes = shapes(2)
        g.spheres = wp.array(self.spheres, dtype=wp.vec4, device=DEVICE)
        identity = np.tile(np.eye(3, dtype=np.float32), (len(self.spheres), 1, 1))
        g.sphere_to_local = wp.array(identity, dtype=wp.mat33, device=DEVICE)
        hierarchies = [(TriangleBvh(g.points, g.indices, alone=False), g.points)]
        if len(self.spheres):
            boxes = [wp.array(c, dtype=wp.vec3, device=DEVICE) for c in sphere_boxes(self.spheres)]
            hierarchies.append((BoxBvh(*boxes, alone=False), *boxes))
        huge = np.full((len(matrices), 3), 1e30)
        boxes = [wp.array(c, dtype=wp.vec3, device=DEVICE) for c in (-huge, huge)]
        hierarchies.append((BoxBvh(*boxes, alone=False), *boxes))
        g.bvh = place(hierarchies)
        g.instance_root = hierarchies[-1][0].first_node
        group = no_shapes()
        group.root = 0
        if len(self.spheres):
            group.sphere_root = hierarchies[1][0].first_node
        g.groups = wp.array([group], dtype=Group, device=DEVICE)
        host = np.zeros(len(matrices), Instance.numpy_dtype())
        host["to_world"], host["translation"] = matrices, translations
        host["to_local"] = np.linalg.inv(host["to_world"].astype(np.float64))
        g.instances = wp.array(host, dtype=Instance, device=DEVICE)
        self.matrices, self.translations = (host[name].astype(np.float64) for name in ("to_world", "translation"))

    def launch(self, kernel, inputs, outputs):
        n = len(inputs[-1])
        arrays = [
            wp.array(np.ascontiguousarray(a), dtype=t, device=DEVICE)
            for a, t in zip(inputs, kernel_types(inputs), strict=True)
        ]
        out = [wp.zeros(n, dtype=t, device=DEVICE) for t in outputs]
        wp.launch(kernel, dim=n, inputs=[self.geometry, *arrays], outputs=out, device=DEVICE)
        return [a.numpy() for a in out]

    def trace(self, origin, direction, t_max):
        """Hits, vertices, and what is blocked; asserts that streams find the same bits."""
        inputs = [np.float32(origin), np.float32(direction), np.float32(t_max)]
        hits, vertices, blocked = self.launch(trace_kernel, inputs, [InstanceHit, Vertex, int])
        stream = tracing.make_kernels(False, False, KINDS)[1]
        found = tracing.launch(stream, self.geometry, *inputs[:2])
        for name in ("t", "primitive", "instance"):
            assert (getattr(found, name) == hits[name]).all(), name
        assert (found.uv == np.column_stack([hits["u"], hits["v"]])).all()
        scale = np.float32(0.3)
        found = tracing.launch(stream, self.geometry, inputs[0], scale * inputs[1], inputs[2] / scale)
        assert (found.blocked == blocked).all()
        return hits, vertices, blocked

    def leave(self, instance, primitive, u, v, leaving, origin=None, direction=None, t=None):
        hits = np.zeros(len(primitive), InstanceHit.numpy_dtype())
        hits["instance"], hits["primitive"], hits["u"], hits["v"] = instance, primitive, u, v
        hits["t"] = 1.0 if t is None else t
        zero = np.zeros_like(leaving)
        inputs = [hits, zero if origin is None else origin, zero if direction is None else direction, leaving]
        return self.launch(leave_kernel, inputs, [Vertex, InstanceHit])


def kernel_types(inputs):
    return [InstanceHit if a.dtype.names else wp.vec3 if a.ndim == 2 else wp.float32 for a in inputs]


def random_matrices(rng, n, kind):
    """3 x 3: turned and scaled alike; by up to 100 to 1 along axes that are turned; sheared too; a third mirrors."""
    q = [np.linalg.qr(rng.normal(size=(n, 3, 3)))[0] for _ in range(2)]
    size = 10.0 ** rng.uniform(-2.0, 2.0, (n, 1, 1))
    if kind == "similar":
        return size * q[0]
    spread = 10.0 ** rng.uniform(-1.0, 1.0, (n, 3))
    if kind == "axes":  # the usual scale, then a turn
        return size * q[0] @ (spread[:, :, None] * np.eye(3))
    return size * (q[0] * spread[:, None]) @ q[1]


TRANSFORMS = ("similar", "axes", "sheared")


def brute_force(world, origin, direction):
    """Closest parameter, instance and primitive in float64, of unbounded rays."""
    best = np.full(len(origin), np.inf)
    instance, primitive = np.full(len(origin), -1), np.full(len(origin), -1)
    for k, (matrix, translation) in enumerate(zip(world.matrices, world.translations, strict=True)):
        inverse = np.linalg.inv(matrix)
        o, w = (origin - translation) @ inverse.T, direction @ inverse.T
        found = []
        for a, b, c in world.corners.astype(np.float64):
            p = np.cross(w, c - a)
            det = p @ (b - a)
            s = o - a
            u, q = np.einsum("ij,ij->i", s, p) / det, np.cross(s, b - a)
            v, t = np.einsum("ij,ij->i", w, q) / det, q @ (c - a) / det
            found.append(np.where((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0), t, np.inf))
        for x, y, z, r in world.spheres.astype(np.float64):
            f = o - (x, y, z)
            a, b, c = (np.einsum("ij,ij->i", *pair) for pair in ((w, w), (f, w), (f, f)))
            root = np.sqrt(np.maximum(b * b - a * (c - r * r), -0.0), where=b * b >= a * (c - r * r),
                           out=np.full(len(o), np.nan))  # fmt: skip
            near, far = (-b - root) / a, (-b + root) / a
            found.append(np.where(near > 0.0, near, np.where(far > 0.0, far, np.inf)))
        for j, t in enumerate(found):
            closer = t < best
            instance, primitive = np.where(closer, k, instance), np.where(closer, j, primitive)
            best = np.where(closer, t, best)
    return best, instance, primitive


@pytest.mark.parametrize("kind", TRANSFORMS)
def test_hits_are_those_of_brute_force(kind):
    """Closest and any hit, of triangles and ellipsoids that overlap, and the vertex in world space."""
    rng = np.random.default_rng(21)
    instances = 12
    corners = rng.normal(size=(15, 1, 3)) + 0.5 * rng.normal(size=(15, 3, 3))
    spheres = np.column_stack([rng.normal(size=(5, 3)), rng.uniform(0.1, 0.5, 5)])
    matrices = random_matrices(rng, instances, kind)
    matrices /= np.abs(np.linalg.det(matrices))[:, None, None] ** (1.0 / 3.0)
    translations = 3.0 * rng.normal(size=(instances, 3)) + (0.0, 0.0, 50.0)
    world = World(corners, matrices, translations, spheres)
    n = 8000
    origin = (rng.normal(size=(n, 3)) * 8.0 + (0.0, 0.0, 50.0)).astype(np.float32)
    target = rng.normal(size=(n, 3)) * 4.0 + (0.0, 0.0, 50.0)
    direction = unit(target - origin).astype(np.float32)
    best, instance, primitive = brute_force(world, origin.astype(np.float64), direction.astype(np.float64))
    t_max = np.where(rng.random(n) < 0.5, 0.99, 1.01) * np.where(np.isfinite(best), best, 1.0)
    hits, vertices, blocked = world.trace(origin, direction, t_max)
    # Where two are within roundings, or an edge decides, either is right: a few of thousands.
    same = (hits["instance"] == np.where(np.isfinite(best), instance, -1)) & (hits["primitive"] == primitive)
    assert 0.25 < np.isfinite(best).mean() < 0.995
    assert same.mean() > 0.999, same.mean()
    found = same & np.isfinite(best)
    assert len(set(hits["instance"][found])) == instances
    assert (primitive[found] >= len(corners)).mean() > 0.02
    reached = origin + best[:, None] * direction.astype(np.float64)
    np.testing.assert_allclose(hits["t"][found], best[found], rtol=3e-4, atol=3e-4)
    assert np.median(np.abs(hits["t"][found] / best[found] - 1.0)) < 1e-6
    error = np.linalg.norm(vertices["position"][found] - reached[found], axis=1)
    assert np.quantile(error, 0.99) < 1e-4
    clear = found & (best > 1e-2)
    expected = (t_max > best) & np.isfinite(best)
    assert (blocked[clear] == expected[clear]).mean() > 0.999
    assert (blocked[~np.isfinite(best) & same] == 0).all()
    # Normals: the plane of the transformed corners, outwards where the local normal is.
    triangle = found & (primitive < len(corners))
    moved = np.einsum("nij,nkj->nki", world.matrices[instance], world.corners[np.minimum(primitive, len(corners) - 1)])
    normal = np.cross(moved[:, 1] - moved[:, 0], moved[:, 2] - moved[:, 0])
    normal = unit(normal * np.sign(np.linalg.det(world.matrices[instance]))[:, None])
    np.testing.assert_allclose(vertices["geometric_normal"][triangle], normal[triangle], atol=2e-5)
    ball = found & (primitive >= len(corners))
    center = world.spheres[np.maximum(primitive - len(corners), 0), :3]
    inverse = np.linalg.inv(world.matrices[instance])
    local = np.einsum("nij,nj->ni", inverse, reached - world.translations[instance]) - center
    normal = unit(np.einsum("nji,nj->ni", inverse, local))
    assert np.quantile(np.abs(vertices["geometric_normal"][ball] - normal[ball]), 0.99) < 1e-3


def test_smooth_normals_are_those_of_a_mesh_in_the_world():
    """Each vertex normal goes by the inverse transpose and is made a unit vector, then they are interpolated."""
    rng = np.random.default_rng(22)
    n = 500
    corners = rng.normal(size=(n, 3, 3)).astype(np.float32)
    face = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    normals = unit(face[:, None] + 0.3 * rng.normal(size=(n, 3, 3))).astype(np.float32)
    uvs = rng.random((n, 3, 2)).astype(np.float32)
    matrices = random_matrices(rng, n, "sheared")
    world = World(corners, matrices, rng.normal(size=(n, 3)), normals=normals, uvs=uvs)
    world.geometry.shape_of = wp.zeros(n, dtype=wp.int32, device=DEVICE)
    world.geometry.shapes = shapes(1, smooth=1)
    u, v = random_barycentrics(rng, n)
    vertices, _ = world.leave(np.arange(n), np.arange(n), u, v, unit(rng.normal(size=(n, 3))).astype(np.float32))
    weights = np.stack([u, v, 1.0 - u.astype(np.float64) - v], axis=1)[:, :, None]
    covector = np.linalg.inv(world.matrices).transpose(0, 2, 1)
    moved = unit(np.einsum("nij,nkj->nki", covector, normals))
    expected = unit((weights * moved).sum(axis=1))
    np.testing.assert_allclose(vertices["shading_normal"], expected, atol=2e-5)
    np.testing.assert_allclose(vertices["uv"], (weights * uvs).sum(axis=1), atol=1e-6)
    position = np.einsum("nij,nj->ni", world.matrices, (weights * corners).sum(axis=1)) + world.translations
    scale = np.abs(world.matrices).max(axis=(1, 2))[:, None] * 4.0
    assert (np.abs(vertices["position"] - position) < 1e-6 * (scale + 4.0)).all()
    normal = unit(np.einsum("nij,nj->ni", covector, face))
    side = np.sign(np.einsum("ij,ij->i", normal, expected))[:, None]
    assert np.quantile(np.abs(vertices["geometric_normal"] - side * normal), 0.999) < 1e-4


# --- rays that leave ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("grazing", [False, True], ids=["any", "grazing"])
@pytest.mark.parametrize("shape", ["plain", "slivers", "axis-aligned"])
@pytest.mark.parametrize("kind", TRANSFORMS)
def test_ray_does_not_meet_its_own_triangle(kind, shape, grazing):
    """Each of 200 groups is seen in an instance of its own; other triangles may be hit, the own one never."""
    rng = np.random.default_rng(31 + grazing)
    corners = cloud(rng, shape, N)
    c = corners.astype(np.float64)
    corners = corners[(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) != 0.0).any(axis=1)]
    n = len(corners)
    u, v = random_barycentrics(rng, n)
    u[: n // 20], v[: n // 20] = 0.0, 0.0  # a corner
    v[n // 20 : n // 10] = 0.0  # an edge
    groups = -(-n // CHUNK)
    matrices = random_matrices(rng, groups, kind).astype(np.float32)
    translations = rng.normal(size=(groups, 3)) * 10.0 ** rng.uniform(-3.0, 5.0, (groups, 1))
    own = np.zeros(n, bool)
    for k in range(groups):
        chunk = slice(k * CHUNK, (k + 1) * CHUNK)
        local = corners[chunk].astype(np.float64)
        cross = np.cross(local[:, 1] - local[:, 0], local[:, 2] - local[:, 0])
        normal = unit(unit(cross) @ np.linalg.inv(matrices[k].astype(np.float64)))
        direction = leaving_directions(rng, normal, grazing)
        index = np.arange(len(local))
        world = World(corners[chunk], matrices[k : k + 1], translations[k : k + 1])
        _, hits = world.leave(0, index, u[chunk], v[chunk], direction)
        own[chunk] = (hits["primitive"] == index) & (hits["instance"] == 0)
    assert own.sum() == 0, (own.sum(), np.unique(np.flatnonzero(own) // CHUNK))


@pytest.mark.parametrize("grazing", [False, True], ids=["any", "grazing"])
@pytest.mark.parametrize("kind", TRANSFORMS)
def test_ray_does_not_meet_its_own_sphere(kind, grazing):
    """Outwards it meets nothing, also where the sphere is stretched to an ellipsoid."""
    rng = np.random.default_rng(41 + grazing)
    lost = 0
    for center, radius in zip(*random_spheres(rng, 60), strict=True):
        matrix = random_matrices(rng, 1, kind).astype(np.float32)
        translation = rng.normal(size=(1, 3)) * np.abs(matrix).max() * radius * 10.0 ** rng.uniform(-2.0, 3.0)
        far = np.full((1, 3, 3), 1e30) * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]])
        world = World(far, matrix, translation, [[*center, radius]])
        m = 500
        local = unit(rng.normal(size=(m, 3)))
        inverse = np.linalg.inv(world.matrices[0])
        point = (center + radius * local) @ world.matrices[0].T + world.translations[0]
        normal = unit(local @ inverse)
        leaving = leaving_directions(rng, normal, grazing)
        leaving[np.einsum("ij,ij->i", leaving, normal) < 0.0] *= -1.0
        start = point + normal * np.abs(world.matrices[0]).max() * radius
        t = np.linalg.norm(point - start, axis=1)
        vertices, hits = world.leave(
            0, np.ones(m, int), 0.0, 0.0, leaving, np.float32(start), np.float32(-normal), np.float32(t)
        )
        cos = np.einsum("ij,ij->i", vertices["geometric_normal"].astype(np.float64), leaving)
        outwards = cos > 2e-7  # closer to the plane, roundings of the cosine decide the side
        lost += (~outwards).sum()
        assert (hits["primitive"][outwards] == -1).all(), (center, radius, matrix, translation)
    assert lost < 0.05 * 60 * 500 if grazing else lost == 0


def test_no_leak_through_what_is_just_behind():
    """The offset stays small: a parallel copy of each triangle, 1e-3 of its magnitude behind, is met through it."""
    rng = np.random.default_rng(51)
    for kind in TRANSFORMS:
        corners = cloud(rng, "plain", 4000)
        matrices = random_matrices(rng, len(corners) // CHUNK, kind).astype(np.float32)
        seen, count = 0, 0
        for k, matrix in enumerate(matrices):
            c = corners[k * CHUNK : (k + 1) * CHUNK].astype(np.float64)
            normal = unit(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]))
            extent = np.abs(c - c[:, :1]).max(axis=(1, 2))
            gap = 1e-3 * np.abs(c).max(axis=(1, 2))
            area = np.linalg.norm(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]), axis=1)
            good = (area > 0.3 * extent**2) & (gap < 0.02 * extent)
            c, normal, gap = c[good], normal[good], gap[good]
            behind = (c - (gap[:, None] * normal)[:, None]).astype(np.float32)
            inverse = np.linalg.inv(matrix.astype(np.float64))
            leaving = -unit(normal @ inverse).astype(np.float32)
            world = World(np.concatenate([c, behind]), matrix[None], np.zeros((1, 3)))
            m = len(c)
            third = np.full(m, 1.0 / 3.0, np.float32)
            _, hits = world.leave(0, np.arange(m), third, third, leaving)
            # The closest hit is the copy, or by chance another triangle in front of it.
            across = gap / np.abs(np.einsum("ij,ij->i", leaving @ inverse.T, normal))
            inside = np.linalg.norm(leaving @ inverse.T, axis=1) * across < 0.05 * extent[good]
            seen += ((hits["primitive"] >= 0) & (hits["t"] < 1.1 * across))[inside].sum()
            count += inside.sum()
        assert count > 200
        assert seen == count, (kind, seen, count)
