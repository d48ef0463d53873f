"""Small Mitsuba XML scenes: one per BSDF, texture mode and emitter, for the comparison of images.

A scene is a floor, a lamp and a subject. Scenes of one *family* have the same features (kinds of BSDF, texture, light
and geometry), so that their kernels are compiled once: what a scene does not show lies in a corner that hardly sends
any light to the camera, as `EVERYTHING`. They are small, short-pathed and without sharp highlights, so that a second of
rendering finds a difference of half a percent.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from PIL import Image

from wavefront.scene.images import write_exr

SIZE = 32  # pixels of a side
MAX_DEPTH = 5

_SCENE = """<scene version="3.0.0">
  <integrator type="path">
    <integer name="max_depth" value="{depth}"/><integer name="rr_depth" value="1000"/>
  </integrator>
  <sensor type="perspective">
    <float name="fov" value="27"/>{camera}
    <transform name="to_world"><lookat origin="0, 2.4, 6" target="0, 0.75, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm">
      <integer name="width" value="{width}"/><integer name="height" value="{height}"/><rfilter type="box"/>
    </film>
  </sensor>
  {body}
</scene>
"""

FLOOR = """<shape type="rectangle">
    <transform name="to_world"><scale value="4"/><rotate x="1" angle="-90"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.45, 0.4"/></bsdf>
  </shape>"""

LAMP = """<shape type="rectangle">
    <transform name="to_world">
      <scale value="0.8"/><rotate x="1" angle="90"/><translate x="-0.6" y="4" z="1"/>
    </transform>
    <emitter type="area"><rgb name="radiance" value="12, 11, 10"/></emitter>
  </shape>"""

# Beside the sky, so that it does not make all of the noise.
WEAK_LAMP = LAMP.replace("12, 11, 10", "4, 3.6, 3.2")

SKY = """<emitter type="constant"><rgb name="radiance" value="0.5, 0.6, 0.8"/></emitter>"""


def ball(bsdf: str) -> str:
    """A sphere on the floor."""
    return f'<shape type="sphere"><point name="center" x="0" y="1" z="0"/>{bsdf}</shape>'


def panel(bsdf: str, angle: float = -50.0) -> str:
    """A tilted square above the floor; by more than 90 degrees it shows its back."""
    return f"""<shape type="rectangle">
    <transform name="to_world"><scale value="1.1"/><rotate x="1" angle="{angle}"/><translate y="1"/></transform>
    {bsdf}
  </shape>"""


def _speck(bsdf: str, x: float, emitter: str = "", shape: str = "rectangle") -> str:
    """A square or a ball of a millimetre, behind the camera."""
    return f"""<shape type="{shape}">
    <transform name="to_world"><scale value="0.001"/><translate x="{x}" y="1" z="9"/></transform>{bsdf}{emitter}
  </shape>"""


_WEIGHT = '<float name="weight" value="0.3"/>'
METAL = '<rgb name="eta" value="0.2, 0.9, 1.1"/><rgb name="k" value="3.9, 2.4, 2.2"/>'
EVERYTHING = "\n  ".join(
    [
        _speck(
            '<bsdf type="mask"><float name="opacity" value="0.5"/>'
            '<bsdf type="diffuse"><texture name="reflectance" type="bitmap">'
            '<string name="filename" value="texture.png"/></texture></bsdf></bsdf>',
            0.0,
        ),
        _speck('<bsdf type="diffuse"><texture name="reflectance" type="checkerboard"/></bsdf>', 0.1),
        _speck('<bsdf type="conductor"><string name="material" value="Cu"/></bsdf>', 0.2),
        _speck(f'<bsdf type="roughconductor">{METAL}</bsdf>', 0.3),
        _speck('<bsdf type="dielectric"/>', 0.4),
        _speck('<bsdf type="roughdielectric"/>', 0.5),
        _speck(
            '<bsdf type="bumpmap"><texture type="bitmap"><string name="filename" value="height.exr"/></texture>'
            f'<bsdf type="blendbsdf">{_WEIGHT}<bsdf type="diffuse"/><bsdf type="diffuse"/></bsdf></bsdf>',
            1.2,
        ),
        _speck(
            '<bsdf type="normalmap"><rgb name="normalmap" value="0.5, 0.5, 1"/><bsdf type="diffuse"/></bsdf>',
            1.3,
        ),
        _speck('<bsdf type="thindielectric"/>', 1.0),
        _speck('<bsdf type="null"/>', 1.1),
        _speck('<bsdf type="principled"><float name="anisotropic" value="0.5"/></bsdf>', 1.4),
        _speck('<bsdf type="principled"><float name="spec_trans" value="0.5"/></bsdf>', 1.5),
        _speck('<bsdf type="plastic"/>', 0.8),
        _speck('<bsdf type="roughplastic"/>', 0.9),
        _speck("", 0.6, '<emitter type="area"><rgb name="radiance" value="1"/></emitter>'),
        _speck("", 0.7, '<emitter type="area"><rgb name="radiance" value="1"/></emitter>', "sphere"),
    ]
)


def document(body: list[str], everything: bool, camera: str = "", size=(SIZE, SIZE)) -> str:
    """The XML text of a scene.

    Args:
        body: Its shapes and emitters.
        everything: Whether to add `EVERYTHING`, which also needs a constant emitter and the file ``texture.png``.
        camera: Further elements of the sensor.
        size: Width and height, pixels.
    """
    parts = [*body, EVERYTHING] if everything else body
    return _SCENE.format(depth=MAX_DEPTH, camera=camera, width=size[0], height=size[1], body="\n  ".join(parts))


def in_dialect_0_6(text: str) -> str:
    """A scene as Mitsuba 0.6 spells it: names in camel case."""
    names = {"int_ior": "intIOR", "ext_ior": "extIOR"}

    def spell(match):
        name = match[1]
        return f'name="{names.get(name) or re.sub("_(.)", lambda m: m[1].upper(), name)}"'

    return re.sub('name="([a-z_]+)"', spell, text).replace('version="3.0.0"', 'version="0.6.0"')


def _texture(parameter: str, wrap: str = "repeat", scale: float = 2.6, raw: bool = False) -> str:
    return f"""<texture name="{parameter}" type="bitmap">
      <string name="filename" value="{"opacity" if parameter in ("opacity", "weight") else "texture"}.png"/>
      <string name="wrap_mode" value="{wrap}"/><boolean name="raw" value="{str(raw).lower()}"/>
      <transform name="to_uv"><scale x="{scale}" y="{0.7 * scale}"/><translate x="-0.35" y="-0.2"/></transform>
    </texture>"""


_PAINT = '<bsdf type="diffuse"><rgb name="reflectance" value="{}"/></bsdf>'
_GLASS = '<float name="int_ior" value="1.5"/><float name="ext_ior" value="1"/>'
_COLOURS = '<rgb name="diffuse_reflectance" value="0.8, 0.4, 0.1"/><rgb name="specular_reflectance" value="0.9"/>'
_NONLINEAR = '<boolean name="nonlinear" value="true"/>'
_CHECKS = """<texture name="reflectance" type="checkerboard">
      <rgb name="color0" value="0.9, 0.6, 0.1"/><rgb name="color1" value="0.1, 0.2, 0.5"/>
      <transform name="to_uv"><scale x="3" y="2"/></transform>
    </texture>"""


_METALLIC = """<texture name="metallic" type="checkerboard">
      <rgb name="color0" value="0.9"/><rgb name="color1" value="0.1"/>
      <transform name="to_uv"><scale x="3" y="2"/></transform>
    </texture>"""


def _rough(kind: str, distribution: str, alpha: float, rest: str) -> str:
    return f"""<bsdf type="{kind}">
      <string name="distribution" value="{distribution}"/><float name="alpha" value="{alpha}"/>{rest}
    </bsdf>"""


def _principled(**fields) -> str:
    """The BSDF with numbers, and further elements as `rest`."""
    rest = fields.pop("rest", '<rgb name="base_color" value="0.8, 0.4, 0.1"/>')
    numbers = "".join(f'<float name="{name}" value="{value}"/>' for name, value in fields.items())
    return f'<bsdf type="principled">{numbers}{rest}</bsdf>'


_TWO_SIDES = f'<bsdf type="twosided">{_PAINT.format("0.8, 0.2, 0.1")}{_PAINT.format("0.1, 0.3, 0.8")}</bsdf>'

# Diffuse surfaces and triangles alone: the kernels of a plain scene.
PLAIN: dict[str, list[str]] = {
    "diffuse": [FLOOR, LAMP, panel(_PAINT.format("0.8, 0.3, 0.2"))],
    "two sides, the front": [FLOOR, LAMP, panel(_TWO_SIDES)],
    "two sides, the back": [FLOOR, LAMP, panel(_TWO_SIDES, 130.0)],
    "one side, the back": [FLOOR, LAMP, panel(_PAINT.format("0.8, 0.3, 0.2"), 130.0)],
    "smooth mesh": [
        FLOOR,
        LAMP,
        f"""<shape type="obj"><string name="filename" value="ball.obj"/>
    <transform name="to_world"><translate y="1"/></transform>{_PAINT.format("0.3, 0.6, 0.7")}</shape>""",
    ],
    "flat mesh": [
        FLOOR,
        LAMP,
        f"""<shape type="obj"><string name="filename" value="ball.obj"/><boolean name="face_normals" value="true"/>
    <transform name="to_world"><translate y="1"/></transform>{_PAINT.format("0.3, 0.6, 0.7")}</shape>""",
    ],
    "mesh light": [
        FLOOR,
        # Flat: where normals are interpolated, Mitsuba converts areas to solid angles by the shading normal; its
        # light samples and its BSDF samples then do not agree on the image.
        """<shape type="obj"><string name="filename" value="ball.obj"/><boolean name="face_normals" value="true"/>
    <transform name="to_world"><scale value="0.5"/><translate x="-0.4" y="2" z="0.3"/></transform>
    <emitter type="area"><rgb name="radiance" value="6, 8, 10"/></emitter></shape>""",
    ],
    "cube and disk": [
        FLOOR,
        LAMP,
        f"""<shape type="cube"><transform name="to_world"><scale value="0.6"/><rotate y="1" angle="30"/>
    <translate x="-0.9" y="0.6"/></transform>{_PAINT.format("0.7, 0.7, 0.2")}</shape>""",
        f"""<shape type="disk"><transform name="to_world"><scale value="0.8"/><rotate x="1" angle="-40"/>
    <translate x="0.9" y="0.8"/></transform>{_PAINT.format("0.2, 0.7, 0.3")}</shape>""",
    ],
}


def _brushed(kind: str, distribution: str, alpha_u: float, alpha_v: float, rest: str) -> str:
    return f"""<bsdf type="{kind}"><string name="distribution" value="{distribution}"/>
      <float name="alpha_u" value="{alpha_u}"/><float name="alpha_v" value="{alpha_v}"/>{rest}
    </bsdf>"""


def _bump(nested: str, scale: float) -> str:
    return f"""<bsdf type="bumpmap"><float name="scale" value="{scale}"/>
    <texture name="map" type="bitmap"><string name="filename" value="height.exr"/>
      <transform name="to_uv"><scale x="2" y="3"/></transform></texture>{nested}</bsdf>"""


def _normals(nested: str) -> str:
    return f"""<bsdf type="normalmap">
    <texture name="normalmap" type="bitmap"><string name="filename" value="normals.exr"/></texture>{nested}</bsdf>"""


def _blend(weight: str, first: str, second: str) -> str:
    return f'<bsdf type="blendbsdf">{weight}{first}{second}</bsdf>'


_METAL = _rough("roughconductor", "ggx", 0.3, METAL)

# The kernels of a scene with all kinds of everything.
MIXED: dict[str, list[str]] = {
    "conductor": [FLOOR, WEAK_LAMP, SKY, ball('<bsdf type="conductor"><string name="material" value="Au"/></bsdf>')],
    "rough conductor, GGX": [FLOOR, WEAK_LAMP, SKY, ball(_rough("roughconductor", "ggx", 0.4, METAL))],
    "rough conductor, Beckmann": [FLOOR, WEAK_LAMP, SKY, ball(_rough("roughconductor", "beckmann", 0.3, METAL))],
    "dielectric": [FLOOR, SKY, ball(f'<bsdf type="dielectric">{_GLASS}</bsdf>')],
    "rough dielectric, GGX": [FLOOR, SKY, ball(_rough("roughdielectric", "ggx", 0.3, _GLASS))],
    "rough dielectric, Beckmann": [FLOOR, SKY, ball(_rough("roughdielectric", "beckmann", 0.3, _GLASS))],
    "thin dielectric": [FLOOR, LAMP, SKY, panel(f'<bsdf type="thindielectric">{_GLASS}</bsdf>')],
    "null": [FLOOR, LAMP, SKY, ball('<bsdf type="null"/>')],
    "plastic": [FLOOR, LAMP, SKY, ball(f'<bsdf type="plastic">{_GLASS}{_COLOURS}</bsdf>')],
    "plastic, nonlinear": [FLOOR, LAMP, SKY, ball(f'<bsdf type="plastic">{_GLASS}{_COLOURS}{_NONLINEAR}</bsdf>')],
    "rough plastic, GGX": [FLOOR, LAMP, SKY, ball(_rough("roughplastic", "ggx", 0.2, _GLASS + _COLOURS + _NONLINEAR))],
    "rough plastic, Beckmann": [FLOOR, LAMP, SKY, ball(_rough("roughplastic", "beckmann", 0.3, _GLASS + _COLOURS))],
    "rough plastic, bitmap": [
        FLOOR,
        LAMP,
        SKY,
        panel(_rough("roughplastic", "ggx", 0.2, _GLASS + _NONLINEAR + _texture("diffuse_reflectance"))),
    ],
    "principled": [FLOOR, LAMP, SKY, ball(_principled(roughness=0.5))],
    "principled, opaque lobes": [
        FLOOR,
        LAMP,
        SKY,
        ball(
            _principled(
                roughness=0.6,
                metallic=0.3,
                spec_tint=0.6,
                sheen=0.8,
                sheen_tint=0.5,
                flatness=0.6,
                clearcoat=0.9,
                clearcoat_gloss=0.2,
                specular=0.8,
            )
        ),
    ],
    "principled, brushed metal": [
        FLOOR,
        WEAK_LAMP,
        SKY,
        ball(_principled(roughness=0.6, metallic=1.0, anisotropic=0.8)),
    ],
    "principled, glass": [FLOOR, SKY, ball(_principled(roughness=0.5, spec_trans=1.0, eta=1.4))],
    "principled, half glass": [
        FLOOR,
        SKY,
        ball(_principled(roughness=0.6, spec_trans=0.5, metallic=0.2, sheen=0.5, clearcoat=0.5)),
    ],
    "principled, textures": [
        FLOOR,
        LAMP,
        SKY,
        panel(f'<bsdf type="twosided">{_principled(rest=_texture("base_color") + _METALLIC)}</bsdf>'),
    ],
    "brushed metal, GGX": [FLOOR, LAMP, SKY, panel(_brushed("roughconductor", "ggx", 0.5, 0.1, METAL))],
    "brushed metal, Beckmann": [FLOOR, WEAK_LAMP, SKY, ball(_brushed("roughconductor", "beckmann", 0.2, 0.5, METAL))],
    "brushed metal on a mesh": [
        FLOOR,
        WEAK_LAMP,
        SKY,
        f"""<shape type="obj"><string name="filename" value="ball.obj"/>
    <transform name="to_world"><scale x="1.1" y="0.8"/><translate y="1"/></transform>
    {_brushed("roughconductor", "ggx", 0.15, 0.5, METAL)}</shape>""",
    ],
    "brushed glass": [FLOOR, SKY, ball(_brushed("roughdielectric", "ggx", 0.5, 0.15, _GLASS))],
    "bump map": [FLOOR, LAMP, SKY, panel(_bump(_PAINT.format("0.8, 0.3, 0.2"), 0.4))],
    "bump map around two sides, the back": [FLOOR, LAMP, SKY, panel(_bump(_TWO_SIDES, 0.4), 130.0)],
    "bump map inside of two sides, the back": [
        FLOOR,
        LAMP,
        SKY,
        panel(f'<bsdf type="twosided">{_bump(_PAINT.format("0.8, 0.2, 0.1"), 0.4)}{_bump(_METAL, -0.6)}</bsdf>', 130.0),
    ],
    "bump map on a ball": [FLOOR, WEAK_LAMP, SKY, ball(_bump(_METAL, 0.4))],
    "bump map on a disk": [
        FLOOR,
        LAMP,
        SKY,
        f"""<shape type="disk"><transform name="to_world"><rotate x="1" angle="-50"/><translate y="1"/></transform>
    {_bump(_PAINT.format("0.8, 0.3, 0.2"), 0.4)}</shape>""",
    ],
    "bump map on a mesh": [
        FLOOR,
        WEAK_LAMP,
        SKY,
        f"""<shape type="obj"><string name="filename" value="ball.obj"/>
    <transform name="to_world"><translate y="1"/></transform>{_bump(_PAINT.format("0.3, 0.6, 0.7"), 0.4)}</shape>""",
    ],
    "normal map": [FLOOR, LAMP, SKY, panel(_normals(_METAL))],
    "normal map on ground glass": [FLOOR, SKY, ball(_normals(_rough("roughdielectric", "ggx", 0.3, _GLASS)))],
    "normal map in a mask": [
        FLOOR,
        WEAK_LAMP,
        SKY,
        panel(
            f'<bsdf type="mask"><float name="opacity" value="0.6"/>{_normals(_PAINT.format("0.8, 0.3, 0.2"))}</bsdf>'
        ),
    ],
    "blend": [
        FLOOR,
        LAMP,
        SKY,
        panel(
            f'<bsdf type="twosided">{_blend(_WEIGHT, _PAINT.format("0.8, 0.3, 0.2"), _METAL)}</bsdf>',
            130.0,
        ),
    ],
    "blend bitmap": [
        FLOOR,
        LAMP,
        SKY,
        panel(
            _blend(
                _texture("weight", raw=True),
                _PAINT.format("0.8, 0.3, 0.2"),
                _blend(_WEIGHT, _PAINT.format("0.1, 0.3, 0.8"), _METAL),
            )
        ),
    ],
    "opacity": [
        FLOOR,
        WEAK_LAMP,
        SKY,
        panel(
            f'<bsdf type="mask"><float name="opacity" value="0.3"/><bsdf type="twosided">'
            f"{_PAINT.format('0.8, 0.3, 0.2')}</bsdf></bsdf>"
        ),
    ],
    "opacity checkerboard": [
        FLOOR,
        WEAK_LAMP,
        SKY,
        panel(
            '<bsdf type="mask"><texture name="opacity" type="checkerboard"><rgb name="color0" value="0.9"/>'
            f'<rgb name="color1" value="0.2"/></texture>{_PAINT.format("0.8, 0.3, 0.2")}</bsdf>'
        ),
    ],
    "opacity bitmap": [
        FLOOR,
        WEAK_LAMP,
        SKY,
        panel(f'<bsdf type="mask">{_texture("opacity", raw=True)}{_PAINT.format("0.8, 0.3, 0.2")}</bsdf>'),
    ],
    "bitmap, repeat": [FLOOR, WEAK_LAMP, SKY, panel(f'<bsdf type="diffuse">{_texture("reflectance")}</bsdf>')],
    "bitmap, mirror": [
        FLOOR,
        WEAK_LAMP,
        SKY,
        panel(f'<bsdf type="diffuse">{_texture("reflectance", "mirror")}</bsdf>'),
    ],
    "bitmap, clamp": [FLOOR, WEAK_LAMP, SKY, panel(f'<bsdf type="diffuse">{_texture("reflectance", "clamp")}</bsdf>')],
    "bitmap on a ball": [FLOOR, WEAK_LAMP, SKY, ball(f'<bsdf type="diffuse">{_texture("reflectance")}</bsdf>')],
    "checkerboard": [FLOOR, WEAK_LAMP, SKY, panel(f'<bsdf type="diffuse">{_CHECKS}</bsdf>')],
    "sky": [FLOOR, SKY, ball(_PAINT.format("0.7, 0.7, 0.2"))],
    "sphere light": [
        FLOOR,
        SKY,
        """<shape type="sphere"><point name="center" x="-0.4" y="1.8" z="0.3"/><float name="radius" value="0.5"/>
    <emitter type="area"><rgb name="radiance" value="6, 7, 8"/></emitter></shape>""",
    ],
}

# Scenes of MIXED that run with the slow tests alone: variants of others.
VARIANTS = (
    "brushed metal, Beckmann",
    "brushed metal on a mesh",
    "bump map",
    "bump map around two sides, the back",
    "bump map on a ball",
    "bump map on a disk",
    "normal map",
    "normal map in a mask",
    "blend",
)

_BOX = f"""<shape type="cube"><transform name="to_world"><scale value="0.6"/><rotate y="1" angle="30"/>
    <translate x="0.2" y="0.6"/></transform>{_PAINT.format("0.7, 0.7, 0.2")}</shape>"""


def _envmap(file: str, rotate: str) -> str:
    return f"""<emitter type="envmap"><string name="filename" value="{file}"/><float name="scale" value="1.5"/>
    <transform name="to_world">{rotate}</transform></emitter>"""


# Emitters that rays find which hit nothing, so that a render without light sampling sees them too.
AROUND: dict[str, list[str]] = {
    "envmap": [FLOOR, _BOX, _envmap("sky.exr", "")],
    "envmap, turned": [FLOOR, _BOX, _envmap("sky.exr", '<rotate x="1" angle="50"/><rotate y="1" angle="110"/>')],
    "envmap, mirrored": [FLOOR, _BOX, _envmap("sky.exr", '<rotate z="1" angle="35"/><scale x="-1"/>')],
    "envmap, 8 bit": [FLOOR, _BOX, _envmap("texture.png", '<rotate z="1" angle="35"/>')],
    "textured lamp": [
        FLOOR,
        _BOX,
        SKY,
        f"""<shape type="rectangle">
    <transform name="to_world"><scale x="1.5" y="0.8"/><rotate x="1" angle="110"/><translate y="2" z="-1"/></transform>
    <emitter type="area">{_texture("radiance", raw=True)}</emitter></shape>""",
    ],
    "envmap and lamp": [FLOOR, _BOX, LAMP, _envmap("sky.exr", "")],
}

_SPOT = """<emitter type="spot"><transform name="to_world"><lookat origin="1, 4, 2" target="0, 0.3, 0" up="0, 1, 0"/>
    </transform><rgb name="intensity" value="50, 40, 30"/>{}</emitter>"""
_POINT = """<emitter type="point"><point name="position" x="-1.5" y="2" z="1"/>
    <rgb name="intensity" value="6, 7, 9"/></emitter>"""

# Emitters that only light sampling finds.
DELTA: dict[str, list[str]] = {
    "point": [FLOOR, _BOX, _POINT],
    "spot": [FLOOR, _BOX, _SPOT.format("")],
    "spot, even": [
        FLOOR,
        _BOX,
        _SPOT.format('<float name="cutoff_angle" value="25"/><float name="beam_width" value="25"/>'),
    ],
    "spot, wide": [
        FLOOR,
        _BOX,
        _SPOT.format('<float name="cutoff_angle" value="120"/><float name="beam_width" value="10"/>'),
    ],
    "directional": [
        FLOOR,
        _BOX,
        """<emitter type="directional"><vector name="direction" x="1" y="-2" z="-0.5"/>
    <rgb name="irradiance" value="3, 2.5, 2"/></emitter>""",
    ],
    "directional, turned": [
        FLOOR,
        _BOX,
        """<emitter type="directional"><transform name="to_world"><rotate x="1" angle="60"/><rotate y="1" angle="30"/>
    </transform></emitter>""",
    ],
    "all of them": [
        FLOOR,
        _BOX,
        LAMP,
        SKY,
        _SPOT.format(""),
        _POINT,
        '<emitter type="directional"><vector name="direction" x="0.3" y="-1" z="0"/></emitter>',
    ],
}

# A ball so far away that it is a disc of an angular radius of 30 degrees from everywhere in the scene.
SUN_DIRECTION, SUN_ANGLE, SUN_RADIANCE = (0.6, -1.0, -0.3), 30.0, (5.0, 4.0, 3.0)


def far_ball() -> str:
    axis, distance = np.array(SUN_DIRECTION) / np.linalg.norm(SUN_DIRECTION), 1e5
    x, y, z = -distance * axis
    return f"""<shape type="sphere"><point name="center" x="{x}" y="{y}" z="{z}"/>
    <float name="radius" value="{distance * np.sin(np.radians(SUN_ANGLE))}"/><emitter type="area">
    <rgb name="radiance" value="{SUN_RADIANCE[0]}, {SUN_RADIANCE[1]}, {SUN_RADIANCE[2]}"/></emitter></shape>"""


SUN = [FLOOR, _BOX, far_ball()]

# Elements of the sensor, and the size of the film.
CAMERAS: dict[str, tuple[str, tuple[int, int]]] = {
    axis: (f'<string name="fov_axis" value="{axis}"/>', size)
    for axis, size in zip(
        ("x", "y", "diagonal", "smaller", "larger"), ((48, 24), (48, 24), (48, 24), (24, 32), (24, 32)), strict=True
    )
}


def write_files(folder: Path) -> None:
    """Writes the mesh and the images that the scenes refer to."""
    rng = np.random.default_rng(1)
    texture = rng.integers(20, 250, (5, 7, 3), dtype=np.uint8)
    Image.fromarray(texture).save(folder / "texture.png")
    Image.fromarray(rng.integers(0, 255, (4, 6), dtype=np.uint8)).save(folder / "opacity.png")
    y, x = np.mgrid[0:6, 0:8]
    height = (0.2 * np.sin(0.25 * np.pi * x) * np.cos(np.pi * y / 3.0)).astype(np.float32)
    write_exr(folder / "height.exr", {"Y": height})
    normals = np.stack([0.5 * np.sin(0.25 * np.pi * x), 0.4 * np.cos(np.pi * y / 3.0), np.ones(x.shape)])
    normals = 0.5 + 0.5 * normals / np.linalg.norm(normals, axis=0)
    write_exr(folder / "normals.exr", {name: normals[i].astype(np.float32) for i, name in enumerate("RGB")})
    sky = np.exp(rng.normal(size=(6, 10, 3))).astype(np.float32)
    sky[2, 3] = (20.0, 16.0, 8.0)
    write_exr(folder / "sky.exr", {name: sky[:, :, i] for i, name in enumerate("RGB")})
    (folder / "ball.obj").write_text(_ball_obj(8, 12), encoding="utf-8")


def _ball_obj(rings: int, sectors: int) -> str:
    """A unit ball of few triangles with smooth normals that are not quite those of the sphere."""
    lines, faces = [], []
    for i in range(rings + 1):
        for j in range(sectors + 1):
            theta, phi = np.pi * i / rings, 2.0 * np.pi * j / sectors
            p = np.array([np.sin(theta) * np.cos(phi), np.cos(theta), -np.sin(theta) * np.sin(phi)])
            n = p * (1.0, 1.2, 1.0) / np.linalg.norm(p * (1.0, 1.2, 1.0))
            lines += [
                "v {:.6f} {:.6f} {:.6f}".format(*p),
                f"vt {j / sectors:.6f} {1.0 - i / rings:.6f}",
                "vn {:.6f} {:.6f} {:.6f}".format(*n),
            ]
    for i in range(rings):
        for j in range(sectors):
            a, b = i * (sectors + 1) + j + 1, (i + 1) * (sectors + 1) + j + 1
            if i > 0:
                faces.append((a, b, a + 1))
            if i < rings - 1:
                faces.append((a + 1, b, b + 1))
    lines += [f"f {' '.join(f'{k}/{k}/{k}' for k in face)}" for face in faces]
    return "\n".join(lines) + "\n"
