"""The scene records: what a scene file says, typed.

Every importer produces these records and everything downstream reads only them. The JSON Schema of the scene
format is generated from them, so a field's description here is its documentation there.

Conventions: right-handed, Y up, metres, degrees; linear Rec. 709 colour. UV (0, 0) is the upper left corner of an
image (first row of the file), as in glTF. A camera looks along its local -Z with +X to the right and +Y up.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

NonNegative = Annotated[float, Meta(ge=0.0)]
Positive = Annotated[float, Meta(gt=0.0)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]
Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Vec4 = tuple[float, float, float, float]

# Three numbers as a list of fixed length: msgspec 0.22 corrupts memory where one union holds both a constrained
# float and a fixed-length tuple.
RGB = Annotated[list[NonNegative], Meta(min_length=3, max_length=3)]
RGBFraction = Annotated[list[Fraction], Meta(min_length=3, max_length=3)]


class Record(msgspec.Struct, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Base of all scene records: keyword-only, unknown keys refused, defaults left out when written."""


# --- transforms ------------------------------------------------------------------------------------------------


class LookAt(Record):
    origin: Annotated[Vec3, Meta(description="Position of the viewer.")]
    target: Annotated[Vec3, Meta(description="Point that local -Z points at.")]
    up: Annotated[Vec3, Meta(description="Direction that local +Y leans to.")] = (0.0, 1.0, 0.0)


class Rotate(Record):
    axis: Vec3
    angle: Annotated[float, Meta(description="Degrees, counter-clockwise seen against the axis.")]


class TransformStep(Record):
    """One step of a transform; exactly one key is given."""

    translate: Vec3 | None = None
    rotate: Rotate | None = None
    scale: float | Vec3 | None = None
    look_at: LookAt | None = None
    matrix: tuple[Vec4, Vec4, Vec4, Vec4] | None = None


Transform = Annotated[
    list[TransformStep | Vec4],
    Meta(description="Four rows of a 4x4 matrix that acts on column vectors, or steps; the first is applied first."),
]

# --- textures --------------------------------------------------------------------------------------------------

UVTransform = Annotated[
    tuple[Vec3, Vec3],
    Meta(description="Rows of a 2x3 matrix that maps (u, v, 1) of the surface to the texture."),
]
IDENTITY_UV = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


class Bitmap(Record, tag_field="type", tag="bitmap"):
    """An image file: PNG or TIFF (8 or 16 bit, TIFF also float), JPEG, BMP, TGA, OpenEXR, or Radiance HDR."""

    file: Annotated[str, Meta(description="Path of the image, relative to the scene file.", min_length=1)]
    name: str = ""
    image: Annotated[
        Annotated[int, Meta(ge=0)] | None, Meta(description="Index of an image that lies inside a glTF file.")
    ] = None
    channel: Annotated[
        Literal["r", "g", "b", "a"] | None,
        Meta(description="This one alone, as a number; default: the colour. a is 1 where the image has no alpha."),
    ] = None
    color_space: Annotated[
        Literal["auto", "srgb", "linear"],
        Meta(description="How values are encoded; auto: colours of 8 or 16 bit are sRGB, all else is linear."),
    ] = "auto"
    scale: Annotated[
        NonNegative | RGB, Meta(description="Multiplies the (linear) values; a colour those of the same channel.")
    ] = 1.0
    filter: Literal["bilinear", "nearest"] = "bilinear"
    wrap: Literal["repeat", "mirror", "clamp"] = "repeat"
    uv_transform: UVTransform = IDENTITY_UV


class Checkerboard(Record, tag_field="type", tag="checkerboard"):
    """Two colours in a 2x2 pattern per unit of UV: color0 where both halves agree, color1 elsewhere."""

    name: str = ""
    color0: NonNegative | RGB = 0.4
    color1: NonNegative | RGB = 0.2
    uv_transform: UVTransform = IDENTITY_UV


Texture = Bitmap | Checkerboard

