"""Optimisers, determinism, checkpoints, and what happens at the extremes."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import warp as wp
from nn_models import GRID, NPM, make
from test_nn_values import inputs

import nn

ADAM = {"otype": "Adam", "learning_rate": 1e-2, "beta1": 0.9, "beta2": 0.99, "epsilon": 1e-8, "l2_reg": 1e-2}
SGD = {"otype": "SGD", "learning_rate": 1e-2, "l2_reg": 1e-2}


def adam(p, g, m, v, t, matrix, rate=1e-2, beta1=0.9, beta2=0.99, epsilon=1e-8, l2=1e-2):
    """One step in float64, for the entries that move."""
    moves = matrix | (g != 0)
    g = g + np.where(matrix, l2 * p, 0)
    m[moves] = (beta1 * m + (1 - beta1) * g)[moves]
    v[moves] = (beta2 * v + (1 - beta2) * g * g)[moves]
    t[moves] += 1
    with np.errstate(divide="ignore", invalid="ignore"):
        step = rate * np.sqrt(1 - beta2**t) / (1 - beta1**t) * m / (np.sqrt(v) + epsilon)
    p[moves] -= step[moves]


@pytest.mark.parametrize("ema", [False, True])
def test_adam_and_average(ema):
    """Twenty steps with gradients of our own, many of them zero, against float64."""
    optimizer = {"otype": "EMA", "decay": 0.9, "nested": ADAM} if ema else ADAM
    model = make(GRID, optimizer=optimizer, threads=2)
    n = model.n_params
    matrix = np.arange(n) < model.n_matrix_params
    p = model.parameters.numpy().astype(np.float64)
    m, v, t = np.zeros(n), np.zeros(n), np.zeros(n)
    average, rng = np.zeros(n), np.random.default_rng(0)
    for step in range(20):
        g = (rng.normal(size=n) * (rng.random(n) < 0.5)).astype(np.float32)
        model.gradients.assign(g)
        model.optimizer_step()
        adam(p, g.astype(np.float64), m, v, t, matrix)
        average = (average * 0.9 * (1 - 0.9**step) + p * 0.1) / (1 - 0.9 ** (step + 1))
        assert (model.gradients.numpy() == 0).all()
    np.testing.assert_allclose(model.parameters.numpy(), p, rtol=0, atol=2e-6)
    np.testing.assert_array_equal(model.optimizer.steps.numpy(), t)
    if ema:
        np.testing.assert_allclose(model.inference_parameters.numpy(), average, rtol=0, atol=2e-6)
        x = inputs(17, 3)
        assert not np.array_equal(model.inference(x), model.inference(x, averaged=False))
        assert np.array_equal(model.forward(x), model.inference(x, averaged=False))


def test_sgd_and_decay_of_the_learning_rate():
    optimizer = {"otype": "ExponentialDecay", "decay_base": 0.5, "decay_start": 2, "decay_interval": 3, "decay_end": 8,
                 "nested": SGD}  # fmt: skip
    model = make(optimizer=optimizer)
    p, rates = model.parameters.numpy().astype(np.float64), []
    for step in range(14):
        g = np.random.default_rng(step).normal(size=p.size).astype(np.float32)
        model.gradients.assign(g)
        model.optimizer_step()
        rate = 1e-2 * 0.5 ** sum(k <= step for k in (2, 5, 8))
        rates.append(model.statistics["learning_rate"])
        assert rates[-1] == pytest.approx(rate, rel=1e-6)
        p -= rate * (g + 1e-2 * p)
    np.testing.assert_allclose(model.parameters.numpy(), p, atol=2e-6)


def test_adabound_decay_and_limits():
    rest = {"adabound": True, "relative_decay": 0.1, "absolute_decay": 0.01, "clipping_magnitude": 0.3,
            "non_matrix_learning_rate_factor": 2.0, "l2_reg": 0.0}  # fmt: skip
    model = make(GRID, optimizer={**ADAM, **rest})
    n = model.n_params
    matrix = np.arange(n) < model.n_matrix_params
    p = model.parameters.numpy().astype(np.float64)
    m, v = np.zeros(n), np.zeros(n)
    for step in range(1, 6):
        g = np.random.default_rng(step).normal(size=n).astype(np.float32)
        model.gradients.assign(g)
        model.optimizer_step()
        m, v = 0.9 * m + 0.1 * g, 0.99 * v + 0.01 * g.astype(np.float64) ** 2
        rate = np.where(matrix, 1e-2, 2e-2) * np.sqrt(1 - 0.99**step) / (1 - 0.9**step)
        low, high = 0.1 - 0.1 / (0.01 * step + 1), 0.1 + 0.1 / (0.01 * step)
        own = np.clip(rate / (np.sqrt(v) + 1e-8), low, high)
        p = np.clip((1 - 0.1 * rate) * p - 0.01 * rate * np.sign(p) - own * m, -0.3, 0.3)
    np.testing.assert_allclose(model.parameters.numpy(), p, atol=2e-6)


def test_frozen_parameters():
    for key, frozen in (("optimize_matrix_params", True), ("optimize_non_matrix_params", False)):
        model = make(GRID, optimizer={**ADAM, key: False})
        before = model.parameters.numpy().copy()
        model.gradients.fill_(1.0)
        model.optimizer_step()
        same = model.parameters.numpy() == before
        matrix = np.arange(model.n_params) < model.n_matrix_params
        assert same[matrix == frozen].all()
        assert not same[matrix != frozen].any()
        assert (model.gradients.numpy() == 0).all()


def test_clipping_scales_all_gradients_together():
    model = make(optimizer={**SGD, "l2_reg": 0.0}, gradient_clipping={"global_norm": 0.5})
    before = model.parameters.numpy().astype(np.float64)
    g = np.random.default_rng(0).normal(size=model.n_params).astype(np.float32)
    model.gradients.assign(g)
    model.optimizer_step()
    norm = np.linalg.norm(g.astype(np.float64))
    np.testing.assert_allclose(model.parameters.numpy(), before - 1e-2 * g * 0.5 / norm, atol=1e-7)
    assert model.statistics["gradient_norm"] == pytest.approx(norm, rel=1e-9)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_batch_with_bad_gradient_is_skipped(bad):
    model = make(GRID, optimizer={"otype": "EMA", "nested": ADAM}, n_out=2)
    x, target = inputs(50, 3), inputs(50, 2)
    model.train_step(x, target)
    before = model.state_dict()
    target[7, 1] = bad
    model.train_step(x, target)
    after = model.state_dict()
    for name in before:
        if name != "optimizer.state":
            np.testing.assert_array_equal(before[name], after[name])
    assert (model.gradients.numpy() == 0).all()
    assert model.statistics["skipped_batches"] == 1 and model.statistics["steps"] == 1
    target[7, 1] = 0
    assert np.isfinite(model.train_step(x, target))
    assert model.statistics["steps"] == 2


@pytest.mark.parametrize("loss", ["L1", "MAPE", "SMAPE", "RelativeL1"])
def test_losses_of_a_sign_keep_nan(loss):
    model = make(n_out=2, loss={"otype": loss})
    x = inputs(20, 3)
    target = model.inference(x)
    assert model.compute_gradients(x, target) == 0
    assert (model.gradients.numpy() == 0).all()  # at the minimum the slope is zero
    target[3, 1] = np.nan
    assert np.isnan(model.train_step(x, target))
    assert model.statistics["skipped_batches"] == 1


def test_loss_scaling():
    """A factor of all gradients changes nothing but them; a dynamic one halves with every bad batch."""
    x, target = inputs(100, 3), inputs(100, 4)
    models = [make(GRID, optimizer=ADAM, loss_scale=scale) for scale in (1.0, 128.0)]
    for _ in range(5):
        losses = [model.compute_gradients(x, target) for model in models]
        assert losses[0] == losses[1]
        np.testing.assert_array_equal(models[1].gradients.numpy(), 128 * models[0].gradients.numpy())
        for model in models:
            model.optimizer_step()
        np.testing.assert_array_equal(models[0].parameters.numpy(), models[1].parameters.numpy())
    dynamic = make(GRID, optimizer=ADAM, loss_scale="dynamic")
    assert dynamic.statistics["loss_scale"] == 2.0**15
    dynamic.gradients.fill_(np.inf)
    dynamic.optimizer_step()
    assert dynamic.statistics["loss_scale"] == 2.0**14
    for _ in range(2000):
        dynamic.optimizer_step()
    assert dynamic.statistics["loss_scale"] == 2.0**15


@pytest.mark.parametrize("n", [17, 1000, 9000])
def test_same_bits_for_any_number_of_threads(n):
    rng = np.random.default_rng(n)
    x, target = rng.random((n, 9), np.float32), rng.random((n, 32), np.float32)
    results = []
    for threads in (1, 2, 5):
        model = nn.Model.from_config(NPM, 9, 32, seed=3, threads=threads)
        losses = [model.train_step(x, target) for _ in range(3)]
        results.append((losses, model.parameters.numpy().copy(), model.inference(x)))
    for losses, parameters, outputs in results[1:]:
        assert losses == results[0][0]
        np.testing.assert_array_equal(parameters, results[0][1])
        np.testing.assert_array_equal(outputs, results[0][2])


def test_parts_of_a_batch_add_up():
    """Gradients of two halves, averaged, are those of the whole, as several machines need."""
    model = make(GRID, n_out=2)
    x, target = inputs(512, 3), inputs(512, 2)
    model.compute_gradients(x, target)
    whole = model.gradients.numpy().copy()
    model.zero_gradients()
    model.compute_gradients(x[:256], target[:256])
    model.compute_gradients(x[256:], target[256:])
    np.testing.assert_allclose(model.gradients.numpy() / 2, whole, atol=1e-6 * np.abs(whole).max())


def test_several_threads_infer_at_once():
    model = nn.Model.from_config(NPM, 9, 32, threads=2)
    xs = [inputs(3000, 9, seed=i, low=0, high=1) for i in range(4)]
    expected = [model.inference(x) for x in xs]
    wrong = []

    def work(i):
        for _ in range(5):
            if not np.array_equal(model.inference(xs[i]), expected[i]):
                wrong.append(i)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_latents_through_an_index():
    """Several directions share one encoded position; the ignored columns may hold anything."""
    model = nn.Model.from_config(NPM, 9, 32)
    rng = np.random.default_rng(0)
    positions = rng.random((40, 3), np.float32)
    index = rng.integers(0, 40, 300).astype(np.int32)
    x = rng.random((300, 9), np.float32)
    x[:, :3] = positions[index]
    expected = model.inference(x)
    latent = model.encode(0, positions)
    x[:, :3] = 0.25
    np.testing.assert_array_equal(model.inference(x, latents={0: (latent, index)}), expected)
    index[5] = 40
    with pytest.raises(nn.NnError, match=r"indices from 0 to 40; allowed: 0 to 39"):
        model.inference(x, latents={0: (latent, index)})


def test_checkpoint_continues_to_the_last_bit(tmp_path):
    x, target = inputs(500, 3), inputs(500, 4)
    optimizer = {"otype": "EMA", "nested": ADAM}
    model = make(GRID, optimizer=optimizer)
    for _ in range(3):
        model.train_step(x, target)
    model.save(tmp_path / "model.npz")
    other = make(GRID, optimizer=optimizer, seed=9)
    other.load(tmp_path / "model.npz")
    for _ in range(3):
        assert model.train_step(x, target) == other.train_step(x, target)
    for name, array in model.state_dict().items():
        np.testing.assert_array_equal(array, other.state_dict()[name])
    with pytest.raises(nn.NnError, match="parameters has shape"):
        make(GRID, network={"n_neurons": 32}).load(tmp_path / "model.npz")
    with pytest.raises(nn.NnError, match=r"optimizer\.averages"):
        make(GRID).load(tmp_path / "model.npz")
    (tmp_path / "broken.npz").write_bytes(b"no archive")
    with pytest.raises(nn.NnError, match=r"broken\.npz"):
        model.load(tmp_path / "broken.npz")


def test_arrays_are_shared_not_copied():
    model = make()
    x, out = inputs(64, 3), np.empty((64, 4), np.float32)
    assert model.inference(x, out=out) is out
    y = model.inference(wp.array(x, dtype=wp.float32))
    assert isinstance(y, wp.array)
    np.testing.assert_array_equal(y.numpy(), out)
    np.testing.assert_array_equal(model.inference(np.asfortranarray(x)), out)
    np.testing.assert_array_equal(model.inference(x.astype(np.float64)), out)
    view = model.parameters.numpy()
    view[:] = 0
    assert (model.inference(x) == 0).all()


def test_loss_decreases_to_a_stated_value():
    """A product of waves over the square: 300 steps of 4096 samples bring the mean square error below 3e-4."""
    encoding = {**GRID, "n_levels": 6, "log2_hashmap_size": 12, "per_level_scale": 1.5, "interpolation": "Linear"}
    model = nn.Model.from_config(
        {
            "encoding": encoding,
            "network": {"otype": "MLP", "n_neurons": 32, "n_hidden_layers": 2},
            "optimizer": {**ADAM, "l2_reg": 0.0},
        },
        2,
        1,
        seed=5,
    )
    rng = np.random.default_rng(0)
    for _ in range(300):
        x = rng.random((4096, 2), np.float32)
        loss = model.train_step(x, (np.sin(9 * x[:, :1]) * np.cos(11 * x[:, 1:])).astype(np.float32))
    assert loss < 3e-4


@pytest.mark.parametrize("optimizer", [{**ADAM, "learning_rate": 1.0}, {**SGD, "learning_rate": 1.0}])
def test_huge_learning_rate_stays_finite_with_clipping(optimizer):
    model = make(GRID, optimizer=optimizer, gradient_clipping={"global_norm": 1.0})
    x, target = inputs(64, 3), inputs(64, 4)
    for _ in range(1000):
        model.train_step(x, target)
    assert np.isfinite(model.parameters.numpy()).all()
    assert model.statistics["steps"] + model.statistics["skipped_batches"] == 1000


def test_extreme_inputs():
    """Corners, vertices, far outside, and -0.0 stay finite; NaN and infinity are counted and keep to their rows."""
    encoding = {
        "otype": "Composite",
        "nested": [
            {**GRID, "n_dims_to_encode": 3, "n_levels": 8},
            {"otype": "OneBlob", "n_dims_to_encode": 1},
            {"otype": "Frequency", "n_dims_to_encode": 1},
            {"otype": "TriangleWave"},
        ],
    }
    model = make(encoding, n_in=6, network={"activation": "ReLU"})
    special = np.array([0, 1, -0.0, 0.125, 0.25, -1, 2, 1e30, -1e30, 1e-40, 3.4e38, -3.4e38], np.float32)
    x = np.stack(np.meshgrid(special, special, [0.5]), -1).reshape(-1, 3)
    x = np.hstack([x, np.resize(special, (len(x), 3))]).astype(np.float32)
    assert np.isfinite(model.inference(x)).all()
    assert model.statistics["nonfinite_inputs"] == 0
    np.testing.assert_array_equal(model.inference(np.where(x == 0, np.float32(-0.0), x)), model.inference(x))
    for column in range(6):
        for value in (np.nan, np.inf):
            y = x.copy()
            y[5, column] = value
            before = model.statistics["nonfinite_inputs"]
            result = model.inference(y)
            assert model.statistics["nonfinite_inputs"] == before + 1
            assert np.isnan(result[5]).all()
            assert np.isfinite(np.delete(result, 5, 0)).all()
    model.train_step(y, inputs(len(y), 4))
    assert model.statistics["skipped_batches"] == 1


def test_rows_of_an_earlier_batch_leave_no_trace():
    """Blocks are padded: what a larger batch of NaN left there must not reach the gradients of a smaller one."""
    model = make(GRID, network={"n_hidden_layers": 2}, optimizer=ADAM)
    x, target = inputs(93, 3), inputs(93, 4)
    model.compute_gradients(x, target)
    expected = model.gradients.numpy().copy()
    model.zero_gradients()
    model.compute_gradients(np.full((200, 3), np.nan, np.float32), inputs(200, 4))
    model.optimizer_step()
    assert model.statistics["skipped_batches"] == 1
    model.compute_gradients(x, target)
    np.testing.assert_array_equal(model.gradients.numpy(), expected)


def power_loss(scale):
    """A loss of one's own; all have one name, and differ by a constant here and in a function that they call."""

    @wp.func
    def term(d: wp.float32):
        return scale * wp.abs(d) * d * d

    @wp.func
    def loss(
        y: wp.array[wp.float32],
        y_offset: int,
        target: wp.array2d[wp.float32],
        row: int,
        factor: wp.float32,
        dL_dy: wp.array[wp.float32],
        dL_dy_offset: int,
    ):
        total = wp.float32(0.0)
        for i in range(target.shape[1]):
            d = y[y_offset + i] - target[row, i]
            total += term(d)
            dL_dy[dL_dy_offset + i] = scale * 3.0 * wp.abs(d) * d * factor
        return total

    return loss


