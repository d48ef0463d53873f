"""The principled BSDF: values and densities against a float64 oracle and Mitsuba 3, its sampler, energy, reciprocity."""

import numpy as np
import pytest
from scipy import stats

from tests.bsdf import harness
from tests.bsdf.charts import PER_CELL, SHAPE, Chart
from tests.bsdf.principled_oracle import evaluate
from tests.chi_square import cell_sums, histogram, nodes, p_value, sidak

N = 100_000
COLOR = (0.9, 0.5, 0.1)
# Each lobe alone (a lobe that cannot be alone has all samples), and mixed. The names are those of the record, but for
# the sampling rates.
ALONE = {
    "diffuse": {"diffuse_rate": 1e6, "roughness": 0.7},
    "flat": {"diffuse_rate": 1e6, "roughness": 0.9, "flatness": 1.0},
    "sheen": {"diffuse_rate": 1e6, "base_color": (0.0,) * 3, "sheen": 1.0, "sheen_tint": 0.5},
    "metal": {"metallic": 1.0, "roughness": 0.5},
    "sharp metal": {"metallic": 1.0, "roughness": 0.02},
    "anisotropic metal": {"metallic": 1.0, "roughness": 0.5, "anisotropic": 0.9},
    "clearcoat": {"metallic": 1.0, "clearcoat": 1.0, "clearcoat_rate": 1e6},
    "sharp clearcoat": {"metallic": 1.0, "clearcoat": 1.0, "clearcoat_gloss": 1.0, "clearcoat_rate": 1e6},
    "glass": {"spec_trans": 1.0, "roughness": 0.5},
    "rough glass": {"spec_trans": 1.0, "roughness": 1.0, "eta": 2.0},
    "sharp glass": {"spec_trans": 1.0, "roughness": 0.02},
    "anisotropic glass": {"spec_trans": 1.0, "roughness": 0.4, "anisotropic": 0.7},
}
MIXED = {
    "default": {},
    "tinted": {"spec_tint": 0.8, "roughness": 0.3, "eta": 2.5},
    "thin": {"eta": 0.7, "spec_tint": 0.5, "metallic": 0.3, "roughness": 0.4},
    "all": {
        "roughness": 0.4, "metallic": 0.3, "spec_tint": 0.4, "sheen": 0.7, "sheen_tint": 0.6, "flatness": 0.5,
        "clearcoat": 0.8, "clearcoat_gloss": 0.3, "specular_rate": 0.7, "clearcoat_rate": 2.0, "diffuse_rate": 1.5,
    },
    "all, anisotropic": {
        "roughness": 0.6, "anisotropic": 0.8, "metallic": 0.5, "sheen": 0.3, "flatness": 1.0, "clearcoat": 1.0,
        "clearcoat_gloss": 0.9,
    },
    "all, transmissive": {
        "roughness": 0.5, "anisotropic": 0.4, "metallic": 0.2, "spec_trans": 0.6, "eta": 1.33, "spec_tint": 0.5,
        "sheen": 0.5, "flatness": 0.3, "clearcoat": 0.5, "clearcoat_gloss": 0.5, "specular_rate": 2.0,
    },
    "half glass": {"spec_trans": 0.5, "roughness": 0.25, "eta": 1.5},
    "thin glass": {"spec_trans": 0.9, "roughness": 0.5, "eta": 0.75},
}  # fmt: skip
SETS = {name: {"base_color": COLOR} | fields for name, fields in (ALONE | MIXED).items()}
SHARP = [name for name in SETS if name.startswith("sharp")]
each_set = pytest.mark.parametrize("name", SETS)


def kind(name: str) -> str:
    return "principled_transmissive" if SETS[name].get("spec_trans") else "principled"


def parameters(name: str):
    return harness.parameters(principled=SETS[name])


def cosines(name: str) -> list[float]:
    return [1.0, 0.6, 0.05] + ([-0.9, -0.5, -0.05] if SETS[name].get("spec_trans") else [])


