"""Encodings: functions from input dimensions to the features that a network reads."""

from __future__ import annotations

import functools
import math

import numpy as np
import warp as wp

from nn import config as c
from nn.encodings import kernels as k
from nn.encodings.cpu_grid import make_cpu_grid_kernels
from nn.encodings.grid import GridLayout, make_grid_kernels
from nn.errors import ConfigError
from nn.mlp import pad


def spherical_harmonics_factors() -> np.ndarray:
    """Factors of the recurrence over l of the normalised real spherical harmonics, ``[8 l + m, 2]``.

    With Q(m, m) the entry [m, m, 0], which has the sign (-1)^m of Condon and Shortley and the √2 of the real harmonics:
    Q(l, m) = a z Q(l-1, m) - b Q(l-2, m), and Y(l, ±m) = Q(l, m)(z) times the real or imaginary part of (x + i y)^m.
    """
    factors = np.zeros((64, 2))
    for m in range(8):
        double_factorial = math.prod(range(2 * m - 1, 0, -2))
        q = (-1) ** m * math.sqrt((2 * m + 1) / (4 * math.pi) / math.factorial(2 * m)) * double_factorial
        factors[8 * m + m, 0] = q * (math.sqrt(2) if m else 1)
        for band in range(m + 1, 8):
            factors[8 * band + m, 0] = math.sqrt((4 * band * band - 1) / (band * band - m * m))
            factors[8 * band + m, 1] = math.sqrt(
                (2 * band + 1) * ((band - 1) ** 2 - m * m) / ((2 * band - 3) * (band * band - m * m))
                if band > m + 1
                else 0
            )
    return factors


class _Part:
    """A part of an encoding; input dimensions from `first_dim`, features from `column`."""

    n_params = 0

    def __init__(self, cfg, n_dims, first_dim, column, n_features):
        self.cfg, self.n_dims, self.first_dim, self.column, self.n_features = cfg, n_dims, first_dim, column, n_features


class _FixedPart(_Part):
    """A part without parameters: a pair of kernels, and their extra arguments."""

    def __init__(self, cfg, n_dims, first_dim, column, n_features, forward, backward, extra, backward_extra=None):
        super().__init__(cfg, n_dims, first_dim, column, n_features)
        self._forward, self._backward, self._extra = forward, backward, extra
        self._backward_extra = extra if backward_extra is None else backward_extra

    def kernels(self):
        """All kernels that it launches."""
        return [self._forward, self._backward]

    def forward(self, x, first_row, n_rows, first_dim, parameters, encoded, column):
        """Writes features of rows ``first_row … first_row + n_rows``."""
        inputs = [x, first_row, first_dim, *self._extra]
        wp.launch(self._forward, dim=n_rows, inputs=inputs, outputs=[encoded, column], device=x.device)

    def backward_inputs(self, x, first_row, n_rows, parameters, dL_dencoded, dL_dx):
        """Adds the gradient with respect to the inputs of these rows."""
        inputs = [x, first_row, self.first_dim, *self._backward_extra, dL_dencoded, self.column]
        wp.launch(self._backward, dim=n_rows, inputs=inputs, outputs=[dL_dx], device=x.device)


