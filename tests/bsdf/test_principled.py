"""The principled BSDF: values against a float64 oracle and Mitsuba 3, its sampler, energy and reciprocity."""

import itertools

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


def conditioned(name: str, wo: np.ndarray, wi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Relative error of a density where the half vector h comes from float32 directions, and where that is known.

    The error of the slope is 1e-7 / |h|, which a lobe of width alpha turns into as many alphas. Refraction that grazes
    the microfacet goes with the cosine, whose error is 1e-7 / cos; left out is the onset of total reflection."""
    fields = harness.PRINCIPLED | SETS[name]
    n_o, n_i = (np.where(w[:, 2:] > 0.0, 1.0, fields["eta"]) for w in (wo, wi))
    h = n_o * wo.astype(np.float64) + n_i * wi
    length = np.linalg.norm(h, axis=1)
    alpha = max(1e-3, fields["roughness"] ** 2 * np.sqrt(1.0 - 0.9 * fields["anisotropic"]))
    if fields["clearcoat"] > 0.0:
        alpha = min(alpha, 0.1 + (0.001 - 0.1) * fields["clearcoat_gloss"])
    cos_o, cos_i = (np.abs(np.sum(h * w, axis=1)) / np.maximum(length, 1e-30) for w in (wo, wi))
    same_side = wo[:, 2] * wi[:, 2] > 0.0
    inside = min(fields["eta"], 1.0 / fields["eta"])
    grazing = np.minimum(cos_o, cos_i)
    clear = np.where(same_side, np.abs(cos_o**2 - (1.0 - inside**2)) > 3e-3, grazing > 0.02)
    tolerance = 2e-5 + 2e-6 / (alpha * np.minimum(length, 1.0))
    return tolerance + np.where(same_side, 0.0, 4e-7 / np.maximum(grazing, 0.02) ** 2), clear


@each_set
def test_oracle(name):
    """Values and densities against the float64 oracle; lobes that a set has are met."""
    wo, wi = pairs(name, 1, 40_000)
    ours = harness.evaluate(kind(name), parameters(name), wo, wi)
    value, pdf = evaluate(SETS[name], wo, wi)
    tolerance, clear = conditioned(name, wo, wi)
    for ours_, expected in ((ours.value, value), (ours.pdf[:, None], pdf[:, None])):
        assert np.count_nonzero(expected[:, 0]) > 0.2 * len(expected)
        error = np.abs(ours_ - expected) / np.maximum(expected, 1e-6)
        assert np.all(error[clear] < tolerance[clear, None]), error[clear].max()


@each_set
def test_mitsuba(name):
    """Values and densities of Mitsuba 3, which is float32 too, and its sampling rates.

    Its clearcoat takes sin^2 + alpha^2 cos^2 as 1 - (1 - alpha^2) cos^2, so it has an absolute error of 1e-7 there."""
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
    if not fields["spec_trans"]:  # from below, Mitsuba has a density but neither a value nor samples
        wo[:, 2] = np.abs(wo[:, 2])
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
    tolerance, clear = conditioned(name, wo, wi)
    if fields["clearcoat"] > 0.0:
        h = wo + wi.astype(np.float64)
        sin2 = (h[:, 0] ** 2 + h[:, 1] ** 2) / np.sum(h * h, axis=1)
        tolerance += 2e-7 / (sin2 + (0.1 + (0.001 - 0.1) * fields["clearcoat_gloss"]) ** 2)
    for ours_, expected in ((ours.value, value), (ours.pdf[:, None], pdf[:, None])):
        error = np.abs(ours_ - expected) / np.maximum(expected, 1e-5)
        assert np.all(error[clear] < 1e-4 + tolerance[clear, None]), error[clear].max()


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
        tolerance, clear = conditioned(name, wo_all, s.wi)
        usable = (s.pdf > 0.0) & (e.pdf > 1e-20) & clear
        assert usable.sum() > 0.95 * (s.pdf > 0.0).sum() > 1000
        tolerance = tolerance[usable]
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
    tolerance, clear = conditioned(name, wo, wi)
    assert np.count_nonzero(forward[clear]) > 1000
    tolerance = 2e-4 + 2.0 * tolerance[clear, None]
    assert np.all(np.abs(forward - backward)[clear] <= tolerance * np.maximum(forward, backward)[clear] + 1e-10)


@pytest.mark.parametrize("name", ["clearcoat", "sharp clearcoat"])
def test_clearcoat_inverts_its_distribution(name):
    """Burley 2012, equation 2 of appendix B.2: the normal that a number makes, seen from straight above."""
    wo, u = harness.direction(1.0), harness.uniforms(20_000, 9)
    s = harness.sample(kind(name), parameters(name), wo, u)
    alive = (s.pdf > 0.0) & (u[:, 2] < 0.99)
    assert alive.sum() > 10_000
    h = wo + s.wi[alive].astype(np.float64)
    alpha2 = (0.1 + (0.001 - 0.1) * SETS[name].get("clearcoat_gloss", 0.0)) ** 2
    expected = 1.0 - (1.0 - alpha2 ** (1.0 - u[alive, 1].astype(np.float64))) / (1.0 - alpha2)
    found = (h[:, 0] ** 2 + h[:, 1] ** 2) / np.sum(h * h, axis=1)
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-6 * alpha2)


ENDS = [0.0, 2.0**-24, 0.3, 1.0 - 2.0**-23, harness.LARGEST_UNIFORM]
COSINES = [1.0, 1.0 - 2.0**-24, 0.5, 1e-2, 1e-4, 1e-7, 1e-20, 1e-30, 0.0]
EXTREMES = [
    {"roughness": 0.0},
    {"roughness": 0.0, "anisotropic": 1.0, "metallic": 1.0},
    {"roughness": 0.0, "spec_trans": 1.0, "eta": 1.001},
    {"roughness": 1.0, "anisotropic": 1.0, "spec_trans": 1.0, "eta": 4.0},
    {"roughness": 1.0, "flatness": 1.0, "diffuse_rate": 1e6},
    {"eta": 1.0, "spec_tint": 1.0},
    {"eta": 0.25, "spec_trans": 0.5, "metallic": 0.5},
    {"base_color": (0.0, 0.0, 0.0), "spec_tint": 1.0, "sheen": 1.0, "sheen_tint": 1.0},
    {"base_color": (0.0, 0.0, 1.0), "spec_trans": 1.0, "metallic": 1.0},
    {"clearcoat": 1.0, "clearcoat_gloss": 1.0, "clearcoat_rate": 0.0, "diffuse_rate": 0.0},
    {"clearcoat": 1.0, "clearcoat_gloss": 1.0, "specular_rate": 1e-6, "diffuse_rate": 0.0},
    dict.fromkeys(
        ("roughness", "anisotropic", "metallic", "spec_trans", "spec_tint", "sheen", "sheen_tint", "flatness",
         "clearcoat", "clearcoat_gloss"), 1.0,
    ),
]  # fmt: skip


def test_extremes_are_finite():
    """Every end of every range: samples and values are finite and not negative, directions are unit vectors."""
    u = np.array(list(itertools.product(ENDS, repeat=3)), dtype=np.float32)
    wo = np.array([harness.direction(sign * c, phi) for c in COSINES for sign in (1.0, -1.0) for phi in (0.0, 2.0)])
    wo_all, u_all = np.repeat(wo, len(u), axis=0), np.tile(u, (len(wo), 1))
    for fields in EXTREMES + list(SETS.values()):
        p = harness.parameters(principled=fields)
        for name in ("principled", "principled_transmissive"):
            if fields.get("spec_trans") and name == "principled":
                continue
            s = harness.sample(name, p, wo_all, u_all)
            for field in (s.wi, s.weight, s.pdf, s.eta):
                assert np.all(np.isfinite(field)), fields
            assert np.all(s.pdf >= 0.0)
            assert np.all(s.weight >= 0.0)
            assert np.all((s.weight == 0.0).all(axis=1) | (s.pdf > 0.0)), "a sample without a density"
            np.testing.assert_allclose(np.linalg.norm(s.wi, axis=1), 1.0, atol=1e-5)
            for wi in (s.wi, -wo_all, wo_all, wo_all * [-1.0, -1.0, 1.0]):
                e = harness.evaluate(name, p, wo_all, wi)
                for field in (e.value, e.pdf):
                    assert np.all(np.isfinite(field)), fields
                    assert np.all(field >= 0.0), fields


def test_opaque_is_one_sided_and_a_case_of_transmissive():
    """What does not transmit has the same values and samples in both sets of functions."""
    wo, wi = harness.random_directions(20_000, 3), harness.random_directions(20_000, 4)
    u = harness.uniforms(20_000, 5)
    below = (wo[:, 2] <= 0.0) | (wi[:, 2] <= 0.0)
    for name in [name for name, fields in SETS.items() if not fields.get("spec_trans")]:
        results = []
        for functions in ("principled", "principled_transmissive"):
            e = harness.evaluate(functions, parameters(name), wo, wi)
            s = harness.sample(functions, parameters(name), wo, u)
            assert np.all((e.pdf == 0.0) == below)
            assert np.all(e.value[below] == 0.0)
            assert np.all(s.weight[wo[:, 2] <= 0.0] == 0.0)
            assert np.all(s.wi[s.pdf > 0.0, 2] > 0.0)
            assert np.all(s.eta == 1.0)
            results.append(np.column_stack([e.value, e.pdf, s.wi, s.weight, s.pdf]))
        np.testing.assert_allclose(results[0], results[1], rtol=2e-6, atol=1e-12)


# What comes back from a white surface seen at cosines 1, 0.6 and 0.1, by quadrature of the oracle. Burley's model adds
# the reflection, the coat and the sheen to a diffuse base that stays as it is, so it makes light; see that it makes no
# more. A smooth base without a reflection darkens towards grazing angles, a rough one brightens.
WHITE = {
    "default": ({}, (1.043, 1.061, 1.182)),
    "smooth base": ({"eta": 1.0, "roughness": 0.0}, (0.976, 0.971, 0.688)),
    "rough base": ({"eta": 1.0, "roughness": 1.0}, (1.036, 1.041, 1.380)),
    "flat": ({"flatness": 1.0}, (0.791, 1.051, 1.434)),
    "sheen": ({"sheen": 1.0}, (1.043, 1.070, 1.248)),
    "clearcoat": ({"clearcoat": 1.0}, (1.069, 1.075, 1.188)),
    "half metal": ({"metallic": 0.5}, (0.979, 0.966, 1.018)),
    "half glass": ({"spec_trans": 0.5}, (1.018, 1.016, 1.030)),
    "the most": ({"sheen": 1.0, "clearcoat": 1.0, "flatness": 1.0, "roughness": 1.0}, (0.799, 1.052, 1.605)),
}


@pytest.mark.parametrize("name", WHITE)
def test_energy(name):
    """The mean weight is the tabulated one. Six standard errors, a false alarm in 1e9."""
    fields, table = WHITE[name]
    p = harness.parameters(principled={"base_color": (1.0,) * 3} | fields)
    for cos_o, expected in zip((1.0, 0.6, 0.1), table, strict=True):
        s = harness.sample("principled_transmissive", p, harness.direction(cos_o), harness.uniforms(N, 7))
        energy = s.weight[:, 1].astype(np.float64) * s.eta.astype(np.float64) ** 2
        assert abs(energy.mean() - expected) < 6.0 * energy.std() / np.sqrt(N) + 1e-3, cos_o


@pytest.mark.parametrize("cos_o", [1.0, 0.6, 0.1])
@pytest.mark.parametrize("roughness", [0.1, 0.5, 1.0])
def test_furnace(roughness, cos_o):
    """White metal and clear glass lose light to shadowing only, next to nothing when smooth.

    Mean weights of samples; six standard errors, a false alarm in 1e9."""
    wo = harness.direction(cos_o)
    for fields in ({"metallic": 1.0}, {"spec_trans": 1.0, "eta": 1.5}):
        p = harness.parameters(principled={"base_color": (1.0,) * 3, "roughness": roughness} | fields)
        s = harness.sample("principled_transmissive", p, wo, harness.uniforms(N, 8))
        energy = s.weight[:, 0].astype(np.float64) * s.eta.astype(np.float64) ** 2
        error = 6.0 * energy.std() / np.sqrt(N) + 1e-5
        assert energy.max() < 1.0 + 1e-4
        assert energy.mean() < 1.0 + error
        if roughness == 0.1 and cos_o > 0.5:
            assert energy.mean() > 0.999 - error
