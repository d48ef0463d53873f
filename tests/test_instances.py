"""Instances: the image of a scene in which every instance is a copy, rays against brute force, and what it costs."""

import resource
import sys

import msgspec
import numpy as np
import pytest

from tests.megakernel import render_megakernel
from wavefront import Renderer
from wavefront.accel.geometry import hit_type
from wavefront.errors import SceneError
from wavefront.scene import description as d
from wavefront.scene import json_format, load_scene, validate
from wavefront.scene.device import upload_scene
from wavefront.scene.transforms import to_matrix


def rows(matrix):
    return [tuple(map(float, row)) for row in matrix]


def flattened(scene):
    """The scene with a copy of its group's shapes in the place of every instance."""
    groups = {group.name: group for group in scene.groups}
    shapes = list(scene.shapes)
    for instance in scene.instances:
        matrix = to_matrix(instance.to_world)
        shapes += [
            msgspec.structs.replace(shape, name="", to_world=rows(matrix @ to_matrix(shape.to_world)))
            for shape in groups[instance.group].shapes
        ]
    return msgspec.structs.replace(scene, shapes=shapes, groups=[], instances=[])


def step(**fields):
    return d.TransformStep(**fields)


def turn(axis, angle):
    return step(rotate=d.Rotate(axis=axis, angle=angle))


def bent_sheet(**fields):
    """Four triangles with normals that are not those of the faces, and UVs."""
    vertices = [(-1.0, -1.0, 0.0), (1.0, -1.0, 0.2), (1.0, 1.0, -0.1), (-1.0, 1.0, 0.3), (0.1, 0.0, 0.4)]
    normals = [(-0.3, -0.3, 1.0), (0.3, -0.2, 1.0), (0.2, 0.3, 0.9), (-0.2, 0.2, 1.1), (0.0, 0.1, 1.0)]
    uvs = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.5, 0.5)]
    faces = [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)]
    return d.Mesh(vertices=vertices, faces=faces, normals=normals, uvs=uvs, **fields)


SHEAR = (1.0, 0.6, 0.0, 0.0), (0.0, 1.0, 0.3, 0.0), (0.2, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)
PLACES = [
    [step(translate=(-2.0, 1.0, 0.0))],
    [step(scale=(0.5, 1.2, 0.8)), turn((1.0, 0.3, 0.0), -50.0), step(translate=(0.0, 1.0, 0.5))],
    [step(scale=(-0.7, 0.7, 0.7)), turn((0.0, 1.0, 0.0), 30.0), step(translate=(1.8, 1.0, 0.3))],
    [step(matrix=SHEAR), step(scale=0.6), turn((0.0, 1.0, 0.0), 200.0), step(translate=(-0.8, 2.2, -0.6))],
    [step(scale=(1.0, -0.4, 2.0)), turn((0.2, 0.2, 1.0), 70.0), step(translate=(1.2, 2.4, -1.0))],
]


