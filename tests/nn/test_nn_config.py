"""Configurations: those that were published load as they are, wrong ones say what is allowed."""

from __future__ import annotations

import copy
import json
import re

import pytest
from nn_models import NPM

import nn
from nn import config

# The networks of Figueiredo et al. 2025: coordinate networks with the code's inputs, and their radiance cache.
DF_ENCODING = {
    "otype": "Composite",
    "nested": [
        {"otype": "DenseGrid", "n_dims_to_encode": 3, "n_levels": 8, "n_features_per_level": 4, "base_resolution": 8,
         "per_level_scale": 1.405, "interpolation": "Smoothstep"},
        {"otype": "SphericalHarmonics", "n_dims_to_encode": 3, "degree": 4},
        {"otype": "OneBlob", "n_dims_to_encode": 4, "n_bins": 4},
        {"otype": "TriangleWave", "n_dims_to_encode": 1, "n_frequencies": 12},
    ],
}  # fmt: skip
CACHE = {
    "loss": {"otype": "RelativeL2Luminance"},
    "optimizer": {"otype": "Ema", "decay": 0.99, "nested": {"otype": "Adam", "learning_rate": 1e-2, "adabound": False}},
    "encoding": {
        "otype": "Composite",
        "nested": [
            {"otype": "Frequency", "n_dims_to_encode": 3, "n_frequencies": 12},
            {"otype": "OneBlob", "n_dims_to_encode": 5, "n_bins": 4},
            {"otype": "Identity"},
        ],
    },
    "network": {"otype": "FullyFusedMLP", "n_neurons": 64, "n_hidden_layers": 5, "activation": "ReLU",
                "output_activation": "None"},
}  # fmt: skip


def test_published_configurations():
    model = nn.Model.from_config(NPM, 9, 32)
    features = 8 * 4 + 4 + 3 * 4
    assert model.encoding.n_features == features
    assert model.n_matrix_params == features * 64 + 2 * 64 * 64 + 64 * 32
    resolutions = [8, 12, 16, 23, 32, 44, 62, 87]
    assert model.n_params - model.n_matrix_params == 4 * sum(-(-(r**3) // 8) * 8 for r in resolutions)
    second = nn.Model.from_config({**NPM, "encoding": DF_ENCODING}, 11, 16)
    assert second.encoding.n_features == 32 + 16 + 16 + 12
    cache = nn.Model.from_config(CACHE, 14, 3)
    assert cache.encoding.n_features == 3 * 24 + 20 + 6


def test_round_trip_and_comments(tmp_path):
    loaded = config.load(NPM)
    assert config.load(config.dump(loaded)) == loaded
    text = json.dumps(NPM, indent=1).replace('"loss"', '// a comment with "quotes"\n"loss"')
    (tmp_path / "npm.json").write_text(text)
    assert config.load(tmp_path / "npm.json") == loaded
    (tmp_path / "broken.json").write_text('{\n"loss": ')
    with pytest.raises(nn.ConfigError, match=r"broken\.json: line 2"):
        config.load(tmp_path / "broken.json")
    with pytest.raises(nn.ConfigError, match=r"absent\.json: No such file"):
        config.load(tmp_path / "absent.json")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b'{"network": {"otype": "MLP", "width": 64}}', r"^{file}: network\.width: unknown key; allowed: otype, "),
        (
            b'{"loss": {"otype": "L2"}, "precision": 16}',
            r'^{file}: precision: found 16; allowed: "fp32", "fp16", "bf16"$',
        ),
        (
            b'{"network": {"otype": "MLP", "n_parts": 2}}',
            r"^{file}: network\.n_parts: found 2; the encoding has 1 parts$",
        ),
        (b'{"encoding": "\xff"}', r"^{file}: not UTF-8: invalid start byte$"),
        (b"[1]", r"^{file}: a configuration is an object; found \[1\]$"),
    ],
)
def test_a_wrong_file_is_named(tmp_path, text, words):
    file = tmp_path / "model.json"
    file.write_bytes(text)
    with pytest.raises(nn.ConfigError, match=words.format(file=re.escape(str(file)))):
        nn.Model.from_config(file, 3, 4)


