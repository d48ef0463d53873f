"""The Mitsuba importer: facts against Mitsuba itself, dialects against each other, every error with its line."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from wavefront.errors import SceneError
from wavefront.scene import description as d
from wavefront.scene import meshes, mitsuba
from wavefront.scene.transforms import to_matrix


def bsdf_of(scene):
    """The BSDF record of the first shape."""
    return scene.shapes[0].bsdf


def on_shape(body):
    return f'<shape type="rectangle">{body}</shape>'


# --- camera ----------------------------------------------------------------------------------------------------


def our_rays(camera, film, positions):
    """Origins and directions of camera rays through film positions in [0, 1]^2, from the description of the records."""
    aspect = film.width / film.height
    half = np.tan(np.radians(camera.fov) / 2.0)
    axis = camera.fov_axis
    if axis in ("smaller", "larger"):
        axis = "x" if (axis == "larger") == (aspect >= 1.0) else "y"
    half_x = {"x": half, "y": half * aspect, "diagonal": half * aspect / np.hypot(aspect, 1.0)}[axis]
    matrix = to_matrix(camera.to_world)
    u, v = np.asarray(positions).T
    local = np.stack([(2 * u - 1) * half_x, (1 - 2 * v) * half_x / aspect, -np.ones_like(u)], axis=1)
    world = local @ matrix[:3, :3].T
    return matrix[:3, 3], world / np.linalg.norm(world, axis=1, keepdims=True)


CAMERAS = [
    '<float name="fov" value="35"/>',
    '<string name="focal_length" value="35mm"/>',
    "",
    '<float name="fov" value="50"/><string name="fov_axis" value="y"/>',
    '<float name="fov" value="50"/><string name="fov_axis" value="diagonal"/>',
    '<float name="fov" value="50"/><string name="fov_axis" value="smaller"/>',
    '<float name="fov" value="50"/><string name="fov_axis" value="larger"/>',
    '<float name="fov" value="40"/><transform name="to_world">'
    '<lookat origin="1 2 3" target="-4 0.5 9" up="0.1 1 -0.2"/></transform>',
    '<float name="fov" value="40"/><transform name="to_world"><lookat origin="1 2 3" target="-4 0.5 9"/></transform>',
    '<float name="fov" value="40"/><transform name="to_world"><rotate x="0.8" y="0.6" angle="25"/>'
    '<translate z="4" x="1"/><rotate z="1" angle="-70"/></transform>',
    '<float name="fov" value="60"/><transform name="to_world"><matrix value="-0.137283 -0.0319925 -0.990015 4.05402 '
    '2.71355e-08 0.999478 -0.0322983 1.61647 0.990532 -0.00443408 -0.137213 -2.30652 0 0 0 1"/></transform>',
]


@pytest.mark.parametrize("body", CAMERAS)
@pytest.mark.parametrize("size", [(320, 180), (90, 200)])
def test_camera_rays_are_those_of_mitsuba(mi, load_xml, body, size):
    film = f'<integer name="width" value="{size[0]}"/><integer name="height" value="{size[1]}"/>'
    text = f'<sensor type="perspective">{body}<film type="hdrfilm">{film}</film></sensor>'
    scene = load_xml(text, sensor=False)
    sensor = mi.load_string(text.replace("<sensor ", '<sensor version="3.0.0" ', 1))
    positions = np.array([(0.5, 0.5), (0.0, 0.0), (1.0, 0.0), (0.1, 0.9), (0.73, 0.21), (1.0, 1.0)])
    origin, directions = our_rays(scene.camera, scene.film, positions)
    for position, direction in zip(positions, directions, strict=True):
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(*position), mi.Point2f(0.5, 0.5))
        np.testing.assert_allclose(np.array(ray.d), direction, atol=2e-6)
        # Mitsuba's ray starts on the near plane
        offset = np.array(ray.o) - origin
        assert np.linalg.norm(np.cross(offset, direction)) < 5e-6


def test_camera_matrix_is_right_handed(load_xml):
    scene = load_xml('<sensor type="perspective"><float name="fov" value="30"/></sensor>', sensor=False)
    np.testing.assert_array_equal(to_matrix(scene.camera.to_world), np.diag([-1.0, 1.0, -1.0, 1.0]))


# --- shapes and textures ---------------------------------------------------------------------------------------

SHAPES = {
    "rectangle": '<shape type="rectangle">{}</shape>',
    "cube": '<shape type="cube">{}</shape>',
    "disk": '<shape type="disk">{}</shape>',
    "obj": '<shape type="obj"><string name="filename" value="flat.obj"/>{}</shape>',
    "obj with normals": '<shape type="obj"><string name="filename" value="normals.obj"/>{}</shape>',
    "obj unflipped": '<shape type="obj"><string name="filename" value="normals.obj"/>'
    '<boolean name="flip_tex_coords" value="false"/>{}</shape>',
    "obj flat": '<shape type="obj"><string name="filename" value="normals.obj"/>'
    '<boolean name="face_normals" value="true"/>{}</shape>',
    "ply": '<shape type="ply"><string name="filename" value="mesh.ply"/>{}</shape>',
    "ply flipped": '<shape type="ply"><string name="filename" value="mesh.ply"/>'
    '<boolean name="flip_tex_coords" value="true"/>{}</shape>',
}
PLACES = {
    "identity": "",
    "moved": '<transform name="to_world"><scale x="2" y="0.5"/><rotate y="1" angle="30"/><translate z="3"/>'
    "</transform>",
    "mirrored": '<transform name="to_world"><scale x="-1" y="2"/><rotate y="1" angle="30"/></transform>',
}


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", SHAPES)
def test_shading_side_and_texture_are_those_of_mitsuba(mi, load_xml, xml_folder, kind, place, flip):
    """The front (as the BSDF and the emitter see it) and the texel under a point agree, whatever the transform."""
    texture = (
        '<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="colours.png"/>'
        '<string name="filter_type" value="nearest"/></texture></bsdf>'
    )
    flipped = '<boolean name="flip_normals" value="true"/>' if flip else ""
    scene = load_xml(SHAPES[kind].format(PLACES[place] + flipped + texture))
    shape = scene.shapes[0]
    mesh = meshes.tessellate(shape)
    pixels = np.asarray(Image.open(shape.bsdf.reflectance.file))
    theirs = mi.load_file(str(xml_folder / "scene.xml"))
    weights = np.array((0.31, 0.3, 0.39))
    for face in mesh.faces[:: 41 if kind == "disk" else 1]:
        corners = mesh.vertices[face].astype(np.float64)
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal /= np.linalg.norm(normal)
        point = weights @ corners
        hit = theirs.ray_intersect(mi.Ray3f(point + 0.01 * normal, -normal))
        assert np.array(hit.sh_frame.n) @ normal > 0.9
        if mesh.normals is not None:
            assert (mesh.normals[face] @ np.array(hit.sh_frame.n) > 0.9).all()
        uv = weights @ mesh.uvs[face].astype(np.float64)
        np.testing.assert_allclose(uv, np.array(hit.uv), atol=3e-4 if kind == "disk" else 1e-5)
        texel = pixels[int(uv[1] * 4), int(uv[0] * 8)] / 255.0
        linear = np.where(texel <= 0.04045, texel / 12.92, ((texel + 0.055) / 1.055) ** 2.4)
        found = np.array(hit.bsdf().eval_diffuse_reflectance(hit))
        np.testing.assert_allclose(found, linear, atol=2e-3)  # Mitsuba stores half precision


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("place", PLACES)
def test_computed_normals_are_those_of_mitsuba(mi, load_xml, xml_folder, place, flat):
    flag = f'<boolean name="face_normals" value="{str(flat).lower()}"/>'
    body = '<shape type="obj"><string name="filename" value="bent.obj"/>' + flag + PLACES[place] + "</shape>"
    mesh = meshes.tessellate(load_xml(body).shapes[0])
    scene = mi.load_file(str(xml_folder / "scene.xml"))
    weights = np.array((0.2, 0.3, 0.5))
    for face in mesh.faces:
        corners = mesh.vertices[face].astype(np.float64)
        front = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        front /= np.linalg.norm(front)
        normal = front if flat else weights @ mesh.normals[face]
        hit = scene.ray_intersect(mi.Ray3f(weights @ corners + 0.01 * front, -front))
        np.testing.assert_allclose(np.array(hit.sh_frame.n), normal / np.linalg.norm(normal), atol=1e-5)


def test_spheres(mi, load_xml, xml_folder):
    body = '<shape type="sphere"><point name="center" x="1" y="2" z="3"/><float name="radius" value="0.5"/>{}</shape>'
    for place in ("", '<transform name="to_world"><scale value="2"/><translate x="1"/></transform>',
                  '<transform name="to_world"><scale x="-2" y="2" z="2"/></transform>'):  # fmt: skip
        shape = load_xml(body.format(place)).shapes[0]
        matrix = to_matrix(shape.to_world)
        center = (matrix @ (*shape.center, 1.0))[:3]
        radius = shape.radius * np.cbrt(abs(np.linalg.det(matrix)))
        direction = np.array((0.0, 0.6, -0.8))
        hit = mi.load_file(str(xml_folder / "scene.xml")).ray_intersect(mi.Ray3f(center - 10 * direction, direction))
        np.testing.assert_allclose(np.array(hit.p), center - radius * direction, atol=1e-5)
        outward = -direction * (-1.0 if shape.flip_normals else 1.0)
        np.testing.assert_allclose(np.array(hit.sh_frame.n), outward, atol=1e-5)


def test_uv_transforms(mi, load_xml):
    steps = '<scale x="20" y="80"/><rotate z="1" angle="30"/><translate x="0.1" y="0.2" z="3"/>'
    texture = (
        '<texture type="checkerboard" name="reflectance"><transform name="to_uv">' + steps + "</transform></texture>"
    )
    found = bsdf_of(load_xml(on_shape(f'<bsdf type="diffuse">{texture}</bsdf>'))).reflectance.uv_transform
    theirs = mi.load_string(f'<bsdf version="3.0.0" type="diffuse">{texture}</bsdf>')
    expected = np.array(mi.traverse(theirs)["reflectance.to_uv"].matrix)
    np.testing.assert_allclose(found, expected[:2], atol=2e-6)


def test_old_uv_scale_and_offset(mi, load_xml):
    body = '<bsdf type="diffuse"><texture type="checkerboard" name="reflectance"><float name="uoffset" value="0.5"/>'
    body += '<float name="uscale" value="10"/><float name="vscale" value="3"/></texture></bsdf>'
    found = bsdf_of(load_xml(on_shape(body), "0.6.0")).reflectance.uv_transform
    theirs = mi.load_string(body.replace("<bsdf ", '<bsdf version="0.6.0" '))
    np.testing.assert_allclose(found, np.array(mi.traverse(theirs)["reflectance.to_uv"].matrix)[:2], atol=1e-6)


def test_scalar_texture_is_linearised_as_mitsuba_does(mi, load_xml, xml_folder):
    bitmap = '<texture type="bitmap" name="opacity"><string name="filename" value="colours.png"/>{}</texture>'
    for extra, space in (("", "srgb"), ('<boolean name="raw" value="true"/>', "linear")):
        body = f'<bsdf type="mask">{bitmap.format(extra)}<bsdf type="diffuse"/></bsdf>'
        assert bsdf_of(load_xml(on_shape(body))).opacity.color_space == space


# --- BSDFs, emitters and other defaults ------------------------------------------------------------------------


def test_bump_maps_take_a_texture_of_any_name(load_xml, xml_folder):
    """Encoded as it says; normals too."""
    image = '<texture type="bitmap" name="{}"><string name="filename" value="colours.png"/>{}</texture>'
    raw, file = '<boolean name="raw" value="true"/>', str(xml_folder / "colours.png")
    body = (
        f'<bsdf type="bumpmap"><float name="scale" value="-3"/>{image.format("map", raw)}<bsdf type="plastic"/></bsdf>'
    )
    expected = d.BumpMap(bsdf=d.Plastic(), height=d.Bitmap(file=file, color_space="linear"), scale=-3.0)
    assert bsdf_of(load_xml(on_shape(body))) == expected
    body = f'<bsdf type="normalmap">{image.format("normalmap", "")}<bsdf type="diffuse"/></bsdf>'
    expected = d.NormalMap(bsdf=d.Diffuse(), normal=d.Bitmap(file=file, color_space="srgb"))
    assert bsdf_of(load_xml(on_shape(body))) == expected


BSDFS = [
    ('<bsdf type="diffuse"/>', d.Diffuse(reflectance=0.5)),
    (
        '<bsdf type="diffuse"><rgb name="reflectance" value="0.1 0.2,0.3"/></bsdf>',
        d.Diffuse(reflectance=[0.1, 0.2, 0.3]),
    ),
    ('<bsdf type="diffuse"><spectrum name="reflectance" value="0.25"/></bsdf>', d.Diffuse(reflectance=0.25)),
    ('<bsdf type="conductor"/>', d.Conductor(eta=0.0, k=1.0)),
    ('<bsdf type="conductor"><string name="material" value="none"/></bsdf>', d.Conductor(eta=0.0, k=1.0)),
    ('<bsdf type="conductor"><string name="material" value="Au"/></bsdf>', d.Conductor(material="Au")),
    ('<bsdf type="conductor"><float name="eta" value="1.5"/></bsdf>', d.Conductor(eta=1.5, k=1.0)),
    ('<bsdf type="roughconductor"/>', d.RoughConductor(eta=0.0, k=1.0, distribution="beckmann")),
    (
        '<bsdf type="roughconductor"><float name="alpha" value="0.00001"/><string name="material" value="Cu"/></bsdf>',
        d.Conductor(material="Cu"),
    ),
    (
        '<bsdf type="roughconductor"><float name="alpha_u" value="0.2"/><float name="alpha_v" value="0.2"/></bsdf>',
        d.RoughConductor(eta=0.0, k=1.0, alpha=0.2, distribution="beckmann"),
    ),
    ('<bsdf type="dielectric"/>', d.Dielectric()),
    (
        '<bsdf type="dielectric"><string name="int_ior" value="water"/><float name="ext_ior" value="1"/></bsdf>',
        d.Dielectric(int_ior="water", ext_ior=1.0),
    ),
    (
        '<bsdf type="roughconductor"><float name="alpha_u" value="0.2"/><float name="alpha_v" value="0.4"/>'
        '<string name="material" value="Cu"/></bsdf>',
        d.RoughConductor(material="Cu", alpha_u=0.2, alpha_v=0.4, distribution="beckmann"),
    ),
    (
        '<bsdf type="roughdielectric"><float name="alpha_u" value="0.2"/><float name="alpha_v" value="0.2"/></bsdf>',
        d.RoughDielectric(alpha=0.2, distribution="beckmann"),
    ),
    (
        '<bsdf type="blendbsdf"><float name="weight" value="0.25"/><bsdf type="diffuse"/><bsdf type="plastic"/></bsdf>',
        d.Blend(first=d.Diffuse(), second=d.Plastic(), weight=0.25),
    ),
    (
        '<bsdf type="normalmap"><rgb name="normalmap" value="0.4, 0.5, 0.9"/><bsdf type="diffuse"/></bsdf>',
        d.NormalMap(bsdf=d.Diffuse(), normal=[0.4, 0.5, 0.9]),
    ),
    (
        '<bsdf type="normalmap"><rgb name="normalmap" value="0.4, 0.5, 0.9"/><bsdf type="diffuse"/>'
        '<boolean name="flip_invalid_normals" value="false"/>'
        '<boolean name="use_shadowing_function" value="false"/></bsdf>',
        d.NormalMap(bsdf=d.Diffuse(), normal=[0.4, 0.5, 0.9], flip_invalid_normals=False, shadowing=False),
    ),
    ('<bsdf type="roughdielectric"/>', d.RoughDielectric(distribution="beckmann")),
    ('<bsdf type="roughdielectric"><float name="alpha" value="0"/></bsdf>', d.Dielectric()),
    ('<bsdf type="plastic"/>', d.Plastic()),
    (
        '<bsdf type="plastic"><float name="int_ior" value="1.6"/><string name="ext_ior" value="water"/>'
        '<rgb name="diffuse_reflectance" value="0.1 0.2 0.3"/><float name="specular_reflectance" value="0.75"/>'
        '<boolean name="nonlinear" value="true"/></bsdf>',
        d.Plastic(
            int_ior=1.6,
            ext_ior="water",
            diffuse_reflectance=[0.1, 0.2, 0.3],
            specular_reflectance=0.75,
            nonlinear=True,
        ),
    ),
    ('<bsdf type="roughplastic"/>', d.RoughPlastic(distribution="beckmann")),
    (
        '<bsdf type="roughplastic"><float name="alpha" value="0.3"/><string name="distribution" value="ggx"/>'
        '<boolean name="nonlinear" value="true"/></bsdf>',
        d.RoughPlastic(alpha=0.3, nonlinear=True),
    ),
    ('<bsdf type="twosided"><bsdf type="diffuse"/></bsdf>', d.TwoSided(front=d.Diffuse())),
    (
        '<bsdf type="twosided"><bsdf type="diffuse"/><bsdf type="conductor"/></bsdf>',
        d.TwoSided(front=d.Diffuse(), back=d.Conductor(eta=0.0, k=1.0)),
    ),
    ('<bsdf type="mask"><bsdf type="diffuse"/></bsdf>', d.Mask(bsdf=d.Diffuse(), opacity=0.5)),
    ('<bsdf type="principled"/>', d.Principled()),
    (
        '<bsdf type="principled"><rgb name="base_color" value="0.1 0.2 0.3"/><float name="roughness" value="0.05"/>'
        '<float name="anisotropic" value="0.1"/><float name="metallic" value="0.15"/>'
        '<float name="spec_trans" value="0.2"/><float name="eta" value="1.4"/><float name="spec_tint" value="0.25"/>'
        '<float name="sheen" value="0.3"/><float name="sheen_tint" value="0.35"/><float name="flatness" value="0.4"/>'
        '<float name="clearcoat" value="0.45"/><float name="clearcoat_gloss" value="0.55"/>'
        '<float name="main_specular_sampling_rate" value="2"/><float name="clearcoat_sampling_rate" value="3"/>'
        '<float name="diffuse_reflectance_sampling_rate" value="4"/></bsdf>',
        d.Principled(
            base_color=[0.1, 0.2, 0.3],
            roughness=0.05,
            anisotropic=0.1,
            metallic=0.15,
            spec_trans=0.2,
            eta=1.4,
            spec_tint=0.25,
            sheen=0.3,
            sheen_tint=0.35,
            flatness=0.4,
            clearcoat=0.45,
            clearcoat_gloss=0.55,
            main_specular_sampling_rate=2.0,
            clearcoat_sampling_rate=3.0,
            diffuse_reflectance_sampling_rate=4.0,
        ),
    ),
    (
        '<bsdf type="twosided"><bsdf type="principled"><float name="specular" value="0"/>'
        '<texture name="sheen" type="checkerboard"/></bsdf></bsdf>',
        d.TwoSided(front=d.Principled(specular=0.0, sheen=d.Checkerboard(color0=0.2, color1=0.4))),
    ),
    ('<bsdf type="null"/>', d.Null()),
    ('<bsdf type="thindielectric"><float name="int_ior" value="1.5"/></bsdf>', d.ThinDielectric(int_ior=1.5)),
]


@pytest.mark.parametrize(("body", "expected"), BSDFS)
def test_bsdfs(load_xml, body, expected):
    assert bsdf_of(load_xml(on_shape(body))) == expected


@pytest.mark.parametrize(("body", "expected"), BSDFS)
def test_mitsuba_reads_the_same_bsdfs(mi, body, expected):
    mi.load_string(body.replace("<bsdf ", '<bsdf version="3.0.0" ', 1))


def test_default_indices_are_those_of_mitsuba(mi):
    for record in (d.Dielectric(), d.RoughDielectric(), d.Plastic(), d.RoughPlastic()):
        kind = record.__struct_config__.tag.replace("_", "")
        eta = mi.traverse(mi.load_dict({"type": kind}))["eta"]
        assert record.int_ior / record.ext_ior == pytest.approx(eta, rel=1e-6)
    assert (d.ThinDielectric().int_ior, d.ThinDielectric().ext_ior) == (d.Dielectric().int_ior, d.Dielectric().ext_ior)


@pytest.mark.parametrize(
    "element",
    [
        '<rgb name="radiance" value="1 2 3"/>',
        '<spectrum name="radiance" value="5"/>',
        '<float name="radiance" value="5"/>',
    ],
)
def test_emitted_colours_are_those_of_mitsuba(mi, load_xml, element):
    scene = load_xml(f'<emitter type="constant">{element}</emitter>')
    emitter = mi.load_string(f'<emitter version="3.0.0" type="constant">{element}</emitter>')
    theirs = np.array(emitter.eval(mi.SurfaceInteraction3f()))
    np.testing.assert_allclose(np.broadcast_to(scene.emitters[0].radiance, 3), theirs, rtol=2e-6)
    scene = load_xml(on_shape(f'<emitter type="area">{element}</emitter>'))
    np.testing.assert_allclose(np.broadcast_to(scene.shapes[0].emitter.radiance, 3), theirs, rtol=2e-6)
    assert bsdf_of(scene) == d.Diffuse(reflectance=0.0)


def test_srgb_colours(load_xml):
    body = on_shape('<bsdf type="diffuse"><srgb name="reflectance" value="{}"/></bsdf>')
    np.testing.assert_allclose(
        bsdf_of(load_xml(body.format("#ff8000"), "0.6.0")).reflectance, (1.0, 0.2158605, 0.0), atol=1e-6
    )
    np.testing.assert_allclose(
        bsdf_of(load_xml(body.format("0.5 1 0.04"), "0.6.0")).reflectance, (0.214041, 1.0, 0.0030960), atol=1e-6
    )


def test_scene_defaults(load_xml):
    scene = load_xml("")
    assert (scene.film.width, scene.film.height, scene.film.filter) == (768, 576, d.GaussianFilter(stddev=0.5))
    assert scene.integrator == d.PathIntegrator(max_depth=1000, rr_depth=5, spp=4)
    assert any("no integrator" in warning for warning in load_xml.warnings)


@pytest.mark.parametrize(
    ("body", "expected", "warning"),
    [
        ('type="path"><integer name="max_depth" value="7"/>', (7, 5), None),
        ('type="path"><integer name="max_depth" value="7"/><integer name="rr_depth" value="3"/>', (7, 3), None),
        ('type="path">', (1000, 5), "unlimited max_depth"),
        ('type="direct">', (2, None), None),
        (
            'type="sppm"><integer name="max_depth" value="9"/><integer name="photon_count" value="9"/>',
            (9, 5),
            "'sppm' is taken",
        ),
    ],
)
def test_integrators(load_xml, body, expected, warning):
    integrator = load_xml(f"<integrator {body}</integrator>").integrator
    assert (integrator.max_depth, integrator.rr_depth) == expected
    assert len(load_xml.warnings) == (warning is not None)
    assert warning is None or (warning in load_xml.warnings[0] and "line 2" in load_xml.warnings[0])


@pytest.mark.parametrize(
    ("kind", "sampler", "warns"),
    [
        ("independent", "independent", False),
        ("ldsampler", "sobol", False),
        ("sobol", "sobol", False),
        ("multijitter", "sobol", True),
        ("halton", "sobol", True),
        ("other", "independent", True),
    ],
)
def test_samplers(load_xml, kind, sampler, warns):
    numbers = '<integer name="sample_count" value="9"/><integer name="seed" value="1"/>'
    plugin = f'<sampler type="{kind}">{numbers}</sampler>'
    path = '<integrator type="path"><integer name="max_depth" value="7"/></integrator>'
    integrator = load_xml(f'{path}<sensor type="perspective">{plugin}</sensor>', sensor=False).integrator
    assert integrator == d.PathIntegrator(max_depth=7, sampler=sampler, spp=9)
    told = [warning for warning in load_xml.warnings if "sampler" in warning]
    assert len(told) == warns
    assert not warns or f"is taken as '{sampler}'" in told[0]


@pytest.mark.parametrize(
    ("body", "expected", "warns"),
    [
        ('type="box"/>', d.BoxFilter(), False),
        ('type="tent"/>', d.TentFilter(radius=1.0), False),
        ('type="tent"><float name="radius" value="2"/></rfilter>', d.TentFilter(radius=2.0), False),
        ('type="gaussian"><float name="stddev" value="0.4"/></rfilter>', d.GaussianFilter(stddev=0.4), False),
        ('type="mitchell"/>', d.GaussianFilter(), True),
    ],
)
def test_filters(load_xml, body, expected, warns):
    scene = load_xml(f'<sensor type="perspective"><film type="hdrfilm"><rfilter {body}</film></sensor>', sensor=False)
    assert scene.film.filter == expected
    assert any("rfilter" in warning for warning in load_xml.warnings) == warns


def sensor(kind, body="", film=""):
    return f'<sensor type="{kind}">{body}<film type="hdrfilm">{film}</film></sensor>'


LENS = '<float name="aperture_radius" value="0.5"/>'


@pytest.mark.parametrize(
    ("kind", "body", "expected"),
    [
        (
            "perspective",
            '<float name="fov" value="30"/><float name="principal_point_offset_y" value="0.25"/>',
            d.Perspective(fov=30.0, principal_point_offset=(0.0, 0.25)),
        ),
        (
            "thinlens",
            '<float name="fov" value="30"/><string name="fov_axis" value="y"/><float name="focus_distance" value="3"/>'
            + LENS,
            d.ThinLens(fov=30.0, fov_axis="y", aperture_radius=0.5, focus_distance=3.0),
        ),
        (
            "thinlens",
            '<float name="fov" value="30"/>' + LENS,
            d.ThinLens(fov=30, aperture_radius=0.5, focus_distance=1e4),
        ),
        ("orthographic", "", d.Orthographic(width=2.0)),
    ],
)
@pytest.mark.parametrize("version", ["0.5.0", "3.0.0"])
def test_cameras(load_xml, kind, body, expected, version):
    body = in_old_words(body) if version < "3" else body
    camera = load_xml(sensor(kind, body), version, sensor=False).camera
    matrix = to_matrix(camera.to_world)
    camera.to_world = []
    assert camera == expected
    np.testing.assert_array_equal(matrix, np.diag([-1.0, 1.0, -1.0, 1.0]))
    assert not [warning for warning in load_xml.warnings if "integrator" not in warning]


def test_clip_planes_are_a_warning(load_xml):
    load_xml(sensor("thinlens", LENS + '<float name="near_clip" value="1"/>'), sensor=False)
    assert any("near_clip is left out; nothing is clipped" in warning for warning in load_xml.warnings)


def film_numbers(**numbers):
    return "".join(f'<integer name="{name}" value="{value}"/>' for name, value in numbers.items())


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ({}, None),
        ({"crop_offset_x": 0, "crop_width": 60}, None),
        ({"crop_offset_x": 10, "crop_width": 50}, d.Crop(x=10, y=0, width=50, height=40)),
        (
            {"crop_offset_x": 1, "crop_offset_y": 39, "crop_width": 2, "crop_height": 1},
            d.Crop(x=1, y=39, width=2, height=1),
        ),
    ],
)
def test_crop_windows(load_xml, numbers, expected):
    film = load_xml(sensor("perspective", film=film_numbers(width=60, height=40, **numbers)), sensor=False).film
    assert film.crop == expected
    assert (film.width, film.height) == (60, 40)


# --- structure: names, references, parameters, includes ----------------------------------------------------------

DIALECT = """
<default name="size" value="64"/>
<integrator type="path"><integer name="max_depth" value="$depth"/><integer name="rr_depth" value="4"/></integrator>
<sensor type="perspective">
  <float name="fov" value="35"/><string name="fov_axis" value="y"/>
  <transform name="to_world"><scale x="1"/><lookat origin="0 1 5" target="0 1 0" up="0 1 0"/></transform>
  <sampler type="independent"><integer name="sample_count" value="16"/></sampler>
  <film type="hdrfilm"><integer name="width" value="$size"/><integer name="height" value="32"/>
    <rfilter type="gaussian"/></film>