# A grey value, a colour, the name of a texture, or a texture. Only the range differs between the kinds.
Reflectance = Fraction | RGBFraction | str | Bitmap | Checkerboard
Radiance = NonNegative | RGB | str | Bitmap | Checkerboard
Spectrum = Radiance  # unbounded above: eta and k of a conductor
Alpha = Annotated[float, Meta(ge=1e-4, le=1.0)] | str | Bitmap | Checkerboard
Opacity = Fraction | str | Bitmap | Checkerboard

# --- BSDFs -----------------------------------------------------------------------------------------------------

Distribution = Literal["ggx", "beckmann"]


class Diffuse(Record, tag_field="type", tag="diffuse"):
    """Lambertian reflection, one-sided."""

    name: str = ""
    reflectance: Reflectance = 0.5


class OrenNayar(Record, tag_field="type", tag="oren_nayar"):
    """Rough diffuse reflection (Oren and Nayar 1994 in Fujii's improved form), one-sided."""

    name: str = ""
    reflectance: Reflectance = 0.5
    roughness: Annotated[Opacity, Meta(description="0: Lambertian; 1: as rough as the model goes.")] = 0.5


class Conductor(Record, tag_field="type", tag="conductor"):
    """Smooth conductor with a complex index of refraction."""

    name: str = ""
    material: Annotated[str | None, Meta(description="Named metal; excludes eta and k.")] = None
    eta: Spectrum | None = None
    k: Spectrum | None = None
    specular_reflectance: Reflectance = 1.0


class RoughConductor(Record, tag_field="type", tag="rough_conductor"):
    """Conductor with a microfacet surface."""

    name: str = ""
    material: Annotated[str | None, Meta(description="Named metal; excludes eta and k.")] = None
    eta: Spectrum | None = None
    k: Spectrum | None = None
    specular_reflectance: Reflectance = 1.0
    alpha: Annotated[
        Alpha | None,
        Meta(description="Microfacet roughness (root mean square slope for Beckmann); default: 0.1."),
    ] = None
    alpha_u: Annotated[Alpha | None, Meta(description="Roughness along growing u; with alpha_v instead of alpha.")] = (
        None
    )
    alpha_v: Annotated[Alpha | None, Meta(description="Roughness across it; with alpha_u instead of alpha.")] = None
    distribution: Distribution = "ggx"


IOR = Annotated[float, Meta(gt=0.0)] | str


class Dielectric(Record, tag_field="type", tag="dielectric"):
    """Smooth boundary between two dielectrics; the normal points to the exterior."""

    name: str = ""
    int_ior: Annotated[
        IOR, Meta(description="Interior index of refraction, or a name such as water, bk7, diamond.")
    ] = 1.5046
    ext_ior: Annotated[IOR, Meta(description="Exterior index of refraction, or a name.")] = 1.000277
    specular_reflectance: Reflectance = 1.0
    specular_transmittance: Reflectance = 1.0


class RoughDielectric(Record, tag_field="type", tag="rough_dielectric"):
    """Boundary between two dielectrics with a microfacet surface."""

    name: str = ""
    int_ior: Annotated[
        IOR, Meta(description="Interior index of refraction, or a name such as water, bk7, diamond.")
    ] = 1.5046
    ext_ior: Annotated[IOR, Meta(description="Exterior index of refraction, or a name.")] = 1.000277
    specular_reflectance: Reflectance = 1.0
    specular_transmittance: Reflectance = 1.0
    alpha: Annotated[
        Alpha | None,
        Meta(description="Microfacet roughness (root mean square slope for Beckmann); default: 0.1."),
    ] = None
    alpha_u: Annotated[Alpha | None, Meta(description="Roughness along growing u; with alpha_v instead of alpha.")] = (
        None
    )
    alpha_v: Annotated[Alpha | None, Meta(description="Roughness across it; with alpha_u instead of alpha.")] = None
    distribution: Distribution = "ggx"


