"""Semantic checks: each message in full, and what must not be refused."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from wavefront.errors import SceneError
from wavefront.scene import description as d
from wavefront.scene import mesh_files
from wavefront.scene.lookup import resolve_bsdf, resolve_texture, shown, walk
from wavefront.scene.validate import MESH_SUFFIXES, validate

STEP = d.TransformStep
TILES = str(Path(__file__).parents[2] / "scenes" / "textures" / "tiles.png")
STEPS = "translate, rotate, scale, look_at, matrix"
REFLECTING = (
    "diffuse, oren_nayar, conductor, rough_conductor, plastic, rough_plastic, principled, a blend of those, and a "
    "normal_map or bump_map around one"
)
FLAT = d.NormalMap(bsdf=d.Diffuse(), normal=[0.5, 0.5, 1.0])
GLASSY = d.Blend(name="b", first=d.Plastic(), second=d.Dielectric())
TOO_LARGE = "expected a number of at most 3.403e+38, as 32-bit floats are; found"


def with_bsdfs(*bsdfs):
    return d.Scene(bsdfs=list(bsdfs))


def with_mesh(**fields):
    fields = {"vertices": [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)], "faces": [(0, 1, 2)], **fields}
    return d.Scene(shapes=[d.Mesh(**fields)])


def moved(*transform, shape=d.Rectangle):
    return d.Scene(shapes=[shape(to_world=list(transform))])


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (
            with_bsdfs(d.Diffuse(name="a"), d.Conductor(name="a", material="Au")),
            "bsdfs[1].name: the name 'a' is taken by an earlier entry of bsdfs",
        ),
        (
            d.Scene(shapes=[d.Cube(name="a"), d.Cube(), d.Cube(), d.Disk(name="a")]),
            "shapes[3].name: the name 'a' is taken by an earlier entry of shapes",
        ),
        (
            d.Scene(bsdfs=[d.Diffuse(name="gold"), d.Diffuse(name="wood")], shapes=[d.Sphere(bsdf="glod")]),
            "shapes[0].bsdf: unknown BSDF 'glod'; did you mean 'gold'? known: 'gold', 'wood'",
        ),
        (
            d.Scene(bsdfs=[d.Diffuse(name=f"b{i:02}") for i in range(30)], shapes=[d.Sphere(bsdf="x")]),
            f"shapes[0].bsdf: unknown BSDF 'x'; known: {', '.join(repr(f'b{i:02}') for i in range(24))} and 6 more",
        ),
        (with_bsdfs(d.TwoSided(front="x")), "bsdfs[0].front: unknown BSDF 'x'; none is defined"),
        (with_bsdfs(d.Diffuse(reflectance="x")), "bsdfs[0].reflectance: unknown texture 'x'; none is defined"),
        (
            d.Scene(shapes=[d.Disk(emitter=d.Area(radiance="x"))], textures=[d.Checkerboard(name="y")]),
            "shapes[0].emitter.radiance: unknown texture 'x'; known: 'y'",
        ),
        (with_bsdfs(d.Diffuse(reflectance="")), "bsdfs[0].reflectance: unknown texture ''; none is defined"),
        # Nesting
        (
            with_bsdfs(d.TwoSided(front=d.Dielectric())),
            f"bsdfs[0].front: a twosided BSDF cannot hold dielectric; allowed: {REFLECTING}",
        ),
        (
            with_bsdfs(d.TwoSided(front=d.Diffuse(), back=d.Principled(spec_trans=0.1))),
            "bsdfs[0].back: a twosided BSDF cannot hold principled with spec_trans; allowed: " + REFLECTING,
        ),
        (
            with_bsdfs(d.Principled(eta=1.5, specular=0.5)),
            "bsdfs[0]: a principled BSDF has eta or specular; found both",
        ),
        (with_bsdfs(d.Principled(sheen_tint="x")), "bsdfs[0].sheen_tint: unknown texture 'x'; none is defined"),
        (
            with_bsdfs(d.TwoSided(front=d.ThinDielectric())),
            f"bsdfs[0].front: a twosided BSDF cannot hold thin_dielectric; allowed: {REFLECTING}",
        ),
        (
            with_bsdfs(d.TwoSided(front=d.Diffuse(), back="m"), d.Mask(name="m", bsdf=d.Diffuse())),
            f"bsdfs[0].back: a twosided BSDF cannot hold mask; allowed: {REFLECTING}",
        ),
        (
            with_bsdfs(d.TwoSided(name="t", front=d.TwoSided(front=d.Diffuse()))),
            f"bsdfs[0].front: a twosided BSDF cannot hold twosided; allowed: {REFLECTING}",
        ),
        (
            with_bsdfs(d.Blend(first=d.Diffuse(), second=d.Mask(bsdf=d.Diffuse()))),
            "bsdfs[0].second: a blend cannot hold mask; put the mask around the blend",
        ),
        (
            with_bsdfs(d.Blend(first=FLAT, second=d.Diffuse())),
            "bsdfs[0].first: a blend cannot hold normal_map; put the normal_map around the blend",
        ),
        (
            with_bsdfs(d.TwoSided(front=d.Blend(first=d.Diffuse(), second="b")), GLASSY),
            f"bsdfs[0].front: a twosided BSDF cannot hold a blend with dielectric; allowed: {REFLECTING}",
        ),
        (
            with_bsdfs(d.TwoSided(front=d.NormalMap(bsdf=d.Null(), normal=[0.5, 0.5, 1.0]))),
            f"bsdfs[0].front.bsdf: a twosided BSDF cannot hold null; allowed: {REFLECTING}",
        ),
        (
            with_bsdfs(d.Blend(first="a", second=d.Diffuse(), name="a")),
            "bsdfs[0].first: BSDFs refer to each other in a cycle: 'a' -> 'a'",
        ),
        (
            with_bsdfs(d.NormalMap(bsdf=FLAT, normal=[0.5, 0.5, 1.0])),
            "bsdfs[0].bsdf: a normal_map cannot hold normal_map",
        ),
        (
            with_bsdfs(d.BumpMap(bsdf=d.Mask(bsdf=d.Diffuse()), height=d.Bitmap(file=TILES))),
            "bsdfs[0].bsdf: a bump_map cannot hold mask; put the bump_map into the mask",
        ),
        (
            with_bsdfs(d.BumpMap(bsdf=d.Null(), height=d.Bitmap(file=TILES))),
            "bsdfs[0].bsdf: a bump_map cannot hold null, which has no normal",
        ),
        (
            with_bsdfs(d.NormalMap(bsdf=d.TwoSided(front=d.Diffuse(), back=FLAT), normal=[0.5, 0.5, 1.0])),
            "bsdfs[0].bsdf.back: a normal_map cannot hold normal_map",
        ),
        (
            with_bsdfs(d.BumpMap(bsdf=d.Diffuse(), height=d.Bitmap(file=TILES, filter="nearest"))),
            "bsdfs[0].height: expected a bitmap with the filter 'bilinear', which has slopes; found filter 'nearest'",
        ),
        (
            d.Scene(bsdfs=[d.BumpMap(bsdf=d.Diffuse(), height="c")], textures=[d.Checkerboard(name="c")]),
            "bsdfs[0].height: expected a bitmap with the filter 'bilinear', which has slopes; found a checkerboard",
        ),
        (
            with_bsdfs(d.RoughConductor(material="Au", alpha_u=0.1)),
            "bsdfs[0]: a rough surface has alpha, or alpha_u and alpha_v; found alpha_u",
        ),
        (
            with_bsdfs(d.RoughDielectric(alpha=0.1, alpha_u=0.1, alpha_v=0.1)),
            "bsdfs[0]: a rough surface has alpha, or alpha_u and alpha_v; found alpha and alpha_u and alpha_v",
        ),
        (
            d.Scene(shapes=[d.Cube(bsdf=d.Mask(bsdf=d.Mask(bsdf=d.Diffuse())))]),
            "shapes[0].bsdf.bsdf: a mask cannot hold another mask; multiply their opacities",
        ),
        (
            with_bsdfs(d.Mask(name="a", bsdf="a")),
            "bsdfs[0].bsdf: BSDFs refer to each other in a cycle: 'a' -> 'a'",
        ),
        (
            with_bsdfs(d.Mask(name="a", bsdf="b"), d.Mask(name="b", bsdf=d.TwoSided(front="a"))),
            "bsdfs[0].bsdf: BSDFs refer to each other in a cycle: 'b' -> 'a' -> 'b'",
        ),
        # Materials
        (with_bsdfs(d.Conductor()), "bsdfs[0]: a conductor has material, or eta and k; found none of them"),
        (with_bsdfs(d.Conductor(k=1.0)), "bsdfs[0]: a conductor has material, or eta and k; found k"),
        (
            with_bsdfs(d.RoughConductor(material="Au", eta=1.0, k=1.0)),
            "bsdfs[0]: a conductor has material, or eta and k; found material and eta and k",
        ),
        (
            with_bsdfs(d.Dielectric(ext_ior="watr")),
            "bsdfs[0].ext_ior: unknown index of refraction 'watr'; did you mean 'water'? known: 'acetone', "
            "'acrylic glass', 'air', 'amber', 'benzene', 'bk7', 'bromine', 'carbon dioxide', 'carbon tetrachloride', "
            "'diamond', 'ethanol', 'fused quartz', 'glycerol', 'helium', 'hydrogen', 'pet', 'polypropylene', 'pyrex', "
            "'silicone oil', 'sodium chloride', 'vacuum', 'water', 'water ice'",
        ),
        # Transforms
        (
            moved(STEP()),
            f"shapes[0].to_world[0]: a transform step has exactly one of {STEPS}; found none",
        ),
        (
            moved(STEP(scale=2.0), STEP(scale=1.0, translate=(0.0, 0.0, 0.0))),
            f"shapes[0].to_world[1]: a transform step has exactly one of {STEPS}; found translate and scale",
        ),
        (
            moved(STEP(scale=2.0), (1.0, 0.0, 0.0, 0.0)),
            "shapes[0].to_world: matrix rows and steps cannot be mixed in one transform",
        ),
        (
            moved((1.0, 0.0, 0.0, 0.0)),
            "shapes[0].to_world: a matrix has four rows of four numbers; found 1 rows",
        ),
        (
            moved(STEP(scale=(1.0, 0.0, 1.0))),
            "shapes[0].to_world: the transform is not invertible (it flattens space); check for a scale of 0",
        ),
        (
            moved(*[STEP(scale=1e30)] * 3),
            "shapes[0].to_world: the transform's matrix has a number above 3.403e+38, too large for 32-bit floats",
        ),
        (
            moved(STEP(scale=(1.0, 1.0, 1.01)), shape=d.Sphere),
            "shapes[0].to_world: a sphere can be scaled uniformly only; found different scales or a shear",
        ),
        # Numbers
        (d.Scene(shapes=[d.Sphere(radius=1e39)]), f"shapes[0].radius: {TOO_LARGE} 1e+39"),
        (d.Scene(shapes=[d.Sphere(radius=10**39)]), f"shapes[0].radius: {TOO_LARGE} 1e+39"),
        (
            d.Scene(shapes=[d.Sphere(center=(0.0, -math.inf, 0.0))]),
            "shapes[0].center[1]: expected a finite number; found -inf",
        ),
        (
            with_bsdfs(d.Conductor(eta=[1.0, math.inf, 1.0], k=1.0)),
            "bsdfs[0].eta[1]: expected a finite number; found inf",
        ),
        (
            d.Scene(textures=[d.Checkerboard(uv_transform=((1.0, 0.0, math.nan), (0.0, 1.0, 0.0)))]),
            "textures[0].uv_transform[0][2]: expected a finite number; found nan",
        ),
        (
            d.Scene(camera=d.Perspective(to_world=[STEP(translate=(0.0, math.nan, 0.0))])),
            "camera.to_world[0].translate[1]: expected a finite number; found nan",
        ),
        (
            d.Scene(camera=d.Perspective(to_world=[(1.0, 0.0, 0.0, math.nan)] * 4)),
            "camera.to_world[0][3]: expected a finite number; found nan",
        ),
        # Meshes
        (d.Scene(shapes=[d.Mesh()]), "shapes[0]: a mesh has file, or vertices and faces; found none of them"),
        (with_mesh(faces=None), "shapes[0]: a mesh has file, or vertices and faces; found vertices"),
        (with_mesh(file="/a.ply"), "shapes[0]: a mesh with a file has no vertices of its own"),
        (with_mesh(vertices=[]), "shapes[0].vertices: the mesh is empty"),
        (with_mesh(faces=[]), "shapes[0].faces: the mesh is empty"),
        (with_mesh(uvs=[(0.0, 0.0)]), "shapes[0].uvs: expected one per vertex, 3; found 1"),
        (with_mesh(faces=[(0, 1, 2), (0, 1, 3)]), "shapes[0].faces[1]: expected vertex indices from 0 to 2; found 3"),
        (with_mesh(faces=[(0, -1, 2)]), "shapes[0].faces[0]: expected vertex indices from 0 to 2; found -1"),
        (with_mesh(faces=[(0, 1, 10**25)]), f"shapes[0].faces[0]: expected vertex indices from 0 to 2; found {10**25}"),
        # Files
        (
            d.Scene(shapes=[d.Mesh(file="/none/a.stl")]),
            "shapes[0].file: unknown mesh format '.stl' of '/none/a.stl'; allowed: .ply, .obj, .gltf, .glb",
        ),
        (d.Scene(shapes=[d.Mesh(file="/none/a.ply")]), "shapes[0].file: file not found: '/none/a.ply'"),
        (
            d.Scene(textures=[d.Bitmap(file="/none/a.psd")]),
            "textures[0].file: unknown image format '.psd' of '/none/a.psd'; "
            "allowed: .png, .jpg, .jpeg, .bmp, .tga, .tif, .tiff, .exr, .hdr",
        ),
        (
            with_bsdfs(d.Diffuse(reflectance=d.Bitmap(file="/none/a.png"))),
            "bsdfs[0].reflectance.file: file not found: '/none/a.png'",
        ),
        # The rest
        (
            d.Scene(emitters=[d.Constant(), d.Constant()]),
            "emitters[1]: a scene has at most one environment; emitters[0] is one already",
        ),
        (
            d.Scene(emitters=[d.Constant(), d.Sun(direction=(0.0, 0.0, 0.0))]),
            "emitters[1].direction: the direction is zero",
        ),
        (
            d.Scene(emitters=[d.Sun(direction=(0.0, 1.0, 0.0), radiance=1.0, irradiance=1.0)]),
            "emitters[0]: a sun has irradiance or radiance; found both",
        ),
        (
            d.Scene(emitters=[d.Spot(position=(0.0, 0.0, 0.0), direction=(0.0, 1.0, 0.0), beam_width=21.0)]),
            "emitters[0].beam_width: expected at most cutoff_angle; found 21 and 20",
        ),
        (
            d.Scene(emitters=[d.Envmap(file="/none/sky.png")]),
            "emitters[0].file: file not found: '/none/sky.png'",
        ),
        (
            d.Scene(emitters=[d.Envmap(file=__file__)]),
            f"emitters[0].file: unknown image format '.py' of {shown(__file__)}; "
            "allowed: .png, .jpg, .jpeg, .bmp, .tga, .tif, .tiff, .exr, .hdr",
        ),
        (
            d.Scene(emitters=[d.Envmap(file=TILES, to_world=[d.TransformStep(scale=(1.0, 2.0, 1.0))])]),
            "emitters[0].to_world: an environment can be rotated; found different scales or a shear",
        ),
        (d.Scene(film=d.Film(aovs=["depth", "depth"])), "film.aovs[1]: 'depth' is given twice"),
    ],
)
def test_a_scene_that_makes_no_sense_is_refused_with_the_place(scene, message):
    with pytest.raises(SceneError) as caught:
        validate(scene, "s.json")
    assert str(caught.value) == f"s.json: {message}"


def test_unknown_indices_of_refraction_are_refused():
    for bsdf in (d.ThinDielectric(int_ior="plastik"), d.Plastic(int_ior="plastik"), d.RoughPlastic(ext_ior="plastik")):
        with pytest.raises(SceneError, match="unknown index of refraction 'plastik'"):
            validate(with_bsdfs(bsdf))


def test_the_name_of_a_texture_of_roughness_is_checked():
    with pytest.raises(SceneError, match=r"bsdfs\[0\]\.roughness: unknown texture 'clay'"):
        validate(with_bsdfs(d.OrenNayar(roughness="clay")))


@pytest.mark.parametrize("nee", [True, False])
def test_a_light_that_no_ray_meets_is_a_warning_without_light_sampling(nee):
    lights = [
        d.Directional(direction=(0.0, -1.0, 0.0)),
        d.Constant(),
        d.Point(position=(0.0, 1.0, 0.0)),
        d.Spot(position=(0.0, 1.0, 0.0), direction=(0.0, -1.0, 0.0)),
        d.Sun(direction=(0.0, -1.0, 0.0)),
    ]
    scene = d.Scene(shapes=[d.Cube()], emitters=lights, integrator=d.PathIntegrator(nee=nee))
    kinds = {} if nee else {0: "directional", 2: "point", 3: "spot"}
    text = "emitters[{}]: a {} light adds nothing where integrator.nee is false: no ray meets it"
    assert validate(scene) == [text.format(i, kind) for i, kind in kinds.items()]


def test_unknown_metals_are_named_with_the_nearest():
    with pytest.raises(SceneError) as caught:
        validate(with_bsdfs(d.Conductor(material="TiO")))
    assert str(caught.value).startswith(
        "bsdfs[0].material: unknown metal 'TiO'; did you mean 'TiO2'? known: 'Ag', 'Al', "
    )


@pytest.mark.parametrize(
    "look_at",
    [
        d.LookAt(origin=(1.0, 2.0, 3.0), target=(1.0, 2.0, 3.0)),
        d.LookAt(origin=(0.0, 0.0, 0.0), target=(0.0, 2.0, 0.0)),
        d.LookAt(origin=(0.0, 0.0, 0.0), target=(0.0, 2.0, 1.0), up=(0.0, 0.0, 0.0)),
    ],
)
def test_a_camera_without_a_direction_is_refused(look_at):
    with pytest.raises(SceneError) as caught:
        validate(d.Scene(camera=d.Perspective(to_world=[STEP(look_at=look_at)])))
    assert caught.value.path == "camera.to_world[0].look_at"


def test_a_rotation_without_an_axis_is_refused():
    with pytest.raises(SceneError) as caught:
        validate(moved(STEP(rotate=d.Rotate(axis=(0.0, 0.0, 0.0), angle=3.0))))
    assert caught.value.path == "shapes[0].to_world[0].rotate"


@pytest.mark.parametrize(
    "scene",
    [
        with_bsdfs(d.Mask(name="m", bsdf="t"), d.TwoSided(name="t", front="d", back=d.Conductor(material="none"))),
        with_bsdfs(d.TwoSided(front=d.Principled(anisotropic=0.5, clearcoat=d.Checkerboard()), back=d.Principled())),
        with_bsdfs(d.Mask(bsdf=d.Principled(spec_trans=d.Checkerboard(), eta=1.0))),
        with_bsdfs(d.TwoSided(front=d.OrenNayar(roughness=d.Checkerboard(color0=0.0, color1=1.0)))),
        with_bsdfs(
            d.TwoSided(front=d.Plastic(int_ior="water"), back=d.RoughPlastic(diffuse_reflectance=[1.0, 0.0, 0.5]))
        ),
        with_bsdfs(
            d.Mask(bsdf=d.NormalMap(bsdf=d.TwoSided(front=GLASSY.first, back="b"), normal=[0.5, 0.5, 1.0])),
            d.Blend(name="b", first=d.Conductor(material="Au"), second=d.Blend(first=d.Diffuse(), second=d.Plastic())),
            d.TwoSided(front=FLAT, back=d.BumpMap(bsdf="b", height=d.Bitmap(file=TILES), scale=-1.0)),
            d.BumpMap(bsdf=GLASSY.second, height=d.Bitmap(file=TILES), shadowing=False),
            d.Blend(first=d.Null(), second=d.RoughDielectric(alpha_u=0.1, alpha_v=d.Checkerboard())),
        ),
        with_bsdfs(d.Mask(bsdf=d.RoughDielectric()), d.Mask(bsdf=d.TwoSided(front=d.Diffuse()))),
        moved(STEP(scale=1e-6), STEP(scale=(1.0, 1e6, 1.0))),
        moved(STEP(scale=-3.0), STEP(rotate=d.Rotate(axis=(1.0, 2.0, 3.0), angle=77.0)), shape=d.Sphere),
        d.Scene(bsdfs=[d.Diffuse(name="same")], textures=[d.Checkerboard(name="same")], shapes=[d.Cube(name="same")]),
        with_mesh(normals=[(0.0, 0.0, 1.0)] * 3, uvs=[(0.0, 9e9)] * 3),
        d.Scene(emitters=[d.Constant(radiance=1e8)]),
    ],
)
def test_legal_scenes_pass(scene):
    scene.bsdfs.append(d.Diffuse(name="d"))
    validate(scene)


@pytest.mark.parametrize("sampler", ["independent", "sobol"])
@pytest.mark.parametrize("aov", ["depth", "variance"])
def test_a_variance_of_samples_that_are_not_independent_is_a_warning(sampler, aov):
    film, integrator = d.Film(aovs=[aov]), d.PathIntegrator(sampler=sampler)
    warnings = validate(d.Scene(shapes=[d.Cube()], emitters=[d.Constant()], film=film, integrator=integrator))
    assert len(warnings) == (sampler == "sobol" and aov == "variance")
    assert all("film.aovs: variance is that of independent samples" in warning for warning in warnings)


def test_warnings_are_returned_and_passed_on():
    told = []
    assert (
        validate(d.Scene(), warn=told.append)
        == told
        == [
            "the scene has no shapes",
            "the scene has no emitter: the image will be black",
        ]
    )
    assert validate(with_bsdfs(d.Diffuse()))[2:] == ["bsdfs[0] has no name, so nothing can refer to it"]
    lit = d.Scene(shapes=[d.Cube(emitter=d.Area())], bsdfs=[d.Diffuse(name="not used")])
    assert validate(lit) == []
    assert validate(d.Scene(shapes=[d.Cube()], emitters=[d.Constant()])) == []


def test_the_reader_takes_the_mesh_files_that_are_allowed():
    assert mesh_files.SUFFIXES == MESH_SUFFIXES


def test_lookups_give_records():
    checks = d.Checkerboard(name="c")
    named = d.Diffuse(name="a", reflectance="c")
    scene = d.Scene(bsdfs=[named], textures=[checks])
    assert resolve_bsdf(scene, "a") is named
    assert resolve_bsdf(scene, named) is named
    assert resolve_bsdf(scene, None) == d.Diffuse()
    assert resolve_texture(scene, "c") is checks
    assert resolve_texture(scene, 0.5) == 0.5
    assert resolve_texture(scene, [0.1, 0.2, 0.3]) == [0.1, 0.2, 0.3]
    for call, name, message in (
        (resolve_bsdf, "b", "unknown bsdf 'b'; known: 'a'"),
        (resolve_texture, "", "unknown texture ''; known: 'c'"),
    ):
        with pytest.raises(SceneError) as caught:
            call(scene, name)
        assert str(caught.value) == message


def test_walk_gives_every_record_with_its_path():
    scene = d.Scene(
        shapes=[d.Cube(bsdf=d.Mask(bsdf=d.Diffuse(reflectance=d.Checkerboard())), to_world=[STEP(scale=2.0)])]
    )
    assert [path for path, _ in walk(scene)] == [
        "",
        "shapes[0]",
        "shapes[0].bsdf",
        "shapes[0].bsdf.bsdf",
        "shapes[0].bsdf.bsdf.reflectance",
        "shapes[0].to_world[0]",
        "camera",
        "film",
        "film.filter",
        "integrator",
    ]