def garden(spheres=True, size=48, nee=True, own=True):
    """Every transform on a smooth textured sheet, a mask and a box of glass; spheres where they remain spheres."""
    checks = d.Checkerboard(name="checks", color0=[0.8, 0.5, 0.2], color1=0.2, uv_transform=((3, 0, 0), (0, 3, 0)))
    sheet = bent_sheet(bsdf=d.TwoSided(front=d.Diffuse(reflectance="checks"), back=d.Diffuse(reflectance=0.3)))
    fence = d.Rectangle(
        bsdf=d.Mask(bsdf=d.TwoSided(front=d.Diffuse(reflectance=[0.2, 0.6, 0.3])), opacity=0.6),
        to_world=[step(scale=(0.3, 0.8, 1.0)), turn((0.0, 1.0, 0.0), 90.0), step(translate=(0.8, 0.0, 0.6))],
    )
    one_sided = d.Cube(bsdf=d.Diffuse(reflectance=0.6), to_world=[step(scale=0.2), step(translate=(-0.5, 0.6, 0.6))])
    glass = d.Cube(
        bsdf=d.Dielectric(), interior=d.Homogeneous(sigma_a=[0.1, 2.0, 3.0]),
        to_world=[step(scale=0.25), step(translate=(-0.4, -0.5, 0.6))],
    )  # fmt: skip
    groups = [d.Group(name="sheet", shapes=[sheet, fence, one_sided, glass])]
    instances = [d.Instance(group="sheet", to_world=place) for place in PLACES]
    if spheres:
        ball = d.Sphere(bsdf=d.Diffuse(reflectance="checks"), radius=0.4, to_world=[turn((1.0, 0.0, 0.0), 40.0)])
        inwards = d.Sphere(
            center=(0.7, 0.2, 0.3), radius=0.3, flip_normals=True,
            bsdf=d.TwoSided(front=d.Diffuse(), back=d.Diffuse(reflectance=[0.7, 0.1, 0.1])),
        )  # fmt: skip
        groups.append(d.Group(name="balls", shapes=[ball, inwards]))
        groups.append(d.Group(name="mixed", shapes=[inwards, one_sided]))
        for i, (name, angle) in enumerate((("balls", 0.0), ("mixed", 200.0), ("balls", 77.0))):
            place = [turn((0.3, 1.0, 0.2), angle), step(scale=0.7), step(translate=(-2.0 + 2.0 * i, 0.5, 1.6))]
            instances.append(d.Instance(group=name, to_world=place))
    lamp = d.Rectangle(
        emitter=d.Area(radiance=[9.0, 8.0, 7.0]),
        to_world=[turn((1.0, 0.0, 0.0), 90.0), step(translate=(0.0, 5.0, 1.0))],
    )
    floor = d.Rectangle(bsdf=d.Diffuse(reflectance=0.5), to_world=[step(scale=5.0), turn((1.0, 0.0, 0.0), -90.0)])
    return d.Scene(
        camera=d.Perspective(
            fov=50.0, to_world=[step(look_at=d.LookAt(origin=(0.5, 2.5, 6.0), target=(0.0, 1.2, 0.0)))]
        ),
        film=d.Film(width=size, height=size, aovs=["albedo", "depth", "normal"]),
        integrator=d.PathIntegrator(max_depth=8, nee=nee),
        textures=[checks],
        shapes=[floor, lamp] if own else [],
        groups=groups,
        instances=instances,
        emitters=[d.Constant(radiance=[0.3, 0.35, 0.4])],
    )


def same(a, b, share=1e-3):
    """All pixels but a thousandth agree to 1e-5: where a rounding turns a decision (a lobe, a hit), they do not."""
    error = np.abs(a - b).reshape(*a.shape[:2], -1).max(axis=2)
    scale = np.maximum(np.abs(b).reshape(*b.shape[:2], -1).max(axis=2), 1e-3 * np.abs(b).mean())
    different = error > 1e-5 * scale
    for y, x in np.argwhere(different)[:10]:
        print(f"pixel ({x}, {y}): {a[y, x]}, {b[y, x]}")
    assert different.sum() <= share * different.size, different.mean()


def images(renderer, spp):
    image = renderer.render(spp)
    assert sum(renderer.statistics.nonfinite.values()) == 0
    return image, renderer.film.channels()


# Light samples close to grazing enlarge the roundings of a vertex, so with them paths are short and samples many.
@pytest.mark.parametrize(("nee", "max_depth", "spp"), [(True, 3, 64), (False, 8, 16)])
@pytest.mark.parametrize("spheres", [True, False])
def test_same_image_as_flattened(spheres, nee, max_depth, spp):
    scene = garden(spheres, nee=nee)
    scene.integrator.max_depth = max_depth
    assert validate(scene) == []
    assert validate(flattened(scene)) == []
    image, channels = images(Renderer(scene, threads=1, seed=3), spp)
    expected, flat_channels = images(Renderer(flattened(scene), threads=1, seed=3), spp)
    assert expected.std() > 0.1 * expected.mean()
    same(image, expected)
    for aov in ("albedo", "depth", "normal"):
        a, b = (
            np.stack([values for name, values in found.items() if name.startswith(aov)], axis=-1)
            for found in (channels, flat_channels)
        )
        same(a, b)


