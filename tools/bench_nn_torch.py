"""The networks of `tools.bench_nn` in PyTorch, written for speed: the peer that ours is measured against."""

from __future__ import annotations

import math

import numpy as np
import torch

from nn import config as c
from nn.encodings.grid import GridLayout


class Grid(torch.nn.Module):
    """A dense or hashed grid: per level, all corners in one weighted look-up. Inputs lie in the unit cube."""

    def __init__(self, cfg: c.Grid, n_dims: int):
        super().__init__()
        layout = GridLayout(cfg, n_dims)
        self.n_dims, self.smooth = n_dims, cfg.interpolation == "Smoothstep"
        self.tables = torch.nn.ParameterList(torch.empty(size, cfg.n_features_per_level) for size in layout.sizes)
        self.hashed = layout.hashed
        self.scales, self.sizes = layout.scales, layout.sizes
        self.strides = [stride[:n_dims] for stride in layout.strides]
        corners = [[(corner >> d) & 1 for d in range(n_dims)] for corner in range(1 << n_dims)]
        for level, stride in enumerate(self.strides):
            steps = [sum(b * s for b, s in zip(bits, stride, strict=True)) for bits in corners]
            self.register_buffer(f"steps{level}", torch.tensor(steps))

    def _level(self, x, level):
        """Features of one level: its tensors stay in the cache."""
        p = x * self.scales[level] + 0.5
        cell = torch.floor(p)
        t = p - cell
        if self.smooth:
            t = t * t * (3 - 2 * t)
        both = torch.stack((1 - t, t), 2)  # [n, dims, 2]
        weight = both[:, 0]
        for d in range(1, self.n_dims):
            weight = (both[:, d, :, None] * weight[:, None, :]).flatten(1)
        size, cell = self.sizes[level], cell.long()
        if self.hashed[level]:
            index = None
            for d, prime in enumerate((1, 2654435761, 805459861, 3674653429)[: self.n_dims]):
                pair = torch.stack((cell[:, d], cell[:, d] + 1), 1) * prime
                index = pair if index is None else (pair[:, :, None] ^ index[:, None, :]).flatten(1)
            index = index & (size - 1)
        else:
            base = cell[:, 0] * self.strides[level][0]
            for d in range(1, self.n_dims):
                base = base + cell[:, d] * self.strides[level][d]
            index = base[:, None] + getattr(self, f"steps{level}")
            index = torch.where(index >= size, index - size, index)
        # faster than embedding_bag and than advanced indexing, backward included
        values = self.tables[level].index_select(0, index.view(-1)).view(*index.shape, -1)
        return torch.bmm(weight[:, None, :], values).squeeze(1)

    def forward(self, x):
        return torch.cat([self._level(x, level) for level in range(len(self.scales))], 1)


def spherical_harmonics(cfg, x):
    """The first two bands, which the network of the benchmark uses."""
    if cfg.degree != 2:
        raise ValueError("the benchmark's spherical harmonics are of degree 2")
    v = 2 * x - 1
    k = math.sqrt(3 / (4 * math.pi))
    first = torch.full_like(v[:, :1], math.sqrt(1 / (4 * math.pi)))
    return torch.cat((first, -k * v[:, 1:2], k * v[:, 2:3], -k * v[:, 0:1]), 1)


def one_blob(cfg, x):
    n = cfg.n_bins
    edges = torch.arange(n + 1, dtype=x.dtype, device=x.device)
    u = edges - x[:, :, None] * n
    u = torch.stack((u - n, u, u + n)).clamp(-1, 1)
    u2 = u * u
    cdf = (0.9375 * u * (1 - (2 / 3) * u2 + 0.2 * u2 * u2) + 0.5).sum(0)
    return (cdf[..., 1:] - cdf[..., :-1]).flatten(1)