@pytest.mark.parametrize("execution", ["blocks", "tiles"])
def test_own_loss(execution):
    """Losses of the caller's own run inside the training kernel; those of one factory do not share one."""
    model = make(GRID, execution=execution)
    x, target = inputs(200, 3), inputs(200, 4)
    y = model.inference(x)
    losses = {scale: power_loss(scale) for scale in (1.0, 2.0)}
    for scale in (1.0, 2.0, 1.0):
        model.zero_gradients()
        value = model.compute_gradients(x, target, loss=losses[scale])
        found = model.gradients.numpy().copy()
        assert value == pytest.approx(scale * (np.abs(y - target) ** 3).mean(), rel=1e-5)
        model.zero_gradients()
        model.forward(x)
        model.backward((scale * 3 * np.abs(y - target) * (y - target) / y.size).astype(np.float32))
        np.testing.assert_allclose(found, model.gradients.numpy(), atol=1e-6 * np.abs(found).max())


@wp.func
def weighted_loss(
    y: wp.array[wp.float32],
    y_offset: int,
    target: wp.array2d[wp.float32],
    row: int,
    factor: wp.float32,
    dL_dy: wp.array[wp.float32],
    dL_dy_offset: int,
):
    """Of 18 outputs: the last column weighs the squares of their differences to the first, whatever is between."""
    total = wp.float32(0.0)
    weight = target[row, target.shape[1] - 1]
    for i in range(18):
        d = y[y_offset + i] - target[row, 0]
        total += weight * d * d
        dL_dy[dL_dy_offset + i] = weight * 2.0 * d * factor
    return total


