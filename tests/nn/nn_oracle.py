"""The networks' definitions in float64 NumPy, written apart from the kernels, with the magnitudes that bound rounding.

Every function returns values and magnitudes: the sum of the absolute values of the terms that a value is a sum of,
carried through all layers. The float32 kernels are held to 1e-6 of it.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from nn import config as c


def grid_levels(cfg, n_dims):
    """(scale, resolution, entries) of each level. The scale is a float32 by definition."""
    levels = []
    for level in range(cfg.n_levels):
        growth = np.exp2(np.float32(level) * np.float32(math.log2(cfg.per_level_scale)))
        scale = np.float32(growth * np.float32(cfg.base_resolution) - np.float32(1))
        resolution = int(np.ceil(scale)) + 1
        entries = (resolution**n_dims + 7) // 8 * 8
        if cfg.type == "Tiled":
            entries = min(entries, cfg.base_resolution**n_dims)
        if cfg.type == "Hash":
            entries = min(entries, 2**cfg.log2_hashmap_size)
        levels.append((float(scale), resolution, entries))
    return levels


def grid_index(cfg, vertex, resolution, entries):
    """Entry of integer vertices [n, d], as the schema's home computes it."""
    n_dims = vertex.shape[1]
    index, stride = np.zeros(len(vertex), object), 1
    for d in range(n_dims):
        if stride > entries:
            break
        index = index + vertex[:, d].astype(object) * stride
        stride *= resolution
    if cfg.type == "Hash" and entries < stride:
        primes = (1, 2654435761, 805459861, 3674653429)
        index = np.zeros(len(vertex), np.uint64)
        for d in range(n_dims):
            index = index ^ (vertex[:, d].astype(np.int64).astype(np.uint64) * np.uint64(primes[d]) % 2**32)
    return np.array([int(i) % 2**32 % entries for i in index], np.int64)


def encode_grid(cfg, x, table):
    n, n_dims = x.shape
    values, sizes, first = [], [], 0
    f = cfg.n_features_per_level
    table = table.reshape(-1, f)
    for scale, resolution, entries in grid_levels(cfg, n_dims):
        p = x * scale + 0.5
        cell = np.floor(p)
        t = p - cell
        if cfg.interpolation == "Smoothstep":
            t = t * t * (3 - 2 * t)
        value, size = np.zeros((n, f)), np.zeros((n, f))
        corners = 1 if cfg.interpolation == "Nearest" else 2**n_dims
        for corner in range(corners):
            bits = np.array([(corner >> d) & 1 for d in range(n_dims)])
            w = np.ones(n) if corners == 1 else np.prod(np.where(bits, t, 1 - t), axis=1)
            row = table[first + grid_index(cfg, (cell + bits).astype(np.int64), resolution, entries)]
            value += w[:, None] * row
            size += np.abs(w[:, None] * row)
        values.append(value)
        sizes.append(size)
        first += entries
    return np.hstack(values), np.hstack(sizes)


def encode_spherical_harmonics(cfg, x):
    v = 2 * x - 1
    values, sizes = [], []
    for band in range(cfg.degree):
        for m in range(-band, band + 1):
            k = math.sqrt(
                (2 * band + 1) / (4 * math.pi) * math.factorial(band - abs(m)) / math.factorial(band + abs(m))
            )
            legendre = (
                np.polynomial.legendre.Legendre.basis(band).deriv(abs(m)) if m else np.polynomial.Legendre.basis(band)
            )
            powers = legendre.convert(kind=np.polynomial.Polynomial).coef
            z = np.polynomial.polynomial.polyval(v[:, 2], powers)
            z_size = np.polynomial.polynomial.polyval(np.abs(v[:, 2]), np.abs(powers))
            turned = (v[:, 0] + 1j * v[:, 1]) ** abs(m)
            xy = turned.imag if m < 0 else turned.real
            factor = (-1) ** abs(m) * k * (math.sqrt(2) if m else 1)
            values.append(factor * z * xy)
            sizes.append(np.abs(factor) * z_size * (np.abs(v[:, 0]) + np.abs(v[:, 1])) ** abs(m))
    return np.stack(values, 1), np.stack(sizes, 1)


