"""The renderer gives the image of a tiny megakernel that follows the same paths.

On the CPU device both evaluate the same functions in the same order, so nearly all pixels agree to a few roundings.
Where they do not, a rounding has turned a decision (a hit, a lobe, roulette): at most one pixel in a thousand, and the
test prints every one with both values.
"""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from tests.megakernel import render_megakernel
from wavefront import Renderer, load_scene
from wavefront.scene import description as d
from wavefront.scene.images import write_exr

SCENES = Path(__file__).parent.parent / "scenes"
SPP = 4
SIZE = ["film.width=48", "film.height=48"]


def check(scene, spp=SPP, seed=3):
    renderer = Renderer(scene, threads=1, seed=seed)
    image = renderer.render(spp)
    expected = render_megakernel(renderer, spp)
    assert sum(renderer.statistics.nonfinite.values()) == 0
    assert np.isfinite(expected).all()
    assert expected.max() > 0.0 or not scene.integrator.nee  # without it, few paths may find a small light: none
    error = np.abs(image - expected).max(axis=2)
    # Relative to the pixel, or to the mean of the image for pixels that are nearly black.
    scale = np.maximum(expected.max(axis=2), 1e-3 * expected.mean())
    different = error > 1e-5 * scale
    for y, x in np.argwhere(different)[:20]:
        print(f"pixel ({x}, {y}): renderer {image[y, x]}, megakernel {expected[y, x]}")
    assert different.sum() <= 1e-3 * different.size
    return image


def own(name, *overrides):
    return load_scene(SCENES / f"{name}.json", [*SIZE, *overrides])


# Grouped by the kernels they need, so that few are compiled; the rest is slow.
@pytest.mark.parametrize("nee", ["true", "false"])
@pytest.mark.parametrize("rr_depth", ["1", "null"])
def test_cornell_box(nee, rr_depth):
    check(own("cornell-box", f"integrator.nee={nee}", f"integrator.rr_depth={rr_depth}"))


@pytest.mark.parametrize("max_depth", [1, 2, 3])
def test_short_paths(max_depth):
    check(own("cornell-box", f"integrator.max_depth={max_depth}", "integrator.rr_depth=1"))


@pytest.mark.parametrize("filter_name", ["box", "gaussian"])
def test_filters(filter_name):
    scene = own("cornell-box", "integrator.max_depth=2")
    scene.film.filter = {"box": d.BoxFilter(), "gaussian": d.GaussianFilter(stddev=0.7)}[filter_name]
    check(scene)