def test_megakernel():
    """The stages pass on which instance was hit."""
    scene = garden()
    scene.film.aovs = []
    renderer = Renderer(scene, threads=1, seed=3)
    same(renderer.render(4), render_megakernel(renderer, 4).astype(np.float32))


def test_only_instances():
    """The scene itself has no triangles, no spheres, or neither."""
    for spheres in (True, False):
        scene = garden(spheres, own=False, nee=False)
        same(Renderer(scene, threads=1).render(16), Renderer(flattened(scene), threads=1).render(16))


def test_features():
    """Without instances nothing of this is there: kernels, tables and hits are those of any scene. A group that no
    instance puts into the scene is not loaded."""
    scene = garden()
    f = Renderer(scene, threads=1).features
    assert f.instances == ("spheres", "triangles")
    assert not f.spheres
    scene.instances = []
    plain = msgspec.structs.replace(scene, groups=[])
    a, b = Renderer(scene, threads=1), Renderer(plain, threads=1)
    assert a.features == b.features
    assert a.features.instances == ()
    assert a.kernels.intersect is b.kernels.intersect
    assert a.device_scene.triangle_count == b.device_scene.triangle_count == 4
    assert not a.device_scene.geometry.instances
    assert "instance" not in hit_type(()).vars


def test_threads_and_memory():
    """The same to the last bit, whoever traces what."""
    scene = garden(size=37)
    reference = Renderer(scene, threads=1, seed=5).render(4)
    for threads in (2, 3):
        probe = Renderer(scene, threads=threads, seed=5)
        memory = 37 * 37 * probe.bytes_per_pixel + 1024 * threads * probe.bytes_per_path
        np.testing.assert_array_equal(Renderer(scene, threads=threads, seed=5, memory=memory).render(4), reference)


def test_lights_from_afar_know_how_large_the_scene_is():
    """The power of a constant environment grows with the bounds, which are those of the flattened scene here."""
    lamp = d.Sphere(emitter=d.Area(radiance=5.0))
    group = d.Group(name="box", shapes=[d.Cube(), d.Sphere(radius=0.5)])
    scene = d.Scene(shapes=[lamp], groups=[group], emitters=[d.Constant()])
    for place in ([step(translate=(9.0, 2.0, -4.0))], [step(scale=7.0), step(translate=(0.0, -3.0, 0.0))]):
        scene.instances = [d.Instance(group="box", to_world=place)]
        a, b = (upload_scene(s, "cpu").lights.lights.numpy()["pmf"] for s in (scene, flattened(scene)))
        np.testing.assert_allclose(a, b, rtol=1e-4)


# --- what it costs ---------------------------------------------------------------------------------------------------


def sheet_of(triangles):
    """A mesh of about so many triangles."""
    n = int(np.sqrt(triangles / 2))
    v, u = np.mgrid[0 : n + 1, 0 : n + 1] / n
    vertices = np.stack([u, v, 0.1 * np.sin(9.0 * u) * np.cos(7.0 * v)], axis=-1).reshape(-1, 3)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    quads = [corner, corner + 1, corner + n + 2], [corner, corner + n + 2, corner + n + 1]
    return d.Mesh(vertices=vertices, faces=np.concatenate([np.stack(q, axis=1) for q in quads]))


