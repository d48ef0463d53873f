"""What a dielectric coating does to diffuse light: constants of plastics, computed once when a scene is uploaded."""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from wavefront.bsdf.fresnel import fresnel_dielectric
from wavefront.bsdf.microfacet import sample_visible_normal, smith_g1
from wavefront.bsdf.rough_plastic import TABLE_SIZE
from wavefront.stage_kernel import stage_kernel

_NODES = 96  # of the quadrature over the unit square of a microfacet normal, in each direction


def diffuse_fresnel(eta: float) -> float:
    """Fraction of diffuse light that a smooth boundary reflects, from the side whose index is 1 / eta of the other's.

    2 times the integral of F(cos) cos over cos in [0, 1]. For eta < 1 the integrand has a kink where total reflection
    begins; there it follows from the other side, as what passes both ways is the same: (1 - R(1 / eta)) eta^2 passes.
    """
    if eta == 1.0:
        return 0.0
    if eta < 1.0:
        return 1.0 - (1.0 - diffuse_fresnel(1.0 / eta)) * eta * eta
    x, w = np.polynomial.legendre.leggauss(64)
    c = 0.5 * (x + 1.0)
    p = np.sqrt(eta * eta - 1.0 + c * c)
    r_s, r_p = (c - p) / (c + p), (eta * eta * c - p) / (eta * eta * c + p)
    return float(np.sum(w * c * 0.5 * (r_s**2 + r_p**2)))


@stage_kernel
def _integrate_coating(
    eta: float,
    alpha: wp.vec2,
    distribution: int,
    nodes: int,
    # out
    transmittance: wp.array[wp.float32],
    internal_reflectance: wp.array[wp.float32],
):
    """Midpoints over the numbers that a visible normal is made from: the mean of what one normal lets through."""
    i = wp.tid()
    cos_o = wp.max(float(i) / float(TABLE_SIZE - 1), 1.0e-6)
    wo = wp.vec3(wp.sqrt((1.0 - cos_o) * (1.0 + cos_o)), 0.0, cos_o)
    passed = wp.float64(0.0)
    returned = wp.float64(0.0)
    for a in range(nodes):
        for b in range(nodes):
            u = wp.vec2((float(a) + 0.5) / float(nodes), (float(b) + 0.5) / float(nodes))
            m = sample_visible_normal(wo, alpha, distribution, u)
            c = wp.max(wp.dot(wo, m), 0.0)
            outside = fresnel_dielectric(c, eta)
            t = (c * outside.inv_eta + outside.cos_t) * m - outside.inv_eta * wo
            if t[2] < 0.0:
                passed += wp.float64(outside.transmittance * smith_g1(t, alpha, distribution))
            inside = fresnel_dielectric(c, 1.0 / eta)
            r = 2.0 * c * m - wo
            if r[2] > 0.0:
                returned += wp.float64(inside.reflectance * smith_g1(r, alpha, distribution))
    count = wp.float64(nodes * nodes)
    transmittance[i] = wp.float32(passed / count)
    internal_reflectance[i] = wp.float32(returned / count)


@functools.lru_cache(maxsize=256)
def rough_coating(eta: float, alpha: float, distribution: int) -> tuple[np.ndarray, float]:
    """Transmittance of a rough coating at `TABLE_SIZE` cosines from 0 to 1, and its internal reflectance.

    Both follow Mitsuba 3, so that images agree. A ray is reflected or refracted by one microfacet, and what another
    microfacet blocks is lost: T is the mean of (1 - F) G1 over visible normals. The internal reflectance is twice the
    plain mean of R(cos) cos over the same cosines, which is 1 to 2 % below the integral (the ends count in full).
    """
    out = [wp.empty(int(TABLE_SIZE), dtype=wp.float32, device="cpu") for _ in range(2)]
    wp.launch(
        _integrate_coating,
        dim=int(TABLE_SIZE),
        inputs=[eta, wp.vec2(alpha), distribution, _NODES],
        outputs=out,
        device="cpu",
    )
    transmittance, reflectance = (array.numpy().astype(np.float64) for array in out)
    cosines = np.arange(int(TABLE_SIZE)) / (int(TABLE_SIZE) - 1)
    return transmittance, float(2.0 * np.mean(reflectance * cosines))
