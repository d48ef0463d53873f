"""From scene records to tables on the device, and to the features that kernels are built for."""

from __future__ import annotations

import dataclasses

import numpy as np
import warp as wp

from wavefront.accel.mesh_query import Geometry, Shape
from wavefront.bsdf import tables as bsdf_tables
from wavefront.film import LUMINANCE
from wavefront.light.tables import EmitterRecord, LightTables
from wavefront.scene import description
from wavefront.scene.light_upload import LightUpload
from wavefront.scene.material_upload import MaterialUpload
from wavefront.scene.meshes import clear_cache, tessellate
from wavefront.scene.texture_upload import TextureAtlas, struct_array
from wavefront.scene.transforms import to_matrix
from wavefront.texture import TextureTables


@dataclasses.dataclass
class DeviceScene:
    """A scene in device memory. Arrays are owned here; the structs refer to them."""

    geometry: Geometry
    materials: bsdf_tables.MaterialTables
    textures: TextureTables
    lights: LightTables
    triangle_count: int
    sphere_count: int
    light_count: int
    # What the kernels must know
    smooth: bool
    bsdfs: tuple[str, ...]
    mask: bool
    tangents: bool
    maps: tuple[str, ...]
    texture_kinds: tuple[str, ...]
    light_kinds: tuple[str, ...]
    light_texture_kinds: tuple[str, ...]
    keep_alive: list
    notes: list[str]


def upload_scene(scene: description.Scene, device: str) -> DeviceScene:
    """Loads meshes and images, builds the acceleration structure and the light table, and moves all to `device`.

    Raises:
        SceneError: A file is missing or unreadable, a mesh is empty, an emitter has no area.
    """
    return _Upload(scene, device).run()


