"""A network on the CPU device: tables and launches around the kernels of `nn.cpu_mlp`."""

from __future__ import annotations

import numpy as np
import warp as wp

from nn import activations
from nn.cpu_mlp import (
    ACTIVATION,
    BIAS,
    BLOCK,
    FROM_INPUT,
    GRAD,
    HAS_BIAS,
    IN_PAD,
    INPUT_OF_ACTIVATION,
    N_CHUNKS,
    N_IN,
    N_OUT,
    OUT_PAD,
    OUTPUT,
    PRECISIONS,
    WT,
    Network,
    W,
    add_chunks,
    infer,
    make_train_kernel,
    n_blocks,
    pack,
)
from nn.mlp import MLP, pad
from nn.workers import Buffers, Workers


class CpuNetwork:
    """A network on the CPU device: its tables, and its passes over a batch.

    Args:
        mlp: The network.
        offset: Of its first parameter among all.
        stride: Of the rows of encoded features, a multiple of 16; columns beyond `mlp.n_in` are not read.
        device: The CPU device.
        precision: Of the operands of products: ``fp32``, or ``fp16`` and ``bf16``, which are float32 rounded to it.
    """

    def __init__(self, mlp: MLP, offset: int, stride: int, device, precision: str):
        self.mlp, self.device, self.precision = mlp, device, PRECISIONS.index(precision)
        table, offsets = [], []
        packed = gradient = scratch = widest = 0
        for layer in mlp.layers:
            in_pad, out_pad = pad(layer.n_in) if table else stride, pad(layer.n_out)
            row = {N_IN: layer.n_in, IN_PAD: in_pad, N_OUT: layer.n_out, OUT_PAD: out_pad}
            row[WT] = packed
            row[W] = packed + layer.n_in * out_pad
            row[BIAS] = row[W] + layer.n_out * in_pad
            packed = row[BIAS] + out_pad
            row[GRAD] = gradient
            gradient += out_pad * in_pad + out_pad
            row[ACTIVATION] = activations.CODES[layer.activation]
            row[OUTPUT] = scratch
            scratch += BLOCK * out_pad
            row[FROM_INPUT] = int(layer.activation in activations.FROM_INPUT)
            row[INPUT_OF_ACTIVATION] = scratch
            scratch += BLOCK * out_pad * row[FROM_INPUT]
            row[HAS_BIAS] = int(layer.bias >= 0)
            widest = max(widest, in_pad, out_pad)
            table.append([row[key] for key in range(13)])
            offsets.append([offset + layer.weight, offset + layer.bias])
        self.outputs = (len(mlp.layers), max(layer.n_out for layer in mlp.layers))
        self.table = wp.array(np.array(table, np.int32), dtype=wp.int32, device=device)
        self.offsets = wp.array(np.array(offsets, np.int32), dtype=wp.int32, device=device)
        self.packed_size, self.gradient_size = packed, gradient
        self.gradient, self.gradient_stride = scratch, BLOCK * widest
        self.scratch_size = scratch + 2 * BLOCK * widest

    def load(self, loss) -> None:
        """Builds the kernels of inference, and of training with `loss`."""
        wp.force_load(device=self.device, modules=[infer.module, make_train_kernel(loss).module])

    def pack(self, parameters: wp.array) -> Network:
        """The network with these parameters (a copy of them)."""
        net = Network()
        net.table, net.precision = self.table, self.precision
        net.packed = wp.zeros(self.packed_size, dtype=wp.float32, device=self.device)
        net.scratch_size, net.gradient_size = self.scratch_size, self.gradient_size
        net.gradient, net.gradient_stride = self.gradient, self.gradient_stride
        wp.launch(pack, dim=self.outputs, inputs=[parameters, self.offsets, net], device=self.device)
        return net

    def lend_scratch(self, workers: Workers, buffers: Buffers):
        """Room for the activations of one block for each worker."""
        return buffers.lend(("scratch", id(self)), self.scratch_size * workers.threads)

    def infer(self, net: Network, encoded: wp.array, row: int, end: int, worker: int, scratch: wp.array, y: wp.array):
        """Outputs of rows ``row … end`` into `y`; `row` is the first of a block."""
        inputs = [encoded, row, end, net, worker, scratch]
        wp.launch(infer, dim=n_blocks(end - row), inputs=inputs, outputs=[y], device=self.device)

    def differentiate(
        self, net, encoded, n, loss, target, y, encode, scale, want_input, gradients, dL_dencoded, workers, buffers
    ) -> wp.array:
        """Forward pass, loss and backward pass over a batch of at least one row; adds to `gradients`.

        In half precision gradients inside the network are not divided by the size of the batch, which would make them
        vanish: their sums are.

        Args:
            net: From `pack`.
            encoded: Features, flat.
            loss: As of `make_train_kernel`.
            target: Of the loss, or dL/dy without a loss.
            y: Where to write outputs; of no rows if they are not wanted.
            encode: ``encode(row, end, worker)`` computes features of these rows first; None: they are there.
            scale: Factor of all gradients, an array of one number.
            want_input: As of `backward_block`.
            gradients: Of all parameters.
            dL_dencoded: Gradients of the features, flat.
            workers: Threads.
            buffers: Lends scratch.

        Returns:
            Parts of the sum of the loss over rows and outputs.
        """
        kernel = make_train_kernel(loss)
        mean = 1.0 / (n * self.mlp.n_out) if loss is not None else 1.0
        inside, outside = (1.0, mean) if self.precision else (mean, 1.0)
        losses = wp.zeros(N_CHUNKS, dtype=wp.float64, device=self.device)
        size = N_CHUNKS * self.gradient_size
        with self.lend_scratch(workers, buffers) as scratch, buffers.lend(("chunks", id(self)), size) as chunks:

            def work(first, count, worker):
                row = n_blocks(n) * first // N_CHUNKS * BLOCK
                end = min(n_blocks(n) * (first + count) // N_CHUNKS * BLOCK, n)
                if encode is not None and end > row:
                    encode(row, end, worker)
                inputs = [encoded, n, first, N_CHUNKS, net, worker, scratch, target, scale, inside]
                wp.launch(
                    kernel,
                    dim=count,
                    inputs=[*inputs, outside, want_input],
                    outputs=[y, losses, chunks, dL_dencoded],
                    device=self.device,
                )

            workers.run(work, N_CHUNKS, 1 if n > 2048 else N_CHUNKS)
            inputs = [net, self.offsets, N_CHUNKS, outside]
            wp.launch(add_chunks, dim=self.outputs, inputs=inputs, outputs=[chunks, gradients], device=self.device)
            chunks.zero_()
        return losses
