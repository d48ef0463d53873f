"""The converter: what it writes says the same as what it read, and an error leaves nothing behind."""

import numpy as np
import pytest
from PIL import Image

from tools import convert
from tools.gltf_writer import GltfBuilder
from tools.make_scenes import FOLDER as SCENES
from wavefront import Renderer
from wavefront.identity import scene_hash, scene_records
from wavefront.scene import description as d
from wavefront.scene import load_scene, meshes
from wavefront.scene.mesh_files import read_mesh
from wavefront.scene.mitsuba import UNLIMITED_DEPTH

OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0.5\nvt 0.1 0.2\nvt 0.9 0.2\nvt 0.9 0.8\nf 1/1 2/2 3/3\nf 1/1 3/3 4/2\n"
SCENE = """<scene version="3.0.0">
<integrator type="path"><integer name="max_depth" value="$depth"/></integrator>
<default name="unused" value="1"/>
<sensor type="perspective"><float name="fov" value="40"/></sensor>
<bsdf type="twosided" id="board"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
  <string name="filename" value="{texture}"/></texture></bsdf></bsdf>
<shape type="obj"><string name="filename" value="a/mesh.obj"/><ref id="board"/>
  <transform name="to_world"><scale x="-1" y="2"/></transform></shape>
<shape type="obj"><string name="filename" value="b/mesh.obj"/><boolean name="flip_tex_coords" value="false"/></shape>
<shape type="obj"><string name="filename" value="a/mesh.obj"/><boolean name="face_normals" value="true"/></shape>
<shape type="obj"><string name="filename" value="a/mesh.obj"/><ref id="board"/></shape>
<shape type="sphere"><emitter type="area"/></shape>
<emitter type="envmap"><string name="filename" value="a/t.png"/><float name="scale" value="2"/></emitter>
</scene>
"""


@pytest.fixture
def scene_file(tmp_path):
    for name, text in (("a", OBJ), ("b", OBJ.replace("0.5", "0.25") + "vn 0 0 1\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mesh.obj").write_text(text)
    Image.fromarray(np.full((2, 2, 3), 80, np.uint8)).save(tmp_path / "a" / "t.png")
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.replace("$depth", "5").replace("{texture}", "a/t.png"))
    return path


