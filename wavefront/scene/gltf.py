"""glTF 2.0 scenes to scene records.

Meshes and embedded images stay in the file: the records name it with the index inside. Photometric units are taken
one to one: a lux is a W/m^2, a candela a W/sr, a candela per square metre of emission a W/(m^2 sr). So lights of all
kinds keep their ratio, and the image is in candela per square metre.

A large mesh that several nodes use becomes a group, which is stored once, and an instance per node.

A spot light falls linearly with the angle between its cones, where the standard recommends the square of a ramp in
the cosine: of the default cone (0 to 45 degrees) ours emits 2 % more.
"""

from __future__ import annotations

import math
import os
import warnings
from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np

from wavefront.errors import SceneError
from wavefront.scene import description
from wavefront.scene import gltf_document as gltf
from wavefront.scene.gltf_accessors import TRIANGLES
from wavefront.scene.gltf_graph import choose_scene, is_flat, world_nodes
from wavefront.scene.gltf_materials import Materials, unique_name
from wavefront.scene.lookup import unknown_name
from wavefront.scene.transforms import rows

FILM_SIZE = 512  # of the longer side, in pixels: a glTF file has no resolution
PARAMETERS = ("camera", "scene")
# Copies of a mesh with fewer triangles than this, all together, are faster to trace than instances, and small.
INSTANCED_TRIANGLES = 10_000
_POINTS_AND_LINES = "points and lines are left out"


def load(
    path: str | os.PathLike,
    warn: Callable[[str], object] | None = None,
    parameters: Mapping[str, str] | None = None,
) -> description.Scene:
    """Reads a glTF scene.

    Args:
        path: The ``.gltf`` or ``.glb`` file.
        warn: Called with a line of text for each warning; default: `warnings.warn`.
        parameters: ``camera`` is the name or the number of a camera of the file (default: the first in the scene), and
            ``scene`` that of a scene (default: the file's).

    Returns:
        The scene; file paths are absolute. Vertices and pixels are not read yet.

    Raises:
        SceneError: With the JSON path: a damaged file, an index out of range, a file that is missing, a required
            extension that is not supported.
    """
    if warn is None:
        warn = _default_warn
    parameters = dict(parameters or {})
    for name in parameters:
        if name not in PARAMETERS:
            raise SceneError(unknown_name("parameter", name, PARAMETERS), path)
    return _Importer(gltf.open_document(path), warn, parameters).scene()


def _default_warn(message):
    warnings.warn(message, stacklevel=3)


