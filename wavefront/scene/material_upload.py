"""From BSDF records to the tables of materials on the device."""

from __future__ import annotations

import numpy as np
import warp as wp

from wavefront.bsdf import tables as bsdf_tables
from wavefront.bsdf.coating import diffuse_fresnel, rough_coating
from wavefront.scene import description
from wavefront.scene.ior import CONDUCTORS, INDEX_OF_REFRACTION
from wavefront.scene.lookup import PRINCIPLED_FRACTIONS, resolve_bsdf, roughness
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


def bsdf_kind(bsdf: description.Bsdf) -> str:
    """Name of the kind, from `tables.KINDS`, of a BSDF that is neither two-sided nor a mask."""
    if isinstance(bsdf, description.Principled) and bsdf.spec_trans != 0.0:  # a number, or textured
        return "principled_transmissive"
    return BSDF_KINDS[type(bsdf)]


def _principled_eta(bsdf: description.Principled) -> float:
    """Relative index of refraction; one that would not refract is moved off 1 as in Mitsuba 3 where light passes."""
    transmits = bsdf_kind(bsdf) == "principled_transmissive"
    if bsdf.eta is not None:
        return 1.001 if transmits and bsdf.eta == 1.0 else bsdf.eta
    specular = 0.5 if bsdf.specular is None else bsdf.specular
    if transmits and specular == 0.0:
        specular = 1e-3
    return 2.0 / (1.0 - np.sqrt(0.08 * specular)) - 1.0


def _relative_ior(bsdf) -> float:
    interior, exterior = (
        INDEX_OF_REFRACTION[value] if isinstance(value, str) else value for value in (bsdf.int_ior, bsdf.ext_ior)
    )
    return interior / exterior


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
        self.tangents = False  # whether some BSDF depends on the direction of its tangent
        self.keep_alive: list = []

    def upload(self, device: str) -> bsdf_tables.MaterialTables:
        """The tables with all that was added."""
        materials = bsdf_tables.MaterialTables()
        materials.materials = struct_array(bsdf_tables.Material, self.materials, device)
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
        references = self.atlas.references
        material = {"opacity": 1.0, "opacity_texture": -1}
        inner = bsdf
        if isinstance(inner, description.Mask):
            self._set(material, "opacity", inner.opacity, f"{where}.opacity", scalar=True)
            material["cutoff"] = inner.cutoff or 0.0
            self.mask = True
            inner, where = resolve_bsdf(self.scene, inner.bsdf), f"{where}.bsdf"
        if isinstance(inner, description.TwoSided):
            front = resolve_bsdf(self.scene, inner.front)
            back = front if inner.back is None else resolve_bsdf(self.scene, inner.back)
            sides = [self._bsdf(front, f"{where}.front")]
            sides.append(sides[0] if back is front else self._bsdf(back, f"{where}.back"))
        else:
            front = self._bsdf(inner, where)
            transmits = bsdf_kind(inner) in bsdf_tables.TRANSMISSIVE
            sides = [front, front if transmits else (int(bsdf_tables.KIND_NONE), 0)]
        (material["front"], material["front_index"]), (material["back"], material["back_index"]) = sides
        self.materials.append(material)
        if self.atlas.references > references:
            self.textured.add(len(self.materials) - 1)
        self.known[id(bsdf)] = len(self.materials) - 1
        self.keep_alive.append(bsdf)  # the id stays taken
        return len(self.materials) - 1

    def _bsdf(self, bsdf: description.Bsdf, where: str) -> tuple[int, int]:
        """Kind and record index of a BSDF that is neither two-sided nor a mask."""
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
        elif isinstance(bsdf, description.Principled):
            table = "principled"
            record["eta"] = _principled_eta(bsdf)
            record["specular_rate"] = bsdf.main_specular_sampling_rate
            record["clearcoat_rate"] = bsdf.clearcoat_sampling_rate
            record["diffuse_rate"] = bsdf.diffuse_reflectance_sampling_rate
            self._set(record, "base_color", bsdf.base_color, f"{where}.base_color")
            self.tangents |= bsdf.anisotropic != 0.0
            for name in PRINCIPLED_FRACTIONS:
                self._set(record, name, getattr(bsdf, name), f"{where}.{name}", scalar=True)
        else:
            table = "dielectric"
            record["eta"] = _relative_ior(bsdf)
            self._set(record, "reflectance", bsdf.specular_reflectance, f"{where}.specular_reflectance")
            self._set(record, "transmittance", bsdf.specular_transmittance, f"{where}.specular_transmittance")
        if kind in ("rough_conductor", "rough_dielectric"):
            self._set_alpha(record, bsdf, where)
            record["distribution"] = DISTRIBUTIONS[bsdf.distribution]
        self.bsdfs[table].append(record)
        return bsdf_tables.KINDS[kind], len(self.bsdfs[table]) - 1
