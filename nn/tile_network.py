"""A network by thread blocks: tables, scratch and launches around the kernels of `nn.tile_mlp`."""

from __future__ import annotations

import contextlib
import itertools
import threading

import numpy as np
import warp as wp

from nn.errors import ConfigError
from nn.mlp import MLP
from nn.tile_mlp import Shape, add_chunks, make_functions, make_infer_kernel, make_pack_kernel, make_train_kernel
from nn.workers import Buffers, Workers

DTYPES = {"fp32": wp.float32, "fp16": wp.float16, "bf16": wp.bfloat16}
WIDTHS = (16, 32, 64, 128)
CPU_CHUNKS = 4  # as many as a test needs to see that they add up
_one_at_a_time = threading.Lock()  # tile kernels of the CPU device share one arena


class TileNetwork:
    """A network as thread blocks execute it: its tables, and its passes over a batch.

    Args:
        mlp: The network.
        offset: Of its first parameter among all.
        stride: Of the rows of encoded features.
        device: Where it runs.
        precision: Of the operands of products: ``fp32``, ``fp16`` or ``bf16``.
        path: Of the network in the configuration, for messages.

    Raises:
        ConfigError: The network is wider than the kernels.
    """

    def __init__(self, mlp: MLP, offset: int, stride: int, device, precision: str, path: str):
        self.mlp, self.stride, self.device, self.half = mlp, stride, device, precision != "fp32"
        width = next((w for w in WIDTHS if w >= mlp.cfg.n_neurons), None)
        if width is None:
            raise ConfigError(
                f"{path}.n_neurons", f"found {mlp.cfg.n_neurons}; allowed on {device}: up to {WIDTHS[-1]}"
            )
        cfg = mlp.cfg
        self.shape = Shape(DTYPES[precision], width, cfg.activation, cfg.output_activation, cfg.bias)
        self.n_in, self.n_out = -(-mlp.n_in // width), -(-mlp.n_out // width)
        self.depth = cfg.n_hidden_layers
        blocks, biases = [], []
        for layer in mlp.layers:
            rows, columns = -(-layer.n_out // width), -(-layer.n_in // width)
            source = np.full((rows * width, columns * width), -1, np.int32)
            size = layer.n_in * layer.n_out
            source[: layer.n_out, : layer.n_in] = (
                np.arange(size).reshape(layer.n_out, layer.n_in) + layer.weight + offset
            )
            blocks.append(source.reshape(rows, width, columns, width).swapaxes(1, 2).reshape(-1))
            bias = np.full(rows * width, -1, np.int32)
            if layer.bias >= 0:
                bias[: layer.n_out] = np.arange(layer.n_out) + layer.bias + offset
            biases.append(bias)
        self.weight_source = wp.array(np.concatenate(blocks), dtype=wp.int32, device=device)
        self.bias_source = wp.array(np.concatenate(biases), dtype=wp.int32, device=device)
        self.n_blocks = self.weight_source.size // width**2
        # Two blocks for every multiprocessor, for one to work while the other waits.
        self.n_chunks = CPU_CHUNKS if device.is_cpu else 2 * device.sm_count
        self.infer_kernel, self.pack_kernel = make_infer_kernel(self.shape), make_pack_kernel(self.shape.dtype)

    def load(self, loss) -> None:
        """Builds the kernels of inference, and of training with `loss`."""
        train = make_train_kernel(self.shape, loss).kernel
        wp.force_load(device=self.device, modules=[self.infer_kernel.module, train.module], block_dim=self._threads)
        small = [self.pack_kernel, make_pack_kernel(wp.float32), add_chunks]
        wp.force_load(device=self.device, modules=list({kernel.module for kernel in small}))

    @property
    def _threads(self):
        return 1 if self.device.is_cpu else self.shape.threads

    def pack(self, parameters: wp.array):
        """The network with these parameters (a copy of them)."""
        width, shape = self.shape.width, self.shape
        net = make_functions(shape).Network()
        net.weights = wp.zeros((self.n_blocks * width, width), dtype=shape.dtype, device=self.device)
        net.biases = wp.zeros((self.bias_source.size // width, width), dtype=wp.float32, device=self.device)
        net.depth, net.n_in, net.n_out, net.n_blocks = self.depth, self.n_in, self.n_out, self.n_blocks
        net.n_outputs = self.mlp.n_out
        pairs = [(self.pack_kernel, self.weight_source, net.weights)]
        if shape.bias:
            pairs.append((make_pack_kernel(wp.float32), self.bias_source, net.biases))
        for kernel, source, packed in pairs:
            inputs = [parameters, source]
            wp.launch(kernel, dim=source.size, inputs=inputs, outputs=[packed.flatten()], device=self.device)
        return net

    def lend_scratch(self, workers: Workers, buffers: Buffers):
        """Inference needs none."""
        return contextlib.nullcontext()

    def infer(self, net, encoded: wp.array, row: int, end: int, worker: int, scratch, y: wp.array) -> None:
        """Outputs of rows ``row … end`` into `y`."""
        if end > row:
            features = self._features(encoded, end)[row:]
            self._launch(self.infer_kernel, -(-(end - row) // self.shape.rows), [features, net], [y[row:end]])

    def differentiate(
        self, net, encoded, n, loss, target, y, encode, scale, want_input, gradients, dL_dencoded, workers, buffers
    ) -> wp.array:
        """As `CpuNetwork.differentiate`."""
        width, M, shape = self.shape.width, self.shape.rows, self.shape
        train = make_train_kernel(shape, loss)
        if encode is not None:
            encode(0, n, 0)
        dL_dfeatures = dL_dencoded[: n * self.stride if want_input else 0].reshape((-1, self.stride))
        if want_input == 1 and self.n_in * width < self.stride:  # columns that this network does not read
            dL_dfeatures.zero_()
            want_input = 2
        mean = 1.0 / (n * self.mlp.n_out) if loss is not None else 1.0
        inside, outside = (1.0, mean) if self.half else (mean, 1.0)
        s = train.Scratch()
        rows, n_biases = self.n_chunks * M, self.bias_source.size // width
        values_size = rows * self.depth * width
        n_outputs = self.n_out * width
        sizes = [values_size, rows * n_outputs, rows * n_outputs, rows * n_outputs,
                 self.n_chunks * self.weight_source.size, self.n_chunks * self.bias_source.size]  # fmt: skip
        with buffers.lend(("training", id(self)), sum(sizes)) as room:
            bounds = [0, *itertools.accumulate(sizes)]
            values, sums, outputs, flat, weights, biases = (
                room[first:end] for first, end in itertools.pairwise(bounds)
            )
            s.values = wp.array(
                ptr=values.ptr if values.size else None, dtype=shape.dtype, shape=(rows * self.depth, width),
                device=self.device,
            )  # fmt: skip
            s.sums, s.outputs = sums.reshape((rows, n_outputs)), outputs
            s.gradients, s.flat_gradients = flat.reshape((rows, n_outputs)), flat
            losses = wp.zeros((self.n_chunks, self._threads), dtype=wp.float64, device=self.device)
            self._launch(
                train.kernel,
                self.n_chunks,
                [self._features(encoded, n), n, net, target, scale, inside, outside, want_input, s],
                [
                    y,
                    losses,
                    weights.reshape((self.n_chunks * self.n_blocks * width, width)),
                    biases.reshape((self.n_chunks * n_biases, width)),
                    dL_dfeatures,
                ],
            )
            for source, chunks in ((self.weight_source, weights), (self.bias_source, biases)):
                if source is self.weight_source or shape.bias:
                    inputs = [source, self.n_chunks, outside]
                    outputs = [chunks, gradients]
                    wp.launch(add_chunks, dim=source.size, inputs=inputs, outputs=outputs, device=self.device)
        return losses

    def _features(self, flat, n):
        """The columns of `n` rows that the network reads."""
        rows = flat[: n * self.stride].reshape((n, self.stride))
        return rows if self.mlp.cfg.n_parts is None else rows[:, : self.mlp.n_in]

    def _launch(self, kernel, n_blocks, inputs, outputs):
        with _one_at_a_time if self.device.is_cpu else contextlib.nullcontext():
            wp.launch_tiled(
                kernel, dim=[n_blocks], inputs=inputs, outputs=outputs, block_dim=self.shape.threads, device=self.device
            )
