"""Our scene format: reading, its messages, overrides, include, writing, schema."""

from __future__ import annotations

import json
import os

import msgspec
import numpy as np
import pytest

from wavefront.errors import SceneError, WavefrontError
from wavefront.scene import description as d
from wavefront.scene import json_format, load_scene

SPHERE = {"type": "sphere"}
NAME_OR_BITMAP = "a list of 3 numbers >= 0 and <= 1, a name or an object of type 'bitmap' or 'checkerboard'"
BSDF_TYPES = (
    "'diffuse', 'oren_nayar', 'conductor', 'rough_conductor', 'dielectric', 'rough_dielectric', 'thin_dielectric', "
    "'plastic', 'rough_plastic', 'principled', 'null', 'blend', 'normal_map', 'bump_map', 'twosided'"
)


def sphere(**fields):
    return {"shapes": [{"type": "sphere", **fields}]}


def bsdf(**fields):
    return {"bsdfs": [fields]}


@pytest.fixture
def write(tmp_path):
    def write(raw, name="s.json"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(raw, bytes):
            path.write_bytes(raw)
        else:
            path.write_text(raw if isinstance(raw, str) else json.dumps(raw), encoding="utf-8")
        return path

    return write


@pytest.fixture
def error(write):
    """The message that a scene is refused with, file and record path included, folder left out."""

    def error(raw, overrides=()):
        path = write(raw)
        with pytest.raises(SceneError) as caught:
            json_format.load(path, overrides)
        text = str(caught.value)
        assert len(text.splitlines()) == 1
        return text.replace(str(path.parent) + os.sep, "")

    return error


# --- messages --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        ('{"film": {,}}', "line 1, column 11: not JSON: expecting property name enclosed in double quotes"),
        ('{\n "film": {"width": 3 4}}', "line 2, column 22: not JSON: expecting ',' delimiter"),
        ("", "line 1, column 1: not JSON: expecting value"),
        ("[1]", "expected an object; found [1]"),
        ('{"description": "NaN",\n"film": NaN}', "line 2, column 9: not JSON: NaN is not a number here"),
        ('{"film": -Infinity}', "line 1, column 10: not JSON: -Infinity is not a number here"),
        ("[" * 100_000, "nested too deeply"),
        (b'{"description":\n"\xff"}', "line 2: not UTF-8: byte 0xff"),
        ('{"bsdfs": [{"type": "diffuse", "type": "mask"}]}', "bsdfs[0]: the key 'type' is given twice"),
    ],
)
def test_text_that_is_not_json_is_refused_with_its_place(error, raw, message):
    assert error(raw) == f"s.json: {message}"


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (
            {"film": {"widht": 3}},
            "film: unknown key 'widht'; did you mean 'width'? valid keys: width, height, crop, pixel_aspect, filter, "
            "aovs, precision",
        ),
        (
            {"fiml": {}},
            "unknown key 'fiml'; did you mean 'film'? "
            "valid keys: shapes, camera, film, integrator, textures, bsdfs, media, groups, instances, emitters, "
            "include, description",
        ),
        (
            {"film": {"a\nb": 1}},
            "film: unknown key 'a\\nb'; valid keys: width, height, crop, pixel_aspect, filter, aovs, precision",
        ),
        (
            {"shapes": [SPHERE, {"type": "spere"}]},
            "shapes[1].type: unknown type 'spere'; did you mean 'sphere'? "
            "allowed: 'mesh', 'rectangle', 'cube', 'disk', 'sphere'",
        ),
        (
            {"shapes": [{"type": 3}]},
            "shapes[0].type: expected a string; found 3; allowed: 'mesh', 'rectangle', 'cube', 'disk', 'sphere'",
        ),
        ({"film": {"filter": {"radius": 2}}}, "film.filter: missing key 'type'; allowed: 'box', 'tent', 'gaussian'"),
        (bsdf(type="twosided"), "bsdfs[0]: missing key 'front'"),
        (
            bsdf(type="diffuse", reflectance=2),
            f"bsdfs[0].reflectance: expected a number >= 0 and <= 1, {NAME_OR_BITMAP}; found 2",
        ),
        (
            bsdf(type="diffuse", reflectance=[0.1, 0.2]),
            f"bsdfs[0].reflectance: expected a number >= 0 and <= 1, {NAME_OR_BITMAP}; found [0.1, 0.2]",
        ),
        (
            bsdf(type="diffuse", reflectance=[0.1, 0.2, 1.5]),
            "bsdfs[0].reflectance[2]: expected a number >= 0 and <= 1; found 1.5",
        ),
        (
            bsdf(type="diffuse", reflectance={"type": "bitmap", "file": ""}),
            "bsdfs[0].reflectance.file: expected a string that is not empty; found the string ''",
        ),
        (
            bsdf(type="mask", bsdf=None),
            f"bsdfs[0].bsdf: expected a name or an object of type {BSDF_TYPES} or 'mask'; found null",
        ),
        ({"film": {"width": 2.5}}, "film.width: expected an integer >= 1 and <= 65536; found 2.5"),
        ({"camera": {"fov": 180}}, "camera.fov: expected a number > 0 and < 180; found 180"),
        (
            {"camera": {"type": "fisheye"}},
            "camera.type: unknown type 'fisheye'; allowed: 'perspective', 'thin_lens', 'orthographic', 'spherical'",
        ),
        ({"camera": {"type": "thin_lens", "aperture_radius": 1}}, "camera: missing key 'focus_distance'"),
        (
            {"camera": {"type": "thin_lens", "aperture_radius": -1, "focus_distance": 2}},
            "camera.aperture_radius: expected a number >= 0; found -1",
        ),
        (
            {"camera": {"type": "orthographic", "fov": 3}},
            "camera: unknown key 'fov'; valid keys: type, width, to_world, medium",
        ),
        ({"film": {"crop": {"width": 3}}}, "film.crop: missing key 'height'"),
        (
            {"film": {"width": 20, "height": 10, "crop": {"x": 18, "width": 3, "height": 10}}},
            "film.crop: expected a window inside the film of 20x10 pixels; found 3x10 at (18, 0)",
        ),
        ({"film": {"pixel_aspect": 0}}, "film.pixel_aspect: expected a number >= 0.01 and <= 100; found 0"),
        ({"integrator": {"nee": 1}}, "integrator.nee: expected true or false; found 1"),
        (
            {"integrator": {"sampler": "halton"}},
            "integrator.sampler: expected 'independent' or 'sobol'; found the string 'halton'",
        ),
        (
            {"film": {"aovs": ["albdo"]}},
            "film.aovs[0]: expected 'albedo', 'bsdf_index', 'depth', 'geometric_normal', 'normal', 'position', "
            "'sample_count', 'shape_index', 'uv' or 'variance'; found the string 'albdo'",
        ),
        ({"shapes": {}}, "shapes: expected a list of objects; found an object"),
        (sphere(to_world=[[1, 2]]), "shapes[0].to_world[0]: expected an object or a list of 4 numbers; found [1, 2]"),
        (
            sphere(to_world=[{"scale": "a"}]),
            "shapes[0].to_world[0].scale: expected a number, a list of 3 numbers or null; found the string 'a'",
        ),
        (
            sphere(to_world=[{"matrix": [1] * 7}]),
            "shapes[0].to_world[0].matrix: expected a list of 4 lists of 4 numbers or null; found a list of 7 items",
        ),
        (sphere(radius=10**400), f"shapes[0].radius: the number 1{'0' * 56}... is too large"),
        # Found by `validate`, so with the file and the path that `load` gives it.
        (sphere(bsdf="a"), "shapes[0].bsdf: unknown BSDF 'a'; none is defined"),
    ],
)
def test_a_wrong_record_is_refused_with_its_path_what_was_found_and_what_is_allowed(error, raw, message):
    assert error(raw) == f"s.json: {message}"


