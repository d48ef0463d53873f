"""Triangles and rays of `tools.bench_accel`: meshes of any size, those of scene files, and rays as a render has."""

from __future__ import annotations

import dataclasses
import functools
import math
from pathlib import Path

import numpy as np
import warp as wp

from tools.accel_engines import Ours, Rays
from wavefront.camera import Camera, camera_kind, make_camera, make_camera_ray
from wavefront.errors import WavefrontError
from wavefront.light.sampling import SHADOW_T_MAX
from wavefront.scene import description, load_scene
from wavefront.scene.meshes import clear_cache, tessellate
from wavefront.scene.transforms import is_mirror, to_matrix
from wavefront.surface import position_error, scaled_cross, spawn_origin, triangle_extent
from wavefront.warp_samples import orthonormal_basis, square_to_cosine_hemisphere

INFINITE = 3.0e38  # t_max of a ray that nothing ends


@dataclasses.dataclass
class Case:
    """What rays are traced against, and from where.

    Attributes:
        name: For tables.
        points: Vertices, [N, 3] float32.
        faces: Three a triangle, [M, 3] int32.
        camera, film: Of the primary rays; of the film, only the aspect counts.
        lights: Indices of the triangles that emit, [L] int; without any, shadow rays end on a sphere around all.
        notes: What the user should know.
        generated: A mesh of `blob`.
    """

    name: str
    points: np.ndarray
    faces: np.ndarray
    camera: description.Camera
    film: description.Film
    lights: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    notes: list[str] = dataclasses.field(default_factory=list)
    generated: bool = False


# --- triangles ---------------------------------------------------------------------------------------------------