def quartic_cdf(u):
    u = np.clip(u, -1, 1)
    return 15 / 16 * (u - 2 / 3 * u**3 + u**5 / 5) + 0.5


def encode_one_blob(cfg, x):
    n = cfg.n_bins
    edges = np.arange(n + 1) / n

    def cdf(b):
        return sum(quartic_cdf((b - x[:, :, None] + shift) * n) for shift in (-1, 0, 1))

    left, right = cdf(edges[:-1]), cdf(edges[1:])
    # the position within a bin is n · x, rounded; the slope of the integral is at most 15/16
    size = np.abs(left) + np.abs(right) + n * np.abs(x[:, :, None])
    return (right - left).reshape(len(x), -1), size.reshape(len(x), -1)


def encode_part(cfg, x, table):
    """Features of float64 x [n, d]."""
    if isinstance(cfg, c.Grid):
        return encode_grid(cfg, x, table)
    if isinstance(cfg, c.SphericalHarmonics):
        return encode_spherical_harmonics(cfg, x)
    if isinstance(cfg, c.OneBlob):
        return encode_one_blob(cfg, x)
    if isinstance(cfg, c.Identity):
        return cfg.scale * x + cfg.offset, np.abs(cfg.scale * x) + abs(cfg.offset)
    octaves = 2.0 ** np.arange(cfg.n_frequencies)
    if isinstance(cfg, c.Frequency):
        angle = math.pi * x[:, :, None] * octaves
        value = np.stack([np.sin(angle), np.cos(angle)], -1).reshape(len(x), -1)
        return value, np.full(value.shape, 4.0)  # the angle is reduced to one turn, whose rounding is 2 pi of it
    phase = x[:, :, None] * octaves / 2 + 0.25 * np.arange(cfg.n_frequencies)
    value = (4 * np.abs(phase - np.floor(phase) - 0.5) - 1).reshape(len(x), -1)
    return value, np.full(value.shape, 3.0)


def activate(name, x):
    """Activation and its derivative."""
    with np.errstate(over="ignore"):
        s = np.where(x < 0, np.exp(-np.abs(x)), 1.0) / (1 + np.exp(-np.abs(x)))
        if name == "None":
            return x, np.ones_like(x)
        if name == "ReLU":
            return np.maximum(x, 0), (x > 0).astype(float)
        if name == "LeakyReLU":
            return np.where(x > 0, x, 0.01 * x), np.where(x > 0, 1, 0.01)
        if name == "SiLU":
            return x * s, s * (1 + x * (1 - s))
        if name == "Sigmoid":
            return s, s * (1 - s)
        if name == "Tanh":
            return np.tanh(x), 1 - np.tanh(x) ** 2
        if name == "Softplus":
            return np.logaddexp(0, 10 * x) / 10, 1 / (1 + np.exp(-10 * x))
        if name == "Squareplus":
            root = np.sqrt(100 * x * x + 4)
            return np.where(x < 0, 4 / (root - 10 * x), root + 10 * x) / 20, 0.5 * (1 + 10 * x / root)
        if name == "Exponential":
            return np.exp(x), np.exp(x)
        if name == "Sine":
            return np.sin(x), np.cos(x)
    raise ValueError(name)


def loss_terms(name, y, t, held=None):
    """Loss of every entry. `held`: the prediction in denominators that the gradient holds constant."""
    held = y if held is None else held
    luminance = 0
    if name == "RelativeL2Luminance":
        luminance = np.sum(held.reshape(len(y), -1, 3) * [0.299, 0.587, 0.114], axis=(1, 2))[:, None]
    return {
        "L1": lambda: np.abs(y - t),
        "L2": lambda: (y - t) ** 2,
        "RelativeL1": lambda: np.abs(y - t) / (np.abs(held) + 0.01),
        "RelativeL2": lambda: (y - t) ** 2 / (held**2 + 0.01),
        "RelativeL2Luminance": lambda: (y - t) ** 2 / (luminance**2 + 0.01),
        "MAPE": lambda: np.abs(y - t) / (np.abs(t) + 0.01),
        "SMAPE": lambda: np.abs(y - t) / (0.5 * (np.abs(held) + np.abs(t)) + 0.01),
        "CrossEntropy": lambda: -t * np.log(y),
        "Variance": lambda: t * t / y,
    }[name]()


