"""The meshes, rays and figures of `tools.bench_accel`."""

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from tools.accel_engines import Answer, Ours, Rays, WarpMesh, missing
from tools.accel_rays import RayMaker, blob, from_scene, generated, soup
from tools.bench_accel import differences, main, print_report

SCENES = Path(__file__).parent.parent / "scenes"
CORNELL_BOX = str(SCENES / "cornell-box.json")
OURS = ["--engines", "stream,portable,wp.Mesh"]


def areas(points, faces):
    corners = points.astype(np.float64)[faces]
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


@pytest.mark.parametrize("count", [100, 1000, 54321])
def test_blob_is_closed(count):
    """Every edge has a triangle on either side of it, with Euler's characteristic of a sphere, facing outwards."""
    points, faces = blob(count)
    assert 0.9 * count < len(faces) < 1.1 * count and faces.dtype == np.int32
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    forth = np.sort(edges @ [len(points), 1])
    assert len(np.unique(forth)) == len(forth)  # each in one direction once
    assert np.array_equal(forth, np.sort(edges @ [1, len(points)]))  # and in the other
    assert len(points) - len(edges) // 2 + len(faces) == 2 and len(np.unique(faces)) == len(points)
    corners = points.astype(np.float64)[faces]
    volume = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
    assert volume == pytest.approx(4.0 / 3.0 * math.pi, rel=0.25)
    assert areas(points, faces).min() > 0.0
    if count > 10_000:
        low, high = np.quantile(areas(points, faces), [0.01, 0.99])
        assert high > 30.0 * low


def test_soup():
    points, faces = soup(5000)
    assert points.shape == (15000, 3) and np.array_equal(faces.ravel(), np.arange(15000))
    low, high = np.quantile(areas(points, faces), [0.05, 0.95])
    assert high > 100.0 * low


def test_scene_with_instances():
    """Triangles of instances are copies of those of their groups; spheres are left out and counted."""
    case = from_scene(SCENES / "instances.json")
    assert case.faces.min() == 0 and case.faces.max() == len(case.points) - 1
    assert "spheres are left out" in case.notes[0]
    lights = from_scene(Path(CORNELL_BOX)).lights
    assert len(lights) == 2


@pytest.fixture(scope="module")
def blob_rays():
    case = generated(2000)
    case.faces[::2] = case.faces[::2, ::-1]  # which side is the front must not matter
    return case, RayMaker(case, 20_000, seed=3).make()