class _Upload:
    def __init__(self, scene: description.Scene, device: str):
        self.scene, self.device = scene, device
        self.atlas = TextureAtlas()
        self.materials = MaterialUpload(scene, self.atlas)
        self.emitters: list[dict] = []
        self.light_texture_kinds: set[str] = set()
        self.keep_alive: list = []
        self.notes: list[str] = []

    def run(self) -> DeviceScene:
        meshes, spheres = self._collect_shapes()
        geometry, bounds = self._upload_geometry(meshes, spheres)
        luminances = [self._mean_luminance(emitter) for emitter in range(len(self.emitters))]
        upload = LightUpload(self.scene, self.emitters, luminances, self.device, self.notes)
        lights, light_kinds = upload.run(meshes, spheres, bounds)
        lights.emitters = struct_array(EmitterRecord, self.emitters, self.device)
        geometry.shapes = struct_array(Shape, self.shape_records, self.device)
        return DeviceScene(
            geometry=geometry,
            materials=self.materials.upload(self.device),
            textures=self.atlas.upload(self.device),
            lights=lights,
            triangle_count=geometry.triangle_count,
            sphere_count=len(spheres),
            light_count=lights.lights.shape[0],
            smooth=any(mesh.normals is not None for _, mesh, _ in meshes),
            bsdfs=tuple(sorted(self.materials.kinds)),
            mask=self.materials.mask,
            tangents=self.materials.tangents,
            maps=tuple(sorted(self.materials.map_kinds)),
            texture_kinds=tuple(sorted(set(self.atlas.kinds))),
            light_kinds=light_kinds,
            light_texture_kinds=tuple(sorted(self.light_texture_kinds)),
            keep_alive=self.keep_alive,
            notes=self.notes,
        )

    # --- geometry --------------------------------------------------------------------------------------------------

    def _collect_shapes(self):
        """Meshes as (shape record, triangles, emitter index) and spheres as (shape record, centre, radius, emitter)."""
        meshes, spheres = [], []
        for i, shape in enumerate(self.scene.shapes):
            where = f"shapes[{i}]"
            emitter = self._emitter(shape.emitter, where) if shape.emitter is not None else -1
            record = {"material": self.materials.add(shape.bsdf, f"{where}.bsdf"), "first_light": -1}
            record["two_sided"] = int(shape.emitter is not None and shape.emitter.two_sided)
            if isinstance(shape, description.Sphere):
                matrix = to_matrix(shape.to_world, f"{where}.to_world")
                center = matrix[:3, :3] @ np.asarray(shape.center) + matrix[:3, 3]
                scale = abs(np.linalg.det(matrix[:3, :3])) ** (1.0 / 3.0)
                record["flip"] = int(shape.flip_normals)
                spheres.append((record, center, shape.radius * scale, emitter, matrix[:3, :3] / scale))
            else:
                mesh = tessellate(shape, where)
                if mesh.dropped:
                    self.notes.append(f"{where}: {mesh.dropped} triangles without area are left out")
                record["smooth"] = int(mesh.normals is not None)
                record["polar"] = int(isinstance(shape, description.Disk))
                meshes.append((record, mesh, emitter))
        clear_cache()
        return meshes, spheres

    def _upload_geometry(self, meshes, spheres) -> tuple[Geometry, np.ndarray]:
        device = self.device
        geometry = Geometry()
        points = np.concatenate([mesh.vertices for _, mesh, _ in meshes] or [np.zeros((0, 3), np.float32)])
        starts = np.cumsum([0] + [len(mesh.vertices) for _, mesh, _ in meshes])
        faces = [mesh.faces + start for (_, mesh, _), start in zip(meshes, starts, strict=False)]
        faces = np.concatenate(faces or [np.zeros((0, 3), np.int32)]).astype(np.int32)
        counts = [len(mesh.faces) for _, mesh, _ in meshes] + [1] * len(spheres)
        for first, (record, *_) in zip(np.cumsum([0, *counts]), meshes + spheres, strict=False):
            record["first_primitive"] = first
        geometry.triangle_count = len(faces)
        geometry.points = wp.array(points, dtype=wp.vec3, device=device)
        geometry.indices = wp.array(faces.ravel(), dtype=wp.int32, device=device)
        geometry.shape_of = wp.array(np.repeat(np.arange(len(counts)), counts), dtype=wp.int32, device=device)
        self.shape_records = [record for record, *_ in meshes + spheres]
        if any(mesh.normals is not None for _, mesh, _ in meshes):
            normals = [m.normals if m.normals is not None else np.zeros_like(m.vertices) for _, m, _ in meshes]
            geometry.normals = wp.array(np.concatenate(normals), dtype=wp.vec3, device=device)
        if self.atlas.records or self.materials.tangents:
            if meshes:
                uvs = [m.uvs if m.uvs is not None else np.zeros((len(m.vertices), 2)) for _, m, _ in meshes]
                geometry.uvs = wp.array(np.concatenate(uvs), dtype=wp.vec2, device=device)
            if spheres:
                rotations = np.stack([rotation.T for *_, rotation in spheres])
                geometry.sphere_to_local = wp.array(rotations, dtype=wp.mat33, device=device)
        lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
        if len(faces):
            # Leaves of 2 triangles traced fastest of 1, 2, 4 and 8 on the CPU device.
            mesh = wp.Mesh(geometry.points, geometry.indices, bvh_constructor="sah", bvh_leaf_size=2)
            self.keep_alive.append(mesh)
            geometry.mesh = mesh.id
            lower, upper = points.min(axis=0), points.max(axis=0)
        if spheres:
            table = np.array([[*center, radius] for _, center, radius, *_ in spheres], np.float32)
            geometry.spheres = wp.array(table, dtype=wp.vec4, device=device)
            # The box is grown by some roundings, so that its sides never cut the sphere.
            grown = table[:, 3:] + 1e-6 * (np.abs(table[:, :3]).max(axis=1, keepdims=True) + table[:, 3:])
            lowers, uppers = table[:, :3] - grown, table[:, :3] + grown
            bvh = wp.Bvh(wp.array(lowers, dtype=wp.vec3, device=device), wp.array(uppers, dtype=wp.vec3, device=device))
            self.keep_alive.append(bvh)
            geometry.sphere_bvh = bvh.id
            lower, upper = np.minimum(lower, lowers.min(axis=0)), np.maximum(upper, uppers.max(axis=0))
        bounds = np.array([lower, upper]) if len(counts) else np.zeros((2, 3))
        return geometry, bounds

    # --- lights ----------------------------------------------------------------------------------------------------

    def _emitter(self, area: description.Area, where: str) -> int:
        record: dict = {}
        radiance = self.atlas.parameter(self.scene, area.radiance, f"{where}.emitter.radiance")
        record["radiance"], record["radiance_texture"] = radiance
        if record["radiance_texture"] >= 0:
            self.light_texture_kinds.add(self.atlas.kinds[record["radiance_texture"]])
        self.emitters.append(record)
        return len(self.emitters) - 1

    def _mean_luminance(self, emitter: int) -> float:
        record = self.emitters[emitter]
        texture = record["radiance_texture"]
        return float((record["radiance"] if texture < 0 else self.atlas.means[texture]) @ np.asarray(LUMINANCE))
