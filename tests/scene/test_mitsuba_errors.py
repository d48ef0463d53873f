"""The Mitsuba importer: every error is one line that names file and line, and what is allowed."""

import pytest

from wavefront.errors import SceneError
from wavefront.scene import mitsuba


def on_shape(body):
    return f'<shape type="rectangle">{body}</shape>'


def bsdf(kind, body=""):
    return on_shape(f'<bsdf type="{kind}">{body}</bsdf>')


def diffuse(body):
    return bsdf("diffuse", body)


def to_world(step):
    """A shape whose transform has its step in line 3."""
    return on_shape(f'<transform name="to_world">\n{step}</transform>')


def path(body):
    """An integrator whose properties are in line 3."""
    return f'<integrator type="path">\n{body}</integrator>'


def envmap(body):
    return f'<emitter type="envmap"><string name="filename" value="colours.png"/>{body}</emitter>'


ERRORS = [
    ('\n\n<shape type="cylinder"/>', 4, "shape 'cylinder' is not supported; supported: obj, ply, rectangle"),
    ('<shape type="serialized"/>', 2, "shape 'serialized' is not supported"),
    (on_shape('\n<bsdf type="plaster"/>'), 3, "bsdf 'plaster' is not supported; supported: diffuse"),
    (bsdf("plastic", '<float name="alpha" value="0.1"/>'), 2, "alpha"),
    (bsdf("roughplastic", '<float name="alpha_u" value="0.2"/>'), 2, "needs one number alpha"),
    (bsdf("roughplastic", '<texture name="alpha" type="checkerboard"/>'), 2, "needs one number alpha"),
    (bsdf("plastic", '<rgb name="diffuse_reflectance" value="1 2 1"/>'), 2, "must be from 0 to 1"),
    (bsdf("roughdiffuse", '<texture name="alpha" type="checkerboard"/>'), 2, "needs a number alpha"),
    (bsdf("principledthin"), 2, "bsdf 'principledthin' is not supported"),
    (bsdf("principled", '<float name="eta" value="1.5"/><float name="specular" value="0.5"/>'), 2, "eta or specular"),
    (bsdf("principled", '\n<float name="eta" value="0"/>'), 3, "eta must be greater than 0; found 0"),
    (bsdf("principled", '\n<float name="specular" value="1.5"/>'), 3, "specular must be from 0 to 1; found 1.5"),
    (bsdf("principled", '\n<float name="main_specular_sampling_rate" value="0"/>'), 3, "must be greater than 0"),
    (bsdf("principled", '\n<float name="clearcoat_sampling_rate" value="-1"/>'), 3, "must be at least 0; found -1"),
    (bsdf("principled", '\n<float name="metallic" value="2"/>'), 3, "must be from 0 to 1"),
    (bsdf("principled", '<texture name="eta" type="checkerboard"/>'), 2, "must be a number, not a texture"),
    (bsdf("hair"), 2, "bsdf 'hair' is not supported; supported: diffuse"),
    (bsdf("bumpmap"), 2, "needs one BSDF; found 0"),
    (bsdf("bumpmap", '<bsdf type="diffuse"/>'), 2, "needs one texture; found 0"),
    (bsdf("bumpmap", '<bsdf type="diffuse"/><texture type="checkerboard"/>'), 2, "needs a bitmap"),
    (bsdf("normalmap", '<bsdf type="diffuse"/>'), 2, "needs a normalmap"),
    (bsdf("blendbsdf", '<bsdf type="diffuse"/>'), 2, "needs two BSDFs; found 1"),
    (bsdf("blendbsdf", '<bsdf type="diffuse"/><bsdf type="diffuse"/>'), 2, "needs a weight"),
    ('<emitter type="projector"/>', 2, "emitter 'projector' is not supported; supported: area, constant, envmap"),
    ('<emitter type="spot">\n<float name="cutoff_angle" value="0"/></emitter>', 3, "above 0 and at most 180; found 0"),
    ('<emitter type="spot">\n<float name="beam_width" value="21"/></emitter>', 3, "from 0 to cutoff_angle; found 21"),
    ('<emitter type="spot"><texture type="checkerboard"/></emitter>', 2, "cannot hold a texture"),
    ('<emitter type="directional">\n<vector name="direction" x="0"/></emitter>', 3, "the direction is zero"),
    (
        '<emitter type="point"><point name="position" x="0"/><transform name="to_world"/></emitter>',
        2,
        "either position or to_world",
    ),
    ('<emitter type="envmap"/>', 2, "emitter 'envmap' needs a filename"),
    (envmap('\n<float name="scale" value="-1"/>'), 3, "scale must be at least 0; found -1"),
    (envmap('\n<transform name="to_world"><scale x="2"/></transform>'), 3, "an environment map can be rotated"),
    (envmap('<string name="filename" value="no.exr"/>'.replace("filename", "other")), 2, "no property 'other'"),
    ('<emitter type="area"/>', 2, "belongs inside a shape"),
    (on_shape('<emitter type="spot"/>'), 2, "emitter 'spot' is not supported inside a shape"),
    ('<integrator type="aov"/>', 2, "integrator 'aov' is not supported"),
    (path('<boolean name="hide_emitters" value="true"/>'), 3, "hide_emitters is not supported"),
    (path('<integer name="max_dept" value="3"/>'), 3, "no property 'max_dept'; did you mean 'max_depth'?"),
    (path('<integer name="max_depth" value="0"/>'), 3, "max_depth must be -1 or from 1"),
    (path('<integer name="max_depth" value="3.5"/>'), 3, "'3.5' is not an integer"),
    (path('<float name="max_depth" value="3"/>'), 3, "must be <integer>, not <float>"),
    ('<integrator type="path"/><integrator type="path"/>', 2, "one integrator"),
    (diffuse('\n<rgb name="reflectence" value="1"/>'), 3, "did you mean 'reflectance'?"),
    (diffuse('\n<rgb name="reflectance" value="1.5"/>'), 3, "from 0 to 1; found '1.5'"),
    (diffuse('<rgb name="reflectance" value="1 1"/>'), 2, "needs one or three numbers"),
    (diffuse('<rgb name="reflectance" value="a"/>'), 2, "'a' is not a finite number"),
    (diffuse('<rgb name="reflectance" value="nan"/>'), 2, "not a finite number"),
    (diffuse('<spectrum name="reflectance" value="400:1, 700:2"/>'), 2, "sampled spectra"),
    (diffuse('<srgb name="reflectance" value="#12345"/>'), 2, "not a colour such as"),
    (diffuse('<rgb name="reflectance" value="1"/><rgb name="reflectance" value="1"/>'), 2, "given twice"),
    (diffuse('<bsdf type="diffuse"/>'), 2, "cannot hold a bsdf"),
    (diffuse('<texture type="noise" name="reflectance"/>'), 2, "texture 'noise' is not supported"),
    (
        diffuse('<texture type="bitmap" name="reflectance">\n<string name="filename" value="no.png"/></texture>'),
        3,
        "file not found: 'no.png'",
    ),
    (bsdf("roughconductor", '<string name="distribution" value="phong"/>'), 2, "distribution 'phong' is not supported"),
    (bsdf("roughconductor", '<float name="alpha" value="2"/>'), 2, "alpha must be at most 1"),
    (
        bsdf("roughconductor", '<float name="alpha_u" value="0"/><float name="alpha_v" value="0.1"/>'),
        2,
        "must both be below 0.0001, or neither",
    ),
    (bsdf("roughconductor", '<float name="alpha_u" value="0.2"/>'), 2, "must be given together"),
    (bsdf("roughconductor", '<float name="alpha" value="1"/><float name="alpha_u" value="1"/>'), 2, "alpha excludes"),
    (bsdf("roughdielectric", '<float name="alpha_u" value="0.2"/><float name="alpha_v" value="2"/>'), 2, "at most 1"),
    (bsdf("conductor", '<string name="material" value="Cu"/><rgb name="eta" value="1"/>'), 2, "either material or eta"),
    (bsdf("dielectric", '<float name="int_ior" value="0"/>'), 2, "int_ior must be greater than 0"),
    (bsdf("twosided"), 2, "needs one or two BSDFs; found 0"),
    (bsdf("mask", '<rgb name="opacity" value="1 0 0"/><bsdf type="diffuse"/>'), 2, "must be one number"),
    (on_shape('<bsdf type="diffuse"/><bsdf type="diffuse"/>'), 2, "a shape has one bsdf"),
    (on_shape('\n<ref id="wals"/>') + '<bsdf type="diffuse" id="walls"/>', 3, "the id 'wals'; did you mean 'walls'?"),
    ('<bsdf type="diffuse" id="a"/>\n<bsdf type="diffuse" id="a"/>', 3, "the id 'a' is used twice; first in line 2"),
    ('<bsdf type="twosided" id="a"><ref id="a"/></bsdf>', 2, "contains itself"),
    ('<alias id="x" as="y"/>', 2, "nothing in the scene has the id 'x'"),
    (on_shape('\n<float name="$x" value="1"/>'), 3, "parameter $x is not defined"),
    ('\n<include filename="no.xml"/>', 3, "file not found: 'no.xml'"),
    ('<include filename="scene.xml"/>', 2, "does a file include itself?"),
    ('<shape type="obj">\n<string name="filename" value="no.obj"/></shape>', 3, "file not found: 'no.obj'"),
    ('<shape type="obj"/>', 2, "needs a filename"),
    ('<shape type="ply"><string name="filename" value="flat.obj"/></shape>', 2, "needs a .ply file"),
    (to_world('<scale value="0"/>'), 2, "not invertible"),
    (to_world('<rotate angle="5"/>'), 3, "rotation axis is zero"),
    (to_world('<matrix value="1 2 3"/>'), 3, "needs 9 or 16 numbers; found 3"),
    (to_world('<shear x="1"/>'), 3, "<shear> cannot stand inside a <transform>"),
    (to_world('<scale w="1"/>'), 3, "has no attribute 'w'"),
    (to_world('<lookat origin="1 1 1" target="1 1 1"/>'), 3, "same point"),
    (on_shape('<medium type="homogeneous" name="interior"/>'), 2, "participating media are not supported"),
    ("<translate x='1'/>", 2, "belongs inside a <transform>"),
    ("<luminaire/>", 2, "use <emitter>"),
    ("<shap/>", 2, "did you mean 'shape'?"),
    ("<shape/>", 2, "needs the attribute 'type'"),
    ("\nhello", 1, "unexpected text 'hello'"),
    ('<volume type="grid"/>', 2, "is not supported at the top level"),
    ('<boolean name="x" value="maybe"/>', 2, "scene 'scene' has no property 'x'"),
]


