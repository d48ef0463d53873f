"""Sums over the BSDFs that a material is blended of."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.blend import is_blend, make_part_weight
from wavefront.bsdf.dispatch import side_kind, transmits
from wavefront.bsdf.tables import BLENDS, MaterialTables
from wavefront.texture import TextureTables


@functools.cache
def make_sum_over_parts(of_kind: wp.Function, kinds: tuple[str, ...], textures: tuple[str, ...]):
    """`sum_over_parts(tables, textures, material_index, uv, cos_o) -> vec2`: of a function of the BSDFs on the side of
    a material that is seen, by their weights in its blend; of one BSDF, the function itself.

    Args:
        of_kind: (tables, textures, kind, index, uv, cos_o) -> vec2. The cosine is negative only behind a BSDF that
            transmits.
        kinds, textures: As of `dispatch.make_bsdf`.
    """
    has_blend = bool(set(kinds).intersection(BLENDS))
    weight_of = make_part_weight(textures)

    @wp.func
    def sum_over_parts(
        tables: MaterialTables, textures: TextureTables, material_index: int, uv: wp.vec2, cos_o: float
    ) -> wp.vec2:
        material = tables.materials[material_index]
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
        total = wp.vec2(0.0)
        for i in range(count):
            part_kind = kind
            part_index = index
            weight = float(1.0)
            if wp.static(has_blend):
                if first >= 0:
                    part_kind = tables.blend_parts[first + i].kind
                    part_index = tables.blend_parts[first + i].index
                    weight = weight_of(tables, textures, first + i, uv)
            total += weight * of_kind(tables, textures, part_kind, part_index, uv, cos_o)
        return total

    return sum_over_parts