</sensor>
<bsdf type="twosided" id="walls"><bsdf type="diffuse"><rgb name="reflectance" value="0.1, 0.2, 0.3"/></bsdf></bsdf>
<bsdf type="dielectric" id="glass"><float name="int_ior" value="1.5"/><float name="ext_ior" value="1.0"/></bsdf>
<bsdf type="roughconductor" id="metal"><float name="alpha" value="0.2"/><rgb name="eta" value="1 2 3"/>
  <rgb name="k" value="3 2 1"/><rgb name="specular_reflectance" value="0.5"/></bsdf>
<alias id="glass" as="bottle"/>
<shape type="obj" id="a"><string name="filename" value="flat.obj"/><boolean name="face_normals" value="true"/>
  <ref id="walls"/></shape>
<shape type="sphere" id="b"><float name="radius" value="2"/><point name="center" x="1" y="2" z="3"/>
  <ref id="bottle"/></shape>
<shape type="rectangle" id="c"><transform name="to_world"><rotate x="1" angle="90"/><translate y="2"/></transform>
  <boolean name="flip_normals" value="true"/><ref id="metal"/>
  <emitter type="area"><rgb name="radiance" value="3"/></emitter></shape>
<emitter type="constant"><rgb name="radiance" value="0.5"/></emitter>
"""


def in_old_words(text):
    """The scene as Mitsuba 0.5 and 0.6 spell it."""
    text = re.sub(r'name="([a-z]+(?:_[a-z]+)+)"', lambda m: f'name="{camel(m[1])}"', text)
    return text.replace("<lookat", "<lookAt").replace('name="reflectance"', 'name="diffuseReflectance"', 1)


def camel(name):
    first, *rest = name.split("_")
    return first + "".join("IOR" if part == "ior" else part.capitalize() for part in rest)


def test_dialects_give_equal_records(load_xml):
    scenes = {
        version: load_xml(text, version, sensor=False, parameters={"depth": 6})
        for version, text in (
            ("0.5.0", in_old_words(DIALECT)),
            ("0.6.0", in_old_words(DIALECT)),
            ("2.1.0", DIALECT),
            ("3.0.0", DIALECT),
        )
    }
    scene = scenes["3.0.0"]
    assert all(other == scene for other in scenes.values())
    assert [bsdf.name for bsdf in scene.bsdfs] == ["walls", "glass", "metal"]
    assert [(shape.name, shape.bsdf) for shape in scene.shapes] == [("a", "walls"), ("b", "glass"), ("c", "metal")]
    assert (scene.film.width, scene.integrator.max_depth, scene.integrator.spp) == (64, 6, 16)
    assert scene.shapes[2].flip_normals
    assert scene.shapes[2].emitter.radiance == [3.0] * 3
    np.testing.assert_allclose(to_matrix(scene.camera.to_world)[:3, 3], (0, 1, 5))
    assert "intIOR" in in_old_words(DIALECT)


def test_parameters(load_xml):
    body = '<default name="a" value="0.25"/><default name="ab" value="0.75"/>'
    body += on_shape('<bsdf type="diffuse"><rgb name="reflectance" value="$a $ab $a"/></bsdf>')
    assert bsdf_of(load_xml(body)).reflectance == [0.25, 0.75, 0.25]
    assert bsdf_of(load_xml(body, parameters={"ab": "1.0"})).reflectance == [0.25, 1.0, 0.25]
    with pytest.raises(SceneError, match=r"no parameter \$spq; allowed: a, ab"):
        load_xml(body, parameters={"spq": 1})


def test_escaped_dollar(load_xml, xml_folder):
    (xml_folder / "a$b.obj").write_text((xml_folder / "flat.obj").read_text())
    scene = load_xml('<shape type="obj"><string name="filename" value="a\\$b.obj"/></shape>')
    assert scene.shapes[0].file == str(xml_folder / "a$b.obj")


def test_includes(load_xml, xml_folder):
    (xml_folder / "parts").mkdir()
    (xml_folder / "parts" / "part.obj").write_text((xml_folder / "flat.obj").read_text())
    (xml_folder / "parts" / "inner.xml").write_text(
        '<scene version="0.6.0"><bsdf type="diffuse" id="grey"/><shape type="obj">'
        '<string name="filename" value="part.obj"/><boolean name="faceNormals" value="true"/>'
        '<ref id="grey"/></shape></scene>'
    )
    (xml_folder / "light.xml").write_text(
        '<emitter version="3.0.0" type="constant"><float name="radiance" value="$p"/></emitter>'
    )
    scene = load_xml(
        '<default name="p" value="2"/><include filename="parts/inner.xml"/><include filename="light.xml"/>'
    )
    assert scene.shapes[0].file == str(xml_folder / "parts" / "part.obj")
    assert scene.shapes[0].bsdf == "grey"
    assert scene.emitters == [d.Constant(radiance=2.0)]


def test_references_may_come_first_and_nested_ones_are_copied(load_xml):
    body = on_shape('<ref id="later"/>') + on_shape('<ref id="inner"/>')
    body += '<bsdf type="twosided" id="later"><bsdf type="diffuse" id="inner"><float name="reflectance" value="0.3"/>'
    scene = load_xml(body + "</bsdf></bsdf>")
    assert scene.shapes[0].bsdf == "later"
    assert scene.shapes[1].bsdf == d.Diffuse(reflectance=0.3)
    assert [bsdf.name for bsdf in scene.bsdfs] == ["later"]


def test_scaled_textures(load_xml):
    """The `scale` texture of Mitsuba 0.x, around a bitmap that has a name, a checkerboard, and itself."""
    body = '<texture type="bitmap" id="t"><string name="filename" value="colours.png"/></texture>'
    scale = '<texture type="scale" name="reflectance"><float name="scale" value="0.5"/>{}</texture>'
    kinds = {
        "bitmap": '<ref id="t"/>',
        "checkerboard": '<texture type="checkerboard"><rgb name="color0" value="0.1 0.2 0.3"/></texture>',
        "nested": scale.format('<ref id="t"/>').replace(' name="reflectance"', ""),
    }
    body += "".join(on_shape(f'<bsdf type="diffuse">{scale.format(child)}</bsdf>') for child in kinds.values())
    bitmap, checkers, nested = (shape.bsdf.reflectance for shape in load_xml(body).shapes)
    assert (bitmap.scale, nested.scale, bitmap.name) == (0.5, 0.25, "")
    assert (checkers.color0, checkers.color1) == ([0.05, 0.1, 0.15], 0.1)
    with pytest.raises(SceneError, match="needs one texture and a number"):
        load_xml(on_shape(f'<bsdf type="diffuse">{scale.format("")}</bsdf>'))


def test_named_textures(load_xml):
    body = '<texture type="bitmap" id="t"><string name="filename" value="colours.png"/></texture>'
    body += on_shape('<bsdf type="diffuse"><ref name="reflectance" id="t"/></bsdf>')
    scene = load_xml(body)
    assert bsdf_of(scene).reflectance == "t"
    assert [texture.name for texture in scene.textures] == ["t"]


@pytest.mark.parametrize(("alpha", "roughness"), [(0.0, 0.0), (0.2, 0.0842246), (1.0, 0.5457335)])
def test_rough_diffuse_of_mitsuba_0(load_xml, alpha, roughness):
    """The ratio of the terms of Oren and Nayar's qualitative model at sigma = alpha / sqrt(2)."""
    body = f'<bsdf type="roughdiffuse"><float name="alpha" value="{alpha}"/>'
    body += '<boolean name="useFastApprox" value="true"/>'
    found = bsdf_of(load_xml(on_shape(body + '<rgb name="reflectance" value="0.1 0.2 0.3"/></bsdf>'), "0.6.0"))
    assert found.reflectance == [0.1, 0.2, 0.3]
    assert found.roughness == pytest.approx(roughness, rel=1e-5, abs=1e-9)


