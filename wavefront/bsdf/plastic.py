"""Plastic: a diffuse base below a smooth dielectric coating, one-sided.

The coating mirrors a fraction F(wo) as a delta direction. The rest enters, is scattered by the base with reflectance
`diffuse`, and meets the coating again from inside, where the fraction `internal_reflectance` of diffuse light returns
to the base. The sum over all bounces gives (as `plastic` of Mitsuba 3; compare Wolff 1994, "Diffuse-Reflectance Model
for Smooth Dielectric Surfaces")
    f = (1 - F(wo)) (1 - F(wi)) base / (pi eta^2),    base = diffuse / (1 - diffuse internal_reflectance).
With `nonlinear` off the denominator is 1 - internal_reflectance: colours do not saturate by bounces inside, and less
light returns. A white base absorbs nothing either way, since 1 - internal = (1 - external) / eta^2.
"""

import warp as wp

from wavefront.bsdf.fresnel import fresnel_dielectric
from wavefront.bsdf.record import BsdfEval, BsdfSample, no_eval, no_sample
from wavefront.warp_samples import cosine_hemisphere_pdf, square_to_cosine_hemisphere


@wp.func
def coated_base(diffuse: wp.vec3, eta: float, internal_reflectance: float, nonlinear: int) -> wp.vec3:
    """base / eta^2: the reflectance of the base and all that bounces between it and the coating."""
    loop = wp.vec3(internal_reflectance)
    if nonlinear == 1:
        loop = internal_reflectance * diffuse
    return wp.cw_div(diffuse, wp.vec3(1.0) - loop) / (eta * eta)


@wp.func
def coating_probability(diffuse: wp.vec3, specular: wp.vec3, reflected: float, transmitted: float) -> float:
    """Probability with which the coating is sampled, else the base: by what each reflects, roughly.

    `reflected` and `transmitted` are the fractions of light at the coating, which sum to one or (rough coatings) less.
    """
    s = reflected * (specular[0] + specular[1] + specular[2])
    d = transmitted * (diffuse[0] + diffuse[1] + diffuse[2])
    total = s + d
    return wp.where(total > 0.0, s / total, 0.0)


@wp.func
def sample_plastic(
    diffuse: wp.vec3,
    specular_reflectance: wp.vec3,
    eta: float,
    internal_reflectance: float,
    nonlinear: int,
    wo: wp.vec3,
    u: wp.vec3,
) -> BsdfSample:
    """The mirror direction as a delta, or the base by its cosine; each weight contains its probability."""
    result = no_sample()
    if wo[2] > 0.0:
        o = fresnel_dielectric(wo[2], eta)
        p = coating_probability(diffuse, specular_reflectance, o.reflectance, o.transmittance)
        if u[2] < p:
            result.wi = wp.vec3(-wo[0], -wo[1], wo[2])
            result.weight = (o.reflectance / p) * specular_reflectance
        else:
            wi = square_to_cosine_hemisphere(wp.vec2(u[0], u[1]))
            if wi[2] > 0.0 and p < 1.0:
                i = fresnel_dielectric(wi[2], eta)
                base = coated_base(diffuse, eta, internal_reflectance, nonlinear)
                result.wi = wi
                result.weight = (o.transmittance * i.transmittance / (1.0 - p)) * base
                result.pdf = (1.0 - p) * cosine_hemisphere_pdf(wi)
    return result


@wp.func
def eval_plastic(
    diffuse: wp.vec3,
    specular_reflectance: wp.vec3,
    eta: float,
    internal_reflectance: float,
    nonlinear: int,
    wo: wp.vec3,
    wi: wp.vec3,
) -> BsdfEval:
    """The base alone; its density contains the probability that the base is sampled."""
    result = no_eval()
    if wo[2] > 0.0 and wi[2] > 0.0:
        o = fresnel_dielectric(wo[2], eta)
        i = fresnel_dielectric(wi[2], eta)
        p = coating_probability(diffuse, specular_reflectance, o.reflectance, o.transmittance)
        cosine = cosine_hemisphere_pdf(wi)
        result.pdf = (1.0 - p) * cosine
        result.value = (o.transmittance * i.transmittance * cosine) * coated_base(
            diffuse, eta, internal_reflectance, nonlinear
        )
    return result
