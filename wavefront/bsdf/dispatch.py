"""From a material to its BSDF: sides, opacity, textures, and the kinds that a scene has."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.blend import make_blend
from wavefront.bsdf.frame import ShadingFrame, base_shadowing, make_frame
from wavefront.bsdf.kinds import make_eval_scalar
from wavefront.bsdf.record import BsdfEval, BsdfSample, no_eval
from wavefront.bsdf.tables import (
    KIND_BLEND_TRANSMISSIVE,
    KIND_CONDUCTOR,
    KIND_DIELECTRIC,
    KIND_NONE,
    KIND_NULL,
    KIND_PRINCIPLED_TRANSMISSIVE,
    KIND_ROUGH_DIELECTRIC,
    KIND_THIN_DIELECTRIC,
    Material,
    MaterialTables,
)
from wavefront.texture import TextureTables
from wavefront.warp_samples import to_local, to_world


@wp.func
def is_delta_transmission(kind: int) -> bool:
    return kind == KIND_DIELECTRIC or kind == KIND_THIN_DIELECTRIC or kind == KIND_NULL


@wp.func
def transmits(kind: int) -> bool:
    return (
        is_delta_transmission(kind)
        or kind == KIND_ROUGH_DIELECTRIC
        or kind == KIND_PRINCIPLED_TRANSMISSIVE
        or kind == KIND_BLEND_TRANSMISSIVE
    )


@wp.func
def side_kind(material: Material, cos_o: float) -> int:
    return wp.where(cos_o >= 0.0, material.front, material.back)


@wp.func
def is_smooth(material: Material, cos_o: float) -> bool:
    """Whether the side that is seen has a part that is not a delta, so that a light sample can contribute."""
    kind = side_kind(material, cos_o)
    return not (kind == KIND_NONE or kind == KIND_CONDUCTOR or is_delta_transmission(kind))


@functools.cache
def make_opacity(textures: tuple[str, ...]):
    """`opacity_at(textures, material, uv) -> float`: the share of a surface that is there.

    Args:
        textures: Kinds of texture that parameters may have.
    """
    eval_scalar = make_eval_scalar(textures)

    @wp.func
    def opacity_at(textures: TextureTables, material: Material, uv: wp.vec2) -> float:
        opacity = eval_scalar(textures, material.opacity, material.opacity_texture, uv)
        if material.cutoff > 0.0:
            return wp.where(opacity >= material.cutoff, 1.0, 0.0)
        return wp.clamp(opacity, 0.0, 1.0)

    return opacity_at


@functools.cache
def make_bsdf(kinds: tuple[str, ...], mask: bool, textures: tuple[str, ...], tangents: bool, maps: bool):
    """BSDF functions for the kinds in a scene.

    Args:
        kinds: Names of the kinds, from `tables.KINDS`.
        mask: Whether some material is not opaque.
        textures: Kinds of texture that parameters may have, see `texture.make_eval_texture`.
        tangents: Whether frames have a tangent.
        maps: Whether some material has a bump or normal map.

    Returns:
        `eval_bsdf(tables, textures, material, uv, frame, wo, wi) -> BsdfEval` without the delta parts,
        `sample_bsdf(tables, textures, material, uv, frame, wo, u) -> BsdfSample`, both with directions in world
        space, and `eval_albedo(tables, textures, material, uv, normal, wo) -> vec3`, a colour for denoisers.
    """
    eval_local, sample_local, albedo_local = make_blend(kinds, textures)
    opacity_at = make_opacity(textures)
    _, basis = make_frame(tangents, maps)

    @wp.func
    def mirror_side(kind: int, v: wp.vec3, cos_o: float) -> wp.vec3:
        """A reflecting BSDF always sees its front; one that transmits tells the sides apart itself."""
        if cos_o < 0.0 and not transmits(kind):
            return wp.vec3(v[0], v[1], -v[2])
        return v

    @wp.func
    def eval_bsdf(
        tables: MaterialTables,
        textures: TextureTables,
        material_index: int,
        uv: wp.vec2,
        frame: ShadingFrame,
        wo: wp.vec3,
        wi: wp.vec3,
    ) -> BsdfEval:
        material = tables.materials[material_index]
        s, t = basis(frame)
        wo_local = to_local(s, t, frame.normal, wo)
        cos_o = wo_local[2]
        kind = side_kind(material, cos_o)
        index = wp.where(cos_o >= 0.0, material.front_index, material.back_index)
        result = eval_local(
            tables,
            textures,
            kind,
            index,
            uv,
            mirror_side(kind, wo_local, cos_o),
            mirror_side(kind, to_local(s, t, frame.normal, wi), cos_o),
        )
        if wp.static(maps):
            shadowing = base_shadowing(frame, wi)
            if shadowing == 0.0:
                return no_eval()
            result.value *= shadowing
        if wp.static(mask):
            opacity = opacity_at(textures, material, uv)
            result.value *= opacity
            result.pdf *= opacity
        return result

    @wp.func
    def sample_bsdf(
        tables: MaterialTables,
        textures: TextureTables,
        material_index: int,
        uv: wp.vec2,
        frame: ShadingFrame,
        wo: wp.vec3,
        u: wp.vec3,
    ) -> BsdfSample:
        material = tables.materials[material_index]
        u_lobe = u[2]
        if wp.static(mask):
            opacity = opacity_at(textures, material, uv)
            if u_lobe >= opacity:  # straight through: a delta, chosen with the probability that is its weight
                through = BsdfSample()
                through.wi = -wo
                through.weight = wp.vec3(1.0)
                through.eta = 1.0
                return through
            u_lobe = wp.min(u_lobe / opacity, 1.0 - 5.9604645e-8)  # what is left of the number chooses the lobe
        s, t = basis(frame)
        wo_local = to_local(s, t, frame.normal, wo)
        cos_o = wo_local[2]
        kind = side_kind(material, cos_o)
        index = wp.where(cos_o >= 0.0, material.front_index, material.back_index)
        result = sample_local(
            tables, textures, kind, index, uv, mirror_side(kind, wo_local, cos_o), wp.vec3(u[0], u[1], u_lobe)
        )
        result.wi = to_world(s, t, frame.normal, mirror_side(kind, result.wi, cos_o))
        if wp.static(maps):
            result.weight *= base_shadowing(frame, result.wi)
        if wp.static(mask):
            result.pdf *= opacity
        return result

    @wp.func
    def eval_albedo(
        tables: MaterialTables,
        textures: TextureTables,
        material_index: int,
        uv: wp.vec2,
        normal: wp.vec3,
        wo: wp.vec3,
    ) -> wp.vec3:
        material = tables.materials[material_index]
        cos_o = wp.dot(normal, wo)
        kind = side_kind(material, cos_o)
        index = wp.where(cos_o >= 0.0, material.front_index, material.back_index)
        return albedo_local(tables, textures, kind, index, uv)

    return eval_bsdf, sample_bsdf, eval_albedo
