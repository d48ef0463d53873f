"""Images against Blender's Cycles, as `tests.test_mitsuba_images` against Mitsuba: tests of tiles, and closed forms.

All are slow, and are skipped where Cycles is not installed (`python -m tools.peers.cycles --install`).
"""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tools import methods
from tools.image_test import RATIO_TOLERANCE, compare
from tools.methods import load_job
from tools.peers import cycles
from tools.peers.images import cycles_batches, like_the_peer, our_batches
from wavefront.errors import WavefrontError
from wavefront.renderer import Renderer
from wavefront.scene import description as d
from wavefront.scene import load_scene
from wavefront.scene.images import write_exr

SCENES = Path(__file__).parent.parent / "scenes"
TILES = (4, 4)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(cycles.missing() is not None, reason=str(cycles.missing())),
]


def check(name: str, scene: d.Scene, spp: int = 32, guided: bool = False, tolerance=RATIO_TOLERANCE, **settings):
    """Renders a scene with both renderers until they are known to be the same, or not."""
    session = cycles.Session(scene, guided, threads=2)
    try:
        seed = zlib.crc32(name.encode()) >> 1
        comparison = compare(our_batches(scene, spp, name), cycles_batches(session, spp, seed), TILES, **settings)
    finally:
        session.close()
    print(f"{name}: {comparison}")  # shown with -s, or when the test fails
    comparison.check(tolerance)


# --- closed forms ------------------------------------------------------------------------------------------------


def furnace(albedo: float, **integrator) -> d.Scene:
    """Inside of a sphere that emits 1 and reflects `albedo`."""
    inside = d.Sphere(radius=2.0, flip_normals=True, bsdf=d.Diffuse(reflectance=albedo), emitter=d.Area(radiance=1.0))
    return d.Scene(
        shapes=[inside],
        film=d.Film(width=16, height=16),
        integrator=d.PathIntegrator(rr_depth=None, **integrator),
    )


def mean(scene: d.Scene, spp: int, guided: bool = False) -> np.ndarray:
    session = cycles.Session(scene, guided, threads=2)
    try:
        return session.render(spp, seed=1).mean(axis=(0, 1))
    finally:
        session.close()


@pytest.mark.parametrize("nee", [True, False])
@pytest.mark.parametrize("max_depth", [2, 3, 5])
def test_length_of_paths(max_depth, nee):
    """Emission that is seen after n reflections has n + 1 segments: 1 + a + … + a^(max_depth - 1). Without next-event
    estimation every path has exactly this value; with it, the mean is of 262144 paths."""
    expected = sum(0.5**n for n in range(max_depth))
    np.testing.assert_allclose(mean(furnace(0.5, max_depth=max_depth, nee=nee), 1024), expected, rtol=2e-3)


def test_guiding_changes_no_length():
    np.testing.assert_allclose(mean(furnace(0.5, max_depth=4), 1024, guided=True), 1.875, rtol=5e-3)


def test_emission_is_of_one_side():
    scene = furnace(0.5, max_depth=3)
    scene.shapes[0].flip_normals = False
    assert mean(scene, 4).max() == 0.0
    scene.shapes[0].emitter.two_sided = True
    np.testing.assert_allclose(mean(scene, 16), 1.0, rtol=1e-5)


@pytest.mark.parametrize(
    ("emitter", "expected"),
    [
        (d.Point(position=(0.0, 0.0, 2.0), intensity=[8.0, 4.0, 0.0]), [2.0, 1.0, 0.0]),  # I / r^2
        (d.Directional(direction=(0.0, 0.0, -1.0), irradiance=3.0), [3.0] * 3),
        (d.Directional(direction=(0.0, 3.0**0.5, -1.0), irradiance=3.0), [1.5] * 3),
        (d.Spot(position=(0.0, 0.0, 2.0), direction=(0.0, 0.0, -1.0), intensity=8.0), [2.0] * 3),
        (d.Constant(radiance=[1.0, 0.5, 0.25]), [np.pi, 0.5 * np.pi, 0.25 * np.pi]),
    ],
    ids=["point", "directional", "directional 60 degrees", "spot", "constant"],
)
def test_irradiance(emitter, expected):
    """A diffuse square under one light: radiance is albedo E / pi. The camera sees its middle, a thousandth wide."""
    scene = d.Scene(
        shapes=[d.Rectangle(bsdf=d.Diffuse(reflectance=0.5))],
        emitters=[emitter],
        camera=d.Perspective(fov=0.05, to_world=[d.TransformStep(translate=(0.0, 0.0, 1.0))]),
        film=d.Film(width=8, height=8),
        integrator=d.PathIntegrator(max_depth=2, rr_depth=None),
    )
    np.testing.assert_allclose(mean(scene, 1024), 0.5 / np.pi * np.array(expected), rtol=2e-3)