def pairs(name: str, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random directions, half of them sampled, so that narrow lobes are met; none in the horizon."""
    wo, wi = harness.random_directions(count, seed), harness.random_directions(count, seed + 1)
    s = harness.sample(kind(name), parameters(name), wo, harness.uniforms(count, seed + 2))
    wi[::2] = s.wi[::2]
    clear = np.minimum(np.abs(wo[:, 2]), np.abs(wi[:, 2])) > 0.02
    return wo[clear], wi[clear]


def conditioned(name: str, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Relative error of a density where the half vector comes from float32 directions: 1e-7 / |h| in slope, of a lobe
    of width alpha; and where total reflection begins, the reflectance follows any rounding of the cosine."""
    fields = harness.PRINCIPLED | SETS[name]
    n_o, n_i = (np.where(w[:, 2:] > 0.0, 1.0, fields["eta"]) for w in (wo, wi))
    h = np.linalg.norm(n_o * wo + n_i * wi, axis=1)
    alpha = max(1e-3, fields["roughness"] ** 2 * np.sqrt(1.0 - 0.9 * fields["anisotropic"]))
    if fields["clearcoat"] > 0.0:
        alpha = min(alpha, 0.1 + (0.001 - 0.1) * fields["clearcoat_gloss"])
    return 2e-5 + 4e-6 / (alpha * np.minimum(h, 1.0))


def away_from_total_reflection(name: str, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    eta = (harness.PRINCIPLED | SETS[name])["eta"]
    inside = eta if eta < 1.0 else 1.0 / eta  # ratio of indices, seen from the denser side
    cos2 = 0.25 * np.sum((wo + wi).astype(np.float64) ** 2, axis=1)
    dense = (wo[:, 2] < 0.0) == (eta > 1.0)
    return ~(dense & (wo[:, 2] * wi[:, 2] > 0.0) & (np.abs(cos2 - (1.0 - inside**2)) < 3e-3))


@each_set
def test_oracle(name):
    """Values and densities against the float64 oracle; lobes that a set has are met."""
    wo, wi = pairs(name, 1, 40_000)
    ours = harness.evaluate(kind(name), parameters(name), wo, wi)
    value, pdf = evaluate(SETS[name], wo, wi)
    tolerance = conditioned(name, wo, wi)
    clear = away_from_total_reflection(name, wo, wi)
    for ours_, expected in ((ours.value, value), (ours.pdf[:, None], pdf[:, None])):
        assert np.count_nonzero(expected[:, 0]) > 0.2 * len(expected)
        error = np.abs(ours_ - expected) / np.maximum(expected, 1e-6)
        assert np.all(error[clear] < tolerance[clear, None]), error[clear].max()


@each_set
def test_mitsuba(name):
    """Values and densities of Mitsuba 3, which is float32 too, and its sampling rates."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    fields = harness.PRINCIPLED | SETS[name]
    rates = {
        "specular_rate": "main_specular_sampling_rate", "clearcoat_rate": "clearcoat_sampling_rate",
        "diffuse_rate": "diffuse_reflectance_sampling_rate",
    }  # fmt: skip
    plugin = {"type": "principled"} | {rates.get(key, key): value for key, value in fields.items()}
    plugin["base_color"] = {"type": "rgb", "value": list(fields["base_color"])}
    bsdf = mi.load_dict(plugin)
    wo, wi = pairs(name, 10, 1500)
    if name in SHARP:  # Mitsuba's half vector is float32 as ours
        clear = np.linalg.norm(wo + wi, axis=1) > 0.2
        wo, wi = wo[clear], wi[clear]
    si, context = mi.SurfaceInteraction3f(), mi.BSDFContext()
    value, pdf = [], []
    for o, i in zip(wo.tolist(), wi.tolist(), strict=True):
        si.wi = o
        value.append(np.array(bsdf.eval(context, si, i)))
        pdf.append(bsdf.pdf(context, si, i))
    value, pdf = np.array(value), np.array(pdf)
    ours = harness.evaluate(kind(name), parameters(name), wo, wi)
    tolerance = 1e-4 + conditioned(name, wo, wi)
    clear = away_from_total_reflection(name, wo, wi)
    error = np.abs(ours.value - value) / np.maximum(value, 1e-5)
    assert np.all(error[clear] < tolerance[clear, None]), error[clear].max()
    error = np.abs(ours.pdf - pdf) / np.maximum(pdf, 1e-5)
    assert np.all(error[clear] < tolerance[clear]), error[clear].max()


class WideChart(Chart):
    """Cells of all sizes: the microfacet's angle grows exponentially from 1e-4 of a cell's width to a right angle."""

    GROWTH = 8.0

    def directions(self):
        t, b, area = nodes(SHAPE, PER_CELL)
        theta = 0.5 * np.pi * np.expm1(self.GROWTH * t) / np.expm1(self.GROWTH)
        d_theta = 0.5 * np.pi * self.GROWTH * np.exp(self.GROWTH * t) / np.expm1(self.GROWTH)
        x, y = np.tan(theta) * np.cos(2.0 * np.pi * b), np.tan(theta) * np.sin(2.0 * np.pi * b)
        step = 1e-5 * np.tan(theta)
        wi = self._direction(x, y)
        dx = (self._direction(x + step, y) - self._direction(x - step, y)) / (2.0 * step)[:, None]
        dy = (self._direction(x, y + step) - self._direction(x, y - step)) / (2.0 * step)[:, None]
        jacobian = np.nan_to_num(np.linalg.norm(np.cross(dx, dy), axis=1))
        slopes = np.tan(theta) / np.cos(theta) ** 2 * d_theta * 2.0 * np.pi
        wi = np.where(np.isfinite(wi), wi, [0.0, 0.0, 1.0]) * [1.0, 1.0, np.sign(self.wo[2])]
        return wi, jacobian * slopes * area

    def counts(self, wi):
        o, i = self._upper(), wi * [1.0, 1.0, np.sign(self.wo[2])]
        i = i[i[:, 2] > 0.0] if self.index is None else self.index * i[i[:, 2] < 0.0]
        h = o + i
        theta = np.arctan(np.hypot(h[:, 0], h[:, 1]) / np.abs(h[:, 2]))
        slopes = h[:, :2] * np.sign(h[:, 2:])
        azimuth = np.mod(np.arctan2(slopes[:, 1], slopes[:, 0]) / (2.0 * np.pi), 1.0)
        t = np.log1p(theta / (0.5 * np.pi) * np.expm1(self.GROWTH)) / self.GROWTH
        return histogram(t, azimuth, SHAPE)[:-1]


def integrate(name: str, wo: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[Chart]]:
    """From the oracle: the probability of each cell, the flux per channel that it sends on, and the charts."""
    fields = harness.PRINCIPLED | SETS[name]
    charts = [WideChart(wo, 1.0, None)]
    if fields["spec_trans"] > 0.0:
        charts.append(WideChart(wo, 1.0, fields["eta"] if wo[2] > 0.0 else 1.0 / fields["eta"]))
    probabilities, flux = [], np.zeros(3)
    for chart in charts:
        wi, solid_angle = chart.directions()
        seen = solid_angle > 0.0
        value, pdf = np.zeros((len(wi), 3)), np.zeros(len(wi))
        value[seen], pdf[seen] = evaluate(SETS[name], wo[None], wi[seen])
        probabilities.append(cell_sums(pdf * solid_angle, SHAPE, PER_CELL))
        flux += (value * solid_angle[:, None]).sum(axis=0) * (1.0 if chart.index is None else chart.index**2)
    return np.concatenate(probabilities), flux, charts


QUADRATURE_ERROR = 2e-3


@each_set
def test_samples_follow_the_density(name):
    """Chi-square over cells that adapt to lobes of any width, and the mean weight: what the oracle's integral says.

    False-alarm rate 1e-4 for each set."""
    p = parameters(name)
    level = sidak(5 * len(cosines(name)))
    z = stats.norm.isf(level / 2.0)
    for seed, cos_o in enumerate(cosines(name)):
        wo = harness.direction(cos_o)
        probabilities, flux, charts = integrate(name, wo)
        total = probabilities.sum()
        assert total < 1.0 + QUADRATURE_ERROR, cos_o
        s = harness.sample(kind(name), p, wo, harness.uniforms(N, seed))
        alive = s.pdf > 0.0
        wi = s.wi[alive].astype(np.float64)
        counts = np.concatenate([chart.counts(wi) for chart in charts])
        assert counts.sum() == alive.sum()
        assert p_value(np.append(counts, 0), probabilities / total) > level, cos_o
        assert abs(alive.mean() - total) < z * max(alive.std(), 0.01) / np.sqrt(N) + QUADRATURE_ERROR, cos_o
        energy = s.weight.astype(np.float64) * s.eta[:, None].astype(np.float64) ** 2
        error = np.abs(energy.mean(axis=0) - flux)
        assert np.all(error < z * energy.std(axis=0) / np.sqrt(N) + QUADRATURE_ERROR * np.maximum(flux, 1.0)), cos_o
        assert np.all(s.weight[~alive] == 0.0)


@each_set
def test_weight_is_value_over_density(name):
    for seed, cos_o in enumerate(cosines(name)):
        wo = harness.direction(cos_o)
        s = harness.sample(kind(name), parameters(name), wo, harness.uniforms(20_000, seed))
        e = harness.evaluate(kind(name), parameters(name), wo, s.wi)
        wo_all = np.broadcast_to(wo, s.wi.shape)
        usable = (s.pdf > 0.0) & (e.pdf > 1e-20) & away_from_total_reflection(name, wo_all, s.wi)
        assert usable.sum() > 0.98 * (s.pdf > 0.0).sum() > 1000
        tolerance = conditioned(name, wo_all, s.wi)[usable]
        assert np.all(np.abs(e.pdf[usable] / s.pdf[usable] - 1.0) < tolerance), cos_o
        ratio = s.weight[usable] * e.pdf[usable, None] - e.value[usable]
        assert np.all(np.abs(ratio) <= 2.0 * tolerance[:, None] * e.value[usable] + 1e-12), cos_o
        np.testing.assert_allclose(np.linalg.norm(s.wi, axis=1), 1.0, atol=1e-6)


@each_set
def test_reciprocity(name):
    """f(wo, wi) n_wi^2 = f(wi, wo) n_wo^2, n the index of the side that a direction is on: every part has it."""
    eta = (harness.PRINCIPLED | SETS[name])["eta"]
    wo, wi = pairs(name, 30, 20_000)
    n_o, n_i = (np.where(w[:, 2:] > 0.0, 1.0, eta) for w in (wo, wi))
    forward = harness.evaluate(kind(name), parameters(name), wo, wi).value / np.abs(wi[:, 2:]) * n_i**2
    backward = harness.evaluate(kind(name), parameters(name), wi, wo).value / np.abs(wo[:, 2:]) * n_o**2
    h = n_o * wo + n_i * wi
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    clear = np.minimum(np.abs(np.sum(h * wo, axis=1)), np.abs(np.sum(h * wi, axis=1))) > 0.05
    clear &= away_from_total_reflection(name, wo, wi)
    assert np.count_nonzero(forward[clear]) > 1000
    tolerance = 2e-4 + 2.0 * conditioned(name, wo, wi)[clear, None]
    assert np.all(np.abs(forward - backward)[clear] <= tolerance * np.maximum(forward, backward)[clear] + 1e-10)