@pytest.mark.parametrize("execution", ["blocks", "tiles"])
@pytest.mark.parametrize("width", [1, 2, 23])
def test_targets_of_an_own_loss_have_any_width(execution, width):
    """Fewer and more columns than outputs, which fill two blocks of a tile network."""
    network = {"output_activation": "Sigmoid"}
    model = make(GRID, network, n_out=18, execution=execution)
    x, target, outputs = inputs(77, 3), inputs(77, width, seed=2), np.full((77, 18), np.nan, np.float32)
    value = model.compute_gradients(x, target, loss=weighted_loss, outputs=outputs)
    found = model.gradients.numpy().copy()
    y = model.inference(x)
    np.testing.assert_allclose(outputs, y, atol=1e-6)
    d, weight = y.astype(np.float64) - target[:, :1], target[:, -1:].astype(np.float64)
    assert value == pytest.approx((weight * d**2).mean(), rel=1e-5)
    model.zero_gradients()
    model.forward(x)
    model.backward((2 * weight * d / d.size).astype(np.float32))
    np.testing.assert_allclose(found, model.gradients.numpy(), atol=2e-6 * np.abs(found).max())
    assert model.train_step(x[:0], target[:0], loss=weighted_loss, report=False) is None
    with pytest.raises(nn.NnError, match=rf"target: found shape \(77, {width}\); allowed: \[n, 18\]"):
        model.train_step(x, target)
    with pytest.raises(nn.NnError, match=r"target: found shape \(77, 0\); allowed: \[n, 1 or more\]"):
        model.train_step(x, target[:, :0], loss=weighted_loss)


def test_wrong_arrays_are_named():
    model = make()
    x = inputs(10, 3)
    for call, words in (
        (lambda: model.inference(x[:, :2]), r"x: found shape \(10, 2\); allowed: \[n, 3\]"),
        (lambda: model.inference([[0, 0, 0]]), "x: found shape"),
        (lambda: model.inference(x.astype(complex)), "complex128; allowed: float32"),
        (
            lambda: model.inference(x, out=np.empty((9, 4), np.float32)),
            r"out: found shape \(9, 4\); allowed: \(10, 4\)",
        ),
        (lambda: model.train_step(x, inputs(9, 4)), "9 rows of targets for 10 rows of inputs"),
        (lambda: model.train_step(x), "found both or neither"),
        (lambda: model.backward(inputs(10, 4)), "no forward"),
        (lambda: model.encode(1, x), "part: found 1; allowed: 0 to 0"),
        (lambda: model.load_state_dict({}), "parameters is missing"),
    ):
        with pytest.raises(nn.NnError, match=words):
            call()
