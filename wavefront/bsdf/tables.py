"""Materials on the device: one table of records per kind of BSDF, and a table of materials that names them.

Two-sidedness and opacity are properties of a material; what remains of a BSDF has one record in its kind's table.
Each parameter is a value and the index of a texture that replaces it (-1: none).
"""

from __future__ import annotations

import warp as wp

KIND_NONE = wp.constant(0)  # absorbs: the back of a one-sided surface
KIND_DIFFUSE = wp.constant(1)
KIND_CONDUCTOR = wp.constant(2)
KIND_ROUGH_CONDUCTOR = wp.constant(3)
KIND_DIELECTRIC = wp.constant(4)
KIND_ROUGH_DIELECTRIC = wp.constant(5)
KIND_PLASTIC = wp.constant(6)
KIND_ROUGH_PLASTIC = wp.constant(7)
KIND_THIN_DIELECTRIC = wp.constant(8)
KIND_NULL = wp.constant(9)
KIND_OREN_NAYAR = wp.constant(10)
KIND_PRINCIPLED = wp.constant(11)
KIND_PRINCIPLED_TRANSMISSIVE = wp.constant(12)
KIND_BLEND = wp.constant(20)  # of BSDFs that reflect
KIND_BLEND_TRANSMISSIVE = wp.constant(21)  # of BSDFs of which one transmits
KINDS = {
    "diffuse": 1,
    "conductor": 2,
    "rough_conductor": 3,
    "dielectric": 4,
    "rough_dielectric": 5,
    "plastic": 6,
    "rough_plastic": 7,
    "thin_dielectric": 8,
    "null": 9,
    "oren_nayar": 10,
    "principled": 11,
    "principled_transmissive": 12,
    "blend": 20,
    "blend_transmissive": 21,
}
TRANSMISSIVE = (
    "dielectric",
    "rough_dielectric",
    "thin_dielectric",
    "null",
    "principled_transmissive",
    "blend_transmissive",
)
BLENDS = ("blend", "blend_transmissive")
DELTA = ("conductor", "dielectric", "thin_dielectric", "null")


@wp.struct
class Material:
    front: wp.int32  # kind on the side of the normal, and its record
    front_index: wp.int32
    back: wp.int32
    back_index: wp.int32
    opacity: wp.float32
    opacity_texture: wp.int32
    cutoff: wp.float32  # above 0: opacity is 1 from here on, and 0 below
    texture: wp.int32  # one of those that are looked up, to be fetched ahead; -1: none


@wp.struct
class DiffuseRecord:
    reflectance: wp.vec3
    reflectance_texture: wp.int32


@wp.struct
class OrenNayarRecord:
    reflectance: wp.vec3
    reflectance_texture: wp.int32
    roughness: wp.float32
    roughness_texture: wp.int32


@wp.struct
class ConductorRecord:
    """Smooth and rough; `alpha` and `distribution` are read for rough conductors only."""

    eta: wp.vec3
    eta_texture: wp.int32
    k: wp.vec3
    k_texture: wp.int32
    reflectance: wp.vec3
    reflectance_texture: wp.int32
    alpha: wp.vec2  # along the tangent and across it
    alpha_u_texture: wp.int32
    alpha_v_texture: wp.int32
    distribution: wp.int32


@wp.struct
class DielectricRecord:
    """Smooth, rough and thin; `alpha` and `distribution` are read for rough dielectrics only."""

    eta: wp.float32  # interior over exterior index of refraction
    reflectance: wp.vec3
    reflectance_texture: wp.int32
    transmittance: wp.vec3
    transmittance_texture: wp.int32
    alpha: wp.vec2  # along the tangent and across it
    alpha_u_texture: wp.int32
    alpha_v_texture: wp.int32
    distribution: wp.int32


@wp.struct
class PlasticRecord:
    """Smooth and rough; `alpha`, `distribution` and `first` are read for rough plastics only."""

    eta: wp.float32  # interior over exterior index of refraction
    internal_reflectance: wp.float32  # of the coating, for diffuse light from inside
    nonlinear: wp.int32
    diffuse: wp.vec3
    diffuse_texture: wp.int32
    reflectance: wp.vec3
    reflectance_texture: wp.int32
    alpha: wp.float32
    distribution: wp.int32
    first: wp.int32  # index into MaterialTables.coatings of the coating's transmittance


# Parameters of a principled BSDF that are numbers from 0 to 1, or textures, in the order of a record.
PRINCIPLED_FRACTIONS = (
    "roughness",
    "anisotropic",
    "metallic",
    "spec_trans",
    "spec_tint",
    "sheen",
    "sheen_tint",
    "flatness",
    "clearcoat",
    "clearcoat_gloss",
)
PrincipledFractions = wp.types.vector(length=len(PRINCIPLED_FRACTIONS), dtype=wp.float32)
PrincipledTextures = wp.types.vector(length=len(PRINCIPLED_FRACTIONS), dtype=wp.int32)


@wp.struct
class PrincipledRecord:
    """Only the fractions that have a texture are listed with one, so that what has none costs nothing to look up."""

    eta: wp.float32  # interior over exterior index of refraction
    specular_rate: wp.float32  # of sampling
    clearcoat_rate: wp.float32
    diffuse_rate: wp.float32
    base_color: wp.vec3
    base_color_texture: wp.int32
    fractions: PrincipledFractions
    textured: wp.int32  # how many fractions have a texture
    textured_fraction: PrincipledTextures  # the first `textured`: which ones
    fraction_texture: PrincipledTextures


@wp.struct
class BlendRecord:
    """A mixture; a blend of blends is flattened."""

    first: wp.int32  # index into MaterialTables.blend_parts
    count: wp.int32


@wp.struct
class BlendPart:
    """A BSDF of a mixture, and which factors make its weight."""

    kind: wp.int32
    index: wp.int32
    first: wp.int32  # index into MaterialTables.blend_factors
    count: wp.int32


@wp.struct
class BlendFactor:
    weight: wp.float32
    weight_texture: wp.int32
    complement: wp.int32  # 1: the factor is 1 - weight


MAP_NORMAL = wp.constant(0)
MAP_BUMP = wp.constant(1)
MAPS = {"normal": 0, "bump": 1}


@wp.struct
class MapRecord:
    """A normal map (`normal`, or a texture, of the normal's coordinates in [0, 1], x and y times `scale`) or a bump
    map (a texture of the height, times `scale`)."""

    kind: wp.int32
    normal: wp.vec3
    texture: wp.int32
    scale: wp.float32
    flip: wp.int32  # 1: turn a normal that faces away from the viewer
    shadowing: wp.int32  # 1: see `frame.base_shadowing`


@wp.struct
class MaterialMaps:
    front: wp.int32  # index into MaterialTables.maps; -1: none
    back: wp.int32
    mirrored: wp.int32  # 1: the map of the back is inside a two-sided BSDF, hence belongs to its mirror image


@wp.struct
class MaterialTables:
    materials: wp.array[Material]
    maps_of: wp.array[MaterialMaps]  # per material; empty if none has a map
    maps: wp.array[MapRecord]
    blend: wp.array[BlendRecord]
    blend_parts: wp.array[BlendPart]
    blend_factors: wp.array[BlendFactor]
    diffuse: wp.array[DiffuseRecord]
    conductor: wp.array[ConductorRecord]
    dielectric: wp.array[DielectricRecord]
    plastic: wp.array[PlasticRecord]
    oren_nayar: wp.array[OrenNayarRecord]
    principled: wp.array[PrincipledRecord]
    coatings: wp.array[wp.float32]