def test_rays(blob_rays):
    """Primary rays start at the camera; those of the others that are not blocked leave the mesh for good.

    Directions of bounces are cosine-distributed about normals that face the camera, and so the mean cosine is 2/3 with
    a variance of 1/18. Five standard errors: a false alarm in 2e6 runs, and the seed is fixed.
    """
    case, rays = blob_rays
    corners = case.points.astype(np.float64)[case.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= np.sign(np.einsum("ni,ni->n", normals, corners[:, 0]))[:, None]  # the surface is a graph over directions
    assert np.allclose(rays["primary"].origin, (3.2, 2.0, 1.6)) and rays["primary"].coherent
    assert not (rays["bounce"].coherent or rays["shadow"].coherent)

    # The triangle that a ray starts from is that which a ray back into the surface meets next.
    tracer = Ours("cpu", 1)
    tracer.prepare(case.points, case.faces)
    tracer.build()
    toward = np.asarray(rays["bounce"].origin - np.float32((3.2, 2.0, 1.6)))
    start = rays["bounce"].origin - 1e-3 * toward
    query = tracer.query("portable", Rays(start, toward, rays["bounce"].t_max, False), False)
    query.run()
    left = query.answer()
    n = normals[left.primitive]
    near = (left.t > 0.0) & (left.t < 2e-3)
    assert near.mean() > 0.98  # near an edge, another may be in front
    assert (np.einsum("ni,ni->n", n, toward)[near] < 0.0).all()  # seen from outside
    cosine = np.einsum("ni,ni->n", n, rays["bounce"].direction)[near]
    assert np.abs(np.linalg.norm(rays["bounce"].direction, axis=1) - 1.0).max() < 1e-5
    assert abs(cosine.mean() - 2.0 / 3.0) < 5.0 * math.sqrt(1.0 / 18.0 / len(cosine))
    # Around a closed surface nothing is hit from inside.
    for kind in ("bounce", "shadow"):
        query = tracer.query("portable", rays[kind], False)
        query.run()
        found = query.answer()
        hit = found.primitive >= 0
        assert 0.05 < hit.mean() < 0.7
        assert (np.einsum("ni,ni->n", normals[found.primitive], rays[kind].direction)[hit] < 0.0).mean() > 0.999
    # Shadow rays end on the sphere around all.
    ends = rays["shadow"].origin + rays["shadow"].direction
    lower, upper = case.points.min(axis=0), case.points.max(axis=0)
    radius = np.linalg.norm(ends - 0.5 * (lower + upper), axis=1)
    assert np.allclose(radius, np.linalg.norm(upper - lower), rtol=1e-5)


def test_shadow_rays_of_a_scene_end_on_its_lights():
    case = from_scene(Path(CORNELL_BOX))
    shadow = RayMaker(case, 1000).make()["shadow"]
    ends = shadow.origin + shadow.direction
    light = case.points[case.faces[case.lights]].reshape(-1, 3)
    assert (ends >= light.min(axis=0) - 1e-4).all() and (ends <= light.max(axis=0) + 1e-4).all()


def test_threads_share_the_rays(blob_rays):
    """Answers do not depend on the number of threads; the last share is not full."""
    case, rays = blob_rays
    for make in (lambda n: Ours("cpu", n), lambda n: WarpMesh("cpu", n, 2)):
        answers = []
        for threads in (1, 3):
            structure = make(threads)
            structure.prepare(case.points, case.faces)
            structure.build()
            for engine in structure.engines:
                query = structure.query(engine, rays["bounce"], False)
                query.run()
                answers.append(query.answer())
        for answer in answers[1:]:
            assert np.array_equal(answer.primitive, answers[0].primitive)
            assert np.array_equal(answer.t, answers[0].t)


def test_differences():
    hit = Answer(np.array([3, 4, -1, 7, 8]), np.array([1.0, 2.0, np.inf, 1.0, 5.0], np.float32))
    other = Answer(np.array([3, 5, -1, -1, 9]), np.array([1.0, 2.0001, 3e38, np.inf, 5.01], np.float32))
    assert differences(hit, hit) == 0
    assert differences(hit, other) == 2  # the fourth is missed, the fifth farther away
    assert differences(Answer(blocked=np.array([True, False])), Answer(blocked=np.array([True, True]))) == 1


def test_account(tmp_path, capsys):
    """Rates, ratios and the best leaf follow from the seconds, and all engines answer alike."""
    path, plot = tmp_path / "out.json", tmp_path / "out.png"
    arguments = [
        CORNELL_BOX,
        "--sizes",
        "500,2000",
        "--soup",
        "800",
        "--rays",
        "3000",
        "--rounds",
        "3",
        "--threads",
        "2",
    ]
    assert main([*arguments, *OURS, "--json", str(path), "--plot", str(plot)]) == 0
    out = capsys.readouterr().out
    assert plot.read_bytes().startswith(b"\x89PNG") and sorted(tmp_path.iterdir()) == [path, plot]
    account = json.loads(path.read_text())
    assert account["settings"] == {"threads": 2, "rays": 3000, "rounds": 3, "device": "cpu"}
    assert [case["generated"] for case in account["cases"]] == [False, True, True, False]
    for case in account["cases"]:
        assert f"{case['name']}: building" in out
        engines = case["engines"]
        assert list(engines) == ["stream", "portable", *(f"wp.Mesh, leaf {n}" for n in (1, 2, 4, 8))]
        total = {}
        for name, engine in engines.items():
            medians = []
            for kind, sorts in engine["measured"].items():
                assert list(sorts) == ["closest", "any"]
                for sort, measured in sorts.items():
                    seconds = measured["seconds"]["rounds"]
                    first = engines["stream"]["measured"][kind][sort]["seconds"]["rounds"]
                    rates = [case["rays"][kind] / s / 1e6 for s in seconds]
                    assert measured["mrays_per_second"]["rounds"] == pytest.approx(rates)
                    assert measured["mrays_per_second"]["max"] == pytest.approx(max(rates))
                    assert measured["mrays_per_second"]["median"] == pytest.approx(np.median(rates))
                    ratios = [theirs / ours for theirs, ours in zip(seconds, first, strict=True)]
                    assert measured["first_over_this"]["rounds"] == pytest.approx(ratios)
                    medians.append(np.median(seconds))
                    # The two traversals of ours are one; of wp.Mesh, rays through edges may miss.
                    assert measured["differences"] <= (0 if name in ("stream", "portable") else 3)
            assert engine["median_seconds_of_all"] == pytest.approx(sum(medians))
            total[name] = engine["median_seconds_of_all"]
        meshes = [name for name in total if name.startswith("wp.Mesh")]
        assert case["best_mesh"] == min(meshes, key=total.get) and f"{case['best_mesh']} (best)" in out
        for name, structure in case["structures"].items():
            assert structure["build_seconds"]["min"] > 0.0
            assert (structure["statistics"] is not None) == (name == "wavefront")
        ours = case["structures"]["wavefront"]
        assert ours["bytes_per_triangle"] == ours["statistics"]["bytes"] / case["triangles"]
        assert ours["statistics"]["primitives"] == case["triangles"]
        for kind in case["rays"]:
            assert 0.0 <= case["hit_share"][kind]["any"] <= case["hit_share"][kind]["closest"] <= 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rounds", "0"], "--rounds 0; allowed: 1 or more"),
        (["--threads", "0"], "--threads 0; allowed: 1 or more"),
        (["--rays", "1"], "--rays 1; allowed: 100 or more"),
        (["--sizes", "none", "--soup", "none"], "there is nothing to measure"),
        (["none.json"], "none.json: file not found"),
        (["--device", "tpu"], "tpu"),
        (["--sizes", "1e3", "--plot", "out.png"], "--plot needs two --sizes or more"),
        (["--plot", "out.pdf"], "allowed: names that end in .png"),
        (["--json", "none/out.json"], "none/out.json: the folder none does not exist"),
    ],
)
def test_bad_input_is_one_line(capsys, arguments, message):
    assert main([*OURS, *arguments]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ") and message in error


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sizes", "many"], "is not a list of numbers"),
        (["--sizes", "10"], "allowed: 100 to 100000000"),
        (["--sizes", "nan"], "is not a list of numbers"),
        (["--engines", "optix"], "there is no engine 'optix'"),
    ],
)
def test_bad_values_are_refused(capsys, arguments, message):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2 and message in capsys.readouterr().err


def test_engines_that_are_missing(monkeypatch, capsys):
    """One that is asked for by name is an error that names the extra."""
    monkeypatch.setitem(sys.modules, "embreex", None)
    assert main(["--engines", "stream,embree", "--sizes", "500", "--soup", "none"]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "embreex is not installed" in error and "pip install '.[embree]'" in error
    account = {"settings": {"device": "cpu", "threads": 1, "rounds": 1}, "cases": []}
    account |= {"machine": dict.fromkeys(("cpu", "cores", "load", "system", "python"), "?") | {"versions": {}}}
    print_report(account | {"left_out": {"embree": missing("embree", "cpu")}}, Console(width=200))
    assert "pip install '.[embree]'" in capsys.readouterr().out  # brackets are no markup
