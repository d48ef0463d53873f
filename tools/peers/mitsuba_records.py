"""Our scene records as a dictionary for `mitsuba.load_dict`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wavefront.errors import WavefrontError
from wavefront.scene import description
from wavefront.scene.lookup import resolve_bsdf, resolve_medium, resolve_texture, roughness, walk
from wavefront.scene.meshes import tessellate, write_ply
from wavefront.scene.transforms import is_mirror, to_matrix

# Mitsuba's camera looks along +Z with +X to the left; ours along -Z with +X to the right.
CAMERA_FRAME = np.diag([-1.0, 1.0, -1.0, 1.0])
NEVER = 1 << 30  # rr_depth where there is no Russian roulette


def from_records(scene: description.Scene, folder: str | Path) -> dict:
    """The scene as Mitsuba's dictionary, in the current variant of Mitsuba.

    `integrator.nee` is left out: Mitsuba's `path` always samples lights, which changes the noise but not the mean.

    Args:
        scene: Valid records (see `wavefront.scene.validate`); file paths absolute.
        folder: Where meshes are written as PLY. They must exist until the dictionary is loaded.

    Raises:
        WavefrontError: The records say what Mitsuba cannot.
    """
    return _Writer(scene, Path(folder)).scene_dict()


def integrator_of(scene: description.Scene) -> str:
    """The integrator of Mitsuba that renders the scene as ours does: `path` leaves media out, `volpath` is slower."""
    return "volpath" if any(isinstance(record, description.Homogeneous) for _, record in walk(scene)) else "path"


class _Writer:
    def __init__(self, scene: description.Scene, folder: Path):
        import mitsuba  # only here: a peer that need not be installed

        self.mi, self.scene, self.folder = mitsuba, scene, folder

    def scene_dict(self):
        integrator = self.scene.integrator
        result = {
            "type": "scene",
            "integrator": {
                "type": integrator_of(self.scene),
                "max_depth": integrator.max_depth,
                "rr_depth": NEVER if integrator.rr_depth is None else integrator.rr_depth,
            },
            "sensor": self._camera(),
        }
        for i, emitter in enumerate(self.scene.emitters):
            result[f"emitter_{i}"] = self._emitter(emitter, f"emitters[{i}]")
        for i, shape in enumerate(self.scene.shapes):
            result[f"shape_{i}"] = self._shape(f"shape_{i}", shape, f"shapes[{i}]")
        names = {group.name: f"group_{i}" for i, group in enumerate(self.scene.groups)}
        for i, group in enumerate(self.scene.groups):
            result[f"group_{i}"] = {"type": "shapegroup"} | {
                f"shape_{j}": self._shape(f"group_{i}_shape_{j}", shape, f"groups[{i}].shapes[{j}]")
                for j, shape in enumerate(group.shapes)
            }
        for i, instance in enumerate(self.scene.instances):
            result[f"instance_{i}"] = {
                "type": "instance",
                "group": {"type": "ref", "id": names[instance.group]},
                "to_world": self._transform(to_matrix(instance.to_world, f"instances[{i}].to_world")),
            }
        return result

    def _camera(self):
        camera, film = self.scene.camera, self.scene.film
        if film.pixel_aspect != 1.0:
            raise WavefrontError("film.pixel_aspect: Mitsuba has square pixels")
        kind = type(film.filter).__struct_config__.tag
        rfilter = {"type": kind}
        rfilter |= {name: getattr(film.filter, name) for name in film.filter.__struct_fields__}
        window = film.window
        frame = CAMERA_FRAME
        result = self._media(medium=camera.medium)
        if isinstance(camera, description.Spherical):
            raise WavefrontError("camera.type: spherical; Mitsuba has no such sensor")
        if isinstance(camera, description.Orthographic):
            result |= {"type": "orthographic"}
            frame = CAMERA_FRAME @ np.diag([camera.width / 2.0, camera.width / 2.0, 1.0, 1.0])
        else:
            result |= {"type": "perspective", "fov": camera.fov, "fov_axis": camera.fov_axis}
            x, y = camera.principal_point_offset
            if isinstance(camera, description.ThinLens):
                if x or y:
                    raise WavefrontError("camera.principal_point_offset: Mitsuba's thin lens has none")
                lens = {"aperture_radius": camera.aperture_radius, "focus_distance": camera.focus_distance}
                result |= {"type": "thinlens", **lens}
            else:
                result |= {"principal_point_offset_x": x, "principal_point_offset_y": y}
        return result | {
            "near_clip": 1e-3,  # ours clips nothing
            "far_clip": 1e5,
            "to_world": self._transform(to_matrix(camera.to_world, "camera.to_world") @ frame),
            "film": {
                "type": "hdrfilm",
                "width": film.width,
                "height": film.height,
                "crop_offset_x": window.x,
                "crop_offset_y": window.y,
                "crop_width": window.width,
                "crop_height": window.height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": rfilter,
            },
            "sampler": {"type": "independent", "sample_count": self.scene.integrator.spp},
        }

    def _transform(self, matrix):
        return self.mi.ScalarTransform4f(np.asarray(matrix, np.float64).tolist())

    # --- emitters ------------------------------------------------------------------------------------------------

    def _emitter(self, emitter, where):
        if isinstance(emitter, description.Constant):
            return {"type": "constant", "radiance": _colour(emitter.radiance)}
        if isinstance(emitter, description.Directional):
            return {
                "type": "directional",
                "direction": list(emitter.direction),
                "irradiance": _colour(emitter.irradiance),
            }
        if isinstance(emitter, description.Point):
            return {"type": "point", "position": list(emitter.position), "intensity": _colour(emitter.intensity)}
        if isinstance(emitter, description.Spot):
            target = np.add(emitter.position, emitter.direction)
            up = np.eye(3)[int(np.argmin(np.abs(emitter.direction)))]
            beam = 0.75 * emitter.cutoff_angle if emitter.beam_width is None else emitter.beam_width
            return {
                "type": "spot",
                "to_world": self.mi.ScalarTransform4f().look_at(list(emitter.position), target.tolist(), up.tolist()),
                "intensity": _colour(emitter.intensity),
                "cutoff_angle": emitter.cutoff_angle,
                "beam_width": beam,
            }
        if isinstance(emitter, description.Sun):
            raise WavefrontError(f"{where}: Mitsuba has no sun that is a disc alone")
        if isinstance(emitter, description.SunSky):
            raise WavefrontError(f"{where}: Mitsuba has another sky; compare on one that tools.bake makes")
        return {
            "type": "envmap",
            "filename": emitter.file,
            "scale": emitter.scale,
            "to_world": self._transform(to_matrix(emitter.to_world, f"{where}.to_world")),
        }

    # --- shapes --------------------------------------------------------------------------------------------------

    def _shape(self, key, shape, where):
        result = {"bsdf": self._bsdf(shape.bsdf)} | self._media(interior=shape.interior, exterior=shape.exterior)
        if shape.emitter is not None:
            if shape.emitter.two_sided:
                raise WavefrontError(f"{where}: Mitsuba has no emission from both sides")
            result["emitter"] = {"type": "area", "radiance": self._parameter(shape.emitter.radiance)}
        if isinstance(shape, description.Mesh):
            # The triangles that we read ourselves: reading files is compared through Mitsuba's XML.
            mesh = tessellate(shape, where)
            file = self.folder / f"{key}.ply"
            write_ply(file, mesh)
            return result | {"type": "ply", "filename": str(file), "face_normals": mesh.normals is None}
        matrix = to_matrix(shape.to_world, f"{where}.to_world")
        flip = shape.flip_normals
        if isinstance(shape, description.Sphere):
            result |= {"type": "sphere", "center": list(shape.center), "radius": shape.radius}
            flip ^= is_mirror(matrix)  # Mitsuba turns a mirrored sphere inside out
        else:
            result["type"] = type(shape).__struct_config__.tag
        return result | {"to_world": self._transform(matrix), "flip_normals": flip}

    def _media(self, **references):
        """Those that are given. Mitsuba takes a medium that is given twice as two, which changes nothing."""
        result = {}
        for name, reference in references.items():
            medium = resolve_medium(self.scene, reference)
            if medium is not None:
                sigma_a = medium.scale * np.broadcast_to(medium.sigma_a, 3)
                scale = float(sigma_a.max()) or 1.0  # Mitsuba takes colours up to 1
                result[name] = {
                    "type": "homogeneous",
                    "sigma_t": _colour(sigma_a / scale),
                    "albedo": 0.0,
                    "scale": scale,
                }
        return result

    # --- materials -----------------------------------------------------------------------------------------------

    def _bsdf(self, reference):
        bsdf = resolve_bsdf(self.scene, reference)
        if isinstance(bsdf, description.TwoSided):
            front = self._bsdf(bsdf.front)
            return {"type": "twosided", "front": front, "back": front if bsdf.back is None else self._bsdf(bsdf.back)}
        if isinstance(bsdf, description.Blend):
            weight = self._parameter(bsdf.weight, scalar=True)
            return {
                "type": "blendbsdf",
                "weight": weight,
                "bsdf_0": self._bsdf(bsdf.first),
                "bsdf_1": self._bsdf(bsdf.second),
            }
        if isinstance(bsdf, (description.NormalMap, description.BumpMap)):
            result = {"flip_invalid_normals": bsdf.flip_invalid_normals, "use_shadowing_function": bsdf.shadowing}
            result["nested"] = self._bsdf(bsdf.bsdf)
            if isinstance(bsdf, description.NormalMap) and bsdf.scale != 1.0:
                raise WavefrontError("Mitsuba's normalmap has no scale")
            if isinstance(bsdf, description.NormalMap):
                return result | {
                    "type": "normalmap",
                    "normalmap": self._parameter(bsdf.normal, scalar=not isinstance(bsdf.normal, list)),
                }
            height = self._parameter(bsdf.height, scalar=True)
            return result | {"type": "bumpmap", "height": height, "scale": bsdf.scale}
        if isinstance(bsdf, description.Mask) and bsdf.cutoff is not None:
            raise WavefrontError("Mitsuba's mask has no cutoff")
        if isinstance(bsdf, description.Mask):
            opacity = self._parameter(bsdf.opacity, scalar=True)
            return {"type": "mask", "opacity": opacity, "nested": self._bsdf(bsdf.bsdf)}
        if isinstance(bsdf, description.Diffuse):
            return {"type": "diffuse", "reflectance": self._parameter(bsdf.reflectance)}
        if isinstance(bsdf, (description.Plastic, description.RoughPlastic)):
            result = {
                "type": "plastic",
                "int_ior": bsdf.int_ior,
                "ext_ior": bsdf.ext_ior,
                "nonlinear": bsdf.nonlinear,
                "diffuse_reflectance": self._parameter(bsdf.diffuse_reflectance),
                "specular_reflectance": self._parameter(bsdf.specular_reflectance),
            }
            if isinstance(bsdf, description.RoughPlastic):
                result |= {"type": "roughplastic", "distribution": bsdf.distribution, "alpha": bsdf.alpha}
            return result
        if isinstance(bsdf, description.OrenNayar):
            raise WavefrontError("Mitsuba 3 has no oren_nayar BSDF")
        if isinstance(bsdf, description.Principled):
            return self._principled(bsdf)
        if isinstance(bsdf, description.Null):
            return {"type": "null"}
        rough = isinstance(bsdf, (description.RoughConductor, description.RoughDielectric))
        result = {"specular_reflectance": self._parameter(bsdf.specular_reflectance)}
        if rough:
            result["distribution"] = bsdf.distribution
            for key, (_, value) in zip(("alpha_u", "alpha_v"), roughness(bsdf), strict=True):
                result[key] = self._parameter(value, scalar=True)
        if isinstance(bsdf, (description.Conductor, description.RoughConductor)):
            result["type"] = "roughconductor" if rough else "conductor"
            if bsdf.material is not None:
                return result | {"material": bsdf.material}
            eta, k = (0.0, 1.0) if bsdf.eta is None else (bsdf.eta, bsdf.k)  # a perfect mirror
            return result | {"eta": self._parameter(eta), "k": self._parameter(k)}
        thin = isinstance(bsdf, description.ThinDielectric)
        return result | {
            "type": "thindielectric" if thin else "roughdielectric" if rough else "dielectric",
            "int_ior": bsdf.int_ior,
            "ext_ior": bsdf.ext_ior,
            "specular_transmittance": self._parameter(bsdf.specular_transmittance),
        }

    def _principled(self, bsdf):
        result = {"type": "principled", "base_color": self._parameter(bsdf.base_color)}
        for name in bsdf.__struct_fields__:
            value = getattr(bsdf, name)
            if name not in ("name", "base_color") and value is not None:
                result[name] = self._parameter(value, scalar=True)
        return result

    def _parameter(self, value, scalar=False):
        value = resolve_texture(self.scene, value)
        if isinstance(value, description.Checkerboard):
            # Where a number is wanted (up to 3.9 at least), Mitsuba's checkerboard has its two colours swapped.
            first, second = (value.color1, value.color0) if scalar else (value.color0, value.color1)
            return {
                "type": "checkerboard",
                "color0": _colour(first),
                "color1": _colour(second),
                "to_uv": self._uv_transform(value),
            }
        if isinstance(value, description.Bitmap):
            return self._bitmap(value, scalar)
        return float(value) if scalar and not isinstance(value, list) else _colour(value)

    def _bitmap(self, bitmap, scalar):
        if bitmap.scale != 1.0:
            raise WavefrontError(f"{bitmap.file}: Mitsuba has no scale of a bitmap")
        if bitmap.channel is not None or bitmap.image is not None:
            raise WavefrontError(f"{bitmap.file}: Mitsuba takes no channel of a bitmap, and no image inside a file")
        is_float = bitmap.file.lower().endswith(".exr")
        if is_float and bitmap.color_space == "srgb":
            raise WavefrontError(f"{bitmap.file}: Mitsuba takes no OpenEXR image as sRGB")
        linear = bitmap.color_space == "linear" or (bitmap.color_space == "auto" and (scalar or is_float))
        return {
            "type": "bitmap",
            "filename": bitmap.file,
            "raw": linear,
            "filter_type": bitmap.filter,
            "wrap_mode": bitmap.wrap,
            "to_uv": self._uv_transform(bitmap),
        }

    def _uv_transform(self, texture):
        (a, b, c), (d, e, f) = texture.uv_transform
        return self._transform([[a, b, 0.0, c], [d, e, 0.0, f], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def _colour(value):
    return {"type": "rgb", "value": [float(channel) for channel in np.broadcast_to(value, 3)]}