def test_a_missing_file_and_a_folder_are_errors(tmp_path):
    with pytest.raises(SceneError) as caught:
        json_format.load(tmp_path / "none.json")
    assert str(caught.value) == f"{tmp_path / 'none.json'}: file not found"
    with pytest.raises(SceneError) as caught:
        json_format.load(tmp_path)
    assert str(caught.value) == f"{tmp_path}: is a directory; expected a scene file"


def test_a_byte_order_mark_is_stepped_over(write):
    assert json_format.load(write(b"\xef\xbb\xbf{}")) == d.Scene()


def test_a_type_that_stands_alone_can_be_left_out(write):
    scene = json_format.load(write({"camera": {"fov": 30}, "emitters": [{"type": "constant", "radiance": 2}]}))
    assert scene.camera == d.Perspective(fov=30.0)
    assert scene.emitters == [d.Constant(radiance=2.0)]


@pytest.mark.parametrize("depth", [2, 200, 900, 5000, 100_000])
def test_deep_nesting_is_an_error_whatever_the_depth(error, depth):
    text = '{"bsdfs": [' + '{"type": "mask", "bsdf": ' * depth + '{"type": "diffuse"}' + "}" * depth + "]}"
    illegal = "bsdfs[0].bsdf: a mask cannot hold another mask; multiply their opacities"
    assert error(text) in (f"s.json: {illegal}", "s.json: nested too deeply")
    text = text.replace('"diffuse"', '"difuse"')
    assert error(text).startswith("s.json: bsdfs[0].bsdf.bsdf" if depth < 200 else "s.json: ")