class _Importer:
    def __init__(self, document: gltf.Document, warn: Callable[[str], object], parameters: dict[str, str]):
        self.document, self.root = document, document.root
        self._said: set[str] = set()
        self._warn_once = warn
        self.parameters = parameters
        self.materials = Materials(document, self.warn)
        self.shape_names: set[str] = set()
        self.light_names: set[str] = set()
        self.shapes: list[description.Mesh] = []
        self.groups: dict[int, description.Group] = {}  # by the index of the mesh
        self.instances: list[description.Instance] = []
        self.emitters: list[description.Emitter] = []
        self.cameras: list[tuple[int, int, np.ndarray]] = []

    def warn(self, message: str) -> None:
        if message not in self._said:
            self._said.add(message)
            self._warn_once(message)

    def _note(self, where: str, message: str) -> None:
        self.warn(f"{self.document.path}: {where}: {message}")

    def scene(self) -> description.Scene:
        for i, name in enumerate(self.root.extensions_used):
            if name not in gltf.SUPPORTED_EXTENSIONS:
                self._note(f"extensionsUsed[{i}]", f"{name} is not supported and left out")
        if self.root.animations:
            self._note("animations", "animations are left out")
        scene = self._scene_index()
        nodes = list(world_nodes(self.document, scene))
        uses = Counter(self.root.nodes[index].mesh for index, _ in nodes)
        for index, matrix in nodes:
            node = self.root.nodes[index]
            if node.mesh is not None:
                self._mesh(index, node, matrix, uses[node.mesh])
            if node.extensions.light is not None:
                self._light(index, node.extensions.light.light, matrix)
            if node.camera is not None:
                self.cameras.append((index, node.camera, matrix))
        camera, film = self._camera()
        chosen = choose_scene(self.document, scene)
        return description.Scene(
            shapes=self.shapes,
            camera=camera,
            film=film,
            bsdfs=self.materials.bsdfs,
            emitters=self.emitters,
            groups=list(self.groups.values()),
            instances=self.instances,
            description="" if chosen is None else self.root.scenes[chosen].name,
        )

    def _scene_index(self) -> int | None:
        wanted = self.parameters.get("scene")
        return None if wanted is None else self._named("scene", wanted, self.root.scenes, range(len(self.root.scenes)))

    def _named(self, kind, wanted, items, allowed) -> int:
        """Index of the item of the name or number `wanted`; one of the indices `allowed`."""
        for i in allowed:
            if items[i].name == wanted:
                return i
        if wanted.isascii() and wanted.isdigit() and len(wanted) < 10 and int(wanted) in allowed:
            return int(wanted)
        names = [items[i].name or str(i) for i in allowed]
        raise SceneError(unknown_name(kind, wanted, names), self.document.path)

    # --- shapes -------------------------------------------------------------------------------------------------

    def _mesh(self, index, node, matrix, uses):
        mesh, place = self.document.item("meshes", node.mesh, f"nodes[{index}].mesh"), f"meshes[{node.mesh}]"
        if is_flat(matrix):
            self._note(f"nodes[{index}]", "is scaled to nothing; its mesh is left out")
            return
        if node.skin is not None:
            self._note(f"nodes[{index}].skin", "skins are not supported: the mesh is in its bind pose")
        if any(primitive.targets for primitive in mesh.primitives) and any(node.weights or mesh.weights):
            self._note(place, "morph targets are not supported: the mesh is in its base shape")
        group = self.groups.get(node.mesh)
        shapes = self._primitives(index, node) if group is None else []
        emits = any(shape.emitter is not None for shape in shapes)
        if group is None and shapes and not emits and (uses - 1) * self._triangles(mesh) >= INSTANCED_TRIANGLES:
            names = {other.name for other in self.groups.values()}
            group = description.Group(name=unique_name(mesh.name or place, names), shapes=shapes)
            self.groups[node.mesh] = group
        if group is None:
            for shape in shapes:
                shape.to_world = _transform(matrix)
            self.shapes += shapes
        else:
            self.instances.append(description.Instance(group=group.name, name=node.name, to_world=_transform(matrix)))

    def _triangles(self, mesh) -> int:
        """About how many triangles a mesh has."""
        primitives = [(p.indices, p.attributes.POSITION) for p in mesh.primitives]
        used = [position if indices is None else indices for indices, position in primitives]
        return sum(self.root.accessors[i].count for i in used if i is not None and i < len(self.root.accessors)) // 3

    def _primitives(self, index, node) -> list[description.Mesh]:
        """The mesh of a node, in its own space."""
        shapes = []
        for i, primitive in enumerate(self.root.meshes[node.mesh].primitives):
            where = f"meshes[{node.mesh}].primitives[{i}]"
            if primitive.mode < TRIANGLES:
                self._note(where, _POINTS_AND_LINES)
            elif primitive.attributes.POSITION is None:
                self._note(where, "has no POSITION and is left out")
            else:
                shapes.append(self._primitive(index, node, i))
        return shapes

    def _primitive(self, index, node, i) -> description.Mesh:
        mesh = self.root.meshes[node.mesh]
        primitive, where = mesh.primitives[i], f"meshes[{node.mesh}].primitives[{i}]"
        surface = self.materials.surface(primitive.material, f"{where}.material")
        if primitive.attributes.COLOR_0 is not None:
            self._note(where, "vertex colours are left out")
        return description.Mesh(
            name=unique_name(node.name or mesh.name or f"node {index}", self.shape_names),
            file=str(self.document.path),
            part=description.GltfPart(mesh=node.mesh, primitive=i, uv_set=surface.uv_set or 0),
            bsdf=surface.bsdf,
            emitter=surface.emitter,
        )

    # --- lights -------------------------------------------------------------------------------------------------

    def _light(self, index, light_index, matrix):
        place = f"extensions.KHR_lights_punctual.lights[{light_index}]"
        light = self.document.item("lights", light_index, f"nodes[{index}].extensions.KHR_lights_punctual.light")
        color = [light.intensity * value for value in light.color]
        color = color[0] if color[0] == color[1] == color[2] else color
        if light.range is not None:
            self._note(place, "range is left out: light falls with the square of the distance alone")
        name = unique_name(light.name or self.root.nodes[index].name or f"light {light_index}", self.light_names)
        position, direction = _vector(matrix[:3, 3]), _vector(-matrix[:3, 2])
        if light.type != "point" and not any(direction):
            raise self.document.error(f"nodes[{index}]", "its light has no direction: the node is scaled to nothing")
        if light.type == "directional":
            record = description.Directional(name=name, direction=direction, irradiance=color)
        elif light.type == "point":
            record = description.Point(name=name, position=position, intensity=color)
        else:
            inner, outer = light.spot.inner_cone_angle, light.spot.outer_cone_angle
            if inner > outer:
                message = f"innerConeAngle must be at most outerConeAngle; found {inner:g} and {outer:g}"
                raise self.document.error(f"{place}.spot", message)
            record = description.Spot(
                name=name,
                position=position,
                direction=direction,
                intensity=color,
                cutoff_angle=math.degrees(outer),
                beam_width=math.degrees(inner),
            )
        self.emitters.append(record)

    # --- camera -------------------------------------------------------------------------------------------------

    def _camera(self):
        if not self.cameras:
            if "camera" in self.parameters:
                raise SceneError(unknown_name("camera", self.parameters["camera"], ()), self.document.path)
            self._note("cameras", "the scene has no camera; one is put where it sees all meshes")
            return self._overview(), description.Film(width=FILM_SIZE, height=FILM_SIZE)
        for node, camera, _ in self.cameras:
            self.document.item("cameras", camera, f"nodes[{node}].camera")
        node, camera_index, matrix = self.cameras[0]
        wanted = self.parameters.get("camera")
        if wanted is not None:
            camera_index = self._named("camera", wanted, self.root.cameras, [camera for _, camera, _ in self.cameras])
            node, _, matrix = next(found for found in self.cameras if found[1] == camera_index)
        elif len(self.cameras) > 1:
            label = self.root.cameras[camera_index].name or camera_index
            self._note("cameras", f"the scene has {len(self.cameras)} cameras; the first is used, {label!r}")
        camera, place = self.root.cameras[camera_index], f"cameras[{camera_index}]"
        if getattr(camera, camera.type) is None:
            raise self.document.error(place, f"has no {camera.type}")
        if camera.type == "orthographic":
            size = camera.orthographic
            record = description.Orthographic(width=2.0 * size.xmag, to_world=self._frame(matrix, node))
            return record, _film(size.xmag / size.ymag)
        aspect = camera.perspective.aspect_ratio or 1.0
        record = description.Perspective(
            fov=math.degrees(camera.perspective.yfov), fov_axis="y", to_world=self._frame(matrix, node)
        )
        return record, _film(aspect)

    def _frame(self, matrix, node):
        """The transform of a camera: position and orientation, without scale."""
        if is_flat(matrix):
            raise self.document.error(f"nodes[{node}]", "its camera has no orientation: the node is scaled to nothing")
        lengths = np.linalg.norm(matrix[:3, :3], axis=0)
        frame = matrix.copy()
        frame[:3, :3] /= lengths
        return _transform(frame)

    def _overview(self) -> description.Perspective:
        """A camera that looks along -Z and sees the boxes of all meshes."""
        corners = []
        for shape in self.shapes:
            primitive = self.root.meshes[shape.part.mesh].primitives[shape.part.primitive]
            accessor = self.document.item("accessors", primitive.attributes.POSITION, "meshes")
            if accessor.min is None or accessor.max is None or len(accessor.min) != 3 or len(accessor.max) != 3:
                continue  # the standard wants them
            box = np.array([accessor.min, accessor.max])
            points = np.stack([box[[i & 1, i >> 1 & 1, i >> 2], range(3)] for i in range(8)])
            matrix = np.array(shape.to_world or np.eye(4), np.float64)
            corners.append(points @ matrix[:3, :3].T + matrix[:3, 3])
        fov = 40.0
        low, high = (-np.ones(3), np.ones(3)) if not corners else (
            np.min(np.concatenate(corners), axis=0), np.max(np.concatenate(corners), axis=0)
        )  # fmt: skip
        matrix = np.eye(4)
        radius = 0.5 * max(float(np.linalg.norm(high - low)), 1e-6)
        matrix[:3, 3] = 0.5 * (low + high)
        matrix[2, 3] += radius / math.sin(math.radians(0.5 * fov))
        return description.Perspective(fov=fov, fov_axis="smaller", to_world=_transform(matrix))


def _film(aspect: float) -> description.Film:
    """A film of the aspect ratio of a camera."""
    short = max(1, round(FILM_SIZE * min(aspect, 1.0 / aspect)))
    width, height = (FILM_SIZE, short) if aspect >= 1.0 else (short, FILM_SIZE)
    return description.Film(width=width, height=height)


def _transform(matrix):
    return [] if np.array_equal(matrix, np.eye(4)) else rows(matrix)


def _vector(values):
    return tuple(float(value) + 0.0 for value in values)