class Oracle:
    """A model in float64.

    Args:
        model: The model whose definition and sizes are taken; `parameters` are given to every call.
    """

    def __init__(self, model):
        self.config = model.config
        encoding = self.config.encoding
        self.parts = encoding.nested if isinstance(encoding, c.Composite) else [encoding]
        self.n_dims, self.n_out = model.n_input_dims, model.n_output_dims
        self.networks = self.config.network if isinstance(self.config.network, list) else [self.config.network]

    def part_dims(self):
        known = sum(part.n_dims_to_encode or 0 for part in self.parts)
        return [self.n_dims - known if p.n_dims_to_encode is None else p.n_dims_to_encode for p in self.parts]

    def n_features(self, part, dims):
        if isinstance(part, c.Grid):
            return part.n_levels * part.n_features_per_level
        return {
            c.SphericalHarmonics: lambda: part.degree**2,
            c.OneBlob: lambda: part.n_bins * dims,
            c.Frequency: lambda: 2 * part.n_frequencies * dims,
            c.TriangleWave: lambda: part.n_frequencies * dims,
            c.Identity: lambda: dims,
        }[type(part)]()

    def split(self, parameters):
        """Matrices (with biases) of every network, and tables of every part."""
        at, networks = 0, []
        for cfg, n_out in zip(self.networks, self.n_out, strict=True):
            parts = list(zip(self.parts, self.part_dims(), strict=True))[: cfg.n_parts]
            widths = [sum(self.n_features(p, d) for p, d in parts)] + [cfg.n_neurons] * cfg.n_hidden_layers + [n_out]
            layers = []
            for a, b in itertools.pairwise(widths):
                weight = parameters[at : at + a * b].reshape(b, a)
                at += a * b
                bias = parameters[at : at + b] if cfg.bias else np.zeros(b)
                at += b if cfg.bias else 0
                layers.append((weight, bias))
            networks.append(layers)
        at = -(-at // 8) * 8
        tables = []
        for part, dims in zip(self.parts, self.part_dims(), strict=True):
            size = 0
            if isinstance(part, c.Grid):
                size = sum(entries for _, _, entries in grid_levels(part, dims)) * part.n_features_per_level
            tables.append(parameters[at : at + size])
            at += size
        assert at == len(parameters)
        return networks, tables

    def encode(self, x, parameters, n_parts=None):
        """Features and their magnitudes."""
        _, tables = self.split(parameters)
        values, first = [], 0
        for part, dims, table in list(zip(self.parts, self.part_dims(), tables, strict=True))[:n_parts]:
            values.append(encode_part(part, x[:, first : first + dims], table))
            first += dims
        return np.hstack([v for v, _ in values]), np.hstack([s for _, s in values])

    def forward(self, x, parameters, network=0):
        """Outputs and their magnitudes for inputs [n, n_dims]."""
        x, parameters = np.asarray(x, np.float64), np.asarray(parameters, np.float64)
        cfg = self.networks[network]
        h, size = self.encode(x, parameters, cfg.n_parts)
        layers = self.split(parameters)[0][network]
        for i, (weight, bias) in enumerate(layers):
            name = cfg.output_activation if i == len(layers) - 1 else cfg.activation
            z = h @ weight.T + bias
            size = size @ np.abs(weight).T + np.abs(bias)
            h, slope = activate(name, z)
            # steepest slope within a rounding error, for ReLU and its like at zero
            steep = np.maximum(np.abs(slope), np.abs(activate(name, z + 1e-6 * size)[1]))
            size = steep * size + np.abs(h)
        return h, size

    def loss(self, x, parameters, target, held=None, network=0):
        """Mean loss; `held` as in `loss_terms`."""
        y, _ = self.forward(x, parameters, network)
        return loss_terms(self.config.loss.__struct_config__.tag, y, np.asarray(target, np.float64), held).mean()