class Plastic(Record, tag_field="type", tag="plastic"):
    """A diffuse base below a smooth dielectric coating, one-sided."""

    name: str = ""
    int_ior: Annotated[IOR, Meta(description="Index of refraction of the coating, or a name.")] = 1.49
    ext_ior: Annotated[IOR, Meta(description="Exterior index of refraction, or a name.")] = 1.000277
    diffuse_reflectance: Reflectance = 0.5
    specular_reflectance: Reflectance = 1.0
    nonlinear: Annotated[bool, Meta(description="Let colours saturate by light that bounces below the coating.")] = (
        False
    )


class RoughPlastic(Record, tag_field="type", tag="rough_plastic"):
    """A diffuse base below a dielectric coating with a microfacet surface, one-sided."""

    name: str = ""
    int_ior: Annotated[IOR, Meta(description="Index of refraction of the coating, or a name.")] = 1.49
    ext_ior: Annotated[IOR, Meta(description="Exterior index of refraction, or a name.")] = 1.000277
    diffuse_reflectance: Reflectance = 0.5
    specular_reflectance: Reflectance = 1.0
    nonlinear: Annotated[bool, Meta(description="Let colours saturate by light that bounces below the coating.")] = (
        False
    )
    alpha: Annotated[
        float, Meta(ge=1e-4, le=1.0, description="Microfacet roughness (root mean square slope for Beckmann).")
    ] = 0.1
    distribution: Distribution = "ggx"


class ThinDielectric(Record, tag_field="type", tag="thin_dielectric"):
    """A thin sheet of glass, modelled by one surface: reflects and lets pass without refraction, both sides alike."""

    name: str = ""
    int_ior: Annotated[IOR, Meta(description="Index of refraction of the sheet, or a name.")] = 1.5046
    ext_ior: Annotated[IOR, Meta(description="Exterior index of refraction, or a name.")] = 1.000277
    specular_reflectance: Reflectance = 1.0
    specular_transmittance: Reflectance = 1.0


class Principled(Record, tag_field="type", tag="principled"):
    """The Disney model as Mitsuba 3 parameterises it: metal, coloured glass, paint, cloth and lacquer in one BSDF.

    Burley 2012, "Physically Based Shading at Disney", and 2015, "Extending the Disney BRDF to a BSDF with Integrated
    Subsurface Scattering". One-sided unless it transmits; the normal then points to the exterior.
    """

    name: str = ""
    base_color: Reflectance = 0.5
    roughness: Annotated[Opacity, Meta(description="Square root of the GGX alpha of the main specular lobe.")] = 0.5
    anisotropic: Annotated[Opacity, Meta(description="Stretches the main specular lobe along the tangent.")] = 0.0
    metallic: Annotated[Opacity, Meta(description="0: dielectric; 1: metal that reflects base_color.")] = 0.0
    spec_trans: Annotated[
        Opacity, Meta(description="Share of the dielectric that refracts in place of the diffuse base: 1 is glass.")
    ] = 0.0
    eta: Annotated[
        Positive | None, Meta(description="Interior over exterior index of refraction; excludes specular.")
    ] = None
    specular: Annotated[
        Fraction | None, Meta(description="12.5 times the reflectance at normal incidence; default, without eta: 0.5.")
    ] = None
    spec_tint: Annotated[Opacity, Meta(description="Tints the dielectric reflection towards base_color.")] = 0.0
    sheen: Annotated[Opacity, Meta(description="Strength of the grazing lobe of cloth.")] = 0.0
    sheen_tint: Annotated[Opacity, Meta(description="Tints the sheen towards base_color.")] = 0.0
    flatness: Annotated[
        Opacity, Meta(description="From diffuse reflection to an approximation of subsurface scattering.")
    ] = 0.0
    clearcoat: Annotated[Opacity, Meta(description="Strength of a second, isotropic specular lobe.")] = 0.0
    clearcoat_gloss: Annotated[Opacity, Meta(description="0: a soft clearcoat; 1: a sharp one.")] = 0.0
    main_specular_sampling_rate: Annotated[
        Positive, Meta(description="Weight of the main specular lobe in sampling.")
    ] = 1.0
    clearcoat_sampling_rate: Annotated[NonNegative, Meta(description="Weight of the clearcoat in sampling.")] = 1.0
    diffuse_reflectance_sampling_rate: Annotated[
        NonNegative, Meta(description="Weight of the diffuse lobe in sampling.")
    ] = 1.0