def blob(count: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed surface around the origin with bumps, of about `count` triangles, facing outwards.

    Longitudes and latitudes are spaced unevenly, and meridians meet in two poles: areas differ by orders of magnitude.

    Returns:
        Vertices, [N, 3] float32, and triangles, [M, 3] int32.
    """
    columns = max(3, round(math.sqrt(count)))
    rows = max(2, round(count / (2 * columns)) + 1)  # bands of latitude
    s, w = np.arange(columns) / columns, np.arange(1, rows) / rows
    u = 2.0 * np.pi * s + 0.25 * np.sin(6.0 * np.pi * s)
    v = np.pi * w + 0.1 * np.sin(4.0 * np.pi * w)
    u, v = u[None, :], v[:, None]
    bumps = 0.2 * np.sin(9.0 * u) * np.sin(7.0 * v) + 0.05 * np.sin(40.0 * u) * np.cos(33.0 * v)
    radius = 1.0 + np.sin(v) * bumps
    body = np.stack([radius * np.cos(u) * np.sin(v), radius * np.sin(u) * np.sin(v), radius * np.cos(v)], axis=-1)
    points = np.concatenate([body.reshape(-1, 3), [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]]).astype(np.float32)
    here = np.arange((rows - 1) * columns, dtype=np.int32).reshape(rows - 1, columns)
    there = np.roll(here, -1, axis=1)
    a, b, c, d = here[:-1], there[:-1], here[1:], there[1:]
    north, south = np.full(columns, len(points) - 2), np.full(columns, len(points) - 1)
    faces = [
        np.stack([a, c, d], axis=-1),
        np.stack([a, d, b], axis=-1),
        np.stack([north, here[0], there[0]], axis=-1),
        np.stack([south, there[-1], here[-1]], axis=-1),
    ]
    return points, np.concatenate([part.reshape(-1, 3) for part in faces]).astype(np.int32)


def soup(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Triangles without order that pass through each other, in a cube of two metres; sizes are log-normal.

    Returns:
        As of `blob`.
    """
    random = np.random.default_rng(seed)
    size = 0.7 * count ** (-1.0 / 3.0) * np.exp(random.normal(size=(count, 1, 1)))
    points = random.uniform(-1.0, 1.0, (count, 1, 3)) + size * random.normal(size=(count, 3, 3))
    return points.reshape(-1, 3).astype(np.float32), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def generated(count: int, ordered: bool = True) -> Case:
    """A mesh of `blob`, or without order one of `soup`, and a camera outside it."""
    points, faces = blob(count) if ordered else soup(count)
    step = description.TransformStep(look_at=description.LookAt(origin=(3.2, 2.0, 1.6), target=(0.0, 0.0, 0.0)))
    camera = description.Perspective(fov=40.0, to_world=[step])
    name = f"{'blob' if ordered else 'soup'}, {len(faces):,} triangles"
    return Case(name, points, faces, camera, description.Film(width=64, height=64), generated=ordered)


def from_scene(path: Path) -> Case:
    """The triangles of a scene file, those of its instances as copies.

    Raises:
        WavefrontError: The file cannot be read, or there is no triangle.
    """
    scene = load_scene(path)
    identity = np.eye(4)
    shapes = [(shape, f"shapes[{i}]", identity) for i, shape in enumerate(scene.shapes)]
    groups = {group.name: (i, group) for i, group in enumerate(scene.groups)}
    for i, instance in enumerate(scene.instances):
        matrix = to_matrix(instance.to_world, f"instances[{i}].to_world")
        g, group = groups[instance.group]
        shapes += [(shape, f"groups[{g}].shapes[{k}]", matrix) for k, shape in enumerate(group.shapes)]
    spheres = [shape for shape, *_ in shapes if isinstance(shape, description.Sphere)]
    points, faces, lights = [], [], []
    first_point = first_face = 0
    for shape, where, matrix in shapes:
        if isinstance(shape, description.Sphere):
            continue
        mesh = tessellate(shape, where)
        moved = (mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
        points.append(moved)
        faces.append((mesh.faces[:, ::-1] if is_mirror(matrix) else mesh.faces) + first_point)
        if shape.emitter is not None:
            lights.append(np.arange(first_face, first_face + len(mesh.faces)))
        first_point += len(moved)
        first_face += len(mesh.faces)
    clear_cache()
    if not faces:
        raise WavefrontError(f"{path}: the scene has no triangles")
    name = path.stem if path.stem != "scene" else path.resolve().parent.name
    return Case(
        name=f"{name}, {first_face:,} triangles",
        points=np.concatenate(points),
        faces=np.concatenate(faces).astype(np.int32),
        camera=scene.camera,
        film=scene.film,
        lights=np.concatenate(lights) if lights else np.zeros(0, np.int64),
        notes=[f"{len(spheres)} spheres are left out"] if spheres else [],
    )


# --- rays --------------------------------------------------------------------------------------------------------


@functools.cache
def make_primary(kind: str):
    """Kernel of the rays through the centres of pixels, row by row."""
    camera_ray = make_camera_ray(kind)

    @wp.kernel(enable_backward=False, module="unique")
    def primary(
        camera: Camera,
        width: int,
        lens: wp.array[wp.vec2],
        # out
        origin: wp.array[wp.vec3],
        direction: wp.array[wp.vec3],
    ):
        i = wp.tid()
        ray = camera_ray(camera, float(i % width) + 0.5, float(i // width) + 0.5, lens[i])
        origin[i] = ray.origin
        direction[i] = ray.direction

    return primary


@wp.kernel(enable_backward=False, module="unique")
def leave(
    points: wp.array[wp.vec3],
    indices: wp.array[wp.int32],
    primitive: wp.array[wp.int32],
    uv: wp.array[wp.vec2],
    incoming: wp.array[wp.vec3],
    sample: wp.array[wp.vec2],
    target: wp.array[wp.vec3],
    # out
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    cosine: wp.array[float],
):
    """Rays from hits to targets or, without targets, into the cosine-weighted hemisphere that the ray came from.

    They start off the surface as those of the renderer do.
    """
    i = wp.tid()
    v0 = points[indices[3 * primitive[i]]]
    v1 = points[indices[3 * primitive[i] + 1]]
    v2 = points[indices[3 * primitive[i] + 2]]
    u = uv[i][0]
    v = uv[i][1]
    position = u * v0 + v * v1 + (1.0 - u - v) * v2
    normal = wp.normalize(scaled_cross(v0, v1, v2, triangle_extent(v0, v1, v2)))
    offset = position_error(v0, v1, v2, u, v, normal)
    if wp.dot(normal, incoming[i]) > 0.0:
        normal = -normal
    if target.shape[0] > 0:
        start = spawn_origin(position, normal, offset, target[i] - position)
        leaving = target[i] - start
    else:
        s, t = orthonormal_basis(normal)
        local = square_to_cosine_hemisphere(sample[i])
        leaving = local[0] * s + local[1] * t + local[2] * normal
        start = spawn_origin(position, normal, offset, leaving)
    origin[i] = start
    direction[i] = leaving
    cosine[i] = wp.dot(normal, leaving)


def _vectors(array: np.ndarray, dtype) -> wp.array:
    return wp.array(np.ascontiguousarray(array, np.float32), dtype=dtype, device="cpu")


class RayMaker:
    """Makes the rays of a case, on the CPU device, whatever they are traced on.

    Args:
        case: Its triangles and camera.
        count: Rays of each kind; of primary rays about as many.
        seed: Of the random numbers.

    Raises:
        WavefrontError: No primary ray hits a triangle.
    """

    def __init__(self, case: Case, count: int, seed: int = 0):
        self.case, self.count = case, count
        self.random = np.random.default_rng(seed)
        self.points = _vectors(case.points, wp.vec3)
        self.indices = wp.array(case.faces.ravel(), dtype=wp.int32, device="cpu")
        self.primary_rays = self._primary()
        tracer = Ours("cpu", 1)
        tracer.prepare(case.points, case.faces)
        tracer.build()
        query = tracer.query("stream", self.primary_rays, False)
        query.run()
        self.primitive, self.uv = query.primitive.numpy(), query.uv.numpy()
        self.hits = np.flatnonzero(self.primitive >= 0)
        if not len(self.hits):
            raise WavefrontError(f"{case.name}: the camera sees no triangle")

    def make(self) -> dict[str, Rays]:
        """Rays by kind: ``primary`` in the order of pixels, ``bounce`` and ``shadow`` shuffled."""
        return {"primary": self.primary_rays, "bounce": self._bounce(), "shadow": self._shadow()}

    def _primary(self) -> Rays:
        film = self.case.film
        aspect = film.width / film.height
        width = max(1, round(math.sqrt(self.count * aspect)))
        height = max(1, round(self.count / width))
        camera = make_camera(
            self.case.camera, description.Film(width=width, height=height, pixel_aspect=film.pixel_aspect)
        )
        lens = _vectors(self.random.random((width * height, 2)), wp.vec2)
        origin, direction = (wp.empty(width * height, dtype=wp.vec3, device="cpu") for _ in range(2))
        kernel = make_primary(camera_kind(self.case.camera))
        wp.launch(kernel, width * height, inputs=[camera, width, lens], outputs=[origin, direction], device="cpu")
        t_max = np.full(width * height, INFINITE, np.float32)
        return Rays(origin.numpy(), direction.numpy(), t_max, coherent=True)

    def _leave(self, chosen: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        n = len(chosen)
        origin, direction = (wp.empty(n, dtype=wp.vec3, device="cpu") for _ in range(2))
        cosine = wp.empty(n, dtype=float, device="cpu")
        inputs = [
            self.points,
            self.indices,
            wp.array(self.primitive[chosen], dtype=wp.int32, device="cpu"),
            _vectors(self.uv[chosen], wp.vec2),
            _vectors(self.primary_rays.direction[chosen], wp.vec3),
            _vectors(self.random.random((n, 2)), wp.vec2),
            _vectors(target, wp.vec3),
        ]
        wp.launch(leave, n, inputs=inputs, outputs=[origin, direction, cosine], device="cpu")
        return origin.numpy(), direction.numpy(), cosine.numpy()

    def _chosen(self, n: int) -> np.ndarray:
        return self.random.permutation(np.resize(self.hits, n))

    def _bounce(self) -> Rays:
        origin, direction, _ = self._leave(self._chosen(self.count), np.zeros((0, 3)))
        return Rays(origin, direction, np.full(self.count, INFINITE, np.float32), coherent=False)

    def _shadow(self) -> Rays:
        # A renderer traces none below the horizon; about half of the tries are.
        tries = 4 * self.count
        origin, direction, cosine = self._leave(self._chosen(tries), self._light_points(tries))
        above = np.flatnonzero(cosine > 0.0)
        if not len(above):
            raise WavefrontError(f"{self.case.name}: no light is above the horizon of a surface that the camera sees")
        above = np.resize(above, self.count)
        t_max = np.full(self.count, float(SHADOW_T_MAX), np.float32)
        return Rays(origin[above], direction[above], t_max, coherent=False)

    def _light_points(self, n: int) -> np.ndarray:
        points, faces, lights = self.case.points.astype(np.float64), self.case.faces, self.case.lights
        if not len(lights):
            lower, upper = points.min(axis=0), points.max(axis=0)
            on_sphere = self.random.normal(size=(n, 3))
            on_sphere /= np.linalg.norm(on_sphere, axis=1, keepdims=True)
            return 0.5 * (lower + upper) + np.linalg.norm(upper - lower) * on_sphere
        corners = points[faces[lights]]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        corners = corners[self.random.choice(len(lights), n, p=areas / areas.sum())]
        root, v = np.sqrt(self.random.random((n, 1))), self.random.random((n, 1))
        return (1.0 - root) * corners[:, 0] + root * (1.0 - v) * corners[:, 1] + root * v * corners[:, 2]
