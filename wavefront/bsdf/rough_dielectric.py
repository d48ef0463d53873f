"""Boundary between two dielectrics with a microfacet surface (Walter et al. 2007), both sides.

eta = n_interior / n_exterior, the normal points to the exterior. Inside the functions the viewer is always above:
for wo.z < 0 the frame is mirrored at the surface and eta replaced by 1 / eta, which changes nothing for a microfacet
surface. From then on eta = n_wi / n_wo for transmission.

A visible normal is sampled, and reflection with probability F. With pdf_m = D G1(wo) (wo.m) / cos(wo)
    reflection    pdf = F pdf_m / (4 wo.m)
    transmission  pdf = (1 - F) pdf_m eta^2 |wi.m| / |h|^2,   h = wo + eta wi = (wo.m + eta wi.m) m
(Walter et al., equations 14 and 17). In both cases f |cos(wi)| = pdf G1(wi) tint, and transmitted radiance scales
with 1 / eta^2. So the weight is G1(wi) tint, or G1(wi) tint / eta^2.

For eta = 1 nothing refracts: the boundary is invisible, and light passes as a delta direction.
"""

import warp as wp

from wavefront.bsdf.fresnel import fresnel_dielectric, fresnel_refracting
from wavefront.bsdf.microfacet import microfacet_d, sample_visible_normal, smith_g1, smith_g1_over_cos
from wavefront.bsdf.record import BsdfEval, BsdfSample, no_eval, no_sample


@wp.func
def sample_rough_dielectric(
    eta: float,
    specular_reflectance: wp.vec3,
    specular_transmittance: wp.vec3,
    alpha: wp.vec2,
    distribution: int,
    wo: wp.vec3,
    u: wp.vec3,
) -> BsdfSample:
    result = no_sample()
    if eta == 1.0:
        result.wi = -wo
        result.weight = specular_transmittance
    elif wo[2] != 0.0:
        side = wp.where(wo[2] > 0.0, 1.0, -1.0)
        o = wp.vec3(wo[0], wo[1], wp.abs(wo[2]))
        m = sample_visible_normal(o, alpha, distribution, wp.vec2(u[0], u[1]))
        cos_m = wp.max(wp.dot(o, m), 0.0)
        # The sign of the cosine tells the side, hence the ratio of indices.
        fresnel = fresnel_dielectric(side * cos_m, eta)
        density = microfacet_d(m, alpha, distribution) * smith_g1_over_cos(o, alpha, distribution)
        if u[2] < fresnel.reflectance:
            i = 2.0 * cos_m * m - o
            pdf = 0.25 * fresnel.reflectance * density
            if i[2] > 0.0 and pdf > 0.0:
                result.wi = wp.vec3(i[0], i[1], side * i[2])
                result.weight = smith_g1(i, alpha, distribution) * specular_reflectance
                result.pdf = pdf
        else:
            n = fresnel.eta
            cos_t = wp.abs(fresnel.cos_t)
            i = (cos_m * fresnel.inv_eta - cos_t) * m - fresnel.inv_eta * o
            # |h| = |wo.m - n cos_t| without the cancellation: the squares differ by 1 - n^2 (Snell's law).
            h = (n - 1.0) * (n + 1.0) / (cos_m + n * cos_t)
            jacobian = n * n * cos_t / (h * h)
            pdf = fresnel.transmittance * density * cos_m * jacobian
            if i[2] < 0.0 and pdf > 0.0:
                result.wi = wp.vec3(i[0], i[1], side * i[2])
                result.weight = (
                    smith_g1(i, alpha, distribution) * fresnel.inv_eta * fresnel.inv_eta
                ) * specular_transmittance
                result.pdf = pdf
                result.eta = n
    return result


@wp.func
def eval_rough_dielectric(
    eta: float,
    specular_reflectance: wp.vec3,
    specular_transmittance: wp.vec3,
    alpha: wp.vec2,
    distribution: int,
    wo: wp.vec3,
    wi: wp.vec3,
) -> BsdfEval:
    result = no_eval()
    if eta != 1.0 and wo[2] != 0.0 and wi[2] != 0.0:
        side = wp.where(wo[2] > 0.0, 1.0, -1.0)
        n = wp.where(wo[2] > 0.0, eta, 1.0 / eta)
        o = wp.vec3(wo[0], wo[1], wp.abs(wo[2]))
        i = wp.vec3(wi[0], wi[1], side * wi[2])
        g1_over_cos = smith_g1_over_cos(o, alpha, distribution)
        g1 = smith_g1(i, alpha, distribution)
        if i[2] > 0.0:
            h = o + i
            length = wp.length(h)
            if length > 0.0:
                m = h / length
                fresnel = fresnel_dielectric(side * 0.5 * length, eta)
                result.pdf = 0.25 * fresnel.reflectance * microfacet_d(m, alpha, distribution) * g1_over_cos
                result.value = (result.pdf * g1) * specular_reflectance
        else:
            h = o + n * i
            length = wp.length(h)
            if length > 0.0:
                # m points to the side of wo; the half vector of a refraction points into the denser medium.
                m = h * (wp.where(h[2] < 0.0, -1.0, 1.0) / length)
                cos_o = wp.dot(o, m)
                cos_i = wp.dot(i, m)
                if cos_o > 0.0 and cos_i < 0.0:
                    # Both cosines are known: near the critical angle that is better than Snell's law from one of them.
                    split = fresnel_refracting(cos_o, -n * cos_i, n, (n - 1.0) * (n + 1.0))
                    density = microfacet_d(m, alpha, distribution) * g1_over_cos * cos_o
                    jacobian = n * n * wp.abs(cos_i) / (length * length)
                    result.pdf = split[1] * density * jacobian
                    result.value = (result.pdf * g1 / (n * n)) * specular_transmittance
    return result