class Null(Record, tag_field="type", tag="null"):
    """A surface that is not there: light passes. It can still emit."""

    name: str = ""


class TwoSided(Record, tag_field="type", tag="twosided"):
    """A reflecting BSDF on both sides of a surface; `back` defaults to `front`."""

    front: Annotated[str | Bsdf, Meta(description="Name of a BSDF, or a BSDF.")]
    name: str = ""
    back: str | Bsdf | None = None


class Mask(Record, tag_field="type", tag="mask"):
    """Opacity: the surface is there with probability `opacity`, else light passes straight through."""

    bsdf: Annotated[str | Bsdf, Meta(description="Name of a BSDF, or a BSDF.")]
    name: str = ""
    opacity: Opacity = 0.5
    cutoff: Annotated[
        Positive | None,
        Meta(description="Where opacity is at least this, the surface is there for certain, and elsewhere it is not."),
    ] = None


class NormalMap(Record, tag_field="type", tag="normal_map"):
    """Turns the shading frame by normals from an image; goes around what is to be shaded so."""

    bsdf: Annotated[str | Bsdf, Meta(description="Name of a BSDF, or a BSDF; no mask, null or other map.")]
    normal: Annotated[
        RGBFraction | str | Bitmap | Checkerboard,
        Meta(
            description="(x, y, z) of the normal scaled to [0, 1], as in glTF: x is along growing u, y up in the "
            "image. 8-bit images are linear."
        ),
    ]
    name: str = ""
    scale: Annotated[float, Meta(description="Multiplies x and y of the normal.")] = 1.0
    flip_invalid_normals: Annotated[
        bool, Meta(description="Turn a normal that faces away from the viewer about the base normal.")
    ] = True
    shadowing: Annotated[bool, Meta(description="Darken light from near the horizon of the base surface.")] = True


class BumpMap(Record, tag_field="type", tag="bump_map"):
    """Turns the shading frame by the slope of a height field; goes around what is to be shaded so."""

    bsdf: Annotated[str | Bsdf, Meta(description="Name of a BSDF, or a BSDF; no mask, null or other map.")]
    height: Annotated[
        str | Bitmap,
        Meta(description="Bilinear image of the height along the normal, metres. 8-bit images are linear."),
    ]
    name: str = ""
    scale: Annotated[float, Meta(description="Multiplies the height.")] = 1.0
    flip_invalid_normals: Annotated[
        bool, Meta(description="Turn a normal that faces away from the viewer about the base normal.")
    ] = True
    shadowing: Annotated[bool, Meta(description="Darken light from near the horizon of the base surface.")] = True


class Blend(Record, tag_field="type", tag="blend"):
    """A mixture of two BSDFs, (1 - weight) first + weight second, each of which may be a blend."""

    first: Annotated[str | Bsdf, Meta(description="Name of a BSDF, or a BSDF; no mask, twosided or map.")]
    second: Annotated[str | Bsdf, Meta(description="Name of a BSDF, or a BSDF; no mask, twosided or map.")]
    name: str = ""
    weight: Annotated[Opacity, Meta(description="Of the second.")] = 0.5


Bsdf = (
    Diffuse
    | OrenNayar
    | Conductor
    | RoughConductor
    | Dielectric
    | RoughDielectric
    | ThinDielectric
    | Plastic
    | RoughPlastic
    | Principled
    | Null
    | Blend
    | NormalMap
    | BumpMap
    | TwoSided
    | Mask
)

