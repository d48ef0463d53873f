"""One von Mises-Fisher lobe: density, moments, sampling, product, and the lobe that stands for a cosine."""

import mpmath
import numpy as np
import pytest
import warp as wp
from scipy import integrate, optimize

from guiding.distributions import vmf
from tests.chi_square import cell_sums, histogram, nodes, p_value, sidak
from tests.guiding import vmf_oracle as oracle

DEVICE = "cpu"
KAPPAS = [0.0, 1e-30, 1e-8, 1e-3, 0.1, 0.499, 0.5, 1.0, 2.19, 10.0, 300.0, 1e4, 1e5, 1e6, 4.8e8]
ENDS = [0.0, 2.0**-24, 1e-3, 0.5, 0.75, 1.0 - 2.0**-24]
RANDOM_MU = oracle.unit(np.random.default_rng(11).normal(size=3))
MUS = {"+z": (0, 0, 1), "-z": (0, 0, -1), "+x": (1, 0, 0), "-x": (-1, 0, 0), "random": RANDOM_MU}
N = 100_000


@wp.kernel(enable_backward=False, module="unique")
def lobe_kernel(
    mu: wp.array[wp.vec3],
    kappa: wp.array[wp.float32],
    w: wp.array[wp.vec3],
    u: wp.array[wp.vec2],
    # outputs
    pdf: wp.array[wp.float32],
    log_pdf: wp.array[wp.float32],
    moments: wp.array[wp.vec2],
    h: wp.array[wp.float32],
    sample: wp.array[wp.vec3],
    turned: wp.array[wp.vec3],
):
    i = wp.tid()
    pdf[i] = vmf.vmf_pdf(mu[i], kappa[i], w[i])
    log_pdf[i] = vmf.vmf_log_pdf(mu[i], kappa[i], w[i])
    moments[i] = vmf.vmf_moments(kappa[i])
    h[i] = vmf.sample_one_minus_cosine(kappa[i], u[i][0])
    sample[i] = vmf.sample_vmf(mu[i], kappa[i], u[i])
    turned[i] = vmf.turn_from_z(mu[i], w[i])


@wp.kernel(enable_backward=False, module="unique")
def product_kernel(
    mu: wp.array[wp.vec3],
    kappa: wp.array[wp.float32],
    other_mu: wp.array[wp.vec3],
    other_kappa: wp.array[wp.float32],
    # outputs
    product_mu: wp.array[wp.vec3],
    product_kappa: wp.array[wp.float32],
    loss: wp.array[wp.float32],
):
    i = wp.tid()
    a, b, c = vmf.multiply_vmf(mu[i], kappa[i], other_mu[i], other_kappa[i])
    product_mu[i] = a
    product_kappa[i] = b
    loss[i] = c


DTYPES = {1: wp.float32, 2: wp.vec2, 3: wp.vec3}


def run(kernel, widths, *arguments):
    """Float64 results of `widths` numbers per thread; arguments are broadcast along the first dimension."""
    arguments = [np.asarray(a, np.float32) for a in arguments]
    columns = (3, 1, 3, 2) if kernel is lobe_kernel else (3, 1, 3, 1)
    n = max(a.shape[0] if a.ndim > (width > 1) else 1 for a, width in zip(arguments, columns, strict=True))
    inputs = []
    for a, width in zip(arguments, columns, strict=True):
        full = np.broadcast_to(a, (n, width) if width > 1 else n)
        inputs.append(wp.array(np.ascontiguousarray(full), dtype=DTYPES[width], device=DEVICE))
    outputs = [wp.empty(n, dtype=DTYPES[width], device=DEVICE) for width in widths]
    wp.launch(kernel, dim=n, inputs=inputs, outputs=outputs, device=DEVICE)
    return [a.numpy().astype(np.float64) for a in outputs]


def lobe(mu, kappa, w=(0, 0, 1), u=(0.5, 0.5)):
    """pdf, log pdf, moments, h, sample, turned w."""
    return run(lobe_kernel, (1, 1, 2, 1, 3, 3), mu, kappa, w, u)


