"""Gradients with respect to raw outputs against float64 finite differences, and the loss against the divergence."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

import nn
from guiding.distributions.vmf import COSINE_KAPPA
from guiding.distributions.vmf_mixture import make_vmf_mixture
from tests.guiding import vmf_oracle as oracle
from tests.guiding.test_vmf_mixture import directions, mixtures
from tests.guiding.vmf_kernels import DEVICE, evaluate

CASES = [(1, "angles"), (1, "vector"), (2, "angles"), (2, "vector"), (8, "angles"), (8, "vector")]
RANGES = [(-19.0, -5.0), (-5.0, 3.0), (3.0, 8.0), (11.5, 13.9)]  # of log kappa: to 0, and 1e5 to 1e6
N = 400


def share_errors(logs, sizes):
    """Shares exp(logs) over their sum, and how far they are off if the logs are off by 3e-7 of the sizes.

    A single lobe has the share 1, exactly.
    """
    share = np.exp(logs - oracle.log_sum(logs)[:, None])
    error = 3e-7 * sizes
    others = np.sum(share * error, axis=1, keepdims=True) - share * error + (1.0 - share) * error
    return share, share * others


def bounds(raw, direction, at, w, other_mu, other_kappa):
    """Bounds [n, P] on the rounding of the gradient of the product's log p at the decoded mixture (kappa, mu).

    Each entry is a difference of two means over lobes, by responsibility and by share of the product. Every factor is
    off by 1e-6 of its size, apart from what these weights are off by.
    """
    log_weight = oracle.decode(raw, direction)[0]
    kappa, mu = at
    mixture = log_weight, kappa, oracle.unit(mu)
    distance = oracle.length(mixture[2] - oracle.unit(w)[:, None, :])
    apart = oracle.length(mixture[2] - oracle.unit(other_mu)[:, None, :])
    other_kappa = other_kappa[:, None]
    joint = oracle.length(kappa[..., None] * mixture[2] + (other_kappa * oracle.unit(other_mu))[:, None, :])
    loss = kappa + other_kappa - joint
    h, base = 0.5 * distance**2, 2.0 + np.abs(log_weight) + np.log1p(kappa)
    share, share_error = share_errors(oracle.log_terms(mixture, w), base + kappa * h)
    masses = oracle.product_log_masses(mixture, other_mu, other_kappa[:, 0])
    mass, mass_error = share_errors(masses, base + np.log1p(joint) + 3.0 * loss)
    share_error, mass_error = share_error + 1e-6 * share, mass_error + 1e-6 * mass
    noise = 1e-15 * kappa * (share + mass)  # of the differences in float64

    mean, joint_mean = 1.0 / (1.0 + kappa), 1.0 / (1.0 + joint)  # of h, about; and the mean cosine over kappa
    turn = joint_mean * other_kappa * (1.0 + other_kappa / (1.0 + kappa + other_kappa)) * apart**2
    result = np.empty((*kappa.shape, oracle.per_lobe(direction)))
    result[..., 0] = share_error + mass_error + 1e-15
    result[..., 1] = kappa * (share_error * (mean + h) + mass_error * (mean + joint_mean + turn)) + noise
    pull = kappa * (share_error * distance + mass_error * joint_mean * other_kappa * apart) + noise
    turned = np.stack([m[2].imag * 1e30 for m in oracle.derivatives(raw, direction)], axis=1)
    turned = turned.reshape(len(raw), kappa.shape[1], -1, kappa.shape[1], 3)
    for k in range(kappa.shape[1]):
        jacobian = np.linalg.norm(turned[:, k, 2:, k], axis=-1)
        if direction == "vector":  # its columns are differences
            jacobian = np.broadcast_to(jacobian.max(axis=1, keepdims=True), jacobian.shape)
        result[:, k, 2:] = pull[:, k, None] * jacobian
    return result.reshape(raw.shape) + 1e-35  # underflow of float32


@pytest.mark.parametrize("log_kappa", RANGES)
@pytest.mark.parametrize(("n_lobes", "direction"), CASES)
def test_gradient_of_log_pdf(n_lobes, direction, log_kappa):
    raw = mixtures(21, N, n_lobes, direction, log_kappa)
    w = directions(22, raw, direction)
    found = evaluate(raw, w, direction, factor=-2.5)
    at = found.kappa.astype(np.float64), found.mu
    expected = -2.5 * oracle.gradient(lambda m: oracle.log_pdf(m, w), raw, direction, at)
    bound = 2.5 * bounds(raw, direction, at, w, w, np.zeros(N))
    error = np.abs(found.gradient - expected)
    assert np.all(error <= bound)


def test_gradient_of_one_lobe_to_1e_5_relative():
    """From kappa = 5e-9 to 1e6; the bounds above are those of many lobes, which compete."""
    for direction in ("angles", "vector"):
        for seed, log_kappa in enumerate(RANGES):
            raw = mixtures(27 + seed, N, 1, direction, log_kappa)
            w = directions(28 + seed, raw, direction)
            found = evaluate(raw, w, direction)
            at = found.kappa.astype(np.float64), found.mu
            expected = oracle.gradient(lambda m, w=w: oracle.log_pdf(m, w), raw, direction, at)
            assert np.all(found.gradient[:, 0] == 0.0)
            largest = np.abs(expected).max(axis=1, keepdims=True)
            np.testing.assert_allclose(found.gradient / largest, expected / largest, atol=1e-5)


def test_the_derivatives_of_the_oracle():
    """Steps along the imaginary axis, which resolve any kappa, against plain central differences in float64."""
    for direction in ("angles", "vector"):
        raw = mixtures(29, N, 3, direction, (-3.0, 4.0)).astype(np.float64)[N // 4 :]
        w, other_mu = directions(30, raw, direction), directions(31, raw, direction)
        other_kappa = np.full(len(raw), COSINE_KAPPA)

        def product(mixture, w=w, other_mu=other_mu, other_kappa=other_kappa):
            return oracle.product_log_pdf(mixture, w, other_mu, other_kappa)

        for function in (lambda m, w=w: oracle.log_pdf(m, w), product):
            found = oracle.gradient(function, raw, direction)
            steps = 1e-6 * np.eye(raw.shape[1])
            high, low = ([function(oracle.decode(raw + sign * step, direction)) for step in steps] for sign in (1, -1))
            np.testing.assert_allclose(found, (np.transpose(high) - np.transpose(low)) / 2e-6, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("log_kappa", RANGES)
@pytest.mark.parametrize("other_kappa", [1e-6, COSINE_KAPPA, 1e3])
@pytest.mark.parametrize(("n_lobes", "direction"), CASES)
def test_gradient_of_product_log_pdf(n_lobes, direction, other_kappa, log_kappa):
    raw = mixtures(23, N, n_lobes, direction, log_kappa)
    w = directions(24, raw, direction)
    other_mu = oracle.unit(np.random.default_rng(25).normal(size=(N, 3))).astype(np.float32)
    other_mu[:100] = directions(26, raw[:100], direction)
    other_kappa = np.full(N, float(np.float32(other_kappa)))
    found = evaluate(raw, w, direction, factor=3.0, other_mu=other_mu, other_kappa=other_kappa)
    at = found.kappa.astype(np.float64), found.mu
    expected = 3.0 * oracle.gradient(lambda m: oracle.product_log_pdf(m, w, other_mu, other_kappa), raw, direction, at)
    bound = 3.0 * bounds(raw, direction, at, w, other_mu, other_kappa)
    error = np.abs(found.product_gradient - expected)
    assert np.all(error <= bound)


def test_beyond_the_limit_of_kappa_its_gradient_is_zero():
    raw = mixtures(32, 100, 2, "vector", (20.5, 1e4))
    raw[::2, 1] *= -1.0
    found = evaluate(raw, directions(33, raw, "vector"), "vector", other_kappa=COSINE_KAPPA)
    for gradient in (found.gradient, found.product_gradient):
        assert np.all(gradient[:, 1::5] == 0.0)
        assert np.count_nonzero(gradient[:, 2:5]) > 100


# --- the loss --------------------------------------------------------------------------------------------------------

SCALE = 3.0  # the integral of the function to learn
TARGET = oracle.encode(
    np.array([0.5, 0.3, 0.2]),
    np.array([30.0, 3.0, 0.2]),
    np.array([[0.2, 0.5, 0.8], [-0.9, 0.1, -0.3], [0.1, -0.8, 0.1]]),
    "vector",
)
LEARNERS = {direction: mixtures(34, 2, 4, direction, (-2.0, 2.5)) for direction in ("angles", "vector")}


def draw(n, seed):
    """Directions [n, 3] from half the target and half the uniform density, and weights f / q."""
    rng = np.random.default_rng(seed)
    w = oracle.unit(rng.normal(size=(n, 3))).astype(np.float32)
    w[::2] = evaluate(TARGET, np.tile((0, 0, 1.0), (len(w[::2]), 1)), "vector", rng.random((len(w[::2]), 3))).sample
    f = np.exp(oracle.log_pdf(oracle.decode(TARGET[None], "vector"), w))
    return w, SCALE * f / (0.5 * f + 0.125 / np.pi)


def divergence(mixture):
    """KL(f / SCALE || mixture) [1], by quadrature; derivatives pass through."""
    w, area = oracle.quadrature((0, 0, 1), 2.0, 96, 192)
    log_f = oracle.log_pdf(oracle.decode(TARGET[None], "vector"), w)
    return np.sum(area * np.exp(log_f) * (log_f - oracle.log_pdf(mixture, w)), axis=-1, keepdims=True)


def run_loss(raw, w, weight, direction, factor):
    """The loss of every row and its gradient [n, P], as `nn` calls it."""
    f = make_vmf_mixture(raw.size // oracle.per_lobe(direction), direction)
    n_params, kl_loss, n = f.n_params, f.kl_loss, len(w)

    @wp.kernel(enable_backward=False, module="unique")
    def loss_kernel(
        y: wp.array[wp.float32],
        target: wp.array2d[wp.float32],
        scale: wp.float32,
        loss: wp.array[wp.float32],
        dL_dy: wp.array[wp.float32],
    ):
        i = wp.tid()
        loss[i] = kl_loss(y, 0, target, i, scale, dL_dy, i * n_params)

    target = np.concatenate([w, np.asarray(weight)[:, None]], axis=1).astype(np.float32)
    inputs = [wp.array(raw, device=DEVICE), wp.array(target, device=DEVICE), factor]
    outputs = [wp.zeros(n, dtype=wp.float32, device=DEVICE), wp.full(n * n_params, np.nan, wp.float32, device=DEVICE)]
    wp.launch(loss_kernel, dim=n, inputs=inputs, outputs=outputs, device=DEVICE)
    return outputs[0].numpy().astype(np.float64), outputs[1].numpy().reshape(n, n_params).astype(np.float64)


def z_scores(samples, expected):
    return (samples.mean(axis=0) - expected) / (samples.std(axis=0) / np.sqrt(len(samples)))


@pytest.mark.parametrize("direction", ["angles", "vector"])
def test_the_loss_is_the_divergence_up_to_a_constant(direction):
    """Means of the loss less SCALE times the divergence are the same, SCALE times the entropy, for every mixture; and
    the mean gradient is SCALE times that of the divergence. z-tests, false alarms 1e-5 each, 1e-4 for a gradient."""
    w, area = oracle.quadrature((0, 0, 1), 2.0, 96, 192)
    log_f = oracle.log_pdf(oracle.decode(TARGET[None], "vector"), w)
    entropy = -np.sum(area * np.exp(log_f) * log_f)
    for seed, raw in enumerate(LEARNERS[direction]):
        w, weight = draw(100_000, 35 + seed)
        loss, gradient = run_loss(raw, w, weight, direction, 0.5)
        kl = divergence(oracle.decode(raw[None], direction))[0]
        assert kl > 0.1
        assert abs(z_scores(loss, SCALE * (kl + entropy))) < stats.norm.isf(0.5e-5)
        expected = 0.5 * SCALE * oracle.gradient(divergence, raw[None], direction)[0]
        assert np.abs(z_scores(gradient, expected)).max() < stats.norm.isf(0.5e-4 / raw.size)


def test_a_weight_of_zero_gives_a_gradient_of_zero():
    raw = LEARNERS["angles"][0]
    loss, gradient = run_loss(raw, np.full((3, 3), np.nan), np.zeros(3), "angles", 1.0)
    assert np.all(loss == 0.0)
    assert np.all(gradient == 0.0)


@pytest.mark.parametrize("direction", ["angles", "vector"])
def test_a_network_learns_a_target_by_this_loss(direction):
    mixture = make_vmf_mixture(4, direction)
    model = nn.Model.from_config(
        {
            "loss": {"otype": "L2"},
            "optimizer": {"otype": "Adam", "learning_rate": 0.01},
            "encoding": {"otype": "Identity"},
            "network": {
                "otype": "FullyFusedMLP",
                "activation": "ReLU",
                "output_activation": "None",
                "n_neurons": 16,
                "n_hidden_layers": 1,
            },
        },
        n_input_dims=1,
        n_output_dims=mixture.n_params,
        device=DEVICE,
        seed=1,
    )
    ones = np.ones((1024, 1), np.float32)
    target = np.zeros((1024, 4), np.float32)
    divergences = []
    for step in range(250):
        if step in (0, 249):
            divergences.append(divergence(oracle.decode(model.inference(ones[:1]), direction))[0])
        target[:, :3], target[:, 3] = draw(1024, 1000 + step)
        model.train_step(ones, target, loss=mixture.kl_loss, report=False)
    assert divergences[0] > 0.3
    assert divergences[1] < 0.02