def microfacet_albedo(alpha: float, cosine: float, correlated: bool) -> float:
    """Of a GGX surface that reflects all light, by quadrature over microfacet normals: masking and shadowing that are
    correlated by height (Heitz 2014, equation 99) or separable (equation 98)."""
    n = 1000
    theta, phi = np.meshgrid((np.arange(n) + 0.5) / n * np.pi / 2, (np.arange(n) + 0.5) / n * 2 * np.pi, indexing="ij")
    m = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    wo = np.array([np.sqrt(1.0 - cosine**2), 0.0, cosine])
    wi_z = 2.0 * (m @ wo) * m[..., 2] - cosine
    density = alpha**2 / (np.pi * (m[..., 2] ** 2 * (alpha**2 - 1.0) + 1.0) ** 2)
    o, i = (0.5 * np.sqrt(1.0 + alpha**2 * (1.0 / np.maximum(c, 1e-9) ** 2 - 1.0)) - 0.5 for c in (cosine, wi_z))
    g = 1.0 / (1.0 + o + i) if correlated else 1.0 / ((1.0 + o) * (1.0 + i))
    seen = (m @ wo > 0.0) & (wi_z > 0.0)
    return float((seen * density * g * (m @ wo) / cosine * np.sin(theta)).sum() * np.pi**2 / n**2)


@pytest.mark.parametrize(("alpha", "degrees"), [(0.15, 60.0), (0.5, 60.0), (0.5, 80.0)])
def test_masking_of_microfacets(alpha, degrees):
    """What is not the same: Cycles' rough surfaces are the brighter ones, by 0.04, 1.8 and 7.8 % here."""
    angle = np.radians(degrees)
    origin = (4.0 * float(np.sin(angle)), 0.0, 4.0 * float(np.cos(angle)))
    scene = d.Scene(
        shapes=[d.Rectangle(bsdf=d.RoughConductor(material="none", alpha=alpha))],
        emitters=[d.Constant(radiance=1.0)],
        camera=d.Orthographic(
            width=0.1, to_world=[d.TransformStep(look_at=d.LookAt(origin=origin, target=(0.0, 0.0, 0.0)))]
        ),
        film=d.Film(width=16, height=16),
        integrator=d.PathIntegrator(max_depth=2, rr_depth=None),
    )
    cosine = float(np.cos(angle))
    np.testing.assert_allclose(mean(scene, 1024), microfacet_albedo(alpha, cosine, True), rtol=2e-3)
    ours = Renderer(scene, seed=1).render(spp=1024).mean(axis=(0, 1))
    np.testing.assert_allclose(ours, microfacet_albedo(alpha, cosine, False), rtol=4e-3)


# --- the scenes of this repository -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("furnace", 0.001),
        ("light-envmap", 0.001),
        ("light-spot", 0.001),
        ("camera-thin-lens", 0.001),
        ("camera-orthographic", 0.001),
        ("material-rough-conductor-anisotropic", 0.0015),
        ("material-rough-conductor-beckmann", 0.0015),
        ("material-dielectric", 0.0015),
        ("material-diffuse-bitmap", 0.0015),
        ("material-twosided", 0.0015),
    ],
)
def test_scenes(name, error):
    scene = load_scene(SCENES / f"{name}.json")
    check(name, like_the_peer(scene, 32, 32, min(scene.integrator.max_depth, 6)), error=error)


@pytest.mark.parametrize("guided", [False, True])
def test_cornell_box(guided):
    """Guiding changes no mean; every batch learns anew. The edge of the lamp is most of our noise."""
    scene = like_the_peer(load_scene(SCENES / "cornell-box.json"), 32, 32, 6)
    check(f"cornell-box {guided}", scene, spp=192, guided=guided, tolerance=0.01, error=0.002, most=64)


def test_rough_glass():
    """Masking of microfacets differs, see below: at this roughness by less than a percent."""
    scene = like_the_peer(load_scene(SCENES / "material-rough-dielectric.json"), 32, 32, 6)
    check("rough glass", scene, tolerance=0.01, rounding=0.01, error=0.002)