def around(mu, h, phi):
    """float32 unit vectors at 1 - cos = h from mu."""
    r = np.sqrt(h * (2.0 - h))
    local = np.stack([r * np.cos(phi), r * np.sin(phi), 1.0 - h], axis=-1)
    return (local @ oracle.frame(mu)).astype(np.float32)


@pytest.mark.parametrize("kappa", KAPPAS)
def test_density_against_60_digits(kappa):
    rng = np.random.default_rng(5)
    for mu in MUS.values():
        mu = np.asarray(mu, np.float32)
        h = np.concatenate(
            [[0.0, 2.0, 1.0], rng.uniform(0.0, 2.0, 10), np.minimum(2.0, rng.exponential(size=20) / max(kappa, 1e-3))]
        )
        w = around(mu, h, rng.uniform(0.0, 6.28, len(h)))
        pdf, log_pdf, *_ = lobe(mu, kappa, w)
        exact = np.array([float(oracle.precise_vmf_log_pdf(mu, np.float32(kappa), one)) for one in w])
        # sizes of what the logarithm is a sum of
        size = 1.0 + np.log1p(kappa) + kappa * h
        assert (np.abs(log_pdf - exact) / size).max() < 1e-6
        near = exact > -20.0
        np.testing.assert_allclose(pdf[near], np.exp(exact[near]), rtol=1e-5)
        assert np.all(pdf[~near] <= 1.01 * np.exp(np.maximum(exact[~near], -100.0)))


@pytest.mark.parametrize("kappa", KAPPAS[:-1])
def test_density_integrates_to_one(kappa):
    for mu in MUS.values():
        w, area = oracle.quadrature(mu, min(2.0, 40.0 / max(kappa, 1.0)), 48, 24)
        pdf, *_ = lobe(mu, kappa, w)
        assert pdf @ area == pytest.approx(1.0, abs=1e-5)


def test_moments():
    kappas = np.unique(np.concatenate([KAPPAS, np.logspace(-6, 6, 200)])).astype(np.float32)
    _, _, moments, *_ = lobe((0, 0, 1), kappas)
    with mpmath.workdps(60):
        for kappa, (complement, ratio) in zip(kappas, moments, strict=True):
            k = mpmath.mpf(float(kappa))
            mean = mpmath.coth(k) - 1 / k if k > 1e-12 else k / 3
            assert complement == pytest.approx(float(1 - mean), rel=1e-6)
            assert ratio == pytest.approx(float(mean / k) if k > 0 else 1 / 3, rel=2e-6)


@pytest.mark.parametrize("kappa", KAPPAS)
def test_angle_of_a_sample_against_60_digits(kappa):
    u = np.concatenate([ENDS, np.random.default_rng(3).integers(0, 2**24, 200) * 2.0**-24]).astype(np.float32)
    h = lobe((0, 0, 1), kappa, u=np.stack([u, u], axis=1))[3]
    with mpmath.workdps(60):
        k = mpmath.mpf(float(np.float32(kappa)))
        exact = [
            float(-mpmath.log(1 + mpmath.mpf(float(x)) * mpmath.expm1(-2 * k)) / k) if k > 0 else 2.0 * float(x)
            for x in u
        ]
    np.testing.assert_allclose(h, exact, rtol=1e-6)


def test_ends_of_the_unit_interval():
    """Also at many a kappa at which rounding could take the far end beyond the opposite direction."""
    kappas = np.concatenate([KAPPAS, np.logspace(-9, 6, 3000)])
    u = np.array([(a, b) for a in ENDS for b in ENDS], np.float32)
    u, kappas = np.tile(u, (len(kappas), 1)), np.repeat(kappas, len(u))
    for mu in MUS.values():
        *_, sample, _ = lobe(mu, kappas, u=u)
        np.testing.assert_allclose(np.linalg.norm(sample, axis=1), 1.0, atol=2e-7)
        np.testing.assert_allclose(sample[u[:, 0] == 0.0] - oracle.unit(mu), 0.0, atol=2e-7)


