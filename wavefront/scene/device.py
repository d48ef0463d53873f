"""From scene records to tables on the device, and to the features that kernels are built for."""

from __future__ import annotations

import dataclasses

import numpy as np
import warp as wp

from wavefront.accel.mesh_query import Geometry, Shape
from wavefront.bsdf import tables as bsdf_tables
from wavefront.bsdf.coating import diffuse_fresnel, rough_coating
from wavefront.errors import SceneError
from wavefront.film import LUMINANCE
from wavefront.light.tables import EmitterRecord, LightTables
from wavefront.scene import description
from wavefront.scene.images import load_image
from wavefront.scene.ior import CONDUCTORS, INDEX_OF_REFRACTION
from wavefront.scene.light_upload import LightUpload
from wavefront.scene.lookup import resolve_bsdf, resolve_texture
from wavefront.scene.meshes import clear_cache, tessellate
from wavefront.scene.transforms import to_matrix
from wavefront.texture import WRAP_MODES, TextureRecord, TextureTables, srgb_to_linear

DISTRIBUTIONS = {"ggx": 0, "beckmann": 1}
BSDF_KINDS = {
    description.Diffuse: "diffuse",
    description.OrenNayar: "oren_nayar",
    description.Conductor: "conductor",
    description.RoughConductor: "rough_conductor",
    description.Dielectric: "dielectric",
    description.RoughDielectric: "rough_dielectric",
    description.ThinDielectric: "thin_dielectric",
    description.Null: "null",
    description.Plastic: "plastic",
    description.RoughPlastic: "rough_plastic",
}


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


def _struct_array(struct: type, records: list[dict], device: str) -> wp.array:
    """A device array of structs from dicts of fields (in NumPy, since a struct a triangle in Python is slow)."""
    host = np.zeros(len(records), dtype=struct.numpy_dtype())
    for i, record in enumerate(records):
        for name, value in record.items():
            host[name][i] = value
    return wp.array(host, dtype=struct, device=device)


class _TextureAtlas:
    """Collects the textures that parameters refer to, each image once."""

    def __init__(self):
        self.records: list[dict] = []
        self.kinds: list[str] = []
        self.means: list[np.ndarray] = []
        self.bytes: list[np.ndarray] = []
        self.floats: list[np.ndarray] = []
        self.known: dict[tuple, int] = {}

    def add(self, texture: description.Texture, where: str, scalar: bool) -> int:
        """Index of a texture; `scalar` textures hold numbers, not colours, unless they say otherwise."""
        key = (repr(texture), scalar)
        if key not in self.known:
            self.known[key] = len(self.records)
            rows = {"uv_row0": texture.uv_transform[0], "uv_row1": texture.uv_transform[1]}
            if isinstance(texture, description.Checkerboard):
                color0, color1 = _rgb(texture.color0), _rgb(texture.color1)
                self._append(
                    "checkerboard", rows | {"kind": 0, "color0": color0, "color1": color1}, (color0 + color1) / 2
                )
            else:
                self._add_bitmap(texture, where, scalar, rows)
        return self.known[key]

    def _add_bitmap(self, texture: description.Bitmap, where: str, scalar: bool, rows: dict):
        pixels = load_image(texture.file, where)
        height, width, channels = pixels.shape
        is_bytes = pixels.dtype == np.uint8
        srgb = texture.color_space == "srgb" or (texture.color_space == "auto" and is_bytes and not scalar)
        if not is_bytes:
            if not np.isfinite(pixels).all():
                y, x = np.argwhere(~np.isfinite(pixels).all(axis=2))[0]
                raise SceneError(f"{texture.file}: pixel ({x}, {y}) is not finite", path=where)
            if srgb:
                pixels = srgb_to_linear(np.maximum(pixels, 0.0)).astype(np.float32)
        store = self.bytes if is_bytes else self.floats
        first = sum(part.size for part in store)
        store.append(pixels.ravel())
        linear = pixels.reshape(-1, channels) / 255.0 if is_bytes else np.maximum(pixels.reshape(-1, channels), 0.0)
        if is_bytes and srgb:
            linear = srgb_to_linear(linear)
        record = {
            "kind": 1 if is_bytes else 2,
            "first": first,
            "width": width,
            "height": height,
            "channels": channels,
            "srgb": int(srgb),
            "nearest": int(texture.filter == "nearest"),
            "wrap": WRAP_MODES[texture.wrap],
        }
        self._append("bytes" if is_bytes else "floats", rows | record, np.broadcast_to(linear.mean(axis=0), 3))

    def _append(self, kind: str, record: dict, mean: np.ndarray):
        self.records.append(record)
        self.kinds.append(kind)
        self.means.append(np.asarray(mean, np.float64))

    def upload(self, device: str) -> TextureTables:
        tables = TextureTables()
        tables.records = _struct_array(TextureRecord, self.records, device)
        tables.bytes = wp.array(np.concatenate(self.bytes) if self.bytes else np.zeros(0, np.uint8), device=device)
        tables.floats = wp.array(
            np.concatenate(self.floats) if self.floats else np.zeros(0), dtype=wp.float32, device=device
        )
        tables.srgb_to_linear = wp.array(srgb_to_linear(np.arange(256) / 255.0), dtype=wp.float32, device=device)
        return tables