def test_without_next_event_estimation():
    scene = load_scene(SCENES / "furnace.json")
    check("furnace without NEE", like_the_peer(scene, 32, 32, 5, nee=False))


# --- what they do not show ---------------------------------------------------------------------------------------


def stage(*shapes: d.Shape, **fields) -> d.Scene:
    """Shapes on a floor below a constant environment and a lamp."""
    lamp = d.Rectangle(
        emitter=d.Area(radiance=[6.0, 5.0, 4.0]),
        to_world=[
            d.TransformStep(rotate=d.Rotate(axis=(1.0, 0.0, 0.0), angle=90.0)),
            d.TransformStep(translate=(0.5, 4.0, 1.0)),
        ],
    )
    floor = d.Rectangle(
        bsdf=d.Diffuse(reflectance=[0.5, 0.4, 0.3]),
        to_world=[
            d.TransformStep(scale=4.0),
            d.TransformStep(rotate=d.Rotate(axis=(1.0, 0.0, 0.0), angle=-90.0)),
        ],
    )
    return d.Scene(
        shapes=[floor, lamp, *shapes],
        emitters=[d.Constant(radiance=[0.4, 0.5, 0.6])],
        camera=d.Perspective(
            fov=30.0,
            principal_point_offset=(0.1, -0.05),
            to_world=[d.TransformStep(look_at=d.LookAt(origin=(0.0, 2.4, 6.0), target=(0.0, 0.75, 0.0)))],
        ),
        film=d.Film(width=32, height=24, pixel_aspect=0.8),
        integrator=d.PathIntegrator(max_depth=6, rr_depth=3),
        **fields,
    )


def ball(bsdf: d.Bsdf) -> d.Sphere:
    return d.Sphere(center=(0.0, 1.0, 0.0), radius=0.9, bsdf=bsdf)


@pytest.mark.parametrize(
    "bsdf",
    [
        d.Principled(base_color=[0.9, 0.5, 0.2], metallic=1.0, roughness=0.4),
        d.Principled(base_color=[0.9, 0.5, 0.2], spec_trans=1.0, roughness=0.3, eta=1.4),
        d.Dielectric(specular_reflectance=[0.9, 0.5, 0.2], specular_transmittance=[0.3, 0.6, 0.9]),
        d.RoughConductor(material="Au", alpha=0.3, specular_reflectance=[0.9, 0.5, 0.2]),
        d.RoughConductor(material="none", alpha=0.2, specular_reflectance=0.6),
        d.RoughConductor(eta=[0.2, 0.9, 1.1], k=[3.9, 2.4, 2.2], alpha=d.Checkerboard(color0=0.1, color1=0.5)),
        d.Blend(first=d.Diffuse(reflectance=[0.1, 0.6, 0.3]), second=d.Conductor(material="Cu"), weight=0.3),
    ],
    ids=["metal", "coloured glass", "tinted glass", "tinted metal", "mirror", "textured alpha", "blend"],
)
def test_materials(bsdf, request):
    check(request.node.name, stage(ball(bsdf)), error=0.0015)


def test_instances_with_shear_and_mirror():
    """Of a smooth mesh that is red in front and green behind, with a texture of a turned and scaled UV."""
    squeeze = [(0.5, 0.3, 0.0, -0.8), (0.0, 0.6, 0.0, 0.7), (0.0, 0.0, 0.5, 0.0), (0.0, 0.0, 0.0, 1.0)]
    mirror = [(-0.6, 0.0, 0.2, 0.8), (0.0, 0.6, 0.0, 0.7), (0.0, 0.0, 0.6, 0.0), (0.0, 0.0, 0.0, 1.0)]
    texture = d.Checkerboard(color0=[0.7, 0.2, 0.1], color1=0.4, uv_transform=((4.0, 1.0, 0.1), (0.5, 5.0, 0.0)))
    sides = d.TwoSided(front=d.Diffuse(reflectance=texture), back=d.Diffuse(reflectance=[0.1, 0.6, 0.1]))
    vase = d.Mesh(
        file=str(SCENES / "meshes" / "vase.ply"), bsdf=sides, to_world=[d.TransformStep(scale=6.0)], smooth_normals=True
    )
    groups = [d.Group(name="things", shapes=[vase, d.Sphere(center=(0.0, -0.4, 0.9), radius=0.4, bsdf=sides)])]
    instances = [d.Instance(group="things", to_world=matrix) for matrix in (squeeze, mirror)]
    check("instances", stage(groups=groups, instances=instances), error=0.0015)


