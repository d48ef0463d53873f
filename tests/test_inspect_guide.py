"""`tools.inspect_guide`: maps of directions, divergences against hand-computed ones, light at a vertex, the command."""

from __future__ import annotations

import json
import math

import numpy as np
import OpenEXR
import pytest

from tests.guides import LobeGuide, ResamplingGuide, use_mean_preset
from tools import inspect_guide
from tools.guide_map import DirectionMap
from tools.guide_vertex import VertexWorker, centred, incident_sides
from wavefront import Renderer
from wavefront.errors import WavefrontError
from wavefront.guide import check_guide
from wavefront.scene import description as d
from wavefront.scene import json_format

# --- maps --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "height", "parts"), [(16, 8, 3), (7, 5, 1), (256, 128, 4)])
def test_directions_share_their_cells_evenly(width, height, parts):
    grid = DirectionMap(width, height, parts)
    assert width * grid.solid_angle.sum() == pytest.approx(4.0 * np.pi)
    w = grid.directions.astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(w, axis=-1), 1.0, atol=1e-6)
    # Every direction is in its cell of the spherical camera's film.
    x = (np.arctan2(w[..., 0], -w[..., 2]) / (2.0 * np.pi) + 0.5) * width
    y = np.arccos(np.clip(w[..., 1], -1.0, 1.0)) / np.pi * height
    rows, columns = np.mgrid[:height, :width]
    assert (np.floor(x) == columns[..., None]).all() and (np.floor(y) == rows[..., None]).all()
    # Weighted by solid angle they have the moments of the sphere: exactly, but for the square of the size of a part.
    flat = w.reshape(-1, 3)
    weight = np.broadcast_to(grid.solid_angle[..., None] / parts**2, w.shape[:3]).ravel() / (4.0 * np.pi)
    np.testing.assert_allclose(weight @ flat, 0.0, atol=1e-6)
    size = np.pi / (height * parts)
    np.testing.assert_allclose((flat * weight[:, None]).T @ flat, np.eye(3) / 3.0, atol=size**2)


def test_divergences_by_hand():
    grid = DirectionMap(64, 64)
    up = grid.directions.reshape(-1, 3)[:, 1].astype(np.float64)
    sphere = np.full((64, 64), 1.0 / (4.0 * np.pi))
    hemisphere = grid.normalised(grid.means(up > 0.0))
    cosine = grid.normalised(grid.means(np.maximum(up, 0.0)))
    for density in (sphere, hemisphere, cosine):
        assert grid.integral(density) == pytest.approx(1.0)
        assert grid.divergence(density, density) == 0.0
    # integral of cos / pi log(2 cos) over the hemisphere: log 2 + integral of 2 c log c from 0 to 1
    assert grid.divergence(hemisphere, sphere) == pytest.approx(math.log(2.0))
    assert grid.divergence(cosine, hemisphere) == pytest.approx(math.log(2.0) - 0.5, abs=2e-3)
    assert grid.divergence(cosine, sphere) == pytest.approx(2.0 * math.log(2.0) - 0.5, abs=2e-3)
    assert grid.divergence(sphere, hemisphere) == math.inf
    assert grid.normalised(np.zeros((64, 64))) is None


def test_excess_of_noise():
    """Cells with independent noise of relative variance v in each half: that of both is v / 2, and the mean of
    x log x is raised by half of that, v / 4. Noise of the result itself: 1 / sqrt(cells), 1.3 %."""
    grid = DirectionMap(96, 64)
    rng = np.random.default_rng(4)
    truth = grid.means(1.2 + grid.directions.reshape(-1, 3)[:, 0])
    for variance in (0.01, 0.1):
        halves = [truth * rng.gamma(1.0 / variance, variance, truth.shape) for _ in range(2)]
        both = 0.5 * (halves[0] + halves[1])
        excess = grid.excess(*(grid.normalised(values) for values in (both, *halves)))
        assert excess == pytest.approx(variance / 4.0, rel=0.07)
    assert grid.excess(truth, truth, None) is None


# --- what arrives at a vertex ------------------------------------------------------------------------------------