def test_the_turn_is_an_isometry():
    rng = np.random.default_rng(7)
    mu = rng.normal(size=(3000, 3))
    mu[:1000, :2] *= 10.0 ** rng.uniform(-8.0, 0.0, size=(1000, 1))  # around the poles
    mu[1000:2000, 2] *= 10.0 ** rng.uniform(-8.0, 0.0, size=1000)  # around the equator
    mu = oracle.unit(np.concatenate([mu, np.eye(3), -np.eye(3), [[1.0, 0.0, -1e-30], [1e-20, 0.0, -1.0]]]))
    images = np.stack([lobe(mu, 1.0, axis)[5] for axis in np.eye(3)], axis=1)
    np.testing.assert_allclose(images[:, 2], mu, atol=3e-7)
    np.testing.assert_allclose(images @ images.transpose(0, 2, 1), np.broadcast_to(np.eye(3), images.shape), atol=8e-7)


@pytest.mark.parametrize("kappa", KAPPAS)
def test_round_trip(kappa):
    """From the sample back to the two numbers, in float64."""
    u = (np.random.default_rng(9).integers(0, 2**24, size=(20_000, 2)) * 2.0**-24).astype(np.float32)
    for mu in MUS.values():
        mu = np.asarray(mu, np.float32)
        *_, sample, _ = lobe(mu, kappa, u=u)
        basis = np.stack([lobe(mu, 1.0, axis)[5][0] for axis in np.eye(3)])
        local = oracle.unit(sample) @ oracle.unit(basis).T
        h = 0.5 * np.sum((oracle.unit(sample) - oracle.unit(mu)) ** 2, axis=1)
        # a coordinate is off by 2e-7 at most, and the distribution function of h has slope kappa exp(-kappa h) / (...)
        assert np.abs(oracle.cdf(kappa, h) - u[:, 0]).max() < 4e-7 * (1.0 + np.sqrt(kappa))
        phi = np.mod(np.arctan2(local[:, 1], local[:, 0]) / (2.0 * np.pi) - u[:, 1] + 0.5, 1.0) - 0.5
        r = np.hypot(local[:, 0], local[:, 1])
        assert (np.abs(phi) * r).max() < 3e-7


SHAPE, PER_CELL = (24, 12), 4


@pytest.mark.parametrize("kappa", KAPPAS)
def test_samples_follow_the_density(kappa):
    """In cells of a chart (q / (1 + q), azimuth) with q = c h, which spreads the lobe over the unit square."""
    c = 0.5 + kappa
    end = 2.0 * c / (1.0 + 2.0 * c)
    a, b, area = nodes(SHAPE, PER_CELL)
    q = a * end / (1.0 - a * end)
    jacobian = 2.0 * np.pi * end / (c * (1.0 - a * end) ** 2)
    u = (np.random.default_rng(int(kappa)).integers(0, 2**24, size=(N, 2)) * 2.0**-24).astype(np.float32)
    for mu in MUS.values():
        mu = np.asarray(mu, np.float32)
        pdf, *_ = lobe(mu, kappa, around(mu, q / c, 2.0 * np.pi * b))
        expected = cell_sums(pdf * jacobian * area, SHAPE, PER_CELL)
        assert expected.sum() == pytest.approx(1.0, abs=2e-3)
        expected /= expected.sum()  # quadrature error; the integral itself was tested above
        *_, sample, _ = lobe(mu, kappa, u=u)
        h = 0.5 * np.sum((oracle.unit(sample) - oracle.unit(mu)) ** 2, axis=1)
        local = sample @ oracle.frame(mu).T
        azimuth = np.mod(np.arctan2(local[:, 1], local[:, 0]) / (2.0 * np.pi), 1.0)
        counts = histogram(c * h / (1.0 + c * h) / end / (1.0 + 1e-7), azimuth, SHAPE)
        assert p_value(counts, expected) > sidak(len(KAPPAS) * len(MUS))


