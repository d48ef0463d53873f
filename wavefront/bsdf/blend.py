"""Blend: a mixture of BSDFs, f = sum of w f over its parts, the weights w adding to one."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.kinds import make_eval_scalar, make_kinds
from wavefront.bsdf.record import BsdfEval, BsdfSample, no_sample
from wavefront.bsdf.tables import BLENDS, KIND_BLEND, KIND_BLEND_TRANSMISSIVE, MaterialTables
from wavefront.texture import TextureTables


@wp.func
def is_blend(kind: int) -> bool:
    return kind == KIND_BLEND or kind == KIND_BLEND_TRANSMISSIVE


@functools.cache
def make_blend(kinds: tuple[str, ...], textures: tuple[str, ...]):
    """The functions of `make_kinds`, for blends too; the very same where a scene has none."""
    functions = make_kinds(kinds, textures)
    if not set(kinds).intersection(BLENDS):
        return functions
    eval_local, sample_local, albedo_local = functions
    eval_scalar = make_eval_scalar(textures)

    @wp.func
    def weight_of(tables: MaterialTables, textures: TextureTables, part: int, uv: wp.vec2) -> float:
        weight = float(1.0)
        for i in range(tables.blend_parts[part].count):
            factor = tables.blend_factors[tables.blend_parts[part].first + i]
            w = wp.clamp(eval_scalar(textures, factor.weight, factor.weight_texture, uv), 0.0, 1.0)
            weight *= wp.where(factor.complement == 1, 1.0 - w, w)
        return weight

    @wp.func
    def eval_parts(
        tables: MaterialTables,
        textures: TextureTables,
        index: int,
        uv: wp.vec2,
        wo: wp.vec3,
        wi: wp.vec3,
        but: int,
    ) -> BsdfEval:
        """Sum over all parts except `but`."""
        result = BsdfEval()
        blend = tables.blend[index]
        for i in range(blend.count):
            part = blend.first + i
            if part != but:
                w = weight_of(tables, textures, part, uv)
                if w > 0.0:
                    e = eval_local(
                        tables, textures, tables.blend_parts[part].kind, tables.blend_parts[part].index, uv, wo, wi
                    )
                    result.value += w * e.value
                    result.pdf += w * e.pdf
        return result

    @wp.func
    def eval_blend(
        tables: MaterialTables, textures: TextureTables, kind: int, index: int, uv: wp.vec2, wo: wp.vec3, wi: wp.vec3
    ) -> BsdfEval:
        if is_blend(kind):
            return eval_parts(tables, textures, index, uv, wo, wi, -1)
        return eval_local(tables, textures, kind, index, uv, wo, wi)

    @wp.func
    def sample_blend(
        tables: MaterialTables, textures: TextureTables, kind: int, index: int, uv: wp.vec2, wo: wp.vec3, u: wp.vec3
    ) -> BsdfSample:
        """Chooses a part by its weight, which cancels from a delta direction; others are weighted with all parts."""
        if not is_blend(kind):
            return sample_local(tables, textures, kind, index, uv, wo, u)
        blend = tables.blend[index]
        chosen = int(-1)
        weight = float(0.0)
        lobe = float(0.0)
        rest = float(u[2])
        for i in range(blend.count):
            # Up to the part in whose share of [0, 1) the number falls, or the last one with a share.
            if chosen < 0 or rest >= 0.0:
                w = weight_of(tables, textures, blend.first + i, uv)
                if w > 0.0:
                    chosen = blend.first + i
                    weight = w
                    lobe = wp.min(rest / w, 1.0 - 5.9604645e-8)  # what is left of the number chooses the lobe
                    rest -= w
        if chosen < 0:
            return no_sample()
        part = tables.blend_parts[chosen]
        result = sample_local(tables, textures, part.kind, part.index, uv, wo, wp.vec3(u[0], u[1], lobe))
        if result.pdf > 0.0:
            others = eval_parts(tables, textures, index, uv, wo, result.wi, chosen)
            own = weight * result.pdf
            result.pdf = own + others.pdf
            result.weight = (own * result.weight + others.value) / result.pdf
        return result

    @wp.func
    def albedo_blend(tables: MaterialTables, textures: TextureTables, kind: int, index: int, uv: wp.vec2) -> wp.vec3:
        if is_blend(kind):
            albedo = wp.vec3(0.0)
            blend = tables.blend[index]
            for i in range(blend.count):
                part = tables.blend_parts[blend.first + i]
                w = weight_of(tables, textures, blend.first + i, uv)
                albedo += w * albedo_local(tables, textures, part.kind, part.index, uv)
            return albedo
        return albedo_local(tables, textures, kind, index, uv)

    return eval_blend, sample_blend, albedo_blend