LOOK = [d.TransformStep(look_at=d.LookAt(origin=(0.2, 1.0, 4.2), target=(0.0, 1.0, 0.0)))]
CAMERAS = {
    "thin lens": d.ThinLens(fov=38.0, aperture_radius=0.2, focus_distance=3.5, to_world=LOOK),
    "orthographic": d.Orthographic(width=2.4, to_world=LOOK),
    "spherical": d.Spherical(to_world=LOOK),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_cameras(name):
    scene = own("cornell-box", "integrator.max_depth=2")
    scene.camera = CAMERAS[name]
    check(scene)


DEFAULT = [
    "glossy-plates",
    "glass-caustic",
    "material-mask",
    "material-diffuse-bitmap",
    "material-twosided",
    "principled-lobes",
    "coloured-glass",
]
OTHERS = sorted(p.stem for p in SCENES.glob("*.json") if p.stem not in [*DEFAULT, "cornell-box"])


@pytest.mark.parametrize("name", DEFAULT)
def test_own_scene(name):
    check(own(name))


@pytest.mark.parametrize("name", ["cornell-box", "camera-thin-lens", "coloured-glass"])
def test_sobol(name):
    check(own(name, "integrator.sampler=sobol", "integrator.rr_depth=2"), spp=6)


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
def test_own_scene_slow(name):
    check(own(name))


@pytest.mark.slow
@pytest.mark.parametrize("nee", ["true", "false"])
@pytest.mark.parametrize("rr_depth", ["2", "null"])
@pytest.mark.parametrize("name", [*DEFAULT, *OTHERS])
def test_own_scene_settings(name, nee, rr_depth):
    check(own(name, f"integrator.nee={nee}", f"integrator.rr_depth={rr_depth}"), seed=2**40 + 1)


def mixed_scene():
    """Everything at once: a textured light, spheres that emit outwards and inwards, a mask, glass, an environment, bump
    and normal maps, brushed metal, and a blend of a blend."""
    checks = d.Checkerboard(color0=[2.0, 1.0, 0.5], color1=0.25, uv_transform=((4.0, 0.0, 0.0), (0.0, 4.0, 0.0)))
    opacity = d.Checkerboard(color0=1.0, color1=0.25, uv_transform=((6.0, 0.0, 0.0), (0.0, 6.0, 0.0)))
    turned = [d.TransformStep(scale=(3.0, 3.0, 1.0)), d.TransformStep(rotate=d.Rotate(axis=(1, 0, 0), angle=-90.0))]
    shapes = [
        d.Rectangle(bsdf=d.Diffuse(reflectance=[0.7, 0.6, 0.5]), to_world=turned),
        d.Rectangle(
            bsdf=d.Mask(bsdf=d.TwoSided(front=d.Diffuse(reflectance=0.8)), opacity=opacity),
            to_world=[d.TransformStep(translate=(0.0, 1.0, -1.0))],
        ),
        d.Rectangle(
            emitter=d.Area(radiance=checks),
            to_world=[
                d.TransformStep(scale=0.5),
                d.TransformStep(rotate=d.Rotate(axis=(1, 0, 0), angle=80.0)),
                d.TransformStep(translate=(-0.5, 2.5, 0.0)),
            ],
        ),
        d.Sphere(center=(1.2, 0.5, 0.4), radius=0.3, emitter=d.Area(radiance=[4.0, 2.0, checks.color1])),
        d.Sphere(center=(-1.3, 0.5, 0.3), radius=0.4, emitter=d.Area(radiance=checks)),
        d.Sphere(center=(0.1, 0.5, 0.7), radius=0.4, bsdf=d.RoughDielectric(alpha=0.2)),
        d.Sphere(center=(0.5, 0.3, 1.3), radius=0.25, bsdf=d.Dielectric()),
        d.Sphere(center=(-0.5, 0.3, 1.3), radius=0.25, bsdf=d.RoughConductor(material="Au", alpha=0.15)),
        d.Sphere(
            center=(0.9, 0.3, 1.5),
            radius=0.3,
            bsdf=d.NormalMap(
                bsdf=d.Blend(
                    first=d.Blend(first=d.Diffuse(), second=d.Dielectric(), weight=checks.color1),
                    second=d.RoughDielectric(alpha_u=0.4, alpha_v=0.2),
                    weight=opacity,
                ),
                normal=d.Checkerboard(color0=[0.4, 0.6, 0.9], color1=[0.8, 0.5, 0.8]),
            ),
        ),
        d.Disk(
            bsdf=d.TwoSided(
                front=d.BumpMap(
                    bsdf=d.RoughConductor(material="Au", alpha_u=0.1, alpha_v=0.3),
                    height=d.Bitmap(file=str(SCENES / "textures" / "dents.png")),
                    scale=-0.2,
                )
            ),
            to_world=[
                d.TransformStep(scale=(0.5, 0.3, 1.0)),
                d.TransformStep(rotate=d.Rotate(axis=(1, 1, 0), angle=-70.0)),
                d.TransformStep(translate=(-0.9, 0.6, 1.4)),
            ],
        ),
        d.Sphere(radius=9.0, flip_normals=True, bsdf=d.Diffuse(reflectance=0.1), emitter=d.Area(radiance=0.05)),
    ]
    camera = d.Perspective(
        fov=45.0, to_world=[d.TransformStep(look_at=d.LookAt(origin=(0.0, 1.5, 5.0), target=(0.0, 0.8, 0.0)))]
    )
    film = d.Film(width=48, height=40, filter=d.TentFilter())
    return d.Scene(
        shapes=shapes,
        camera=camera,
        film=film,
        emitters=[d.Constant(radiance=[0.3, 0.4, 0.6])],
        integrator=d.PathIntegrator(max_depth=10, rr_depth=3),
    )


@pytest.mark.parametrize("nee", [True, False])
def test_mixed_scene(nee):
    scene = mixed_scene()
    scene.integrator.nee = nee
    check(scene, spp=8)


@pytest.mark.parametrize("nee", [True, False])
def test_environment_map(tmp_path, nee):
    pixels = np.exp(np.random.default_rng(1).normal(size=(6, 10, 3))).astype(np.float32)
    write_exr(tmp_path / "sky.exr", {name: pixels[:, :, i] for i, name in enumerate("RGB")})
    scene = mixed_scene()
    scene.shapes = scene.shapes[:-1]  # but the sphere around everything
    scene.emitters = [d.Envmap(file=str(tmp_path / "sky.exr"), scale=0.7)]
    scene.integrator.nee = nee
    check(scene, spp=8)


@pytest.mark.parametrize("nee", [True, False])
def test_lights_from_afar_and_from_points(nee):
    """Two suns that overlap, and one of each light without extent, beside lamps and an environment."""
    scene = mixed_scene()
    scene.shapes = scene.shapes[:-1]
    for shape in scene.shapes:
        if shape.emitter is not None:
            shape.emitter = d.Area(radiance=shape.emitter.radiance, two_sided=True)
    scene.emitters += [
        d.Sun(direction=(0.3, -1.0, -0.2), angle=20.0, radiance=[3.0, 2.0, 1.0]),
        d.Directional(direction=(-1.0, -1.0, 0.0), irradiance=0.5),
        d.Point(position=(0.5, 2.0, 2.0), intensity=[0.5, 0.7, 0.9]),
        d.Sun(direction=(0.5, -1.0, -0.2), angle=10.0, irradiance=0.5),
        d.Spot(position=(0.0, 3.0, 0.0), direction=(0.0, -1.0, 0.1), intensity=3.0),
    ]
    scene.integrator.nee = nee
    check(scene, spp=8)


def test_spheres_and_environment_only():
    """No triangles, no textures, and lights that are spheres seen from outside, from inside and from close by."""
    scene = mixed_scene()
    shapes = [s for s in scene.shapes if isinstance(s, d.Sphere)]
    shapes[1] = msgspec.structs.replace(shapes[1], emitter=d.Area(radiance=[0.5, 3.0, 1.0]))
    shapes.append(d.Sphere(center=(0.0, -1000.0, 0.0), radius=1000.0, bsdf=d.Diffuse(reflectance=0.6)))
    scene.shapes = shapes[:-2] + shapes[-1:]
    check(scene, spp=8)


def test_scene_without_lights_is_black():
    scene = own("cornell-box")
    scene.shapes = [msgspec.structs.replace(shape, emitter=None) for shape in scene.shapes]
    renderer = Renderer(scene, threads=1)
    assert (renderer.render(2) == 0.0).all()
    assert (render_megakernel(renderer, 2) == 0.0).all()


@pytest.mark.parametrize("nee", [True, False])
def test_media(nee):
    """Everything in a haze, which a glass ball and a mask displace: what a path and a shadow ray travel in."""
    scene = mixed_scene()
    haze = d.Homogeneous(name="haze", sigma_a=[0.05, 0.02, 0.0])
    scene.media, scene.camera.medium = [haze], "haze"
    for i, shape in enumerate(scene.shapes):
        if i % 2 == 1:
            shape.exterior, shape.interior = "haze", d.Homogeneous(sigma_a=[0.3, 0.9, 0.1], scale=0.5 + i)
    scene.integrator.nee = nee
    check(scene, spp=8)
