"""From BSDF records to the tables of materials on the device."""

from __future__ import annotations

import numpy as np
import warp as wp

from wavefront.bsdf import tables as bsdf_tables
from wavefront.bsdf.coating import diffuse_fresnel, rough_coating
from wavefront.scene import description
from wavefront.scene.ior import CONDUCTORS, INDEX_OF_REFRACTION
from wavefront.scene.lookup import resolve_bsdf, roughness
from wavefront.scene.texture_upload import TextureAtlas, struct_array

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
    description.Principled: "principled",
}


TRANSMISSIVE = {bsdf_tables.KINDS[kind] for kind in bsdf_tables.TRANSMISSIVE}


def bsdf_kind(bsdf: description.Bsdf) -> str:
    """Name of the kind, from `tables.KINDS`, of a BSDF that is neither two-sided nor a mask."""
    if isinstance(bsdf, description.Principled) and bsdf.spec_trans != 0.0:  # a number, or textured
        return "principled_transmissive"
    return BSDF_KINDS[type(bsdf)]


def principled_eta(bsdf: description.Principled) -> float:
    """Relative index of refraction; one that would not refract is moved off 1 as in Mitsuba 3 where light passes."""
    transmits = bsdf_kind(bsdf) == "principled_transmissive"
    if bsdf.eta is not None:
        return 1.001 if transmits and bsdf.eta == 1.0 else bsdf.eta
    specular = 0.5 if bsdf.specular is None else bsdf.specular
    if transmits and specular == 0.0:
        specular = 1e-3
    return 2.0 / (1.0 - np.sqrt(0.08 * specular)) - 1.0


def relative_ior(bsdf) -> float:
    """Interior over exterior index of refraction of a dielectric or a plastic."""
    interior, exterior = (
        INDEX_OF_REFRACTION[value] if isinstance(value, str) else value for value in (bsdf.int_ior, bsdf.ext_ior)
    )
    return interior / exterior


class BlendTables:
    """Collects mixtures, flattened."""

    def __init__(self):
        self.blends: list[dict] = []
        self.parts: list[dict] = []
        self.factors: list[dict] = []

    def add(self, parts: list[tuple[int, int, tuple[dict, ...]]]) -> int:
        """Index of a mixture, from kind, record index and factors of the weight of each part."""
        self.blends.append({"first": len(self.parts), "count": len(parts)})
        for kind, index, factors in parts:
            self.parts.append({"kind": kind, "index": index, "first": len(self.factors), "count": len(factors)})
            self.factors += factors
        return len(self.blends) - 1

    def upload(self, materials: bsdf_tables.MaterialTables, device: str) -> None:
        materials.blend = struct_array(bsdf_tables.BlendRecord, self.blends, device)
        materials.blend_parts = struct_array(bsdf_tables.BlendPart, self.parts, device)
        materials.blend_factors = struct_array(bsdf_tables.BlendFactor, self.factors, device)


