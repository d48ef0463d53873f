"""The vertex at a hit against float64, and rays that leave it: neither caught by their own surface nor through it."""

import numpy as np
import pytest
import warp as wp

from wavefront.accel.bvh import BoxBvh, TriangleBvh
from wavefront.accel.geometry import Geometry, Hit, Shape
from wavefront.accel.intersector import make_intersector
from wavefront.surface import Vertex, make_vertex, spawn_origin

DEVICE = "cpu"
N = 100_000
CHUNK = 200  # triangles in one mesh: a cloud of all scales overlaps too much for a large hierarchy

closest_triangle = make_intersector(True, False).closest_hit
closest_sphere = make_intersector(False, True).closest_hit
triangle_vertex = make_vertex(True, False, True, True, True, True)
sphere_vertex = make_vertex(False, True, False, True, True, True)


@wp.kernel(enable_backward=False, module="unique")
def triangle_kernel(
    geometry: Geometry,
    hits: wp.array(dtype=Hit),
    direction: wp.array(dtype=wp.vec3),
    # outputs
    vertices: wp.array(dtype=Vertex),
    next_hit: wp.array(dtype=Hit),
    origins: wp.array(dtype=wp.vec3),
):
    """The vertex of a given hit, and what a ray that leaves it meets."""
    i = wp.tid()
    vertex = triangle_vertex(geometry, wp.vec3(0.0), direction[i], hits[i])
    vertices[i] = vertex
    origin = spawn_origin(vertex.position, vertex.geometric_normal, vertex.offset, direction[i])
    origins[i] = origin
    next_hit[i] = closest_triangle(geometry, origin, direction[i])


@wp.kernel(enable_backward=False, module="unique")
def sphere_kernel(
    geometry: Geometry,
    origin: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    leaving: wp.array(dtype=wp.vec3),
    # outputs
    first_hit: wp.array(dtype=Hit),
    vertices: wp.array(dtype=Vertex),
    next_hit: wp.array(dtype=Hit),
):
    i = wp.tid()
    hit = closest_sphere(geometry, origin[i], direction[i])
    first_hit[i] = hit
    if hit.primitive < 0:
        return
    vertex = sphere_vertex(geometry, origin[i], direction[i], hit)
    vertices[i] = vertex
    start = spawn_origin(vertex.position, vertex.geometric_normal, vertex.offset, leaving[i])
    next_hit[i] = closest_sphere(geometry, start, leaving[i])


def shapes(count, **fields):
    host = np.zeros(count, dtype=Shape.numpy_dtype())
    host["first_light"] = -1
    for name, value in fields.items():
        host[name] = value
    return wp.array(host, dtype=Shape, device=DEVICE)


class Soup:
    """Triangles without order, uploaded with normals and UVs; `smooth` says whether the normals are used."""

    def __init__(self, corners, normals=None, uvs=None, shape_of=None):
        count = len(corners)
        g = self.geometry = Geometry()
        self.corners = np.ascontiguousarray(corners, np.float32)
        g.triangle_count = count
        g.points = wp.array(self.corners.reshape(-1, 3), dtype=wp.vec3, device=DEVICE)
        g.indices = wp.array(np.arange(3 * count, dtype=np.int32), dtype=wp.int32, device=DEVICE)
        normals = np.zeros((count, 3, 3)) if normals is None else normals
        uvs = np.zeros((count, 3, 2)) if uvs is None else uvs
        g.normals = wp.array(np.ascontiguousarray(normals, np.float32).reshape(-1, 3), dtype=wp.vec3, device=DEVICE)
        g.uvs = wp.array(np.ascontiguousarray(uvs, np.float32).reshape(-1, 2), dtype=wp.vec2, device=DEVICE)
        g.shape_of = wp.array(np.zeros(count) if shape_of is None else shape_of, dtype=wp.int32, device=DEVICE)
        g.shapes = shapes(2, smooth=[0, 1])
        g.bvh = TriangleBvh(g.points, g.indices).bvh

    def leave(self, primitive, u, v, direction):
        n = len(primitive)
        hits = np.zeros(n, dtype=Hit.numpy_dtype())
        hits["primitive"], hits["u"], hits["v"], hits["t"] = primitive, u, v, 1.0
        out = [
            wp.zeros(n, dtype=Vertex, device=DEVICE),
            wp.zeros(n, dtype=Hit, device=DEVICE),
            wp.zeros(n, dtype=wp.vec3, device=DEVICE),
        ]
        hits, direction = wp.array(hits, dtype=Hit, device=DEVICE), wp.array(direction, dtype=wp.vec3, device=DEVICE)
        inputs = [self.geometry, hits, direction]
        wp.launch(triangle_kernel, dim=n, inputs=inputs, outputs=out, device=DEVICE)
        return [a.numpy() for a in out]


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def random_barycentrics(rng, n):
    u, v = rng.random(n), rng.random(n)
    flip = u + v > 1.0
    return np.where(flip, 1.0 - u, u).astype(np.float32), np.where(flip, 1.0 - v, v).astype(np.float32)


