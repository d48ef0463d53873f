"""Our own scenes: they come from their generator, and are what their descriptions say."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import trimesh
from PIL import Image

from tools import make_scenes
from wavefront.scene import description as d
from wavefront.scene import load_scene
from wavefront.scene.lookup import resolve_bsdf, walk
from wavefront.scene.mesh_files import read_mesh
from wavefront.scene.transforms import to_matrix

SCENES = make_scenes.FOLDER
NAMES = sorted(path.name for path in SCENES.glob("*.json"))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    return folder, make_scenes.write(folder)


def test_the_generator_reproduces_the_files(written):
    folder, names = written
    here = {path.relative_to(SCENES).as_posix() for path in SCENES.rglob("*") if path.is_file()}
    here = {name for name in here if not name.startswith("images/")}  # pictures for the README
    assert here == set(names)
    for name in names:
        if name.endswith(".png"):  # compressed as the library likes: the pixels count
            assert np.array_equal(Image.open(SCENES / name), Image.open(folder / name))
        else:
            assert (SCENES / name).read_bytes() == (folder / name).read_bytes(), name


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_loads_without_warnings_and_says_what_it_is_for(name):
    warnings = []
    scene = load_scene(SCENES / name, warn=warnings.append)
    assert warnings == []
    assert scene.description
    assert 192 <= scene.film.height <= 256 <= scene.film.width <= 320
    assert scene.integrator.spp == 64
    assert "include" in json.loads((SCENES / name).read_text()) or not name.startswith("material")


def test_files_are_small():
    files = [path for path in SCENES.rglob("*") if path.is_file()]
    pictures = [path.stat().st_size for path in files if path.parent.name == "images"]  # for the README
    scenes = [path.stat().st_size for path in files if path.parent.name != "images"]
    assert max(scenes) < 70_000 and sum(scenes) < 300_000
    assert max(pictures) < 320_000


def test_there_is_a_material_scene_for_every_bsdf():
    seen, names = set(), {path.stem for path in SCENES.glob("material-*.json")}
    for name in names:
        scene = load_scene(SCENES / f"{name}.json")
        (subject,) = (shape for shape in scene.shapes if shape.name == "subject")
        bsdf = subject.bsdf
        seen.add((type(bsdf), getattr(bsdf, "distribution", None)))
        assert name.startswith("material-" + bsdf.__struct_config__.tag.replace("_", "-"))
    assert {kind for kind, _ in seen} == set(get_args(d.Bsdf))
    assert {(d.RoughConductor, "ggx"), (d.RoughConductor, "beckmann")} <= seen


def test_the_furnace_has_nothing_but_a_white_sphere_in_an_even_light():
    scene = load_scene(SCENES / "furnace.json")
    assert scene.shapes == [d.Sphere(name="sphere", bsdf=d.Diffuse(reflectance=1.0))]
    assert scene.emitters == [d.Constant(radiance=1.0)]
    assert scene.integrator.rr_depth is None
    assert not scene.integrator.nee  # with it, two estimates of 1 are combined, which is 1 in the mean only


def test_every_glossy_plate_mirrors_the_row_of_lights_to_the_camera():
    scene = load_scene(SCENES / "glossy-plates.json")
    camera = to_matrix(scene.camera.to_world)[:3, 3]
    lights = [shape for shape in scene.shapes if shape.emitter]
    powers = [light.emitter.radiance * light.radius**2 for light in lights]
    assert np.allclose(powers, powers[0], rtol=1e-3)
    plates = [shape for shape in scene.shapes if shape.name.startswith("plate")]
    assert len(plates) == len(lights) == 4
    for plate in plates:
        matrix = to_matrix(plate.to_world)
        normal = matrix[:3, 1] / np.linalg.norm(matrix[:3, 1])
        top = matrix[:3, 3] + matrix[:3, 1]
        view = (top - camera) / np.linalg.norm(top - camera)
        mirrored = view - 2.0 * (view @ normal) * normal
        to_lights = np.array((0.0, *lights[0].center[1:])) - top
        assert mirrored @ to_lights / np.linalg.norm(to_lights) > math.cos(math.radians(1.0))


# --- the door --------------------------------------------------------------------------------------------------


def triangles(shape):
    """(N, 3, 3) corners of a shape in world space; a sphere as a fine polyhedron around it."""
    if isinstance(shape, d.Rectangle):
        corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], float)[[[0, 1, 2], [0, 2, 3]]]
    elif isinstance(shape, d.Cube):
        corners = trimesh.creation.box((2, 2, 2)).triangles
    elif isinstance(shape, d.Sphere):
        corners = trimesh.creation.icosphere(2, 1.02 * shape.radius).triangles + np.array(shape.center)
    else:
        mesh = read_mesh(shape.file)
        corners = mesh.vertices[mesh.faces]
    matrix = to_matrix(shape.to_world)
    return corners @ matrix[:3, :3].T + matrix[:3, 3]


def first_hit(corners, origins, directions):
    """For each ray, the parameter of the closest hit and the triangle; infinity and -1 where there is none."""
    a = corners[:, 0]
    edge1, edge2 = corners[:, 1] - a, corners[:, 2] - a
    best, which = np.full(len(origins), np.inf), np.full(len(origins), -1)
    for start in range(0, len(origins), 256):
        part = slice(start, start + 256)
        o, w = origins[part, None], directions[part, None]
        p = np.cross(w, edge2)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / np.einsum("rtk,tk->rt", p, edge1)
            s = o - a
            u = np.einsum("rtk,rtk->rt", s, p) * inverse
            q = np.cross(s, edge1)
            v = np.einsum("rtk,rtk->rt", np.broadcast_to(w, q.shape), q) * inverse
            t = np.einsum("rtk,tk->rt", q, edge2) * inverse
            t[~((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 1e-6))] = np.inf
        which[part] = np.where(np.isfinite(t.min(1)), t.argmin(1), -1)
        best[part] = t.min(1)
    return best, which


def seen_and_lit(scene, columns, rows):
    """What the camera sees through a grid of rays: the shape of each, and how many of 16 lamp points light it."""
    soups = [triangles(shape) for shape in scene.shapes]
    corners = np.concatenate(soups)
    owner = np.repeat(np.arange(len(soups)), [len(soup) for soup in soups])
    matrix = to_matrix(scene.camera.to_world)
    half = math.tan(math.radians(scene.camera.fov) / 2)
    x, y = np.meshgrid((np.arange(columns) + 0.5) / columns * 2 - 1, (np.arange(rows) + 0.5) / rows * 2 - 1)
    y *= scene.film.height / scene.film.width
    directions = np.stack((x * half, y * half, -np.ones_like(x)), -1).reshape(-1, 3) @ matrix[:3, :3].T
    distance, which = first_hit(corners, np.tile(matrix[:3, 3], (len(directions), 1)), directions)
    assert (which >= 0).all()  # the rooms are closed
    points = matrix[:3, 3] + distance[:, None] * directions

    (lamp,) = (shape for shape in scene.shapes if shape.emitter)
    # Only walls and door may hide the lamp: what stands about in the room is not needed for it.
    hiding = np.concatenate(
        [
            soup
            for shape, soup in zip(scene.shapes, soups, strict=True)
            if isinstance(shape, (d.Rectangle, d.Cube)) and shape is not lamp
        ]
    )
    grid = np.linspace(-1, 1, 4)
    lamp_points = np.array([(u, v, 0.0, 1.0) for u in grid for v in grid]) @ to_matrix(lamp.to_world).T
    lit = np.zeros(len(points), int)
    for lamp_point in lamp_points[:, :3]:
        to_lamp = lamp_point - points
        # From a little above the surface towards the lamp, so that the surface does not hide it from itself.
        nearest, _ = first_hit(hiding, points + 1e-5 * to_lamp, to_lamp)
        lit += nearest >= 1.0 - 1e-4
    return [scene.shapes[i] for i in owner[which]], lit


@pytest.fixture
def door():
    return load_scene(SCENES / "door-ajar.json")


def test_the_camera_sees_neither_the_lamp_nor_what_it_lights(door):
    seen, lit = seen_and_lit(door, 64, 38)
    assert not lit.any()
    names = {shape.name for shape in seen}
    assert {"door", "floor", "right wall", "glass vase", "copper vase", "glass ball", "picture"} <= names
    assert all(shape.emitter is None for shape in seen)


def test_without_the_door_the_same_check_finds_light(door):
    door.shapes = [shape for shape in door.shapes if not shape.name.startswith("door")]
    _, lit = seen_and_lit(door, 64, 38)
    assert lit.any()


def test_light_comes_through_the_gap(door):
    """Between the free edge of the door and the opening there is a way from one room into the other."""
    corners = np.concatenate([triangles(shape) for shape in door.shapes])
    origin = np.array([(0.14, 1.3, -2.0)])
    target = np.array([(0.44, 1.3, 1.0)])
    distance, _ = first_hit(corners, origin, target - origin)
    assert distance[0] > 1.0


def test_the_door_scene_is_small_and_has_glass_and_gloss(door):
    count = sum(len(triangles(shape)) for shape in door.shapes if not isinstance(shape, d.Sphere))
    assert 500 < count < 2000
    kinds = {type(resolve_bsdf(door, shape.bsdf)) for shape in door.shapes}
    assert {d.Diffuse, d.RoughConductor, d.Conductor, d.Dielectric} <= kinds
    assert door.emitters == []


@pytest.mark.parametrize("name", ["bowl.ply", "vase.ply"])
def test_meshes_face_the_way_of_their_normals(name):
    mesh = read_mesh(str(SCENES / "meshes" / name))
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.linalg.norm(normals, axis=1) > 1e-7).all()
    assert (np.einsum("ik,ijk->ij", normals, mesh.normals[mesh.faces]).sum(1) > 0.0).all()
    assert mesh.uvs.min() == 0.0
    assert mesh.uvs.max() == 1.0


def test_the_vase_is_closed():
    mesh = read_mesh(str(SCENES / "meshes" / "vase.ply"))
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    solid.merge_vertices(merge_tex=True, merge_norm=True)
    assert solid.is_watertight
    assert solid.volume > 0.0


def test_paths_in_the_files_are_relative():
    for name in NAMES:
        for _, record in walk(load_scene(SCENES / name)):
            if getattr(record, "file", None):
                assert Path(record.file).is_relative_to(SCENES)
        assert str(SCENES) not in (SCENES / name).read_text()