class MaterialUpload:
    """Collects materials, each once.

    Args:
        scene: Valid records.
        atlas: Gets the textures that parameters refer to.
    """

    def __init__(self, scene: description.Scene, atlas: TextureAtlas):
        self.scene, self.atlas = scene, atlas
        self.materials: list[dict] = []
        self.bsdfs: dict[str, list[dict]] = {
            "diffuse": [],
            "conductor": [],
            "dielectric": [],
            "plastic": [],
            "oren_nayar": [],
            "principled": [],
        }
        self.coatings: list[np.ndarray] = []
        self.kinds: set[str] = set()
        self.known: dict[int, int] = {}
        self.textured: set[int] = set()  # materials that look textures up
        self.mask = False
        self.blends = BlendTables()
        self.tangents = False  # whether some BSDF or map depends on the direction of the tangent
        self.maps: list[dict] = []
        self.maps_of: list[dict] = []
        self.map_kinds: set[str] = set()
        self.keep_alive: list = []

    def upload(self, device: str) -> bsdf_tables.MaterialTables:
        """The tables with all that was added."""
        materials = bsdf_tables.MaterialTables()
        materials.materials = struct_array(bsdf_tables.Material, self.materials, device)
        materials.maps = struct_array(bsdf_tables.MapRecord, self.maps, device)
        materials.maps_of = struct_array(bsdf_tables.MaterialMaps, self.maps_of if self.maps else [], device)
        self.blends.upload(materials, device)
        materials.diffuse = struct_array(bsdf_tables.DiffuseRecord, self.bsdfs["diffuse"], device)
        materials.conductor = struct_array(bsdf_tables.ConductorRecord, self.bsdfs["conductor"], device)
        materials.dielectric = struct_array(bsdf_tables.DielectricRecord, self.bsdfs["dielectric"], device)
        materials.plastic = struct_array(bsdf_tables.PlasticRecord, self.bsdfs["plastic"], device)
        materials.oren_nayar = struct_array(bsdf_tables.OrenNayarRecord, self.bsdfs["oren_nayar"], device)
        materials.principled = struct_array(bsdf_tables.PrincipledRecord, self.bsdfs["principled"], device)
        coatings = np.concatenate([np.zeros(0), *self.coatings])
        materials.coatings = wp.array(coatings, dtype=wp.float32, device=device)
        return materials

    def _set(self, record: dict, name: str, value, where: str, scalar: bool = False):
        record[name], record[f"{name}_texture"] = self.atlas.parameter(self.scene, value, where, scalar)

    def _set_alpha(self, record: dict, bsdf, where: str):
        values = [
            self.atlas.parameter(self.scene, value, f"{where}.{name}", scalar=True) for name, value in roughness(bsdf)
        ]
        record["alpha"] = [value for value, _ in values]
        record["alpha_u_texture"], record["alpha_v_texture"] = (texture for _, texture in values)
        self.tangents |= values[0] != values[1]

    def add(self, ref, where: str) -> int:
        """Index of the material of a BSDF record; the same record is stored once."""
        bsdf = resolve_bsdf(self.scene, ref)
        if id(bsdf) in self.known:
            return self.known[id(bsdf)]
        references = len(self.atlas.references)
        material = {"opacity": 1.0, "opacity_texture": -1}
        inner = bsdf
        if isinstance(inner, description.Mask):
            self._set(material, "opacity", inner.opacity, f"{where}.opacity", scalar=True)
            material["cutoff"] = inner.cutoff or 0.0
            self.mask = True
            inner, where = resolve_bsdf(self.scene, inner.bsdf), f"{where}.bsdf"
        inner, where, outer = self._without_map(inner, where)
        if isinstance(inner, description.TwoSided):
            front = resolve_bsdf(self.scene, inner.front)
            back = front if inner.back is None else resolve_bsdf(self.scene, inner.back)
            sides = [self._side(front, f"{where}.front")]
            sides.append(sides[0] if back is front else self._side(back, f"{where}.back"))
        else:
            kind, index = self._bsdf(inner, where)
            sides = [(kind, index, -1), (kind if kind in TRANSMISSIVE else int(bsdf_tables.KIND_NONE), index, -1)]
        for side, (kind, index, _) in zip(("front", "back"), sides, strict=True):
            material[side], material[f"{side}_index"] = kind, index
        front, back = (inside if outer < 0 else outer for *_, inside in sides)
        self.maps_of.append({"front": front, "back": back, "mirrored": int(outer < 0)})
        self.materials.append(material)
        textures = self.atlas.references[references:]
        material["texture"] = textures[0] if textures else -1
        if textures:
            self.textured.add(len(self.materials) - 1)
        self.known[id(bsdf)] = len(self.materials) - 1
        self.keep_alive.append(bsdf)  # the id stays taken
        return len(self.materials) - 1

    def _side(self, bsdf: description.Bsdf, where: str) -> tuple[int, int, int]:
        """Kind, record index and map of one side of a two-sided BSDF."""
        inner, where, index = self._without_map(bsdf, where)
        return *self._bsdf(inner, where), index

    def _without_map(self, bsdf: description.Bsdf, where: str) -> tuple[description.Bsdf, str, int]:
        """What a map is around, its record path, and the index of the map (-1: there is none)."""
        if not isinstance(bsdf, (description.NormalMap, description.BumpMap)):
            return bsdf, where, -1
        kind = "bump" if isinstance(bsdf, description.BumpMap) else "normal"
        field = "height" if kind == "bump" else "normal"
        value, texture = self.atlas.parameter(self.scene, getattr(bsdf, field), f"{where}.{field}", scalar=True)
        record = {"kind": bsdf_tables.MAPS[kind], "texture": texture, "scale": bsdf.scale}
        record |= {"normal": value, "flip": int(bsdf.flip_invalid_normals), "shadowing": int(bsdf.shadowing)}
        self.maps.append(record)
        self.map_kinds.add(kind)
        self.tangents = True
        return resolve_bsdf(self.scene, bsdf.bsdf), f"{where}.bsdf", len(self.maps) - 1

    def _blend(self, blend: description.Blend, where: str) -> tuple[int, int]:
        parts = []
        for bsdf, place, factors in self._parts(blend, where, ()):
            kind, index = self._bsdf(bsdf, place)
            parts.append((kind, index, factors))
        kind = "blend_transmissive" if any(kind in TRANSMISSIVE for kind, *_ in parts) else "blend"
        self.kinds.add(kind)
        return bsdf_tables.KINDS[kind], self.blends.add(parts)

    def _parts(self, bsdf: description.Bsdf, where: str, factors: tuple):
        """The BSDFs that a blend of blends mixes: record, path, and the factors of its weight."""
        if not isinstance(bsdf, description.Blend):
            yield bsdf, where, factors
            return
        weight, texture = self.atlas.parameter(self.scene, bsdf.weight, f"{where}.weight", scalar=True)
        for complement, field in ((1, "first"), (0, "second")):
            factor = {"weight": weight, "weight_texture": texture, "complement": complement}
            nested = resolve_bsdf(self.scene, getattr(bsdf, field))
            yield from self._parts(nested, f"{where}.{field}", (*factors, factor))

    def _bsdf(self, bsdf: description.Bsdf, where: str) -> tuple[int, int]:
        """Kind and record index of a BSDF that is neither two-sided nor a mask nor a map."""
        if isinstance(bsdf, description.Blend):
            return self._blend(bsdf, where)
        kind = bsdf_kind(bsdf)
        self.kinds.add(kind)
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
            record["eta"] = relative_ior(bsdf)
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
        elif isinstance(bsdf, description.Principled):
            table = "principled"
            record["eta"] = principled_eta(bsdf)
            record["specular_rate"] = bsdf.main_specular_sampling_rate
            record["clearcoat_rate"] = bsdf.clearcoat_sampling_rate
            record["diffuse_rate"] = bsdf.diffuse_reflectance_sampling_rate
            self._set(record, "base_color", bsdf.base_color, f"{where}.base_color")
            self.tangents |= bsdf.anisotropic != 0.0
            fractions = [
                self.atlas.parameter(self.scene, getattr(bsdf, name), f"{where}.{name}", scalar=True)
                for name in bsdf_tables.PRINCIPLED_FRACTIONS
            ]
            textured = [(i, texture) for i, (_, texture) in enumerate(fractions) if texture >= 0]
            unused = [(0, -1)] * (len(fractions) - len(textured))
            record["fractions"] = [value for value, _ in fractions]
            record["textured"] = len(textured)
            record["textured_fraction"], record["fraction_texture"] = zip(*textured, *unused, strict=True)
        else:
            table = "dielectric"
            record["eta"] = relative_ior(bsdf)
            self._set(record, "reflectance", bsdf.specular_reflectance, f"{where}.specular_reflectance")
            self._set(record, "transmittance", bsdf.specular_transmittance, f"{where}.specular_transmittance")
        if kind in ("rough_conductor", "rough_dielectric"):
            self._set_alpha(record, bsdf, where)
            record["distribution"] = DISTRIBUTIONS[bsdf.distribution]
        self.bsdfs[table].append(record)
        return bsdf_tables.KINDS[kind], len(self.bsdfs[table]) - 1
