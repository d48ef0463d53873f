"""The multilayer perceptron: its layers, the order of its parameters, and their first values.

Parameters of a layer are its matrix, row-major ``[n_out, n_in]``, then its bias if there is one; layers follow each
other. A network has no notion of a device; `nn.cpu_mlp` executes it.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from nn import config as c


def pad(n: int, multiple: int = 16) -> int:
    """The next multiple."""
    return -(-n // multiple) * multiple


@dataclasses.dataclass(frozen=True)
class Layer:
    """One layer: sizes, and where its parameters begin among those of the network."""

    n_in: int
    n_out: int
    weight: int
    bias: int  # -1: none
    activation: str


@dataclasses.dataclass(frozen=True)
class MLP:
    """A network from `n_in` features to `n_out` values.

    Args:
        cfg: Its record.
        n_in: Features that it reads.
        n_out: Values that it writes.
    """

    cfg: c.MLP
    n_in: int
    n_out: int

    @property
    def layers(self) -> list[Layer]:
        """Layers in order."""
        widths = [self.n_in] + [self.cfg.n_neurons] * self.cfg.n_hidden_layers + [self.n_out]
        layers, offset = [], 0
        for i, (n_in, n_out) in enumerate(itertools.pairwise(widths)):
            last = i == len(widths) - 2
            layers.append(
                Layer(
                    n_in,
                    n_out,
                    offset,
                    offset + n_in * n_out if self.cfg.bias else -1,
                    self.cfg.output_activation if last else self.cfg.activation,
                )
            )
            offset += n_in * n_out + (n_out if self.cfg.bias else 0)
        return layers

    @property
    def n_params(self) -> int:
        """All matrices and biases."""
        last = self.layers[-1]
        return last.weight + last.n_in * last.n_out + (last.n_out if self.cfg.bias else 0)

    def initialize(self, rng: np.random.Generator, out: np.ndarray) -> None:
        """Xavier-uniform matrices (Glorot and Bengio 2010), as in the schema's home; zero biases."""
        for layer in self.layers:
            limit = np.sqrt(6.0 / (layer.n_in + layer.n_out))
            size = layer.n_in * layer.n_out
            out[layer.weight : layer.weight + size] = rng.uniform(-limit, limit, size)
            if layer.bias >= 0:
                out[layer.bias : layer.bias + layer.n_out] = 0.0

    def flops_per_sample(self) -> int:
        """Floating-point operations of the matrices, forward."""
        return sum(2 * layer.n_in * layer.n_out for layer in self.layers)