# --- overrides -------------------------------------------------------------------------------------------------


def test_overrides_change_what_is_there_and_add_what_is_not(write):
    path = write({**bsdf(type="rough_conductor", name="a", material="Au"), "film": {"width": 8}})
    overrides = ["integrator.max_depth=6", "film.filter.type=tent", "film.filter.radius=2", "bsdfs[0].alpha=0.25"]
    scene = json_format.load(path, [*overrides, "description=as it is", 'camera.to_world=[{"scale": 2}]'])
    assert scene.integrator == d.PathIntegrator(max_depth=6)
    assert scene.film == d.Film(width=8, filter=d.TentFilter(radius=2.0))
    assert scene.bsdfs[0].alpha == 0.25
    assert scene.description == "as it is"
    assert scene.camera.to_world == [d.TransformStep(scale=2.0)]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("a", "bad override 'a'; expected a path and a value such as integrator.max_depth=6"),
        ("film..width=3", "bad override 'film..width=3'; expected a path and a value such as integrator.max_depth=6"),
        (
            "integrator.max_dept=6",
            "integrator: unknown key 'max_dept'; did you mean 'max_depth' or 'rr_depth'? "
            "valid keys: type, max_depth, rr_depth, nee, sampler, spp, guide (set by 'integrator.max_dept=6')",
        ),
        (
            "film.width=big",
            "film.width: expected an integer >= 1 and <= 65536; found the string 'big' (set by 'film.width=big')",
        ),
        (
            "camera.fov=NaN",
            "camera.fov: expected a number > 0 and < 180; found the string 'NaN' (set by 'camera.fov=NaN')",
        ),
        ("shapes[1].radius=2", "shapes has 1 entries (set by 'shapes[1].radius=2')"),
        ("film[0]=2", "film is not a list (set by 'film[0]=2')"),
        ("shapes[0].type.x=2", "shapes[0].type has no keys; found the string 'sphere' (set by 'shapes[0].type.x=2')"),
    ],
)
def test_a_bad_override_is_named(error, override, message):
    assert error({"shapes": [SPHERE]}, [override]) == f"s.json: {message}"


def test_overrides_of_a_scene_in_memory():
    scene = d.Scene(shapes=[d.Sphere(name="a")])
    changed = json_format.with_overrides(scene, ["shapes[0].radius=2", "integrator.spp=3"])
    assert changed == d.Scene(shapes=[d.Sphere(name="a", radius=2.0)], integrator=d.PathIntegrator(spp=3))
    assert scene.shapes[0].radius == 1.0
    with pytest.raises(SceneError) as caught:
        json_format.checked(d.Scene(bsdfs=[d.Diffuse(reflectance=-1.0)]))
    assert str(caught.value).startswith("bsdfs[0].reflectance: expected a number >= 0 and <= 1, ")


CAMERAS = [
    d.Perspective(fov=30.0, principal_point_offset=(0.25, -0.5)),
    d.ThinLens(fov=30.0, fov_axis="y", aperture_radius=0.1, focus_distance=3.0),
    d.Orthographic(width=3.0, to_world=[d.TransformStep(scale=2.0)]),
    d.Spherical(to_world=[d.TransformStep(translate=(1.0, 2.0, 3.0))]),
]


@pytest.mark.parametrize("camera", CAMERAS)
def test_every_camera_and_film_is_read_as_written(camera, write, tmp_path):
    film = d.Film(crop=d.Crop(x=1, y=2, width=30, height=40), pixel_aspect=1.5, aovs=["uv", "bsdf_index"])
    scene = d.Scene(camera=camera, film=film)
    text = json_format.dumps(scene, tmp_path)
    assert json_format.load(write(text)) == scene
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.validate(json.loads(text), json_format.schema())


# --- include ---------------------------------------------------------------------------------------------------