# --- vertices ----------------------------------------------------------------------------------------------------


def test_triangle_vertex():
    """Position, normals and UVs of random triangles, half of them smooth, to float32's roundings."""
    rng = np.random.default_rng(1)
    n = 20_000
    corners = (rng.normal(size=(n, 1, 3)) * 10.0 + rng.normal(size=(n, 3, 3))).astype(np.float32)
    face = unit(np.cross(corners[:, 1] - corners[:, 0], (corners[:, 2] - corners[:, 0]).astype(np.float64)))
    normals = unit(face[:, None] * rng.choice([-1.0, 1.0], (n, 1, 1)) + 0.4 * rng.normal(size=(n, 3, 3)))
    normals = normals.astype(np.float32)
    uvs = rng.random((n, 3, 2)).astype(np.float32)
    smooth = np.arange(n) % 2
    soup = Soup(corners, normals, uvs, smooth)
    u, v = random_barycentrics(rng, n)
    vertices, _, _ = soup.leave(np.arange(n), u, v, unit(rng.normal(size=(n, 3))).astype(np.float32))
    weights = np.stack([u, v, 1.0 - u.astype(np.float64) - v], axis=1)[:, :, None]
    np.testing.assert_allclose(vertices["position"], (weights * corners).sum(axis=1), atol=1e-5)
    np.testing.assert_allclose(vertices["uv"], (weights * uvs).sum(axis=1), atol=1e-6)
    blend = unit((weights * normals).sum(axis=1))
    shading = np.where(smooth[:, None], blend, face)
    # Slivers have an ill-conditioned normal: the bound follows area and extent.
    corners = corners.astype(np.float64)
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    area2 = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    tolerance = 1e-6 + 4e-7 * edge**2 / area2
    # The geometric normal is on the side of the shading normal, unless that is in the plane to a rounding.
    side = np.where(np.einsum("ij,ij->i", face, shading) < 0.0, -1.0, 1.0)[:, None]
    clear = np.abs(np.einsum("ij,ij->i", face, shading)) > 1e-5
    assert (np.abs(vertices["geometric_normal"] - side * face).max(axis=1) < tolerance)[clear].all()
    flat = smooth == 0
    assert (np.abs(vertices["shading_normal"] - shading).max(axis=1)[flat] < tolerance[flat]).all()
    length = np.linalg.norm((weights * normals).sum(axis=1), axis=1)
    good = ~flat & (length > 0.05)
    np.testing.assert_allclose(vertices["shading_normal"][good], blend[good], atol=1e-5)
    assert (vertices["offset"] > 0.0).all()


