"""Tangents of all shapes: against Mitsuba's shading frames and partial derivatives, and against float64."""

import functools

import numpy as np
import pytest
import warp as wp

from wavefront.accel.geometry import Geometry
from wavefront.accel.intersector import make_intersector
from wavefront.scene import description as d
from wavefront.scene.device import upload_scene
from wavefront.surface import Vertex, make_vertex

DEVICE = "cpu"
BRUSHED = d.RoughConductor(eta=0.0, k=1.0, alpha_u=0.1, alpha_v=0.2)
SHEAR = [(1.5, 0.4, 0.1, 0.2), (0.0, 0.7, -0.3, -0.1), (0.3, 0.0, 1.1, 0.4), (0.0, 0.0, 0.0, 1.0)]
TURN = [d.TransformStep(rotate=d.Rotate(axis=(1.0, 2.0, 3.0), angle=70.0)), d.TransformStep(scale=1.3)]


@functools.cache
def make_kernel(spheres: bool, smooth: bool):
    closest_hit = make_intersector(not spheres, spheres).closest_hit
    vertex_of = make_vertex(not spheres, spheres, smooth, True, True, True)

    @wp.kernel(enable_backward=False, module="unique")
    def vertex_kernel(
        geometry: Geometry,
        origin: wp.array(dtype=wp.vec3),
        direction: wp.array(dtype=wp.vec3),
        # outputs
        hit: wp.array(dtype=int),
        vertices: wp.array(dtype=Vertex),
    ):
        i = wp.tid()
        h = closest_hit(geometry, origin[i], direction[i])
        hit[i] = h.primitive
        if h.primitive >= 0:
            vertices[i] = vertex_of(geometry, origin[i], direction[i], h)

    return vertex_kernel


def trace(shape, origin, direction):
    shape.bsdf = BRUSHED
    scene = upload_scene(d.Scene(shapes=[shape]), DEVICE)
    n = len(origin)
    out = [wp.zeros(n, dtype=int, device=DEVICE), wp.zeros(n, dtype=Vertex, device=DEVICE)]
    rays = [wp.array(np.ascontiguousarray(a, np.float32), dtype=wp.vec3, device=DEVICE) for a in (origin, direction)]
    kernel = make_kernel(isinstance(shape, d.Sphere), scene.smooth)
    wp.launch(kernel, dim=n, inputs=[scene.geometry, *rays], outputs=out, device=DEVICE)
    return out[0].numpy() >= 0, out[1].numpy()


def rays(n, seed=1):
    rng = np.random.default_rng(seed)
    origin = rng.normal(size=(n, 3))
    origin *= 5.0 / np.linalg.norm(origin, axis=1, keepdims=True)
    target = rng.normal(size=(n, 3)) * 0.4
    direction = target - origin
    return origin, direction / np.linalg.norm(direction, axis=1, keepdims=True)


def partials(vertex):
    """dp/du and dp/dv in the tangent plane, from the numbers of a vertex."""
    s, n = vertex["tangent"].astype(np.float64), vertex["shading_normal"].astype(np.float64)
    t = np.cross(n, s)
    a, b, c = vertex["uv_jacobian"].astype(np.float64).T[:, :, None]
    return a * s, b * s + c * t


def mesh(uvs, normals=True):
    rng = np.random.default_rng(3)
    corners = [(-1.0, -1.0, 0.1), (1.0, -1.0, -0.2), (1.1, 1.0, 0.3), (-1.0, 0.9, 0.0)]
    return d.Mesh(
        vertices=corners,
        faces=[(0, 1, 2), (0, 2, 3)],
        normals=[tuple(v) for v in rng.normal(size=(4, 3)) * 0.3 + (0, 0, 1)] if normals else None,
        uvs=uvs,
    )


