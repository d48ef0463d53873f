"""The principled BSDF in float64 NumPy, from the papers: Burley 2012 and 2015, and Mitsuba 3's parameters.

Every lobe is written by itself, for the pairs of directions that it applies to, with no factor shared between them.
"""

from __future__ import annotations

import numpy as np

from tests.bsdf import oracle
from tests.bsdf.harness import PRINCIPLED
from wavefront.film import LUMINANCE


def _ggx(m, ax, ay):
    return 1.0 / (np.pi * ax * ay * ((m[:, 0] / ax) ** 2 + (m[:, 1] / ay) ** 2 + m[:, 2] ** 2) ** 2)


def _g1(w, ax, ay):
    """Smith's masking by tan^2, of the roughness that the azimuth of w sees."""
    tan2 = ((ax * w[:, 0]) ** 2 + (ay * w[:, 1]) ** 2) / w[:, 2] ** 2
    return 2.0 / (1.0 + np.sqrt(1.0 + tan2))


def _gtr1(m, a):
    cos2 = m[:, 2] ** 2
    return (a**2 - 1.0) / (np.pi * np.log(a**2) * (1.0 + (a**2 - 1.0) * cos2))


def _dielectric(cos, eta):
    """Reflectance at a microfacet; total reflection is 1."""
    return oracle.fresnel(cos, eta)


def _schlick(cos):
    return np.clip(1.0 - cos, 0.0, 1.0) ** 5


