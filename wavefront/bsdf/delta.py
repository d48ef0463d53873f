"""How often a BSDF is sampled in a delta direction, which no other technique can find."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.blend import is_blend, make_part_weight
from wavefront.bsdf.dispatch import is_delta_transmission, make_opacity, side_kind, transmits
from wavefront.bsdf.fresnel import fresnel_dielectric
from wavefront.bsdf.plastic import coating_probability
from wavefront.bsdf.tables import BLENDS, KIND_CONDUCTOR, KIND_PLASTIC, MaterialTables
from wavefront.texture import TextureTables, make_eval_parameter


@functools.cache
def make_delta_probability(kinds: tuple[str, ...], mask: bool, textures: tuple[str, ...]):
    """`delta_probability(tables, textures, material_index, uv, normal, wo) -> float`: with which probability a sample
    of the BSDF is a delta direction, for its shading normal.

    Args:
        kinds, mask, textures: As of `dispatch.make_bsdf`.
    """
    has_plastic = "plastic" in kinds
    has_blend = bool(set(kinds).intersection(BLENDS))
    eval_parameter = make_eval_parameter(textures)
    weight_of = make_part_weight(textures)
    opacity_at = make_opacity(textures)

    @wp.func
    def delta_of_kind(
        tables: MaterialTables, textures: TextureTables, kind: int, index: int, uv: wp.vec2, cos_o: float
    ) -> float:
        if wp.static(has_plastic):
            if kind == KIND_PLASTIC and cos_o > 0.0:
                p = tables.plastic[index]
                fresnel = fresnel_dielectric(cos_o, p.eta)
                return coating_probability(
                    eval_parameter(textures, p.diffuse, p.diffuse_texture, uv),
                    eval_parameter(textures, p.reflectance, p.reflectance_texture, uv),
                    fresnel.reflectance,
                    fresnel.transmittance,
                )
        return wp.where(kind == KIND_CONDUCTOR or is_delta_transmission(kind), 1.0, 0.0)

    @wp.func
    def delta_probability(
        tables: MaterialTables,
        textures: TextureTables,
        material_index: int,
        uv: wp.vec2,
        normal: wp.vec3,
        wo: wp.vec3,
    ) -> float:
        material = tables.materials[material_index]
        cos_o = wp.dot(normal, wo)
        kind = side_kind(material, cos_o)
        index = wp.where(cos_o >= 0.0, material.front_index, material.back_index)
        if not transmits(kind):
            cos_o = wp.abs(cos_o)
        first = int(-1)
        count = int(1)
        if wp.static(has_blend):
            if is_blend(kind):
                first = tables.blend[index].first
                count = tables.blend[index].count
        probability = float(0.0)
        for i in range(count):
            part_kind = kind
            part_index = index
            weight = float(1.0)
            if wp.static(has_blend):
                if first >= 0:
                    part_kind = tables.blend_parts[first + i].kind
                    part_index = tables.blend_parts[first + i].index
                    weight = weight_of(tables, textures, first + i, uv)
            probability += weight * delta_of_kind(tables, textures, part_kind, part_index, uv, cos_o)
        if wp.static(mask):
            probability = 1.0 + opacity_at(textures, material, uv) * (probability - 1.0)
        return wp.clamp(probability, 0.0, 1.0)

    return delta_probability