def resident():
    """Bytes of this process in memory, as the operating system counts them."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory():
    """10^4 instances of a mesh of 10^4 triangles, of which a copy each would take 5 GB, take about what one takes."""
    group = d.Group(name="sheet", shapes=[sheet_of(10_000)])
    rng = np.random.default_rng(1)
    instances = [
        d.Instance(group="sheet", to_world=[step(translate=tuple(map(float, position)))])
        for position in rng.normal(size=(10_000, 3)) * 20.0
    ]
    one, all_of_them = (d.Scene(groups=[group], instances=instances[:n]) for n in (1, 10_000))
    first = upload_scene(one, "cpu")
    before = resident()
    second = upload_scene(all_of_them, "cpu")
    grown = resident() - before
    assert first.triangle_count == second.triangle_count == second.instanced_triangle_count // 10_000 > 9_000
    assert second.instance_count == 10_000

    def stored(device_scene, names):
        arrays = (getattr(device_scene.geometry, name) for name in names)
        return sum(array.capacity for array in arrays if array is not None)

    shared = ("points", "indices", "normals", "uvs", "spheres", "shape_of", "shapes")
    assert stored(first, shared) == stored(second, shared)
    assert stored(second, ("instances",)) == 10_000 * 88
    print(f"resident memory grew by {grown / 2**20:.1f} MiB")
    assert grown < 32 << 20


# --- records ---------------------------------------------------------------------------------------------------------


def test_written_and_read_back(tmp_path):
    scene = garden()
    json_format.dump(scene, tmp_path / "s.json")
    assert json_format.load(tmp_path / "s.json") == scene
    for name in ("camera", "film", "integrator"):
        setattr(scene, name, getattr(d.Scene(), name))
    json_format.dump(scene, tmp_path / "part.json")
    (tmp_path / "whole.json").write_text('{"include": ["part.json"]}')
    whole = load_scene(tmp_path / "whole.json")
    assert (whole.groups, whole.instances) == (scene.groups, scene.instances)


GROUP = {"name": "a", "shapes": [{"type": "cube"}]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"instances": [{"group": "b"}]}, "instances[0].group: unknown group 'b'; known: 'a'"),
        ({"instances": [{}]}, "instances[0]: missing key 'group'"),
        ({"groups": [GROUP, GROUP]}, "groups[1].name: the name 'a' is taken"),
        ({"groups": [{"name": "a", "shapes": []}]}, "groups[0].shapes: the group is empty"),
        ({"groups": [{"name": "", "shapes": []}]}, "groups[0].name: expected a string that is not empty"),
        (
            {"groups": [{"name": "a", "shapes": [{"type": "cube", "emitter": {"type": "area"}}]}]},
            "groups[0].shapes[0].emitter: a shape of a group cannot emit",
        ),
        (
            {"groups": [{"name": "a", "shapes": [{"type": "instance", "group": "a"}]}]},
            "groups[0].shapes[0].type: unknown type 'instance'",
        ),
        (
            {"groups": [{"name": "a", "shapes": [{"type": "sphere", "to_world": [{"scale": [1, 2, 1]}]}]}]},
            "groups[0].shapes[0].to_world: a sphere can be scaled uniformly only",
        ),
        ({"instances": [{"group": "a", "to_world": [{"scale": 0}]}]}, "instances[0].to_world: the transform is not"),
        ({"instances": [{"group": "a", "to_world": [{"scale": 1e-39}]}]}, "instances[0].to_world: the transform's inv"),
        ({"groups": [{"name": "a", "shapes": [{"type": "cube", "bsdf": "x"}]}]}, "groups[0].shapes[0].bsdf: unknown"),
    ],
)
def test_bad_groups_are_refused(tmp_path, change, message):
    raw = {"groups": [GROUP], "instances": [{"group": "a"}]} | change
    (tmp_path / "s.json").write_bytes(msgspec.json.encode(raw))
    with pytest.raises(SceneError) as error:
        load_scene(tmp_path / "s.json")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_warnings():
    scene = d.Scene(groups=[d.Group(name="a", shapes=[d.Cube()])], emitters=[d.Constant()], shapes=[d.Cube()])
    assert validate(scene) == ["groups[0]: no instance puts 'a' into the scene"]
    scene.instances, scene.shapes = [d.Instance(group="a")], []
    assert validate(scene) == []


def test_the_reference_traversal_finds_the_same():
    """But for edges, which rounding decides, and for roundings that diffuse bounces enlarge."""
    image, reference = (Renderer(garden(nee=False), threads=1, accel=accel).render(spp=2) for accel in ("bvh", "mesh"))
    assert image.max() > 0.0
    assert (np.abs(image - reference) <= 1e-3 * (1.0 + np.abs(reference))).mean() > 0.97
