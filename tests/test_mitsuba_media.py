"""Absorbing media against Mitsuba 3 with `volpath`, from the same XML: see `tests.test_mitsuba_images`.

Mitsuba does not count passing a null surface as a segment, and light samples pass there; so paths are long here, and
what is compared is the mean.
"""

import pytest

pytest.importorskip("mitsuba")
from tests import mitsuba_scenes as scenes
from tests.test_mitsuba_images import TILES, check, compare, like_the_peer, our_batches, variant  # noqa: F401
from tools.peers import mitsuba as peer
from tools.peers.mitsuba_records import integrator_of
from wavefront.scene import load_scene

DEPTH = 40
TEA = """<medium type="homogeneous" {}>
    <rgb name="albedo" value="0, 0, 0"/><rgb name="sigma_t" value="0.2, 0.4, 0.8"/><float name="scale" value="2.25"/>
  </medium>"""
BALL = f"""<shape type="sphere"><point name="center" x="-0.9" y="0.8" z="0"/><float name="radius" value="0.8"/>
    <bsdf type="dielectric"/>{TEA.format('name="interior"')}</shape>"""
BOX = f"""<shape type="cube"><transform name="to_world"><scale value="0.7"/><rotate y="1" angle="30"/>
    <translate x="1" y="0.72"/></transform><bsdf type="null"/>{TEA.format('name="interior"')}</shape>"""
CLAY = """<shape type="sphere"><point name="center" x="-0.9" y="0.8" z="0"/><float name="radius" value="0.8"/>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.3, 0.2"/></bsdf></shape>"""
SMOKE = TEA.format('id="smoke"').replace("2.25", "0.22")
MEDIA = {
    "glass ball and null box": ([scenes.FLOOR, scenes.SKY, BALL, BOX], ""),
    "camera in smoke": ([scenes.FLOOR, scenes.LAMP, CLAY], '<ref id="smoke"/>'),
}


def their_batches(scene, integrator):
    seed = 0
    while True:
        yield peer.render(scene, 32, seed, DEPTH, integrator=integrator)
        seed += 1


@pytest.mark.parametrize("records", [False, True], ids=["xml", "records"])
@pytest.mark.parametrize("name", MEDIA)
def test_media(tmp_path, name, records):
    body, camera = MEDIA[name]
    path = tmp_path / "scene.xml"
    path.write_text(scenes.document([SMOKE, *body], everything=False, camera=camera), encoding="utf-8")
    size = (scenes.SIZE, scenes.SIZE)
    scene = like_the_peer(load_scene(path), *size, DEPTH)
    assert integrator_of(scene) == "volpath"
    theirs = their_batches(peer.load_records(scene) if records else peer.load_xml(path, *size), "volpath")
    check(name, compare(our_batches(scene, 32, name), theirs, TILES))