GRID = DirectionMap(32, 48)
VIEW = [d.TransformStep(look_at=d.LookAt(origin=(0.0, 3.0, 3.0), target=(0.0, 0.0, 0.0)))]
LEVEL = [d.TransformStep(rotate=d.Rotate(axis=(1.0, 0.0, 0.0), angle=-90.0)), d.TransformStep(scale=5.0)]
TURNED = [*LEVEL, d.TransformStep(rotate=d.Rotate(axis=(0.0, 0.0, 1.0), angle=180.0))]
TILTED = [*LEVEL, d.TransformStep(rotate=d.Rotate(axis=(0.3, 0.1, 1.0), angle=37.0))]


def plate(bsdf, to_world=LEVEL, **others):
    """A plate through the origin, which the middle of the film sees."""
    parts = {"emitters": [d.Constant(radiance=1.0)], "integrator": d.PathIntegrator(max_depth=6)} | others
    shapes = [d.Rectangle(bsdf=bsdf, to_world=to_world), *parts.pop("shapes", [])]
    camera = d.Perspective(fov=40.0, to_world=VIEW, medium=parts.pop("medium", None))
    return d.Scene(shapes=shapes, camera=camera, film=d.Film(width=9, height=9), **parts)


def found(scene, number=1, rays=2, pixel=(4, 4)):
    worker = VertexWorker(Renderer(centred(scene), threads=1))
    vertex = worker.find(*pixel, number)
    halves = incident_sides(scene, vertex, GRID, rays, lambda of: Renderer(of, threads=1))
    return worker, vertex, halves


def compared(scene, guide, **settings):
    worker, vertex, halves = found(scene, **settings)
    return vertex, *inspect_guide.compare(guide, worker, vertex, GRID, halves)


def lobe(target, one_minus_cos=2.0, axis=(0.0, 1.0, 0.0)):
    guide = LobeGuide(axis=axis, one_minus_cos=one_minus_cos)
    guide.target = target
    return guide


LOG2 = math.log(2.0)


@pytest.mark.parametrize(
    ("target", "one_minus_cos", "expected"),
    [
        ("product", 1.0, LOG2 - 0.5),
        ("product", 2.0, 2.0 * LOG2 - 0.5),
        ("radiance-cosine", 1.0, LOG2 - 0.5),
        ("radiance", 1.0, 0.0),
        ("radiance", 2.0, LOG2),
        ("product", 0.1, math.inf),
    ],
)
def test_a_diffuse_plate_under_an_even_sky(target, one_minus_cos, expected):
    """All known: Li is 1 above and f |cos| is cos / pi, which is also the density of BSDF sampling."""
    vertex, maps, numbers = compared(plate(d.Diffuse(reflectance=1.0)), lobe(target, one_minus_cos))
    np.testing.assert_allclose(vertex.asked.position, 0.0, atol=1e-6)
    np.testing.assert_allclose(vertex.asked.wo, (0.0, np.sqrt(0.5), np.sqrt(0.5)), atol=1e-6)
    assert vertex.asked.roughness == 1.0 and not vertex.asked.transmits and vertex.traced.depth == 1
    assert GRID.integral(maps["target"]) == pytest.approx(1.0)
    np.testing.assert_allclose(maps["visible"], np.repeat([1.0, 0.0], 24)[:, None] * np.ones((1, 32)))
    np.testing.assert_allclose(maps["R"], maps["visible"], atol=1e-6)
    rounding = 5e-3  # of rows of 4 degrees
    assert numbers["kl"]["learned"] == pytest.approx(expected, abs=rounding)
    assert numbers["kl_noise"] == pytest.approx(0.0, abs=1e-6)
    assert numbers["integrals"]["bsdf"] == pytest.approx(1.0, abs=1e-3)
    assert numbers["lost"] == pytest.approx(max(one_minus_cos - 1.0, 0.0) / 2.0, abs=1e-3)
    if target != "radiance":
        assert numbers["kl"]["bsdf"] == pytest.approx(0.0, abs=rounding)
    if one_minus_cos == 1.0 and target == "product":
        # integral of 2 c log(2 c / (c + 1/2)) over the cosine c: half of the density is cos / pi, half 1 / (2 pi)
        c = (np.arange(10000) + 0.5) / 10000
        mixed = np.mean(2.0 * c * np.log(2.0 * c / (c + 0.5)))
        assert numbers["kl"]["mixture"] == pytest.approx(mixed, abs=rounding)