def test_vanishing_blend_of_normals_falls_back_to_the_face():
    corners = np.float32([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    normals = np.float32([[[1, 0, 0], [-1, 0, 0], [0, 0, 0]]])
    vertices, _, _ = Soup(corners, normals, None, [1]).leave([0], [0.5], [0.5], np.float32([[0, 0, 1]]))
    np.testing.assert_array_equal(vertices["shading_normal"], [[0, 0, 1]])
    np.testing.assert_array_equal(vertices["geometric_normal"], [[0, 0, 1]])


def random_spheres(rng, n):
    radius = 10.0 ** rng.uniform(-3.0, 3.0, n)
    center = unit(rng.normal(size=(n, 3))) * radius[:, None] * 10.0 ** rng.uniform(-1.0, 3.0, (n, 1))
    return center.astype(np.float32), radius.astype(np.float32)


class OneSphere:
    def __init__(self, center, radius, flip=0, rotation=None):
        g = self.geometry = Geometry()
        self.center, self.radius = np.float32(center), np.float32(radius)
        g.triangle_count = 0
        g.spheres = wp.array([[*self.center, self.radius]], dtype=wp.vec4, device=DEVICE)
        rotation = np.eye(3) if rotation is None else rotation
        g.sphere_to_local = wp.array(rotation[None].astype(np.float32), dtype=wp.mat33, device=DEVICE)
        g.shape_of = wp.zeros(1, dtype=wp.int32, device=DEVICE)
        g.shapes = shapes(1, flip=flip)
        grown = self.radius * 1.001 + 1e-5 * np.abs(self.center).max()
        low, high = (wp.array([self.center + s * grown], dtype=wp.vec3, device=DEVICE) for s in (-1.0, 1.0))
        g.bvh = BoxBvh(low, high).bvh

    def trace(self, origin, direction, leaving):
        n = len(origin)
        out = [
            wp.zeros(n, dtype=Hit, device=DEVICE),
            wp.zeros(n, dtype=Vertex, device=DEVICE),
            wp.zeros(n, dtype=Hit, device=DEVICE),
        ]
        rays = [np.ascontiguousarray(a, np.float32) for a in (origin, direction, leaving)]
        rays = [wp.array(a, dtype=wp.vec3, device=DEVICE) for a in rays]
        wp.launch(sphere_kernel, dim=n, inputs=[self.geometry, *rays], outputs=out, device=DEVICE)
        return [a.numpy() for a in out]


@pytest.mark.parametrize("flip", [0, 1])
def test_sphere_vertex(flip):
    """Position on the sphere, normal along the radius, turned for a sphere that faces inwards, UV by longitude and
    colatitude of the sphere's own axes."""
    rng = np.random.default_rng(2)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    for center, radius in zip(*random_spheres(rng, 10), strict=True):
        sphere = OneSphere(center, radius, flip, rotation)
        n = 2000
        inside = np.arange(n) % 2 == 0
        start = unit(rng.normal(size=(n, 3))) * (radius * np.where(inside, 0.5, 3.0))[:, None] + center
        target = unit(rng.normal(size=(n, 3))) * radius * rng.random((n, 1)) + center
        start = start.astype(np.float32)
        direction = unit(target - start).astype(np.float32)
        hits, vertices, _ = sphere.trace(start, direction, direction)
        assert (hits["primitive"] == 0).mean() > 0.999
        hit = hits["primitive"] == 0
        # Float64: near root from outside, far root from inside.
        o = start.astype(np.float64) - center
        b = np.einsum("ij,ij->i", o, direction)
        root = np.sqrt(np.maximum(b**2 - np.sum(o * o, axis=1) + np.float64(radius) ** 2, 0.0))
        t = np.where(inside, -b + root, -b - root)
        expected = o + t[:, None] * direction.astype(np.float64)
        scale = np.abs(center).max() + radius
        # A ray that touches the rim has an ill-conditioned root.
        check = hit & (root > 0.05 * radius)
        np.testing.assert_allclose(vertices["position"][check], (expected + center)[check], atol=4e-6 * scale)
        outwards = unit(expected)
        sign = -1.0 if flip else 1.0
        tolerance = 3e-6 * scale / radius
        np.testing.assert_allclose(vertices["geometric_normal"][check], sign * outwards[check], atol=tolerance)
        np.testing.assert_array_equal(vertices["shading_normal"], vertices["geometric_normal"])
        local = outwards @ rotation.T
        u = np.arctan2(local[:, 1], local[:, 0]) / (2.0 * np.pi) % 1.0
        v = np.arccos(np.clip(local[:, 2], -1.0, 1.0)) / np.pi
        sin = np.sqrt(np.maximum(1.0 - local[:, 2] ** 2, 0.0))
        away = check & (sin > 0.1)
        du = np.abs(vertices["uv"][:, 0] - u)
        assert (np.minimum(du, 1.0 - du)[away] < 1e-6 + 2.0 * tolerance).all()
        assert (np.abs(vertices["uv"][:, 1] - v)[away] < 1e-6 + 2.0 * tolerance).all()


# --- rays that leave ---------------------------------------------------------------------------------------------


def leaving_directions(rng, normal, grazing):
    """Unit directions on either side; the cosine is uniform, or down to 1e-6 if grazing."""
    n = len(normal)
    tangent = unit(np.cross(normal, rng.normal(size=(n, 3))))
    cos = 10.0 ** rng.uniform(-6.0, -1.0, n) if grazing else rng.uniform(0.01, 1.0, n)
    cos = (cos * rng.choice([-1.0, 1.0], n))[:, None]
    return unit(cos * normal + np.sqrt(1.0 - cos**2) * tangent).astype(np.float32)


def cloud(rng, kind, n=N):
    """Triangles of scales 1e-3 to 1e4 at up to some hundred times their size from the origin."""
    size = 10.0 ** rng.uniform(-3.0, 4.0, (n, 1, 1))
    place = rng.normal(size=(n, 1, 3)) * size * 10.0 ** rng.uniform(-1.0, 2.0, (n, 1, 1))
    shape = rng.normal(size=(n, 3, 3))
    if kind == "slivers":  # one corner close to the opposite edge
        t = rng.random((n, 1))
        height = 10.0 ** rng.uniform(-4.0, -1.0, (n, 1))
        shape[:, 2] = t * shape[:, 0] + (1.0 - t) * shape[:, 1] + height * rng.normal(size=(n, 3))
    if kind == "axis-aligned":
        axis = rng.integers(0, 3, n)
        shape[np.arange(n), :, axis] = 0.0
        place[np.arange(n), 0, axis] = np.where(rng.random(n) < 0.5, 0.0, place[np.arange(n), 0, axis])
    return (place + size * shape).astype(np.float32)


@pytest.mark.parametrize("grazing", [False, True], ids=["any", "grazing"])
@pytest.mark.parametrize("kind", ["plain", "slivers", "axis-aligned"])
def test_ray_does_not_meet_its_own_triangle(kind, grazing):
    """10^5 triangles; other triangles may be hit, the own one never."""
    rng = np.random.default_rng(3 + grazing)
    corners = cloud(rng, kind)
    c = corners.astype(np.float64)
    cross = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
    corners, cross = corners[(cross != 0.0).any(axis=1)], cross[(cross != 0.0).any(axis=1)]
    n = len(corners)
    u, v = random_barycentrics(rng, n)
    u[: n // 20], v[: n // 20] = 0.0, 0.0  # a corner
    v[n // 20 : n // 10] = 0.0  # an edge
    direction = leaving_directions(rng, unit(cross), grazing)
    own = np.zeros(n, bool)
    hits = np.zeros(n, Hit.numpy_dtype())
    for first in range(0, n, CHUNK):
        chunk = slice(first, first + CHUNK)
        index = np.arange(len(corners[chunk]))
        _, hits[chunk], _ = Soup(corners[chunk]).leave(index, u[chunk], v[chunk], direction[chunk])
        own[chunk] = hits[chunk]["primitive"] == index
    assert own.sum() == 0, (own.sum(), corners[own][0], hits[own][0], direction[own][0])


@pytest.mark.parametrize("extent", [1e-2, 1.0, 1e3])
def test_floor_at_zero(extent):
    """The coordinates along the normal are zero, so what errs is the intersection alone."""
    rng = np.random.default_rng(int(extent) + 5)
    e = extent
    corners = np.float32([[[-e, 0, -e], [e, 0, e], [e, 0, -e]], [[-e, 0, -e], [-e, 0, e], [e, 0, e]]])
    soup = Soup(corners)
    u, v = random_barycentrics(rng, N)
    normal = np.broadcast_to([0.0, 1.0, 0.0], (N, 3))
    for grazing in (False, True):
        direction = leaving_directions(rng, normal, grazing)
        _, hits, _ = soup.leave(rng.integers(0, 2, N), u, v, direction)
        assert (hits["primitive"] >= 0).sum() == 0


@pytest.mark.parametrize("kind", ["plain", "axis-aligned"])
def test_no_leak_through_what_is_just_behind(kind):
    """A parallel copy of each triangle, 1e-4 of its magnitude behind, is met by every ray that goes through, if its
    direction is steep enough not to pass the rim."""
    rng = np.random.default_rng(8)
    corners = cloud(rng, kind, 20_000)
    c = corners.astype(np.float64)
    normal = unit(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]))
    extent = np.abs(c - c[:, :1]).max(axis=(1, 2))
    magnitude = np.abs(c).max(axis=(1, 2))
    area = np.linalg.norm(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]), axis=1)
    gap = 1e-4 * magnitude
    # Fat triangles that are larger than the gap, so that a ray from the centre stays over the copy.
    good = (area > 0.3 * extent**2) & (gap < 0.02 * extent)
    corners, c, normal, gap = corners[good], c[good], normal[good], gap[good]
    n = len(c)
    assert n > 1000
    behind = (c - (gap[:, None] * normal)[:, None]).astype(np.float32)
    direction = leaving_directions(rng, normal, False)
    cos = np.einsum("ij,ij->i", direction.astype(np.float64), normal)
    direction = np.ascontiguousarray(np.where((cos > 0.0)[:, None], -direction, direction))  # to the back
    steep = np.abs(cos) > 0.3
    third = np.full(n, 1.0 / 3.0, np.float32)
    seen = np.zeros(n, bool)
    for first in range(0, n, CHUNK):
        chunk = slice(first, first + CHUNK)
        # The closest hit is the copy, or by chance another triangle in front of it, but nothing further away.
        soup = Soup(np.concatenate([corners[chunk], behind[chunk]]))
        count = len(corners[chunk])
        _, hits, origins = soup.leave(np.arange(count), third[chunk], third[chunk], direction[chunk])
        seen[chunk] = (hits["primitive"] >= 0) & (hits["t"] < 1.1 * gap[chunk] / np.maximum(np.abs(cos[chunk]), 1e-9))
        assert np.isfinite(origins).all()
    assert steep.sum() > 500
    assert seen[steep].all(), (~seen[steep]).sum()


