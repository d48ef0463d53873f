"""Our scene records as a folder from which `cycles_child` builds the same scene in Blender.

``scene.json`` has Blender's settings by their names, materials as trees of nodes (`tools.peers.cycles_materials`),
camera, lights and world; meshes lie beside it as arrays and images as linear OpenEXR files. Blender builds the scene
from these and not from glTF, which has no complex index of refraction, no emission from one side and no environment.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tools.peers.cycles_materials import (
    Images,
    Materials,
    color_and_strength,
    combine,
    dot,
    emission,
    math_node,
    node,
)
from wavefront.camera import half_extent
from wavefront.errors import SceneError, WavefrontError
from wavefront.scene import description
from wavefront.scene.light_upload import load_envmap
from wavefront.scene.lookup import resolve_medium
from wavefront.scene.meshes import TriangleMesh, tessellate
from wavefront.scene.transforms import is_mirror, look_at, to_matrix
from wavefront.texture import srgb_to_linear

MAX_BOUNCES = 1024  # of Cycles
LEAST_DEPTH, LARGEST_DEPTH = 2, MAX_BOUNCES + 2
# Cycles puts the first sample of a sequence in the middle of the pixel, which biases images of few samples; renders
# begin where the table that it takes its points from begins again.
FIRST_SAMPLE = 1 << 13
SEQUENCE = 1 << 24  # samples per pixel
MAX_SAMPLES = SEQUENCE - FIRST_SAMPLE
LEAST_SIZE = 4  # pixels
SENSOR_WIDTH = 36.0  # mm
SPHERE_ROWS, SPHERE_COLUMNS = 96, 192  # of the triangles that a sphere is made of
WORLD_MAP = (256, 4096)  # width of the map that the environment is sampled with, at least and at most


def settings(scene: description.Scene, guided: bool, threads: int) -> dict[str, object]:
    """Blender's settings by their path in its scene; what is not named here has its factory value.

    There are more for guiding, and one for next-event estimation, which builds of Cycles for users ignore.

    A path of n segments has n - 2 bounces in Cycles: the ray of the camera is none, and the last segment, to a light,
    is none either. Cycles plays Russian roulette from the segment `min_light_bounces` + 3 on.
    """
    integrator, film = scene.integrator, scene.film
    bounces = integrator.max_depth - 2
    roulette = MAX_BOUNCES if integrator.rr_depth is None else min(max(integrator.rr_depth - 3, 0), MAX_BOUNCES)
    cycles = {
        "device": "CPU",
        "samples": SEQUENCE,  # of the whole sequence, of which every render takes a part
        "use_sample_subset": True,
        "use_adaptive_sampling": False,
        "use_denoising": False,
        "time_limit": 0.0,
        "sampling_pattern": "TABULATED_SOBOL",
        "use_layer_samples": "IGNORE",
        "scrambling_distance": 1.0,
        "auto_scrambling_distance": False,
        "light_sampling_threshold": 0.0,
        "use_light_tree": True,
        "max_bounces": bounces,
        "diffuse_bounces": bounces,
        "glossy_bounces": bounces,
        "transmission_bounces": bounces,
        "volume_bounces": 0,
        "transparent_max_bounces": 0,
        "min_light_bounces": roulette,
        "min_transparent_bounces": 0,
        "caustics_reflective": True,
        "caustics_refractive": True,
        "blur_glossy": 0.0,
        "sample_clamp_direct": 0.0,
        "sample_clamp_indirect": 0.0,
        "use_fast_gi": False,
        "film_exposure": 1.0,
        "pixel_filter_type": "BOX",
        "filter_width": 1.0,
        "use_guiding": guided,
    }
    if guided:
        cycles |= {
            "use_surface_guiding": True,
            "use_volume_guiding": True,
            "guiding_training_samples": 128,
            "use_deterministic_guiding": True,  # or a seed would not give the same image again
        }
    render = {
        "engine": "CYCLES",
        "use_persistent_data": True,  # the scene is kept from one render to the next
        "threads_mode": "FIXED",
        "threads": threads,
        "resolution_percentage": 100,
        "pixel_aspect_x": max(film.pixel_aspect, 1.0),  # Blender's are at least 1
        "pixel_aspect_y": max(1.0 / film.pixel_aspect, 1.0),
        "use_border": False,
        "film_transparent": False,
        "use_motion_blur": False,
        "use_simplify": False,
        "use_texture_cache": False,  # which filters
        "use_compositing": False,
        "use_sequencer": False,
        "use_file_extension": False,
        "dither_intensity": 0.0,
        "image_settings.file_format": "OPEN_EXR",
        "image_settings.color_mode": "RGB",
        "image_settings.color_depth": "32",
        "image_settings.exr_codec": "NONE",
    }
    return {f"render.{key}": value for key, value in render.items()} | {
        f"cycles.{key}": value for key, value in cycles.items()
    }


def check_scene(scene: description.Scene) -> None:
    """Refuses what Cycles has not, without reading meshes and images.

    Raises:
        WavefrontError: Names the setting or the record.
    """
    _Writer(scene, read=False).describe(False, 1)


def write_scene(scene: description.Scene, folder: str | Path, guided: bool, threads: int) -> None:
    """Writes a scene.

    Args:
        scene: Valid records; file paths absolute.
        folder: An empty one.
        guided: With path guiding.
        threads: On the CPU.

    Raises:
        WavefrontError: The records say what Cycles cannot, or a file cannot be read or written.
    """
    folder, writer = Path(folder), _Writer(scene, read=True)
    result = writer.describe(guided, threads)
    for i, (shape, where) in enumerate(writer.shapes):
        mesh = sphere_mesh(shape, where) if isinstance(shape, description.Sphere) else tessellate(shape, where)
        if mesh.uvs is None and "ShaderNodeTangent" in json.dumps(writer.records[i]):
            raise SceneError("with cycles: UVs, where roughness depends on the direction", path=where)
        arrays = {name: getattr(mesh, name) for name in ("vertices", "faces", "normals", "uvs")}
        np.savez(folder / mesh_file(i), **{name: array for name, array in arrays.items() if array is not None})
    writer.images.write(folder)
    (folder / "scene.json").write_text(json.dumps(result), encoding="utf-8")


def mesh_file(index: int) -> str:
    return f"mesh{index}.npz"


def sphere_mesh(shape: description.Sphere, where: str = "") -> TriangleMesh:
    """A sphere as triangles of the same area, with its exact normals and UVs."""
    theta, phi = np.meshgrid(
        np.linspace(0.0, math.pi, SPHERE_ROWS + 1), np.linspace(0.0, 2.0 * math.pi, SPHERE_COLUMNS + 1), indexing="ij"
    )
    normals = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    uvs = np.stack([phi / (2.0 * math.pi), theta / math.pi], -1).reshape(-1, 2)
    first = (np.arange(SPHERE_ROWS)[:, None] * (SPHERE_COLUMNS + 1) + np.arange(SPHERE_COLUMNS)).ravel()
    below, right = SPHERE_COLUMNS + 1, 1
    upper = np.stack([first, first + below, first + below + right], -1)[:-SPHERE_COLUMNS]  # none has two poles
    lower = np.stack([first, first + below + right, first + right], -1)[SPHERE_COLUMNS:]
    faces = np.concatenate([upper, lower])
    a, b, c = (normals[faces[:, i]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    matrix = to_matrix(shape.to_world, f"{where}.to_world")
    outside = shape.radius * math.sqrt(4.0 * math.pi / area)
    vertices = (np.asarray(shape.center) + outside * normals) @ matrix[:3, :3].T + matrix[:3, 3]
    normals = normals @ np.linalg.inv(matrix[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    if is_mirror(matrix) != shape.flip_normals:
        faces = faces[:, ::-1]
    if shape.flip_normals:
        normals = -normals
    return TriangleMesh(
        vertices.astype(np.float32),
        np.ascontiguousarray(faces, np.int32),
        normals.astype(np.float32),
        uvs.astype(np.float32),
    )


class _Writer:
    """What ``scene.json`` says.

    Args:
        scene: Valid records.
        read: Whether files are read; without, the description is of no use but for its errors.

    Attributes:
        shapes: Those of the mesh files, with their places.
    """

    def __init__(self, scene: description.Scene, read: bool):
        self.scene, self.images, self.read = scene, Images(), read
        self.materials = Materials(scene, self.images)
        self.shapes: list[tuple[description.AnyShape, str]] = []
        self.records: list[dict] = []

    def describe(self, guided: bool, threads: int) -> dict:
        self._check_settings()
        objects = list(self._objects())
        lights, world = [], None
        for i, emitter in enumerate(self.scene.emitters):
            if isinstance(emitter, (description.Constant, description.Envmap)):
                world = self._world(emitter, f"emitters[{i}]")
            else:
                lights.append(_light(emitter, f"emitters[{i}]"))
        if not self.scene.integrator.nee:
            lights = []  # which nothing else finds
            for record in [*self.records, *filter(None, [world])]:
                record["sampling"] = "NONE"
        return {
            "settings": settings(self.scene, guided, threads),
            "camera": camera_record(self.scene.camera, self.scene.film),
            "materials": self.records,
            "meshes": [{"arrays": mesh_file(i), "material": i} for i in range(len(self.shapes))],
            "objects": objects,
            "lights": lights,
            "world": world,
            "images": list(self.images.makers),
        }

    def _check_settings(self) -> None:
        integrator, film, default = self.scene.integrator, self.scene.film, description.PathIntegrator()
        if type(integrator) is not type(default):
            raise WavefrontError("integrator.type: cycles has only path")
        if not LEAST_DEPTH <= integrator.max_depth <= LARGEST_DEPTH:
            raise WavefrontError(
                f"integrator.max_depth is {integrator.max_depth}; with cycles: {LEAST_DEPTH} to {LARGEST_DEPTH}"
            )
        for name in integrator.__struct_fields__:
            value, only = getattr(integrator, name), getattr(default, name)
            if name not in ("max_depth", "rr_depth", "spp", "nee", "guide") and value != only:
                raise WavefrontError(f"integrator.{name} is {json.dumps(value)}; with cycles: {json.dumps(only)}")
        if not isinstance(film.filter, description.BoxFilter):
            raise WavefrontError(f"film.filter.type is {type(film.filter).__struct_config__.tag}; with cycles: box")
        for name in ("width", "height"):
            if getattr(film, name) < LEAST_SIZE:
                raise WavefrontError(f"film.{name} is {getattr(film, name)}; with cycles: {LEAST_SIZE} or more")
        if film.crop is not None:
            raise WavefrontError("film.crop: with cycles: none")

    # --- shapes --------------------------------------------------------------------------------------------------

    def _objects(self) -> Iterator[dict]:
        """What is in the scene: the index of a mesh, and its transform where it is in the space of a group."""
        if resolve_medium(self.scene, self.scene.camera.medium) is not None:
            raise SceneError("with cycles: none", path="camera.medium")
        for i, shape in enumerate(self.scene.shapes):
            yield {"mesh": self._add(shape, f"shapes[{i}]"), "matrix": None}
        groups = {
            group.name: [self._add(shape, f"groups[{i}].shapes[{j}]") for j, shape in enumerate(group.shapes)]
            for i, group in enumerate(self.scene.groups)
        }
        for i, instance in enumerate(self.scene.instances):
            matrix = to_matrix(instance.to_world, f"instances[{i}].to_world").tolist()
            for mesh in groups[instance.group]:
                yield {"mesh": mesh, "matrix": matrix}

    def _add(self, shape: description.AnyShape, where: str) -> int:
        for name in ("interior", "exterior"):
            if resolve_medium(self.scene, getattr(shape, name)) is not None:
                raise SceneError("with cycles: no medium", path=f"{where}.{name}")
        self.records.append(self.materials.surface(shape, where))
        self.shapes.append((shape, where))
        return len(self.shapes) - 1

    # --- the environment -----------------------------------------------------------------------------------------

    def _world(self, emitter, where: str) -> dict:
        if isinstance(emitter, description.Constant):
            color, strength = color_and_strength(emitter.radiance)
            surface = node("Background", "Background", {"Color": color, "Strength": strength})
            return {"surface": surface, "sampling": "MANUAL", "resolution": WORLD_MAP[0]}
        u, _, vt = np.linalg.svd(to_matrix(emitter.to_world, f"{where}.to_world")[:3, :3])
        # The direction that a ray comes from; then the map's own axes, its longitude and colatitude.
        direction = node("TexCoord", "Generated")
        x, y, z = (dot(direction, axis) for axis in (u @ vt).T)
        longitude = math_node("ARCTAN2", x, math_node("MULTIPLY", z, -1.0))
        colatitude = math_node("ARCCOSINE", math_node("MINIMUM", math_node("MAXIMUM", y, -1.0), 1.0))
        pixels = environment(emitter, where) if self.read else np.zeros((2, 4, 3))
        height, width = pixels.shape[:2]
        name = self.images.add(f"{emitter!r}", lambda: pixels)
        # The first and the last row of pixels, whose centres are half a pixel inside of the image, are the poles.
        down = math_node("MULTIPLY_ADD", colatitude, (height - 1) / (height * math.pi), 0.5 / height)
        around = math_node("MULTIPLY", longitude, 0.5 / math.pi)
        vector = combine(around, math_node("SUBTRACT", 1.0, down), 0.0)
        color = node("TexImage", "Color", {"Vector": vector}, image=name, interpolation="Linear", extension="REPEAT")
        surface = node("Background", "Background", {"Color": color, "Strength": emitter.scale})
        least, most = WORLD_MAP
        resolution = min(max(1 << (width - 1).bit_length(), least), most)
        return {"surface": surface, "sampling": "MANUAL", "resolution": resolution}


def environment(emitter: description.Envmap, where: str) -> np.ndarray:
    """Linear pixels of an environment map without its scale, [h, w, 3]."""
    pixels = load_envmap(emitter.file, where, [])
    if pixels.dtype == np.uint8:
        pixels = srgb_to_linear(pixels / 255.0)
    return np.broadcast_to(pixels, (*pixels.shape[:2], 3)).astype(np.float32)


# --- lights --------------------------------------------------------------------------------------------------------


def _light(emitter, where: str) -> dict:
    """A light without extent.

    Of Blender's point light of energy E and no radius the intensity is E / (4 pi) in all directions; a sun of energy E
    makes the irradiance E. The nodes of a light multiply it.
    """
    properties = {"normalize": True, "use_shadow": True}
    if isinstance(emitter, description.Directional):
        color, strength = color_and_strength(emitter.irradiance)
        frame = look_at((0.0, 0.0, 0.0), emitter.direction, np.eye(3)[int(np.argmin(np.abs(emitter.direction)))])
        properties |= {"energy": strength, "angle": 0.0}
        return {"type": "SUN", "properties": properties, "matrix": frame.tolist(), "surface": emission(color)}
    if not isinstance(emitter, (description.Point, description.Spot)):
        kind = type(emitter).__struct_config__.tag
        more = "; tools.convert --bake-emitters makes an envmap of it" if kind == "sunsky" else ""
        raise SceneError(f"cycles has no emitter that is as {kind} is here{more}", path=where)
    frame = np.eye(4)
    frame[:3, 3] = emitter.position
    color, strength = color_and_strength(emitter.intensity)
    properties |= {"energy": strength * 4.0 * math.pi, "shadow_soft_size": 0.0}
    surface = emission(color)
    if isinstance(emitter, description.Spot):
        surface["inputs"]["Strength"] = _falloff(emitter)
    return {"type": "POINT", "properties": properties, "matrix": frame.tolist(), "surface": surface}


def _falloff(emitter: description.Spot) -> dict:
    """Share of the intensity of a spot in the direction that a ray leaves it."""
    axis = np.asarray(emitter.direction, np.float64) / np.linalg.norm(emitter.direction)
    cosine = dot(node("NewGeometry", "Incoming"), axis)
    angle = math_node("ARCCOSINE", math_node("MINIMUM", math_node("MAXIMUM", cosine, -1.0), 1.0))
    outer = math.radians(emitter.cutoff_angle)
    inner = 0.75 * outer if emitter.beam_width is None else math.radians(emitter.beam_width)
    if inner >= outer:
        return math_node("LESS_THAN", angle, outer)
    # (outer - angle) / (outer - inner), from 0 to 1
    share = math_node("MULTIPLY_ADD", angle, -1.0 / (outer - inner), outer / (outer - inner))
    return math_node("MINIMUM", math_node("MAXIMUM", share, 0.0), 1.0)


# --- the camera --------------------------------------------------------------------------------------------------


def camera_record(camera: description.Camera, film: description.Film) -> dict:
    """Blender's camera, which looks along its -Z as ours does: ``properties`` and ``matrix``.

    Raises:
        SceneError: It is spherical, or its transform is more than a rotation, a translation and a uniform scale.
    """
    if isinstance(camera, description.Spherical):
        raise SceneError("spherical; with cycles: perspective, thin_lens, orthographic", path="camera.type")
    matrix = to_matrix(camera.to_world, "camera.to_world")
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    rotation = matrix[:3, :3] / scale
    if scale < 0.0 or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5):
        raise SceneError("with cycles: rotation, translation and uniform scale", path="camera.to_world")
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rotation, matrix[:3, 3]
    properties = {
        "sensor_fit": "HORIZONTAL",
        "sensor_width": SENSOR_WIDTH,
        "clip_start": 1e-6,  # ours clips nothing
        "clip_end": 1e9,
        "dof.use_dof": False,
    }
    if isinstance(camera, description.Orthographic):
        properties |= {"type": "ORTHO", "ortho_scale": camera.width * scale}
        return {"properties": properties, "matrix": frame.tolist()}
    half_width, half_height = half_extent(camera, film)
    # The focal length is at least 1 mm in Blender, the sensor may be as large as one likes.
    lens = 0.5 * SENSOR_WIDTH / half_width
    if lens < 1.0:
        properties["sensor_width"], lens = SENSOR_WIDTH / lens, 1.0
    x, y = camera.principal_point_offset
    properties |= {"type": "PERSP", "lens": lens, "shift_x": x, "shift_y": -y * half_height / half_width}
    if isinstance(camera, description.ThinLens) and camera.aperture_radius > 0.0:
        properties |= {
            "dof.use_dof": True,
            "dof.focus_distance": camera.focus_distance * scale,
            "dof.aperture_fstop": 1e-3 * lens / (2.0 * camera.aperture_radius * scale),
            "dof.aperture_blades": 0,
            "dof.aperture_ratio": 1.0,
        }
    return {"properties": properties, "matrix": frame.tolist()}
