"""Configuration of a model: the JSON schema of tiny-cuda-nn as typed records.

Names of types (`otype` and the values of enumerations) are read without regard to case. ``HashGrid``, ``DenseGrid`` and
``TiledGrid`` stand for ``Grid`` with that `type`. Defaults are those of the schema's documentation. Our own keys are
`bias` and `n_parts` of a network, a list of networks, and `precision`, `loss_scale` and `gradient_clipping` at the top
level.
"""

from __future__ import annotations

import difflib
import json
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import msgspec

from nn.errors import ConfigError, of_file

Count = Annotated[int, msgspec.Meta(ge=1, le=1 << 20)]
Size = Annotated[int, msgspec.Meta(ge=0, le=1 << 20)]
Fraction = Annotated[float, msgspec.Meta(ge=0, lt=1)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
Activation = Literal[
    "None", "ReLU", "LeakyReLU", "SiLU", "Sigmoid", "Tanh", "Softplus", "Squareplus", "Exponential", "Sine"
]


class _Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A record of the configuration; `otype` names its kind."""


class Identity(_Record, tag_field="otype", tag="Identity", frozen=True):
    """y = scale · x + offset, each dimension by itself."""

    n_dims_to_encode: Size | None = None
    scale: float = 1.0
    offset: float = 0.0


class Frequency(_Record, tag_field="otype", tag="Frequency", frozen=True):
    """sin(2^f pi x) and cos(2^f pi x) for f < `n_frequencies` (Mildenhall et al. 2020)."""

    n_dims_to_encode: Size | None = None
    n_frequencies: Annotated[int, msgspec.Meta(ge=1, le=24)] = 12


class TriangleWave(_Record, tag_field="otype", tag="TriangleWave", frozen=True):
    """A triangle wave per octave, each shifted by a quarter of a period more (Müller et al. 2021)."""

    n_dims_to_encode: Size | None = None
    n_frequencies: Annotated[int, msgspec.Meta(ge=1, le=24)] = 12


class OneBlob(_Record, tag_field="otype", tag="OneBlob", frozen=True):
    """Integral of a quartic blob around x over each of `n_bins` bins, which wrap around (Müller et al. 2019)."""

    n_dims_to_encode: Size | None = None
    n_bins: Annotated[int, msgspec.Meta(ge=1, le=256)] = 16


class SphericalHarmonics(_Record, tag_field="otype", tag="SphericalHarmonics", frozen=True):
    """Real spherical harmonics of bands below `degree`, of the unit vector 2 x - 1."""

    n_dims_to_encode: Size | None = None
    degree: Annotated[int, msgspec.Meta(ge=1, le=8)] = 4


class Grid(_Record, tag_field="otype", tag="Grid", frozen=True):
    """Multiresolution grid of trainable features (Müller et al. 2022)."""

    n_dims_to_encode: Size | None = None
    type: Literal["Hash", "Dense", "Tiled"] = "Hash"
    n_levels: Annotated[int, msgspec.Meta(ge=1, le=64)] = 16
    n_features_per_level: Literal[1, 2, 4, 8] = 2
    log2_hashmap_size: Annotated[int, msgspec.Meta(ge=1, le=28)] = 19
    base_resolution: Annotated[int, msgspec.Meta(ge=1, le=1 << 16)] = 16
    per_level_scale: Annotated[float, msgspec.Meta(ge=1, le=64)] = 2.0
    interpolation: Literal["Linear", "Smoothstep", "Nearest"] = "Linear"


Part = Identity | Frequency | TriangleWave | OneBlob | SphericalHarmonics | Grid


class Composite(_Record, tag_field="otype", tag="Composite", frozen=True):
    """Parts that encode consecutive dimensions, side by side; one part may leave out `n_dims_to_encode`."""

    nested: Annotated[list[Part], msgspec.Meta(min_length=1)]
    n_dims_to_encode: Size | None = None


Encoding = Identity | Frequency | TriangleWave | OneBlob | SphericalHarmonics | Grid | Composite


class MLP(_Record, tag_field="otype", tag="MLP", frozen=True):
    """Fully connected network with `n_hidden_layers` layers of `n_neurons`."""

    n_neurons: Annotated[int, msgspec.Meta(ge=1, le=512)] = 128
    n_hidden_layers: Annotated[int, msgspec.Meta(ge=0, le=64)] = 5
    activation: Activation = "ReLU"
    output_activation: Activation = "None"
    bias: bool = False
    n_parts: Count | None = None  # reads the first parts of a composite encoding only
    feedback_alignment: Literal[False] = False  # in the schema; only its default is supported


class L1(_Record, tag_field="otype", tag="L1", frozen=True):
    """|y - t|"""


class L2(_Record, tag_field="otype", tag="L2", frozen=True):
    """(y - t)²"""


class RelativeL1(_Record, tag_field="otype", tag="RelativeL1", frozen=True):
    """|y - t| / (|y| + 0.01), the denominator held constant in the gradient."""


class RelativeL2(_Record, tag_field="otype", tag="RelativeL2", frozen=True):
    """(y - t)² / (y² + 0.01), the denominator held constant in the gradient (Lehtinen et al. 2018)."""


class RelativeL2Luminance(_Record, tag_field="otype", tag="RelativeL2Luminance", frozen=True):
    """As RelativeL2, divided by the squared luminance of the predicted RGB (Müller et al. 2021)."""


class MAPE(_Record, tag_field="otype", tag="MAPE", frozen=True):
    """|y - t| / (|t| + 0.01)"""


class SMAPE(_Record, tag_field="otype", tag="SMAPE", frozen=True):
    """|y - t| / ((|y| + |t|) / 2 + 0.01), the denominator held constant in the gradient."""


class CrossEntropy(_Record, tag_field="otype", tag="CrossEntropy", frozen=True):
    """-t log y; y is a probability density."""


class Variance(_Record, tag_field="otype", tag="Variance", frozen=True):
    """t² / y, the second moment of the estimator t / y; y is a probability density."""


Loss = L1 | L2 | RelativeL1 | RelativeL2 | RelativeL2Luminance | MAPE | SMAPE | CrossEntropy | Variance


class Adam(_Record, tag_field="otype", tag="Adam", frozen=True):
    """Adam (Kingma and Ba 2014), optionally AdaBound (Luo et al. 2019).

    An entry of an encoding whose gradient is exactly zero is left alone: value, moments and its own step count.
    """

    learning_rate: NonNegative = 1e-3
    beta1: Fraction = 0.9
    beta2: Fraction = 0.999
    epsilon: NonNegative = 1e-8
    l2_reg: NonNegative = 1e-8  # matrices only
    relative_decay: NonNegative = 0.0
    absolute_decay: NonNegative = 0.0
    adabound: bool = False
    clipping_magnitude: NonNegative = 0.0  # largest magnitude of a parameter; 0: none
    non_matrix_learning_rate_factor: NonNegative = 1.0
    optimize_matrix_params: bool = True
    optimize_non_matrix_params: bool = True


class SGD(_Record, tag_field="otype", tag="SGD", frozen=True):
    """Gradient descent."""

    learning_rate: NonNegative = 1e-3
    l2_reg: NonNegative = 1e-8


class EMA(_Record, tag_field="otype", tag="EMA", frozen=True):
    """Bias-corrected exponential moving average of the parameters, which inference uses."""

    nested: Optimizer
    decay: Fraction = 0.99
    full_precision: bool = False  # in the schema; ours is always in float32


class ExponentialDecay(_Record, tag_field="otype", tag="ExponentialDecay", frozen=True):
    """Multiplies the learning rate by `decay_base` at `decay_start` and every `decay_interval` steps to `decay_end`."""

    nested: Optimizer
    decay_base: Positive = 0.1
    decay_start: Size = 10_000
    decay_end: Annotated[int, msgspec.Meta(ge=0)] = 10_000_000
    decay_interval: Count = 10_000


Optimizer = Adam | SGD | EMA | ExponentialDecay


class GradientClipping(_Record, frozen=True):
    """Scales all gradients together so that their Euclidean norm is at most `global_norm`."""

    global_norm: Positive


class ModelConfig(_Record, frozen=True):
    """A whole model.

    Attributes:
        network: One, or several that share the encoding.
        precision: Of the weights and activations inside the network; parameters are always kept in float32.
        loss_scale: Factor of all gradients, undone by the optimizer; ``"dynamic"`` halves it at an overflow and doubles
            it after 2000 steps without.
    """

    encoding: Encoding = msgspec.field(default_factory=Identity)
    network: MLP | list[MLP] = msgspec.field(default_factory=MLP)
    loss: Loss = msgspec.field(default_factory=L2)
    optimizer: Optimizer = msgspec.field(default_factory=Adam)
    precision: Literal["fp32", "fp16", "bf16"] = "fp32"
    loss_scale: Positive | Literal["dynamic"] = 1.0
    gradient_clipping: GradientClipping | None = None


_KINDS = {
    "encoding": get_args(Encoding),
    "part": get_args(Part),
    "network": (MLP,),
    "loss": get_args(Loss),
    "optimizer": get_args(Optimizer),
}
_ALIASES = {
    "hashgrid": ("Grid", "Hash"),
    "densegrid": ("Grid", "Dense"),
    "tiledgrid": ("Grid", "Tiled"),
    "fullyfusedmlp": ("MLP", None),
    "cutlassmlp": ("MLP", None),
}
_ALIAS_NAMES = {
    "encoding": ["HashGrid", "DenseGrid", "TiledGrid"],
    "part": ["HashGrid", "DenseGrid", "TiledGrid"],
    "network": ["FullyFusedMLP", "CutlassMLP"],
}
_ENUMERATIONS = ("type", "interpolation", "activation", "output_activation", "precision", "loss_scale")
_STEP = re.compile(r"\.([A-Za-z_]\w*)|\[(\d+)\]")


def load(config: Mapping | str | os.PathLike | ModelConfig) -> ModelConfig:
    """Reads a configuration.

    Args:
        config: The object as parsed from JSON, or the path of a JSON file, which may have ``//`` comments.

    Raises:
        ConfigError: With the path in the configuration, what was found there, and what is allowed.
    """
    if isinstance(config, ModelConfig):
        return config
    if isinstance(config, (str, os.PathLike)):
        with of_file(config):
            return load(_read(config))
    if not isinstance(config, Mapping):
        raise ConfigError("", f"a configuration is an object, or the path of a file; found {_shown(config)}")
    raw = _check_keys(dict(config), ModelConfig, "")
    for key in ("encoding", "network", "loss", "optimizer"):
        if key == "network" and isinstance(raw.get(key), list):
            if not raw[key]:
                raise ConfigError(key, "found []; allowed: a list that is not empty")
            raw[key] = [_canonical(r, key, f"{key}[{i}]") for i, r in enumerate(raw[key])]
        elif key in raw:
            raw[key] = _canonical(raw[key], key, key)
    if isinstance(raw.get("gradient_clipping"), Mapping):
        raw["gradient_clipping"] = _check_keys(dict(raw["gradient_clipping"]), GradientClipping, "gradient_clipping")
    try:
        return msgspec.convert(raw, ModelConfig)
    except msgspec.ValidationError as error:
        raise _explained(raw, str(error)) from None


def dump(config: ModelConfig) -> dict:
    """The object that `load` reads back as an equal configuration."""
    return msgspec.to_builtins(config)


def _read(path):
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError("", getattr(error, "strerror", None) or f"not UTF-8: {error.reason}") from None
    # Comments outside strings; the first alternative consumes strings whole.
    text = re.sub(r'("(?:\\.|[^"\\])*")|//[^\n]*', lambda match: match[1] or "", text)
    try:
        value = json.loads(text)
    except json.JSONDecodeError as error:
        raise ConfigError("", f"line {error.lineno}: {error.msg}") from None
    if not isinstance(value, Mapping):
        raise ConfigError("", f"a configuration is an object; found {_shown(value)}")
    return value


def _canonical(raw, kind, path):
    """`raw` with the schema's own spelling of names, after a check of its `otype` and keys."""
    if not isinstance(raw, Mapping):
        raise ConfigError(path, f"expected an object; found {_shown(raw)}")
    raw = dict(raw)
    records = {record.__struct_config__.tag: record for record in _KINDS[kind]}
    names = list(records) + _ALIAS_NAMES.get(kind, [])
    name = raw.get("otype")
    if not isinstance(name, str):
        raise ConfigError(f"{path}.otype", f"found {_shown(name)}; allowed: {', '.join(names)}")
    by_lower = {known.lower(): known for known in names}
    canonical = by_lower.get(name.lower())
    if canonical is None:
        raise ConfigError(f"{path}.otype", f"found {_shown(name)}; allowed: {', '.join(names)}")
    if canonical.lower() in _ALIASES:
        canonical, grid_type = _ALIASES[canonical.lower()]
        if grid_type is not None:
            if str(raw.get("type", grid_type)).lower() != grid_type.lower():
                raise ConfigError(f"{path}.type", f"found {_shown(raw['type'])}; {name} allows: {grid_type}")
            raw["type"] = grid_type
    raw["otype"] = canonical
    _check_keys(raw, records[canonical], path)
    if isinstance(raw.get("nested"), list):
        raw["nested"] = [_canonical(r, "part", f"{path}.nested[{i}]") for i, r in enumerate(raw["nested"])]
    elif "nested" in raw and kind == "optimizer":
        raw["nested"] = _canonical(raw["nested"], "optimizer", f"{path}.nested")
    elif kind == "optimizer" and canonical in ("EMA", "ExponentialDecay"):
        raw["nested"] = {"otype": "Adam"}
    return raw


def _check_keys(raw, record, path):
    """Names every unknown key's neighbours, and writes enumerations as the schema spells them."""
    fields = {field.encode_name: field for field in msgspec.structs.fields(record)}
    allowed = sorted(fields) if record in (ModelConfig, GradientClipping) else ["otype", *sorted(fields)]
    for key in raw:
        if key not in allowed:
            close = difflib.get_close_matches(str(key), allowed, 1)
            hint = f" (did you mean {close[0]!r}?)" if close else ""
            where = f"{path}.{key}" if path else str(key)
            raise ConfigError(where, f"unknown key{hint}; allowed: {', '.join(allowed)}")
        if isinstance(raw[key], float) and not math.isfinite(raw[key]):
            raise ConfigError(f"{path}.{key}" if path else str(key), f"found {raw[key]}; allowed: a finite number")
    for key in _ENUMERATIONS:
        if key in fields and isinstance(raw.get(key), str):
            for literal in _literals(fields[key].type):
                if str(literal).lower() == raw[key].lower():
                    raw[key] = literal
    return raw


def _literals(annotation):
    if getattr(annotation, "__origin__", None) is Literal:
        return get_args(annotation)
    return [value for argument in get_args(annotation) for value in _literals(argument)]


def _explained(raw, text):
    message, _, where = text.partition(" - at `$")
    steps = [name or int(index) for name, index in _STEP.findall(where)]
    value, record = raw, ModelConfig
    for step in steps:
        try:
            value = value[step]
        except (LookupError, TypeError):
            value = None
    owner = raw
    for step in steps[:-1]:
        owner = owner[step]
    if isinstance(owner, Mapping) and "otype" in owner:
        record = next(r for group in _KINDS.values() for r in group if r.__struct_config__.tag == owner["otype"])
    elif steps[:1] == ["gradient_clipping"] and len(steps) == 2:
        record = GradientClipping
    path = "".join(f"[{s}]" if isinstance(s, int) else f".{s}" for s in steps).removeprefix(".")
    field = next((f for f in msgspec.structs.fields(record) if steps and f.encode_name == steps[-1]), None)
    if "missing required field" in message:
        return ConfigError(path, message[0].lower() + message[1:].replace("`", "'"))
    allowed = _allowed(field.type) if field is not None else message.removeprefix("Expected ").replace("`", "")
    return ConfigError(path, f"found {_shown(value)}; allowed: {allowed}")


def _allowed(annotation: Any) -> str:
    if annotation in (int, float, bool, str):
        return {int: "a whole number", float: "a number", bool: "true or false", str: "a string"}[annotation]
    if annotation is type(None):
        return "null"
    if (literals := _literals(annotation)) and getattr(annotation, "__origin__", None) is Literal:
        return ", ".join(json.dumps(value) for value in literals)
    meta = [m for m in getattr(annotation, "__metadata__", ()) if isinstance(m, msgspec.Meta)]
    if meta:
        bounds = [
            f"{sign} {limit:g}"
            for sign, limit in ((">=", meta[0].ge), (">", meta[0].gt), ("<=", meta[0].le), ("<", meta[0].lt))
            if limit is not None
        ]
        return " ".join([_allowed(annotation.__origin__), " and ".join(bounds)]).strip()
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        tag = annotation.__struct_config__.tag
        return f"an object with otype {tag}" if tag else "an object"
    if getattr(annotation, "__origin__", None) is list:
        return "a list that is not empty"
    return " or ".join(_allowed(argument) for argument in get_args(annotation))


def _shown(value):
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."
