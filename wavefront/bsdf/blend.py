"""Blend: a mixture of BSDFs, f = sum of w f over its parts, the weights w adding to one."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.kinds import make_eval_scalar, make_kinds
from wavefront.bsdf.record import BsdfEval, BsdfSample
from wavefront.bsdf.tables import BLENDS, KIND_BLEND, KIND_BLEND_TRANSMISSIVE, KIND_NONE, MaterialTables
from wavefront.texture import TextureTables


@wp.func
def is_blend(kind: int) -> bool:
    return kind == KIND_BLEND or kind == KIND_BLEND_TRANSMISSIVE


@functools.cache
def make_part_weight(textures: tuple[str, ...]):
    """`weight_of(tables, textures, part, uv) -> float`: the weight of a part of a blend.

    Args:
        textures: Kinds of texture that parameters may have.
    """
    eval_scalar = make_eval_scalar(textures)

    @wp.func
    def weight_of(tables: MaterialTables, textures: TextureTables, part: int, uv: wp.vec2) -> float:
        weight = float(1.0)
        for i in range(tables.blend_parts[part].count):
            factor = tables.blend_factors[tables.blend_parts[part].first + i]
            w = wp.clamp(eval_scalar(textures, factor.weight, factor.weight_texture, uv), 0.0, 1.0)
            weight *= wp.where(factor.complement == 1, 1.0 - w, w)
        return weight

    return weight_of


@functools.cache
def make_blend(kinds: tuple[str, ...], textures: tuple[str, ...]):
    """The functions of `make_kinds`, for blends too; the very same where a scene has none."""
    functions = make_kinds(kinds, textures)
    if not set(kinds).intersection(BLENDS):
        return functions
    eval_local, sample_local, albedo_local = functions
    weight_of = make_part_weight(textures)

    # Each function has one place where it calls that of `make_kinds`, which is large: a BSDF that is no blend goes the
    # way of a part. Else CUDA's compiler has all of it twice.

    @wp.func
    def eval_parts(
        tables: MaterialTables,
        textures: TextureTables,
        kind: int,
        index: int,
        uv: wp.vec2,
        wo: wp.vec3,
        wi: wp.vec3,
        but: int,
    ) -> BsdfEval:
        """Sum over all parts except `but`."""
        result = BsdfEval()
        first = int(-1)
        count = int(1)
        if is_blend(kind):
            first = tables.blend[index].first
            count = tables.blend[index].count
        for i in range(count):
            part_kind = kind
            part_index = index
            w = float(1.0)
            if first >= 0:
                part_kind = tables.blend_parts[first + i].kind
                part_index = tables.blend_parts[first + i].index
                w = weight_of(tables, textures, first + i, uv)
            if w > 0.0 and i != but:
                e = eval_local(tables, textures, part_kind, part_index, uv, wo, wi)
                result.value += w * e.value
                result.pdf += w * e.pdf
        return result

    @wp.func
    def eval_blend(
        tables: MaterialTables, textures: TextureTables, kind: int, index: int, uv: wp.vec2, wo: wp.vec3, wi: wp.vec3
    ) -> BsdfEval:
        return eval_parts(tables, textures, kind, index, uv, wo, wi, -1)

    @wp.func
    def sample_blend(
        tables: MaterialTables, textures: TextureTables, kind: int, index: int, uv: wp.vec2, wo: wp.vec3, u: wp.vec3
    ) -> BsdfSample:
        """Chooses a part by its weight, which cancels from a delta direction; others are weighted with all parts."""
        part_kind = kind
        part_index = index
        chosen = int(-1)
        weight = float(1.0)
        lobe = float(u[2])
        if is_blend(kind):
            part_kind = KIND_NONE  # where no part has a share
            blend = tables.blend[index]
            rest = float(u[2])
            for i in range(blend.count):
                # Up to the part in whose share of [0, 1) the number falls, or the last one with a share.
                if chosen < 0 or rest >= 0.0:
                    w = weight_of(tables, textures, blend.first + i, uv)
                    if w > 0.0:
                        chosen = i
                        weight = w
                        lobe = wp.min(rest / w, 1.0 - 5.9604645e-8)  # what is left of the number chooses the lobe
                        rest -= w
            if chosen >= 0:
                part_kind = tables.blend_parts[blend.first + chosen].kind
                part_index = tables.blend_parts[blend.first + chosen].index
        result = sample_local(tables, textures, part_kind, part_index, uv, wo, wp.vec3(u[0], u[1], lobe))
        if chosen >= 0 and result.pdf > 0.0:
            others = eval_parts(tables, textures, kind, index, uv, wo, result.wi, chosen)
            own = weight * result.pdf
            result.pdf = own + others.pdf
            result.weight = (own * result.weight + others.value) / result.pdf
        return result

    @wp.func
    def albedo_blend(tables: MaterialTables, textures: TextureTables, kind: int, index: int, uv: wp.vec2) -> wp.vec3:
        albedo = wp.vec3(0.0)
        first = int(-1)
        count = int(1)
        if is_blend(kind):
            first = tables.blend[index].first
            count = tables.blend[index].count
        for i in range(count):
            part_kind = kind
            part_index = index
            w = float(1.0)
            if first >= 0:
                part_kind = tables.blend_parts[first + i].kind
                part_index = tables.blend_parts[first + i].index
                w = weight_of(tables, textures, first + i, uv)
            albedo += w * albedo_local(tables, textures, part_kind, part_index, uv)
        return albedo

    return eval_blend, sample_blend, albedo_blend
