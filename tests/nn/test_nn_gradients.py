"""Gradients against float64 finite differences of the oracle."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nn_models import GRID, NPM, make
from nn_oracle import Oracle
from test_nn_values import PARTS, inputs

import nn
from nn import activations
from nn.encodings import grid as grid_module

STEP = 1e-6


def numerical(function, at, found=None, most=120):
    """Central differences of a scalar function along entries of `at` (float64, any shape).

    With many entries, those of `most` that are drawn at random and `found` in all others.
    """
    gradient = np.zeros(at.size) if found is None else found.astype(np.float64).reshape(-1)
    flat = at.reshape(-1)
    indices = range(at.size)
    if found is not None and at.size > most:
        rng = np.random.default_rng(at.size)
        touched = np.flatnonzero(gradient)
        indices = np.union1d(rng.choice(touched, min(most, touched.size), False), rng.choice(at.size, most // 4, False))
    for i in indices:
        kept = flat[i]
        flat[i] = kept + STEP
        high = function()
        flat[i] = kept - STEP
        gradient[i] = (high - function()) / (2 * STEP)
        flat[i] = kept
    return gradient.reshape(at.shape)


def weighted(oracle, x, values, weights, network=0):
    return float(np.sum(oracle.forward(x, values, network)[0] * weights))


def check(value, expected, scale):
    """Within 2e-5 of the largest gradient: rounding in float32, and of the differences."""
    assert np.abs(value - expected).max() <= 2e-5 * scale, np.abs(value - expected).max() / scale


@pytest.mark.parametrize("name", PARTS)
def test_encoding_gradients(name):
    part, dims = PARTS[name]
    if part["otype"] in ("Frequency", "TriangleWave"):
        part = {**part, "n_frequencies": 5}
    model = make(part, n_in=dims, n_out=2, network={"n_hidden_layers": 0})
    n = 17
    x = inputs(n, dims, seed=3)
    weights = np.random.default_rng(5).normal(size=(n, 2)).astype(np.float32)
    oracle, values = Oracle(model), model.parameters.numpy().astype(np.float64)
    model.forward(x)
    dL_dx = model.backward(weights, input_gradient=True)
    gradients = model.gradients.numpy()

    x64 = x.astype(np.float64)
    if part["otype"] != "Grid" or part.get("interpolation") != "Nearest":
        expected = numerical(lambda: weighted(oracle, x64, values, weights), x64)
        check(dL_dx, expected, np.abs(expected).max())
    else:
        assert (dL_dx == 0).all()
    expected = numerical(lambda: weighted(oracle, x64, values, weights), values, gradients)
    check(gradients, expected, np.abs(expected).max())


@pytest.mark.parametrize("name", activations.NAMES)
def test_gradients_through_activations(name):
    for network in ({"activation": name, "n_hidden_layers": 2, "bias": True}, {"output_activation": name}):
        model = make(network=network, n_in=3, n_out=3)
        x = inputs(17, 3, low=-1, high=1)
        weights = np.random.default_rng(5).normal(size=(17, 3)).astype(np.float32)
        oracle, values = Oracle(model), model.parameters.numpy().astype(np.float64)
        model.forward(x)
        dL_dx = model.backward(weights, input_gradient=True)
        x64 = x.astype(np.float64)
        expected = numerical(lambda o=oracle, v=values, a=x64, w=weights: weighted(o, a, v, w), values)
        check(model.gradients.numpy(), expected, np.abs(expected).max())
        expected = numerical(lambda o=oracle, v=values, a=x64, w=weights: weighted(o, a, v, w), x64)
        check(dL_dx, expected, np.abs(expected).max())


@pytest.mark.parametrize("name", ["L1", "L2", "RelativeL1", "RelativeL2", "RelativeL2Luminance", "MAPE", "SMAPE",
                                  "CrossEntropy", "Variance"])  # fmt: skip
def test_gradients_of_losses(name):
    model = make(n_out=6, network={"output_activation": "Sigmoid"}, loss={"otype": name})
    x, target = inputs(17, 3), inputs(17, 6, low=0.2, high=2)
    oracle, values = Oracle(model), model.parameters.numpy().astype(np.float64)
    held, _ = oracle.forward(x, values)
    model.compute_gradients(x, target)
    expected = numerical(lambda: oracle.loss(x, values, target, held), values, model.gradients.numpy())
    check(model.gradients.numpy(), expected, np.abs(expected).max())


@settings(max_examples=15, deadline=None)
@given(
    n=st.sampled_from([0, 1, 17, 129, 255, 1000]),
    n_in=st.integers(1, 20),
    n_out=st.integers(1, 40),
    width=st.sampled_from([1, 16, 33, 64]),
    depth=st.integers(0, 3),
    bias=st.booleans(),
    threads=st.sampled_from([1, 2]),
)
def test_gradients_of_any_shape(n, n_in, n_out, width, depth, bias, threads):
    """Along the gradient and along random directions, for smooth networks of any shape and batches of any size."""
    network = {"n_neurons": width, "n_hidden_layers": depth, "bias": bias, "activation": "Tanh"}
    model = make(network=network, n_in=n_in, n_out=n_out, threads=threads)
    rng = np.random.default_rng(n)
    x, target = inputs(n, n_in), rng.normal(size=(n, n_out)).astype(np.float32)
    loss = model.compute_gradients(x, target)
    gradient = model.gradients.numpy().astype(np.float64)
    if n == 0:
        assert loss == 0.0
        assert (gradient == 0).all()
        return
    oracle, values = Oracle(model), model.parameters.numpy().astype(np.float64)
    for direction in (gradient / np.linalg.norm(gradient), rng.normal(size=values.size) / np.sqrt(values.size)):
        up = oracle.loss(x, values + 1e-5 * direction, target)
        down = oracle.loss(x, values - 1e-5 * direction, target)
        assert abs((up - down) / 2e-5 - gradient @ direction) <= 1e-5 * np.abs(gradient * direction).sum() + 1e-9


def test_gradients_of_the_npm_model():
    model = nn.Model.from_config(NPM, 9, 32, threads=2)
    values = model.parameters.numpy()
    values[model.n_matrix_params :] *= 1e4
    rng = np.random.default_rng(7)
    x, target = inputs(255, 9, low=0, high=1), rng.normal(size=(255, 32)).astype(np.float32)
    model.compute_gradients(x, target)
    gradient = model.gradients.numpy().astype(np.float64)
    oracle, values = Oracle(model), values.astype(np.float64)
    touched = np.flatnonzero(gradient)
    for seed in range(4):
        direction = np.zeros(values.size)
        some = touched[: model.n_matrix_params] if seed == 0 else np.random.default_rng(seed).choice(touched, 3000)
        direction[some] = np.random.default_rng(seed).normal(size=some.size)
        up = oracle.loss(x, values + 1e-7 * direction, target)
        down = oracle.loss(x, values - 1e-7 * direction, target)
        assert abs((up - down) / 2e-7 - gradient @ direction) <= 2e-5 * np.abs(gradient * direction).sum() + 1e-8


def test_networks_that_share_an_encoding():
    """The second reads all parts, the first the grid only; gradients of both add up in the grid."""
    encoding = {"otype": "Composite", "nested": [{**GRID, "n_dims_to_encode": 3}, {"otype": "OneBlob", "n_bins": 4}]}
    networks = [{"otype": "MLP", "n_neurons": 16, "n_hidden_layers": 1, "n_parts": 1, "activation": "Tanh"},
                {"otype": "MLP", "n_neurons": 32, "n_hidden_layers": 2, "activation": "Tanh"}]  # fmt: skip
    model = make(encoding, networks, n_in=4, n_out=[2, 3])
    x = inputs(33, 4, low=0, high=1)
    targets = [inputs(33, 2, seed=1), inputs(33, 3, seed=2)]
    loss = model.compute_gradients(x, targets)
    oracle, values = Oracle(model), model.parameters.numpy().astype(np.float64)

    def total():
        return sum(oracle.loss(x, values, t, network=i) for i, t in enumerate(targets))

    assert loss == pytest.approx(total(), rel=1e-6)
    expected = numerical(total, values, model.gradients.numpy())
    check(model.gradients.numpy(), expected, np.abs(expected).max())
    outputs = [model.inference(x, network=i) for i in range(2)]
    for i, y in enumerate(outputs):
        np.testing.assert_allclose(y, oracle.forward(x, values, i)[0], rtol=1e-5, atol=1e-6)
    other = make(encoding, networks, n_in=4, n_out=[2, 3])
    slopes = [(2 * (y - t) / y.size).astype(np.float32) for y, t in zip(outputs, targets, strict=True)]
    for trained, arguments in ((model, {"target": targets}), (other, {"dL_dy": slopes})):
        trained.zero_gradients()
        trained.optimizer_step = lambda: None
        trained.train_step(x, **arguments)
    largest = np.abs(expected).max()
    np.testing.assert_allclose(other.gradients.numpy(), model.gradients.numpy(), rtol=0, atol=2e-6 * largest)
    for arguments, name in (({"target": targets[:1]}, "target"), ({"dL_dy": x}, "dL_dy")):
        with pytest.raises(nn.NnError, match=f"{name}: allowed: a list of 2 arrays, one for each network"):
            model.train_step(x, **arguments)
    with pytest.raises(nn.NnError, match=r"n_output_dims: found \[2\]; allowed: a number for each of the 2 networks"):
        make(encoding, networks, n_in=4, n_out=[2])


def test_given_gradient_equals_loss_gradient():
    model = make(GRID, n_out=2)
    x, target = inputs(300, 3), inputs(300, 2)
    model.compute_gradients(x, target)
    expected = model.gradients.numpy().copy()
    model.zero_gradients()
    y = model.forward(x)
    model.backward((2 * (y - target) / y.size).astype(np.float32))
    np.testing.assert_allclose(model.gradients.numpy(), expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    model.backward((2 * (y - target) / y.size).astype(np.float32))  # adds
    np.testing.assert_allclose(model.gradients.numpy(), 2 * expected, rtol=0, atol=2e-6 * np.abs(expected).max())


def test_one_sample_repeated_a_million_times():
    """Rounding must not grow with the number of equal terms."""
    model = make({**GRID, "n_levels": 2}, n_out=2, threads=2)
    x, target = inputs(1, 3, low=0, high=1), np.ones((1, 2), np.float32)
    model.compute_gradients(x, target)
    expected = model.gradients.numpy().copy()
    model.zero_gradients()
    model.compute_gradients(np.repeat(x, 1_000_000, axis=0), np.repeat(target, 1_000_000, axis=0))
    error = np.abs(model.gradients.numpy() - expected)
    assert (error <= 1e-4 * np.abs(expected)).all()


@pytest.mark.parametrize("kind", [(3, 2, "Smoothstep", True), (2, 2, "Linear", True), (2, 8, "Nearest", False)])
def test_both_executions_of_the_grid_agree(kind):
    """The kernels of Warp alone, which other devices run, against those of the CPU device."""
    import warp as wp

    dims, features, interpolation, hashed = kind
    part = {
        **GRID,
        "n_features_per_level": features,
        "interpolation": interpolation,
        "type": "Hash" if hashed else "Tiled",
    }
    model = make(part, n_in=dims, n_out=2)
    piece = model.encoding.parts[0]
    n = 100
    x = wp.array(inputs(n, dims), dtype=wp.float32)
    forward, atomic, to_inputs = grid_module.make_grid_kernels(*kind)
    encoded = wp.zeros((n, 16 * 3), dtype=wp.float32)
    entries = piece._view(model.parameters)
    levels = piece.cfg.n_levels
    wp.launch(forward, dim=(levels, n), inputs=[x, 0, 0, piece.levels, entries], outputs=[encoded, 1])
    expected = model.encode(0, x).numpy()
    np.testing.assert_allclose(encoded.numpy()[:, 1 : 1 + piece.n_features], expected, atol=1e-6)

    upstream = wp.array(inputs(n, 48, seed=9, low=-1, high=1), dtype=wp.float32)
    found, wanted = wp.zeros(piece.n_params, dtype=wp.float64), wp.zeros(model.n_params, dtype=wp.float32)
    wp.launch(atomic, dim=(levels, n), inputs=[x, 0, piece.levels, upstream, 0], outputs=[found])
    piece.backward_parameters(x, n, upstream, wanted, model._workers)
    np.testing.assert_allclose(found.numpy(), piece._view(wanted).numpy().ravel(), atol=2e-5)

    a, b = wp.zeros((n, dims), dtype=wp.float32), wp.zeros((n, dims), dtype=wp.float32)
    wp.launch(to_inputs, dim=n, inputs=[x, 0, 0, piece.levels, levels, entries, upstream, 0], outputs=[a])
    piece.backward_inputs(x, 0, n, model.parameters, upstream, b)
    np.testing.assert_allclose(a.numpy(), b.numpy(), atol=2e-4)