@pytest.mark.parametrize("kappa", KAPPAS)
@pytest.mark.parametrize("other_kappa", [0.0, 1e-6, vmf.COSINE_KAPPA, 50.0, 1e6])
def test_product(kappa, other_kappa):
    """exp(-loss) exp(-kappa' h') is the product of the two exponentials, everywhere."""
    rng = np.random.default_rng(13)
    mu, other_mu, w = (oracle.unit(rng.normal(size=(300, 3))).astype(np.float32) for _ in range(3))
    other_mu[:30], other_mu[30:60] = mu[:30], -mu[:30]
    mu[30:60] = mu[:30]
    other_mu[60:100] = oracle.unit(mu[60:100] + rng.normal(size=(40, 3)) / np.sqrt(1.0 + kappa))
    w[::3] = oracle.unit(mu[::3] + rng.normal(size=(100, 3)) / np.sqrt(1.0 + kappa))
    product_mu, product_kappa, loss = run(product_kernel, (3, 1, 1), mu, kappa, other_mu, other_kappa)
    np.testing.assert_allclose(np.linalg.norm(product_mu, axis=1), 1.0, atol=3e-7)
    kappa, other_kappa = float(np.float32(kappa)), float(np.float32(other_kappa))
    mu, other_mu, w = oracle.unit(mu), oracle.unit(other_mu), oracle.unit(w)
    s = kappa * mu + other_kappa * other_mu
    absolute = 1e-15 + 3e-7 * min(kappa, other_kappa)  # opposite lobes cancel
    np.testing.assert_allclose(product_kappa, np.linalg.norm(s, axis=1), rtol=1e-6, atol=absolute)
    h, other_h = (0.5 * np.sum((w - m) ** 2, axis=1) for m in (mu, other_mu))
    expected = kappa * h + other_kappa * other_h
    distance = np.linalg.norm(oracle.unit(product_mu) - w, axis=1)
    found = loss + product_kappa * 0.5 * distance**2
    # relative rounding, and that of mu' to float32
    tolerance = 1e-6 * expected + product_kappa * (3e-7 * distance + 1e-14) + absolute
    assert np.all(np.abs(found - expected) <= tolerance)


def test_the_cosine_lobe_is_as_good_as_documented():
    def density(c, kappa):
        return kappa / (2.0 * np.pi * -np.expm1(-2.0 * kappa)) * np.exp(kappa * (c - 1.0))

    def cosine(c):
        return max(c, 0.0) / np.pi

    def over_sphere(f, low=-1.0):
        return 2.0 * np.pi * (integrate.quad(f, low, 0.0)[0] + integrate.quad(f, 1e-300, 1.0)[0])

    def square(kappa):
        return over_sphere(lambda c: (density(c, kappa) - cosine(c)) ** 2)

    def divergence(kappa):
        return over_sphere(lambda c: cosine(c) * np.log(cosine(c) / density(c, kappa)), low=0.0)

    kappa = float(vmf.COSINE_KAPPA)
    assert kappa == 2.19
    assert np.sqrt(square(kappa) / (4.0 * np.pi)) == pytest.approx(0.0247, abs=1e-4)
    assert np.sqrt(square(kappa) / over_sphere(lambda c: cosine(c) ** 2)) == pytest.approx(0.190, abs=1e-3)
    assert max(abs(density(c, kappa) - cosine(c)) for c in np.linspace(-1, 1, 2001)) == pytest.approx(0.0440, abs=1e-4)
    assert density(1.0, kappa) == pytest.approx(0.3530, abs=1e-4)
    assert 0.5 * over_sphere(lambda c: abs(density(c, kappa) - cosine(c))) == pytest.approx(0.132, abs=1e-3)
    assert divergence(kappa) == pytest.approx(0.1266, abs=1e-4)
    assert 2.0 * np.pi * integrate.quad(density, -1.0, 0.0, (kappa,))[0] == pytest.approx(0.1007, abs=1e-4)
    for function, best, value in ((square, 2.2925, None), (divergence, 2.9515, 0.0919)):
        found = optimize.minimize_scalar(function, bounds=(1.0, 5.0), method="bounded")
        assert found.x == pytest.approx(best, abs=1e-3)
        assert value is None or found.fun == pytest.approx(value, abs=1e-4)