def evaluate(fields: dict, wo: np.ndarray, wi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """f |cos(wi)| per channel, and the density of wi.

    Args:
        fields: Those of `PrincipledParameters` that differ from Mitsuba's defaults.
        wo, wi: [N, 3], away from the surface, on either side of it but not in its horizon.
    """
    q = PRINCIPLED | fields
    color = np.array(q["base_color"], np.float64)
    wo, wi = np.broadcast_arrays(np.asarray(wo, np.float64), np.asarray(wi, np.float64))
    value, pdf = np.zeros((len(wo), 3)), np.zeros(len(wo))
    aspect = np.sqrt(1.0 - 0.9 * q["anisotropic"])
    ax, ay = (max(0.001, a) for a in (q["roughness"] ** 2 / aspect, q["roughness"] ** 2 * aspect))
    metal, eta = q["metallic"], q["eta"]
    glass, base = (1.0 - metal) * q["spec_trans"], (1.0 - metal) * (1.0 - q["spec_trans"])
    weights = np.array([q["specular_rate"], 0.25 * q["clearcoat"] * q["clearcoat_rate"], base * q["diffuse_rate"]])
    p_main, p_coat, p_diffuse = weights / weights.sum()
    luminance = color @ np.array(LUMINANCE)
    tint = color / luminance if luminance > 0.0 else np.ones(3)

    # --- both above
    rows = (wo[:, 2] > 0.0) & (wi[:, 2] > 0.0)
    o, i = wo[rows], wi[rows]
    m = (o + i) / np.linalg.norm(o + i, axis=1, keepdims=True)
    cos_o, cos_i, cos_d = o[:, 2], i[:, 2], np.sum(o * m, axis=1)
    fresnel = _dielectric(cos_d, eta)
    # Schlick's angle is the one on the thinner side.
    thin = cos_d if eta >= 1.0 else np.sqrt(np.maximum(1.0 - (1.0 - cos_d**2) / eta**2, 0.0))
    s = _schlick(thin)[:, None]
    mirror = metal * (color + (1.0 - color) * s)
    r0 = tint * ((eta - 1.0) / (eta + 1.0)) ** 2
    tinted = (1.0 - metal) * q["spec_tint"] * (r0 + (1.0 - r0) * s)
    clear = ((1.0 - metal) * (1.0 - q["spec_tint"]) * fresnel)[:, None]
    d, g_o, g_i = _ggx(m, ax, ay), _g1(o, ax, ay), _g1(i, ax, ay)
    main = (mirror + tinted + clear) * (d * g_o * g_i / (4.0 * cos_o * cos_i))[:, None]

    fo, fi, retro = _schlick(cos_o), _schlick(cos_i), 2.0 * q["roughness"] * cos_d**2
    lambert = (1.0 - fo / 2.0) * (1.0 - fi / 2.0)
    back = retro * (fo + fi + fo * fi * (retro - 1.0))
    fss90 = q["roughness"] * cos_d**2
    fss = (1.0 + (fss90 - 1.0) * fo) * (1.0 + (fss90 - 1.0) * fi)
    flat = 1.25 * (fss * (1.0 / (cos_o + cos_i) - 0.5) + 0.5)
    diffuse = (1.0 - q["flatness"]) * (lambert + back) + q["flatness"] * flat
    diffuse = base / np.pi * diffuse[:, None] * color

    sheen = (1.0 - metal) * q["sheen"] * _schlick(cos_d)[:, None]
    sheen = sheen * ((1.0 - q["sheen_tint"]) + q["sheen_tint"] * tint)

    gloss = 0.1 + (0.001 - 0.1) * q["clearcoat_gloss"]
    coat_d = _gtr1(m, gloss)
    coat = 0.25 * q["clearcoat"] * (0.04 + 0.96 * s[:, 0]) * coat_d * _g1(o, 0.25, 0.25) * _g1(i, 0.25, 0.25)

    value[rows] = (main + diffuse + sheen + coat[:, None]) * cos_i[:, None]
    visible = g_o * d * cos_d / cos_o / (4.0 * cos_d)
    pdf[rows] = (
        p_main * (1.0 - glass * (1.0 - fresnel)) * visible
        + p_coat * coat_d * m[:, 2] / (4.0 * cos_d)
        + p_diffuse * cos_i / np.pi
    )

    # --- both below
    rows = (wo[:, 2] < 0.0) & (wi[:, 2] < 0.0)
    if glass > 0.0:
        o, i = wo[rows], wi[rows]
        m = -(o + i) / np.linalg.norm(o + i, axis=1, keepdims=True)
        cos_d = -np.sum(o * m, axis=1)
        fresnel = _dielectric(cos_d, 1.0 / eta)
        lobe = _g1(o, ax, ay) * _ggx(m, ax, ay) / (4.0 * np.abs(o[:, 2]))
        value[rows] = (glass * fresnel * lobe * _g1(i, ax, ay))[:, None]
        pdf[rows] = fresnel * lobe

    # --- through the surface: Walter et al. 2007, equations 16 and 17
    if glass > 0.0:
        for above in (True, False):
            rows = (wo[:, 2] > 0.0) & (wi[:, 2] < 0.0) if above else (wo[:, 2] < 0.0) & (wi[:, 2] > 0.0)
            o, i = wo[rows], wi[rows]
            n_o, n_i = (1.0, eta) if above else (eta, 1.0)
            h = n_o * o + n_i * i
            m = h / np.linalg.norm(h, axis=1, keepdims=True)
            m = m * np.sign(m[:, 2:])
            om, im = np.sum(o * m, axis=1), np.sum(i * m, axis=1)
            sees = (om * o[:, 2] > 0.0) & (im * i[:, 2] > 0.0)
            through = 1.0 - _dielectric(om, n_i / n_o)
            jacobian = n_i**2 * np.abs(im) / (n_o * om + n_i * im) ** 2
            lobe = np.where(sees, through * _g1(o, ax, ay) * _ggx(m, ax, ay) * np.abs(om / o[:, 2]) * jacobian, 0.0)
            scaled = glass * lobe * _g1(i, ax, ay) * (n_o / n_i) ** 2
            value[rows] = scaled[:, None] * np.sqrt(color)
            pdf[rows] = lobe * (p_main * glass if above else 1.0)
    return value, pdf
