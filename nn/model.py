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
from nn.arrays import Array, as_index, as_input, as_kind_of, as_output, check_rows, empty
from nn.cpu_mlp import BLOCK, n_blocks
from nn.cpu_network import CpuNetwork
from nn.encodings import Encoding
from nn.encodings.kernels import count_nonfinite_rows, gather_columns
from nn.errors import ConfigError, NnError
from nn.losses import make_loss
from nn.mlp import MLP
from nn.tile_network import TileNetwork
from nn.workers import Buffers, Workers, available_cores

_ALIGNMENT = 8  # of a grid's first parameter, in floats


class Model:
    """See `Model.from_config`. Several threads may call `inference` and `encode` at once; training is for one thread,
    which spreads a batch over threads itself.

    Attributes:
        config: The configuration, complete with defaults.
        parameters: All parameters, a Warp array; writing to it is allowed between calls.
        gradients: All gradients times the loss scale, a Warp array; may be replaced by averages over machines.
        n_matrix_params: How many parameters, from the first, belong to networks.
    """

    def __init__(
        self,
        cfg: c.ModelConfig,
        n_input_dims: int,
        n_output_dims: Sequence[int],
        device,
        seed: int,
        threads: int,
        tiles: bool,
    ):
        self.config, self.device = cfg, device
        self.n_input_dims, self.n_output_dims = n_input_dims, list(n_output_dims)
        self.encoding = Encoding(cfg.encoding, n_input_dims, device, blocks=not tiles)
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
            execution = (
                TileNetwork(network, offset, self.encoding.stride, device, cfg.precision, path)
                if tiles
                else CpuNetwork(network, offset, self.encoding.stride, device, cfg.precision)
            )
            self._executions.append(execution)
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
        self.optimizer = optimizers.Optimizer(
            cfg.optimizer, self.n_params, offset, cfg.loss_scale, clipping, device, not tiles
        )
        if self.optimizer.ema:
            wp.copy(self.optimizer.averages, self.parameters)
        self._workers = Workers(threads)
        self._buffers = Buffers(device)
        self._nonfinite = wp.zeros(threads, dtype=wp.int32, device=device)
        self._kept = None
        self._load_modules(make_loss(cfg.loss.__struct_config__.tag))

    def _load_modules(self, loss):
        """Builds all kernels before threads could race for them."""
        for execution in self._executions:
            execution.load(loss)
        kernels = [count_nonfinite_rows, optimizers.decide, self.optimizer.kernel]
        kernels += [kernel for part in self.encoding.parts for kernel in part.kernels()]
        wp.force_load(
            device=self.device, modules=list({kernel.module.name: kernel.module for kernel in kernels}.values())
        )

    @classmethod
    def from_config(
        cls,
        cfg: Mapping | str | os.PathLike | c.ModelConfig,
        n_input_dims: int,
        n_output_dims: int | Sequence[int],
        device: str | None = "cpu",
        seed: int = 0,
        threads: int | None = None,
        execution: str | None = None,
    ) -> Model:
        """Builds a model.

        Args:
            cfg: Configuration (`nn.config`), as an object or the path of a JSON file.
            n_input_dims: Columns of the input.
            n_output_dims: Columns of the output; for a list of networks, one number each.
            device: A Warp device.
            seed: Of the first parameters.
            threads: On the CPU device; None: as many as there are cores. Results do not depend on it.
            execution: ``"blocks"`` (of samples, by threads of the CPU device; the default there) or ``"tiles"`` (in
                shared memory, by thread blocks; the default on CUDA, and on the CPU device a slow way to test it).

        Raises:
            ConfigError: With the path in the configuration, what was found, and what is allowed.
        """
        cfg = c.load(cfg)
        try:
            device = wp.get_device(device)
        except (RuntimeError, ValueError) as error:
            raise NnError(f"device: found {device!r}; {error}") from None
        allowed = ("blocks", "tiles") if device.is_cpu else ("tiles",)
        execution = allowed[0] if execution is None else execution
        if execution not in allowed:
            raise NnError(f"execution: found {execution!r}; allowed on {device}: {', '.join(allowed)}")
        several = isinstance(cfg.network, list)
        dims = list(n_output_dims) if isinstance(n_output_dims, Sequence) else [n_output_dims]
        if several and len(dims) != len(cfg.network):
            raise ConfigError(
                "network", f"found {len(cfg.network)} networks and {len(dims)} numbers of output dimensions"
            )
        if (not several and len(dims) != 1) or any(not isinstance(n, (int, np.integer)) or n < 1 for n in dims):
            raise NnError(f"n_output_dims: found {n_output_dims}; allowed: a positive number for each network")
        if not isinstance(n_input_dims, (int, np.integer)) or n_input_dims < 1:
            raise NnError(f"n_input_dims: found {n_input_dims}; allowed: a positive number")
        tiles = execution == "tiles"
        threads = 1 if tiles else available_cores() if threads is None else max(int(threads), 1)
        return cls(cfg, int(n_input_dims), [int(n) for n in dims], device, seed, threads, tiles)

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
        threads: int | None = None,
    ) -> Array:
        """Evaluates a network; several threads may do so at once.

        Args:
            x: Inputs, float32, ``[n, n_input_dims]``, of NumPy, Warp or PyTorch. Contiguous arrays are not copied.
            out: Where to write; None: a new array of the kind of `x`.
            network: Which, if there are several.
            latents: Per index of a part, a result of `encode` and an int32 array of `n` row numbers of it: the part is
                copied from there instead of being encoded from its columns of `x`, which are ignored.
            averaged: Use the moving average of the parameters, if there is one.
            threads: 1: in the calling thread alone, for callers that are many; None: as many as the model has.

        Returns:
            Outputs ``[n, n_output_dims]``.
        """
        parameters = self.inference_parameters if averaged else self.parameters
        rows = as_input(x, self.n_input_dims, "x", self.device)
        y, finish = as_output(out, rows.shape[0], self.n_output_dims[network], x, self.device)
        found = {}
        for part, (latent, index) in (latents or {}).items():
            piece, name = self.encoding.parts[self._part_index(part)], f"latents[{part}]"
            latent = as_input(latent, piece.n_features, name, self.device)
            found[part] = (latent, as_index(index, rows.shape[0], latent.shape[0], name, self.device))
        with self._lend_encoded(rows.shape[0]) as flat:
            self._evaluate(rows, flat, parameters, network, y, found, alone=threads == 1)
        return finish()

    def _evaluate(self, rows, flat, parameters, network, y, latents=None, alone=False):
        """Outputs of a network into `y`, and features into `flat`; returns the packed network."""
        execution, n, encoded = self._executions[network], rows.shape[0], self._as_rows(flat)
        net = execution.pack(parameters)
        n_parts = self.networks[network].cfg.n_parts if latents is not None else None
        with execution.lend_scratch(self._workers, self._buffers) as scratch:

            def work(first, count, worker):
                row, end = first * BLOCK, min((first + count) * BLOCK, n)
                self._encode(rows, row, end, worker, parameters, encoded, latents, n_parts)
                execution.infer(net, flat, row, end, worker, scratch, y)

            if alone:
                work(0, n_blocks(n), 0)
            else:
                self._workers.run(work, n_blocks(n), 16)
        return net

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
        rows = as_input(x, piece.n_dims, "x", self.device)
        latent, finish = as_output(None, rows.shape[0], piece.n_features, x, self.device)
        parameters = self.inference_parameters if averaged else self.parameters

        def work(first, n, worker):
            row, end = first * BLOCK, min((first + n) * BLOCK, rows.shape[0])
            piece.forward(rows, row, end - row, 0, parameters, latent, 0)

        self._workers.run(work, n_blocks(rows.shape[0]), 16)
        return finish()

    # Training -------------------------------------------------------------------------------------------------------

    def forward(self, x: Array, network: int = 0) -> Array:
        """Evaluates a network with the parameters that are being trained, and remembers `x` for `backward`."""
        rows = as_input(x, self.n_input_dims, "x", self.device)
        y, finish = as_output(None, rows.shape[0], self.n_output_dims[network], x, self.device)
        self._release()
        flat = self._buffers.take("encoded", self._encoded_size(rows.shape[0]))
        net = self._evaluate(rows, flat, self.parameters, network, y)
        self._kept = (rows, flat, net, network)
        return finish()

    def backward(self, dL_dy: Array, input_gradient: bool = False) -> Array | None:
        """Adds to `gradients` from the gradient of a loss with respect to the outputs of the last `forward`.

        The activations of the hidden layers are computed again from the encoded features that `forward` kept. `dL_dy`
        is multiplied by the loss scale here.

        Args:
            dL_dy: ``[n, n_output_dims]``.
            input_gradient: Also return dL/dx, ``[n, n_input_dims]`` (without the loss scale only if that is 1).
        """
        if self._kept is None:
            raise NnError("backward: there was no forward before it")
        rows, flat, net, network = self._kept
        target = as_input(dL_dy, self.n_output_dims[network], "dL_dy", self.device)
        check_rows(target, rows)
        self._executions[network].load(None)
        nothing = empty((0, 0), self.device)
        _, dL_dx = self._differentiate(rows, flat, {network: net}, None, {network: (target, nothing)}, input_gradient)
        return None if dL_dx is None else as_kind_of(dL_dy, dL_dx)

    def compute_gradients(
        self,
        x: Array,
        target: Array | Sequence[Array],
        loss=None,
        outputs: Array | Sequence[Array] | None = None,
        report: bool = True,
    ) -> float | None:
        """Forward pass, loss and backward pass in one; adds to `gradients`.

        Args:
            x: Inputs ``[n, n_input_dims]``.
            target: ``[n, n_output_dims]``, or one for each network. A loss of one's own takes any number of columns.
            loss: A loss of one's own (see `nn.losses`); None: the one of the configuration.
            outputs: Where to write the outputs, if they are wanted.
            report: False: do not read the loss back, which waits for a GPU.

        Returns:
            The loss: the mean over samples and outputs, summed over networks. A loss of one's own is normalised alike.
            None without `report`.
        """
        own = loss is not None
        if not own:
            loss = make_loss(self.config.loss.__struct_config__.tag)
        for execution in self._executions:
            execution.load(loss)
        rows = as_input(x, self.n_input_dims, "x", self.device)
        n = rows.shape[0]
        several = isinstance(self.config.network, list)
        targets = list(target) if several else [target]
        written = (list(outputs) if several else [outputs]) if outputs is not None else [None] * len(self.networks)
        jobs, finishes = {}, []
        for i, (one, out) in enumerate(zip(targets, written, strict=True)):
            one = as_input(one, None if own else self.n_output_dims[i], "target", self.device)
            check_rows(one, rows)
            y = empty((0, 0), self.device)
            if out is not None:
                y, finish = as_output(out, n, self.n_output_dims[i], x, self.device)
                finishes.append(finish)
            jobs[i] = (one, y)
        nets = {i: execution.pack(self.parameters) for i, execution in enumerate(self._executions)}
        with self._lend_encoded(n) as flat:
            losses, _ = self._differentiate(rows, flat, nets, loss, jobs, False, encode=True)
        for finish in finishes:
            finish()
        if not report:
            return None
        return sum(_sum(array) / (n * self.n_output_dims[i]) for i, array in losses.items())

    def train_step(
        self,
        x: Array,
        target: Array | Sequence[Array] | None = None,
        *,
        dL_dy: Array | None = None,
        loss=None,
        report: bool = True,
    ) -> float | None:
        """`compute_gradients` and `optimizer_step`.

        Args:
            x: Inputs.
            target: As in `compute_gradients`.
            dL_dy: Instead of `target`: the gradient of the caller's own loss with respect to the outputs.
            loss: As in `compute_gradients`.
            report: As in `compute_gradients`.

        Returns:
            The loss before the step; None with `dL_dy` or without `report`.
        """
        if (target is None) == (dL_dy is None):
            raise NnError("train_step: found both or neither of target and dL_dy; allowed: one of them")
        if dL_dy is None:
            value = self.compute_gradients(x, target, loss, report=report)
        else:
            value = None
            rows = as_input(x, self.n_input_dims, "x", self.device)
            given = as_input(dL_dy, self.n_output_dims[0], "dL_dy", self.device)
            check_rows(given, rows)
            self._executions[0].load(None)
            nothing = empty((0, 0), self.device)
            nets = {0: self._executions[0].pack(self.parameters)}
            with self._lend_encoded(rows.shape[0]) as flat:
                self._differentiate(rows, flat, nets, None, {0: (given, nothing)}, False, encode=True)
        self.optimizer_step()
        return value

    def optimizer_step(self) -> None:
        """Updates the parameters from `gradients` and clears them; skips the batch if one of them is not finite."""
        self.optimizer.step(self.parameters, self.gradients, self._workers.run)

    def zero_gradients(self) -> None:
        """Forgets the gradients."""
        self.gradients.zero_()

    def _differentiate(self, rows, flat, nets, loss, jobs, input_gradient, encode=False):
        """Adds all gradients; returns parts of the loss of each network, and dL/dx or None."""
        n, losses, dL_dx = rows.shape[0], {}, None
        want_features = input_gradient or self.encoding.n_params > 0

        def encode_rows(row, end, worker):
            self._encode(rows, row, end, worker, self.parameters, self._as_rows(flat))

        with self._buffers.lend("dL_dencoded", self._encoded_size(n) if want_features else 1) as dL_dflat:
            for order, (i, net) in enumerate(nets.items() if n else ()):
                target, y = jobs[i]
                losses[i] = self._executions[i].differentiate(
                    net, flat, n, loss, target, y, encode_rows if encode and order == 0 else None,
                    self.optimizer.loss_scale, (2 if order else 1) if want_features else 0, self.gradients, dL_dflat,
                    self._workers, self._buffers,
                )  # fmt: skip
            for part in self.encoding.parts if n else []:
                if part.n_params:
                    part.backward_parameters(rows, n, self._as_rows(dL_dflat), self.gradients, self._workers)
            if input_gradient:
                dL_dx = wp.zeros((n, self.n_input_dims), dtype=wp.float32, device=self.device)
                dL_dencoded = self._as_rows(dL_dflat)

                def work(first, count, worker):
                    row, end = first * BLOCK, min((first + count) * BLOCK, n)
                    for part in self.encoding.parts:
                        part.backward_inputs(rows, row, end - row, self.parameters, dL_dencoded, dL_dx)

                self._workers.run(work, n_blocks(n), 16)
        return losses, dL_dx

    # State ----------------------------------------------------------------------------------------------------------

    @property
    def statistics(self) -> dict:
        """Since the beginning: steps taken, batches skipped, rows of inputs that were not finite; and the last norm."""
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
        wp.launch(
            count_nonfinite_rows, dim=end - row, inputs=inputs, outputs=[self._nonfinite, worker], device=self.device
        )
        for i, part in enumerate(self.encoding.parts[:n_parts]):
            if latents and i in latents:
                source, index = latents[i]
                inputs = [source, index, row, part.n_features]
                wp.launch(
                    gather_columns, dim=end - row, inputs=inputs, outputs=[encoded, part.column], device=self.device
                )
            else:
                part.forward(rows, row, end - row, part.first_dim, parameters, encoded, part.column)

    def _encoded_size(self, n):
        """Floats of the features of `n` rows, in whole blocks."""
        return max(n_blocks(n), 1) * BLOCK * self.encoding.stride

    def _as_rows(self, flat):
        """Features as rows; the columns that pad them are zero."""
        return flat[: flat.size // self.encoding.stride * self.encoding.stride].reshape((-1, self.encoding.stride))

    def _lend_encoded(self, n):
        return self._buffers.lend("encoded", self._encoded_size(n))

    def _release(self):
        if self._kept is not None:
            self._buffers.give("encoded", self._kept[1])
            self._kept = None

    def _part_index(self, part):
        if not isinstance(part, (int, np.integer)) or not 0 <= part < len(self.encoding.parts):
            raise NnError(f"part: found {part!r}; allowed: 0 to {len(self.encoding.parts) - 1}")
        return int(part)


def _sum(array):
    """The sum of a float64 array; only the sum of one on a GPU is copied."""
    return float(array.numpy().sum() if array.device.is_cpu else wp.utils.array_sum(array.flatten()))
