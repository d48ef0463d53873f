"""Speed and accuracy of the networks, against PyTorch with the same architecture in the same run.

    python -m tools.bench_nn [--sizes 14 16] [--threads N] [--rounds 5] [--json FILE]

Three tasks: ``npm``, the network of Neural Parametric Mixtures (dense grid, spherical harmonics and one-blob into
3 × 64, 32 outputs); ``mlp``, its network alone; ``image``, the hash grid and network of `tools.fit_image`. Training is
a whole step: forward, mean square error, backward, Adam over all parameters, and the moving average. Rounds of both
engines take turns; the median counts. First calls, which compile, are not timed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time

import numpy as np
from rich.console import Console
from rich.table import Table

import nn
from nn import config
from nn.workers import available_cores
from tools.bench_common import machine, megabytes, peak_memory_bytes, spread

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


def timed(call) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def gemm_rate(torch, size: int = 1536, rounds: int = 5) -> float:
    """Floating-point operations per second of a large float32 matrix product in PyTorch (BLAS)."""
    a, b = torch.rand(size, size), torch.rand(size, size)
    torch.mm(a, b)
    return 2.0 * size**3 / min(timed(lambda: torch.mm(a, b)) for _ in range(rounds))


def relative_error(values: np.ndarray, reference: np.ndarray) -> float:
    """Largest difference over the largest reference."""
    return float(np.abs(values - reference).max() / np.abs(reference).max())


class Bench:
    """One task at one batch size, in both engines.

    Args:
        task: A key of `TASKS`.
        n: Samples in a batch.
        threads: Of both engines.
        compiled: Compare with `torch.compile` too.
    """

    def __init__(self, task: str, n: int, threads: int, compiled: bool):
        import torch

        from tools.bench_nn_torch import Network, Trainer

        description, n_in, n_out = TASKS[task]
        self.n, cfg = n, config.load(description)
        self.model = nn.Model.from_config(cfg, n_in, n_out, threads=threads)
        values = self.model.parameters.numpy()
        values[self.model.n_matrix_params :] *= 1e4  # features of a trained size, for the accuracy
        rng = np.random.default_rng(0)
        self.x, self.target = rng.random((n, n_in), np.float32), rng.random((n, n_out), np.float32)
        self.calls = {
            "ours": (lambda: self.model.train_step(self.x, self.target), lambda: self.model.inference(self.x))
        }
        x, target = torch.from_numpy(self.x), torch.from_numpy(self.target)
        some = slice(0, 4096)
        exact = Network(cfg, n_in, n_out).double()
        exact.load(values, self.model.n_matrix_params)
        with torch.inference_mode():
            reference = exact(x[some].double()).numpy()
        self.error = {"ours": relative_error(self.model.inference(self.x[some], averaged=False), reference)}
        for engine, compile_it in (("eager", False), ("compile", True))[: 2 if compiled else 1]:
            network = Network(cfg, n_in, n_out)
            network.load(values, self.model.n_matrix_params)
            trainer = Trainer(network, cfg, compile_it)
            self.error[engine] = relative_error(trainer.infer(x[some]).numpy(), reference)
            self.calls[engine] = (
                lambda trainer=trainer: trainer.train(x, target),
                lambda trainer=trainer: trainer.infer(x),
            )

    def run(self, rounds: int) -> dict:
        """Seconds of training steps and inferences of every engine, and what follows from them."""
        seconds = {engine: {"training": [], "inference": []} for engine in self.calls}
        for engine_calls in self.calls.values():
            for call in engine_calls:
                call()
        for _ in range(rounds):
            for engine, (train, infer) in self.calls.items():
                seconds[engine]["training"].append(timed(train))
                seconds[engine]["inference"].append(timed(infer))
        flops = self.model.networks[0].flops_per_sample()
        work = {"training": 3 * flops, "inference": flops}
        results = {}
        for mode, operations in work.items():
            results[mode] = {}
            for engine in self.calls:
                figure = spread(seconds[engine][mode])
                results[mode][engine] = {
                    "seconds": figure,
                    "samples_per_second": self.n / figure["median"],
                    "network_flops": self.n * operations / figure["median"],
                    "relative_error": self.error[engine],
                }
        return results


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.bench_nn", description=__doc__.partition("\n")[0])
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument(
        "--sizes", nargs="+", type=int, default=[14, 16, 18], metavar="N", help="batches of 2^N samples"
    )
    parser.add_argument("--threads", type=int, default=available_cores(), help="of both engines")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--compile", action="store_true", help="also torch.compile, which needs a C++ compiler")
    parser.add_argument("--json", metavar="FILE", help="write all figures")
    options = parser.parse_args(arguments)
    console = Console()

    # The memory of our side alone, before PyTorch is loaded.
    task, largest = options.tasks[0], max(options.sizes)
    description, n_in, n_out = TASKS[task]
    model = nn.Model.from_config(description, n_in, n_out, threads=options.threads)
    model.train_step(np.zeros((1 << largest, n_in), np.float32), np.zeros((1 << largest, n_out), np.float32))
    memory = peak_memory_bytes()
    del model
    try:
        import torch
    except ImportError:
        print("error: PyTorch is not installed; allowed: pip install 'wavefront[bench]'", file=sys.stderr)
        return 2
    torch.set_num_threads(options.threads)

    report = {
        "machine": machine(),
        "threads": options.threads,
        "gemm_flops": gemm_rate(torch),
        "peak_memory_of_training_bytes": {"task": task, "batch": 1 << largest, "bytes": memory},
        "results": [],
    }
    table = Table(title=f"{options.threads} threads, float32; GEMM {report['gemm_flops'] / 1e9:.0f} GFLOP/s")
    for heading in ("task", "batch", "mode", "engine", "M samples/s", "ours / it", "GFLOP/s", "of GEMM", "error"):
        table.add_column(heading, justify="left" if heading in ("task", "mode", "engine") else "right")
    for task in options.tasks:
        for size in options.sizes:
            results = Bench(task, 1 << size, options.threads, options.compile).run(options.rounds)
            report["results"].append({"task": task, "batch": 1 << size, **results})
            for mode, engines in results.items():
                for engine, figure in engines.items():
                    ratio = engines["ours"]["samples_per_second"] / figure["samples_per_second"]
                    table.add_row(
                        task, f"2^{size}", mode, engine,
                        f"{figure['samples_per_second'] / 1e6:.3f}", "" if engine == "ours" else f"{ratio:.2f}",
                        f"{figure['network_flops'] / 1e9:.1f}", f"{figure['network_flops'] / report['gemm_flops']:.2f}",
                        f"{figure['relative_error']:.1e}",
                    )  # fmt: skip
    console.print(table)
    console.print(
        f"load {report['machine']['load']}; peak memory of the process after a training step of {options.tasks[0]} "
        f"with 2^{largest} samples, before PyTorch is loaded: {megabytes(memory)}"
    )
    if options.json:
        with open(options.json, "w", encoding="utf-8") as stream:
            json.dump(report, stream, indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
