"""Mixtures: decoding, density, sampling and product against a float64 oracle, and outputs of any size."""

import numpy as np
import pytest
import warp as wp

from guiding.distributions.vmf import COSINE_KAPPA
from guiding.distributions.vmf_mixture import LOG_KAPPA_LIMIT, make_vmf_mixture
from tests.chi_square import cell_sums, histogram, nodes, p_value, sidak
from tests.guiding import vmf_oracle as oracle
from tests.guiding.vmf_kernels import evaluate

CASES = [(1, "angles"), (1, "vector"), (2, "angles"), (2, "vector"), (8, "angles"), (8, "vector"), (32, "vector")]
EPS = 2.0**-24


def mixtures(seed, n, n_lobes, direction, log_kappa=(-4.0, 14.0)):
    """Random raw outputs [n, P]; some kappas are tiny, as are some weights."""
    rng = np.random.default_rng(seed)
    raw = rng.normal(scale=2.0, size=(n, n_lobes, oracle.per_lobe(direction)))
    raw[..., 1] = rng.uniform(*log_kappa, size=(n, n_lobes))
    if direction == "vector":
        raw[: n // 4, :, 2:] *= 10.0 ** rng.uniform(-4.0, 4.0, size=(n // 4, n_lobes, 1))
    return raw.reshape(n, -1).astype(np.float32)


def directions(seed, raw, direction):
    """float32 unit vectors [n, 3], half of them within a few widths of a lobe."""
    rng = np.random.default_rng(seed)
    w = rng.normal(size=(len(raw), 3))
    _, kappa, mu = oracle.decode(raw, direction)
    some = np.arange(0, len(raw), 2)
    lobe = rng.integers(0, kappa.shape[1], len(some))
    width = 1.0 / np.sqrt(1.0 + kappa[some, lobe, None])
    w[some] = mu[some, lobe] + rng.normal(size=(len(some), 3)) * width
    return oracle.unit(w).astype(np.float32)


def rounding(raw, w, direction, mu_error=6e-7):
    """Bound [n] on the rounding of log p: of the terms, and of the float32 mean directions."""
    log_weight, kappa, mu = mixture = oracle.decode(raw, direction)
    distance = np.linalg.norm(mu - oracle.unit(w)[:, None, :], axis=-1)
    h = 0.5 * distance**2
    share = np.exp(oracle.log_terms(mixture, w) - oracle.log_pdf(mixture, w)[:, None])
    terms = 2e-7 * (5.0 + np.abs(log_weight) + np.log1p(kappa)) + kappa * (5e-7 * h + mu_error * distance)
    return np.sum(share * terms, axis=1)


@pytest.mark.parametrize(("n_lobes", "direction"), CASES)
def test_decoded_parameters(n_lobes, direction):
    raw = mixtures(1, 400, n_lobes, direction)
    found = evaluate(raw, (0, 0, 1), direction)
    log_weight, kappa, mu = oracle.decode(raw, direction)
    np.testing.assert_allclose(found.weight, np.exp(log_weight), rtol=2e-6)
    np.testing.assert_allclose(found.weight.sum(axis=1), 1.0, atol=5e-7)
    np.testing.assert_allclose(found.kappa, kappa, rtol=2e-6)  # 14 rounded to float32 has an error of 5e-7
    np.testing.assert_allclose(np.linalg.norm(found.mu, axis=-1), 1.0, atol=2e-7)
    np.testing.assert_allclose(found.mu, mu, atol=6e-7)


@pytest.mark.parametrize(("n_lobes", "direction"), CASES)
@pytest.mark.parametrize("log_kappa", [(-20.0, 3.0), (-4.0, 14.0), (11.0, 14.0)])
def test_density_against_the_oracle(n_lobes, direction, log_kappa):
    raw = mixtures(2, 1000, n_lobes, direction, log_kappa)
    w = directions(3, raw, direction)
    found = evaluate(raw, w, direction)
    expected = oracle.log_pdf(oracle.decode(raw, direction), w)
    bound = rounding(raw, w, direction)
    assert np.all(np.abs(found.log_pdf - expected) <= bound)
    if log_kappa[1] == 3.0:
        assert bound.max() < 1e-4
    seen = expected > -80.0
    assert np.all(np.abs(found.pdf[seen] / np.exp(expected[seen]) - 1.0) <= 1.1 * bound[seen] + 1e-6)
    assert np.all(found.pdf[expected < -110.0] == 0.0)
    np.testing.assert_array_equal(found.gradient_log_pdf, found.log_pdf)
    np.testing.assert_array_equal(found.product_gradient_log_pdf, found.product_log_pdf)


def test_density_to_1e_5_relative():
    """With the mean directions that were decoded, so that rounding those to float32 is no part of it."""
    for n_lobes, direction in CASES:
        raw = mixtures(4, 1000, n_lobes, direction)
        w = directions(5, raw, direction)
        found = evaluate(raw, w, direction)
        log_weight, kappa, _ = oracle.decode(raw, direction)
        expected = oracle.log_pdf((log_weight, kappa, found.mu), w)
        np.testing.assert_allclose(found.log_pdf, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("direction", ["angles", "vector"])
@pytest.mark.parametrize("other_kappa", [0.0, COSINE_KAPPA, 40.0])
def test_densities_integrate_to_one(direction, other_kappa):
    w, area = oracle.quadrature((0, 0, 1), 2.0, 64, 128)
    for raw in mixtures(6, 5, 8, direction, (-6.0, 4.5)):
        found = evaluate(raw, w, direction, other_mu=(0.6, 0.0, -0.8), other_kappa=other_kappa)
        assert found.pdf @ area == pytest.approx(1.0, abs=1e-5)
        assert found.product_pdf @ area == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize(("n_lobes", "direction"), CASES)
@pytest.mark.parametrize("other_kappa", [0.0, 1e-6, COSINE_KAPPA, 1e3, 1e6])
def test_product_against_the_oracle(n_lobes, direction, other_kappa):
    raw = mixtures(7, 600, n_lobes, direction)
    w = directions(8, raw, direction)
    other_mu = oracle.unit(np.random.default_rng(9).normal(size=(600, 3))).astype(np.float32)
    other_mu[:200] = directions(10, raw[:200], direction)
    found = evaluate(raw, w, direction, other_mu=other_mu, other_kappa=other_kappa)
    mixture = oracle.decode(raw, direction)
    expected = oracle.product_log_pdf(mixture, w, other_mu, np.full(600, np.float64(np.float32(other_kappa))))
    # rounding of the numerator, and of the mass: the same bound at the mean directions of the product
    log_weight, kappa, mu = mixture
    joint = kappa[..., None] * mu + other_kappa * oracle.unit(other_mu)[:, None, :]
    size = np.linalg.norm(joint, axis=-1)
    distance = np.linalg.norm(oracle.unit(joint) - oracle.unit(w)[:, None, :], axis=-1)
    apart = np.linalg.norm(mu - oracle.unit(other_mu)[:, None, :], axis=-1)
    loss = kappa + other_kappa - size
    terms = 4e-7 * (20.0 + np.abs(log_weight)) + size * (5e-7 * distance**2 + 8e-7 * distance)
    terms += 1e-6 * loss + 1e-6 * kappa * other_kappa / size * apart
    bound = 2.0 * terms.max(axis=1)
    assert np.all(np.abs(found.product_log_pdf - expected) <= bound)
    np.testing.assert_allclose(found.product_weight.sum(axis=1), 1.0, atol=1e-6)


def test_product_of_wide_lobes_to_1e_5_relative():
    for n_lobes, direction in CASES:
        raw = mixtures(11, 600, n_lobes, direction, (-20.0, 3.0))
        w, other_mu = directions(12, raw, direction), directions(13, raw, direction)
        found = evaluate(raw, w, direction, other_mu=other_mu, other_kappa=COSINE_KAPPA)
        expected = oracle.product_log_pdf(oracle.decode(raw, direction), w, other_mu, np.full(600, COSINE_KAPPA))
        np.testing.assert_allclose(found.product_pdf, np.exp(expected), rtol=1e-5)


@pytest.mark.parametrize("direction", ["angles", "vector"])
def test_product_is_proportional_to_the_product_of_densities(direction):
    rng = np.random.default_rng(12)
    raw = mixtures(13, 1, 8, direction, (-5.0, 6.0))[0]
    w = oracle.unit(rng.normal(size=(2000, 3))).astype(np.float32)
    other_mu = oracle.unit((0.3, -0.5, 0.2))
    found = evaluate(raw, w, direction, other_mu=other_mu, other_kappa=COSINE_KAPPA)
    ratio = found.product_log_pdf - found.log_pdf - oracle.vmf_log_pdf(other_mu, COSINE_KAPPA, w)
    assert np.ptp(ratio) < 1e-5
    alone = evaluate(raw, w, direction, other_mu=other_mu, other_kappa=0.0)
    np.testing.assert_allclose(alone.product_log_pdf, alone.log_pdf, rtol=1e-6, atol=3e-6)
    np.testing.assert_allclose(alone.product_weight, alone.weight, rtol=3e-6)


SHAPE, PER_CELL, N = (20, 24), 8, 200_000


@pytest.mark.parametrize(("n_lobes", "direction"), CASES)
def test_samples_follow_the_density(n_lobes, direction):
    """In cells of equal area on the sphere, alone and times a cosine lobe."""
    raw = mixtures(14, 1, n_lobes, direction, (-3.0, 3.5))[0]
    a, b, area = nodes(SHAPE, PER_CELL)
    z, phi = 2.0 * a - 1.0, 2.0 * np.pi * b
    r = np.sqrt(1.0 - z * z)
    other_mu = oracle.unit((0.5, 0.1, -0.4)).astype(np.float32)
    grid = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    at = evaluate(raw, grid, direction, other_mu=other_mu, other_kappa=COSINE_KAPPA)
    u = (np.random.default_rng(n_lobes).integers(0, 2**24, size=(N, 3)) * 2.0**-24).astype(np.float32)
    drawn = evaluate(raw, np.tile((0.0, 0.0, 1.0), (N, 1)), direction, u, other_mu=other_mu, other_kappa=COSINE_KAPPA)
    for pdf, sample in ((at.pdf, drawn.sample), (at.product_pdf, drawn.product_sample)):
        expected = cell_sums(pdf.astype(np.float64) * 4.0 * np.pi * area, SHAPE, PER_CELL)
        assert expected.sum() == pytest.approx(1.0, abs=2e-3)
        x, y, z = sample.astype(np.float64).T
        counts = histogram((z + 1.0) / 2.0, np.mod(np.arctan2(y, x) / (2.0 * np.pi), 1.0), SHAPE)
        assert p_value(counts, expected / expected.sum()) > sidak(2 * len(CASES))


@pytest.mark.parametrize("n_lobes", [8, 32])
def test_lobes_are_chosen_by_their_weights(n_lobes):
    """Lobes of 1e-3 rad apart from each other; a weight of zero is never chosen, not even by u = 0."""
    rng = np.random.default_rng(15)
    mu = oracle.unit(rng.normal(size=(n_lobes, 3)))
    weight = rng.exponential(size=n_lobes)
    raw = oracle.encode(weight, np.full(n_lobes, 1e6), mu, "vector").reshape(n_lobes, 5)
    raw[[0, 3, -1], 0] = -1e4
    weight[[0, 3, -1]] = 0.0
    u = (rng.integers(0, 2**24, size=(N, 3)) * 2.0**-24).astype(np.float32)
    u[:2, 2] = 0.0, 1.0 - EPS
    found = evaluate(raw.reshape(-1), np.tile((0.0, 0.0, 1.0), (N, 1)), "vector", u)
    chosen = np.argmax(found.sample @ mu.T, axis=1)
    counts = np.append(np.bincount(chosen, minlength=n_lobes), 0)
    assert np.all(counts[[0, 3, n_lobes - 1]] == 0)
    assert p_value(counts, weight / weight.sum()) > sidak(2)


FINITE = [0.0, -0.0, 1e-45, 1e-30, 1e-6, 1.1e-6, 0.7, 17.0, 20.0, 88.0, 89.0, 1e4, 1e19, 3.4e38]


@pytest.mark.parametrize(("n_lobes", "direction"), CASES)
def test_any_finite_outputs_give_finite_results(n_lobes, direction):
    rng = np.random.default_rng(16)
    n = 4000
    shape = (n, n_lobes * oracle.per_lobe(direction))
    raw = (rng.choice(FINITE, size=shape) * rng.choice([-1.0, 1.0], size=shape)).astype(np.float32)
    mild = rng.random(shape) < 0.3
    raw[mild] = rng.normal(size=mild.sum())
    raw[0], raw[1] = 1e4, -1e4
    w = oracle.unit(rng.normal(size=(n, 3))).astype(np.float32)
    w[: n // 2] = evaluate(raw[: n // 2], (0, 0, 1), direction).mu[:, 0]
    w[: n // 4] *= -1.0
    u = rng.choice([0.0, 0.5, 1.0 - EPS, 0.3], size=(n, 3)).astype(np.float32)
    other_mu = oracle.unit(rng.normal(size=(n, 3))).astype(np.float32)
    other_mu[::3] = -w[::3]
    other_kappa = rng.choice([0.0, 1e-20, COSINE_KAPPA, 1e6], size=n)
    found = evaluate(raw, w, direction, u, 1e3, other_mu, other_kappa)
    for name, value in vars(found).items():
        assert np.all(np.isfinite(value)), name
    assert np.all(found.pdf >= 0.0)
    for sample in (found.sample, found.product_sample):
        np.testing.assert_allclose(np.linalg.norm(sample, axis=1), 1.0, atol=3e-7)


def test_every_sample_has_a_density():
    """Also of the narrowest lobe: a sample rounded to float32 is not off its lobe, nor its product."""
    rng = np.random.default_rng(17)
    u = rng.integers(0, 2**24, size=(N, 3)) * 2.0**-24
    for direction in ("angles", "vector"):
        raw = mixtures(18, N, 2, direction, (LOG_KAPPA_LIMIT, LOG_KAPPA_LIMIT))
        other = {"other_mu": (0.0, 0.6, 0.8), "other_kappa": COSINE_KAPPA}
        drawn = evaluate(raw, (0, 0, 1), direction, u, **other)
        log_peak = np.log(np.exp(LOG_KAPPA_LIMIT) / (2.0 * np.pi))
        for sample, which in ((drawn.sample, "log_pdf"), (drawn.product_sample, "product_log_pdf")):
            log_pdf = getattr(evaluate(raw, sample, direction, **other), which)
            assert log_pdf.min() > log_peak - 17.0 - 8.0  # -log(1 - u) is at most 16.6; the weight
            assert np.mean(log_peak - log_pdf) < 1.0 + 2.0


def test_arguments_are_checked():
    for arguments in ((0,), (8, "polar"), (8, "angles", 0.0), (8, "angles", 20.5)):
        with pytest.raises(ValueError, match="allowed"):
            make_vmf_mixture(*arguments)
    assert make_vmf_mixture(8) is make_vmf_mixture(8, "angles", 20)


def test_mixtures_of_several_sizes_in_one_kernel():
    few, many = make_vmf_mixture(1, "vector"), make_vmf_mixture(3, "angles", 5.0)

    @wp.kernel(enable_backward=False, module="unique")
    def both(raw: wp.array[wp.float32], w: wp.vec3, result: wp.array[wp.float32]):
        result[0] = wp.static(few.log_pdf)(wp.static(few.decode)(raw, 0), w)
        result[1] = wp.static(many.log_pdf)(wp.static(many.decode)(raw, 5), w)

    raw = np.concatenate([mixtures(19, 1, 1, "vector")[0], mixtures(20, 1, 3, "angles", (5.0, 9.0))[0]])
    w = oracle.unit((0.2, -0.4, 0.1))
    result = wp.zeros(2, dtype=wp.float32, device="cpu")
    wp.launch(both, dim=1, inputs=[wp.array(raw, device="cpu"), wp.vec3(*w)], outputs=[result], device="cpu")
    clamped = raw[None, 5:].copy()
    clamped[:, 1::4] = 5.0
    expected = [
        oracle.log_pdf(oracle.decode(r, d), w[None])[0] for r, d in ((raw[None, :5], "vector"), (clamped, "angles"))
    ]
    np.testing.assert_allclose(result.numpy(), expected, rtol=1e-4)