# --- emitters --------------------------------------------------------------------------------------------------


class Area(Record, tag_field="type", tag="area"):
    """Diffuse emission from the front of a shape, or from both sides."""

    radiance: Annotated[Radiance, Meta(description="W / (m^2 sr)")] = 1.0
    two_sided: Annotated[bool, Meta(description="The back emits as the front does.")] = False


class Constant(Record, tag_field="type", tag="constant"):
    """An environment of the same radiance from every direction."""

    name: str = ""
    radiance: NonNegative | RGB = 1.0


class Envmap(Record, tag_field="type", tag="envmap"):
    """An image of the environment in latitude and longitude: its middle is at local -Z, its first row at +Y.

    The columns go clockwise seen from above, from +Z over +X. The first and the last row are the poles themselves.
    """

    file: Annotated[
        str,
        Meta(description="An image as of a bitmap; integers are sRGB. Relative to the scene file.", min_length=1),
    ]
    name: str = ""
    scale: Annotated[NonNegative, Meta(description="Multiplies the image.")] = 1.0
    to_world: Annotated[Transform, Meta(description="A rotation or a mirror; other parts have no meaning here.")] = []


class Directional(Record, tag_field="type", tag="directional"):
    """Parallel light from infinitely far away. Found by next-event estimation only."""

    direction: Annotated[Vec3, Meta(description="Where the light travels to.")]
    name: str = ""
    irradiance: Annotated[NonNegative | RGB, Meta(description="On a surface that faces the light, W / m^2.")] = 1.0


class Point(Record, tag_field="type", tag="point"):
    """Light from a point, the same in all directions. Found by next-event estimation only."""

    position: Vec3
    name: str = ""
    intensity: Annotated[NonNegative | RGB, Meta(description="W / sr")] = 1.0


class Spot(Record, tag_field="type", tag="spot"):
    """Light from a point into a cone: full up to beam_width, from there falling linearly with the angle to zero.

    Found by next-event estimation only.
    """

    position: Vec3
    direction: Annotated[Vec3, Meta(description="Axis of the cone, away from the light.")]
    name: str = ""
    intensity: Annotated[NonNegative | RGB, Meta(description="Along the axis, W / sr.")] = 1.0
    cutoff_angle: Annotated[
        float, Meta(gt=0.0, le=180.0, description="Where the light ends, degrees from the axis.")
    ] = 20.0
    beam_width: Annotated[
        Annotated[float, Meta(ge=0.0, le=180.0)] | None,
        Meta(description="Where it begins to fall, degrees from the axis; default: 3/4 of cutoff_angle."),
    ] = None


class Sun(Record, tag_field="type", tag="sun"):
    """A disc of even radiance, infinitely far away."""

    direction: Annotated[Vec3, Meta(description="Where the light of its centre travels to.")]
    name: str = ""
    angle: Annotated[float, Meta(gt=0.0, le=90.0, description="Angular radius of the disc, degrees.")] = 0.2665
    irradiance: Annotated[
        NonNegative | RGB | None,
        Meta(description="On a surface that faces the light, W / m^2; excludes radiance. Default: 1."),
    ] = None
    radiance: Annotated[NonNegative | RGB | None, Meta(description="Of the disc, W / (m^2 sr).")] = None


