"""Perturb: the frames of the queued slots whose material has a map, and no others."""

import numpy as np

from tests.stages.harness import Counters, launch, materials, no_textures, paths, records, surfaces, unit
from wavefront.bsdf import tables as bsdf
from wavefront.stages.perturb import make_perturb

NORMAL = unit([0.4, -0.2, 0.8])
RECORD = {"kind": bsdf.MAPS["normal"], "normal": 0.5 * (NORMAL + 1.0), "texture": -1, "scale": 1.0}


def perturb(slots, material, direction, record=None, maps=None):
    """Frames after the stage of surfaces that face +z with a tangent along +y."""
    n = len(material)
    tables = materials(diffuse=[{}, {}])
    none = {"front": -1, "back": -1}
    tables.maps_of = records(bsdf.MaterialMaps, [none, {"front": 0, "back": 0, **(maps or {})}])
    tables.maps = records(bsdf.MapRecord, [RECORD | (record or {})])
    counters = Counters()
    s = surfaces(n, material=material, tangent=(0.0, 1.0, 0.0), base_normal=9.0, terminator=9.0)
    queue = counters.queue("rays", slots)
    launch(make_perturb((), False, False), 16, tables, no_textures(), paths(n, direction=direction), queue, s)
    return s.shading_normal.numpy(), s.tangent.numpy(), s.base_normal.numpy(), s.terminator.numpy()


def in_world(v):
    """From the frame s = y, t = n x s = -x, n = z."""
    return np.array([-v[1], v[0], v[2]])


def test_frames_of_queued_slots_are_turned():
    """Slots: with a map; without; escaped; with a map but not in the queue."""
    normal, tangent, base, terminator = perturb([0, 1, 2], [1, 0, -1, 1], (0.0, 0.0, -1.0), {"shadowing": 1})
    up = (0.0, 0.0, 1.0)
    np.testing.assert_allclose(normal, [in_world(NORMAL), up, up, up], atol=1e-6)
    along = unit(np.array([1.0, 0.0, 0.0]) - NORMAL[0] * NORMAL)
    y = (0.0, 1.0, 0.0)
    np.testing.assert_allclose(tangent, [in_world(along), y, y, y], atol=1e-6)
    nine = (9.0, 9.0, 9.0)
    np.testing.assert_allclose(base, [up, up, nine, nine], atol=1e-6)
    np.testing.assert_allclose(terminator, [0.125 * 0.2 / 0.64, 0.0, 9.0, 9.0], rtol=1e-5)


def test_a_normal_that_faces_away_is_turned_back():
    direction = -in_world(unit([-0.9, 0.3, 0.1]))
    for flip, sign in ((0, 1.0), (1, -1.0)):
        normal, *_ = perturb([0], [1], direction, {"flip": flip})
        np.testing.assert_allclose(normal[0], in_world(NORMAL * (sign, sign, 1.0)), atol=1e-6)


def test_the_back_inside_of_two_sides_is_a_mirror_image():
    """Seen from below, the normal of the mirrored front points down with the same slope: minus it points up."""
    for maps, expected in (({}, NORMAL), ({"mirrored": 1}, NORMAL * (-1.0, -1.0, 1.0)), ({"back": -1}, (0, 0, 1))):
        normal, *_ = perturb([0], [1], (0.0, 0.0, 1.0), maps=maps)
        np.testing.assert_allclose(normal[0], in_world(np.array(expected)), atol=1e-6)