@pytest.mark.parametrize(("body", "line", "words"), ERRORS)
def test_errors_name_file_and_line(load_xml, xml_folder, body, line, words):
    with pytest.raises(SceneError) as caught:
        load_xml(body)
    text = str(caught.value)
    assert text.startswith(f"{xml_folder / 'scene.xml'}: line {line}: ")
    assert words in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('<scene version="3.0.0">\n  <shape>\n</scene>', "line 3, column 3: bad XML: mismatched tag"),
        ("", "line 1, column 1: bad XML: no element found"),
        ("<scene>\n</scene>", "line 1: <scene> needs the attribute 'version'"),
        ('<scene version="three"/>', "line 1: version 'three'"),
        ('<bsdf version="3.0.0" type="diffuse"/>', "the root element must be <scene>"),
        ('<scene version="3.0.0"/>', "line 1: the scene has no sensor"),
        ('<!DOCTYPE a [<!ENTITY b "c">]>\n<scene version="3.0.0"/>', "entities are not supported"),
        ('<?xml version="1.0" encoding="klingon"?><scene/>', "bad XML"),
    ],
)
def test_bad_files(tmp_path, text, words):
    file = tmp_path / "bad.xml"
    file.write_text(text)
    with pytest.raises(SceneError) as caught:
        mitsuba.load(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(SceneError, match=r"no\.xml: file not found$"):
        mitsuba.load(tmp_path / "no.xml")
