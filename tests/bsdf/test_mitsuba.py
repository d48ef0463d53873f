"""Values and densities against Mitsuba 3, and its named materials."""

import itertools

import numpy as np
import pytest

from tests.bsdf import harness
from wavefront.scene.ior import CONDUCTORS, INDEX_OF_REFRACTION

mi = pytest.importorskip("mitsuba")
mi.set_variant("scalar_rgb")
mi.set_log_level(mi.LogLevel.Error)

PAIRS = 1500
# Mitsuba approximates G1 of Beckmann by a rational function, Walter et al. 2007, which is off by less than 0.4 %; the
# value has two factors G1, the density one.
TOLERANCE = {0: (1e-4, 1e-4), 1: (8e-3, 4e-3)}


def mitsuba_eval(bsdf, wo: np.ndarray, wi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mitsuba calls the viewer's direction wi and the other one wo."""
    si = mi.SurfaceInteraction3f()
    context = mi.BSDFContext()
    values, pdfs = [], []
    for o, i in zip(wo.tolist(), wi.tolist(), strict=True):
        si.wi = o
        values.append(np.array(bsdf.eval(context, si, i)))
        pdfs.append(bsdf.pdf(context, si, i))
    return np.array(values), np.array(pdfs)


def pairs(name: str, p, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random directions, half of them sampled, so that narrow lobes are met."""
    wo = harness.random_directions(PAIRS, seed)
    wi = harness.random_directions(PAIRS, seed + 1)
    s = harness.sample(name, p, wo, harness.uniforms(PAIRS, seed + 2))
    wi[::2] = s.wi[::2]
    # Grazing directions: both renderers round the half vector there, each in its own way.
    clear = np.minimum(np.abs(wo[:, 2]), np.abs(wi[:, 2])) > 0.02
    return wo[clear], wi[clear]


def compare(ours: harness.Eval, value: np.ndarray, pdf: np.ndarray, distribution: int) -> None:
    value_tolerance, pdf_tolerance = TOLERANCE[distribution]
    assert np.count_nonzero(pdf) > 0.2 * len(pdf)
    np.testing.assert_allclose(ours.value, value, rtol=value_tolerance, atol=1e-6)
    np.testing.assert_allclose(ours.pdf, pdf, rtol=pdf_tolerance, atol=1e-6)


def alphas(alpha) -> dict:
    return dict(zip(("alpha_u", "alpha_v"), np.broadcast_to(alpha, 2).tolist(), strict=True))


def test_diffuse():
    p = harness.parameters((0.9, 0.5, 0.1))
    bsdf = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.9, 0.5, 0.1]}})
    wo, wi = pairs("diffuse", p, 1)
    compare(harness.evaluate("diffuse", p, wo, wi), *mitsuba_eval(bsdf, wo, wi), 0)


@pytest.mark.parametrize(("distribution", "name"), [(0, "ggx"), (1, "beckmann")])
@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0, (0.1, 0.5)])
def test_rough_conductor(alpha, distribution, name):
    eta, k = CONDUCTORS["Au"]
    p = harness.parameters((0.9, 0.5, 0.1), eta=eta, k=k, alpha=alpha, distribution=distribution)
    bsdf = mi.load_dict({
        "type": "roughconductor", "material": "Au", **alphas(alpha), "distribution": name,
        "specular_reflectance": {"type": "rgb", "value": [0.9, 0.5, 0.1]},
    })  # fmt: skip
    wo, wi = pairs("rough_conductor", p, 10)
    compare(harness.evaluate("rough_conductor", p, wo, wi), *mitsuba_eval(bsdf, wo, wi), distribution)


@pytest.mark.parametrize(("distribution", "name"), [(0, "ggx"), (1, "beckmann")])
@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0, (0.5, 0.1)])
@pytest.mark.parametrize(("int_ior", "ext_ior"), [(1.5046, 1.000277), (1.0, 2.419)])
def test_rough_dielectric(alpha, distribution, name, int_ior, ext_ior):
    p = harness.parameters(
        (0.9, 0.5, 0.1), (0.2, 0.7, 1.0), ior=int_ior / ext_ior, alpha=alpha, distribution=distribution
    )
    bsdf = mi.load_dict({
        "type": "roughdielectric", "int_ior": int_ior, "ext_ior": ext_ior, **alphas(alpha), "distribution": name,
        "specular_reflectance": {"type": "rgb", "value": [0.9, 0.5, 0.1]},
        "specular_transmittance": {"type": "rgb", "value": [0.2, 0.7, 1.0]},
    })  # fmt: skip
    wo, wi = pairs("rough_dielectric", p, 20)
    # Where a direction grazes its microfacet, Fresnel's transmittance amplifies the rounding of the cosine: there
    # Mitsuba is off by up to 6e-4 of a value in float64.
    n = np.where(wo[:, 2:] > 0.0, int_ior / ext_ior, ext_ior / int_ior)
    h = wo + np.where(wo[:, 2:] * wi[:, 2:] > 0.0, 1.0, n) * wi
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    clear = np.minimum(np.abs(np.sum(h * wo, axis=1)), np.abs(np.sum(h * wi, axis=1))) > 0.05
    wo, wi = wo[clear], wi[clear]
    compare(harness.evaluate("rough_dielectric", p, wo, wi), *mitsuba_eval(bsdf, wo, wi), distribution)


def plastic_dict(kind, nonlinear, **fields):
    return {
        "type": kind, "int_ior": 1.5, "ext_ior": 1.0, "nonlinear": nonlinear,
        "diffuse_reflectance": {"type": "rgb", "value": [0.9, 0.5, 0.1]},
        "specular_reflectance": {"type": "rgb", "value": [0.3, 0.6, 1.0]}, **fields,
    }  # fmt: skip


def compare_plastics(name, p, bsdf, seed, value_tolerance, pdf_tolerance):
    """Above the surface. Mitsuba's sampling weight is the same ratio of the means of the reflectances."""
    wo, wi = pairs(name, p, seed)
    wo[:, 2], wi[:, 2] = np.abs(wo[:, 2]), np.abs(wi[:, 2])
    ours = harness.evaluate(name, p, wo, wi)
    value, pdf = mitsuba_eval(bsdf, wo, wi)
    assert np.all(pdf > 0.0)
    np.testing.assert_allclose(ours.value, value, rtol=value_tolerance)
    np.testing.assert_allclose(ours.pdf, pdf, rtol=pdf_tolerance)


@pytest.mark.parametrize("nonlinear", [False, True])
def test_plastic(nonlinear):
    """Mitsuba's internal reflectance is a polynomial fit, 0.0005 above the integral: 0.12 % of the value."""
    p = harness.parameters((0.3, 0.6, 1.0), diffuse=(0.9, 0.5, 0.1), nonlinear=nonlinear)
    bsdf = mi.load_dict(plastic_dict("plastic", nonlinear))
    compare_plastics("plastic", p, bsdf, 30, 1.3e-3, 1e-4)
    for cos_o in (1.0, 0.4, 0.05):
        wo = harness.direction(cos_o)
        si = mi.SurfaceInteraction3f()
        si.wi = wo.tolist()
        ours = harness.sample("plastic", p, wo, np.array([[0.5, 0.5, 0.0]]))
        theirs, weight = bsdf.sample(mi.BSDFContext(), si, 0.0, [0.5, 0.5])
        assert ours.pdf[0] == 0.0
        np.testing.assert_allclose(ours.wi[0], np.array(theirs.wo), atol=1e-6)
        np.testing.assert_allclose(ours.weight[0], np.array(weight), rtol=1e-4)


@pytest.mark.parametrize(("distribution", "name"), [(0, "ggx"), (1, "beckmann")])
@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("nonlinear", [False, True])
def test_rough_plastic(alpha, distribution, name, nonlinear):
    """Tables of Mitsuba's quadrature and ours differ by up to 0.001, of T from 0.2 at grazing angles to 0.96."""
    p = harness.parameters(
        (0.3, 0.6, 1.0), diffuse=(0.9, 0.5, 0.1), nonlinear=nonlinear,
        alpha=alpha, distribution=distribution, coating="rough",
    )  # fmt: skip
    bsdf = mi.load_dict(plastic_dict("roughplastic", nonlinear, alpha=alpha, distribution=name))
    value_tolerance, pdf_tolerance = TOLERANCE[distribution]
    compare_plastics("rough_plastic", p, bsdf, 40, value_tolerance + 5e-3, pdf_tolerance + 5e-3)


def test_smooth_weights():
    """Delta directions: Mitsuba's samples of each lobe, weights included."""
    eta, k = CONDUCTORS["Cu"]
    conductor = mi.load_dict({"type": "conductor", "material": "Cu"})
    dielectrics = {
        name: mi.load_dict({"type": name.replace("_", ""), "int_ior": 1.5, "ext_ior": 1.0})
        for name in ("dielectric", "thin_dielectric")
    }
    context, si = mi.BSDFContext(), mi.SurfaceInteraction3f()
    for cos_o in (0.9, 0.2, -0.3, -0.9):
        wo = harness.direction(cos_o)
        si.wi = wo.tolist()
        ours = harness.sample("conductor", harness.parameters(eta=eta, k=k), wo, np.zeros((1, 3)))
        theirs, weight = conductor.sample(context, si, 0.5, [0.5, 0.5])
        np.testing.assert_allclose(ours.weight[0], np.array(weight), rtol=1e-5)
        if cos_o > 0.0:
            np.testing.assert_allclose(ours.wi[0], np.array(theirs.wo), atol=1e-6)
        for (name, dielectric), u in itertools.product(dielectrics.items(), (0.0, 0.999)):
            ours = harness.sample(name, harness.parameters(ior=1.5), wo, np.array([[0.5, 0.5, u]]))
            theirs, weight = dielectric.sample(context, si, u, [0.5, 0.5])
            np.testing.assert_allclose(ours.weight[0], np.array(weight), rtol=1e-5)
            np.testing.assert_allclose(ours.wi[0], np.array(theirs.wo), atol=1e-6)
            np.testing.assert_allclose(ours.eta[0], theirs.eta, rtol=1e-6)


def test_named_dielectrics():
    for name, ior in INDEX_OF_REFRACTION.items():
        parameters = mi.traverse(mi.load_dict({"type": "dielectric", "int_ior": name, "ext_ior": 1.0}))
        assert parameters["eta"] == pytest.approx(ior, rel=1e-6), name
    with pytest.raises(RuntimeError, match="Valid choices are") as error:
        mi.load_dict({"type": "dielectric", "int_ior": "unobtainium"})
    names = str(error.value).split("Valid choices are:")[1].split(", ")
    assert {n.strip() for n in names} == set(INDEX_OF_REFRACTION)


def test_named_conductors():
    for name, (eta, k) in CONDUCTORS.items():
        if name == "none":
            continue
        parameters = mi.traverse(mi.load_dict({"type": "conductor", "material": name}))
        np.testing.assert_allclose(np.array(parameters["eta.value"]), eta, rtol=1e-5, atol=1e-7, err_msg=name)
        np.testing.assert_allclose(np.array(parameters["k.value"]), k, rtol=1e-5, atol=1e-7, err_msg=name)