class SunSky(Record, tag_field="type", tag="sunsky"):
    """A clear sky, baked to an environment map, and the disc of the sun (Preetham, Shirley and Smits 1999).

    Radiance in W / (m^2 sr nm), averaged over the visible spectrum; black below the horizon.
    """

    direction: Annotated[Vec3, Meta(description="Where the light of the sun travels to: downwards.")]
    name: str = ""
    turbidity: Annotated[float, Meta(ge=2.0, le=10.0, description="Haze: 2 is very clear, 10 hazy.")] = 3.0
    up: Annotated[Vec3, Meta(description="Direction of the zenith.")] = (0.0, 1.0, 0.0)
    sky_scale: Annotated[NonNegative, Meta(description="Multiplies the radiance of the sky; 0: no sky.")] = 1.0
    sun_scale: Annotated[NonNegative, Meta(description="Multiplies the radiance of the sun; 0: no sun.")] = 1.0
    sun_angle: Annotated[
        float, Meta(gt=0.0, le=90.0, description="Angular radius of the sun, degrees; its irradiance is kept.")
    ] = 0.2665
    resolution: Annotated[
        int, Meta(ge=16, le=8192, description="Rows of the baked map, which has twice as many columns.")
    ] = 256


Emitter = Constant | Envmap | Directional | Point | Spot | Sun | SunSky

# --- media -----------------------------------------------------------------------------------------------------


class Homogeneous(Record, tag_field="type", tag="homogeneous"):
    """What a part of space is filled with: the same everywhere, and absorbing without scattering."""

    name: str = ""
    sigma_a: Annotated[NonNegative | RGB, Meta(description="Absorption coefficient, 1/m.")] = 0.0
    scale: Annotated[NonNegative, Meta(description="Multiplies the coefficient.")] = 1.0


Medium = Homogeneous

# --- shapes ----------------------------------------------------------------------------------------------------


class Shape(Record):
    """What all shapes share."""

    name: str = ""
    bsdf: Annotated[str | Bsdf | None, Meta(description="Name of a BSDF, or a BSDF; default: diffuse, 0.5.")] = None
    emitter: Annotated[Area | None, Meta(description="Makes the shape an area light.")] = None
    to_world: Transform = []
    flip_normals: bool = False
    interior: Annotated[
        str | Medium | None,
        Meta(
            description="Name of a medium, or a medium, behind the surface: light that crosses it goes on in there. "
            "A surface with one of interior and exterior has vacuum on its other side; with neither it bounds none."
        ),
    ] = None
    exterior: Annotated[str | Medium | None, Meta(description="The medium in front of the surface.")] = None


class GltfPart(Record):
    """One primitive of a glTF file, in the space of its mesh."""

    mesh: Annotated[int, Meta(ge=0, description="Index of the mesh in the file.")]
    primitive: Annotated[int, Meta(ge=0, description="Index of the primitive in the mesh.")] = 0
    uv_set: Annotated[int, Meta(ge=0, le=1, description="The n of the attribute TEXCOORD_n.")] = 0


class Mesh(Shape, tag_field="type", tag="mesh"):
    """Triangles from a PLY, OBJ or glTF file, or inline. UVs and normals are per vertex."""

    file: Annotated[
        str | None, Meta(description="PLY, OBJ, glTF or GLB, relative to the scene file; excludes vertices and faces.")
    ] = None
    part: Annotated[
        GltfPart | None, Meta(description="Of a glTF or GLB file; default: the meshes of all its nodes, as one.")
    ] = None
    vertices: list[Vec3] | None = None
    faces: list[tuple[int, int, int]] | None = None
    normals: list[Vec3] | None = None
    uvs: list[Vec2] | None = None
    face_normals: Annotated[bool, Meta(description="Ignore vertex normals: shade every triangle flat.")] = False
    smooth_normals: Annotated[
        bool,
        Meta(description="Compute vertex normals where there are none: means of the face normals weighted by angle."),
    ] = False
    flip_v: Annotated[bool | None, Meta(description="Turn v into 1 - v; default: for OBJ files only.")] = None


class Rectangle(Shape, tag_field="type", tag="rectangle"):
    """The square [-1, 1]^2 at z = 0, facing +Z."""


class Cube(Shape, tag_field="type", tag="cube"):
    """The cube [-1, 1]^3, facing outwards."""


class Disk(Shape, tag_field="type", tag="disk"):
    """The unit disk at z = 0, facing +Z, as a fine fan of triangles of the same area."""