def test_included_records_come_before_the_own_ones(write, tmp_path):
    write(b"", "b/m.ply")
    write({"shapes": [{"type": "mesh", "file": "m.ply"}], "bsdfs": [{"type": "diffuse", "name": "b"}]}, "b/b.json")
    write({"include": ["b/b.json"], "bsdfs": [{"type": "diffuse", "name": "a"}], "description": "not taken"}, "a.json")
    path = write({"include": ["a.json", "b/b.json"], "bsdfs": [{"type": "diffuse", "name": "own"}], "shapes": [SPHERE]})
    scene = json_format.load(path)
    assert [record.name for record in scene.bsdfs] == ["b", "a", "own"]
    assert [type(shape) for shape in scene.shapes] == [d.Mesh, d.Sphere]
    assert scene.shapes[0].file == str(tmp_path / "b" / "m.ply")
    assert scene.include == []
    assert scene.description == ""


def test_errors_name_the_included_file_and_the_place_in_it(write, error, tmp_path):
    main = {"include": ["a.json"], "shapes": [dict(SPHERE)], "bsdfs": [{"type": "diffuse", "name": "own"}]}
    write({"film": {}}, "a.json")
    assert error(main) == (
        "a.json: key 'film' cannot be included; an included file has only: "
        "textures, bsdfs, media, emitters, groups, shapes, instances, description, include"
    )
    write({"shapes": [{"type": "sphere", "radius": 0}]}, "a.json")
    assert error(main) == "a.json: shapes[0].radius: expected a number > 0; found 0"
    write({"shapes": [SPHERE, {"type": "sphere", "bsdf": "owm"}]}, "a.json")
    assert error(main) == "a.json: shapes[1].bsdf: unknown BSDF 'owm'; did you mean 'own'? known: 'own'"
    write({"shapes": [SPHERE]}, "a.json")
    main["shapes"][0]["bsdf"] = "owm"
    assert error(main) == "s.json: shapes[0].bsdf: unknown BSDF 'owm'; did you mean 'own'? known: 'own'"
    write("{", "a.json")
    assert error(main).startswith("a.json: line 1, column 2: not JSON: ")


def test_include_cycles_and_missing_files_are_errors(write, error):
    assert error({"include": ["none.json"]}) == "s.json: include[0]: file not found: 'none.json'"
    assert error({"include": ["."]}) == "s.json: include[0]: file not found: '.'"
    assert error({"include": ["a\0"]}) == "s.json: include[0]: file not found: 'a\\x00'"
    assert error({"include": ["s.json"]}) == "s.json: include[0]: 's.json' includes this file in turn"
    write({"include": ["s.json"]}, "a.json")
    assert error({"include": ["a.json"]}) == "a.json: include[0]: 's.json' includes this file in turn"


# --- writing ---------------------------------------------------------------------------------------------------