def _rgb(value) -> np.ndarray:
    return np.broadcast_to(np.asarray(value, np.float64), 3)


def _relative_ior(bsdf) -> float:
    interior, exterior = (
        INDEX_OF_REFRACTION[value] if isinstance(value, str) else value for value in (bsdf.int_ior, bsdf.ext_ior)
    )
    return interior / exterior


class _Upload:
    def __init__(self, scene: description.Scene, device: str):
        self.scene, self.device = scene, device
        self.atlas = _TextureAtlas()
        self.materials: list[dict] = []
        self.bsdfs: dict[str, list[dict]] = {
            "diffuse": [],
            "conductor": [],
            "dielectric": [],
            "plastic": [],
            "oren_nayar": [],
        }
        self.coatings: list[np.ndarray] = []
        self.bsdf_kinds: set[str] = set()
        self.known_materials: dict[int, int] = {}
        self.mask = False
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
        lights.emitters = _struct_array(EmitterRecord, self.emitters, self.device)
        geometry.shapes = _struct_array(Shape, self.shape_records, self.device)
        materials = bsdf_tables.MaterialTables()
        materials.materials = _struct_array(bsdf_tables.Material, self.materials, self.device)
        materials.diffuse = _struct_array(bsdf_tables.DiffuseRecord, self.bsdfs["diffuse"], self.device)
        materials.conductor = _struct_array(bsdf_tables.ConductorRecord, self.bsdfs["conductor"], self.device)
        materials.dielectric = _struct_array(bsdf_tables.DielectricRecord, self.bsdfs["dielectric"], self.device)
        materials.plastic = _struct_array(bsdf_tables.PlasticRecord, self.bsdfs["plastic"], self.device)
        materials.oren_nayar = _struct_array(bsdf_tables.OrenNayarRecord, self.bsdfs["oren_nayar"], self.device)
        coatings = np.concatenate([np.zeros(0), *self.coatings])
        materials.coatings = wp.array(coatings, dtype=wp.float32, device=self.device)
        return DeviceScene(
            geometry=geometry,
            materials=materials,
            textures=self.atlas.upload(self.device),
            lights=lights,
            triangle_count=geometry.triangle_count,
            sphere_count=len(spheres),
            light_count=lights.lights.shape[0],
            smooth=any(mesh.normals is not None for _, mesh, _ in meshes),
            bsdfs=tuple(sorted(self.bsdf_kinds)),
            mask=self.mask,
            texture_kinds=tuple(sorted(set(self.atlas.kinds))),
            light_kinds=light_kinds,
            light_texture_kinds=tuple(sorted(self.light_texture_kinds)),
            keep_alive=self.keep_alive,
            notes=self.notes,
        )

    # --- materials -------------------------------------------------------------------------------------------------

    def _parameter(self, value, where: str, scalar: bool = False) -> tuple[object, int]:
        """Value and texture index (-1: none) of a parameter."""
        value = resolve_texture(self.scene, value)
        if isinstance(value, (description.Bitmap, description.Checkerboard)):
            return (1.0 if scalar else np.ones(3)), self.atlas.add(value, where, scalar)
        return (float(value) if scalar else _rgb(value)), -1

    def _set(self, record: dict, name: str, value, where: str, scalar: bool = False):
        record[name], record[f"{name}_texture"] = self._parameter(value, where, scalar)

    def _material(self, ref, where: str) -> int:
        """Index of the material of a BSDF record; the same record is stored once."""
        bsdf = resolve_bsdf(self.scene, ref)
        if id(bsdf) in self.known_materials:
            return self.known_materials[id(bsdf)]
        material = {"opacity": 1.0, "opacity_texture": -1}
        inner = bsdf
        if isinstance(inner, description.Mask):
            self._set(material, "opacity", inner.opacity, f"{where}.opacity", scalar=True)
            self.mask = True
            inner, where = resolve_bsdf(self.scene, inner.bsdf), f"{where}.bsdf"
        if isinstance(inner, description.TwoSided):
            front = resolve_bsdf(self.scene, inner.front)
            back = front if inner.back is None else resolve_bsdf(self.scene, inner.back)
            sides = [self._bsdf(front, f"{where}.front")]
            sides.append(sides[0] if back is front else self._bsdf(back, f"{where}.back"))
        else:
            front = self._bsdf(inner, where)
            transmits = BSDF_KINDS[type(inner)] in bsdf_tables.TRANSMISSIVE
            sides = [front, front if transmits else (int(bsdf_tables.KIND_NONE), 0)]
        (material["front"], material["front_index"]), (material["back"], material["back_index"]) = sides
        self.materials.append(material)
        self.known_materials[id(bsdf)] = len(self.materials) - 1
        self.keep_alive.append(bsdf)  # the id stays taken
        return len(self.materials) - 1

    def _bsdf(self, bsdf: description.Bsdf, where: str) -> tuple[int, int]:
        """Kind and record index of a BSDF that is neither two-sided nor a mask."""
        kind = BSDF_KINDS[type(bsdf)]
        self.bsdf_kinds.add(kind)
        if kind == "null":
            return bsdf_tables.KINDS[kind], 0  # has no parameters, hence no record
        record: dict = {}
        if kind == "diffuse":
            table = "diffuse"
            self._set(record, "reflectance", bsdf.reflectance, f"{where}.reflectance")
        elif kind == "oren_nayar":
            table = "oren_nayar"
            self._set(record, "reflectance", bsdf.reflectance, f"{where}.reflectance")
            self._set(record, "roughness", bsdf.roughness, f"{where}.roughness", scalar=True)
        elif kind in ("conductor", "rough_conductor"):
            table = "conductor"
            eta, k = CONDUCTORS[bsdf.material] if bsdf.material is not None else (bsdf.eta, bsdf.k)
            eta, k = (0.0, 1.0) if eta is None else (eta, k)  # a perfect mirror
            self._set(record, "eta", eta, f"{where}.eta")
            self._set(record, "k", k, f"{where}.k")
            self._set(record, "reflectance", bsdf.specular_reflectance, f"{where}.specular_reflectance")
        elif kind in ("plastic", "rough_plastic"):
            table = "plastic"
            record["eta"] = _relative_ior(bsdf)
            record["nonlinear"] = int(bsdf.nonlinear)
            self._set(record, "diffuse", bsdf.diffuse_reflectance, f"{where}.diffuse_reflectance")
            self._set(record, "reflectance", bsdf.specular_reflectance, f"{where}.specular_reflectance")
            if kind == "plastic":
                record["internal_reflectance"] = diffuse_fresnel(1.0 / record["eta"])
            else:
                record["alpha"], record["distribution"] = bsdf.alpha, DISTRIBUTIONS[bsdf.distribution]
                transmittance, record["internal_reflectance"] = rough_coating(
                    record["eta"], bsdf.alpha, record["distribution"]
                )
                record["first"] = sum(part.size for part in self.coatings)
                self.coatings.append(transmittance)
        else:
            table = "dielectric"
            record["eta"] = _relative_ior(bsdf)
            self._set(record, "reflectance", bsdf.specular_reflectance, f"{where}.specular_reflectance")
            self._set(record, "transmittance", bsdf.specular_transmittance, f"{where}.specular_transmittance")
        if kind in ("rough_conductor", "rough_dielectric"):
            self._set(record, "alpha", bsdf.alpha, f"{where}.alpha", scalar=True)
            record["distribution"] = DISTRIBUTIONS[bsdf.distribution]
        self.bsdfs[table].append(record)
        return bsdf_tables.KINDS[kind], len(self.bsdfs[table]) - 1

    # --- geometry --------------------------------------------------------------------------------------------------

    def _collect_shapes(self):
        """Meshes as (shape record, triangles, emitter index) and spheres as (shape record, centre, radius, emitter)."""
        meshes, spheres = [], []
        for i, shape in enumerate(self.scene.shapes):
            where = f"shapes[{i}]"
            emitter = self._emitter(shape.emitter, where) if shape.emitter is not None else -1
            record = {"material": self._material(shape.bsdf, f"{where}.bsdf"), "first_light": -1}
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
        if self.atlas.records:
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
        self._set(record, "radiance", area.radiance, f"{where}.emitter.radiance")
        if record["radiance_texture"] >= 0:
            self.light_texture_kinds.add(self.atlas.kinds[record["radiance_texture"]])
        self.emitters.append(record)
        return len(self.emitters) - 1

    def _mean_luminance(self, emitter: int) -> float:
        record = self.emitters[emitter]
        texture = record["radiance_texture"]
        return float((record["radiance"] if texture < 0 else self.atlas.means[texture]) @ np.asarray(LUMINANCE))