def test_unused_unsupported_bsdf_is_a_warning(load_xml):
    scene = load_xml('<bsdf type="pplastic" id="p"/>' + on_shape(""))
    assert scene.bsdfs == []
    assert any("line 2: bsdf 'p' is left out" in warning for warning in load_xml.warnings)


def test_conductor_in_another_medium(load_xml):
    body = '<bsdf type="conductor"><rgb name="eta" value="3 2 1"/><rgb name="k" value="6"/>'
    body += '<float name="extEta" value="2"/></bsdf>'
    assert bsdf_of(load_xml(on_shape(body), "0.6.0")) == d.Conductor(eta=[1.5, 1.0, 0.5], k=[3.0] * 3)


# --- real scenes -----------------------------------------------------------------------------------------------


@pytest.fixture
def scenes():
    if "WAVEFRONT_SCENES" not in os.environ:
        pytest.skip("needs the environment variable WAVEFRONT_SCENES, the folder of the real scenes")
    return Path(os.environ["WAVEFRONT_SCENES"])


@pytest.mark.parametrize(("name", "triangles"), [("cornell-box", 36), ("veach-mis", 52), ("veach-ajar", None)])
@pytest.mark.parametrize("file", ["scene.xml", "original.xml"])
def test_real_scenes_load(mi, scenes, name, triangles, file):
    scene = mitsuba.load(scenes / name / file, lambda message: None)
    found = [meshes.tessellate(shape) for shape in scene.shapes if not isinstance(shape, d.Sphere)]
    meshes.clear_cache()
    total = sum(len(mesh.faces) + mesh.dropped for mesh in found)
    if triangles is not None:
        assert total == triangles
    if file == "scene.xml":
        theirs = mi.load_file(str(scenes / name / file), optimize=False)
        shapes = [shape for shape in theirs.shapes() if "Sphere" not in str(shape)]
        assert len(shapes) == len(found)
        assert total == sum(shape.face_count() if shape.is_mesh() else 2 for shape in shapes)
        box = theirs.bbox()
        corners = np.concatenate([mesh.vertices for mesh in found])
        if name != "veach-mis":
            np.testing.assert_allclose(corners.min(axis=0), np.array(box.min), atol=1e-4)
            np.testing.assert_allclose(corners.max(axis=0), np.array(box.max), atol=1e-4)
