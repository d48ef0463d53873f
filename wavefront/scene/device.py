"""From scene records to tables on the device, and to the features that kernels are built for."""

from __future__ import annotations

import dataclasses

import numpy as np
import warp as wp

from wavefront.accel.bvh import BoxBvh, TriangleBvh, place
from wavefront.accel.geometry import Geometry, Shape
from wavefront.accel.spheres import sphere_boxes
from wavefront.bsdf import tables as bsdf_tables
from wavefront.errors import SceneError
from wavefront.film import LUMINANCE
from wavefront.light.tables import EmitterRecord, LightTables
from wavefront.scene import description
from wavefront.scene.instance_upload import InstanceUpload, Part
from wavefront.scene.light_upload import LightUpload
from wavefront.scene.lookup import shown
from wavefront.scene.material_upload import MaterialUpload
from wavefront.scene.medium_upload import MediumUpload
from wavefront.scene.meshes import LARGEST_COORDINATE, SMALLEST_TRIANGLE, clear_cache, tessellate
from wavefront.scene.texture_upload import TextureAtlas, struct_array
from wavefront.scene.transforms import to_matrix
from wavefront.texture import IMAGE_TYPES, TextureTables

CACHE_BYTES = 1 << 20  # of one core of a CPU


@dataclasses.dataclass
class DeviceScene:
    """A scene in device memory. Arrays are owned here; the structs refer to them."""

    geometry: Geometry
    materials: bsdf_tables.MaterialTables
    textures: TextureTables
    lights: LightTables
    triangle_count: int  # in memory, those of groups once
    sphere_count: int
    instanced_triangle_count: int  # as many as there would be without groups
    instance_count: int
    bounds: np.ndarray  # of all surfaces, metres: [2, 3]; zeros without any
    light_count: int
    # What the kernels must know
    smooth: bool
    bsdfs: tuple[str, ...]
    mask: bool
    tangents: bool
    media: bool
    maps: tuple[str, ...]
    instances: tuple[str, ...]
    accel: str
    streams: bool
    ahead: bool
    texture_kinds: tuple[str, ...]
    light_kinds: tuple[str, ...]
    light_texture_kinds: tuple[str, ...]
    keep_alive: list
    notes: list[str]


def upload_scene(scene: description.Scene, device: str, accel: str = "bvh") -> DeviceScene:
    """Loads meshes and images, builds the acceleration structure and the light table, and moves all to `device`.

    Args:
        scene: Valid records.
        device: Where to.
        accel: How rays will find triangles, one of `wavefront.accel.intersector.ACCELS`.

    Raises:
        SceneError: A file is missing or unreadable, a mesh is empty, an emitter has no area.
    """
    return _Upload(scene, device, accel).run()


def _vertex_bytes(geometry: Geometry, textures: TextureTables) -> int:
    """Memory of what vertices are made of and of the images on them."""
    arrays = [getattr(geometry, name) for name in ("points", "indices", "normals", "uvs", "shape_of")]
    arrays += [getattr(textures, name) for name in IMAGE_TYPES]
    return sum(array.capacity for array in arrays if array is not None)


