"""What holds for every model that can be made from JSON."""

from __future__ import annotations

import json

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from nn_models import GRID
from nn_oracle import Oracle

import nn
from nn import config

ACTIVATIONS = ["None", "ReLU", "LeakyReLU", "SiLU", "Sigmoid", "Tanh", "Softplus", "Squareplus", "Exponential", "Sine"]
LOSSES = ["L1", "L2", "RelativeL1", "RelativeL2", "RelativeL2Luminance", "MAPE", "SMAPE", "CrossEntropy", "Variance"]

# Grids of few kinds, each of which is a build of kernels.
grids = st.builds(
    lambda kind, levels: {**GRID, **kind, "n_levels": levels},
    st.sampled_from([{}, {"type": "Dense", "n_features_per_level": 4}]),
    st.integers(1, 5),
).map(lambda part: (part, 3))
fixed = st.one_of(
    st.builds(lambda n, d: ({"otype": "OneBlob", "n_bins": n}, d), st.integers(1, 16), st.integers(1, 3)),
    st.builds(lambda n, d: ({"otype": "Frequency", "n_frequencies": n}, d), st.integers(1, 8), st.integers(1, 3)),
    st.builds(lambda n, d: ({"otype": "TriangleWave", "n_frequencies": n}, d), st.integers(1, 8), st.integers(1, 3)),
    st.builds(lambda n: ({"otype": "SphericalHarmonics", "degree": n}, 3), st.integers(1, 8)),
    st.builds(lambda s, d: ({"otype": "Identity", "scale": s}, d), st.floats(0.25, 2.0), st.integers(1, 3)),
)
adams = st.fixed_dictionaries(
    {"otype": st.just("Adam"), "learning_rate": st.sampled_from([1e-3, 1e-2])},
    optional={"beta2": st.just(0.99), "epsilon": st.just(1e-10), "l2_reg": st.just(1e-6), "adabound": st.booleans()},
)
optimizers = st.one_of(
    adams,
    st.just({"otype": "SGD", "learning_rate": 1e-2}),
    st.builds(lambda nested: {"otype": "EMA", "decay": 0.9, "nested": nested}, adams),
    st.builds(lambda nested: {"otype": "ExponentialDecay", "decay_start": 1, "nested": nested}, adams),
)


@st.composite
def models(draw):
    """A configuration and its input dimensions."""
    parts = draw(st.lists(st.one_of(grids, fixed), min_size=1, max_size=3))
    encoding, dims = parts[0]
    if len(parts) > 1:
        encoding = {"otype": "Composite", "nested": [{**part, "n_dims_to_encode": d} for part, d in parts]}
        dims = sum(d for _, d in parts)
    network = {
        "otype": "FullyFusedMLP",
        "n_neurons": draw(st.sampled_from([16, 24, 64, 128])),
        "n_hidden_layers": draw(st.integers(0, 3)),
        "activation": draw(st.sampled_from(ACTIVATIONS)),
        "output_activation": draw(st.sampled_from(ACTIVATIONS)),
        "bias": draw(st.booleans()),
    }
    return {
        "encoding": encoding,
        "network": network,
        "loss": {"otype": draw(st.sampled_from(LOSSES))},
        "optimizer": draw(optimizers),
        "precision": draw(st.sampled_from(["fp32", "fp16", "bf16"])),
        "loss_scale": draw(st.sampled_from([1.0, 128.0, "dynamic"])),
        "gradient_clipping": draw(st.sampled_from([None, {"global_norm": 0.01}])),
    }, dims


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(models(), st.integers(1, 5), st.sampled_from([0, 1, 17, 300, 2500]))
def test_contract(tmp_path_factory, described, n_out, n):
    description, dims = described
    cfg = config.load(json.loads(json.dumps(description)))
    if description["loss"]["otype"] == "RelativeL2Luminance":
        n_out = 3 * n_out
    assert config.load(config.dump(cfg)) == cfg

    rng = np.random.default_rng(n)
    x, target = rng.random((n, dims), np.float32), rng.random((n, n_out), np.float32)
    one, two = (nn.Model.from_config(cfg, dims, n_out, seed=5, threads=threads) for threads in (1, 2))
    np.testing.assert_array_equal(one.forward(x), one.inference(x, averaged=False))

    before = one.inference(x, averaged=False)
    losses = [[model.train_step(x, target) for _ in range(3)] for model in (one, two)]
    np.testing.assert_equal(*losses)
    for name, array in one.state_dict().items():
        np.testing.assert_array_equal(array, two.state_dict()[name], name)
    statistics = one.statistics
    assert statistics["steps"] + statistics["skipped_batches"] == 3
    assert np.isfinite(one.parameters.numpy()).all()

    file = tmp_path_factory.getbasetemp() / "contract.npz"
    one.save(file)
    other = nn.Model.from_config(cfg, dims, n_out, seed=6, threads=2)
    other.load(file)
    np.testing.assert_array_equal(other.inference(x), one.inference(x))
    np.testing.assert_equal(other.train_step(x, target), one.train_step(x, target))
    np.testing.assert_array_equal(other.parameters.numpy(), one.parameters.numpy())

    if n and cfg.precision == "fp32" and np.isfinite(before).all():
        fresh = nn.Model.from_config(cfg, dims, n_out, seed=5)
        expected, size = Oracle(fresh).forward(x, fresh.parameters.numpy())
        assert (np.abs(before - expected) <= 1e-6 * size + 1e-30).all()
