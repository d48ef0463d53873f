"""From emitters to the table of lights on the device.

Every emissive triangle, every emissive sphere and every other emitter is one light, selected with a probability
in proportion to its power by an alias table: in constant time, however many triangles emit.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from wavefront.errors import SceneError
from wavefront.film import LUMINANCE
from wavefront.light import sky, tables
from wavefront.light.envmap import EnvironmentMap, cell_weights, quantized_cdf
from wavefront.scene import description
from wavefront.scene.images import load_image
from wavefront.scene.texture_upload import rgb
from wavefront.scene.transforms import to_matrix
from wavefront.texture import srgb_to_linear


class LightUpload:
    """Collects lights and their power.

    Args:
        scene: Valid records.
        emitters: Fields of an `EmitterRecord` for each emitter of the shapes; that of a constant environment is added.
        luminances: Mean luminance of each of these.
        device: Where to.
        notes: For what the user should know; added to.
    """

    def __init__(self, scene, emitters: list[dict], luminances: list[float], device: str, notes: list[str]):
        self.scene, self.emitters, self.luminances = scene, emitters, luminances
        self.device, self.notes = device, notes
        self.tables = tables.LightTables()
        self.tables.environment = -1
        self.points: list[tables.PointRecord] = []
        self.distant: list[tables.DistantRecord] = []
        self.count = 0
        self.columns: dict[str, list[np.ndarray]] = {"kind": [], "primitive": [], "emitter": [], "power": []}

    def run(self, meshes, spheres, bounds: np.ndarray) -> tuple[tables.LightTables, tuple[str, ...]]:
        """The tables but for `emitters`, and the names of the kinds of light in them.

        Args:
            meshes: (shape record, triangles, emitter or -1) of each mesh; the record gets its ``first_light``.
            spheres: (shape record, centre, radius, emitter or -1, ...) of each sphere, likewise.
            bounds: Lower and upper corner of the scene.
        """
        for record, mesh, emitter in meshes:
            if emitter >= 0:
                a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
                areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
                primitives = record["first_primitive"] + np.arange(len(areas))
                power = areas * np.pi * self.luminances[emitter] * (1 + record["two_sided"])
                record["first_light"] = self._add("triangle", power, emitter, primitives)
        for record, _, radius, emitter, *_ in spheres:
            if emitter >= 0:
                power = 4.0 * np.pi * radius**2 * np.pi * self.luminances[emitter] * (1 + record["two_sided"])
                record["first_light"] = self._add("sphere", power, emitter, record["first_primitive"])
        # What comes from afar has the power that enters the bounding sphere of the scene.
        cross_section = np.pi * (0.5 * float(np.linalg.norm(bounds[1] - bounds[0])) or 1.0) ** 2
        for i, emitter in enumerate(self.scene.emitters):
            if isinstance(emitter, description.Constant):
                self._constant(emitter, cross_section)
            elif isinstance(emitter, description.Envmap):
                self._envmap(emitter, f"emitters[{i}]", cross_section)
            elif isinstance(emitter, description.SunSky) and emitter.sky_scale > 0.0:
                pixels, matrix = baked_sky(emitter)
                self._map(pixels, emitter.sky_scale, matrix, cross_section)
            elif isinstance(emitter, (description.Point, description.Spot)):
                self._point(emitter)
            elif isinstance(emitter, description.Directional):
                self._distant("directional", emitter.direction, 0.0, rgb(emitter.irradiance), cross_section)
        self.tables.first_sun = self.count
        for emitter in self.scene.emitters:
            if isinstance(emitter, description.Sun):
                self._sun(emitter, cross_section)
            elif isinstance(emitter, description.SunSky) and emitter.sun_scale > 0.0:
                self._sun(sun_disc(emitter), cross_section)
        self.tables.sun_count = self.count - self.tables.first_sun
        self.tables.points = wp.array(self.points, dtype=tables.PointRecord, device=self.device)
        self.tables.distant = wp.array(self.distant, dtype=tables.DistantRecord, device=self.device)
        return self._finish([record for record, *_ in [*meshes, *spheres]])

    def _add(self, kind: str, power, emitter: int, primitive=-1) -> int:
        """Adds a light for each entry of `power` and returns the index of the first."""
        first, n = self.count, np.size(power)
        for name, value in (
            ("kind", tables.KINDS[kind]), ("primitive", primitive), ("emitter", emitter), ("power", power),
        ):  # fmt: skip
            self.columns[name].append(np.broadcast_to(value, n))
        self.count += n
        return first

    def _finish(self, shapes):
        columns = {name: np.concatenate(parts) if parts else np.zeros(0) for name, parts in self.columns.items()}
        if not columns["power"].sum() > 0.0:  # black emitters: nothing to sample, and nothing to find
            for record in shapes:
                record["first_light"] = -1
            self.tables.environment, self.tables.sun_count, self.count = -1, 0, 0
        host = np.zeros(self.count, dtype=tables.Light.numpy_dtype())
        if self.count:
            for name in ("kind", "primitive", "emitter"):
                host[name] = columns[name]
            host["pmf"], host["alias_threshold"], host["alias"] = tables.build_alias_table(columns["power"])
        self.tables.lights = wp.array(host, dtype=tables.Light, device=self.device)
        names = {index: name for name, index in tables.KINDS.items()}
        return self.tables, tuple(sorted(names[kind] for kind in np.unique(host["kind"])))

    # --- environments ------------------------------------------------------------------------------------------------

    def _constant(self, emitter: description.Constant, cross_section: float) -> None:
        radiance = rgb(emitter.radiance)
        self.emitters.append({"radiance": radiance, "radiance_texture": -1})
        power = cross_section * 4.0 * np.pi * _luminance(radiance)
        self.tables.environment = self._add("constant", power, len(self.emitters) - 1)

    def _envmap(self, emitter: description.Envmap, where: str, cross_section: float) -> None:
        pixels = load_envmap(emitter.file, where, self.notes)
        matrix = to_matrix(emitter.to_world, f"{where}.to_world")[:3, :3]
        self._map(pixels, emitter.scale, matrix, cross_section)

    def _map(self, pixels: np.ndarray, scale: float, matrix: np.ndarray, cross_section: float) -> None:
        """The environment map with these pixels, in the orientation of the similarity `matrix`."""
        env = EnvironmentMap()
        env.height, env.width, env.channels = pixels.shape
        env.scale = scale
        u, _, vt = np.linalg.svd(matrix)  # a uniform scale has no meaning, and roundings are taken off
        env.to_world = wp.mat33((u @ vt).astype(np.float32))
        storage = {np.dtype(np.uint8): "bytes", np.dtype(np.float16): "halves"}.get(pixels.dtype, "floats")
        setattr(env, storage, wp.array(pixels.ravel(), device=self.device))
        if storage == "bytes":
            linear = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
            env.srgb_to_linear = wp.array(linear, dtype=wp.float32, device=self.device)
            pixels = linear[pixels]
        means, solid_angles = cell_weights(pixels)
        row_sums = means.sum(axis=1) * solid_angles
        if self.scene.integrator.nee:
            env.rows = wp.array(quantized_cdf(row_sums), dtype=wp.float32, device=self.device)
            env.columns = wp.array(quantized_cdf(means), dtype=wp.float32, device=self.device)
        self.tables.envmap = env
        self.tables.environment = self._add(f"envmap_{storage}", cross_section * scale * row_sums.sum(), -1)

    # --- lights without extent, and suns -----------------------------------------------------------------------------

    def _point(self, emitter: description.Point | description.Spot) -> None:
        record = tables.PointRecord()
        intensity = rgb(emitter.intensity)
        record.position, record.intensity = wp.vec3(*emitter.position), wp.vec3(*intensity)
        power = 4.0 * np.pi * _luminance(intensity)
        if isinstance(emitter, description.Spot):
            record.direction = wp.vec3(*_unit(emitter.direction))
            outer = np.radians(emitter.cutoff_angle)
            inner = 0.75 * outer if emitter.beam_width is None else np.radians(emitter.beam_width)
            record.cutoff_angle, record.beam_width = outer, inner
            # The full cone, and half of what lies around it: enough for a selection.
            power *= 0.5 * (1.0 - 0.5 * (np.cos(inner) + np.cos(outer)))
        self.points.append(record)
        self._add("spot" if isinstance(emitter, description.Spot) else "point", power, len(self.points) - 1)

    def _distant(self, kind: str, direction, one_minus_cos: float, emitted: np.ndarray, power: float) -> None:
        """`power` is that of a luminance of 1 in `emitted`."""
        record = tables.DistantRecord()
        record.direction, record.emitted = wp.vec3(*-_unit(direction)), wp.vec3(*emitted)
        record.one_minus_cos = one_minus_cos
        self.distant.append(record)
        self._add(kind, power * _luminance(emitted), len(self.distant) - 1)

    def _sun(self, emitter: description.Sun, cross_section: float) -> None:
        half = np.radians(0.5 * emitter.angle)
        # Irradiance of a disc of radiance 1: the integral of the cosine over the cone, pi sin^2(angle).
        projected = np.pi * np.sin(2.0 * half) ** 2
        if emitter.radiance is not None:
            radiance = rgb(emitter.radiance)
        else:
            radiance = rgb(1.0 if emitter.irradiance is None else emitter.irradiance) / projected
        self._distant("sun", emitter.direction, 2.0 * np.sin(half) ** 2, radiance, cross_section * projected)


def baked_sky(emitter: description.SunSky) -> tuple[np.ndarray, np.ndarray]:
    """The sky as `sky.bake_sky` gives it, without its scale."""
    return sky.bake_sky(emitter.turbidity, -_unit(emitter.direction), _unit(emitter.up), emitter.resolution)


def sun_disc(emitter: description.SunSky) -> description.Sun:
    """The sun of a sky as a record of its own."""
    cosine = -_unit(emitter.direction) @ _unit(emitter.up)
    radiance = sky.sun_radiance(emitter.turbidity, np.arccos(np.clip(cosine, 0.0, 1.0)))
    irradiance = emitter.sun_scale * np.pi * np.sin(np.radians(sky.SUN_ANGLE)) ** 2 * radiance
    return description.Sun(direction=emitter.direction, angle=emitter.sun_angle, irradiance=irradiance.tolist())


def _unit(vector) -> np.ndarray:
    return np.asarray(vector, np.float64) / np.linalg.norm(vector)


def load_envmap(file: str, where: str, notes: list[str]) -> np.ndarray:
    """Pixels of an environment map, [height, width, 1 or 3], uint8, float16 or float32, finite and not negative."""
    where = f"{where}.file"
    pixels = load_image(file, where)
    height, width, _ = pixels.shape
    if height < 2:
        raise SceneError(f"{file}: an environment map needs at least 2 rows, the poles; found {height}", path=where)
    if pixels.size > np.iinfo(np.int32).max:
        raise SceneError(f"{file}: an environment map of {width}x{height} pixels is too large", path=where)
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype == np.uint16:
        return srgb_to_linear(pixels / 65535.0).astype(np.float32)
    wrong = ~np.isfinite(pixels)
    if wrong.any():
        y, x, _ = np.argwhere(wrong)[0]
        raise SceneError(f"{file}: pixel ({x}, {y}) is not finite", path=where)
    negative = (pixels < 0.0).any(axis=2)
    if negative.any():
        notes.append(f"{where}: {negative.sum()} pixels of {file} have negative radiance, which is taken as 0")
        pixels = np.maximum(pixels, 0)
    return pixels


def _luminance(color: np.ndarray) -> float:
    return float(color @ np.asarray(LUMINANCE))