def full_scene(folder):
    """A scene in which every record type and nearly every field occurs."""
    for name in ("m.ply", "t.png", "t.exr"):
        (folder / name).write_bytes(b"")
    bitmap = d.Bitmap(name="image", file=str(folder / "t.png"), color_space="srgb", filter="nearest", wrap="clamp")
    checks = d.Checkerboard(name="checks", color0=[0.1, 0.2, 0.3], uv_transform=((2.0, 0.0, 0.5), (0.0, 2.0, 0.0)))
    step = d.TransformStep
    rows = ((1.0, 0.0, 0.0, 1e-7), (0.0, 1.0, 0.0, 0.1), (0.0, 0.0, 1.0, -3.0), (0.0, 0.0, 0.0, 1.0))
    return d.Scene(
        description='"quoted" \u00e9\u2028',
        camera=d.Perspective(fov=30.5, fov_axis="y", to_world=list(rows)),
        film=d.Film(width=3, filter=d.GaussianFilter(stddev=0.4), aovs=["normal"], precision="half"),
        integrator=d.PathIntegrator(max_depth=3, rr_depth=None, nee=False, sampler="sobol", spp=1),
        textures=[bitmap, checks],
        bsdfs=[
            d.Diffuse(name="a", reflectance="image"),
            d.Conductor(name="b", eta=[0.1, 0.2, 0.3], k=3.0, specular_reflectance="checks"),
            d.RoughConductor(
                name="c", material="Au", alpha=d.Bitmap(file=str(folder / "t.exr")), distribution="beckmann"
            ),
            d.Dielectric(name="d", int_ior="water", ext_ior=1.0),
            d.RoughDielectric(name="e", alpha=0.3),
            d.TwoSided(name="f", front="a", back=d.Diffuse(reflectance=0.25)),
            d.Mask(name="g", bsdf="f", opacity="checks"),
            d.RoughConductor(name="h", material="Au", alpha_u=0.1, alpha_v="checks"),
            d.BumpMap(
                name="i", bsdf="h", height=d.Bitmap(file=str(folder / "t.exr")), scale=-0.5, flip_invalid_normals=False
            ),
            d.NormalMap(name="j", bsdf="e", normal=[0.5, 0.5, 1.0], shadowing=False),
            d.Blend(name="k", first="a", second=d.Blend(first="c", second="d"), weight="checks"),
        ],
        emitters=[
            d.Envmap(
                name="sky",
                file=str(folder / "t.exr"),
                scale=0.5,
                to_world=[step(rotate=d.Rotate(axis=(1.0, 0.0, 0.0), angle=9.0))],
            ),
            d.Directional(name="d", direction=(0.0, -1.0, 0.5), irradiance=2.0),
            d.Point(name="p", position=(0.0, 1.0, 0.5), intensity=[1.0, 0.0, 1e8]),
            d.Spot(position=(0.0, 1.0, 0.5), direction=(0.0, 0.0, 2.0), cutoff_angle=180.0, beam_width=0.0),
            d.Sun(direction=(1.0, 1.0, 0.5), angle=0.5, radiance=[1.0, 2.0, 3.0]),
            d.SunSky(direction=(1.0, -1.0, 0.5), turbidity=4.0, up=(0.0, 2.0, 0.1), sky_scale=0.0, resolution=64),
        ],
        shapes=[
            d.Mesh(name="m", file=str(folder / "m.ply"), flip_v=True, bsdf="g"),
            d.Mesh(
                vertices=[(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 1.0, 0.3)],
                faces=[(0, 1, 2), (1, 3, 2)],
                normals=[(0.0, 0.0, 1.0)] * 4,
                uvs=[(0.0, 0.0)] * 4,
            ),
            d.Rectangle(to_world=[step(look_at=d.LookAt(origin=(0.0, 0.0, 1.0), target=(1.0, 0.0, 0.0)))]),
            d.Cube(to_world=[step(scale=(1.0, 2.0, 3.0)), step(rotate=d.Rotate(axis=(0.0, 1.0, 0.0), angle=20.0))]),
            d.Disk(emitter=d.Area(radiance="checks", two_sided=True), flip_normals=True, to_world=[step(matrix=rows)]),
            d.Sphere(center=(0.1, 0.2, 0.3), radius=2.0, bsdf=d.Diffuse(), to_world=[step(translate=(0.0, 0.0, 1.0))]),
        ],
    )


def test_what_is_written_reads_as_the_same(tmp_path):
    scene = full_scene(tmp_path)
    (tmp_path / "out").mkdir()
    path = tmp_path / "out" / "s.json"
    json_format.dump(scene, path)
    assert json_format.load(path) == scene
    assert path.read_bytes() == json_format.dumps(scene, path.parent).encode()
    raw = json.loads(path.read_text())
    assert raw["shapes"][0]["file"] == "../m.ply"
    assert raw["bsdfs"][2]["alpha"]["file"] == "../t.exr"
    assert [entry.name for entry in path.parent.iterdir()] == ["s.json"]


def test_defaults_are_left_out_and_number_rows_are_compact(tmp_path):
    assert json_format.dumps(d.Scene(), tmp_path) == "{}\n"
    assert json.loads(json_format.dumps(d.Scene(film=d.Film(width=3)), tmp_path)) == {"film": {"width": 3}}
    mesh = d.Mesh(vertices=np.eye(4)[:, :3], faces=[(0, 1, 2)])
    assert json_format.dumps(d.Scene(description="x", shapes=[mesh]), tmp_path) == (
        '{\n  "description": "x",\n  "shapes": [\n    {\n      "type": "mesh",\n      "vertices": [\n'
        "        [1.0, 0.0, 0.0],\n        [0.0, 1.0, 0.0],\n        [0.0, 0.0, 1.0],\n        [0.0, 0.0, 0.0]\n"
        '      ],\n      "faces": [[0, 1, 2]]\n    }\n  ]\n}\n'
    )


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "s.json"
    json_format.dump(d.Scene(description="old"), path)
    with pytest.raises(SceneError) as caught:
        json_format.dump(d.Scene(shapes=[d.Sphere(radius=float("nan"))]), path)
    assert str(caught.value) == "a number of the scene is not finite"
    assert json_format.load(path).description == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["s.json"]
    with pytest.raises(WavefrontError) as caught:
        json_format.dump(d.Scene(), tmp_path / "none" / "s.json")
    assert len(str(caught.value).splitlines()) == 1


