"""Values of encodings, activations, losses and whole models against the float64 oracle."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nn_models import GRID, NPM, make
from nn_oracle import Oracle, loss_terms

import nn
from nn import activations

TOLERANCE = 1e-6
PARTS = {
    "identity": ({"otype": "Identity", "scale": 2.5, "offset": -0.75}, 3),
    "frequency": ({"otype": "Frequency", "n_frequencies": 12}, 2),
    "triangle": ({"otype": "TriangleWave", "n_frequencies": 12}, 2),
    "one blob": ({"otype": "OneBlob", "n_bins": 16}, 2),
    "one blob, 5 bins": ({"otype": "OneBlob", "n_bins": 5}, 1),
    "one blob, 1 bin": ({"otype": "OneBlob", "n_bins": 1}, 1),
    **{f"harmonics {n}": ({"otype": "SphericalHarmonics", "degree": n}, 3) for n in (1, 4, 8)},
    "hash grid": (GRID, 3),
    "hash grid, 2-D": ({**GRID, "n_levels": 6, "interpolation": "Linear", "per_level_scale": 2.0}, 2),
    "dense grid": ({**GRID, "type": "Dense", "n_features_per_level": 4}, 3),
    "dense grid, 1-D": ({**GRID, "type": "Dense", "n_features_per_level": 1, "interpolation": "Linear"}, 1),
    "tiled grid": ({**GRID, "type": "Tiled", "interpolation": "Nearest", "n_features_per_level": 8}, 2),
    "hash grid, 4-D": ({**GRID, "interpolation": "Linear", "n_levels": 2}, 4),
}


def inputs(n, dims, seed=0, low=-0.25, high=1.25):
    return np.random.default_rng(seed).uniform(low, high, (n, dims)).astype(np.float32)


def check(value, expected, size, tolerance=TOLERANCE):
    error = np.abs(value - expected)
    allowed = tolerance * size + 1e-30
    worst = np.unravel_index(np.argmax(error / allowed), error.shape) if error.size else None
    assert (error <= allowed).all(), f"{error[worst] / size[worst]:.3g} of the absolute terms at {worst}"


@pytest.mark.parametrize("name", PARTS)
def test_encoding(name):
    part, dims = PARTS[name]
    model = make(part, n_in=dims)
    x = inputs(300, dims)
    if part["otype"] == "SphericalHarmonics":
        v = np.random.default_rng(1).normal(size=(300, 3))
        x = (v / np.linalg.norm(v, axis=1, keepdims=True) * 0.5 + 0.5).astype(np.float32)
    expected, size = Oracle(model).encode(x.astype(np.float64), model.parameters.numpy().astype(np.float64))
    check(model.encode(0, x), expected, size)


def test_one_blob_sums_to_one_on_the_circle():
    model = make({"otype": "OneBlob", "n_bins": 8}, n_in=1)
    sums = model.encode(0, inputs(200, 1, low=0, high=1)).sum(axis=1)
    np.testing.assert_allclose(sums, 1, atol=2e-6)


@pytest.mark.parametrize("execution", ["blocks", "tiles"])
@pytest.mark.parametrize("interpolation", ["Linear", "Smoothstep"])
def test_vertices_of_a_grid(interpolation, execution):
    """There the features are those of the vertex and no other's, to the last bit, and so are their gradients."""
    grid = {"otype": "DenseGrid", "n_levels": 1, "n_features_per_level": 2, "base_resolution": 5,
            "interpolation": interpolation}  # fmt: skip
    model = make(grid, n_in=2, n_out=2, network={"n_hidden_layers": 0}, execution=execution)
    table = model.parameters.numpy()[-model.encoding.n_params :].reshape(-1, 2)
    i, j = np.mgrid[1:5, 1:5].reshape(2, -1)
    x = ((np.stack([i, j], 1) - 0.5) / 4).astype(np.float32)  # a point lies at 4 x + 1/2; exact in binary
    np.testing.assert_array_equal(model.encode(0, x), table[i + 5 * j])
    model.forward(x[3:4])
    model.backward(np.ones((1, 2), np.float32))
    touched = model.gradients.numpy()[-model.encoding.n_params :].reshape(-1, 2).any(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(touched), [i[3] + 5 * j[3]])


@pytest.mark.parametrize("name", activations.NAMES)
def test_activation_of_hidden_and_output_layers(name):
    span = 1 if name == "Exponential" else 4  # exponentials of exponentials overflow
    x = inputs(300, 3, low=-span, high=span)
    for network in ({"activation": name}, {"output_activation": name}, {"activation": name, "n_hidden_layers": 3}):
        model = make(network=network)
        expected, size = Oracle(model).forward(x, model.parameters.numpy())
        check(model.inference(x), expected, size)


def test_activations_of_large_logits():
    """A network that is the identity shows the activation itself at ±1e4."""
    x = np.array([[-1e4], [-100], [-1e-3], [0], [1e-3], [100], [1e4]], np.float32)
    for name in activations.NAMES:
        model = make(network={"n_hidden_layers": 0, "output_activation": name}, n_in=1, n_out=1)
        model.parameters.fill_(1.0)
        expected, size = Oracle(model).forward(x, model.parameters.numpy())
        y = model.inference(x)
        if name == "Exponential":
            assert np.isinf(y[-1]) and (y[:-2] >= 0).all()
            continue
        if name == "Sine":  # the angle of 1e4 radians is exact
            np.testing.assert_allclose(y, expected, atol=1e-6)
            continue
        check(y, expected, size)
        if name in ("Sigmoid", "Softplus", "Squareplus"):  # also the small values to full relative precision
            np.testing.assert_allclose(y, expected, rtol=2e-6, atol=1e-38)


@settings(max_examples=25, deadline=None)
@given(
    n=st.sampled_from([0, 1, 7, 17, 128, 129, 255, 1000]),
    n_in=st.integers(1, 40),
    n_out=st.integers(1, 70),
    width=st.sampled_from([1, 16, 17, 32, 64, 100, 128]),
    depth=st.integers(0, 4),
    bias=st.booleans(),
)
def test_network_of_any_shape(n, n_in, n_out, width, depth, bias):
    model = make(network={"n_neurons": width, "n_hidden_layers": depth, "bias": bias}, n_in=n_in, n_out=n_out)
    x = inputs(n, n_in, seed=n + n_in)
    y = model.inference(x)
    assert y.shape == (n, n_out)
    if n:
        check(y, *Oracle(model).forward(x, model.parameters.numpy()))
    np.testing.assert_array_equal(model.forward(x), y)


def test_npm_model():
    model = nn.Model.from_config(NPM, 9, 32, threads=2)
    values = model.parameters.numpy()
    values[model.n_matrix_params :] *= 1e4
    x = inputs(1000, 9, low=0, high=1)
    check(model.inference(x, averaged=False), *Oracle(model).forward(x, values))


@pytest.mark.parametrize("name", ["L1", "L2", "RelativeL1", "RelativeL2", "RelativeL2Luminance", "MAPE", "SMAPE",
                                  "CrossEntropy", "Variance"])  # fmt: skip
def test_loss_value(name):
    model = make(n_out=6, network={"output_activation": "Sigmoid"}, loss={"otype": name})
    x, target = inputs(255, 3), inputs(255, 6, low=0, high=2)
    y = np.empty((255, 6), np.float32)
    loss = model.compute_gradients(x, target, outputs=y)
    expected = loss_terms(name, y.astype(np.float64), target.astype(np.float64))
    assert abs(loss - expected.mean()) <= 2e-6 * np.abs(expected).mean()
    np.testing.assert_array_equal(y, model.inference(x))
