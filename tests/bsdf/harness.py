"""Runs the BSDF functions over arrays.

`SAMPLERS` and `EVALUATORS` hold one kernel per BSDF, all with the same interface, so that a test is written once for
every BSDF. The kernels of this file form one module, which is compiled once for all tests.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from wavefront.bsdf.coating import diffuse_fresnel, rough_coating
from wavefront.bsdf.conductor import sample_conductor
from wavefront.bsdf.dielectric import sample_dielectric
from wavefront.bsdf.diffuse import eval_diffuse, sample_diffuse
from wavefront.bsdf.fresnel import fresnel_conductor, fresnel_dielectric
from wavefront.bsdf.microfacet import (
    microfacet_d,
    sample_visible_normal,
    smith_g1,
    visible_normal_pdf,
)
from wavefront.bsdf.null import sample_null
from wavefront.bsdf.oren_nayar import eval_oren_nayar, sample_oren_nayar
from wavefront.bsdf.plastic import eval_plastic, sample_plastic
from wavefront.bsdf.principled import PrincipledParameters, make_principled
from wavefront.bsdf.record import BsdfEval, BsdfSample
from wavefront.bsdf.rough_conductor import eval_rough_conductor, sample_rough_conductor
from wavefront.bsdf.rough_dielectric import eval_rough_dielectric, sample_rough_dielectric
from wavefront.bsdf.rough_plastic import eval_rough_plastic, sample_rough_plastic
from wavefront.bsdf.thin_dielectric import sample_thin_dielectric

DEVICE = "cpu"
LARGEST_UNIFORM = 1.0 - 2.0**-24


Fresnel5 = wp.types.vector(length=5, dtype=wp.float32)


@wp.struct
class Parameters:
    """Parameters of every BSDF under test; each reads its own."""

    reflectance: wp.vec3
    transmittance: wp.vec3
    eta: wp.vec3
    k: wp.vec3
    ior: float
    alpha: wp.vec2
    distribution: int
    diffuse: wp.vec3
    internal: float
    nonlinear: int
    table: wp.array[wp.float32]
    principled: PrincipledParameters


eval_principled, sample_principled = make_principled(True)
eval_opaque, sample_opaque = make_principled(False)


@wp.func
def call_sample_diffuse(p: Parameters, wo: wp.vec3, u: wp.vec3):
    return sample_diffuse(p.reflectance, wo, u)


@wp.func
def call_sample_conductor(p: Parameters, wo: wp.vec3, u: wp.vec3):
    return sample_conductor(p.eta, p.k, p.reflectance, wo, u)


@wp.func
def call_sample_rough_conductor(p: Parameters, wo: wp.vec3, u: wp.vec3):
    return sample_rough_conductor(p.eta, p.k, p.reflectance, p.alpha, p.distribution, wo, u)


@wp.func
def call_sample_dielectric(p: Parameters, wo: wp.vec3, u: wp.vec3):
    return sample_dielectric(p.ior, p.reflectance, p.transmittance, wo, u)


@wp.func
def call_sample_rough_dielectric(p: Parameters, wo: wp.vec3, u: wp.vec3):
    return sample_rough_dielectric(p.ior, p.reflectance, p.transmittance, p.alpha, p.distribution, wo, u)


@wp.func
def call_sample_thin_dielectric(p: Parameters, wo: wp.vec3, u: wp.vec3):
    return sample_thin_dielectric(p.ior, p.reflectance, p.transmittance, wo, u)


@wp.func
def call_sample_null(p: Parameters, wo: wp.vec3, u: wp.vec3):
    return sample_null(wo)


@wp.func
def call_sample_oren_nayar(p: Parameters, wo: wp.vec3, u: wp.vec3):
    return sample_oren_nayar(p.reflectance, p.alpha[0], wo, u)


@wp.func
def call_eval_oren_nayar(p: Parameters, wo: wp.vec3, wi: wp.vec3):
    return eval_oren_nayar(p.reflectance, p.alpha[0], wo, wi)


@wp.func
def call_sample_plastic(p: Parameters, wo: wp.vec3, u: wp.vec3):
    return sample_plastic(p.diffuse, p.reflectance, p.ior, p.internal, p.nonlinear, wo, u)


@wp.func
def call_sample_rough_plastic(p: Parameters, wo: wp.vec3, u: wp.vec3):
    return sample_rough_plastic(
        p.diffuse, p.reflectance, p.ior, p.internal, p.nonlinear, p.alpha, p.distribution, p.table, 0, wo, u
    )


@wp.func
def call_eval_plastic(p: Parameters, wo: wp.vec3, wi: wp.vec3):
    return eval_plastic(p.diffuse, p.reflectance, p.ior, p.internal, p.nonlinear, wo, wi)


@wp.func
def call_eval_rough_plastic(p: Parameters, wo: wp.vec3, wi: wp.vec3):
    return eval_rough_plastic(
        p.diffuse, p.reflectance, p.ior, p.internal, p.nonlinear, p.alpha, p.distribution, p.table, 0, wo, wi
    )


@wp.func
def call_eval_diffuse(p: Parameters, wo: wp.vec3, wi: wp.vec3):
    return eval_diffuse(p.reflectance, wo, wi)


@wp.func
def call_eval_rough_conductor(p: Parameters, wo: wp.vec3, wi: wp.vec3):
    return eval_rough_conductor(p.eta, p.k, p.reflectance, p.alpha, p.distribution, wo, wi)


@wp.func
def call_eval_rough_dielectric(p: Parameters, wo: wp.vec3, wi: wp.vec3):
    return eval_rough_dielectric(p.ior, p.reflectance, p.transmittance, p.alpha, p.distribution, wo, wi)


@wp.func
def call_sample_principled(p: Parameters, wo: wp.vec3, u: wp.vec3):
    return sample_principled(p.principled, wo, u)


@wp.func
def call_sample_opaque(p: Parameters, wo: wp.vec3, u: wp.vec3):
    return sample_opaque(p.principled, wo, u)


@wp.func
def call_eval_principled(p: Parameters, wo: wp.vec3, wi: wp.vec3):
    return eval_principled(p.principled, wo, wi)


@wp.func
def call_eval_opaque(p: Parameters, wo: wp.vec3, wi: wp.vec3):
    return eval_opaque(p.principled, wo, wi)


def _sample_kernel(function):
    @wp.kernel(enable_backward=False, module="unique")
    def sample_kernel(
        p: Parameters,
        wo: wp.array(dtype=wp.vec3),
        u: wp.array(dtype=wp.vec3),
        # outputs
        samples: wp.array(dtype=BsdfSample),
    ):
        i = wp.tid()
        samples[i] = function(p, wo[i], u[i])

    return sample_kernel


def _eval_kernel(function):
    @wp.kernel(enable_backward=False, module="unique")
    def eval_kernel(
        p: Parameters,
        wo: wp.array(dtype=wp.vec3),
        wi: wp.array(dtype=wp.vec3),
        # outputs
        evals: wp.array(dtype=BsdfEval),
    ):
        i = wp.tid()
        evals[i] = function(p, wo[i], wi[i])

    return eval_kernel


_SAMPLE_KERNELS = {
    "diffuse": _sample_kernel(call_sample_diffuse),
    "conductor": _sample_kernel(call_sample_conductor),
    "rough_conductor": _sample_kernel(call_sample_rough_conductor),
    "dielectric": _sample_kernel(call_sample_dielectric),
    "rough_dielectric": _sample_kernel(call_sample_rough_dielectric),
    "thin_dielectric": _sample_kernel(call_sample_thin_dielectric),
    "null": _sample_kernel(call_sample_null),
    "oren_nayar": _sample_kernel(call_sample_oren_nayar),
    "plastic": _sample_kernel(call_sample_plastic),
    "rough_plastic": _sample_kernel(call_sample_rough_plastic),
    "principled": _sample_kernel(call_sample_opaque),
    "principled_transmissive": _sample_kernel(call_sample_principled),
}
_EVAL_KERNELS = {
    "diffuse": _eval_kernel(call_eval_diffuse),
    "rough_conductor": _eval_kernel(call_eval_rough_conductor),
    "rough_dielectric": _eval_kernel(call_eval_rough_dielectric),
    "oren_nayar": _eval_kernel(call_eval_oren_nayar),
    "plastic": _eval_kernel(call_eval_plastic),
    "rough_plastic": _eval_kernel(call_eval_rough_plastic),
    "principled": _eval_kernel(call_eval_opaque),
    "principled_transmissive": _eval_kernel(call_eval_principled),
}


@wp.kernel(enable_backward=False, module="unique")
def _normals_kernel(
    wo: wp.array(dtype=wp.vec3),
    u: wp.array(dtype=wp.vec3),
    alpha: wp.vec2,
    distribution: int,
    # outputs
    m: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    m[i] = sample_visible_normal(wo[i], alpha, distribution, wp.vec2(u[i][0], u[i][1]))


@wp.kernel(enable_backward=False, module="unique")
def _terms_kernel(
    wo: wp.array(dtype=wp.vec3),
    m: wp.array(dtype=wp.vec3),
    alpha: wp.vec2,
    distribution: int,
    # outputs
    terms: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    terms[i] = wp.vec3(
        microfacet_d(m[i], alpha, distribution),
        smith_g1(wo[i], alpha, distribution),
        visible_normal_pdf(wo[i], m[i], alpha, distribution),
    )


@wp.kernel(enable_backward=False, module="unique")
def _fresnel_kernel(
    cos_i: wp.array(dtype=float),
    ior: float,
    eta: wp.vec3,
    k: wp.vec3,
    # outputs
    dielectric: wp.array(dtype=Fresnel5),
    conductor: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    f = fresnel_dielectric(cos_i[i], ior)
    dielectric[i] = Fresnel5(f.reflectance, f.cos_t, f.eta, f.inv_eta, f.transmittance)
    conductor[i] = fresnel_conductor(cos_i[i], eta, k)


PRINCIPLED = {
    "base_color": (0.5, 0.5, 0.5), "roughness": 0.5, "anisotropic": 0.0, "metallic": 0.0, "spec_trans": 0.0,
    "eta": 1.5, "spec_tint": 0.0, "sheen": 0.0, "sheen_tint": 0.0, "flatness": 0.0, "clearcoat": 0.0,
    "clearcoat_gloss": 0.0, "specular_rate": 1.0, "clearcoat_rate": 1.0, "diffuse_rate": 1.0,
}  # fmt: skip


@dataclass(frozen=True)
class Sample:
    wi: np.ndarray
    weight: np.ndarray
    pdf: np.ndarray
    eta: np.ndarray


@dataclass(frozen=True)
class Eval:
    value: np.ndarray
    pdf: np.ndarray


def parameters(
    reflectance=(1.0, 1.0, 1.0),
    transmittance=(1.0, 1.0, 1.0),
    eta=(0.0, 0.0, 0.0),
    k=(1.0, 1.0, 1.0),
    ior=1.5,
    alpha=0.1,
    distribution=0,
    diffuse=(1.0, 1.0, 1.0),
    nonlinear=False,
    coating="smooth",
    principled=None,
) -> Parameters:
    """White by default: a perfect mirror, or a boundary that absorbs nothing.

    `principled` holds fields of `PrincipledParameters`, as Mitsuba's defaults where they are not given.
    """
    p = Parameters()
    p.reflectance = wp.vec3(*reflectance)
    p.transmittance = wp.vec3(*transmittance)
    p.eta = wp.vec3(*eta)
    p.k = wp.vec3(*k)
    p.ior = float(ior)
    p.alpha = pair(alpha)
    p.distribution = int(distribution)
    p.diffuse = wp.vec3(*diffuse)
    p.nonlinear = int(nonlinear)
    p.internal = diffuse_fresnel(1.0 / float(ior))
    for name, value in (PRINCIPLED | (principled or {})).items():
        setattr(p.principled, name, wp.vec3(*value) if name == "base_color" else float(value))
    if coating == "rough":
        table, p.internal = rough_coating(float(ior), float(alpha), int(distribution))
        p.table = wp.array(table, dtype=wp.float32, device=DEVICE)
    else:
        p.table = wp.zeros(1, dtype=wp.float32, device=DEVICE)
    return p


def vectors(a, n: int) -> np.ndarray:
    """(n, 3) float32 from one direction or many."""
    return np.ascontiguousarray(np.broadcast_to(np.asarray(a, dtype=np.float32), (n, 3)))


def _in(a: np.ndarray) -> wp.array:
    return wp.array(a, dtype=wp.vec3, device=DEVICE)


def sample(name: str, p: Parameters, wo, u) -> Sample:
    n = len(u)
    out = wp.empty(n, dtype=BsdfSample, device=DEVICE)
    inputs = [p, _in(vectors(wo, n)), _in(vectors(u, n))]
    wp.launch(_SAMPLE_KERNELS[name], dim=n, inputs=inputs, outputs=[out], device=DEVICE)
    s = out.numpy()
    return Sample(s["wi"], s["weight"], s["pdf"], s["eta"])


def evaluate(name: str, p: Parameters, wo, wi) -> Eval:
    n = max(len(np.atleast_2d(wo)), len(np.atleast_2d(wi)))
    out = wp.empty(n, dtype=BsdfEval, device=DEVICE)
    inputs = [p, _in(vectors(wo, n)), _in(vectors(wi, n))]
    wp.launch(_EVAL_KERNELS[name], dim=n, inputs=inputs, outputs=[out], device=DEVICE)
    e = out.numpy()
    return Eval(e["value"], e["pdf"])


def pair(alpha) -> wp.vec2:
    """Roughness along x and y, from one number or two."""
    return wp.vec2(*np.broadcast_to(alpha, 2).astype(float))


def visible_normals(wo, alpha, distribution: int, u) -> np.ndarray:
    n = len(u)
    m = wp.empty(n, dtype=wp.vec3, device=DEVICE)
    inputs = [_in(vectors(wo, n)), _in(vectors(u, n)), pair(alpha), distribution]
    wp.launch(_normals_kernel, dim=n, inputs=inputs, outputs=[m], device=DEVICE)
    return m.numpy()


def microfacet_terms(wo, m, alpha, distribution: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """D(m), G1(wo), and the density of the visible normal m."""
    n = max(len(np.atleast_2d(wo)), len(np.atleast_2d(m)))
    terms = wp.empty(n, dtype=wp.vec3, device=DEVICE)
    inputs = [_in(vectors(wo, n)), _in(vectors(m, n)), pair(alpha), distribution]
    wp.launch(_terms_kernel, dim=n, inputs=inputs, outputs=[terms], device=DEVICE)
    d, g1, pdf = terms.numpy().T
    return d, g1, pdf


def fresnel(cos_i, ior: float = 1.5, eta=(0.0, 0.0, 0.0), k=(1.0, 1.0, 1.0)) -> tuple[np.ndarray, np.ndarray]:
    """Dielectric rows (reflectance, cos_t, eta, 1 / eta, transmittance), and conductor reflectances."""
    c = np.ascontiguousarray(cos_i, dtype=np.float32)
    dielectric = wp.empty(len(c), dtype=Fresnel5, device=DEVICE)
    conductor = wp.empty(len(c), dtype=wp.vec3, device=DEVICE)
    inputs = [wp.array(c, dtype=float, device=DEVICE), ior, wp.vec3(*eta), wp.vec3(*k)]
    wp.launch(_fresnel_kernel, dim=len(c), inputs=inputs, outputs=[dielectric, conductor], device=DEVICE)
    return dielectric.numpy(), conductor.numpy()


def direction(theta_cos: float, phi: float = 0.4) -> np.ndarray:
    """Unit vector with the given z, in float64."""
    s = np.sqrt(max(0.0, (1.0 - theta_cos) * (1.0 + theta_cos)))
    return np.array([s * np.cos(phi), s * np.sin(phi), theta_cos])


def uniforms(n: int, seed: int) -> np.ndarray:
    """(n, 3) multiples of 2^-24 in [0, 1), as the renderer makes them."""
    bits = np.random.default_rng(seed).integers(0, 2**24, size=(n, 3))
    return (bits * 2.0**-24).astype(np.float32)


def random_directions(n: int, seed: int, hemisphere: bool = False) -> np.ndarray:
    v = np.random.default_rng(seed).normal(size=(n, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    if hemisphere:
        v[:, 2] = np.abs(v[:, 2])
    return v.astype(np.float32)