class _GridPart(_Part):
    """A grid; `offset` is that of its first parameter among those of the model."""

    def __init__(self, cfg, n_dims, first_dim, column, layout, device, blocks):
        super().__init__(cfg, n_dims, first_dim, column, cfg.n_levels * cfg.n_features_per_level)
        self.layout, self.offset = layout, 0
        self.n_params = layout.n_entries * cfg.n_features_per_level
        self.levels = layout.upload(device)
        kind = (n_dims, cfg.n_features_per_level, cfg.interpolation, any(layout.hashed))
        self._blocks = blocks
        self._kernels = make_cpu_grid_kernels(*kind) if blocks else make_grid_kernels(*kind)
        self._sums = None
        self._feature = wp.types.vector(cfg.n_features_per_level, wp.float32)

    def kernels(self):
        """All kernels that it launches."""
        return list(self._kernels)

    def _view(self, parameters):
        """The entries of the grid among all parameters, or gradients."""
        return wp.array(
            ptr=parameters.ptr + 4 * self.offset,
            shape=self.layout.n_entries,
            dtype=self._feature,
            device=parameters.device,
        )

    def forward(self, x, first_row, n_rows, first_dim, parameters, encoded, column):
        """Writes features of rows ``first_row … first_row + n_rows``."""
        inputs = [first_dim, self.levels, self._view(parameters)]
        if self._blocks:
            dim, inputs = (-(-n_rows // 64), self.cfg.n_levels), [x, first_row, first_row + n_rows, *inputs]
        else:
            dim, inputs = (self.cfg.n_levels, n_rows), [x, first_row, *inputs]
        wp.launch(self._kernels[0], dim=dim, inputs=inputs, outputs=[encoded, column], device=x.device)

    def backward_parameters(self, x, n_rows, dL_dencoded, gradients, workers):
        """Adds the gradient with respect to the parameters, over all rows.

        In blocks a thread takes whole levels and goes through the rows in order: no copies, no atomics, and the same
        sums for any number of threads. Elsewhere atomics add in float64: in float32 the rounding of a million equal
        terms would be seen, and sums would depend on timing by more than a rounding.
        """
        view = self._view(gradients)
        if self._blocks:
            workers.run(
                lambda first, n, worker: wp.launch(
                    self._kernels[1],
                    dim=n,
                    inputs=[x, n_rows, self.first_dim, self.levels, first, dL_dencoded, self.column],
                    outputs=[view],
                    device=x.device,
                ),
                self.cfg.n_levels,
            )
            return
        if self._sums is None:
            self._sums = wp.zeros(self.n_params, dtype=wp.float64, device=x.device)
        inputs = [x, self.first_dim, self.levels, dL_dencoded, self.column]
        wp.launch(
            self._kernels[1], dim=(self.cfg.n_levels, n_rows), inputs=inputs, outputs=[self._sums], device=x.device
        )
        inputs, outputs = [self.offset], [self._sums, gradients]
        wp.launch(k.add_sums, dim=self.n_params, inputs=inputs, outputs=outputs, device=x.device)

    def backward_inputs(self, x, first_row, n_rows, parameters, dL_dencoded, dL_dx):
        """Adds the gradient with respect to the inputs of these rows."""
        rows = [first_row, first_row + n_rows] if self._blocks else [first_row]
        inputs = [x, *rows, self.first_dim, self.levels, self.cfg.n_levels, self._view(parameters)]
        wp.launch(
            self._kernels[2],
            dim=-(-n_rows // 64) if self._blocks else n_rows,
            inputs=[*inputs, dL_dencoded, self.column],
            outputs=[dL_dx],
            device=x.device,
        )


@functools.cache
def _factors_on(device: str):
    return wp.array(spherical_harmonics_factors().astype(np.float32), dtype=wp.float32, device=device)


def _make_part(cfg, n_dims, first_dim, column, path, device, blocks):
    if isinstance(cfg, c.Grid):
        return _GridPart(cfg, n_dims, first_dim, column, GridLayout(cfg, n_dims, path), device, blocks)
    if isinstance(cfg, c.SphericalHarmonics):
        if n_dims != 3:
            raise ConfigError(f"{path}.n_dims_to_encode", f"found {n_dims}; spherical harmonics encode 3 dimensions")
        extra = [cfg.degree, _factors_on(device.alias)]
        forward, backward = k.spherical_harmonics_forward, k.spherical_harmonics_backward
        return _FixedPart(cfg, n_dims, first_dim, column, cfg.degree**2, forward, backward, extra)
    if isinstance(cfg, c.OneBlob):
        per_dim, pair, extra = cfg.n_bins, (k.one_blob_forward, k.one_blob_backward), [cfg.n_bins]
    elif isinstance(cfg, c.Frequency):
        per_dim, pair = 2 * cfg.n_frequencies, (k.frequency_forward, k.frequency_backward)
        extra = [cfg.n_frequencies]
    elif isinstance(cfg, c.TriangleWave):
        per_dim, pair = cfg.n_frequencies, (k.triangle_wave_forward, k.triangle_wave_backward)
        extra = [cfg.n_frequencies]
    else:
        pair, extra = (k.identity_forward, k.identity_backward), [n_dims, cfg.scale, cfg.offset]
        return _FixedPart(cfg, n_dims, first_dim, column, n_dims, *pair, extra, [n_dims, cfg.scale])
    return _FixedPart(cfg, n_dims, first_dim, column, per_dim * n_dims, *pair, [n_dims, *extra])


class Encoding:
    """All parts of an encoding; features of a row are side by side, padded with zeros to a multiple of 16.

    Args:
        cfg: The encoding.
        n_dims: Input dimensions.
        device: Where it runs.
        blocks: By the kernels of the CPU device for blocks of rows, where it has its own.

    Raises:
        ConfigError: The parts do not fit the input dimensions.
    """

    def __init__(self, cfg: c.Encoding, n_dims: int, device, blocks: bool):
        self.parts = []
        composite = isinstance(cfg, c.Composite)
        dim = column = 0
        nested = cfg.nested if composite else [cfg]
        given = [part.n_dims_to_encode for part in nested]
        if composite and given.count(None) > 1:
            second = [i for i, n in enumerate(given) if n is None][1]
            raise ConfigError(
                f"encoding.nested[{second}]", "one part only may leave out n_dims_to_encode; an earlier one did"
            )
        rest = n_dims - sum(n for n in given if n is not None)
        if rest < 0 or (rest > 0 and None not in given):
            raise ConfigError(
                "encoding", f"its parts encode {n_dims - rest} dimensions; the model has {n_dims} input dimensions"
            )
        for i, part in enumerate(nested):
            path = f"encoding.nested[{i}]" if composite else "encoding"
            size = rest if part.n_dims_to_encode is None else part.n_dims_to_encode
            if size == 0:
                raise ConfigError(f"{path}.n_dims_to_encode", "found 0; no input dimension is left for this part")
            self.parts.append(_make_part(part, size, dim, column, path, device, blocks))
            dim, column = dim + size, column + self.parts[-1].n_features
        self.n_dims, self.n_features, self.stride = n_dims, column, pad(column)
        self.n_params = sum(part.n_params for part in self.parts)

    def place(self, offset: int) -> None:
        """Says where among all parameters those of the parts begin."""
        for part in self.parts:
            if part.n_params:
                part.offset = offset
                offset += part.n_params

    def initialize(self, rng: np.random.Generator, out: np.ndarray) -> None:
        """Features uniform in ±1e-4, as in the schema's home."""
        out[...] = rng.random(out.size, dtype=np.float32) * np.float32(2e-4) - np.float32(1e-4)