@pytest.mark.parametrize("grazing", [False, True], ids=["any", "grazing"])
def test_ray_does_not_meet_its_own_sphere(grazing):
    """Outwards it meets nothing, inwards the far side at the length of the chord."""
    rng = np.random.default_rng(9 + grazing)
    for center, radius in zip(*random_spheres(rng, 50), strict=True):
        sphere = OneSphere(center, radius)
        n = 2000
        normal = unit(rng.normal(size=(n, 3)))
        start = center + 4.0 * np.float64(radius) * normal
        direction = unit(center - start)
        leaving = leaving_directions(rng, normal, grazing)
        hits, vertices, next_hits = sphere.trace(start, direction, leaving)
        hit = hits["primitive"] == 0
        cos = np.einsum("ij,ij->i", vertices["geometric_normal"].astype(np.float64), leaving)
        outwards = hit & (cos > 0.0)
        scale = np.abs(center).max() + radius
        assert hit.mean() > 0.999 or scale > 300.0 * radius
        assert (next_hits["primitive"][outwards] == -1).all()
        inwards = hit & (cos < 0.0)
        # A chord that is longer than the offset is met at its other end.
        chord = -2.0 * cos * radius
        long = inwards & (chord > 3e-5 * scale / np.maximum(np.abs(cos), 1e-12) * 4.0)
        assert (next_hits["primitive"][long] == 0).all()
        error = np.abs(next_hits["t"][long] - chord[long])
        assert (error < 1e-4 * scale / np.abs(cos[long])).all()
