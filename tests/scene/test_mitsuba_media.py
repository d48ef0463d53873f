"""Media of Mitsuba scenes: every spelling gives the same record, and what scatters is refused with its line."""

import pytest

from wavefront.errors import SceneError
from wavefront.scene import description as d

RED = [0.5, 0.2, 0.4]
SPELLINGS = {
    "albedo": '<rgb name="albedo" value="0, 0, 0"/><rgb name="sigma_t" value="0.5, 0.2, 0.4"/>',
    "numbers": '<float name="albedo" value="0"/><spectrum name="sigma_t" value="0.5"/>',
    "separate": '<rgb name="sigma_a" value="0.5, 0.2, 0.4"/><float name="sigma_s" value="0"/>',
    "absorption alone": '<rgb name="sigma_a" value="0.5, 0.2, 0.4"/>',
    "scale": '<rgb name="sigma_t" value="0.5, 0.2, 0.4"/><float name="albedo" value="0"/>'
    '<float name="scale" value="2.5"/>',
    "phase": '<rgb name="sigma_t" value="0.5, 0.2, 0.4"/><float name="albedo" value="0"/>'
    '<phase type="hg"><float name="g" value="0.3"/></phase><boolean name="sample_emitters" value="false"/>',
    "volumes": '<volume type="constvolume" name="sigma_t"><rgb name="value" value="0.5, 0.2, 0.4"/></volume>'
    '<volume type="constvolume" name="albedo"><float name="value" value="0"/></volume>',
}
EXPECTED = {"numbers": d.Homogeneous(sigma_a=0.5), "scale": d.Homogeneous(sigma_a=RED, scale=2.5)}
PATH = '<integrator type="volpath"/>'


def ball(body, name="interior"):
    return f'<shape type="sphere"><medium type="homogeneous" name="{name}">{body}</medium></shape>'


@pytest.mark.parametrize("version", ["0.5.0", "0.6.0", "2.0.0", "3.0.0"])
@pytest.mark.parametrize("spelling", SPELLINGS)
def test_spellings(load_xml, spelling, version):
    body = SPELLINGS[spelling]
    if version.startswith("0."):
        for name in ("sigma_a", "sigma_s", "sigma_t", "sample_emitters"):
            first, second = name.split("_")
            body = body.replace(name, first + second.title())
    expected = EXPECTED.get(spelling, d.Homogeneous(sigma_a=RED))
    for side in ("interior", "exterior"):
        shape = load_xml(ball(body, side), version).shapes[0]
        assert getattr(shape, side) == expected
        assert getattr(shape, {"interior": "exterior", "exterior": "interior"}[side]) is None


def test_names_and_the_camera(load_xml):
    """A medium at the top level is one record, whoever refers to it; a light in it needs no word of that."""
    medium = f'<medium type="homogeneous" id="tea">{SPELLINGS["albedo"]}</medium>'
    scene = load_xml(
        PATH
        + medium
        + medium.replace('"tea"', '"unused"')
        + '<shape type="sphere"><ref name="interior" id="tea"/></shape>'
        + '<shape type="cube"><ref name="exterior" id="tea"/></shape>'
        + '<emitter type="point"><ref id="tea"/></emitter>'
        + '<sensor type="perspective"><ref id="tea"/></sensor>',
        sensor=False,
    )
    assert scene.media == [d.Homogeneous(name=name, sigma_a=RED) for name in ("tea", "unused")]
    assert [(shape.interior, shape.exterior) for shape in scene.shapes] == [("tea", None), (None, "tea")]
    assert scene.camera.medium == "tea"
    assert not [message for message in load_xml.warnings if "leaves media out" in message]


def test_a_path_integrator_is_warned_of(load_xml):
    load_xml('<integrator type="path"/>' + ball(SPELLINGS["albedo"]))
    assert any("line 2: integrator 'path' of Mitsuba leaves media out" in text for text in load_xml.warnings)
    load_xml('<integrator type="path"/><shape type="sphere"/>')
    assert not any("media" in text for text in load_xml.warnings)


def test_a_medium_that_nothing_uses_is_a_warning(load_xml):
    scene = load_xml('<medium type="heterogeneous" id="smoke"/>')
    assert scene.media == []
    assert any("medium 'smoke' is left out, nothing uses it" in text for text in load_xml.warnings)


@pytest.mark.parametrize(
    ("body", "line", "message"),
    [
        (ball('\n<float name="albedo" value="0.5"/>'), 3, "scatters: albedo is 0.5; allowed: 0"),
        (ball('\n<rgb name="sigma_s" value="0 0 0.1"/>'), 3, "scatters: sigma_s is [0.0, 0.0, 0.1]; allowed: 0"),
        (ball('<float name="sigma_t" value="1"/>'), 2, "scatters: albedo is 0.75 (its default)"),
        (ball('<float name="sigma_t" value="1"/><float name="sigma_a" value="1"/>'), 2, "either sigma_t and albedo"),
        (ball('<float name="albedo" value="0"/>\n<float name="scale" value="-1"/>'), 3, "scale must be at least 0"),
        (ball('<float name="sigma_a" value="-1"/>'), 2, "'sigma_a' must be at least 0"),
        (ball('<string name="material" value="skin1"/><float name="albedo" value="0"/>'), 2, "no property 'material'"),
        (ball(SPELLINGS["albedo"], "inside"), 2, "a medium of shape 'sphere' is named interior or exterior"),
        ('<shape type="sphere">\n<medium type="heterogeneous" name="interior"/></shape>', 3, "supported: homogeneous"),
        (ball('<volume type="gridvolume" name="albedo"/>'), 2, "volume 'gridvolume' is not supported in a medium"),
        (ball('<volume type="constvolume" name="albedo"/>'), 2, "needs a value"),
    ],
)
def test_errors(load_xml, body, line, message):
    with pytest.raises(SceneError) as error:
        load_xml(body)
    assert error.value.path == f"line {line}", error.value
    assert message in error.value.message
