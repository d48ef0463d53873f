"""What Cycles is told of a scene, without Blender: trees of nodes are evaluated here, by the manual's definitions."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.test_experiment import Clock, Fake
from tools import experiment, methods
from tools.methods import load_job
from tools.peers import cycles
from tools.peers.cycles_materials import Images, Materials
from tools.peers.cycles_scene import camera_record, check_scene, environment, settings, sphere_mesh, write_scene
from tools.results import Budget
from wavefront.camera import make_camera
from wavefront.errors import SceneError, WavefrontError
from wavefront.film import LUMINANCE
from wavefront.scene import description as d
from wavefront.scene.images import load_image, write_exr
from wavefront.texture import srgb_to_linear

CORNELL_BOX = Path(__file__).parent.parent / "scenes" / "cornell-box.json"
MATH = {
    "ADD": np.add,
    "SUBTRACT": np.subtract,
    "MULTIPLY": np.multiply,
    "MULTIPLY_ADD": lambda a, b, c: a * b + c,
    "MINIMUM": np.minimum,
    "MAXIMUM": np.maximum,
    "LESS_THAN": lambda a, b: np.float64(a < b),
    "ARCTAN2": np.arctan2,
    "ARCCOSINE": np.arccos,
    "SQRT": np.sqrt,
}


def evaluate(tree, **given):
    """The value of a tree; `given` are vectors by the output of the node that they come from."""
    if not isinstance(tree, dict):
        return np.asarray(tree)
    inputs = {name: evaluate(value, **given) for name, value in tree["inputs"].items()}
    kind = tree["type"].removeprefix("ShaderNode")
    if kind == "Math":
        return MATH[tree["properties"]["operation"]](*inputs.values())
    if kind == "VectorMath":
        assert tree["properties"]["operation"] == "DOT_PRODUCT"
        return inputs["Vector"] @ inputs["Vector_001"]
    if kind == "CombineXYZ":
        return np.stack([inputs["X"], inputs["Y"], np.zeros_like(inputs["X"])], -1)
    return given[tree["output"]]


def find(tree, kind: str) -> dict:
    """The first node of a type."""
    if tree["type"] == f"ShaderNode{kind}":
        return tree
    for value in tree["inputs"].values():
        if isinstance(value, dict):
            try:
                return find(value, kind)
            except LookupError:
                pass
    raise LookupError(kind)


def written(scene: d.Scene, folder: Path) -> dict:
    folder.mkdir(exist_ok=True)
    write_scene(scene, folder, False, 2)
    return json.loads((folder / "scene.json").read_text())


def scene_of(**fields) -> d.Scene:
    fields = {"film": d.Film(width=8, height=8), "shapes": [d.Rectangle()]} | fields
    return d.Scene(**fields)


# --- settings ----------------------------------------------------------------------------------------------------


def test_settings():
    scene = scene_of(integrator=d.PathIntegrator(max_depth=7, rr_depth=None))
    plain, guided = settings(scene, False, 3), settings(scene, True, 3)
    for kind in ("max", "diffuse", "glossy", "transmission"):
        assert plain[f"cycles.{kind}_bounces"] == 5
    assert plain["cycles.min_light_bounces"] == 1024
    assert plain["render.threads"] == 3
    changed = {key for key in guided if guided[key] != plain.get(key)}
    assert changed == {f"cycles.use_{name}guiding" for name in ("", "surface_", "volume_", "deterministic_")} | {
        "cycles.guiding_training_samples"
    }
    scene.integrator.rr_depth = 5
    assert settings(scene, False, 3)["cycles.min_light_bounces"] == 2
    scene.integrator.rr_depth = 1
    assert settings(scene, False, 3)["cycles.min_light_bounces"] == 0


def test_lights_without_next_event_estimation(tmp_path):
    """Those that nothing else finds are left out; the others are not sampled."""
    scene = scene_of(emitters=[d.Point(position=(0, 0, 1)), d.Constant()])
    scene.shapes[0].emitter = d.Area()
    seen = written(scene, tmp_path / "with")
    scene.integrator.nee = False
    unseen = written(scene, tmp_path / "without")
    assert (len(seen["lights"]), seen["world"]["sampling"], seen["materials"][0]["sampling"]) == (1, "MANUAL", "FRONT")
    assert (unseen["lights"], unseen["world"]["sampling"], unseen["materials"][0]["sampling"]) == ([], "NONE", "NONE")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"integrator": d.PathIntegrator(max_depth=1)}, "integrator.max_depth is 1; with cycles: 2 to 1026"),
        (
            {"integrator": d.PathIntegrator(sampler="sobol")},
            'integrator.sampler is "sobol"; with cycles: "independent"',
        ),
        ({"film": d.Film(filter=d.TentFilter())}, "film.filter.type is tent; with cycles: box"),
        ({"film": d.Film(crop=d.Crop(width=4, height=4))}, "film.crop: with cycles: none"),
        ({"film": d.Film(width=8, height=3)}, "film.height is 3; with cycles: 4 or more"),
        ({"emitters": [d.Sun(direction=(0, -1, 0))]}, "emitters[0]: cycles has no emitter that is as sun is here"),
        ({"emitters": [d.SunSky(direction=(0, -1, 0))]}, "tools.convert --bake-emitters"),
        ({"shapes": [d.Cube(interior=d.Homogeneous())]}, "shapes[0].interior: with cycles: no medium"),
        ({"shapes": [d.Cube(bsdf=d.Plastic())]}, "shapes[0].bsdf: cycles has no BSDF that is as plastic is here"),
        ({"shapes": [d.Cube(bsdf=d.Null())]}, "shapes[0].bsdf: cycles has no BSDF that is as null is here"),
        ({"shapes": [d.Cube(bsdf="a")], "bsdfs": [d.Mask(name="a", bsdf=d.Diffuse())]}, "bsdf 'a': cycles has no BSDF"),
        ({"shapes": [d.Cube(bsdf=d.TwoSided(front=d.RoughPlastic()))]}, "shapes[0].bsdf.front: cycles has no BSDF"),
        ({"shapes": [d.Cube(bsdf=d.OrenNayar())]}, "shapes[0].bsdf.roughness: cycles has another model"),
        ({"shapes": [d.Cube(bsdf=d.Principled())]}, "cycles has another model of the diffuse base of principled"),
        ({"shapes": [d.Cube(bsdf=d.Principled(metallic=1.0, clearcoat=0.5))]}, "shapes[0].bsdf.clearcoat: cycles has"),
        ({"shapes": [d.Cube(bsdf=d.RoughDielectric(alpha_u=0.1, alpha_v=0.2))]}, "bsdf.alpha_u: cycles' glass has"),
        ({"shapes": [d.Cube(bsdf=d.RoughConductor(alpha_u=0.01, alpha_v=0.2))]}, "bsdf.alpha_u: cycles takes a ratio"),
        ({"shapes": [d.Cube(bsdf=d.RoughDielectric(specular_transmittance=0.5))]}, "cycles' rough glass has no such"),
        ({"shapes": [d.Cube(bsdf=d.Conductor(eta=d.Checkerboard(), k=1.0))]}, "shapes[0].bsdf.eta: with cycles: a"),
        ({"camera": d.Perspective(to_world=[d.TransformStep(scale=(1.0, 2.0, 1.0))])}, "camera.to_world: with cycles"),
        ({"camera": d.Perspective(medium=d.Homogeneous())}, "camera.medium: with cycles: none"),
        ({"camera": d.Spherical()}, "camera.type: spherical; with cycles: perspective, thin_lens, orthographic"),
    ],
)
def test_what_cycles_has_not(fields, message):
    with pytest.raises(WavefrontError) as error:
        check_scene(scene_of(**fields))
    assert message in str(error.value)


def test_check_reads_no_file():
    scene = scene_of(
        shapes=[d.Mesh(file="/none.ply", bsdf=d.Diffuse(reflectance=d.Bitmap(file="/none.png")))],
        emitters=[d.Envmap(file="/none.exr")],
    )
    check_scene(scene)


# --- lights ------------------------------------------------------------------------------------------------------


def test_environment_is_looked_up_where_ours_is(tmp_path):
    """Against the definition in `wavefront.light.envmap`, for random directions and a turned and mirrored map."""
    rng = np.random.default_rng(3)
    pixels = rng.random((3, 5, 8), np.float32)
    write_exr(tmp_path / "sky.exr", dict(zip("RGB", pixels, strict=True)))
    steps = [d.TransformStep(rotate=d.Rotate(axis=(1, 2, 3), angle=40)), d.TransformStep(scale=(-2.0, 2.0, 2.0))]
    sky = d.Envmap(file=str(tmp_path / "sky.exr"), scale=3.0, to_world=steps)
    world = written(scene_of(emitters=[sky]), tmp_path / "scene")["world"]
    directions = rng.normal(size=(100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    image = find(world["surface"], "TexImage")
    u, v, _ = evaluate(image["inputs"]["Vector"], Generated=directions).T
    angle, axis = math.radians(40.0), np.array([1.0, 2.0, 3.0]) / math.sqrt(14.0)
    # back into the map: the mirror, then Rodrigues' rotation by minus the angle
    local = directions * [-1.0, 1.0, 1.0]
    local = (
        local * math.cos(angle)
        - np.cross(axis, local) * math.sin(angle)
        + np.outer(local @ axis, axis) * (1.0 - math.cos(angle))
    )
    np.testing.assert_allclose(u % 1.0, np.arctan2(local[:, 0], -local[:, 2]) / (2.0 * math.pi) % 1.0, atol=1e-6)
    row = np.arccos(local[:, 1]) / math.pi * 4.0  # of 5 rows, from pole to pole
    np.testing.assert_allclose((1.0 - v) * 5.0 - 0.5, row, atol=1e-5)
    assert world["surface"]["inputs"]["Strength"] == 3.0
    np.testing.assert_array_equal(
        load_image(tmp_path / "scene" / image["properties"]["image"]), pixels.transpose(1, 2, 0)
    )
    np.testing.assert_array_equal(environment(sky, ""), pixels.transpose(1, 2, 0))


@pytest.mark.parametrize(("cutoff", "beam"), [(40.0, None), (40.0, 10.0), (40.0, 40.0)])
def test_spot(cutoff, beam, tmp_path):
    axis = np.array([1.0, -2.0, 0.5])
    spot = d.Spot(
        position=(1, 2, 3), direction=tuple(axis), intensity=[4.0, 2.0, 0.0], cutoff_angle=cutoff, beam_width=beam
    )
    (light,) = written(scene_of(emitters=[spot]), tmp_path)["lights"]
    axis /= np.linalg.norm(axis)
    across = np.cross(axis, (0.0, 0.0, 1.0))
    across /= np.linalg.norm(across)
    degrees = np.array([0.0, 5.0, 20.0, 35.0, 39.9, 40.1, 90.0, 180.0])
    leaving = np.outer(np.cos(np.radians(degrees)), axis) + np.outer(np.sin(np.radians(degrees)), across)
    inner = 0.75 * cutoff if beam is None else beam
    expected = np.clip((cutoff - degrees) / (cutoff - inner), 0.0, 1.0) if inner < cutoff else degrees < cutoff
    strength = light["surface"]["inputs"]["Strength"]
    # one direction after the other: a comparison is of numbers
    found = [float(evaluate(strength, Incoming=direction)) for direction in leaving]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert light["properties"]["energy"] == pytest.approx(4.0 * 4.0 * math.pi)
    assert light["surface"]["inputs"]["Color"] == [1.0, 0.5, 0.0]
    assert [row[3] for row in light["matrix"]] == [1.0, 2.0, 3.0, 1.0]


def test_directional_light_shines_along_minus_z(tmp_path):
    (light,) = written(scene_of(emitters=[d.Directional(direction=(0, -3, 0), irradiance=2.0)]), tmp_path)["lights"]
    np.testing.assert_allclose(-np.array(light["matrix"])[:3, 2], [0.0, -1.0, 0.0], atol=1e-12)
    assert light["properties"]["energy"] == 2.0


# --- materials ---------------------------------------------------------------------------------------------------


def test_sides():
    """What reflects is mixed with nothing by the side that is seen; what is twosided or lets light through is not."""
    materials = Materials(scene_of(), Images())
    one = materials.bsdf(d.Diffuse(reflectance=[0.1, 0.2, 0.3]), "")
    assert one["inputs"]["Fac"]["output"] == "Backfacing"
    assert (one["inputs"]["Shader"]["type"], one["inputs"]["Shader_001"]) == ("ShaderNodeBsdfDiffuse", None)
    two = materials.bsdf(d.TwoSided(front=d.Diffuse(reflectance=[0.1, 0.2, 0.3])), "")
    assert two == one["inputs"]["Shader"]
    both = materials.bsdf(d.TwoSided(front=d.Diffuse(), back=d.Conductor(material="Au")), "")
    assert both["inputs"]["Shader_001"]["type"] == "ShaderNodeBsdfMetallic"
    assert materials.bsdf(d.Dielectric(int_ior=1.5, ext_ior=1.0), "")["inputs"]["IOR"] == 1.5
    light = materials.surface(d.Rectangle(bsdf=d.Diffuse(), emitter=d.Area(radiance=[2.0, 8.0, 4.0])), "")
    emitted = find(light["surface"], "Emission")
    assert emitted["inputs"] == {"Color": [0.25, 1.0, 0.5], "Strength": 8.0}


@pytest.mark.parametrize(("along", "across"), [(0.3, 0.1), (0.05, 0.35), (0.2, 0.2)])
def test_roughness_of_blenders_metal(along, across):
    """By the node's definition: roughness^2 over and times sqrt(1 - 0.9 anisotropy), turned by a fraction of a turn."""
    bsdf = d.RoughConductor(material="Al", alpha_u=along, alpha_v=across)
    inputs = find(Materials(scene_of(), Images()).bsdf(bsdf, ""), "BsdfMetallic")["inputs"]
    aspect = math.sqrt(1.0 - 0.9 * inputs.get("Anisotropy", 0.0))
    found = inputs["Roughness"] ** 2 / aspect, inputs["Roughness"] ** 2 * aspect
    turned = inputs.get("Rotation", 0.0) == 0.25
    assert (found[::-1] if turned else found) == pytest.approx((along, across))


