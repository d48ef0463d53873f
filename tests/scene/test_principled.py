"""Principled materials from records to the device: indices of refraction, kinds, features, and textures."""

import numpy as np
import pytest

from wavefront import Renderer
from wavefront.bsdf.tables import PRINCIPLED_FRACTIONS
from wavefront.scene import description as d
from wavefront.scene.device import upload_scene


def with_bsdf(*bsdfs):
    return d.Scene(shapes=[d.Rectangle(bsdf=bsdf) for bsdf in bsdfs], emitters=[d.Constant()])


@pytest.mark.parametrize(
    ("fields", "eta"),
    [
        ({}, 1.5),
        ({"specular": 1.0}, 2.0 / (1.0 - np.sqrt(0.08)) - 1.0),
        ({"specular": 0.0}, 1.0),
        ({"eta": 1.0}, 1.0),
        ({"eta": 0.6}, 0.6),
        # What transmits must refract: as Mitsuba, which moves the index off 1.
        ({"eta": 1.0, "spec_trans": 0.5}, 1.001),
        ({"specular": 0.0, "spec_trans": 0.5}, 2.0 / (1.0 - np.sqrt(0.08e-3)) - 1.0),
        ({"specular": 0.0, "spec_trans": d.Checkerboard(color0=0.0, color1=1.0)}, 2.0 / (1.0 - np.sqrt(0.08e-3)) - 1.0),
    ],
)
def test_index_of_refraction(fields, eta):
    """The reflectance at normal incidence, ((eta - 1) / (eta + 1))^2, is 0.08 specular."""
    record = upload_scene(with_bsdf(d.Principled(**fields)), "cpu").materials.principled.numpy()[0]
    assert record["eta"] == pytest.approx(eta, rel=1e-6)
    if "eta" not in fields and "spec_trans" not in fields:
        assert ((eta - 1.0) / (eta + 1.0)) ** 2 == pytest.approx(0.08 * fields.get("specular", 0.5), abs=1e-6)


def test_what_a_scene_requires():
    """Transmission, and tangents, are there where some material uses them."""
    plain, glass = d.Principled(roughness=0.3), d.Principled(spec_trans=0.5)
    brushed = d.Principled(anisotropic=0.5)
    checks = d.Checkerboard(color0=0.0, color1=1.0)
    for bsdfs, kinds, transmission, tangents in (
        ([plain], ("principled",), False, False),
        ([d.TwoSided(front=plain, back=d.Diffuse())], ("diffuse", "principled"), False, False),
        ([glass], ("principled_transmissive",), True, False),
        ([plain, glass], ("principled", "principled_transmissive"), True, False),
        ([brushed], ("principled",), False, True),
        ([d.Principled(anisotropic=checks)], ("principled",), False, True),
        ([d.Mask(bsdf=d.Principled(spec_trans=checks))], ("principled_transmissive",), True, False),
    ):
        features = Renderer(with_bsdf(*bsdfs), threads=1).features
        assert (features.bsdfs, features.transmission, features.tangents) == (kinds, transmission, tangents)


def stage(left: d.Principled, right: d.Principled) -> d.Scene:
    """Two panels before the camera, with texture coordinates that a checkerboard divides in halves."""
    shapes = [
        d.Rectangle(bsdf=bsdf, to_world=[d.TransformStep(scale=0.5), d.TransformStep(translate=(x, 0.0, 0.0))])
        for bsdf, x in ((left, -0.5), (right, 0.5))
    ]
    shapes.append(
        d.Rectangle(
            emitter=d.Area(radiance=[9.0, 8.0, 7.0], two_sided=True),
            to_world=[d.TransformStep(scale=0.4), d.TransformStep(translate=(0.3, 0.2, 2.5))],
        )
    )
    camera = d.Perspective(
        fov=30.0, to_world=[d.TransformStep(look_at=d.LookAt(origin=(1.0, 0.5, 2.0), target=(0, 0, 0)))]
    )
    return d.Scene(
        shapes=shapes,
        camera=camera,
        film=d.Film(width=24, height=12, aovs=["albedo"]),
        emitters=[d.Constant(radiance=[0.3, 0.4, 0.6])],
        integrator=d.PathIntegrator(max_depth=4),
    )


LOW = dict(zip(PRINCIPLED_FRACTIONS, (0.3, 0.2, 0.1, 0.4, 0.6, 0.7, 0.25, 0.45, 0.8, 0.35), strict=True))
HIGH = dict(zip(PRINCIPLED_FRACTIONS, (0.7, 0.6, 0.5, 0.9, 0.1, 0.3, 0.85, 0.15, 0.3, 0.95), strict=True))


def test_textures():
    """A panel whose parameters are all textures is the panel of their values; half a checkerboard is one colour."""
    colors = {"base_color": [0.8, 0.5, 0.2]}, {"base_color": [0.1, 0.3, 0.7]}
    left, right = (d.Principled(**fields, **color) for fields, color in zip((LOW, HIGH), colors, strict=True))

    def textured(shift):
        """color0 on the whole panel, or color1: a unit of its uv is a quarter of a period."""
        return d.Principled(
            **{
                name: d.Checkerboard(
                    color0=getattr(left, name),
                    color1=getattr(right, name),
                    uv_transform=((0.25, 0.0, 0.1 + shift), (0.0, 0.25, 0.1)),
                )
                for name in ("base_color", *PRINCIPLED_FRACTIONS)
            }
        )

    images = []
    for bsdfs in ((left, right), (textured(0.0), textured(0.5))):
        renderer = Renderer(stage(*bsdfs), threads=1, seed=4)
        images.append((renderer.render(8), renderer.film.channels()))
    (constant, albedo), (looked_up, albedo_looked_up) = images
    assert constant.max() > 0.1
    np.testing.assert_allclose(looked_up, constant, rtol=2e-4, atol=1e-6)
    for name in albedo:
        if name.startswith("albedo"):
            np.testing.assert_allclose(albedo_looked_up[name], albedo[name], rtol=1e-5)
            assert albedo[name].max() > 0.05
