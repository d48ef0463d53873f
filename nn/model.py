"""A model: an encoding and the networks that read it, its gradients and its optimiser.

All parameters are one flat float32 array, and so are all gradients: networks in order (`nn.mlp`), then the parts of the
encoding in order. Gradients add up from call to call until `optimizer_step` uses and clears them.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import warp as wp

from nn import config as c
from nn import optimizers
from nn.cpu_mlp import BLOCK, CpuNetwork, infer, make_train_kernel
from nn.cpu_mlp import add_chunks as add_chunks_kernel
from nn.encodings import Encoding
from nn.encodings.kernels import count_nonfinite_rows, gather_columns
from nn.errors import ConfigError, NnError
from nn.losses import make_loss
from nn.mlp import MLP
from nn.workers import Buffers, Workers, available_cores

N_CHUNKS = 16  # of a batch, whose weight gradients are summed in order: the same sums for any number of threads
_ALIGNMENT = 8  # of a grid's first parameter, in floats

Array = np.ndarray | wp.array


class Model:
    """See `Model.from_config`.

    Attributes:
        config: The configuration, complete with defaults.
        parameters: All parameters, a Warp array; writing to it is allowed between calls.
        gradients: All gradients times the loss scale, a Warp array; may be replaced by averages over machines.
        n_matrix_params: How many parameters, from the first, belong to networks.
    """

    def __init__(self, cfg: c.ModelConfig, n_input_dims: int, n_output_dims: Sequence[int], device, seed: int, threads: int):
        self.config, self.device = cfg, device
        self.n_input_dims, self.n_output_dims = n_input_dims, list(n_output_dims)
        if cfg.precision != "fp32":
            raise ConfigError("precision", f'found "{cfg.precision}"; allowed on the CPU device: "fp32"')
        self.encoding = Encoding(cfg.encoding, n_input_dims, device)
        records = cfg.network if isinstance(cfg.network, list) else [cfg.network]
        self.networks, self._executions, offset = [], [], 0
        for i, (record, n_out) in enumerate(zip(records, self.n_output_dims, strict=True)):
            path = f"network[{i}]" if isinstance(cfg.network, list) else "network"
            n_features = self.encoding.n_features
            if record.n_parts is not None:
                if record.n_parts > len(self.encoding.parts):
                    raise ConfigError(
                        f"{path}.n_parts", f"found {record.n_parts}; the encoding has {len(self.encoding.parts)} parts"
                    )
                n_features = sum(part.n_features for part in self.encoding.parts[: record.n_parts])
            network = MLP(record, n_features, n_out)
            self.networks.append(network)
            self._executions.append(CpuNetwork(network, offset, self.encoding.stride, device))
            offset += network.n_params
        if cfg.loss.__struct_config__.tag == "RelativeL2Luminance" and any(n % 3 for n in self.n_output_dims):
            raise ConfigError("loss.otype", "RelativeL2Luminance needs RGB: n_output_dims a multiple of 3")
        self.n_matrix_params = offset
        start = -(-offset // _ALIGNMENT) * _ALIGNMENT
        self.encoding.place(start)
        self.n_params = start + self.encoding.n_params

        values = np.zeros(self.n_params, np.float32)
        rng = np.random.default_rng(seed)
        first = 0
        for network in self.networks:
            network.initialize(rng, values[first : first + network.n_params])
            first += network.n_params
        self.encoding.initialize(rng, values[start:])
        self.parameters = wp.array(values, dtype=wp.float32, device=device)
        self.gradients = wp.zeros(self.n_params, dtype=wp.float32, device=device)
        clipping = cfg.gradient_clipping.global_norm if cfg.gradient_clipping else 0.0
        self.optimizer = optimizers.Optimizer(cfg.optimizer, self.n_params, offset, cfg.loss_scale, clipping, device)
        if self.optimizer.ema:
            wp.copy(self.optimizer.averages, self.parameters)
        self._workers = Workers(threads)
        self._buffers = Buffers(device)
        self._nonfinite = wp.zeros(threads, dtype=wp.int32, device=device)
        self._kept = None
        self._load_modules(make_loss(cfg.loss.__struct_config__.tag))

    def _load_modules(self, loss):
        """Builds all kernels before threads could race for them."""
        kernels = [infer, count_nonfinite_rows, optimizers.decide, self.optimizer.kernel, make_train_kernel(loss)]
        kernels += [kernel for part in self.encoding.parts for kernel in part.kernels()]
        wp.force_load(device=self.device, modules=list({kernel.module.name: kernel.module for kernel in kernels}.values()))

    @classmethod
    def from_config(
        cls,
        cfg: Mapping | str | os.PathLike | c.ModelConfig,
        n_input_dims: int,
        n_output_dims: int | Sequence[int],
        device: str | None = "cpu",
        seed: int = 0,
        threads: int | None = None,
    ) -> Model:
        """Builds a model.

        Args:
            cfg: Configuration (`nn.config`), as an object or the path of a JSON file.
            n_input_dims: Columns of the input.
            n_output_dims: Columns of the output; for a list of networks, one number each.
            device: A Warp device.
            seed: Of the first parameters.
            threads: On the CPU device; None: as many as there are cores. Results do not depend on it.

        Raises:
            ConfigError: With the path in the configuration, what was found, and what is allowed.
        """
        cfg = c.load(cfg)
        device = wp.get_device(device)
        if not device.is_cpu:
            raise NnError(f"device {device}: networks run on the CPU device only so far")
        several = isinstance(cfg.network, list)
        dims = list(n_output_dims) if isinstance(n_output_dims, Sequence) else [n_output_dims]
        if several and len(dims) != len(cfg.network):
            raise ConfigError("network", f"found {len(cfg.network)} networks and {len(dims)} numbers of output dimensions")
        if (not several and len(dims) != 1) or any(not isinstance(n, (int, np.integer)) or n < 1 for n in dims):
            raise NnError(f"n_output_dims: found {n_output_dims}; allowed: a positive number for each network")
        if not isinstance(n_input_dims, (int, np.integer)) or n_input_dims < 1:
            raise NnError(f"n_input_dims: found {n_input_dims}; allowed: a positive number")
        threads = available_cores() if threads is None else max(int(threads), 1)
        return cls(cfg, int(n_input_dims), [int(n) for n in dims], device, seed, threads)

    # Inference ------------------------------------------------------------------------------------------------------

    @property
    def inference_parameters(self) -> wp.array:
        """What `inference` uses: the moving average if the optimiser keeps one."""
        return self.optimizer.averages if self.optimizer.ema else self.parameters

    def inference(
        self,
        x: Array,
        out: Array | None = None,
        network: int = 0,
        latents: Mapping[int, tuple[Array, Array]] | None = None,
        averaged: bool = True,
    ) -> Array:
        """Evaluates a network; several threads may do so at once.

        Args:
            x: Inputs, float32, ``[n, n_input_dims]``, NumPy or Warp. Contiguous arrays are not copied.
            out: Where to write; None: a new array of the kind of `x`.
            network: Which, if there are several.
            latents: Per index of a part, a result of `encode` and an int32 array of `n` row numbers of it: the part is
                copied from there instead of being encoded from its columns of `x`, which are ignored.
            averaged: Use the moving average of the parameters, if there is one.

        Returns:
            Outputs ``[n, n_output_dims]``.
        """
        parameters = self.inference_parameters if averaged else self.parameters
        rows = self._input(x, self.n_input_dims, "x")
        y, given = self._output(out, rows.shape[0], self.n_output_dims[network], x)
        latents = {self._part_index(part): self._latent(part, *pair, rows.shape[0]) for part, pair in (latents or {}).items()}
        execution = self._executions[network]
        net = execution.pack(parameters)
        n_parts = self.networks[network].cfg.n_parts or len(self.encoding.parts)
        with self._lend_encoded(rows.shape[0]) as (encoded, flat), self._lend_scratch(network) as scratch:

            def work(first, n, worker):
                row, end = first * BLOCK, min((first + n) * BLOCK, rows.shape[0])
                self._encode(rows, row, end, worker, parameters, encoded, latents, n_parts)
                inputs = [flat, row, end, net, worker, scratch]
                wp.launch(infer, dim=n, inputs=inputs, outputs=[y], device=self.device)

            self._workers.run(work, self._n_blocks(rows.shape[0]), 16)
        return given

    def encode(self, part: int, x: Array, averaged: bool = True) -> Array:
        """Features of one part of the encoding, for `inference(latents=…)`.

        Args:
            part: Its index.
            x: Its own dimensions only, ``[n, n_dims_to_encode]``.
            averaged: Use the moving average of the parameters, if there is one.

        Returns:
            ``[n, features of the part]``, of the kind of `x`.
        """
        piece = self.encoding.parts[self._part_index(part)]
        rows = self._input(x, piece.n_dims, "x")
        latent, given = self._output(None, rows.shape[0], piece.n_features, x)
        parameters = self.inference_parameters if averaged else self.parameters

        def work(first, n, worker):
            row, end = first * BLOCK, min((first + n) * BLOCK, rows.shape[0])
            piece.forward(rows, row, end - row, 0, parameters, latent, 0)

        self._workers.run(work, self._n_blocks(rows.shape[0]), 16)
        return given

    # Training -------------------------------------------------------------------------------------------------------

    def forward(self, x: Array, network: int = 0) -> Array:
        """Evaluates a network with the parameters that are being trained, and remembers `x` for `backward`."""
        rows = self._input(x, self.n_input_dims, "x")
        y, given = self._output(None, rows.shape[0], self.n_output_dims[network], x)
        self._release()
        encoded, flat = self._take_encoded(rows.shape[0])
        net = self._executions[network].pack(self.parameters)
        with self._lend_scratch(network) as scratch:

            def work(first, n, worker):
                row, end = first * BLOCK, min((first + n) * BLOCK, rows.shape[0])
                self._encode(rows, row, end, worker, self.parameters, encoded)
                inputs = [flat, row, end, net, worker, scratch]
                wp.launch(infer, dim=n, inputs=inputs, outputs=[y], device=self.device)

            self._workers.run(work, self._n_blocks(rows.shape[0]), 16)
        self._kept = (rows, encoded, flat, net, network)
        return given

    def backward(self, dL_dy: Array, input_gradient: bool = False) -> Array | None:
        """Adds to `gradients` from the gradient of a loss with respect to the outputs of the last `forward`.

        The activations of the hidden layers are computed again from the encoded features that `forward` kept. `dL_dy` is
        multiplied by the loss scale here.

        Args:
            dL_dy: ``[n, n_output_dims]``.
            input_gradient: Also return dL/dx, ``[n, n_input_dims]`` (without the loss scale only if that is 1).
        """
        if self._kept is None:
            raise NnError("backward: there was no forward before it")
        rows, encoded, flat, net, network = self._kept
        target = self._input(dL_dy, self.n_output_dims[network], "dL_dy")
        self._check_rows(target, rows)
        wp.load_module(make_train_kernel(None).module, device=self.device)
        empty = wp.empty((0, 0), dtype=wp.float32, device=self.device)
        _, dL_dx = self._differentiate(rows, encoded, flat, {network: net}, None, {network: (target, empty)}, input_gradient)
        return None if dL_dx is None else self._like(dL_dx, dL_dy)

    def compute_gradients(
        self, x: Array, target: Array | Sequence[Array], loss=None, outputs: Array | Sequence[Array] | None = None
    ) -> float:
        """Forward pass, loss and backward pass in one; adds to `gradients`.

        Args:
            x: Inputs ``[n, n_input_dims]``.
            target: ``[n, n_output_dims]``, or one for each network.
            loss: A loss of one's own (see `nn.losses`); None: the one of the configuration.
            outputs: Where to write the outputs, if they are wanted.

        Returns:
            The loss: the mean over samples and outputs, summed over networks. A custom loss is normalised in the same way.
        """
        if loss is None:
            loss = make_loss(self.config.loss.__struct_config__.tag)
        wp.load_module(make_train_kernel(loss).module, device=self.device)
        rows = self._input(x, self.n_input_dims, "x")
        n = rows.shape[0]
        several = isinstance(self.config.network, list)
        targets = list(target) if several else [target]
        written = (list(outputs) if several else [outputs]) if outputs is not None else [None] * len(self.networks)
        jobs = {}
        for i, (one, y) in enumerate(zip(targets, written, strict=True)):
            one = self._input(one, self.n_output_dims[i], "target")
            self._check_rows(one, rows)
            y = self._output(y, n, self.n_output_dims[i], x)[0] if y is not None else None
            jobs[i] = (one, wp.empty((0, 0), dtype=wp.float32, device=self.device) if y is None else y)
        nets = {i: execution.pack(self.parameters) for i, execution in enumerate(self._executions)}
        with self._lend_encoded(n) as (encoded, flat):
            return self._differentiate(rows, encoded, flat, nets, loss, jobs, False, encode=True)[0]

    def train_step(
        self,
        x: Array,
        target: Array | Sequence[Array] | None = None,
        *,
        dL_dy: Array | None = None,
        loss=None,
    ) -> float | None:
        """`compute_gradients` and `optimizer_step`.

        Args:
            x: Inputs.
            target: Of the loss.
            dL_dy: Instead of `target`: the gradient of the caller's own loss with respect to the outputs.
            loss: As in `compute_gradients`.

        Returns:
            The loss before the step; None with `dL_dy`.
        """
        if (target is None) == (dL_dy is None):
            raise NnError("train_step: found both or neither of target and dL_dy; allowed: one of them")
        if dL_dy is None:
            value = self.compute_gradients(x, target, loss)
        else:
            value = None
            rows = self._input(x, self.n_input_dims, "x")
            given = self._input(dL_dy, self.n_output_dims[0], "dL_dy")
            self._check_rows(given, rows)
            wp.load_module(make_train_kernel(None).module, device=self.device)
            empty = wp.empty((0, 0), dtype=wp.float32, device=self.device)
            nets = {0: self._executions[0].pack(self.parameters)}
            with self._lend_encoded(rows.shape[0]) as (encoded, flat):
                self._differentiate(rows, encoded, flat, nets, None, {0: (given, empty)}, False, encode=True)
        self.optimizer_step()
        return value

    def optimizer_step(self) -> None:
        """Updates the parameters from `gradients` and clears them; skips the batch if one of them is not finite."""
        self.optimizer.step(self.parameters, self.gradients, self._workers.run)

    def zero_gradients(self) -> None:
        """Forgets the gradients."""
        self.gradients.zero_()

    def _differentiate(self, rows, encoded, flat, nets, loss, jobs, input_gradient, encode=False):
        """Adds all gradients; returns the loss and dL/dx or None."""
        n = rows.shape[0]
        want_features = input_gradient or self.encoding.n_params > 0
        kernel = make_train_kernel(loss)
        dL_dencoded, dL_dflat = self._take_encoded(n if want_features else 0, "dL_dencoded")
        value = 0.0
        last = list(nets)[-1]
        for order, (i, net) in enumerate(nets.items()):
            target, y = jobs[i]
            execution = self._executions[i]
            losses = wp.zeros(N_CHUNKS, dtype=wp.float64, device=self.device)
            want = (2 if order else 1) if want_features else 0
            size = N_CHUNKS * execution.gradient_size
            with self._lend_scratch(i) as scratch, self._buffers.lend(("weights", i), size) as weights:

                def work(first, count, worker, net=net, target=target, y=y, losses=losses, want=want, order=order,
                         scratch=scratch, weights=weights):  # fmt: skip
                    blocks = self._n_blocks(n)
                    row = blocks * first // N_CHUNKS * BLOCK
                    end = min(blocks * (first + count) // N_CHUNKS * BLOCK, n)
                    if encode and order == 0 and end > row:
                        self._encode(rows, row, end, worker, self.parameters, encoded)
                    inputs = [flat, n, first, N_CHUNKS, net, worker, scratch, target, self.optimizer.loss_scale, want]
                    wp.launch(
                        kernel, dim=count, inputs=inputs, outputs=[y, losses, weights, dL_dflat], device=self.device
                    )

                self._workers.run(work, N_CHUNKS if n else 0, 1 if n > 2048 else N_CHUNKS)
                for layer, shape in enumerate(self.networks[i].layers if n else []):
                    inputs = [net, layer, execution.offsets, N_CHUNKS]
                    wp.launch(
                        add_chunks_kernel, dim=shape.n_out, inputs=inputs, outputs=[weights, self.gradients],
                        device=self.device,
                    )  # fmt: skip
                weights.zero_()
            if loss is not None and n:
                value += float(losses.numpy().sum()) / (n * self.n_output_dims[i])
        del last
        if n:
            for part in self.encoding.parts:
                if part.n_params:
                    part.backward_parameters(rows, n, dL_dencoded, self.gradients, self._workers)
        dL_dx = None
        if input_gradient:
            dL_dx = wp.zeros((n, self.n_input_dims), dtype=wp.float32, device=self.device)

            def work_inputs(first, count, worker):
                row, end = first * BLOCK, min((first + count) * BLOCK, n)
                for part in self.encoding.parts:
                    part.backward_inputs(rows, row, end - row, self.parameters, dL_dencoded, dL_dx)

            self._workers.run(work_inputs, self._n_blocks(n), 16)
        self._buffers.give("dL_dencoded", dL_dflat)
        return value, dL_dx

    # State ----------------------------------------------------------------------------------------------------------

    @property
    def statistics(self) -> dict:
        """Counters since the beginning: steps taken, batches skipped, inputs that were not finite; and the last norm."""
        state = self.optimizer.state.numpy()
        return {
            "steps": int(state[optimizers.STEP]),
            "skipped_batches": int(state[optimizers.SKIPPED]),
            "nonfinite_inputs": int(self._nonfinite.numpy().sum()),
            "loss_scale": float(state[optimizers.LOSS_SCALE]),
            "learning_rate": float(state[optimizers.LEARNING_RATE]),
            "gradient_norm": float(state[optimizers.NORM]),
        }

    def state_dict(self) -> dict[str, np.ndarray]:
        """Everything that continues the training to the last bit: parameters and the state of the optimiser."""
        arrays = {"parameters": self.parameters, **{f"optimizer.{k}": v for k, v in self.optimizer.arrays().items()}}
        return {name: np.array(array.numpy()) for name, array in arrays.items()}

    def load_state_dict(self, state: Mapping[str, np.ndarray]) -> None:
        """Restores what `state_dict` gave.

        Raises:
            NnError: Names or sizes do not fit this model, which is then unchanged.
        """
        arrays = {"parameters": self.parameters, **{f"optimizer.{k}": v for k, v in self.optimizer.arrays().items()}}
        for name, array in arrays.items():
            if name not in state:
                raise NnError(f"state: {name} is missing; found: {', '.join(sorted(state)) or 'nothing'}")
            if np.shape(state[name]) != array.shape:
                raise NnError(f"state: {name} has shape {np.shape(state[name])}; allowed: {array.shape}")
        for name, array in arrays.items():
            array.assign(np.asarray(state[name]))

    def save(self, file: str | os.PathLike) -> None:
        """Writes `state_dict` as an npz file, without pickle."""
        path = Path(file)
        partial = path.with_name(path.name + ".part")
        with open(partial, "wb") as stream:
            np.savez(stream, **self.state_dict())
        os.replace(partial, path)

    def load(self, file: str | os.PathLike) -> None:
        """Reads what `save` wrote.

        Raises:
            NnError: The file cannot be read or does not fit this model.
        """
        try:
            with np.load(file, allow_pickle=False) as arrays:
                state = {name: arrays[name] for name in arrays.files}
        except (OSError, ValueError) as error:
            raise NnError(f"{file}: {error}") from None
        self.load_state_dict(state)

    # Arrays ---------------------------------------------------------------------------------------------------------

    def _encode(self, rows, row, end, worker, parameters, encoded, latents=None, n_parts=None):
        inputs = [rows, row, self.n_input_dims]
        wp.launch(count_nonfinite_rows, dim=end - row, inputs=inputs, outputs=[self._nonfinite, worker], device=self.device)
        for i, part in enumerate(self.encoding.parts[:n_parts]):
            if latents and i in latents:
                source, index = latents[i]
                inputs = [source, index, row, part.n_features]
                wp.launch(gather_columns, dim=end - row, inputs=inputs, outputs=[encoded, part.column], device=self.device)
            else:
                part.forward(rows, row, end - row, part.first_dim, parameters, encoded, part.column)

    @staticmethod
    def _n_blocks(n):
        return -(-n // BLOCK)

    def _take_encoded(self, n, kind="encoded"):
        """Features of `n` rows, padded to whole blocks: as rows, and flat. Padding columns are zero."""
        size = self._n_blocks(n) * BLOCK * self.encoding.stride
        flat = self._buffers.take(kind, size)
        rows = flat.size // self.encoding.stride
        return flat[: rows * self.encoding.stride].reshape((rows, self.encoding.stride)) if rows else wp.empty(
            (0, self.encoding.stride), dtype=wp.float32, device=self.device
        ), flat  # fmt: skip

    def _lend_encoded(self, n):
        model = self

        class Lent:
            def __enter__(self):
                self.pair = model._take_encoded(n)
                return self.pair

            def __exit__(self, *_):
                model._buffers.give("encoded", self.pair[1])

        return Lent()

    def _lend_scratch(self, network):
        return self._buffers.lend(
            ("scratch", network), self._executions[network].scratch_size * self._workers.threads
        )

    def _release(self):
        if self._kept is not None:
            self._buffers.give("encoded", self._kept[2])
            self._kept = None

    def _part_index(self, part):
        if not isinstance(part, (int, np.integer)) or not 0 <= part < len(self.encoding.parts):
            raise NnError(f"part: found {part!r}; allowed: 0 to {len(self.encoding.parts) - 1}")
        return int(part)

    def _latent(self, part, latent, index, n):
        piece = self.encoding.parts[part]
        latent = self._input(latent, piece.n_features, f"latents[{part}]")
        index = index if isinstance(index, wp.array) else wp.array(np.ascontiguousarray(index, np.int32), device=self.device)
        if index.shape != (n,) or index.dtype != wp.int32:
            raise NnError(f"latents[{part}]: found an index of shape {index.shape}; allowed: {n} whole numbers")
        low, high = (index.numpy().min(), index.numpy().max()) if n else (0, -1)
        if n and (low < 0 or high >= latent.shape[0]):
            raise NnError(f"latents[{part}]: found indices from {low} to {high}; allowed: 0 to {latent.shape[0] - 1}")
        return latent, index

    def _input(self, array, width, name):
        """A contiguous float32 Warp array of `width` columns; shares memory where it can."""
        shape = tuple(getattr(array, "shape", ()))
        if len(shape) != 2 or shape[1] != width:
            raise NnError(f"{name}: found shape {shape}; allowed: [n, {width}]")
        if isinstance(array, wp.array):
            if array.dtype != wp.float32 or array.device != self.device:
                raise NnError(f"{name}: found {array.dtype.__name__} on {array.device}; allowed: float32 on {self.device}")
            return array if array.is_contiguous else wp.clone(array)
        if not isinstance(array, np.ndarray):
            raise NnError(f"{name}: found {type(array).__name__}; allowed: a NumPy or Warp array")
        if array.dtype.kind not in "fiu":
            raise NnError(f"{name}: found {array.dtype}; allowed: float32")
        array = np.ascontiguousarray(array, np.float32)
        if array.shape[0] == 0:
            return wp.empty((0, width), dtype=wp.float32, device=self.device)
        return wp.array(array, dtype=wp.float32, device=self.device, copy=False)

    def _output(self, out, n, width, like):
        """An array to write to, and what the caller gets for it."""
        if out is None:
            if isinstance(like, wp.array):
                array = wp.empty((n, width), dtype=wp.float32, device=self.device)
                return array, array
            out = np.empty((n, width), np.float32)
        if tuple(out.shape) != (n, width):
            raise NnError(f"out: found shape {tuple(out.shape)}; allowed: {(n, width)}")
        if isinstance(out, wp.array):
            if out.dtype != wp.float32 or not out.is_contiguous or out.device != self.device:
                raise NnError(f"out: allowed: a contiguous float32 array on {self.device}")
            return out, out
        if out.dtype != np.float32 or not out.flags.c_contiguous or not out.flags.writeable:
            raise NnError("out: allowed: a contiguous float32 array that can be written")
        if n == 0:
            return wp.empty((0, width), dtype=wp.float32, device=self.device), out
        return wp.array(out, dtype=wp.float32, device=self.device, copy=False), out

    @staticmethod
    def _like(array, example):
        return array if isinstance(example, wp.array) else array.numpy()

    @staticmethod
    def _check_rows(array, rows):
        if array.shape[0] != rows.shape[0]:
            raise NnError(f"found {array.shape[0]} rows of targets for {rows.shape[0]} rows of inputs")