def test_images_are_linear(tmp_path):
    """sRGB colours are decoded, numbers are luminances of what is in the file, and both are scaled."""
    pixels = np.random.default_rng(2).integers(0, 256, (4, 3, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    uv = ((2.0, 0.5, 0.1), (-1.0, 3.0, 0.2))
    color = d.Bitmap(file=str(tmp_path / "a.png"), scale=[1.0, 0.5, 0.25], uv_transform=uv, wrap="mirror")
    number = d.Bitmap(file=str(tmp_path / "a.png"))
    images = Images()
    materials = Materials(scene_of(), images)
    trees = materials.parameter(color, ""), materials.parameter(number, "", scalar=True)
    materials.parameter(color, "")
    images.write(tmp_path)
    assert len(list(tmp_path.glob("image*.exr"))) == 2
    found = [load_image(tmp_path / tree["properties"]["image"]) for tree in trees]
    np.testing.assert_allclose(found[0], srgb_to_linear(pixels / 255.0) * [1.0, 0.5, 0.25], rtol=1e-6)
    np.testing.assert_allclose(found[1], np.repeat((pixels / 255.0 @ LUMINANCE)[:, :, None], 3, 2), rtol=1e-6)
    assert trees[0]["properties"]["extension"] == "MIRROR"
    points = np.random.default_rng(4).random((9, 3)) * [1.0, 1.0, 0.0]
    u, v, _ = evaluate(trees[0]["inputs"]["Vector"], UV=points).T
    np.testing.assert_allclose(u, points @ [2.0, 0.5, 0.0] + 0.1)
    np.testing.assert_allclose(1.0 - v, points @ [-1.0, 3.0, 0.0] + 0.2)


# --- shapes and cameras ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_sphere(flip, mirror):
    steps = [d.TransformStep(scale=(2.0 * mirror, 2.0, 2.0)), d.TransformStep(translate=(0.0, 0.0, 5.0))]
    mesh = sphere_mesh(d.Sphere(center=(1.0, 0.0, 0.0), radius=1.5, flip_normals=flip, to_world=steps))
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    normals = np.cross(b - a, c - a)
    areas = 0.5 * np.linalg.norm(normals, axis=1)
    assert areas.min() > 0.0
    assert areas.sum() == pytest.approx(4.0 * math.pi * 9.0, rel=1e-5)
    middle = np.array([2.0 * mirror, 0.0, 5.0])
    outwards = -1.0 if flip else 1.0
    assert (outwards * np.einsum("ij,ij->i", normals, (a + b + c) / 3.0 - middle) > 0.0).all()
    radius = np.linalg.norm(mesh.vertices - middle, axis=1)
    np.testing.assert_allclose(outwards * mesh.normals, (mesh.vertices - middle) / radius[:, None], atol=1e-5)
    np.testing.assert_allclose(radius, 3.0, rtol=3e-4)


@pytest.mark.parametrize("axis", ["x", "y", "diagonal"])
def test_camera(axis):
    """Rays through corners of the film, by the manual: the sensor is `sensor_width` mm wide at `lens` mm, and shifts
    are in widths of the sensor, to the right and up."""
    film = d.Film(width=12, height=8, pixel_aspect=0.8)
    place = [d.TransformStep(look_at=d.LookAt(origin=(1, 2, 3), target=(0, 1, -1))), d.TransformStep(scale=2.0)]
    for fov in (40.0, 170.0):
        camera = d.Perspective(fov=fov, fov_axis=axis, principal_point_offset=(0.2, -0.1), to_world=place)
        record = camera_record(camera, film)
        p, matrix = record["properties"], np.array(record["matrix"])
        assert p["lens"] >= 1.0
        ours = make_camera(camera, film)
        for x, y in ((0.0, 0.0), (12.0, 8.0), (3.0, 7.0)):
            half_width = 0.5 * p["sensor_width"] / p["lens"]
            across = (2.0 * x / 12.0 - 1.0 + 2.0 * p["shift_x"]) * half_width
            up = (1.0 - 2.0 * y / 8.0) * half_width * 8.0 / (12.0 * 0.8) + 2.0 * p["shift_y"] * half_width
            direction = matrix[:3, :3] @ [across, up, -1.0]
            expected = np.array(ours.corner) + x * np.array(ours.du) + y * np.array(ours.dv)
            np.testing.assert_allclose(
                direction / np.linalg.norm(direction), expected / np.linalg.norm(expected), atol=2e-6
            )
        np.testing.assert_allclose(matrix[:3, 3], np.array(ours.origin), rtol=1e-6)


def test_files_of_a_scene(tmp_path):
    job = load_job(CORNELL_BOX, ["film.filter.type=box"], None, 2)
    result = written(job.scene, tmp_path)
    assert len(result["meshes"]) == len(job.scene.shapes) == len(result["objects"])
    floor = np.load(tmp_path / result["meshes"][0]["arrays"])
    assert sorted(floor) == ["faces", "normals", "uvs", "vertices"]
    np.testing.assert_allclose(np.abs(floor["vertices"]), np.tile([1.1, 0.0, 1.0], (4, 1)), atol=1e-6)


def test_tangents_need_uvs(tmp_path):
    bsdf = d.RoughConductor(material="Al", alpha_u=0.1, alpha_v=0.3)
    mesh = d.Mesh(vertices=[(0, 0, 0), (1, 0, 0), (0, 1, 0)], faces=[(0, 1, 2)], bsdf=bsdf)
    with pytest.raises(SceneError, match=r"shapes\[0\]: with cycles: UVs"):
        write_scene(scene_of(shapes=[mesh]), tmp_path, False, 1)


# --- the environment of Blender, and methods ---------------------------------------------------------------------


def test_not_installed(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("WAVEFRONT_CYCLES", str(tmp_path / "none"))
    assert cycles.main(["--where"]) == 1
    assert "is not installed in" in capsys.readouterr().out
    with pytest.raises(WavefrontError, match=r"is not installed in .*; python -m tools.peers.cycles --install"):
        cycles.Session(scene_of(), False, 1)
    with pytest.raises(WavefrontError, match="is not installed"):
        methods.RENDERERS["cycles guided"].versions("cpu")
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "installed.json").write_text('{"blender": "1.0"}')
    assert "has Blender 1.0, not" in cycles.missing()


def test_install_that_fails_leaves_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")
    monkeypatch.delenv("PIP_FIND_LINKS", raising=False)
    monkeypatch.setenv("WAVEFRONT_CYCLES", str(tmp_path / "cycles"))
    monkeypatch.setattr(cycles, "PYTHON", sys.version_info[:2])
    monkeypatch.setattr(cycles, "VERSION", "0.0")
    assert cycles.main(["--install"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: bpy 0.0 cannot be installed: ")
    assert list(tmp_path.iterdir()) == []


def test_install_refuses(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("WAVEFRONT_CYCLES", str(tmp_path / "mine"))
    monkeypatch.setattr(cycles, "PYTHON", (3, 1))
    assert cycles.main(["--install", "--python", sys.executable]) == 2
    assert f"error: {sys.executable} is Python 3." in capsys.readouterr().err
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "diary.txt").write_text("dear")
    assert cycles.main(["--install"]) == 2
    assert "exists and is not an environment of this tool" in capsys.readouterr().err
    assert (tmp_path / "mine" / "diary.txt").exists()


def test_methods_refuse_before_anything_is_rendered():
    job = load_job(CORNELL_BOX, ["film.filter.type=box"], None, 1)
    methods.RENDERERS["cycles"].check(job)
    with pytest.raises(WavefrontError, match=r"film\.filter\.type is tent"):
        methods.RENDERERS["cycles"].check(load_job(CORNELL_BOX, [], None, 1))
    with pytest.raises(WavefrontError, match="--device cuda: cycles is run on the cpu alone"):
        methods.RENDERERS["cycles"].check(load_job(CORNELL_BOX, ["film.filter.type=box"], None, 1, "cuda"))


def test_seeds_of_runs():
    seeds = [
        methods.RENDERERS["cycles"].run_seed((scene, method), seed)
        for scene in "ab"
        for method in "ab"
        for seed in range(50)
    ]
    assert len(set(seeds)) == 200
    assert all(0 <= seed < 1 << 31 for seed in seeds)


@pytest.mark.parametrize("budget", [Budget(spp=11), Budget(seconds=3.0)], ids=["spp", "seconds"])
def test_an_engine_that_learns_anew_is_asked_once(budget):
    """Fake takes 0.25 s a sample."""
    asked = []

    class Whole(Fake):
        clock = Clock()

        def __init__(self, job, seed):
            super().__init__(job, seed)
            self.whole = True

        def add(self, spp, seconds=None):
            asked.append((spp, seconds))
            super().add(spp, seconds)

    watch = experiment.Stopwatch(Whole.clock)
    points = experiment.render_budget(Whole(None, 1), budget, watch, lambda image: {})
    assert asked == [(11, None) if budget.spp else (experiment.MOST_SAMPLES, 3.0)]
    assert [point.samples for point in points] == [11 if budget.spp else 12]