def test_a_tilted_plate():
    """Of albedo 1, so that cells which the plate cuts see the same radiance."""
    scene = plate(d.Diffuse(reflectance=1.0), TILTED)
    vertex = found(scene)[1]
    normal = tuple(vertex.asked.normal)
    assert abs(normal[0]) > 0.3
    _, maps, numbers = compared(scene, lobe("product", 1.0, normal))
    assert numbers["kl"]["learned"] == pytest.approx(LOG2 - 0.5, abs=0.02)
    assert numbers["kl"]["bsdf"] == pytest.approx(0.0, abs=0.02)
    mean = sum(maps["target"][..., None] * maps["solid_angle"][..., None] * GRID.directions.mean(axis=2))
    np.testing.assert_allclose(mean.sum(axis=0), 2.0 / 3.0 * np.array(normal), atol=0.01)


def test_light_from_behind_a_surface_that_transmits():
    """Even light on both sides of rough glass: Li is 1 all around. A target with the cosine is |cos| / (2 pi)."""
    scene = plate(d.RoughDielectric(alpha=0.3))
    vertex, maps, numbers = compared(scene, lobe("radiance"))
    assert vertex.asked.transmits
    assert vertex.asked.roughness == pytest.approx(math.sqrt(0.3))
    np.testing.assert_allclose(maps["visible"], 1.0)
    np.testing.assert_allclose(maps["G"], 1.0, atol=1e-6)
    assert numbers["kl"]["learned"] == pytest.approx(0.0, abs=1e-6)
    _, _, numbers = compared(scene, lobe("radiance-cosine"))
    assert numbers["kl"]["learned"] == pytest.approx(LOG2 - 0.5, abs=5e-3)


def test_a_plate_seen_from_behind():
    """Its other side counts: what is above, as for one that is seen from its front."""
    scene = plate(d.TwoSided(front=d.Diffuse(reflectance=1.0)), TURNED)
    vertex, maps, numbers = compared(scene, lobe("product", 1.0))
    np.testing.assert_allclose(vertex.asked.normal, (0.0, -1.0, 0.0), atol=1e-6)
    np.testing.assert_allclose(vertex.front, (0.0, 1.0, 0.0), atol=1e-6)
    np.testing.assert_allclose(maps["R"], np.repeat([1.0, 0.0], 24)[:, None] * np.ones((1, 32)), atol=1e-6)
    assert numbers["kl"]["learned"] == pytest.approx(LOG2 - 0.5, abs=5e-3)


@pytest.mark.parametrize("bounds", ["nothing", "in front", "behind"])
def test_light_through_a_medium(bounds):
    """A lamp 2 m above, in a medium that absorbs: exp(-sigma_a d) of its radiance. The plate may be what bounds it."""
    lamp = d.Sphere(center=(0.0, 2.0, 0.0), radius=1.0, emitter=d.Area(radiance=5.0))
    fog = d.Homogeneous(sigma_a=(0.5, 1.0, 0.0))
    view = {"shapes": [lamp], "emitters": [], "integrator": d.PathIntegrator(max_depth=2)}
    scene = plate(d.Diffuse(), medium=fog, **view)
    scene.camera.to_world = [d.TransformStep(look_at=d.LookAt(origin=(3.0, 1.0, 0.0), target=(0.0, 0.0, 0.0)))]
    if bounds == "in front":
        scene.shapes[0].exterior = fog
    if bounds == "behind":
        scene.shapes[0].interior = fog
        scene.shapes[0].bsdf, scene.shapes[0].to_world = d.TwoSided(front=d.Diffuse()), TURNED
    _, maps, _ = compared(scene, lobe("product"))
    zenith = [maps[c][0].mean() for c in "RGB"]
    # The cap of the first row is hardly any farther.
    np.testing.assert_allclose(zenith, 5.0 * np.exp([-0.5, -1.0, 0.0]), rtol=0.005)
    assert maps["R"][24:].max() == 0.0


