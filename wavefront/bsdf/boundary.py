"""The boundary that a direction crosses, however it was found: its relative index of refraction."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.blend import is_blend
from wavefront.bsdf.dispatch import side_kind
from wavefront.bsdf.frame import ShadingFrame
from wavefront.bsdf.tables import (
    BLENDS,
    KIND_PRINCIPLED_TRANSMISSIVE,
    KIND_ROUGH_DIELECTRIC,
    MaterialTables,
)


@functools.cache
def make_crossed_eta(kinds: tuple[str, ...]):
    """`crossed_eta(tables, material_index, frame, wo, wi) -> float`: n_transmitted / n_incident seen from `wo`, as
    `BsdfSample.eta`; 1 if `wi` is on the side of `wo`.

    For kinds that refract into more than one direction. Of a blend it is that of the first part that refracts. (A
    sample knows the part that made it; but the index only steers Russian roulette, and any is right in the mean.)

    Args:
        kinds: Names of the kinds in a scene, from `tables.KINDS`.
    """
    has_dielectric = "rough_dielectric" in kinds
    has_principled = "principled_transmissive" in kinds
    has_blend = bool(set(kinds).intersection(BLENDS))

    @wp.func
    def refracting_eta(tables: MaterialTables, kind: int, index: int) -> float:
        """Interior over exterior index; 1 for kinds that do not refract."""
        if wp.static(has_dielectric):
            if kind == KIND_ROUGH_DIELECTRIC:
                return tables.dielectric[index].eta
        if wp.static(has_principled):
            if kind == KIND_PRINCIPLED_TRANSMISSIVE:
                return tables.principled[index].eta
        return 1.0

    @wp.func
    def crossed_eta(
        tables: MaterialTables, material_index: int, frame: ShadingFrame, wo: wp.vec3, wi: wp.vec3
    ) -> float:
        cos_o = wp.dot(frame.normal, wo)
        if cos_o * wp.dot(frame.normal, wi) >= 0.0:
            return 1.0
        material = tables.materials[material_index]
        kind = side_kind(material, cos_o)
        index = wp.where(cos_o >= 0.0, material.front_index, material.back_index)
        eta = float(1.0)
        if wp.static(has_blend):
            if is_blend(kind):
                blend = tables.blend[index]
                for i in range(blend.count):
                    part = tables.blend_parts[blend.first + i]
                    if eta == 1.0:
                        eta = refracting_eta(tables, part.kind, part.index)
            else:
                eta = refracting_eta(tables, kind, index)
        else:
            eta = refracting_eta(tables, kind, index)
        return wp.where(cos_o >= 0.0, eta, 1.0 / eta)

    return crossed_eta