def test_converted_scene_is_the_same_scene(scene_file, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    out = tmp_path / "out" / "room.json"
    assert convert.main([str(scene_file), str(out)]) == 0
    assert capsys.readouterr().err == ""
    names = sorted(str(path.relative_to(out.parent)) for path in out.parent.rglob("*") if path.is_file())
    assert names == ["room.json"] + [f"room_meshes/mesh{i}.ply" for i in ("", "_2", "_3")] + ["room_textures/t.png"]
    assert str(tmp_path) not in out.read_text()
    first, second = load_scene(scene_file, warn=lambda message: None), load_scene(out)
    assert second.integrator == first.integrator
    assert second.camera == first.camera
    assert [bsdf.name for bsdf in second.bsdfs] == ["board"]
    assert second.emitters == [d.Envmap(file=str(out.parent / "room_textures" / "t.png"), scale=2.0)]
    assert len(second.shapes) == len(first.shapes)
    for before, after in zip(first.shapes, second.shapes, strict=True):
        assert (after.bsdf, after.emitter) == (before.bsdf, before.emitter)
        if isinstance(before, d.Sphere):
            continue
        a, b = meshes.tessellate(before), meshes.tessellate(after)
        np.testing.assert_array_equal(a.faces, b.faces)
        np.testing.assert_allclose(a.vertices, b.vertices, atol=1e-6)
        np.testing.assert_allclose(a.uvs, b.uvs, atol=1e-6)
        assert (a.normals is None) == (b.normals is None)
        if a.normals is not None:
            np.testing.assert_allclose(a.normals, b.normals, atol=1e-6)


def test_cameras_and_films_are_converted(scene_file, tmp_path):
    lens = '<float name="aperture_radius" value="0.1"/><float name="focus_distance" value="2"/>'
    crop = "".join(
        f'<integer name="{name}" value="{value}"/>' for name, value in (("crop_offset_y", 5), ("crop_height", 9))
    )
    text = scene_file.read_text().replace(
        'type="perspective"><', f'type="thinlens">{lens}<film type="hdrfilm">{crop}</film><'
    )
    scene_file.write_text(text)
    out = tmp_path / "out.json"
    assert convert.main([str(scene_file), str(out), "--quiet"]) == 0
    first, second = load_scene(scene_file, warn=lambda message: None), load_scene(out)
    assert (first.camera, first.film) == (second.camera, second.film)
    assert (second.camera.aperture_radius, second.film.crop) == (0.1, d.Crop(x=0, y=5, width=768, height=9))


def test_converting_again_replaces_the_folders(scene_file, tmp_path):
    out = tmp_path / "room.json"
    convert.main([str(scene_file), str(out), "--quiet"])
    before = out.read_bytes()
    (tmp_path / "room_meshes" / "left over").write_text("x")
    assert convert.main([str(out), str(out), "--quiet"]) == 0
    assert out.read_bytes() == before
    assert not (tmp_path / "room_meshes" / "left over").exists()
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize(
    ("change", "arguments", "words"),
    [
        (("", ""), ["missing.xml", "out.json"], "file not found"),
        (("", ""), ["scene.xml", "out.txt"], "must end in .json"),
        (("", ""), ["scene.xml", "out.json", "-D", "depth"], "expected NAME=VALUE"),
        (("", ""), ["scene.xml", "no/out.json"], "cannot be written"),
        (('type="sphere"', 'type="cylinder"'), ["scene.xml", "out.json"], "line 12: shape 'cylinder' is not supported"),
        (("a/t.png", "a/no.png"), ["scene.xml", "out.json"], "file not found"),
        (("a/mesh.obj", "a/broken.obj"), ["scene.xml", "out.json"], "index out of range"),
    ],
)
def test_errors_are_one_line_and_leave_nothing(scene_file, tmp_path, capsys, monkeypatch, change, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a" / "broken.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")
    scene_file.write_text(scene_file.read_text().replace(*change))
    before = sorted(path.name for path in tmp_path.iterdir())
    assert convert.main(arguments) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == before


LIT = """<scene version="3.0.0">
<integrator type="path"><integer name="max_depth" value="4"/></integrator>
<sensor type="perspective"><float name="fov" value="50"/>
  <transform name="to_world"><lookat origin="0.5, 0.5, 3" target="0.5, 0.5, 0" up="0, 1, 0"/></transform>
  <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="16"/>
    <rfilter type="tent"/></film></sensor>
<shape type="obj"><string name="filename" value="a/mesh.obj"/>
  <transform name="to_world"><rotate y="1" angle="20"/></transform>
  <bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.5, 0.7"/></bsdf></shape>
<shape type="obj"><string name="filename" value="b/mesh.obj"/></shape>
<shape type="rectangle"><emitter type="area"><rgb name="radiance" value="5, 4, 3"/></emitter>
  <transform name="to_world"><rotate y="1" angle="180"/><translate z="4"/></transform></shape>
</scene>
"""


def test_mitsuba_scene_converted_has_the_same_image(scene_file, tmp_path):
    """The kernels are those of the Cornell box."""
    scene_file.write_text(LIT)
    out = tmp_path / "room.json"
    assert convert.main([str(scene_file), str(out), "--quiet"]) == 0
    images = [Renderer(load_scene(path), seed=5).render(4) for path in (scene_file, out)]
    assert (images[0] > 0.0).mean() > 0.1
    np.testing.assert_array_equal(*images)


def test_meshes_are_written_as_they_are(tmp_path):
    """To the last bit: normals of any length, and a triangle without area."""
    rng = np.random.default_rng(8)
    vertices, normals = rng.normal(size=(2, 5, 3)).astype(np.float32)
    uvs, faces = rng.normal(size=(5, 2)).astype(np.float32), [(0, 1, 2), (2, 3, 4), (1, 1, 3)]
    builder = GltfBuilder()
    builder.scene(builder.add("nodes", mesh=builder.mesh(vertices, faces, normals, uvs), scale=[2, 1, 1]))
    assert convert.main([str(builder.write(tmp_path / "a.glb")), str(tmp_path / "b.json"), "--quiet"]) == 0
    found = read_mesh(str(tmp_path / "b_meshes" / "a.ply"))
    for name, expected in (("vertices", vertices), ("faces", faces), ("normals", normals), ("uvs", uvs)):
        np.testing.assert_array_equal(getattr(found, name), expected)


@pytest.mark.parametrize("name", ["cornell-box", "material-diffuse-bitmap", "light-envmap", "material-twosided"])
def test_converting_json_keeps_the_hash(name, tmp_path):
    """Of a scene with text meshes from the first time on that they are binary."""
    hashes = []
    source = SCENES / f"{name}.json"
    for i in range(2):
        hashes.append(scene_hash(scene_records(load_scene(source))))
        source, last = tmp_path / f"{i}.json", source
        assert convert.main([str(last), str(source)]) == 0
    hashes.append(scene_hash(scene_records(load_scene(source))))
    assert hashes[1] == hashes[2]
    assert (hashes[0] == hashes[1]) == (name != "material-twosided")


def test_parameters(scene_file, tmp_path):
    text = scene_file.read_text().replace('value="5"', 'value="$depth"')
    scene_file.write_text(text.replace('<default name="unused" value="1"/>', ""))
    out = tmp_path / "out.json"
    assert convert.main([str(scene_file), str(out)]) == 2
    assert convert.main([str(scene_file), str(out), "--quiet", "-D", "depth=-1"]) == 0
    assert load_scene(out).integrator.max_depth == UNLIMITED_DEPTH
