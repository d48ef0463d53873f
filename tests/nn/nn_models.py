"""Small models for tests. Few shapes of grid, so that few kernels are built."""

from __future__ import annotations

import numpy as np

import nn

GRID = {"otype": "Grid", "type": "Hash", "n_levels": 3, "n_features_per_level": 2, "log2_hashmap_size": 6,
        "base_resolution": 4, "per_level_scale": 1.7, "interpolation": "Smoothstep"}  # fmt: skip
NPM = {
    "loss": {"otype": "L2"},
    "optimizer": {
        "otype": "Ema",
        "decay": 0.95,
        "nested": {"otype": "Adam", "learning_rate": 1e-2, "beta1": 0.9, "beta2": 0.99, "epsilon": 1e-15,
                   "l2_reg": 1e-6},
    },
    "encoding": {
        "otype": "Composite",
        "nested": [
            {"otype": "DenseGrid", "n_dims_to_encode": 3, "n_levels": 8, "n_features_per_level": 4,
             "base_resolution": 8, "per_level_scale": 1.405, "interpolation": "Smoothstep"},
            {"otype": "SphericalHarmonics", "n_dims_to_encode": 3, "degree": 2},
            {"otype": "OneBlob", "n_bins": 4},
        ],
    },
    "network": {"otype": "FullyFusedMLP", "activation": "ReLU", "output_activation": "None", "n_neurons": 64,
                "n_hidden_layers": 3},
}  # fmt: skip


def make(encoding=None, network=None, n_in=3, n_out=4, seed=1, threads=1, spread=0.5, execution=None, **rest):
    """A model whose parameters are all random and of a size that matters."""
    network = (
        {"otype": "MLP", "n_neurons": 16, "n_hidden_layers": 1, **(network or {})}
        if not isinstance(network, list)
        else network
    )
    config = {"encoding": encoding or {"otype": "Identity"}, "network": network, **rest}
    model = nn.Model.from_config(config, n_in, n_out, seed=seed, threads=threads, execution=execution)
    rng = np.random.default_rng(seed + 100)
    values = model.parameters.numpy()
    values[model.n_matrix_params :] = rng.uniform(-spread, spread, len(values) - model.n_matrix_params)
    if model.networks[0].cfg.bias:
        for layer in model.networks[0].layers:
            values[layer.bias : layer.bias + layer.n_out] = rng.uniform(-0.5, 0.5, layer.n_out)
    return model
