"""How rough a surface is, as an input of what learns how it scatters."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.dispatch import is_delta_transmission
from wavefront.bsdf.kinds import make_eval_alpha, make_principled_at
from wavefront.bsdf.parts import make_sum_over_parts
from wavefront.bsdf.tables import (
    KIND_CONDUCTOR,
    KIND_NONE,
    KIND_PRINCIPLED,
    KIND_PRINCIPLED_TRANSMISSIVE,
    KIND_ROUGH_CONDUCTOR,
    KIND_ROUGH_DIELECTRIC,
    KIND_ROUGH_PLASTIC,
    MaterialTables,
)
from wavefront.texture import TextureTables


@functools.cache
def make_roughness(kinds: tuple[str, ...], textures: tuple[str, ...]):
    """`roughness_at(tables, textures, material_index, uv, cos_o) -> float`, in [0, 1], of the side that is seen.

    The square root of alpha, of the mean of both where they differ; of a principled BSDF its roughness, of a rough
    plastic that of its coating; 1 for diffuse reflection. Of a blend the mean over its parts, by weight. Deltas do not
    count: a plastic with a smooth coating has the roughness of its base.

    Args:
        kinds, textures: As of `dispatch.make_bsdf`.
    """
    has_conductor = "rough_conductor" in kinds
    has_dielectric = "rough_dielectric" in kinds
    has_plastic = "rough_plastic" in kinds
    has_principled = "principled" in kinds or "principled_transmissive" in kinds
    eval_alpha = make_eval_alpha(textures)
    principled_at = make_principled_at(textures)

    @wp.func
    def roughness_of(alpha: wp.vec2) -> float:
        return wp.sqrt(0.5 * (alpha[0] + alpha[1]))

    @wp.func
    def roughness_of_kind(
        tables: MaterialTables, textures: TextureTables, kind: int, index: int, uv: wp.vec2, cos_o: float
    ) -> wp.vec2:
        """Roughness and 1, or zeros for a delta."""
        if kind == KIND_NONE or kind == KIND_CONDUCTOR or is_delta_transmission(kind):
            return wp.vec2(0.0, 0.0)
        roughness = float(1.0)
        if wp.static(has_conductor):
            if kind == KIND_ROUGH_CONDUCTOR:
                c = tables.conductor[index]
                roughness = roughness_of(eval_alpha(textures, c.alpha, c.alpha_u_texture, c.alpha_v_texture, uv))
        if wp.static(has_dielectric):
            if kind == KIND_ROUGH_DIELECTRIC:
                d = tables.dielectric[index]
                roughness = roughness_of(eval_alpha(textures, d.alpha, d.alpha_u_texture, d.alpha_v_texture, uv))
        if wp.static(has_plastic):
            if kind == KIND_ROUGH_PLASTIC:
                roughness = wp.sqrt(tables.plastic[index].alpha)
        if wp.static(has_principled):
            if kind == KIND_PRINCIPLED or kind == KIND_PRINCIPLED_TRANSMISSIVE:
                roughness = principled_at(tables.principled[index], textures, uv).roughness
        return wp.vec2(roughness, 1.0)

    sum_over_parts = make_sum_over_parts(roughness_of_kind, kinds, textures)

    @wp.func
    def roughness_at(
        tables: MaterialTables, textures: TextureTables, material_index: int, uv: wp.vec2, cos_o: float
    ) -> float:
        sums = sum_over_parts(tables, textures, material_index, uv, cos_o)
        return wp.where(sums[1] > 0.0, sums[0] / sums[1], 1.0)

    return roughness_at
