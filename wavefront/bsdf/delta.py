"""How often a BSDF is sampled in a delta direction, which no other technique can find."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.dispatch import is_delta_transmission, make_opacity
from wavefront.bsdf.fresnel import fresnel_dielectric
from wavefront.bsdf.parts import make_sum_over_parts
from wavefront.bsdf.plastic import coating_probability
from wavefront.bsdf.tables import KIND_CONDUCTOR, KIND_PLASTIC, MaterialTables
from wavefront.texture import TextureTables, make_eval_parameter


@functools.cache
def make_delta_probability(kinds: tuple[str, ...], mask: bool, textures: tuple[str, ...]):
    """`delta_probability(tables, textures, material_index, uv, normal, wo) -> float`: with which probability a sample
    of the BSDF is a delta direction, for its shading normal.

    Args:
        kinds, mask, textures: As of `dispatch.make_bsdf`.
    """
    has_plastic = "plastic" in kinds
    eval_parameter = make_eval_parameter(textures)
    opacity_at = make_opacity(textures)

    @wp.func
    def delta_of_kind(
        tables: MaterialTables, textures: TextureTables, kind: int, index: int, uv: wp.vec2, cos_o: float
    ) -> wp.vec2:
        if wp.static(has_plastic):
            if kind == KIND_PLASTIC and cos_o > 0.0:
                p = tables.plastic[index]
                fresnel = fresnel_dielectric(cos_o, p.eta)
                probability = coating_probability(
                    eval_parameter(textures, p.diffuse, p.diffuse_texture, uv),
                    eval_parameter(textures, p.reflectance, p.reflectance_texture, uv),
                    fresnel.reflectance,
                    fresnel.transmittance,
                )
                return wp.vec2(probability, 1.0)
        return wp.vec2(wp.where(kind == KIND_CONDUCTOR or is_delta_transmission(kind), 1.0, 0.0), 1.0)

    sum_over_parts = make_sum_over_parts(delta_of_kind, kinds, textures)

    @wp.func
    def delta_probability(
        tables: MaterialTables,
        textures: TextureTables,
        material_index: int,
        uv: wp.vec2,
        normal: wp.vec3,
        wo: wp.vec3,
    ) -> float:
        probability = sum_over_parts(tables, textures, material_index, uv, wp.dot(normal, wo))[0]
        if wp.static(mask):
            opacity = opacity_at(textures, tables.materials[material_index], uv)
            probability = 1.0 + opacity * (probability - 1.0)
        return wp.clamp(probability, 0.0, 1.0)

    return delta_probability
