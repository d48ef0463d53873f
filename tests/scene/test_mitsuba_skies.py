"""Mitsuba's skies, of both generations, to records."""

import numpy as np
import pytest

from wavefront.errors import SceneError

PORTED = '<transform name="toWorld"><rotate x="1" angle="-90"/></transform>'


def test_sunsky_of_both_generations(load_xml):
    """The zenith is local +Z in Mitsuba 3 and +Y in 0.x; the direction of the sun is the world's in both."""
    sun = '<vector name="sunDirection" x="-0.6" y="0.8" z="0.1"/><float name="turbidity" value="4"/>'
    new = '<emitter type="sunsky">{}<float name="sunAperture" value="2"/><float name="skyScale" value="3"/></emitter>'
    (ported,) = load_xml(new.format(PORTED + sun), "0.6.0").emitters
    assert "tools.convert --bake-emitters" in load_xml.warnings[-1]
    old = '<emitter type="sunsky">{}<float name="sunRadiusScale" value="2"/><float name="scale" value="3"/></emitter>'
    (found,) = load_xml(old.format(sun), "0.6.0").emitters
    for record in (ported, found):
        length = np.linalg.norm((0.6, 0.8, 0.1))
        np.testing.assert_allclose(record.direction, np.array((0.6, -0.8, -0.1)) / length)
        np.testing.assert_allclose(record.up, (0.0, 1.0, 0.0), atol=1e-12)
        assert record.turbidity == 4.0
    assert (ported.sky_scale, ported.sun_scale, ported.sun_angle) == (3.0, 1.0, 1.0)
    assert (found.sky_scale, found.sun_scale, found.sun_angle) == (3.0, 3.0, 0.5358)
    for kind, scales in (("sky", (1.0, 0.0)), ("sun", (0.0, 1.0))):
        (part,) = load_xml(f'<emitter type="{kind}">{sun}</emitter>', "0.6.0").emitters
        assert (part.sky_scale, part.sun_scale) == scales


def test_sunsky_by_place_and_time(mi, load_xml):
    """In the world's axes, to 0.05 degrees; 0.x has its own axes, in which the zenith is +Y and north -Z."""
    body = '<emitter type="sunsky"><float name="hour" value="9.5"/><integer name="month" value="3"/>{}</emitter>'
    turn = '<transform name="to_world"><rotate x="1" y="0.3" angle="20"/></transform>'
    (record,) = load_xml(body.format(turn)).emitters
    theirs = mi.load_string(f'<scene version="3.0.0">{body.format(turn)}</scene>').emitters()[0]
    sun = np.array(mi.traverse(theirs)["sun_direction"]).ravel()
    assert -np.dot(record.direction, sun) > np.cos(np.radians(0.05))
    (plain,) = load_xml(body.format("")).emitters
    (old,) = load_xml(body.format('<float name="stretch" value="1"/>'), "0.6.0").emitters
    south, west, up = plain.direction
    np.testing.assert_allclose(old.direction, (-west, up, south), atol=1e-12)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('<float name="hour" value="1"/>', "the sun is below the horizon (the zenith is local +Z, as in Mitsuba 3)"),
        ('<vector name="sun_direction" x="0" y="1" z="0"/>', "below the horizon"),
        ('<vector name="sun_direction" x="0" y="0" z="0"/>', "the direction is zero"),
        ('<vector name="sun_direction" x="0" y="0" z="1"/><float name="hour" value="9"/>', "sun_direction or hour"),
        ('<integer name="month" value="13"/>', "not a date and time"),
        ('<float name="turbidity" value="1"/>', "turbidity must be from 2 to 10; found 1"),
        ('<float name="sun_scale" value="-1"/>', "sun_scale must be at least 0; found -1"),
        ('<float name="sun_aperture" value="180"/>', "aperture of the sun"),
        ('<float name="stretch" value="1.5"/>', "stretched sky"),
        ('<float name="haze" value="1.5"/>', "haze"),
    ],
)
def test_skies_that_are_not_supported(load_xml, body, words):
    with pytest.raises(SceneError) as caught:
        load_xml(f'<emitter type="sunsky">{body}</emitter>')
    assert words in str(caught.value)
