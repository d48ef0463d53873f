"""Gradients of the composed model against PyTorch's automatic differentiation, and the bindings."""

from __future__ import annotations

import importlib
import json
import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from nn_models import make  # noqa: E402
from test_nn_values import inputs  # noqa: E402

import nn  # noqa: E402
from nn import torch_bindings  # noqa: E402
from nn.arrays import as_input  # noqa: E402
from tools import bench_nn  # noqa: E402
from tools.bench_nn import TASKS, Bench  # noqa: E402
from tools.bench_nn_torch import Network  # noqa: E402


@pytest.mark.parametrize("task", list(TASKS))
def test_values_and_gradients_of_the_benchmark_against_torch(task):
    """Our model and the peer of the benchmark are one function, with one gradient (in float64 there)."""
    description, n_in, n_out = TASKS[task]
    model = nn.Model.from_config(description, n_in, n_out, threads=2)
    values = model.parameters.numpy()
    values[model.n_matrix_params :] *= 1e4
    peer = Network(model.config, n_in, n_out).double()
    peer.load(values, model.n_matrix_params)
    x, target = inputs(1000, n_in, low=0, high=1), inputs(1000, n_out)
    y = peer(torch.from_numpy(x).double())
    loss = torch.nn.functional.mse_loss(y, torch.from_numpy(target).double())
    loss.backward()
    ours = np.empty((1000, n_out), np.float32)
    assert model.compute_gradients(x, target, outputs=ours) == pytest.approx(loss.item(), rel=1e-6)
    np.testing.assert_allclose(ours, y.detach().numpy(), atol=2e-6 * float(y.detach().abs().max()))
    gradients = model.gradients.numpy()
    for tensors, at in ((peer.mlp.parameters(), 0), (peer.grids.parameters(), -(-model.n_matrix_params // 8) * 8)):
        for tensor in tensors:
            found = gradients[at : at + tensor.numel()].reshape(tensor.shape)
            expected = tensor.grad.numpy()
            np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())
            at += tensor.numel()


def test_module_trains_with_an_optimiser_of_torch():
    description, n_in, n_out = TASKS["image"]
    model = nn.Model.from_config(description, n_in, n_out)
    model.parameters.numpy()[model.n_matrix_params :] *= 1e4
    module = torch_bindings.Module(model)
    assert [name for name, _ in module.named_parameters()] == ["parameters_flat"]
    # The slope of linear interpolation jumps from cell to cell: no sample so close to a border that float32 and float64
    # could disagree on its cell.
    samples = inputs(800, 2, low=0, high=1)
    p = samples[:, None, :].astype(np.float64) * np.array(model.encoding.parts[0].layout.scales)[:, None] + 0.5
    samples = samples[(np.abs(p - np.rint(p)) > 4e-7 * p).all(axis=(1, 2))]
    assert len(samples) > 600
    x = torch.from_numpy(samples).requires_grad_()
    target = torch.from_numpy(inputs(len(samples), 3))
    loss = torch.nn.functional.mse_loss(module(x), target)
    loss.backward()
    first = loss.item()

    peer = Network(model.config, n_in, n_out).double()
    peer.load(model.parameters.numpy(), model.n_matrix_params)
    exact = x.detach().double().requires_grad_()
    torch.nn.functional.mse_loss(peer(exact), target.double()).backward()
    np.testing.assert_allclose(x.grad.numpy(), exact.grad.numpy(), atol=1e-4 * float(exact.grad.abs().max()))
    assert (model.gradients.numpy() == 0).all()

    optimizer = torch.optim.Adam(module.parameters(), 1e-2)
    for _ in range(20):
        optimizer.zero_grad()
        loss = torch.nn.functional.mse_loss(module(x), target)
        loss.backward()
        optimizer.step()
    assert loss.item() < 0.8 * first
    np.testing.assert_array_equal(model.inference(x.detach().numpy()), module(x).detach().numpy())


def test_tensors_are_shared_not_copied():
    """Results are of the kind of the inputs, in the memory that was given."""
    model = make(n_in=3, n_out=4)
    x, target = torch.rand(64, 3), torch.rand(64, 4)
    out = torch.empty(64, 4)
    expected = model.inference(x.numpy())
    assert model.inference(x, out=out) is out
    assert as_input(x, 3, "x", model.device).ptr == x.data_ptr()
    assert torch_bindings.Module(model).parameters_flat.data_ptr() == model.parameters.ptr
    np.testing.assert_array_equal(out.numpy(), expected)
    y = model.inference(x.clone().requires_grad_())
    assert isinstance(y, torch.Tensor) and not y.requires_grad
    np.testing.assert_array_equal(y.numpy(), expected)
    np.testing.assert_array_equal(model.inference(x.t().contiguous().t()).numpy(), expected)
    latent = model.encode(0, x)
    index = torch.arange(63, -1, -1)
    for one in (index, index.int()):
        np.testing.assert_array_equal(model.inference(x, latents={0: (latent, one)}).numpy(), expected[::-1])
    assert model.train_step(x, target) == make(n_in=3, n_out=4).train_step(x.numpy(), target.numpy())
    model.forward(x)
    assert isinstance(model.backward(target, input_gradient=True), torch.Tensor)
    with pytest.raises(nn.NnError, match=r"x: found torch\.float64; allowed: a NumPy or Warp array, or a tensor"):
        model.inference(x.double())


def test_benchmark_runs():
    errors = {}
    for precision in ("fp32", "fp16"):
        bench = Bench("image", 512, precision, "cpu", 1, compiled=False)
        results = bench.run(1)
        errors[precision] = bench.error["ours"]
        assert results["training"]["ours"]["samples_per_second"] > 0
    assert errors["fp32"] < 1e-5 < errors["fp16"] < 1e-2


def test_benchmark_command(tmp_path, capsys):
    file = tmp_path / "figures.json"
    arguments = ["--tasks", "image", "--sizes", "6", "--rounds", "1", "--threads", "1", "--no-compile"]
    assert bench_nn.main([*arguments, "--json", str(file)]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [line[:5] for line in lines if line[:1] == ["image"]] == [
        ["image", mode, "fp32", engine, "2^6"] for mode in ("training", "inference") for engine in ("ours", "eager")
    ]
    (result,) = json.loads(file.read_text())["results"]
    figure = result["inference"]["ours"]
    assert figure["samples_per_second"] == pytest.approx(64 / figure["seconds"]["median"])
    assert [path.name for path in tmp_path.iterdir()] == ["figures.json"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--rounds", "0"], "--rounds 0; allowed: 1 or more"),
        (["--sizes", "14", "40"], "--sizes 40; allowed: 0 to 26, for batches of 2^N samples"),
        (["--json", "absent/file.json"], "--json absent/file.json: there is no such folder"),
    ],
)
def test_errors_of_the_benchmark_are_one_line(arguments, words, capsys):
    assert bench_nn.main(arguments) == 2
    assert capsys.readouterr().err == f"error: {words}\n"


def test_without_torch_its_extra_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "nn.torch_bindings")
    words = "PyTorch is not installed; it comes with pip install '.[bench]'"
    assert bench_nn.main([]) == 2
    assert capsys.readouterr().err == f"error: {words}\n"
    with pytest.raises(ImportError) as caught:
        importlib.import_module("nn.torch_bindings")
    assert str(caught.value) == words