def test_bitmaps(tmp_path):
    """Of 8 bits, nearest, mirrored and clamped; and emission from an OpenEXR image, from both sides."""
    rng = np.random.default_rng(1)
    Image.fromarray(rng.integers(0, 256, (3, 5, 3), np.uint8)).save(tmp_path / "a.png")
    write_exr(tmp_path / "b.exr", dict(zip("RGB", rng.random((3, 4, 6), np.float32), strict=True)))
    uv = ((1.7, 0.4, 0.2), (-0.3, 2.1, 0.6))
    mirrored = d.Bitmap(file=str(tmp_path / "a.png"), filter="nearest", wrap="mirror", uv_transform=uv)
    clamped = d.Bitmap(file=str(tmp_path / "a.png"), wrap="clamp", uv_transform=uv, scale=0.8)
    light = d.Area(radiance=d.Bitmap(file=str(tmp_path / "b.exr"), scale=2.0), two_sided=True)
    panels = [
        d.Rectangle(
            bsdf=bsdf,
            emitter=emitter,
            to_world=[d.TransformStep(scale=0.6), d.TransformStep(translate=(x, 0.8, 0.0))],
        )
        for x, bsdf, emitter in (
            (-1.2, d.Diffuse(reflectance=mirrored), None),
            (0.0, d.Diffuse(reflectance=clamped), None),
            (1.2, d.Diffuse(reflectance=0.2), light),
        )
    ]
    check("bitmaps", stage(*panels), error=0.0015)


# --- samples -----------------------------------------------------------------------------------------------------


def cornell(**film) -> methods.Job:
    overrides = [f"film.{name}={value}" for name, value in {"width": 16, "height": 12, **film}.items()]
    return load_job(SCENES / "cornell-box.json", [*overrides, "film.filter.type=box"], None, 2)


def test_parts_of_a_sequence_are_its_samples():
    session = cycles.Session(cornell().scene, False, 2)
    try:
        whole, parts, start = session.render(16, 5), 0.0, 0
        for count in (1, 3, 12):
            parts = parts + count * session.render(count, 5, start)
            start += count
        np.testing.assert_allclose(parts / 16.0, whole, rtol=1e-4, atol=1e-6)
        assert np.array_equal(session.render(16, 5), whole)
        assert not np.array_equal(session.render(16, 6), whole)
        with pytest.raises(WavefrontError, match="allowed: up to"):
            session.render(1, 5, cycles.MAX_SAMPLES)
    finally:
        session.close()


def test_first_samples_are_spread_over_the_pixel():
    """An edge crosses a column of pixels at a quarter of their width. A first sample in the middle of each pixel, which
    Cycles makes of its sample 0, would find one side in all of them; of 64, fewer than 4 or more than 28 do so with a
    probability below 1e-3."""
    light = d.Rectangle(emitter=d.Area(), to_world=[d.TransformStep(translate=(0.875, 0.0, 0.0))])
    scene = d.Scene(
        shapes=[light],
        camera=d.Orthographic(width=2.0, to_world=[d.TransformStep(translate=(0.0, 0.0, 1.0))]),
        film=d.Film(width=4, height=4),
        integrator=d.PathIntegrator(max_depth=2),
    )
    session = cycles.Session(scene, False, 1)
    try:
        found = sum(session.render(1, seed)[1, 1, 0] for seed in range(64))
    finally:
        session.close()
    assert 4 <= found <= 28
    assert found == int(found)


@pytest.mark.parametrize("name", ["cycles", "cycles guided"])
def test_engine(name):
    """Samples are counted, means are right, and a run with a budget in samples gives the same image again."""
    job = cornell()
    engines = [methods.RENDERERS[name](job, 7) for _ in range(2)]
    for engine in engines:
        engine.add(3)
        engine.add(29)
        assert (engine.samples, engine.account()) == (32, {"calls": 2})
    assert np.array_equal(engines[0].image(), engines[1].image())
    first = engines[0].image()
    engines[0].add(1 << 20, 0.5)
    assert 32 < engines[0].samples < 1 << 20
    assert np.abs(engines[0].image().mean() / first.mean() - 1.0) < 0.2


def test_a_process_that_ends_is_an_error():
    session = cycles.Session(cornell().scene, False, 1)
    session.process.kill()
    with pytest.raises(WavefrontError, match="Blender ended with status"):
        session.render(1, 1)
    session.close()
    assert not session.folder.exists()