def test_a_vertex_behind_a_mirror():
    """The path goes over a mirror, which is no vertex of a guide; what is left of its length is traced."""
    mirror = d.Rectangle(
        bsdf=d.Conductor(material="none"),
        to_world=[d.TransformStep(scale=2.0), d.TransformStep(translate=(0.0, 2.0, -1.0))],
    )
    scene = plate(d.Diffuse(), shapes=[mirror], integrator=d.PathIntegrator(max_depth=3))
    view = d.LookAt(origin=(0.0, 1.0, 1.0), target=(0.0, 0.5, -1.0))
    scene.camera.to_world = [d.TransformStep(look_at=view)]
    _, vertex, halves = found(scene)
    assert vertex.traced.depth == 2
    # In the mirror, 13 degrees above the level, the sky is two segments away, and the path has one left.
    assert halves[0][0].radiance[20, 15, 0] == 0.0
    scene.integrator.max_depth = 4
    assert found(scene)[2][0][0].radiance[20, 15, 0] == pytest.approx(1.0)
    np.testing.assert_allclose(vertex.asked.position, (0.0, 0.0, 1.0), atol=1e-5)
    scene.integrator.max_depth = 2
    with pytest.raises(WavefrontError, match=r"pixel 4,4 has no vertex 1: .*, and ends with: the longest path"):
        found(scene)
    scene.integrator.max_depth = 3
    scene.shapes = [mirror]
    with pytest.raises(WavefrontError, match=r"no vertex 1: its path has 0 .* of 1, and ends with: the ray left"):
        found(scene)
    with pytest.raises(WavefrontError, match=r"no vertex 2: its path has 1 .* of 1"):
        found(plate(d.Diffuse()), number=2)


def test_nothing_to_see_or_to_compare():
    scene = plate(d.Diffuse())
    with pytest.raises(WavefrontError, match="pixel 9,0 is not in the film; allowed: 0,0 to 8,8"):
        found(scene, pixel=(9, 0))
    scene.camera.to_world = [d.TransformStep(translate=(0.0, 1.0, 0.0))]
    with pytest.raises(WavefrontError, match="pixel 4,0 sees nothing of the scene"):
        found(scene, pixel=(4, 0))
    with pytest.raises(WavefrontError, match="no light arrives at the vertex"):
        compared(plate(d.Diffuse(), emitters=[]), lobe("product"))
    guide = ResamplingGuide(1)
    with pytest.raises(WavefrontError, match="guide resampling: it has no density"):
        compared(plate(d.Diffuse()), guide)


def test_a_target_that_is_none():
    with pytest.raises(WavefrontError, match="target 'light'; allowed: radiance, radiance-cosine, product"):
        check_guide(lobe("light"))


# --- the command -------------------------------------------------------------------------------------------------

SMALL = [
    f"--guide-set={setting}"
    for setting in (
        "mis_aware=false",
        "n_levels=2",
        "n_features=2",
        "base_resolution=4",
        "n_neurons=32",
        "n_hidden_layers=2",
        "n_lobes=4",
    )
]


@pytest.fixture
def place(monkeypatch, tmp_path):
    """A folder with a room that has a small lamp in a corner."""
    monkeypatch.chdir(tmp_path)
    lamp = d.Sphere(center=(2.0, 2.0, 0.0), radius=0.7, emitter=d.Area(radiance=9.0))
    walls = d.Cube(bsdf=d.Diffuse(), flip_normals=True, to_world=[d.TransformStep(scale=4.0)])
    scene = d.Scene(
        shapes=[walls, lamp],
        camera=d.Perspective(fov=60.0, to_world=[d.TransformStep(translate=(0.0, 0.0, 3.0))]),
        film=d.Film(width=16, height=16),
        integrator=d.PathIntegrator(max_depth=4, spp=48, nee=False),
    )
    json_format.dump(scene, tmp_path / "room.json")
    return tmp_path


def run(capsys, *arguments) -> tuple[int, str]:
    """Exit status, and what was printed to the error stream."""
    status = inspect_guide.main(["room.json", "--threads", "1", "--grid", "32x16", *map(str, arguments)])
    return status, capsys.readouterr().err


