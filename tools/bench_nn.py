"""Speed and accuracy of the networks, against PyTorch with the same architecture in the same run.

    python -m tools.bench_nn [--device cuda] [--precision fp32 fp16 bf16] [--sizes 14 16] [--rounds 5] [--json FILE]

Three tasks: ``npm``, the network of Neural Parametric Mixtures (dense grid, spherical harmonics and one-blob into
3 × 64, 32 outputs); ``mlp``, its network alone; ``image``, the hash grid and network of `tools.fit_image`. Training is
a whole step: forward, mean square error, backward, Adam over all parameters, and the moving average. Rounds of all
engines take turns; the median counts. First calls, which compile, are timed apart. Engines of one row group have one
precision: half precision is autocast in PyTorch; on CUDA, PyTorch also runs float32 with TF32 products.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp
from rich import box
from rich.console import Console
from rich.table import Table

import nn
from nn import config
from nn.workers import available_cores
from tools.bench_common import machine, megabytes, peak_memory_bytes, spread
from wavefront.errors import WavefrontError

_ADAM = {"otype": "Adam", "learning_rate": 1e-2, "beta1": 0.9, "beta2": 0.99, "epsilon": 1e-15, "l2_reg": 0.0}
_MLP = {
    "otype": "FullyFusedMLP",
    "activation": "ReLU",
    "output_activation": "None",
    "n_neurons": 64,
    "n_hidden_layers": 3,
}
_AVERAGED = {"otype": "EMA", "decay": 0.95, "nested": _ADAM}
TASKS = {
    "npm": (
        {
            "encoding": {
                "otype": "Composite",
                "nested": [
                    {"otype": "DenseGrid", "n_dims_to_encode": 3, "n_levels": 8, "n_features_per_level": 4,
                     "base_resolution": 8, "per_level_scale": 1.405, "interpolation": "Smoothstep"},
                    {"otype": "SphericalHarmonics", "n_dims_to_encode": 3, "degree": 2},
                    {"otype": "OneBlob", "n_bins": 4},
                ],
            },
            "network": _MLP,
            "optimizer": _AVERAGED,
        },
        9,
        32,
    ),
    "mlp": ({"encoding": {"otype": "Identity"}, "network": _MLP, "optimizer": _AVERAGED}, 64, 32),
    "image": (
        {
            "encoding": {"otype": "HashGrid", "n_levels": 16, "n_features_per_level": 2, "log2_hashmap_size": 15,
                         "base_resolution": 16, "per_level_scale": 1.5},
            "network": {**_MLP, "n_hidden_layers": 2},
            "optimizer": _ADAM,
        },
        2,
        3,
    ),
}  # fmt: skip


def timed(call, synchronize) -> float:
    start = time.perf_counter()
    call()
    synchronize()
    return time.perf_counter() - start


def gemm_rate(torch, device: str, precision: str, rounds: int = 5) -> float:
    """Floating-point operations per second of a large matrix product in PyTorch."""
    size = 1536 if device == "cpu" else 8192
    dtype = {"fp16": torch.float16, "bf16": torch.bfloat16}.get(precision, torch.float32)
    torch.backends.cuda.matmul.allow_tf32 = False
    a, b = (torch.rand(size, size, device=device).to(dtype) for _ in range(2))
    synchronize = torch.cuda.synchronize if device != "cpu" else (lambda: None)
    torch.mm(a, b)
    synchronize()
    return 2.0 * size**3 / min(timed(lambda: torch.mm(a, b), synchronize) for _ in range(rounds))


def relative_error(values: np.ndarray, reference: np.ndarray) -> float:
    """Largest difference over the largest reference."""
    return float(np.abs(values - reference).max() / np.abs(reference).max())


class Bench:
    """One task at one batch size and precision, in all engines.

    Args:
        task: A key of `TASKS`.
        n: Samples in a batch.
        precision: ``fp32``, ``fp16`` or ``bf16``.
        device: ``cpu`` or a CUDA device.
        threads: Of all engines, on the CPU device.
        compiled: Compare with `torch.compile` too.
    """

    def __init__(self, task: str, n: int, precision: str, device: str, threads: int, compiled: bool):
        import torch

        from tools.bench_nn_torch import Network, Trainer

        description, n_in, n_out = TASKS[task]
        self.n, self.device, self.missing = n, device, {}
        cfg = config.load({**description, "precision": precision})
        self.model = nn.Model.from_config(cfg, n_in, n_out, device=device, threads=threads)
        values = self.model.parameters.numpy()
        values[self.model.n_matrix_params :] *= 1e4  # features of a trained size, for the accuracy
        self.model.parameters.assign(values)
        rng = np.random.default_rng(0)
        x, target = rng.random((n, n_in), np.float32), rng.random((n, n_out), np.float32)
        ours = [wp.array(a, dtype=wp.float32, device=device) for a in (x, target)]
        self.synchronize = (lambda: None) if device == "cpu" else (lambda: wp.synchronize_device(device))
        self.calls = {
            "ours": (lambda: self.model.train_step(*ours, report=False), lambda: self.model.inference(ours[0]))
        }
        exact = Network(cfg, n_in, n_out).double()
        exact.load(values, self.model.n_matrix_params)
        some = x[:4096]
        with torch.inference_mode():
            reference = exact(torch.from_numpy(some).double()).numpy()
        self.error = {"ours": relative_error(self.model.inference(some, averaged=False), reference)}
        theirs = [torch.from_numpy(a).to(device) for a in (x, target)]
        torch._dynamo.reset()  # what it compiled for other batches counts against a limit
        kinds = [("eager", False, precision)]
        if device != "cpu" and precision == "fp32":
            kinds.append(("eager, TF32", False, "tf32"))
        if compiled:
            kinds += [(name.replace("eager", "compile"), True, kind) for name, _, kind in kinds]
        for engine, compile_it, kind in kinds:
            network = Network(cfg, n_in, n_out)
            network.load(values, self.model.n_matrix_params)
            trainer = Trainer(network.to(device), cfg, compile_it, kind)
            try:
                first = trainer.infer(theirs[0])[:4096].cpu().numpy()
            except Exception as error:  # torch.compile needs a compiler, and says so in exceptions of many kinds
                self.missing[engine] = str(error).strip().splitlines()[0]
                continue
            self.error[engine] = relative_error(first, reference)
            self.calls[engine] = (
                lambda trainer=trainer: trainer.train(*theirs),
                lambda trainer=trainer: trainer.infer(theirs[0]),
            )

    def run(self, rounds: int) -> dict:
        """Seconds of training steps and inferences of every engine, and what follows from them."""
        modes = ("training", "inference")
        seconds = {engine: {mode: [] for mode in modes} for engine in self.calls}
        first, repeats = {}, {}
        for engine, calls in self.calls.items():
            for mode, call in zip(modes, calls, strict=True):
                first[engine, mode] = timed(call, self.synchronize)
                once = timed(call, self.synchronize)
                # a GPU works while the next launches are prepared, as in real use
                repeats[engine, mode] = 1 if self.device == "cpu" else max(1, min(200, int(0.05 / once)))
        for _ in range(rounds):
            for engine, calls in self.calls.items():
                for mode, call in zip(modes, calls, strict=True):
                    times = repeats[engine, mode]
                    whole = timed(lambda call=call, times=times: [call() for _ in range(times)], self.synchronize)
                    seconds[engine][mode].append(whole / times)
        flops = self.model.networks[0].flops_per_sample()
        work = {"training": 3 * flops, "inference": flops}
        results = {}
        for mode, operations in work.items():
            results[mode] = {}
            for engine in self.calls:
                figure = spread(seconds[engine][mode])
                results[mode][engine] = {
                    "seconds": figure,
                    "first_call_seconds": first[engine, mode],
                    "samples_per_second": self.n / figure["median"],
                    "network_flops": self.n * operations / figure["median"],
                    "relative_error": self.error[engine],
                }
        return results


def check(options: argparse.Namespace) -> None:
    """Refuses what cannot be measured, before anything is.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    for name in ("rounds", "threads"):
        if getattr(options, name) < 1:
            raise WavefrontError(f"--{name} {getattr(options, name)}; allowed: 1 or more")
    for size in options.sizes or ():
        if not 0 <= size <= 26:
            raise WavefrontError(f"--sizes {size}; allowed: 0 to 26, for batches of 2^N samples")
    if options.json and not options.json.resolve().parent.is_dir():
        raise WavefrontError(f"--json {options.json}: there is no such folder")
    if importlib.util.find_spec("torch") is None:
        raise WavefrontError("PyTorch is not installed; it comes with pip install '.[bench]'")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.bench_nn", description=__doc__.partition("\n")[0])
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--device", default="cpu", help="cpu (the default) or cuda")
    parser.add_argument("--precision", nargs="+", choices=["fp32", "fp16", "bf16"], help="default: fp32; on cuda, all")
    parser.add_argument(
        "--sizes", nargs="+", type=int, metavar="N", help="batches of 2^N samples; default: 14 16 18, on cuda 14 to 21"
    )
    parser.add_argument("--threads", type=int, default=available_cores(), help="of all engines, on the CPU device")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--no-compile", action="store_true", help="leave out torch.compile, which needs a C++ compiler")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures")
    options = parser.parse_args(arguments)
    console = Console(width=None if sys.stdout.isatty() else 120, highlight=False)
    try:
        check(options)
        device = wp.get_device(options.device)
    except (RuntimeError, ValueError) as error:
        print(f"error: --device {options.device}: {error}", file=sys.stderr)
        return 2
    except WavefrontError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    on_cpu = device.is_cpu
    options.sizes = options.sizes or ([14, 16, 18] if on_cpu else list(range(14, 22)))
    options.precision = options.precision or (["fp32"] if on_cpu else ["fp32", "fp16", "bf16"])

    # The memory of our side alone, before PyTorch is loaded.
    task, largest = options.tasks[0], max(options.sizes)
    description, n_in, n_out = TASKS[task]
    model = nn.Model.from_config(description, n_in, n_out, device=device, threads=options.threads)
    model.train_step(np.zeros((1 << largest, n_in), np.float32), np.zeros((1 << largest, n_out), np.float32))
    memory = peak_memory_bytes() if on_cpu else wp.get_mempool_used_mem_high(device)
    del model
    import torch

    torch.set_num_threads(options.threads)

    name = "cpu" if on_cpu else device.alias
    rates = {precision: gemm_rate(torch, name, precision) for precision in options.precision}
    report = {
        "machine": {**machine(), "device": device.name},
        "threads": options.threads if on_cpu else None,
        "gemm_flops": rates,
        "peak_memory_of_training_bytes": {"task": task, "batch": 1 << largest, "bytes": memory},
        "results": [],
        "missing": {},
    }
    shown = ", ".join(f"{precision} {rate / 1e9:.0f}" for precision, rate in rates.items())
    where = f"{options.threads} threads" if on_cpu else device.name
    table = Table(title=f"{where}; GEMM in GFLOP/s: {shown}", box=box.SIMPLE)
    for heading in ("task", "mode", "of", "engine"):
        table.add_column(heading)
    for heading in ("batch", "M samples/s", "ours / it", "GFLOP/s", "of GEMM", "error"):
        table.add_column(heading, justify="right")
    for task, size, precision in itertools.product(options.tasks, options.sizes, options.precision):
        bench = Bench(task, 1 << size, precision, name, options.threads, not options.no_compile)
        results = bench.run(options.rounds)
        report["results"].append({"task": task, "batch": 1 << size, "precision": precision, **results})
        report["missing"].update(bench.missing)
        for mode, engines in results.items():
            for engine, figure in engines.items():
                ratio = engines["ours"]["samples_per_second"] / figure["samples_per_second"]
                table.add_row(
                    task, mode, precision, engine, f"2^{size}",
                    f"{figure['samples_per_second'] / 1e6:.3f}", "" if engine == "ours" else f"{ratio:.2f}",
                    f"{figure['network_flops'] / 1e9:.1f}", f"{figure['network_flops'] / rates[precision]:.2f}",
                    f"{figure['relative_error']:.1e}",
                )  # fmt: skip
    console.print(table)
    console.print(
        f"load {report['machine']['load']}; peak memory {'of the process ' if on_cpu else ''}after a training step of "
        f"{options.tasks[0]} with 2^{largest} samples, before PyTorch is loaded: {megabytes(memory)}"
    )
    for engine, reason in report["missing"].items():
        console.print(f"{engine}: not measured: {reason}")
    if options.json:
        from tools.results import write_json  # here, for it would add to the memory that is measured

        try:
            write_json(options.json, report)
        except WavefrontError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
