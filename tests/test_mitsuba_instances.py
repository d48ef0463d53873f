"""Instances against those of Mitsuba 3, from the same XML and through our records: see `tests.test_mitsuba_images`."""

import pytest

pytest.importorskip("mitsuba")
from tests import mitsuba_scenes as scenes
from tests.test_mitsuba_images import TILES, check, compare, like_the_peer, our_batches, their_batches, variant  # noqa: F401
from tools.peers import mitsuba as peer
from wavefront.scene import load_scene

# Two materials of a smooth mesh and a box, one-sided, so that a mirror must keep the outside outside.
GROUP = """<shape type="shapegroup" id="toy">
    <shape type="obj"><string name="filename" value="ball.obj"/>
      <bsdf type="diffuse"><rgb name="reflectance" value="0.3, 0.6, 0.7"/></bsdf></shape>
    <shape type="cube"><transform name="to_world"><scale value="0.5"/><rotate z="1" angle="20"/>
      <translate x="1.2" y="0.4"/></transform>
      <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.4, 0.2"/></bsdf></shape>
    <shape type="sphere"><point name="center" x="-0.7" y="0.9" z="0.5"/><float name="radius" value="0.4"/>
      <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.7, 0.2"/></bsdf></shape>
  </shape>"""
STEPS = [
    '<scale value="0.5"/><rotate y="1" angle="40"/><translate x="-1.1" y="0.5" z="0.4"/>',
    '<scale x="-0.5" y="0.5" z="0.5"/><translate x="0.2" y="0.6" z="-0.3"/>',
    '<scale x="0.3" y="0.9" z="0.5"/><rotate z="1" angle="-35"/><translate x="1.2" y="0.9"/>',
]
# Different scales along the axes: Mitsuba interpolates normals of a smooth mesh in the space of the group; ours are
# those of a mesh in the world. So there it has none.
FLAT = GROUP.replace('"toy"', '"flat"').replace('.obj"/>', '.obj"/><boolean name="face_normals" value="true"/>')
INSTANCES = "\n  ".join(
    f'<shape type="instance"><ref id="{group}"/><transform name="to_world">{steps}</transform></shape>'
    for group, steps in zip(("toy", "toy", "flat"), STEPS, strict=True)
)


@pytest.mark.parametrize("records", [False, True], ids=["xml", "records"])
def test_instances(tmp_path, records):
    scenes.write_files(tmp_path)
    path = tmp_path / "scene.xml"
    body = [scenes.FLOOR, scenes.LAMP, GROUP, FLAT, INSTANCES]
    path.write_text(scenes.document(body, everything=False), encoding="utf-8")
    size = (scenes.SIZE, scenes.SIZE)
    scene = like_the_peer(load_scene(path), *size, scenes.MAX_DEPTH)
    assert len(scene.instances) == len(STEPS)
    theirs = their_batches(peer.load_records(scene) if records else peer.load_xml(path, *size), scenes.MAX_DEPTH, 32)
    check("instances", compare(our_batches(scene, 32, "instances"), theirs, TILES))