class Network(torch.nn.Module):
    """The model of a configuration (grid, spherical harmonics, one-blob, identity; ReLU)."""

    def __init__(self, cfg: c.ModelConfig, n_in: int, n_out: int):
        super().__init__()
        encoding = cfg.encoding
        self.parts = encoding.nested if isinstance(encoding, c.Composite) else [encoding]
        known = sum(part.n_dims_to_encode or 0 for part in self.parts)
        self.dims = [n_in - known if p.n_dims_to_encode is None else p.n_dims_to_encode for p in self.parts]
        self.grids = torch.nn.ModuleList(
            Grid(part, d) for part, d in zip(self.parts, self.dims, strict=True) if isinstance(part, c.Grid)
        )
        width = self.encode(torch.zeros(1, n_in)).shape[1]
        layers = []
        for _ in range(cfg.network.n_hidden_layers):
            layers += [torch.nn.Linear(width, cfg.network.n_neurons, bias=False), torch.nn.ReLU(inplace=True)]
            width = cfg.network.n_neurons
        self.mlp = torch.nn.Sequential(*layers, torch.nn.Linear(width, n_out, bias=False))

    def encode(self, x):
        features, first, grids = [], 0, iter(self.grids)
        for part, dims in zip(self.parts, self.dims, strict=True):
            piece = x[:, first : first + dims]
            first += dims
            if isinstance(part, c.Grid):
                features.append(next(grids)(piece))
            elif isinstance(part, c.SphericalHarmonics):
                features.append(spherical_harmonics(part, piece))
            elif isinstance(part, c.OneBlob):
                features.append(one_blob(part, piece))
            else:
                features.append(piece)
        return torch.cat(features, 1) if len(features) > 1 else features[0]

    def forward(self, x):
        return self.mlp(self.encode(x))

    def load(self, parameters: np.ndarray, n_matrix_params: int) -> None:
        """Takes over the parameters of our model."""
        with torch.no_grad():
            at = 0
            for tensors, first in ((list(self.mlp.parameters()), 0), (list(self.grids.parameters()), None)):
                at = -(-n_matrix_params // 8) * 8 if first is None else first
                for tensor in tensors:
                    tensor.copy_(torch.from_numpy(parameters[at : at + tensor.numel()].reshape(tensor.shape)))
                    at += tensor.numel()


AUTOCAST = {"fp16": torch.float16, "bf16": torch.bfloat16}


class Trainer:
    """A training step with fused Adam over all parameters, and the average of the parameters.

    Args:
        network: The network, on its device.
        cfg: Its configuration.
        compiled: By `torch.compile`.
        precision: Of matrix products: ``fp32``, ``tf32`` (on CUDA), or ``fp16`` and ``bf16`` by autocast.
    """

    def __init__(self, network: Network, cfg: c.ModelConfig, compiled: bool, precision: str = "fp32"):
        self.network, self.precision = network, precision
        self.device_type = next(network.parameters()).device.type
        optimizer, self.decay = cfg.optimizer, None
        if isinstance(optimizer, c.EMA):
            optimizer, self.decay = optimizer.nested, optimizer.decay
        self.optimizer = torch.optim.Adam(
            network.parameters(),
            optimizer.learning_rate,
            (optimizer.beta1, optimizer.beta2),
            optimizer.epsilon,
            fused=True,
        )
        self.averages = [p.detach().clone() for p in network.parameters()]
        self.module = torch.compile(network, dynamic=False) if compiled else network

    def call(self, x):
        torch.backends.cuda.matmul.allow_tf32 = self.precision == "tf32"
        if self.precision not in AUTOCAST:
            return self.module(x)
        with torch.autocast(self.device_type, AUTOCAST[self.precision]):
            return self.module(x).float()

    def train(self, x, target):
        self.optimizer.zero_grad(set_to_none=True)
        loss = torch.nn.functional.mse_loss(self.call(x), target)
        loss.backward()
        self.optimizer.step()
        if self.decay is not None:
            with torch.no_grad():
                torch._foreach_lerp_(self.averages, list(self.network.parameters()), 1 - self.decay)
        return loss

    def infer(self, x):
        with torch.inference_mode():
            return self.call(x)