UVS = [(0.1, 0.3), (0.9, 0.2), (0.7, 1.4), (-0.2, 0.8)]
MIRRORED = [(-u, v) for u, v in UVS]
SHAPES = {
    "rectangle": lambda: d.Rectangle(to_world=SHEAR),
    "rectangle, flipped": lambda: d.Rectangle(to_world=SHEAR, flip_normals=True),
    "cube": lambda: d.Cube(to_world=SHEAR),
    "disk": lambda: d.Disk(to_world=SHEAR),
    "disk, flipped": lambda: d.Disk(to_world=SHEAR, flip_normals=True),
    "sphere": lambda: d.Sphere(center=(0.1, 0.2, -0.1), radius=0.8, to_world=TURN),
    "sphere, flipped": lambda: d.Sphere(radius=0.8, to_world=TURN, flip_normals=True),
    "mesh": lambda: mesh(UVS),
    "mesh, mirrored UVs": lambda: mesh(MIRRORED),
    "flat mesh": lambda: mesh(UVS, normals=False),
}


@pytest.mark.parametrize("name", SHAPES)
def test_frames_are_those_of_mitsuba(name):
    """In a plane: the shading normal, the tangent, and dp/du and dp/dv without what they have along the normal."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    from tools.peers import mitsuba as peer

    shape = SHAPES[name]()
    shape.bsdf = d.Diffuse()
    scene = peer.load_records(d.Scene(shapes=[shape], emitters=[d.Constant()]))
    origin, direction = rays(300)
    found, vertices = trace(shape, origin, direction)
    du, dv = partials(vertices)
    atol = 1e-4
    count = 0
    for i in np.flatnonzero(found):
        si = scene.ray_intersect(mi.Ray3f(origin[i].tolist(), direction[i].tolist()))
        if not si.is_valid():
            continue
        n = np.array(si.sh_frame.n)
        np.testing.assert_allclose(vertices["shading_normal"][i], n, atol=1e-4)
        np.testing.assert_allclose(vertices["tangent"][i], np.array(si.sh_frame.s), atol=atol)
        # Growing v of a disk goes along a circle, of which a triangle has the chord.
        for ours, theirs, error in (
            (du[i], np.array(si.dp_du), atol),
            (dv[i], np.array(si.dp_dv), 0.03 if name.startswith("disk") else atol),
        ):
            theirs = theirs - (theirs @ n) * n
            np.testing.assert_allclose(ours, theirs, atol=error * max(1.0, np.linalg.norm(theirs)))
        count += 1
    assert count > 60


def test_a_mesh_without_uvs_has_the_tangent_of_its_first_edge():
    """As in Mitsuba; dp/dv is not known."""
    for uvs in (None, [(0.5, 0.5)] * 4, [(0.0, 0.0), (1.0, 1.0), (2.0, 2.0), (3.0, 3.0)]):
        shape = mesh(uvs, normals=False)
        corners = np.array(shape.vertices)
        found, vertices = trace(shape, *rays(300))
        assert found.sum() > 60
        v = vertices[found]
        edges = np.array([corners[1] - corners[0], corners[2] - corners[0]])
        edges /= np.linalg.norm(edges, axis=1, keepdims=True)
        assert (np.abs(v["tangent"][:, None] - edges).max(axis=2).min(axis=1) < 1e-5).all()
        assert not v["uv_jacobian"][:, 2].any() or not np.isfinite(v["uv_jacobian"][:, 2]).any()


def test_tangents_are_unit_and_orthogonal_at_all_scales():
    rng = np.random.default_rng(5)
    for scale in (1e-12, 1e-3, 1.0, 1e6):
        for uv_scale in (1e-12, 1.0, 1e15, 1e30):
            shape = mesh([tuple(uv) for uv in uv_scale * rng.normal(size=(4, 2))])
            shape.to_world = [d.TransformStep(scale=scale)]
            origin, direction = rays(200)
            found, vertices = trace(shape, scale * origin, direction)
            v = vertices[found]
            assert len(v) > 40
            np.testing.assert_allclose(np.linalg.norm(v["tangent"], axis=1), 1.0, atol=1e-6)
            np.testing.assert_allclose(np.einsum("ij,ij->i", v["tangent"], v["shading_normal"]), 0.0, atol=1e-6)


def test_at_the_pole_of_a_sphere_any_tangent_will_do():
    found, vertices = trace(d.Sphere(), np.array([[0.0, 0.0, 3.0]]), np.array([[0.0, 0.0, -1.0]]))
    assert found.all()
    np.testing.assert_allclose(np.linalg.norm(vertices["tangent"][0]), 1.0, atol=1e-6)
    np.testing.assert_allclose(vertices["tangent"][0] @ vertices["shading_normal"][0], 0.0, atol=1e-6)
