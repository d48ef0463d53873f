"""Networks by thread blocks, here on the CPU device, and half precision: against float64, and against blocks of rows.

Few shapes of network, so that few kernels are built: a shape fixes precision, width, activations, and biases.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from nn_models import GRID, NPM, make
from nn_oracle import Oracle
from test_nn_gradients import numerical
from test_nn_values import inputs

import nn
from nn import ConfigError
from nn.cpu_mlp import round_to_precision

SMOOTH = {"n_neurons": 16, "bias": True, "activation": "SiLU", "output_activation": "Sine"}
# Largest relative rounding of an operand.
ROUNDING = {"fp32": 2.0**-24, "fp16": 2.0**-11, "bf16": 2.0**-8}
SMALLEST = {"fp32": 0.0, "fp16": 2.0**-25, "bf16": 0.0}


def pair(**arguments):
    """One model in both executions."""
    return make(**arguments), make(**arguments, execution="tiles")


def check(values, expected, size, precision, n_layers):
    """Each layer rounds its features and its weights, and adds up in float32."""
    error = np.abs(values - expected)
    if precision == "fp32":
        allowed = 1e-6 * size
    else:
        allowed = (2 * n_layers + 1) * (ROUNDING[precision] * size + SMALLEST[precision] * (1 + size))
    worst = np.unravel_index(np.argmax(error / allowed), error.shape)
    assert (error <= allowed).all(), f"{error[worst] / size[worst]:.3g} of the absolute terms at {worst}"


@wp.kernel(module="unique", module_options={"enable_backward": False})
def round_all(a: wp.array[wp.float32], precision: int):
    round_to_precision(a, wp.int64(0), a.shape[0], precision)


def test_rounding_is_that_of_the_types():
    """Random bits, random magnitudes, and the edges of half precision, bit for bit as PyTorch converts."""
    rng = np.random.default_rng(0)
    edges = [0, -0.0, np.inf, -np.inf, np.nan, 65504, 65519.99, 65520, -65520, 6e-8, 2.0**-25, 2.0**-25 * 1.0000001,
             3 * 2.0**-25, 2.0**-14, np.nextafter(np.float32(2.0**-14), np.float32(0)), 3.4e38]  # fmt: skip
    values = np.concatenate(
        [
            rng.integers(0, 2**32, 1_000_000, dtype=np.uint32).view(np.float32),
            (rng.normal(size=100_000) * 10.0 ** rng.uniform(-9, 6, 100_000)).astype(np.float32),
            np.array(edges, np.float32),
        ]
    )
    for code, dtype in ((1, torch.float16), (2, torch.bfloat16)):
        rounded = wp.array(values, dtype=wp.float32)
        wp.launch(round_all, dim=1, inputs=[rounded, code])
        expected = torch.from_numpy(values).to(dtype).float().numpy()
        np.testing.assert_array_equal(rounded.numpy(), expected)
        zero = expected == 0
        np.testing.assert_array_equal(np.signbit(rounded.numpy())[zero], np.signbit(expected)[zero])


@settings(max_examples=20, deadline=None)
@given(
    n=st.sampled_from([0, 1, 17, 64, 65, 255, 1000]),
    n_in=st.integers(1, 40),
    n_out=st.integers(1, 40),
    depth=st.integers(0, 4),
)
def test_tiles_of_any_shape(n, n_in, n_out, depth):
    """Values against float64 and all gradients against blocks of rows; inputs and outputs of several blocks."""
    blocks, tiles = pair(network={**SMOOTH, "n_hidden_layers": depth}, n_in=n_in, n_out=n_out)
    x, target = inputs(n, n_in, seed=n), inputs(n, n_out, seed=n + 1)
    y = tiles.inference(x)
    assert y.shape == (n, n_out)
    np.testing.assert_array_equal(tiles.forward(x), y)
    if n:
        check(y, *Oracle(tiles).forward(x, tiles.parameters.numpy()), "fp32", depth + 1)
    losses, outputs = [model.compute_gradients(x, target) for model in (blocks, tiles)], np.empty_like(y)
    assert losses[1] == pytest.approx(losses[0], rel=1e-6)
    expected = blocks.gradients.numpy()
    np.testing.assert_allclose(tiles.gradients.numpy(), expected, rtol=0, atol=2e-6 * np.abs(expected).max() + 1e-30)
    assert tiles.compute_gradients(x, target, outputs=outputs, report=False) is None
    np.testing.assert_array_equal(outputs, y)
    np.testing.assert_allclose(
        tiles.gradients.numpy(), 2 * expected, rtol=0, atol=4e-6 * np.abs(expected).max() + 1e-30
    )
    if n:
        slopes = []
        for model in (blocks, tiles):
            model.forward(x)
            slopes.append(model.backward(target, input_gradient=True))
        np.testing.assert_allclose(slopes[1], slopes[0], rtol=0, atol=4e-6 * np.abs(slopes[0]).max())


def test_gradients_of_tiles_against_differences():
    model = make(network={**SMOOTH, "n_hidden_layers": 2}, n_in=20, n_out=18, execution="tiles")
    x, target = inputs(70, 20), inputs(70, 18, seed=2)
    model.compute_gradients(x, target)
    oracle, values = Oracle(model), model.parameters.numpy().astype(np.float64)
    found = model.gradients.numpy()
    expected = numerical(lambda: oracle.loss(x, values, target), values, found)
    assert np.abs(found - expected).max() <= 2e-5 * np.abs(expected).max()


@pytest.mark.parametrize("precision", ["fp32", "fp16", "bf16"])
def test_both_executions_of_the_npm_model(precision):
    models, results = [], []
    for execution in ("blocks", "tiles"):
        model = nn.Model.from_config({**NPM, "precision": precision}, 9, 32, execution=execution)
        values = model.parameters.numpy()
        values[model.n_matrix_params :] *= 1e4
        models.append(model)
    rng = np.random.default_rng(3)
    x, target = rng.random((700, 9), np.float32), rng.random((700, 32), np.float32)
    expected, size = Oracle(models[0]).forward(x, values)
    for model in models:
        y = model.inference(x, averaged=False)
        check(y, expected, size, precision, 4)
        loss = model.compute_gradients(x, target)
        gradient = model.gradients.numpy().copy()
        losses = [model.train_step(x, target) for _ in range(3)]
        results.append((y, [loss, *losses], gradient, model.parameters.numpy()))
    # The order of sums differs, and may turn a rounding of half precision.
    tolerance = 1e-6 if precision == "fp32" else 4 * ROUNDING[precision]
    (y0, losses0, gradient0, parameters0), (y1, losses1, gradient1, parameters1) = results
    np.testing.assert_allclose(y1, y0, rtol=0, atol=tolerance * np.abs(y0).max())
    np.testing.assert_allclose(losses1, losses0, rtol=tolerance)
    np.testing.assert_allclose(gradient1, gradient0, rtol=0, atol=4 * tolerance * np.abs(gradient0).max())
    # Adam divides by the size of gradients, so that noise in vanishing ones moves parameters by whole steps
    moved = np.abs(parameters1 - parameters0)
    assert np.median(moved) <= 1e-6 and moved.max() <= 4 * 2e-2


@pytest.mark.parametrize("precision", ["fp16", "bf16"])
def test_gradients_in_half_precision(precision):
    """Against float64: within the roundings of a few layers, however large the batch is that they are averaged over."""
    single = make(network={"n_hidden_layers": 2, "n_neurons": 64}, n_in=8)
    half = make(network={"n_hidden_layers": 2, "n_neurons": 64}, n_in=8, precision=precision)
    for n in (17, 1 << 16):
        x, target = inputs(n, 8, low=0, high=1), inputs(n, 4, seed=2)
        for model in (single, half):
            model.zero_gradients()
            model.compute_gradients(x, target)
        expected = single.gradients.numpy()
        error = half.gradients.numpy() - expected
        assert np.linalg.norm(error) <= 8 * ROUNDING[precision] * np.linalg.norm(expected)
        assert np.linalg.norm(error) > 0.01 * ROUNDING[precision] * np.linalg.norm(expected)  # it is half precision


@pytest.mark.parametrize("execution", ["blocks", "tiles"])
def test_weights_that_overflow_half_precision(execution):
    """A weight of 1e5 is infinite there: the batch is skipped and counted, parameters and moments stay as they are."""
    model = make(GRID, precision="fp16", network={"n_neurons": 64}, execution=execution,
                 optimizer={"otype": "Adam"})  # fmt: skip
    x, target = inputs(50, 3), inputs(50, 4)
    model.train_step(x, target)
    values = model.parameters.numpy()
    kept, values[7] = values[7], 1e5
    before = model.state_dict()
    model.train_step(x, target)
    assert model.statistics["skipped_batches"] == 1
    for name, array in model.state_dict().items():
        if name != "optimizer.state":
            np.testing.assert_array_equal(array, before[name])
    values[7] = kept
    assert np.isfinite(model.train_step(x, target))
    assert model.statistics["steps"] == 2


def test_dynamic_loss_scale_finds_the_range_of_half_precision():
    """Gradients of 1e-9 vanish in half precision without a scale; with a dynamic one training goes on."""
    target_scale = 1e-4
    x = inputs(256, 3, low=0, high=1)
    target = (target_scale * np.sin(7 * x[:, :1])).astype(np.float32)
    gradient = np.full((256, 1), 1e-9, np.float32)
    found = {}
    for scale in (1.0, 2.0**15, "dynamic"):
        model = make(n_out=1, precision="fp16", network={"n_neurons": 64}, loss_scale=scale)
        model.forward(x)
        model.backward(gradient)
        found[scale] = np.abs(model.gradients.numpy()).max() / model.statistics["loss_scale"]
    single = make(n_out=1, network={"n_neurons": 64})
    single.forward(x)
    single.backward(gradient)
    expected = np.abs(single.gradients.numpy()).max()
    assert found[1.0] == 0
    for scale in (2.0**15, "dynamic"):
        assert found[scale] == pytest.approx(expected, rel=0.02)
    model = make(n_out=1, precision="fp16", network={"n_neurons": 64}, loss_scale="dynamic")
    before = model.compute_gradients(x, target)
    model.zero_gradients()
    for _ in range(200):
        loss = model.train_step(x, target)
    assert loss < 0.05 * before


@pytest.mark.parametrize("precision", ["fp32", "fp16"])
def test_networks_of_tiles_share_an_encoding(precision):
    """The first reads a part only: of what the other parts left it sees nothing, and gives them no gradient."""
    encoding = {"otype": "Composite", "nested": [{**GRID, "n_dims_to_encode": 3}, {"otype": "OneBlob", "n_bins": 40}]}
    networks = [{"otype": "MLP", "n_neurons": 16, "n_hidden_layers": 1, "n_parts": 1},
                {"otype": "MLP", "n_neurons": 16, "n_hidden_layers": 2}]  # fmt: skip
    x = inputs(33, 4, low=0, high=1)
    for order in (networks, networks[::-1]):
        models = pair(encoding=encoding, network=order, n_in=4, n_out=[2, 2], precision=precision)
        targets = [inputs(33, 2, seed=1), inputs(33, 2, seed=2)]
        tiles = models[1]
        tiles.compute_gradients(np.full_like(x, np.nan), targets)  # must leave no trace
        tiles.zero_gradients()
        losses = [model.compute_gradients(x, targets) for model in models]
        tolerance = 1e-6 if precision == "fp32" else 2e-3
        assert losses[1] == pytest.approx(losses[0], rel=tolerance)
        a, b = (model.gradients.numpy() for model in models)
        np.testing.assert_allclose(b, a, rtol=0, atol=tolerance * np.abs(a).max())
        y = x.copy()
        y[:, 3] = np.nan
        reader = 0 if order is networks else 1
        np.testing.assert_array_equal(tiles.inference(y, network=reader), tiles.inference(x, network=reader))
        assert np.isnan(tiles.inference(y, network=1 - reader)).all()


def test_tiles_train_as_blocks_do():
    """Optimiser, average, decay, clipping and latents of the execution for GPUs, over 20 steps."""
    optimizer = {"otype": "EMA", "decay": 0.9, "nested": {"otype": "ExponentialDecay", "decay_start": 5,
                 "decay_interval": 5, "decay_base": 0.5, "nested": {"otype": "SGD", "learning_rate": 0.3}}}  # fmt: skip
    models = pair(
        encoding=GRID, network={"n_neurons": 64}, optimizer=optimizer, gradient_clipping={"global_norm": 0.05}
    )
    rng = np.random.default_rng(0)
    for _ in range(20):
        x = rng.random((300, 3), np.float32)
        losses = [model.train_step(x, np.sin(5 * x @ np.ones((3, 4), np.float32))) for model in models]
        assert losses[1] == pytest.approx(losses[0], rel=1e-4)
    assert models[1].statistics == pytest.approx(models[0].statistics, rel=1e-3)
    a, b = (model.inference_parameters.numpy() for model in models)
    np.testing.assert_allclose(b, a, rtol=0, atol=1e-5)
    x = inputs(50, 3, low=0, high=1)
    latent = models[1].encode(0, x)
    index = rng.integers(0, 50, 70).astype(np.int32)
    found = models[1].inference(np.zeros((70, 3), np.float32), latents={0: (latent, index)})
    np.testing.assert_array_equal(found, models[1].inference(x[index]))


def test_one_sample_repeated_by_tiles():
    """Sums of a great many equal terms, of the grid's atomics too."""
    model = make({**GRID, "n_levels": 2}, network={"n_neurons": 64}, execution="tiles")
    x, target = inputs(1, 3, low=0, high=1), np.ones((1, 4), np.float32)
    model.compute_gradients(x, target)
    expected = model.gradients.numpy().copy()
    model.zero_gradients()
    model.compute_gradients(np.repeat(x, 1_000_000, axis=0), np.repeat(target, 1_000_000, axis=0))
    error = np.abs(model.gradients.numpy() - expected)
    assert (error <= 1e-4 * np.abs(expected)).all()


def test_wrong_executions_are_named():
    with pytest.raises(nn.NnError, match="execution: found 'gpu'; allowed on cpu: blocks, tiles"):
        make(execution="gpu")
    with pytest.raises(ConfigError, match=r"network\.n_neurons: found 200; allowed on cpu: up to 128"):
        make(network={"n_neurons": 200}, execution="tiles")