@pytest.mark.parametrize("value", [[], None, 3])
def test_what_is_no_configuration(value):
    with pytest.raises(nn.ConfigError, match=r"^a configuration is an object, or the path of a file; found"):
        config.load(value)


def changed(path, value):
    result = copy.deepcopy(NPM)
    *owners, last = path
    at = result
    for step in owners:
        at = at[step]
    at[last] = value
    return result


WRONG = [
    (
        ["encodin"],
        {},
        r"^encodin: unknown key \(did you mean 'encoding'\?\); allowed: encoding, gradient_clipping, loss",
    ),
    (["loss", "otype"], "L3", r'^loss\.otype: found "L3"; allowed: L1, L2, RelativeL1'),
    (["loss"], {}, r"^loss\.otype: found null; allowed: L1"),
    (["network", "n_neurons"], 0, r"^network\.n_neurons: found 0; allowed: a whole number >= 1 and <= 512"),
    (["network", "activation"], "Relu6", r'^network\.activation: found "Relu6"; allowed: "None", "ReLU"'),
    (["network", "feedback_alignment"], True, r"^network\.feedback_alignment: found true; allowed: false"),
    (["network"], 3, r"^network: expected an object; found 3"),
    (["network"], [], r"^network: found \[\]; allowed: a list that is not empty"),
    (["loss_scale"], float("inf"), r"^loss_scale: found inf; allowed: a finite number"),
    (
        ["optimizer", "nested", "learning_rate"],
        float("nan"),
        r"^optimizer\.nested\.learning_rate: found nan; allowed: a f",
    ),
    (["encoding", "nested", 1, "degree"], 9, r"^encoding\.nested\[1\]\.degree: found 9; allowed: .* <= 8"),
    (["encoding", "nested", 2, "bins"], 4, r"^encoding\.nested\[2\]\.bins: unknown key .*allowed: otype, n_bins"),
    (["encoding", "nested", 0, "n_features_per_level"], 3, r"n_features_per_level: found 3; allowed: 1, 2, 4, 8"),
    (
        ["encoding", "nested", 0, "type"],
        "Hash",
        r"^encoding\.nested\[0\]\.type: found \"Hash\"; DenseGrid allows: Dense",
    ),
    (["encoding", "nested"], [], r"^encoding\.nested: found \[\]; allowed: a list that is not empty"),
    (["optimizer", "nested", "beta1"], 1.0, r"^optimizer\.nested\.beta1: found 1\.0; allowed: a number >= 0 and < 1"),
    (["optimizer", "nested", "otype"], "Shampoo", r"found \"Shampoo\"; allowed: Adam, SGD, EMA, ExponentialDecay"),
    (["gradient_clipping"], {"norm": 1}, r"^gradient_clipping\.norm: unknown key.*; allowed: global_norm"),
    (["loss_scale"], "static", r'^loss_scale: found "static"; allowed: a number > 0 or "dynamic"'),
    (["precision"], "fp64", r'^precision: found "fp64"; allowed: "fp32", "fp16", "bf16"'),
    (["encoding", "nested", 1, "n_dims_to_encode"], 4, r"^encoding\.nested\[1\]\.n_dims_to_encode: found 4; spherical"),
    (["encoding", "nested", 2, "n_dims_to_encode"], 2, r"^encoding: its parts encode 8 dimensions; the model has 9"),
    (["encoding", "nested", 2, "n_dims_to_encode"], 7, r"^encoding: its parts encode 13 dimensions; the model has 9"),
    (["encoding", "nested", 0, "n_dims_to_encode"], 5, r"a grid encodes 1 to 4 dimensions"),
    (["encoding", "nested", 0, "base_resolution"], 4000, r"^encoding\.nested\[0\]: found .* parameters up to level 0"),
    (["loss", "otype"], "RelativeL2Luminance", r"needs RGB: n_output_dims a multiple of 3"),
]


@pytest.mark.parametrize("case", range(len(WRONG)))
def test_wrong_configuration(case):
    path, value, words = WRONG[case]
    with pytest.raises(nn.ConfigError, match=words) as caught:
        nn.Model.from_config(changed(path, value), 9, 32)
    assert "\n" not in str(caught.value)