def test_training_brings_the_guide_nearer(place, capsys):
    pytest.importorskip("matplotlib")
    common = ["--pixel", "8,12", "--guide", "npm-product", *SMALL, "--rays", 16]
    assert run(capsys, *common, "--train-share", 0, "--spp", 1, "-o", "before.exr")[0] == 0
    status, said = run(capsys, *common, "--train-share", 1, "--save-guide", "room.guide", "-o", "after.exr")
    assert status == 0 and "KL of f Li |cos| from the guide" in said
    before, after = (json.loads((place / f"{name}.json").read_text()) for name in ("before", "after"))
    assert after["target"] == "product" and after["guide"]["statistics"]["training_passes"] == 48
    assert after["kl"]["learned"] < 0.6 * before["kl"]["learned"]
    assert after["kl"]["learned"] < after["kl"]["bsdf"]
    assert after["kl"]["bsdf"] == pytest.approx(before["kl"]["bsdf"])
    assert after["integrals"]["learned"] == pytest.approx(1.0, abs=1e-3)
    assert (place / "after.png").stat().st_size > 10000
    with OpenEXR.File("after.exr", separate_channels=True) as file:
        maps = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    assert sorted(maps) == sorted(["R", "G", "B", "learned", "target", "bsdf", "mixture", "visible", "solid_angle"])
    t, q = (maps[name].astype(np.float64) for name in ("target", "learned"))
    assert (t * maps["solid_angle"]).sum() == pytest.approx(1.0, abs=1e-5)
    seen = t > 0.0
    kl = (maps["solid_angle"][seen] * t[seen] * np.log(t[seen] / q[seen])).sum()
    assert kl == pytest.approx(after["kl"]["learned"], abs=1e-4)
    # From the file, nothing is rendered, and the rest is the same.
    assert run(capsys, *common, "--load-guide", "room.guide", "-o", "again.exr")[0] == 0
    again = json.loads((place / "again.json").read_text())
    assert again["samples_per_pixel"] is None and again["guide_file"] == "room.guide"
    assert again["kl"] == after["kl"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the scene names no guide; allowed: --guide NAME"),
        (["--guide", "mean", "--rays", 3], "--rays 3; allowed: even numbers from 2"),
        (["--guide", "mean", "--grid", "1x16"], "--grid 1x16; allowed: 2 to 4096 either way"),
        (["--guide", "mean", "--vertex", 0], "--vertex 0; allowed: 1 or more"),
        (["--guide", "mean", "--spp", 0], "--spp 0; allowed: 1 or more"),
        (["--guide", "mean", "--exposure", "nan"], "--exposure nan; allowed: finite numbers"),
        (["--guide", "mean", "--pixel", "99,0"], "pixel 99,0 is not in the film"),
        (["--guide", "mean", "--load-guide", "a", "--spp", 4], "--spp with --load-guide, which is used as it is"),
        (["--guide", "mean", "--load-guide", "a"], "a: there is no such guide file to load"),
        (["--guide", "mean", "-o", "out.png"], "out.png: the output is an OpenEXR file"),
        (["--guide", "mean", "-o", "room.exr"], "room.json: would be overwritten"),
        (["--load-guide", "a"], "--load-guide is for a guide, and there is none"),
    ],
)
def test_errors_are_one_line(place, capsys, monkeypatch, arguments, message):
    pytest.importorskip("matplotlib")
    presets = place / "presets"
    presets.mkdir()
    use_mean_preset(monkeypatch, presets)
    status, said = run(capsys, *([] if "--pixel" in arguments else ["--pixel", "8,8"]), *arguments)
    errors = [line for line in said.splitlines() if line.startswith("error: ")]
    assert status == 2 and len(errors) == 1 and message in errors[0]
    assert "Traceback" not in said and sorted(p.name for p in place.iterdir()) == ["presets", "room.json"]


def test_npm_says_what_it_learns():
    from guiding.npm import NpmGuide, NpmSettings

    def target(**settings):
        return NpmGuide(NpmSettings(**settings)).target

    assert target(product=True) == target(product=True, cosine_aware=False) == "product"
    assert target(product=False) == "radiance-cosine"
    assert target(product=False, cosine_aware=False) == "radiance"