class Sphere(Shape, tag_field="type", tag="sphere"):
    """An exact sphere, facing outwards. `to_world` must scale uniformly."""

    center: Vec3 = (0.0, 0.0, 0.0)
    radius: Positive = 1.0


AnyShape = Mesh | Rectangle | Cube | Disk | Sphere


class Group(Record):
    """Shapes that are there where instances put them, any number of times, and are stored once. None of them emits."""

    name: Annotated[str, Meta(min_length=1)]
    shapes: Annotated[list[AnyShape], Meta(description="In the group's own space.")]


class Instance(Record):
    """A group, put into the scene."""

    group: Annotated[str, Meta(description="Name of a group.")]
    name: str = ""
    to_world: Annotated[Transform, Meta(description="From the group's space; any scale, shear or mirror.")] = []


# --- camera, film, integrator ------------------------------------------------------------------------------------


CameraMedium = Annotated[
    str | Medium | None, Meta(description="Name of a medium, or a medium, that the camera is in; default: vacuum.")
]


class Perspective(Record, tag_field="type", tag="perspective"):
    """Pinhole camera."""

    fov: Annotated[float, Meta(gt=0.0, lt=180.0, description="Field of view along fov_axis, degrees.")] = 40.0
    fov_axis: Literal["x", "y", "diagonal", "smaller", "larger"] = "x"
    principal_point_offset: Annotated[
        Vec2, Meta(description="Moves the image to the left and up, in fractions of the film's width and height.")
    ] = (0.0, 0.0)
    to_world: Transform = []
    medium: CameraMedium = None


class ThinLens(Perspective, kw_only=True, tag_field="type", tag="thin_lens"):
    """Camera with a thin lens: what is nearer or farther than the focus distance is blurred."""

    aperture_radius: Annotated[
        NonNegative, Meta(description="Radius of the lens in metres, before to_world; 0 is a pinhole.")
    ]
    focus_distance: Annotated[
        float, Meta(ge=1e-6, description="Of the plane that is sharp, along local -Z, in metres, before to_world.")
    ]


class Orthographic(Record, tag_field="type", tag="orthographic"):
    """Camera of parallel rays, which start on its film at local z = 0."""

    width: Annotated[Positive, Meta(description="Width of the film in metres, before to_world.")] = 2.0
    to_world: Transform = []
    medium: CameraMedium = None


class Spherical(Record, tag_field="type", tag="spherical"):
    """Camera that sees all directions: its film is a map in longitude and latitude, with local -Z in the middle, +X to
    the right of it and +Y on top."""

    to_world: Transform = []
    medium: CameraMedium = None


Camera = Perspective | ThinLens | Orthographic | Spherical


class BoxFilter(Record, tag_field="type", tag="box"):
    """Half a pixel in each direction."""


class TentFilter(Record, tag_field="type", tag="tent"):
    radius: Annotated[Positive, Meta(description="Pixels.")] = 1.0


class GaussianFilter(Record, tag_field="type", tag="gaussian"):
    """Truncated at four standard deviations."""

    stddev: Annotated[Positive, Meta(description="Pixels.")] = 0.5


Filter = BoxFilter | TentFilter | GaussianFilter
Aov = Literal[
    "albedo",
    "normal",
    "geometric_normal",
    "depth",
    "position",
    "uv",
    "shape_index",
    "bsdf_index",
    "sample_count",
    "variance",
]


class Crop(Record):
    """A window of the film, in pixels from its upper left corner."""

    width: Annotated[int, Meta(ge=1, le=65536)]
    height: Annotated[int, Meta(ge=1, le=65536)]
    x: Annotated[int, Meta(ge=0, le=65535)] = 0
    y: Annotated[int, Meta(ge=0, le=65535)] = 0


