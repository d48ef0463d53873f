"""Shape groups and instances of Mitsuba scenes: records, errors, and the way through the converter."""

import numpy as np
import pytest

from tools import convert
from wavefront.errors import SceneError
from wavefront.scene import description as d
from wavefront.scene import load_scene, meshes
from wavefront.scene.transforms import to_matrix

TREE = """<shape type="shapegroup" id="tree">
<shape type="obj" id="crown"><string name="filename" value="normals.obj"/>
<transform name="to_world"><scale value="2"/></transform><ref id="leaves"/></shape>
<shape type="sphere"><bsdf type="dielectric"/></shape>
</shape>"""
LEAVES = '<bsdf type="twosided" id="leaves"><bsdf type="diffuse"/></bsdf>'


def instance(body='<ref id="tree"/>'):
    return f'<shape type="instance">{body}</shape>'


@pytest.mark.parametrize("version", ["0.6.0", "3.0.0"])
def test_groups_and_instances(load_xml, version):
    place = '<transform name="to_world"><scale x="-2"/><translate y="3"/></transform>'
    if version == "0.6.0":
        place = place.replace("to_world", "toWorld")
    tree = TREE.replace("to_world", "toWorld") if version == "0.6.0" else TREE
    scene = load_xml(
        LEAVES
        + tree
        + instance()
        + '<shape type="cube"/>'
        + instance(place + '<ref id="tree"/>').replace("<shape ", '<shape id="second" ', 1)
        + instance('<shape type="shapegroup"><shape type="cube"/></shape>'),
        version,
    )
    assert [type(shape) for shape in scene.shapes] == [d.Cube]
    assert [group.name for group in scene.groups] == ["tree", "group 2"]
    crown, ball = scene.groups[0].shapes
    assert (crown.name, crown.bsdf) == ("crown", "leaves")
    assert isinstance(ball, d.Sphere)
    assert [(item.group, item.name) for item in scene.instances] == [("tree", ""), ("tree", "second"), ("group 2", "")]
    assert scene.instances[0].to_world == []
    expected = np.diag([-2.0, 1.0, 1.0, 1.0])
    expected[1, 3] = 3.0
    np.testing.assert_array_equal(to_matrix(scene.instances[1].to_world), expected)


def test_a_group_without_instances_is_not_seen(load_xml):
    scene = load_xml(LEAVES + TREE)
    assert (scene.shapes, scene.groups, scene.instances) == ([], [], [])


@pytest.mark.parametrize(
    ("body", "line", "message"),
    [
        (instance(""), 2, "an instance needs one shapegroup; found none"),
        (instance('<shape type="cube"/>'), 2, "an instance needs one shapegroup; found shape 'cube'"),
        (TREE + "\n" + instance('<ref id="tree"/><bsdf type="diffuse"/>'), 7, "cannot hold a bsdf; allowed: shape"),
        (instance('<shape type="shapegroup"/>'), 2, "the shapegroup is empty"),
        (
            instance('<shape type="shapegroup"><shape type="cube">\n<emitter type="area"/></shape></shape>'),
            2,
            "a shape of a shapegroup cannot emit",
        ),
        (
            TREE + instance('<shape type="shapegroup">\n<shape type="instance"><ref id="tree"/></shape></shape>'),
            7,
            "a shapegroup cannot hold instances or other groups",
        ),
        (
            instance('<shape type="shapegroup">\n<transform name="to_world"/><shape type="cube"/></shape>'),
            3,
            "a shapegroup has no to_world; its instances have",
        ),
        (
            TREE + instance('<ref id="tree"/>\n<transform name="to_world"><scale value="0"/></transform>'),
            7,
            "not inver",
        ),
    ],
)
def test_errors(load_xml, body, line, message):
    with pytest.raises(SceneError) as error:
        load_xml(LEAVES + body)
    assert error.value.path == f"line {line}", error.value
    assert message in error.value.message


def test_conversion(load_xml, xml_folder, tmp_path):
    """Meshes of groups become PLY too, and files that shapes and groups share are written once."""
    tea = '<medium type="homogeneous" id="tea"><float name="albedo" value="0"/><float name="sigma_t" value="0.5"/>'
    ball = '<shape type="sphere"><ref name="interior" id="tea"/></shape>'
    plain = '<shape type="obj"><string name="filename" value="normals.obj"/></shape>'
    first = load_xml(LEAVES + TREE + tea + "</medium>" + ball + plain + instance() + '<emitter type="constant"/>')
    out = tmp_path / "out" / "s.json"
    out.parent.mkdir()
    assert convert.main([str(xml_folder / "scene.xml"), str(out), "--quiet"]) == 0
    assert [path.name for path in (out.parent / "s_meshes").iterdir()] == ["normals.ply"]
    second = load_scene(out)
    assert (second.media, second.instances) == (first.media, first.instances)
    assert second.shapes[0].interior == "tea"
    a, b = (meshes.tessellate(scene.groups[0].shapes[0]) for scene in (first, second))
    np.testing.assert_allclose(a.vertices, b.vertices, atol=1e-6)
    np.testing.assert_allclose(a.uvs, b.uvs, atol=1e-6)
    before = out.read_bytes()
    assert convert.main([str(out), str(out), "--quiet"]) == 0
    assert out.read_bytes() == before