class _Upload:
    def __init__(self, scene: description.Scene, device: str, accel: str):
        self.scene, self.device, self.accel = scene, device, accel
        self.atlas = TextureAtlas()
        self.materials = MaterialUpload(scene, self.atlas)
        self.media = MediumUpload(scene)
        self.instances = InstanceUpload(scene, device)
        self.emitters: list[dict] = []
        self.light_texture_kinds: set[str] = set()
        self.shape_count = 0
        self.keep_alive: list = []
        self.notes: list[str] = []

    def run(self) -> DeviceScene:
        meshes, spheres = self._collect_shapes(self.scene.shapes, "shapes")
        collected = [(meshes, spheres)]
        for i, group in enumerate(self.scene.groups):
            if group.name in self.instances.names:
                collected.append(self._collect_shapes(group.shapes, f"groups[{i}].shapes"))
        clear_cache()
        geometry, bounds, parts = self._upload_geometry(collected)
        luminances = [self._mean_luminance(emitter) for emitter in range(len(self.emitters))]
        upload = LightUpload(self.scene, self.emitters, luminances, self.device, self.notes)
        lights, light_kinds = upload.run(meshes, spheres, bounds)
        lights.emitters = struct_array(EmitterRecord, self.emitters, self.device)
        geometry.shapes = struct_array(Shape, self.shape_records, self.device)
        self.media.upload(geometry, self.device)
        textures, cpu = self.atlas.upload(self.device), wp.get_device(self.device).is_cpu
        return DeviceScene(
            geometry=geometry,
            materials=self.materials.upload(self.device),
            textures=textures,
            lights=lights,
            triangle_count=geometry.triangle_count,
            sphere_count=geometry.spheres.shape[0] if geometry.spheres else 0,
            instanced_triangle_count=parts[0].triangle_count
            + sum(parts[1 + i].triangle_count for i in self.instances.group_of),
            instance_count=len(self.instances.group_of),
            bounds=bounds,
            light_count=lights.lights.shape[0],
            smooth=any(mesh.normals is not None for meshes, _ in collected for _, mesh, _ in meshes),
            bsdfs=tuple(sorted(self.materials.kinds)),
            mask=self.materials.mask,
            tangents=self.materials.tangents,
            media=self.media.absorbing,
            maps=tuple(sorted(self.materials.map_kinds)),
            instances=tuple(
                kind
                for kind, field in (("spheres", "sphere_count"), ("triangles", "triangle_count"))
                if any(getattr(part, field) for part in parts[1:])
            ),
            accel=self.accel,
            streams=self.accel == "bvh" and cpu and bool(self.shape_records),
            ahead=cpu and _vertex_bytes(geometry, textures) > CACHE_BYTES,
            texture_kinds=tuple(sorted(set(self.atlas.kinds))),
            light_kinds=light_kinds,
            light_texture_kinds=tuple(sorted(self.light_texture_kinds)),
            keep_alive=self.keep_alive,
            notes=self.notes,
        )

    # --- geometry --------------------------------------------------------------------------------------------------

    def _collect_shapes(self, shapes, path):
        """Meshes as (shape record, triangles, emitter index) and spheres as (shape record, centre, radius, emitter)."""
        meshes, spheres = [], []
        for i, shape in enumerate(shapes):
            where = f"{path}[{i}]"
            named = where + (f" ({shown(shape.name)})" if shape.name else "")
            emitter = self._emitter(shape.emitter, where) if shape.emitter is not None else -1
            record = {"material": self.materials.add(shape.bsdf, f"{where}.bsdf"), "first_light": -1}
            record["index"] = self.shape_count
            self.shape_count += 1
            record["two_sided"] = int(shape.emitter is not None and shape.emitter.two_sided)
            record |= self.media.sides(shape)
            if isinstance(shape, description.Sphere):
                matrix = to_matrix(shape.to_world, f"{where}.to_world")
                center = matrix[:3, :3] @ np.asarray(shape.center) + matrix[:3, 3]
                scale = abs(np.linalg.det(matrix[:3, :3])) ** (1.0 / 3.0)
                reach = np.abs(center).max() + shape.radius * scale
                if reach > LARGEST_COORDINATE or shape.radius * scale < SMALLEST_TRIANGLE:
                    found = f"radius {shape.radius * scale:g} m, reaches {reach:g} m"
                    limits = f"a radius of at least {SMALLEST_TRIANGLE:g} m within {LARGEST_COORDINATE:g} m"
                    raise SceneError(f"a sphere that 32-bit rays cannot hit ({found}); allowed: {limits}", path=where)
                record["flip"] = int(shape.flip_normals)
                spheres.append((record, center, shape.radius * scale, emitter, matrix[:3, :3] / scale))
            else:
                mesh = tessellate(shape, where)
                self.notes += [f"{named}: {note}" for note in mesh.notes]
                textured = record["material"] in self.materials.textured
                textured |= emitter >= 0 and self.emitters[emitter]["radiance_texture"] >= 0
                if textured and mesh.uvs is None:
                    self.notes.append(f"{named} has no UVs: its textures are looked up at (0, 0)")
                record["smooth"] = int(mesh.normals is not None)
                record["polar"] = int(isinstance(shape, description.Disk))
                meshes.append((record, mesh, emitter))
        return meshes, spheres

    def _upload_geometry(self, collected) -> tuple[Geometry, np.ndarray, list[Part]]:
        """From (meshes, spheres) of the scene itself, then of each group; triangles and spheres are in that order."""
        device = self.device
        meshes, spheres = ([item for pair in collected for item in pair[kind]] for kind in (0, 1))
        parts = [Part(0, 0, 0, 0)]
        for part_meshes, part_spheres in collected:
            last = parts[-1]
            count = sum(len(mesh.faces) for _, mesh, _ in part_meshes)
            first, first_sphere = last.first_triangle + last.triangle_count, last.first_sphere + last.sphere_count
            parts.append(Part(first, count, first_sphere, len(part_spheres)))
            parts[-1].enclose(mesh.vertices for _, mesh, _ in part_meshes)
        del parts[0]
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
        if self.atlas.records or self.materials.tangents or "uv" in self.scene.film.aovs:
            if meshes:
                uvs = [m.uvs if m.uvs is not None else np.zeros((len(m.vertices), 2)) for _, m, _ in meshes]
                geometry.uvs = wp.array(np.concatenate(uvs), dtype=wp.vec2, device=device)
            if spheres:
                rotations = np.stack([rotation.T for *_, rotation in spheres])
                geometry.sphere_to_local = wp.array(rotations, dtype=wp.mat33, device=device)
        if spheres:
            table = np.array([[*center, radius] for _, center, radius, *_ in spheres], np.float32)
            geometry.spheres = wp.array(table, dtype=wp.vec4, device=device)
            for part in parts:
                part.spheres = table[part.first_sphere : part.first_sphere + part.sphere_count]
        bounds = self._build(geometry, parts)
        return geometry, bounds if len(counts) else np.zeros((2, 3)), parts

    def _build(self, geometry: Geometry, parts: list[Part]) -> np.ndarray:
        """Builds the hierarchies of the scene itself, of groups and of instances; returns the bounds of all."""
        hierarchies = []  # (where its root is written to, itself, what it is fitted to)

        def add_boxes(owner, name: str, corners: np.ndarray, first: int = 0) -> None:
            boxes = [wp.array(corner, dtype=wp.vec3, device=self.device) for corner in corners]
            hierarchies.append(((owner, name), BoxBvh(*boxes, first, alone=False), *boxes))

        for part in parts:
            if part.triangle_count:
                # Vertices are those of all.
                points, end = geometry.points, part.first_triangle + part.triangle_count
                indices = geometry.indices[3 * part.first_triangle : 3 * end]
                if self.accel == "bvh":
                    bvh = TriangleBvh(points, indices, part.first_triangle, alone=False)
                    hierarchies.append(((part.group, "root"), bvh, points))
                else:  # leaves of 2 triangles traced fastest of 1, 2, 4 and 8 on the CPU device
                    mesh = wp.Mesh(points, indices, bvh_constructor="sah", bvh_leaf_size=2)
                    self.keep_alive.append(mesh)
                    part.group.mesh, part.group.root, part.group.first_triangle = mesh.id, 0, part.first_triangle
            if part.sphere_count:
                boxes = sphere_boxes(part.spheres)
                add_boxes(part.group, "sphere_root", boxes, part.first_sphere)
                part.enclose(boxes)
        bounds = parts[0].bounds
        if len(parts) > 1:
            lower, upper = self.instances.boxes(parts[1:], bounds)
            add_boxes(geometry, "instance_root", (lower, upper))
            bounds = np.array([np.minimum(bounds[0], lower.min(axis=0)), np.maximum(bounds[1], upper.max(axis=0))])
        if hierarchies:
            geometry.bvh = place([placed for _, *placed in hierarchies])
            for (owner, name), bvh, *_ in hierarchies:
                setattr(owner, name, bvh.first_node)
        geometry.own = parts[0].group
        if len(parts) > 1:
            self.instances.upload(geometry, parts[1:])
        return bounds

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
