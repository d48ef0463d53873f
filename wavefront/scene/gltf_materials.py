"""glTF materials to BSDF and emitter records (glTF 2.0, section 3.9, and the KHR_materials extensions).

The metallic-roughness model becomes `principled`, which differs from it by design: its diffuse part is Disney's and not
Lambert's, its dielectric reflection is exact and not Schlick's. What has no counterpart is a warning.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from wavefront.scene import description
from wavefront.scene import gltf_document as gltf
from wavefront.scene.gltf_document import Document

_WRAPS = {33071: "clamp", 33648: "mirror", 10497: "repeat"}
_NEAREST = 9728
_CLEARCOAT_ALPHA = (0.1, 0.001)  # of `principled` at clearcoat_gloss 0 and 1
_LARGEST_STRETCH = 0.9  # of the squared ratio of the axes of `principled` at anisotropic 1


@dataclass
class Surface:
    """What a material means for a shape.

    Attributes:
        bsdf: Name of a BSDF record.
        emitter: What it emits, or None.
        uv_set: The texture coordinates that its textures use, or None without textures.
    """

    bsdf: str
    emitter: description.Area | None
    uv_set: int | None


class Materials:
    """Converts materials of a document, each once.

    Args:
        document: Where they come from.
        warn: Called with a line of text for what the records cannot say.

    Attributes:
        bsdfs: The records made so far.
        names: Theirs, no two the same.
    """

    def __init__(self, document: Document, warn: Callable[[str], object]):
        self.document, self.warn = document, warn
        self.bsdfs: list[description.Bsdf] = []
        self._known: dict[int | None, Surface] = {}
        self.names: set[str] = set()

    def surface(self, index: int | None, where: str) -> Surface:
        """The records of a material to which the place `where` refers; None is the material of the standard.

        Raises:
            SceneError: An index out of range, an image that is not there, or textures that use two sets of
                coordinates.
        """
        if index not in self._known:
            material = gltf.Material() if index is None else self.document.item("materials", index, where)
            name = material.name or ("default material" if index is None else f"material {index}")
            self._known[index] = _Converter(self, material, f"materials[{index}]").convert(name)
        return self._known[index]


def unique_name(name: str, taken: set[str]) -> str:
    """`name`, or where that is in `taken`, with a number after it; adds it there."""
    free, number = name, 1
    while free in taken:
        number += 1
        free = f"{name} {number}"
    taken.add(free)
    return free


class _Converter:
    """One material."""

    def __init__(self, materials: Materials, material: gltf.Material, where: str):
        self.document, self.materials, self.material, self.where = materials.document, materials, material, where
        self.extensions = material.extensions
        self.uv_sets: dict[int, str] = {}

    def convert(self, name: str) -> Surface:
        """The records; `name` is that of the BSDF unless it is taken."""
        material, pbr = self.material, self.material.pbr
        place = f"{self.where}.pbrMetallicRoughness"
        base_color = self._color(pbr.base_color_texture, f"{place}.baseColorTexture", pbr.base_color_factor[:3])
        if self.extensions.unlit is not None:
            self._warn("KHR_materials_unlit has no place in light transport: taken as a lit material")
        bsdf = self._thin_glass(base_color) or self._principled(base_color)
        transmits = isinstance(bsdf, description.ThinDielectric) or bsdf.spec_trans != 0.0
        if material.double_sided and not transmits:
            bsdf = description.TwoSided(front=bsdf)
        if material.normal_texture is not None:
            info = material.normal_texture
            normal = self._bitmap(info, f"{self.where}.normalTexture", 1.0, color_space="linear")
            bsdf = description.NormalMap(bsdf=bsdf, normal=normal, scale=info.scale)
        opacity = self._opacity()
        if opacity != 1.0:
            cutoff = material.alpha_cutoff if material.alpha_mode == "MASK" else None
            bsdf = description.Mask(bsdf=bsdf, opacity=opacity, cutoff=cutoff)
        bsdf.name = unique_name(name, self.materials.names)
        emitter = self._emitter()
        if emitter is not None and opacity != 1.0:
            self._warn(f"alphaMode {material.alpha_mode} does not mask what the material emits")
        if len(self.uv_sets) > 1:
            found = " and ".join(f"TEXCOORD_{n} ({self.uv_sets[n]})" for n in sorted(self.uv_sets))
            raise self.document.error(self.where, f"its textures use {found}; one set for all is supported")
        self.materials.bsdfs.append(bsdf)
        return Surface(bsdf.name, emitter, next(iter(self.uv_sets), None))

    def _warn(self, message: str) -> None:
        self.materials.warn(f"{self.document.path}: {self.where}: {message}")

    # --- BSDF ---------------------------------------------------------------------------------------------------

    def _principled(self, base_color) -> description.Principled:
        pbr, place = self.material.pbr, f"{self.where}.pbrMetallicRoughness.metallicRoughnessTexture"
        record = description.Principled(
            base_color=base_color,
            metallic=self._number(pbr.metallic_roughness_texture, place, "b", pbr.metallic_factor),
            roughness=self._number(pbr.metallic_roughness_texture, place, "g", pbr.roughness_factor),
        )
        transmission = self.extensions.transmission
        if transmission is not None:
            place = f"{self.where}.extensions.KHR_materials_transmission.transmissionTexture"
            record.spec_trans = self._number(
                transmission.transmission_texture, place, "r", transmission.transmission_factor
            )
            if record.spec_trans != 0.0 and not self._is_solid():
                self._warn("a thin wall that transmits in part is taken as the boundary of a solid")
        volume = self.extensions.volume
        if volume is not None and volume.attenuation_distance is not None and record.spec_trans != 0.0:
            self._warn("the absorption of KHR_materials_volume is left out")
        self._reflectance(record)
        self._clearcoat(record)
        self._sheen(record)
        self._anisotropy(record)
        return record

    def _is_solid(self) -> bool:
        return self.extensions.volume is not None and self.extensions.volume.thickness_factor > 0.0

    def _thin_glass(self, base_color) -> description.ThinDielectric | None:
        """A thin wall that transmits all that it does not reflect (KHR_materials_transmission without a volume)."""
        transmission, pbr = self.extensions.transmission, self.material.pbr
        if transmission is None or transmission.transmission_factor != 1.0 or transmission.transmission_texture:
            return None
        if self._is_solid() or pbr.metallic_factor != 0.0:
            return None
        if pbr.roughness_factor > 0.0:
            self._warn("the roughness of a thin wall that transmits is left out")
        return description.ThinDielectric(int_ior=max(self._ior(), 1.0), ext_ior=1.0, specular_transmittance=base_color)

    def _ior(self) -> float:
        ior = self.extensions.ior.ior if self.extensions.ior else 1.5
        if 0.0 < ior < 1.0:
            place = f"{self.where}.extensions.KHR_materials_ior.ior"
            raise self.document.error(place, f"expected 0 or a number of at least 1; found {ior:g}")
        return ior

    def _reflectance(self, record) -> None:
        """Of the dielectric at normal incidence: from KHR_materials_ior and KHR_materials_specular."""
        ior, specular = self._ior(), self.extensions.specular or gltf.Specular()
        if specular.specular_texture or specular.specular_color_texture:
            self._warn("the textures of KHR_materials_specular are left out")
        if specular.specular_color_factor != (1.0, 1.0, 1.0):
            self._warn("specularColorFactor of KHR_materials_specular is left out")
        if record.spec_trans != 0.0:
            if specular.specular_factor != 1.0:
                self._warn("specularFactor of KHR_materials_specular is left out of a material that transmits")
            record.eta = ior if ior > 0.0 else 1.5
            return
        normal_incidence = specular.specular_factor * (((ior - 1.0) / (ior + 1.0)) ** 2 if ior > 0.0 else 1.0)
        if normal_incidence > 0.08:
            self._warn(f"the dielectric reflectance {normal_incidence:.3g} is taken as 0.08, the most there is")
        if ior != 1.5 or specular.specular_factor != 1.0:
            record.specular = min(12.5 * normal_incidence, 1.0)

    def _clearcoat(self, record) -> None:
        coat, place = self.extensions.clearcoat, f"{self.where}.extensions.KHR_materials_clearcoat"
        if coat is None or coat.clearcoat_factor == 0.0:
            return
        record.clearcoat = self._number(coat.clearcoat_texture, f"{place}.clearcoatTexture", "r", coat.clearcoat_factor)
        widest, sharpest = _CLEARCOAT_ALPHA
        alpha = coat.clearcoat_roughness_factor**2
        record.clearcoat_gloss = min(max((widest - alpha) / (widest - sharpest), 0.0), 1.0)
        self._warn("KHR_materials_clearcoat is taken as the clearcoat of principled, which is a quarter as strong")
        if coat.clearcoat_roughness_texture or coat.clearcoat_normal_texture:
            self._warn("the textures of the clearcoat's roughness and normal are left out")

    def _sheen(self, record) -> None:
        sheen = self.extensions.sheen
        if sheen is None or max(sheen.sheen_color_factor) == 0.0:
            return
        record.sheen = max(sheen.sheen_color_factor)
        self._warn("KHR_materials_sheen is taken as the sheen of principled: colour, roughness, textures are left out")

    def _anisotropy(self, record) -> None:
        """Roughness along the tangent is (1 - s^2) alpha + s^2, across it alpha: the same two of `principled`."""
        anisotropy = self.extensions.anisotropy
        if anisotropy is None or anisotropy.anisotropy_strength == 0.0:
            return
        if anisotropy.anisotropy_texture or not isinstance(record.roughness, float):
            self._warn("KHR_materials_anisotropy is left out where it or the roughness is textured")
            return
        if math.sin(anisotropy.anisotropy_rotation) != 0.0:
            self._warn("the rotation of KHR_materials_anisotropy is left out")
        across = record.roughness**2
        along = across + (1.0 - across) * anisotropy.anisotropy_strength**2
        stretch = (1.0 - across / along) / _LARGEST_STRETCH
        if stretch > 1.0:
            self._warn("the axes of KHR_materials_anisotropy differ by more than a factor of ten: taken as ten")
        record.anisotropic = min(stretch, 1.0)
        record.roughness = (across * along) ** 0.25

    # --- emission and opacity -----------------------------------------------------------------------------------

    def _emitter(self) -> description.Area | None:
        material, strength = self.material, self.extensions.emissive_strength
        scale = strength.emissive_strength if strength else 1.0
        factor = [scale * value for value in material.emissive_factor]
        if max(factor) == 0.0:
            return None
        radiance = self._color(material.emissive_texture, f"{self.where}.emissiveTexture", factor)
        return description.Area(radiance=radiance, two_sided=material.double_sided)

    def _opacity(self):
        """The alpha of the base colour; 1 for a material that is opaque."""
        material, pbr = self.material, self.material.pbr
        if material.alpha_mode == "OPAQUE" or (material.alpha_mode == "MASK" and material.alpha_cutoff == 0.0):
            return 1.0
        place = f"{self.where}.pbrMetallicRoughness.baseColorTexture"
        return self._number(pbr.base_color_texture, place, "a", pbr.base_color_factor[3])

    # --- textures -----------------------------------------------------------------------------------------------

    def _color(self, info, place, factor):
        """`factor`, or its product with the colours of a texture."""
        factor = factor[0] if factor[0] == factor[1] == factor[2] else list(factor)
        if info is None or factor == 0.0:
            return factor
        return self._bitmap(info, place, factor, color_space="srgb")

    def _number(self, info, place, channel, factor):
        """`factor`, or its product with one channel of a texture."""
        if info is None or factor == 0.0:
            return factor
        return self._bitmap(info, place, factor, color_space="linear", channel=channel)

    def _bitmap(self, info: gltf.TextureInfo, place: str, scale, **fields) -> description.Bitmap:
        document, transform = self.document, info.extensions.transform
        texture = document.item("textures", info.index, f"{place}.index")
        if texture.source is None:
            raise document.error(f"textures[{info.index}]", "has no source that is supported: PNG or JPEG")
        where = f"textures[{info.index}].source"
        file = document.image_file(texture.source, where)
        if file is None:
            document.image_bytes(texture.source, where)  # whether it is there
            fields |= {"file": str(document.path), "image": texture.source}
        else:
            fields["file"] = str(file)
        if texture.sampler is not None:
            fields |= self._sampler(document.item("samplers", texture.sampler, f"textures[{info.index}].sampler"))
        uv_set = info.tex_coord
        if transform is not None:
            fields["uv_transform"] = uv_transform(transform)
            uv_set = uv_set if transform.tex_coord is None else transform.tex_coord
        self.uv_sets.setdefault(uv_set, place.rsplit(".", 1)[-1])
        if scale != 1.0:
            fields["scale"] = scale
        return description.Bitmap(**fields)

    def _sampler(self, sampler) -> dict:
        if sampler.wrap_s != sampler.wrap_t:
            found = f"{_WRAPS[sampler.wrap_s]} and {_WRAPS[sampler.wrap_t]}"
            self._warn(f"a texture that is wrapped differently along u and v ({found}) is wrapped as along u")
        fields = {"wrap": _WRAPS[sampler.wrap_s]}
        if sampler.mag_filter == _NEAREST:
            fields["filter"] = "nearest"
        return fields


def uv_transform(transform: gltf.TextureTransform) -> description.UVTransform:
    """KHR_texture_transform: scale, then rotate, then move.

    Counter-clockwise as an image is seen, v down: what viewers and the sample assets agree on, and the reverse of the
    listing in the text of the extension (Khronos glTF issue 1563).
    """
    c, s = math.cos(transform.rotation), math.sin(transform.rotation)
    (u, v), (x, y) = transform.scale, transform.offset
    return ((c * u, s * v, x), (-s * u, c * v, y))
