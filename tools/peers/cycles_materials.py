"""Our BSDFs, textures and emission as trees of Blender's shader nodes, for `tools.peers.cycles_scene`.

A node is a dict: ``type``, ``properties``, ``inputs`` by the identifier of the socket (a number, a list of numbers,
another node, or None: not connected) and the ``output`` that is meant. A closure that is not connected is black.

Cycles' closures reflect on both sides; ours on the front, unless they are twosided or transmit. Microfacet closures
are those of single scattering (``GGX``, ``BECKMANN``), whose roughness is the root of our alpha.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from wavefront.errors import SceneError
from wavefront.film import LUMINANCE
from wavefront.scene import description
from wavefront.scene.images import write_exr
from wavefront.scene.ior import CONDUCTORS
from wavefront.scene.lookup import resolve_bsdf, resolve_texture, roughness
from wavefront.scene.material_upload import principled_eta, relative_ior
from wavefront.scene.texture_upload import TextureAtlas, rgb
from wavefront.texture import IMAGE_TYPES, srgb_to_linear

DISTRIBUTIONS = {"ggx": "GGX", "beckmann": "BECKMANN"}
EXTENSIONS = {"repeat": "REPEAT", "mirror": "MIRROR", "clamp": "EXTEND"}
INTERPOLATIONS = {"bilinear": "Linear", "nearest": "Closest"}
MIN_PRINCIPLED_ALPHA = 1e-3  # as `wavefront.bsdf.principled` has it
LEAST_ASPECT = 0.1  # of the two roughnesses of Blender's metal


# --- nodes -------------------------------------------------------------------------------------------------------


def node(kind: str, output: str, inputs: dict | None = None, **properties) -> dict:
    """A shader node of the type ``ShaderNode`` + `kind`, and which of its outputs is meant."""
    return {"type": f"ShaderNode{kind}", "output": output, "inputs": inputs or {}, "properties": properties}


def math_node(operation: str, *values) -> dict:
    """A function of numbers, such as ``ADD``."""
    names = ("Value", "Value_001", "Value_002")
    return node("Math", "Value", dict(zip(names, values, strict=False)), operation=operation)


def dot(vector: dict, constant) -> dict:
    """Of a vector and three numbers."""
    inputs = {"Vector": vector, "Vector_001": [float(x) for x in constant]}
    return node("VectorMath", "Value", inputs, operation="DOT_PRODUCT")


def combine(x, y, z) -> dict:
    """Three numbers as a vector or, which Blender takes for the same, as a colour."""
    return node("CombineXYZ", "Vector", {"X": x, "Y": y, "Z": z})


def mix_shader(share, first: dict | None, second: dict | None) -> dict:
    """(1 - share) first + share second."""
    return node("MixShader", "Shader", {"Fac": share, "Shader": first, "Shader_001": second})


def add_shader(first: dict | None, second: dict | None) -> dict | None:
    """The sum of closures."""
    if first is None or second is None:
        return first or second
    return node("AddShader", "Shader", {"Shader": first, "Shader_001": second})


def by_side(front: dict | None, back: dict | None) -> dict:
    """One closure on the front of a surface and another on its back."""
    return mix_shader(node("NewGeometry", "Backfacing"), front, back)


def emission(radiance) -> dict:
    """An emitter of a colour (any size) or a node."""
    if isinstance(radiance, dict):
        return node("Emission", "Emission", {"Color": radiance, "Strength": 1.0})
    color, strength = color_and_strength(radiance)
    return node("Emission", "Emission", {"Color": color, "Strength": strength})


def color_and_strength(value) -> tuple[list[float], float]:
    """A colour as one of at most 1, and its factor."""
    value = rgb(value)
    strength = float(value.max()) or 1.0
    return [float(x) for x in value / strength], strength


# --- images ------------------------------------------------------------------------------------------------------


class Images:
    """The images that nodes name. Each is made when it is written, and so never where a scene is only checked."""

    def __init__(self):
        self.makers: dict[str, object] = {}
        self.names: dict[str, str] = {}

    def add(self, key: str, make) -> str:
        """The name of an image; `make` returns its linear values, [h, w, 3]."""
        if key not in self.names:
            self.names[key] = f"image{len(self.names)}.exr"
            self.makers[self.names[key]] = make
        return self.names[key]

    def write(self, folder: Path) -> None:
        for name, make in self.makers.items():
            values = np.asarray(make(), np.float32)
            write_exr(folder / name, dict(zip("RGB", np.moveaxis(values, 2, 0), strict=True)))


def linear_values(texture: description.Bitmap, scalar: bool, where: str) -> np.ndarray:
    """The image of a record as numbers, [h, w, 3] float64: decoded and scaled; of a `scalar` one, the luminance."""
    atlas = TextureAtlas()
    atlas.add(texture, where, scalar)
    (record,), (kind,) = atlas.records, atlas.kinds
    (pixels,) = atlas.pixels[kind]
    values = pixels.reshape(record["height"], record["width"], record["channels"]).astype(np.float64)
    if np.issubdtype(IMAGE_TYPES[kind], np.integer):
        values /= np.iinfo(IMAGE_TYPES[kind]).max
    if record["srgb"]:
        values = srgb_to_linear(values)
    values = values * record["scale"]
    return np.repeat((values @ LUMINANCE)[:, :, None], 3, axis=2) if scalar else values


# --- materials ---------------------------------------------------------------------------------------------------


class Materials:
    """Makes trees of nodes from BSDFs, textures and emission of one scene.

    Args:
        scene: Valid records.
        images: Gets the images of textures.
    """

    def __init__(self, scene: description.Scene, images: Images):
        self.scene, self.images = scene, images

    def surface(self, shape: description.AnyShape, where: str) -> dict:
        """``surface`` and, for next-event estimation, ``sampling`` of a shape's material.

        Raises:
            SceneError: Cycles has no such BSDF; its path is where it stands.
        """
        surface, sampling = self.bsdf(shape.bsdf, f"{where}.bsdf"), "NONE"
        if shape.emitter is not None:
            light = emission(self.parameter(shape.emitter.radiance, f"{where}.emitter.radiance"))
            if not shape.emitter.two_sided:
                light = by_side(light, None)
            surface, sampling = add_shader(surface, light), "FRONT_BACK" if shape.emitter.two_sided else "FRONT"
        return {"surface": surface, "sampling": sampling}

    def bsdf(self, reference, where: str, both_sides: bool = False) -> dict:
        """The closure of a BSDF; reflection is on the front alone unless `both_sides`."""
        bsdf = resolve_bsdf(self.scene, reference)
        if isinstance(reference, str):
            where = f"bsdf {reference!r}"
        if isinstance(bsdf, description.TwoSided):
            front = self.bsdf(bsdf.front, f"{where}.front", both_sides=True)
            return (
                front if bsdf.back is None else by_side(front, self.bsdf(bsdf.back, f"{where}.back", both_sides=True))
            )
        if isinstance(bsdf, description.Blend):
            weight = self.parameter(bsdf.weight, f"{where}.weight", scalar=True)
            parts = (self.bsdf(getattr(bsdf, name), f"{where}.{name}", both_sides) for name in ("first", "second"))
            return mix_shader(weight, *parts)
        if isinstance(bsdf, (description.Dielectric, description.RoughDielectric)):
            return self._dielectric(bsdf, where)
        if isinstance(bsdf, description.Principled) and bsdf.metallic != 1.0:
            return self._principled_glass(bsdf, where)
        if isinstance(bsdf, (description.Diffuse, description.OrenNayar)):
            if isinstance(bsdf, description.OrenNayar) and bsdf.roughness != 0.0:
                raise SceneError("cycles has another model of rough diffuse reflection", path=f"{where}.roughness")
            color = self.parameter(bsdf.reflectance, f"{where}.reflectance")
            closure = node("BsdfDiffuse", "BSDF", {"Color": color, "Roughness": 0.0})
        elif isinstance(bsdf, (description.Conductor, description.RoughConductor)):
            closure = self._conductor(bsdf, where)
        elif isinstance(bsdf, description.Principled):
            closure = self._principled_metal(bsdf, where)
        else:
            kind = type(bsdf).__struct_config__.tag
            raise SceneError(f"cycles has no BSDF that is as {kind} is here", path=where)
        return closure if both_sides else by_side(closure, None)

    def _conductor(self, bsdf, where: str) -> dict:
        inputs, distribution = {"Roughness": 0.0}, "GGX"
        if isinstance(bsdf, description.RoughConductor):
            inputs, distribution = self._roughness(bsdf, where), DISTRIBUTIONS[bsdf.distribution]
        eta, k = CONDUCTORS[bsdf.material] if bsdf.material is not None else (bsdf.eta, bsdf.k)
        eta, k = (0.0, 1.0) if eta is None else (eta, k)  # a perfect mirror
        for name, value in (("eta", eta), ("k", k)):
            if isinstance(resolve_texture(self.scene, value), (description.Bitmap, description.Checkerboard)):
                raise SceneError("with cycles: a number or a colour", path=f"{where}.{name}")
        eta, k = rgb(eta), rgb(k)

        def metal(eta, k):
            fresnel = {"IOR": [float(x) for x in eta], "Extinction": [float(x) for x in k]}
            properties = {"distribution": distribution, "fresnel_type": "PHYSICAL_CONDUCTOR"}
            return node("BsdfMetallic", "BSDF", inputs | fresnel, **properties)

        share = self._grey(bsdf.specular_reflectance, f"{where}.specular_reflectance")
        if share is not None:
            return metal(eta, k) if share == 1.0 else mix_shader(share, None, metal(eta, k))
        # One metal for each channel: where eta is 1 and k is 0, nothing is reflected.
        color = self.parameter(bsdf.specular_reflectance, f"{where}.specular_reflectance")
        result = None
        for i, channel in enumerate(("Red", "Green", "Blue")):
            share = node("SeparateColor", channel, {"Color": color}) if isinstance(color, dict) else color[i]
            only = np.arange(3) == i
            result = add_shader(
                result, mix_shader(share, None, metal(np.where(only, eta, 1.0), np.where(only, k, 0.0)))
            )
        return result

    def _roughness(self, bsdf, where: str) -> dict:
        """Inputs of a microfacet closure.

        Blender's metal has roughness^2 over and times sqrt(1 - 0.9 anisotropy) as alpha along and across the tangent,
        which is turned where the rougher direction is the other one.
        """
        (name, along), (_, across) = roughness(bsdf)
        along, across = (resolve_texture(self.scene, value) for value in (along, across))
        if along == across:
            return {"Roughness": _root(self.parameter(along, f"{where}.{name}", scalar=True))}
        if isinstance(bsdf, description.RoughDielectric):
            raise SceneError("cycles' glass has the same roughness in all directions", path=f"{where}.alpha_u")
        if not all(isinstance(value, (int, float)) for value in (along, across)):
            raise SceneError("with cycles: numbers, where alpha_u and alpha_v differ", path=f"{where}.alpha_u")
        aspect = min(along, across) / max(along, across)
        if aspect < LEAST_ASPECT:
            raise SceneError(
                f"cycles takes a ratio of {LEAST_ASPECT:g} to {1.0 / LEAST_ASPECT:g}", path=f"{where}.alpha_u"
            )
        return {
            "Roughness": (along * across) ** 0.25,
            "Anisotropy": (1.0 - aspect) / 0.9,
            "Rotation": 0.0 if along > across else 0.25,
            "Tangent": node("Tangent", "Tangent", direction_type="UV_MAP", uv_map="uv"),
        }

    def _dielectric(self, bsdf, where: str) -> dict:
        """Glass; a smooth one with tints, as its two parts and their Fresnel reflectance."""
        ior, names = relative_ior(bsdf), ("specular_reflectance", "specular_transmittance")
        tints = [self.parameter(getattr(bsdf, name), f"{where}.{name}") for name in names]
        plain = all(tint == [1.0, 1.0, 1.0] for tint in tints)
        if isinstance(bsdf, description.RoughDielectric):
            if not plain:
                raise SceneError("cycles' rough glass has no such tint; allowed: 1", path=f"{where}.{names[0]}")
            inputs, distribution = self._roughness(bsdf, where), DISTRIBUTIONS[bsdf.distribution]
            return node("BsdfGlass", "BSDF", inputs | {"IOR": ior, "Color": tints[0]}, distribution=distribution)
        inputs = {"Roughness": 0.0}
        if plain:
            return node("BsdfGlass", "BSDF", inputs | {"IOR": ior, "Color": tints[0]}, distribution="GGX")
        reflection = node("BsdfAnisotropic", "BSDF", inputs | {"Color": tints[0]}, distribution="GGX")
        refraction = node("BsdfRefraction", "BSDF", inputs | {"IOR": ior, "Color": tints[1]}, distribution="GGX")
        return mix_shader(node("Fresnel", "Fac", {"IOR": ior}), refraction, reflection)

    def _principled_metal(self, bsdf: description.Principled, where: str) -> dict:
        """Schlick's reflectance, which is Blender's F82 where the tint of its edge is white."""
        self._refuse(bsdf, where, "clearcoat", "anisotropic")
        inputs = {
            "Base Color": self.parameter(bsdf.base_color, f"{where}.base_color"),
            "Edge Tint": [1.0, 1.0, 1.0],
            "Roughness": self._principled_roughness(bsdf, where),
        }
        return node("BsdfMetallic", "BSDF", inputs, distribution="GGX", fresnel_type="F82")

    def _principled_glass(self, bsdf: description.Principled, where: str) -> dict:
        if bsdf.metallic != 0.0 or bsdf.spec_trans != 1.0:
            raise SceneError(
                "cycles has another model of the diffuse base of principled; allowed: metallic 1, or metallic 0 with "
                "spec_trans 1",
                path=where,
            )
        self._refuse(bsdf, where, "clearcoat", "anisotropic", "sheen", "spec_tint")
        inputs = {
            "Base Color": self.parameter(bsdf.base_color, f"{where}.base_color"),
            "Roughness": self._principled_roughness(bsdf, where),
            "IOR": principled_eta(bsdf),
            "Transmission Weight": 1.0,
        }
        return node("BsdfPrincipled", "BSDF", inputs, distribution="GGX")

    def _principled_roughness(self, bsdf, where: str):
        value = self.parameter(bsdf.roughness, f"{where}.roughness", scalar=True)
        least = math.sqrt(MIN_PRINCIPLED_ALPHA)
        return math_node("MAXIMUM", value, least) if isinstance(value, dict) else max(value, least)

    @staticmethod
    def _refuse(bsdf: description.Principled, where: str, *names: str) -> None:
        for name in names:
            if getattr(bsdf, name) != 0.0:
                raise SceneError("cycles has another model of it; allowed: 0", path=f"{where}.{name}")

    # --- textures ------------------------------------------------------------------------------------------------

    def parameter(self, value, where: str, scalar: bool = False):
        """A number, a colour of three, or the node of a texture."""
        value = resolve_texture(self.scene, value)
        if isinstance(value, description.Checkerboard):
            colors = rgb(value.color0), rgb(value.color1)
            if scalar:
                colors = [np.repeat(color @ LUMINANCE, 3) for color in colors]
            name = self.images.add(f"{value!r} {scalar}", lambda: np.array([colors, colors[::-1]]))
            return self._image(name, value.uv_transform, "Closest", "REPEAT")
        if isinstance(value, description.Bitmap):
            name = self.images.add(f"{value!r} {scalar}", lambda: linear_values(value, scalar, where))
            return self._image(name, value.uv_transform, INTERPOLATIONS[value.filter], EXTENSIONS[value.wrap])
        if scalar:
            return float(value)
        return [float(x) for x in rgb(value)]

    def _grey(self, value, where: str):
        """A colour that is known to be grey as a number or a node; None: it may not be."""
        value = resolve_texture(self.scene, value)
        if isinstance(value, description.Bitmap):
            return None
        colors = [value.color0, value.color1] if isinstance(value, description.Checkerboard) else [value]
        if any(np.ptp(rgb(color)) > 0.0 for color in colors):
            return None
        return self.parameter(value, where, scalar=True) if len(colors) == 2 else float(rgb(value)[0])

    @staticmethod
    def _image(name: str, uv_transform, interpolation: str, extension: str) -> dict:
        """An image at our coordinates, of which v = 0 is the first row; Blender's v = 0 is the last."""
        uv = node("UVMap", "UV", uv_map="uv")
        u, v = (math_node("ADD", dot(uv, (a, b, 0.0)), float(c)) for a, b, c in uv_transform)
        vector = combine(u, math_node("SUBTRACT", 1.0, v), 0.0)
        return node(
            "TexImage", "Color", {"Vector": vector}, image=name, interpolation=interpolation, extension=extension
        )


def _root(value):
    return math_node("SQRT", value) if isinstance(value, dict) else math.sqrt(value)
