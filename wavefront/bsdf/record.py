"""What a BSDF answers.

Directions are unit vectors in the local shading frame (z is the shading normal) that point away from the surface:
`wo` towards the viewer, `wi` towards where the light comes from. Every BSDF file offers

    sample_NAME(parameters..., wo, u) -> BsdfSample     u: three uniform numbers; u.x, u.y direction, u.z lobe
    eval_NAME(parameters..., wo, wi) -> BsdfEval        absent where all directions are delta directions

`u` is in [0, 1)^3. A weight of zero ends the path: the sample fell below the surface or was absorbed.
"""

import warp as wp


@wp.struct
class BsdfSample:
    """A sampled direction."""

    wi: wp.vec3
    weight: wp.vec3  # f |cos(wi)| / pdf, or zero
    pdf: float  # solid angle; 0 means a delta direction
    eta: float  # n_transmitted / n_incident of the boundary that was crossed, seen from wo; 1 for reflection


@wp.struct
class BsdfEval:
    """A BSDF and its sampling density for given directions; delta directions are left out of both."""

    value: wp.vec3  # f |cos(wi)|
    pdf: float  # solid angle


@wp.func
def no_sample() -> BsdfSample:
    """A sample that ends the path. The direction is a unit vector all the same, so that nobody normalises zero."""
    s = BsdfSample()
    s.wi = wp.vec3(0.0, 0.0, 1.0)
    s.weight = wp.vec3(0.0, 0.0, 0.0)
    s.pdf = 0.0
    s.eta = 1.0
    return s


@wp.func
def no_eval() -> BsdfEval:
    e = BsdfEval()
    e.value = wp.vec3(0.0, 0.0, 0.0)
    e.pdf = 0.0
    return e
