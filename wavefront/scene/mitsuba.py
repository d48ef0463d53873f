"""Mitsuba XML scenes (dialects 0.5, 0.6, 2 and 3) to scene records.

What the records cannot say is an error that names the element and its line; what does not change the image is a warning
or is left out. Where the dialects differ in meaning, Mitsuba 3.9 decides: it is what images are compared with.

Choices: unlimited `max_depth` (-1) becomes 1000. Integrators that compute the same image another way (bdpt, sppm, ...)
become `path` with a warning, and `direct` becomes `path` of depth 2. Filters that the records lack become a Gaussian.
Media absorb whatever the integrator. Samplers of low discrepancy and stratified ones become `sobol`.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from wavefront.errors import SceneError
from wavefront.scene import description, transforms
from wavefront.scene.meshes import has_file_normals
from wavefront.scene.mitsuba_emitters import Emitters
from wavefront.scene.mitsuba_materials import Materials
from wavefront.scene.mitsuba_media import Media
from wavefront.scene.mitsuba_xml import Document, Plugin, read, rows, world_matrix

UNLIMITED_DEPTH = 1000
# Mitsuba's camera looks along +Z with +X to the left; ours along -Z with +X to the right.
CAMERA_FRAME = np.diag([-1.0, 1.0, -1.0, 1.0])
_FAR_CLIP = 1e4  # what Mitsuba's thin lens focuses on by default
_DIAGONAL_35MM = 43.266615300557  # millimetres: the film that a focal length refers to

_INTEGRATORS_OF_ANOTHER_IMAGE = ("ao", "aov", "depth", "field", "irrcache", "moment", "multichannel", "stokes", "vaov")
_NESTED = ("bsdf", "emitter")
_SOBOL = ("ldsampler", "sobol")  # samplers of scrambled Sobol points
_STRATIFIED = ("halton", "hammersley", "multijitter", "orthogonal", "stratified")


def load(
    path: str | os.PathLike,
    warn: Callable[[str], object] | None = None,
    parameters: Mapping[str, object] | None = None,
) -> description.Scene:
    """Reads a Mitsuba scene.

    Args:
        path: The XML file.
        warn: Called with a line of text for each warning; default: `warnings.warn`.
        parameters: Values for ``$name`` in the file; they win over its defaults.

    Returns:
        The scene; file paths are absolute. Mesh and image files are known to exist, but are not read.

    Raises:
        SceneError: With file and line: bad XML, a missing file, anything that is not supported.
    """
    if warn is None:
        warn = _default_warn
    try:
        return _Importer(read(Path(path), parameters or {}), warn).scene()
    except RecursionError:
        raise SceneError("references are nested too deeply", path) from None


def _default_warn(message):
    warnings.warn(message, stacklevel=3)


class _Importer:
    def __init__(self, document: Document, warn: Callable[[str], object]):
        self.document, self.warn = document, warn
        self.materials = Materials(document, warn)
        self.media = Media(document, warn)
        self.emitters = Emitters(document, warn, self.materials)
        self.groups: dict[int, description.Group] = {}  # by the id() of their plugin, in the order of their first use

    def scene(self):
        root = self.document.scene
        if self.document.version >= (4,):
            self.warn(f"{root.where()}: version {root.element.attributes['version']} is read as version 3")
        groups: dict[str, list[Plugin]] = {}
        for _, plugin in root.children:
            if isinstance(plugin, Plugin):
                groups.setdefault(plugin.tag, []).append(plugin)
        for tag in groups:
            if tag not in ("bsdf", "texture", "shape", "emitter", "sensor", "integrator", "medium", "sampler", "film"):
                raise groups[tag][0].error(f"{groups[tag][0].label()} is not supported at the top level of a scene")
        root.finish(*groups)
        if len(groups.get("integrator", [])) > 1:
            raise groups["integrator"][1].error("a scene has one integrator")
        camera, film, sampling = self._sensor(groups.get("sensor", []))
        integrator = self._integrator(groups.get("integrator", [None])[0], sampling)
        shapes, instances = [], []
        for plugin in groups.get("shape", []):
            if plugin.type == "instance":
                instances.append(self._instance(plugin))
            elif plugin.type != "shapegroup":
                shapes.append(self._shape(plugin))
        emitters = [self.emitters.emitter(plugin) for plugin in groups.get("emitter", [])]
        self.materials.unused()
        media = self.media.records()
        if self.media.found and "integrator" in groups and not groups["integrator"][0].type.startswith("volpath"):
            plugin = groups["integrator"][0]
            self.warn(f"{plugin.where()}: {plugin.label()} of Mitsuba leaves media out; here they absorb")
        return description.Scene(
            shapes=shapes,
            groups=list(self.groups.values()),
            instances=instances,
            camera=camera,
            film=film,
            integrator=integrator,
            textures=self.materials.records("texture"),
            bsdfs=self.materials.records("bsdf"),
            media=media,
            emitters=emitters,
        )

    # --- sensor, film, integrator --------------------------------------------------------------------------------

    def _sensor(self, sensors):
        if not sensors:
            raise self.document.scene.error("the scene has no sensor")
        if len(sensors) > 1:
            self.warn(f"{sensors[1].where()}: the scene has {len(sensors)} sensors; the first is used")
        plugin = sensors[0]
        kinds = {"perspective": self._perspective, "thinlens": self._thin_lens, "orthographic": self._orthographic}
        if plugin.type not in kinds:
            raise plugin.error(f"{plugin.label()} is not supported; supported: {', '.join(kinds)}")
        camera = kinds[plugin.type](plugin)
        camera.medium = next(iter(self.media.of(plugin).values()), None)
        for name in ("near_clip", "far_clip"):
            if plugin.get(name) is not None:
                self.warn(f"{plugin.get(name).where()}: {name} is left out; nothing is clipped")
        plugin.ignore("focus_distance", "shutter_open", "shutter_close", "near_clip", "far_clip")
        sampling = self._sampler(plugin)
        film = self._film(plugin)
        plugin.finish("film", "sampler", "medium")
        return camera, film, sampling

    def _perspective(self, plugin):
        offset = tuple(plugin.number(f"principal_point_offset_{axis}", 0.0) for axis in "xy")
        return description.Perspective(principal_point_offset=offset, **self._view(plugin))

    def _thin_lens(self, plugin):
        radius = plugin.number("aperture_radius")
        if radius is None:
            raise plugin.error(f"{plugin.label()} needs an aperture_radius")
        if radius < 0.0:
            raise plugin.get("aperture_radius").error(f"aperture_radius must be at least 0; found {radius:g}")
        focus = self._positive(plugin, "focus_distance", plugin.number("far_clip", _FAR_CLIP))
        return description.ThinLens(aperture_radius=radius, focus_distance=focus, **self._view(plugin))

    def _orthographic(self, plugin):
        return description.Orthographic(to_world=rows(world_matrix(plugin) @ CAMERA_FRAME))

    def _view(self, plugin):
        """The fields of a perspective camera: field of view and place."""
        axis = plugin.string("fov_axis", "x", ("x", "y", "diagonal", "smaller", "larger"))
        fov = plugin.number("fov")
        if fov is None:
            axis, fov = "diagonal", self._focal_fov(plugin)
        elif plugin.has("focal_length"):
            raise plugin.error("a sensor has either fov or focal_length")
        if not 0.0 < fov < 180.0:
            raise plugin.error(f"fov must be between 0 and 180 degrees; found {fov:g}")
        return {"fov": fov, "fov_axis": axis, "to_world": rows(world_matrix(plugin) @ CAMERA_FRAME)}

    def _focal_fov(self, plugin):
        text = plugin.string("focal_length", "50mm").strip()
        number = text.removesuffix("mm")
        try:
            focal = float(number)
        except ValueError:
            focal = -1.0
        if not (focal > 0.0 and math.isfinite(focal)):
            raise plugin.get("focal_length").error(f"focal_length {text!r} is not a length such as 50mm")
        return math.degrees(2.0 * math.atan(_DIAGONAL_35MM / (2.0 * focal)))

    def _sampler(self, sensor):
        """The fields of the integrator that a sampler has."""
        samplers = sensor.objects("sampler")
        if not samplers:
            return {"spp": 4}
        sampler = samplers[0]
        spp = sampler.integer("sample_count", 4)
        if not 1 <= spp < 2**31:
            raise sampler.error(f"sample_count must be at least 1; found {spp}")
        ours = "sobol" if sampler.type in (*_SOBOL, *_STRATIFIED) else "independent"
        if sampler.type not in ("independent", *_SOBOL):
            self.warn(f"{sampler.where()}: {sampler.label()} is taken as {ours!r}")
        if sampler.type != "independent":
            sampler.ignore(*sampler.properties)
        sampler.ignore("seed", "jitter")
        sampler.finish()
        return {"spp": spp, "sampler": ours}

    def _film(self, sensor):
        films = sensor.objects("film")
        if not films:
            return description.Film(width=768, height=576, filter=description.GaussianFilter())
        film = films[0]
        if film.type not in ("hdrfilm", "ldrfilm"):
            raise film.error(f"{film.label()} is not supported; supported: hdrfilm, ldrfilm")
        width, height = film.integer("width", 768), film.integer("height", 576)
        for name, value in (("width", width), ("height", height)):
            if not 1 <= value <= 65536:
                raise film.get(name).error(f"{name} must be from 1 to 65536; found {value}")
        crop = self._crop(film, width, height)
        # how the file is written, not what is in the image
        film.ignore(
            "file_format", "pixel_format", "component_format", "banner", "gamma", "exposure", "tonemap_method", "key",
            "burn", "high_quality_edges", "attach_log", "compensate", "sample_border", "channel_names",
        )  # fmt: skip
        filters = film.objects("rfilter")
        record = self._filter(filters[0]) if filters else description.GaussianFilter()
        film.finish("rfilter")
        return description.Film(width=width, height=height, crop=crop, filter=record)

    def _crop(self, film, width, height):
        keys = {"x": "crop_offset_x", "y": "crop_offset_y", "width": "crop_width", "height": "crop_height"}
        whole = {"x": 0, "y": 0, "width": width, "height": height}
        window = {key: film.integer(name, whole[key]) for key, name in keys.items()}
        for corner, side in (("x", "width"), ("y", "height")):
            if window[corner] < 0 or window[side] < 1 or window[corner] + window[side] > whole[side]:
                given = keys[corner] if film.has(keys[corner]) and not film.has(keys[side]) else keys[side]
                found = f"{window[side]} from {window[corner]} on"
                raise film.get(given).error(f"the crop window must lie in the {side} of {whole[side]}; found {found}")
        return None if window == whole else description.Crop(**window)

    def _filter(self, plugin):
        if plugin.type == "box":
            if plugin.number("radius", 0.5) != 0.5:
                raise plugin.get("radius").error("a box filter of another radius than 0.5 is not supported")
            record = description.BoxFilter()
        elif plugin.type == "tent":
            record = description.TentFilter(radius=self._positive(plugin, "radius", 1.0))
        elif plugin.type == "gaussian":
            record = description.GaussianFilter(stddev=self._positive(plugin, "stddev", 0.5))
        else:
            self.warn(f"{plugin.where()}: {plugin.label()} is not supported; a Gaussian filter is used")
            return description.GaussianFilter()
        plugin.finish()
        return record

    def _positive(self, plugin, name, default):
        value = plugin.number(name, default)
        if not value > 0.0:
            raise plugin.get(name).error(f"{name} must be greater than 0; found {value:g}")
        return value

    def _integrator(self, plugin, sampling):
        if plugin is None:
            self.warn(f"{self.document.path}: the scene has no integrator; 'path' of depth {UNLIMITED_DEPTH} is used")
            return description.PathIntegrator(max_depth=UNLIMITED_DEPTH, **sampling)
        if plugin.type in _INTEGRATORS_OF_ANOTHER_IMAGE:
            raise plugin.error(f"{plugin.label()} is not supported; supported: path, direct")
        if plugin.type == "direct":
            plugin.ignore("shading_samples", "emitter_samples", "bsdf_samples")
            max_depth, rr_depth = 2, None
        else:
            max_depth, rr_depth = plugin.integer("max_depth", -1), plugin.integer("rr_depth", 5)
        if plugin.boolean("hide_emitters"):
            raise plugin.get("hide_emitters").error("hide_emitters is not supported")
        if plugin.boolean("strict_normals"):
            raise plugin.get("strict_normals").error("strict_normals is not supported")
        plugin.ignore("samples_per_pass", "block_size", "timeout")
        if plugin.type in ("path", "direct"):
            plugin.finish()
        else:
            self.warn(f"{plugin.where()}: {plugin.label()} is taken as 'path'")
        if max_depth == -1:
            self.warn(f"{plugin.where()}: unlimited max_depth is taken as {UNLIMITED_DEPTH}")
            max_depth = UNLIMITED_DEPTH
        if not 1 <= max_depth <= 1_000_000:
            raise plugin.get("max_depth").error(f"max_depth must be -1 or from 1 to 1000000; found {max_depth}")
        if rr_depth is not None and rr_depth < 1:
            raise plugin.get("rr_depth").error(f"rr_depth must be at least 1; found {rr_depth}")
        return description.PathIntegrator(max_depth=max_depth, rr_depth=rr_depth, **sampling)

    # --- shapes -------------------------------------------------------------------------------------------------

    def _shape(self, plugin):
        kinds = {
            "obj": self._mesh,
            "ply": self._mesh,
            "rectangle": self._primitive(description.Rectangle),
            "cube": self._primitive(description.Cube),
            "disk": self._primitive(description.Disk),
            "sphere": self._sphere,
        }
        if plugin.type not in kinds:
            supported = ", ".join([*kinds, "shapegroup", "instance"])
            raise plugin.error(f"{plugin.label()} is not supported; supported: {supported}")
        common = {"name": plugin.id, "flip_normals": plugin.boolean("flip_normals")}
        matrix = world_matrix(plugin)
        if not np.array_equal(matrix, np.eye(4)):
            common["to_world"] = rows(matrix)
        bsdfs, emitters = plugin.objects("bsdf"), plugin.objects("emitter")
        for found in (bsdfs, emitters):
            if len(found) > 1:
                raise found[1].error(f"a shape has one {found[1].tag}; found {len(found)}")
        if emitters:
            common["emitter"] = self.emitters.area(emitters[0])
            # an emitter without a BSDF reflects nothing in Mitsuba 3
            common["bsdf"] = description.Diffuse(reflectance=0.0)
        if bsdfs:
            common["bsdf"] = self.materials.bsdf(bsdfs[0])
        common |= self.media.of(plugin, "interior", "exterior")
        record = kinds[plugin.type](plugin, common, transforms.is_mirror(matrix))
        plugin.finish(*_NESTED)
        return record

    def _instance(self, plugin):
        groups = plugin.objects("shape")
        if len(groups) != 1 or groups[0].type != "shapegroup":
            found = ", ".join(group.label() for group in groups) or "none"
            raise plugin.error(f"an instance needs one shapegroup; found {found}")
        matrix = world_matrix(plugin)
        plugin.finish("shape")
        to_world = [] if np.array_equal(matrix, np.eye(4)) else rows(matrix)
        return description.Instance(group=self._group(groups[0]).name, name=plugin.id, to_world=to_world)

    def _group(self, plugin):
        if id(plugin) not in self.groups:
            if plugin.get("to_world") is not None:
                raise plugin.get("to_world").error("a shapegroup has no to_world; its instances have")
            children = plugin.objects("shape")
            if not children:
                raise plugin.error("the shapegroup is empty")
            for child in children:
                if child.type in ("shapegroup", "instance"):
                    raise child.error("a shapegroup cannot hold instances or other groups")
            shapes = [self._shape(child) for child in children]
            for child, shape in zip(children, shapes, strict=True):
                if shape.emitter is not None:
                    raise child.error("a shape of a shapegroup cannot emit: lights are not instanced")
            plugin.finish("shape")
            name = plugin.id or f"group {len(self.groups) + 1}"
            while any(group.name == name for group in self.groups.values()):
                name += "'"
            self.groups[id(plugin)] = description.Group(name=name, shapes=shapes)
        return self.groups[id(plugin)]

    def _primitive(self, record):
        def convert(plugin, common, mirrored):
            plugin.ignore("face_normals")  # they are flat
            return record(**common)

        return convert

    def _sphere(self, plugin, common, mirrored):
        radius = self._positive(plugin, "radius", 1.0)
        center = plugin.vector("center", (0.0, 0.0, 0.0))
        # under a mirroring transform Mitsuba turns a sphere inside out; our records do not
        common["flip_normals"] ^= mirrored
        return description.Sphere(radius=radius, center=center, **common)

    def _mesh(self, plugin, common, mirrored):
        element = plugin.get("filename")
        if element is None:
            raise plugin.error(f"{plugin.label()} needs a filename")
        file = self.document.find(plugin.string("filename", ""), element)
        flat = plugin.boolean("face_normals")
        flip_v = plugin.boolean("flip_tex_coords", plugin.type == "obj")
        plugin.ignore("collapse", "srgb")
        for name in ("max_smooth_angle", "shape_index"):
            if plugin.get(name) is not None:
                raise plugin.get(name).error(f"{name} is not supported")
        is_obj = file.suffix.lower() == ".obj"
        if is_obj != (plugin.type == "obj") or file.suffix.lower() not in (".obj", ".ply"):
            raise element.error(f"{plugin.label()} needs a .{plugin.type} file; found {file.name!r}")
        if mirrored and (flat or not has_file_normals(str(file), f"line {element.line}")):
            # there the winding decides which side is outside, and mirroring turns it; our records keep the side
            common["flip_normals"] ^= True
        return description.Mesh(
            file=str(file),
            face_normals=flat,
            smooth_normals=not flat,
            flip_v=None if flip_v == is_obj else flip_v,
            **common,
        )