class Film(Record):
    width: Annotated[int, Meta(ge=1, le=65536)] = 512
    height: Annotated[int, Meta(ge=1, le=65536)] = 512
    crop: Annotated[
        Crop | None, Meta(description="Render these pixels alone; they are those of the whole film to the last bit.")
    ] = None
    pixel_aspect: Annotated[
        float, Meta(ge=0.01, le=100.0, description="Width of a pixel over its height, where the image is shown.")
    ] = 1.0
    filter: Filter = msgspec.field(default_factory=BoxFilter)
    aovs: Annotated[
        list[Aov],
        Meta(
            description="Extra channels: of the first hit albedo, shading and geometric normal, depth, position, UV, "
            "index of the shape and of the BSDF; number of samples; variance of the mean luminance."
        ),
    ] = []
    precision: Annotated[Literal["float", "half"], Meta(description="Of the EXR file; half overflows at 65504.")] = (
        "float"
    )

    @property
    def window(self) -> Crop:
        """The pixels that are rendered."""
        return self.crop or Crop(width=self.width, height=self.height)


class GuideChoice(Record):
    """A guide, which learns where light comes from and proposes directions; it changes the noise and not the image."""

    preset: Annotated[str, Meta(min_length=1, description="Name of a preset of guiding/presets, such as npm-product.")]
    train_share: Annotated[
        Fraction | None,
        Meta(description="Share of the samples, or of the time, in which the guide learns; null: that of the preset."),
    ] = None
    bsdf_share: Annotated[
        Annotated[float, Meta(gt=0.0, le=1.0)] | None,
        Meta(description="Probability of BSDF sampling, where the guide says no other; null: that of the preset."),
    ] = None
    settings: Annotated[
        dict[str, Any], Meta(description="Further settings of the method, by name, in place of those of the preset.")
    ] = {}


class PathIntegrator(Record, tag_field="type", tag="path"):
    """Unidirectional path tracing with multiple importance sampling."""

    max_depth: Annotated[
        int,
        Meta(
            ge=1,
            le=1_000_000,
            description="Longest path in segments: 1 is emission seen directly, 2 adds direct light.",
        ),
    ] = 16
    rr_depth: Annotated[
        Annotated[int, Meta(ge=1)] | None,
        Meta(description="Depth from which Russian roulette may end a path; null: never."),
    ] = 5
    nee: Annotated[
        bool, Meta(description="Next-event estimation; false: emitters are found by BSDF sampling only.")
    ] = True
    sampler: Annotated[
        Literal["independent", "sobol"],
        Meta(
            description="Random numbers: independent, or Owen-scrambled Sobol points, with less noise for the same "
            "number of samples; powers of two are best."
        ),
    ] = "independent"
    spp: Annotated[int, Meta(ge=1, le=2**31 - 1, description="Samples per pixel.")] = 64
    guide: Annotated[GuideChoice | None, Meta(description="Path guiding; null: none.")] = None


class Scene(Record):
    """A whole scene. File paths in memory are absolute; in a file they are relative to it."""

    shapes: Annotated[list[AnyShape], Meta(description="What is in the scene.")] = []
    camera: Camera = msgspec.field(default_factory=Perspective)
    film: Film = msgspec.field(default_factory=Film)
    integrator: PathIntegrator = msgspec.field(default_factory=PathIntegrator)
    textures: Annotated[list[Texture], Meta(description="Named textures.")] = []
    bsdfs: Annotated[list[Bsdf], Meta(description="Named BSDFs.")] = []
    media: Annotated[list[Medium], Meta(description="Named media.")] = []
    groups: Annotated[list[Group], Meta(description="Shapes for instances; not seen otherwise.")] = []
    instances: Annotated[list[Instance], Meta(description="Groups, put into the scene.")] = []
    emitters: Annotated[list[Emitter], Meta(description="Emitters that are not shapes; at most one environment.")] = []
    include: Annotated[
        list[str],
        Meta(
            description="Scene files whose textures, bsdfs, media, emitters, groups, shapes and instances are added to "
            "this one."
        ),
    ] = []
    description: Annotated[str, Meta(description="What the scene is for.")] = ""
