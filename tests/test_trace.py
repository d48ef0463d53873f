"""A path traced alone is the path of the render, and what is said of it adds up; strict renders name the right one."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import msgspec
import numpy as np
import pytest

from wavefront import Renderer, WavefrontError, load_scene
from wavefront.film import LUMINANCE
from wavefront.render import main
from wavefront.scene import description as d
from wavefront.strict import NonFiniteError, first_pixel

SCENES = Path(__file__).parent.parent / "scenes"
NAMES = [
    "cornell-box",
    "glossy-plates",
    "glass-caustic",
    "material-mask",
    "material-diffuse-bitmap",
    "cornell-box, sobol",
]
WIDTH, HEIGHT = 48, 37
ENDS = {
    "the ray left the scene",
    "Russian roulette",
    "absorbed: a BSDF sample of no weight",
    "the longest path, max_depth 5",
}


def load(name, *overrides):
    name, _, sampler = name.partition(", ")
    size = [f"film.width={WIDTH}", f"film.height={HEIGHT}", "integrator.max_depth=5", "integrator.rr_depth=2"]
    sampler = f"integrator.sampler={sampler or 'independent'}"
    return load_scene(SCENES / f"{name}.json", [*size, sampler, *overrides])


def film_of(r, sample) -> np.ndarray:
    """Radiance of one sample of every pixel, as the film gets it, shape [HEIGHT, WIDTH, 3]."""
    r.film.arrays.L.zero_()
    r.film.sample_count = sample
    r.render(1)
    return r.film.arrays.L.numpy().reshape(HEIGHT, WIDTH, 3).copy()


@pytest.fixture(scope="module", params=NAMES)
def traces(request):
    """A renderer, and traces of random pixels with the radiance that the film has there."""
    r = Renderer(load(request.param), seed=2**40 + 3, threads=1)
    generator = np.random.default_rng(4)
    result = []
    for sample in (0, 5):
        film = film_of(r, sample)
        for y, x in zip(generator.integers(0, HEIGHT, 40), generator.integers(0, WIDTH, 40), strict=True):
            result.append((r.trace(int(x), int(y), sample), film[y, x]))
    np.testing.assert_array_equal(r.film.arrays.L.numpy().reshape(HEIGHT, WIDTH, 3), film, err_msg="film was touched")
    return r, result


def test_the_radiance_is_that_of_the_film(traces):
    """Bit for bit."""
    for trace, expected in traces[1]:
        assert expected.tolist() == trace.L, trace.pixel
    assert any(any(trace.L) for trace, _ in traces[1])


def test_contributions_add_up(traces):
    """To the radiance, up to the rounding of a float32 sum of a dozen terms."""
    for trace, _ in traces[1]:
        parts = [v.emission for v in trace.vertices if v.emission]
        parts += [v.light["contribution"] for v in trace.vertices if v.light and v.light.get("visible")]
        np.testing.assert_allclose(np.sum(parts, axis=0) if parts else np.zeros(3), trace.L, rtol=12 * 2.0**-24)


def test_vertices_follow_each_other(traces):
    """Throughput times weight over survival is the next throughput; directions and densities are handed on."""
    r, result = traces
    for trace, _ in result:
        assert [v.depth for v in trace.vertices] == list(range(1, len(trace.vertices) + 1))
        assert not trace.left_out
        first = trace.vertices[0]
        assert first.beta == [1.0, 1.0, 1.0] and first.pdf == 0.0
        for v, following in zip(trace.vertices, trace.vertices[1:], strict=False):
            beta = np.multiply(v.beta, v.scatter["weight"])
            if v.roulette:
                assert v.roulette["survived"]
                beta /= v.roulette["probability"]
            np.testing.assert_allclose(following.beta, beta, rtol=1e-6)
            np.testing.assert_allclose(following.direction, v.scatter["wi"], atol=1e-6)
            assert following.pdf == v.scatter["pdf"]
            np.testing.assert_allclose(following.origin, v.position, atol=1e-3)
        for v in trace.vertices:
            assert np.linalg.norm(v.direction) == pytest.approx(1.0, abs=1e-5)
            if v.position is not None:
                t = np.subtract(v.position, v.origin)
                np.testing.assert_allclose(t / np.linalg.norm(t), v.direction, atol=1e-4)
                assert (v.uv is not None) == r.features.uvs


def test_the_end_is_said(traces):
    """By the last vertex, and by what roulette and escape leave behind."""
    for trace, _ in traces[1]:
        last = trace.vertices[-1]
        assert trace.end in ENDS
        assert (trace.end == "the ray left the scene") == (last.position is None)
        assert (trace.end == "Russian roulette") == bool(last.roulette and not last.roulette["survived"])
        assert (last.depth == 5) == trace.end.startswith("the longest path") or last.position is None


def test_every_end_occurs():
    ends = set()
    # From behind, the walls of the box absorb.
    behind = 'camera.to_world=[{"rotate": {"axis": [0, 1, 0], "angle": 180}}, {"translate": [0, 1, -5]}]'
    for overrides in ((), (behind,)):
        r = Renderer(load("cornell-box", *overrides), threads=1)
        for k in range(60):
            ends.add(r.trace(k % WIDTH, (7 * k) % HEIGHT).end)
    assert ends == ENDS, ENDS - ends


def test_light_samples_are_those_of_the_direct_stage(traces):
    """The density is that of the light, and the contribution is BSDF times radiance over density, no larger than a
    diffuse albedo of one allows, which MIS weights keep."""
    diffuse = 0
    for trace, _ in traces[1]:
        for v in trace.vertices:
            if not v.light or "contribution" not in v.light:
                continue
            assert v.light["pdf"] > 0.0 and any(v.light["L"])
            if v.bsdf.endswith("(diffuse)"):
                cos = abs(np.dot(v.light["wi"], v.shading_normal))
                bound = np.multiply(v.beta, v.light["L"]) * cos / np.pi / v.light["pdf"]
                assert (np.array(v.light["contribution"]) <= bound * (1.0 + 1e-4)).all()
                diffuse += 1
    assert diffuse > 10


def test_names_of_shapes_and_bsdfs():
    """At pixels that look at known shapes, of which the sphere comes last on the device."""
    step = d.TransformStep
    shapes = [
        d.Sphere(name="ball", center=(0.0, 0.0, 0.0), radius=0.3, bsdf="glass"),
        d.Rectangle(name="left", to_world=[step(scale=0.3), step(translate=(-1.0, 0.0, 0.0))]),
        d.Rectangle(
            name="right",
            bsdf=d.TwoSided(front=d.Conductor(material="Au")),
            emitter=d.Area(radiance=2.0),
            to_world=[step(scale=0.3), step(translate=(1.0, 0.0, 0.0))],
        ),
    ]
    camera = d.Perspective(fov=2 * np.degrees(np.arctan(1.5 / 4.0)), fov_axis="x", to_world=[step(translate=(0, 0, 4))])
    scene = d.Scene(
        bsdfs=[d.Dielectric(name="glass")],
        shapes=shapes,
        camera=camera,
        film=d.Film(width=300, height=100),
        emitters=[],
    )
    r = Renderer(scene, threads=1)
    found = [r.trace(x, 50, 1).vertices[0] for x in (50, 150, 250)]
    assert [v.shape for v in found] == [
        'shapes[1] "left" (rectangle)',
        'shapes[0] "ball" (sphere)',
        ('shapes[2] "right" (rectangle)'),
    ]
    assert [v.bsdf for v in found] == ["diffuse", '"glass" (dielectric)', "twosided, conductor"]
    assert [v.emission for v in found] == [None, None, [2.0, 2.0, 2.0]]
    assert found[0].light["light"].endswith('triangle of shapes[2] "right" (rectangle)')
    assert found[1].light is None, "a mirror-like surface draws no light sample"
    assert found[0].position[2] == pytest.approx(0.0, abs=1e-6)
    assert found[0].shading_normal == [0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("pixel", "message"),
    [((WIDTH, 0, 0), "not in the film"), ((0, -1, 0), "not in the film"), ((0, 0, 2**31 - 1), "sample"),
     ((0, 0, -1), "sample")],
)  # fmt: skip
def test_pixels_that_are_not_there(pixel, message):
    with pytest.raises(WavefrontError, match=message):
        Renderer(load("cornell-box"), threads=1).trace(*pixel)


# --- strict ------------------------------------------------------------------------------------------------------


def near_lamp():
    """A point light so strong and so near the floor that what arrives overflows right below it, in a few pixels."""
    floor = d.Rectangle(to_world=[d.TransformStep(scale=2.0)])
    lamp = d.Point(position=(0.3, -0.2, 0.05), intensity=2e36)
    camera = d.Perspective(fov=40, to_world=[d.TransformStep(translate=(0, 0, 4))])
    film = d.Film(width=WIDTH, height=HEIGHT)
    return d.Scene(shapes=[floor], camera=camera, film=film, emitters=[lamp], integrator=d.PathIntegrator(max_depth=2))


def bright_sky():
    """Roulette lifts the throughput above one, so that the sky overflows after a reflection."""
    floor = d.Rectangle(bsdf=d.Diffuse(reflectance=0.99), to_world=[d.TransformStep(scale=0.5)])
    camera = d.Perspective(fov=40, to_world=[d.TransformStep(translate=(0, 0, 4))])
    film, integrator = d.Film(width=WIDTH, height=HEIGHT), d.PathIntegrator(max_depth=3, rr_depth=1, nee=False)
    sky = d.Constant(radiance=3.35e38)
    return d.Scene(shapes=[floor], camera=camera, film=film, emitters=[sky], integrator=integrator)


def bright_room():
    """Two finite contributions whose sum is not."""
    room = d.Sphere(flip_normals=True, bsdf=d.Diffuse(reflectance=1.0), emitter=d.Area(radiance=3e38))
    film, integrator = d.Film(width=WIDTH, height=HEIGHT), d.PathIntegrator(max_depth=2, nee=False)
    return d.Scene(shapes=[room], film=film, integrator=integrator)


def first_by_trial(r, samples=8) -> tuple[int, int, int]:
    """(sample, y, x) of the first path with something left out: every path alone."""
    for sample in range(samples):
        for y in range(HEIGHT):
            for x in range(WIDTH):
                if r.trace(x, y, sample).left_out:
                    return sample, y, x
    raise AssertionError("nothing is left out")


@pytest.mark.parametrize(
    ("make", "stage"), [(near_lamp, "direct"), (bright_sky, "escaped"), (bright_room, "accumulate")]
)
def test_strict_names_the_first_path(make, stage):
    scene = make()
    lenient = Renderer(scene, seed=9, threads=1)
    sample, y, x = first_by_trial(lenient)
    trace = lenient.trace(x, y, sample)
    assert trace.left_out[0] == stage
    assert np.isfinite(trace.L).all()
    assert len(lenient.trace(x, y, sample).left_out) == len(trace.left_out), "found again and again"
    lenient.render(8)
    assert lenient.statistics.nonfinite[stage] > 0
    # Whatever the workers and the passes.
    for arguments in ({"threads": 1}, {"threads": 2, "memory": 1 << 20}):
        r = Renderer(scene, seed=9, strict=True, **arguments)
        with pytest.raises(NonFiniteError) as caught:
            r.render(8)
        e = caught.value
        assert (e.stage, e.sample, e.y, e.x, e.seed) == (stage, sample, y, x, 9)
    with pytest.raises(WavefrontError, match="were left out; allowed: none in a strict render"):
        resume_strictly(lenient, scene)


def resume_strictly(lenient, scene):
    with tempfile.TemporaryDirectory() as folder:
        lenient.save_checkpoint(f"{folder}/c")
        Renderer(scene, seed=9, threads=1, strict=True).load_checkpoint(f"{folder}/c")


def test_the_search_finds_the_first_pixel():
    generator = np.random.default_rng(2)
    for _ in range(500):
        height, width, capacity = generator.integers(1, 14, 3)
        bad = generator.random((height, width)) < generator.choice([0.0, 0.02, 0.2, 1.0])

        def found(x, y, w, h, bad=bad, capacity=capacity):
            assert 0 < w * h <= capacity and x + w <= bad.shape[1] and y + h <= bad.shape[0]
            return bad[y : y + h, x : x + w].any()

        places = np.argwhere(bad)
        expected = (places[0][1], places[0][0]) if len(places) else None
        assert first_pixel(found, width, height, capacity) == expected


def test_a_search_in_narrow_tiles(monkeypatch):
    """Rows that do not fit the worker which searches."""
    scene = near_lamp()
    expected = first_by_trial(Renderer(scene, seed=9, threads=1))
    monkeypatch.setattr("wavefront.strict.SEARCH_CAPACITY", 7)
    with pytest.raises(NonFiniteError) as caught:
        Renderer(scene, seed=9, threads=1, strict=True).render(8)
    assert (caught.value.sample, caught.value.y, caught.value.x) == expected


def test_strict_changes_nothing_where_all_is_well():
    a, b = (Renderer(load("cornell-box"), seed=1, threads=1, strict=strict) for strict in (False, True))
    np.testing.assert_array_equal(a.render(4), b.render(4))
    assert a.kernels == b.kernels and a.bytes_per_path == b.bytes_per_path


# --- the command -------------------------------------------------------------------------------------------------


def run(capsys, *arguments) -> tuple[int, str, str]:
    try:
        status = main([str(a) for a in arguments])
    except SystemExit as exit_:
        status = exit_.code
    captured = capsys.readouterr()
    return status, captured.out, captured.err


@pytest.fixture
def scene_file(tmp_path):
    """A scene whose first paths overflow only in a few pixels."""
    path = tmp_path / "scene.json"
    path.write_bytes(msgspec.json.encode(near_lamp()))
    return path


def test_the_command_that_strict_gives_shows_the_path(scene_file, tmp_path, capsys):
    out = tmp_path / "out.exr"
    command = (scene_file, "-o", out, "--spp", 8, "--seed", 9, "--quiet", "--threads", 1)
    status, _, error = run(capsys, *command, "--strict")
    assert status == 2
    assert error.startswith("error: the direct stage made a contribution that is not finite or negative at pixel ")
    assert error.endswith("; no image was written\n") and error.count("\n") == 1
    assert not out.exists()
    added = error.split("add ")[1].split(";")[0].split()
    status, text, _ = run(capsys, *command, *added)
    assert status == 0
    assert f"pixel {added[1]}, sample {added[3]}, seed 9" in text
    assert "left out" in text and "a contribution of the direct stage that is not" in text
    assert not out.exists()


def test_strict_keeps_the_checkpoint_before(scene_file, tmp_path, capsys, monkeypatch):
    """The samples of the pass that failed are not in it, and a render that is not strict goes on from it."""
    out, file = tmp_path / "out.exr", tmp_path / "c"
    command = (scene_file, "-o", out, "--seed", 9, "--quiet", "--set", "emitters[0].position=[0.3,-0.2,3]")
    assert run(capsys, *command, "--spp", 4, "--checkpoint", file, "--strict")[0] == 0

    def fail(renderer, first, count):
        return NonFiniteError("direct", 1, 2, first, 9)

    monkeypatch.setattr("wavefront.renderer.find_nonfinite", fail)
    monkeypatch.setattr("wavefront.integrator.Worker.nonfinite", lambda self: {"direct": int(self.renders_badly())})
    monkeypatch.setattr(
        "wavefront.integrator.Worker.renders_badly", lambda self: self.tile.numpy()[4] > 4, raising=False
    )
    before = file.read_bytes()
    options = ("--spp", 40, "--checkpoint", file, "--resume", file, "--strict")
    status, _, error = run(capsys, *command, *options)
    assert status == 2
    assert error.endswith(f"; no image was written; {file} holds the 4 samples before\n")
    assert file.read_bytes() == before


def test_radiance_and_json(tmp_path, capsys):
    command = (SCENES / "cornell-box.json", "--size", "48x37", "--pixel", "20,18", "--sample", 3, "--quiet")
    status, text, _ = run(capsys, *command)
    assert status == 0
    status, data, _ = run(capsys, *command, "--json")
    found = json.loads(data)
    assert status == 0 and found["pixel"] == [20, 18] and found["sample"] == 3
    assert np.float32(text.split()).tolist() == np.float32(found["L"]).tolist()
    assert (np.array(found["L"]) @ LUMINANCE) > 0.0
    assert found["vertices"][0]["shape"].startswith("shapes[")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--trace"], "error: --trace is for --pixel, which is missing\n"),
        (["--sample", "0"], "error: --sample is for --pixel, which is missing\n"),
        (["--json"], "error: --json is for --pixel, which is missing\n"),
        (["--pixel", "48,0"], "error: pixel 48,0 is not in the film; allowed: 0,0 to 47,36\n"),
        (["--pixel", "0,0", "--sample", "-1"], "error: sample -1; allowed: 0 to 2^31 - 2\n"),
        (["--pixel", "1"], "'1' is not a pixel; allowed: X,Y, such as 12,7\n"),
    ],
)
def test_bad_arguments_are_one_line(capsys, arguments, message):
    status, _, error = run(capsys, SCENES / "cornell-box.json", "--size", "48x37", "--quiet", *arguments)
    assert status == 2 and error.endswith(message)