def test_a_large_inline_mesh(tmp_path):
    side = 250
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side), [0.5]), -1).reshape(-1, 3) / 7
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1, 1)
    faces = np.concatenate((corner + np.array((0, 1, side)), corner + np.array((1, side + 1, side))))
    path = tmp_path / "s.json"
    json_format.dump(d.Scene(shapes=[d.Mesh(vertices=grid, faces=faces)]), path)
    scene = json_format.load(path)
    assert np.array_equal(scene.shapes[0].vertices, grid)
    assert np.array_equal(scene.shapes[0].faces, faces)


# --- schema ----------------------------------------------------------------------------------------------------


def fits(value, node, definitions):
    """Whether `value` is what JSON Schema `node` allows, as far as our schemas go."""
    if "$ref" in node:
        return fits(value, definitions[node["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in node:
        return any(fits(value, option, definitions) for option in node["anyOf"])
    if "enum" in node:
        return value in node["enum"]
    kinds = {"string": str, "boolean": bool, "null": type(None), "object": dict, "array": list, "integer": int}
    kind = (int, float) if node["type"] == "number" else kinds[node["type"]]
    if not isinstance(value, kind) or (isinstance(value, bool) and node["type"] != "boolean"):
        return False
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return node.get("minimum", value) <= value <= node.get("maximum", value) and node.get(
            "exclusiveMinimum", value - 1
        ) < value < node.get("exclusiveMaximum", value + 1)
    if isinstance(value, list):
        if not node.get("minItems", 0) <= len(value) <= node.get("maxItems", len(value)):
            return False
        items = node.get("prefixItems") or [node["items"]] * len(value)
        return all(fits(item, inner, definitions) for item, inner in zip(value, items, strict=True))
    if isinstance(value, dict):
        known = node["properties"]
        return set(node.get("required", ())) <= set(value) <= set(known) and all(
            fits(item, known[key], definitions) for key, item in value.items()
        )
    return True


def test_the_schema_allows_what_is_written_and_refuses_what_is_refused(tmp_path):
    schema = json_format.schema()
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert schema["title"] == "Wavefront scene"
    definitions = schema["$defs"]
    json.dumps(schema)
    raw = json.loads(json_format.dumps(full_scene(tmp_path), tmp_path))
    assert fits(raw, schema, definitions)
    assert fits({"camera": {"fov": 3}, "shapes": [{"type": "cube", "emitter": {}}]}, schema, definitions)
    for wrong in (
        {"camera": {"fov": 180}},
        {"shapes": [{}]},
        {"film": {"widht": 3}},
        bsdf(type="diffuse", reflectance=2),
    ):
        assert not fits(wrong, schema, definitions)
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert(wrong, d.Scene)
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(raw, schema)


def test_every_field_of_the_schema_that_is_not_plain_is_described():
    definitions = json_format.schema()["$defs"]
    assert all("description" in definitions["Scene"]["properties"][key] for key in ("shapes", "bsdfs", "include"))
    assert "description" in definitions["Bitmap"]


# --- load_scene ------------------------------------------------------------------------------------------------


def test_load_scene_goes_by_the_suffix(write, tmp_path):
    warnings = []
    assert load_scene(write({"shapes": [SPHERE]}), ["shapes[0].radius=3"], warn=warnings.append).shapes[0].radius == 3.0
    assert warnings == ["the scene has no emitter: the image will be black"]
    cases = {
        tmp_path / "s.blend": "unknown scene format '.blend'; allowed: .json, .xml, .gltf, .glb",
        tmp_path / "no-suffix": "unknown scene format ''; allowed: .json, .xml, .gltf, .glb",
        tmp_path / "none.json": "file not found",
        tmp_path / "none.xml": "file not found",
        tmp_path / "none.glb": "file not found",
        tmp_path: "is a directory; expected a file, .json, .xml, .gltf, .glb",
    }
    for path, message in cases.items():
        with pytest.raises(SceneError) as caught:
            load_scene(path)
        assert str(caught.value) == f"{path}: {message}"
    with pytest.raises(SceneError) as caught:
        load_scene(write({}), parameters={"spp": "3"})
    assert caught.value.message == "parameters are for Mitsuba and glTF scenes; found spp"
