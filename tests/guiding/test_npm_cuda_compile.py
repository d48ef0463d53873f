"""The kernels of neural parametric mixtures compile for CUDA, which needs no GPU."""

from __future__ import annotations

import pytest
import warp as wp

from guiding import npm_kernels
from guiding.distributions.vmf_mixture import make_vmf_mixture
from guiding.npm import NpmSettings
from nn import tile_mlp
from tests.guiding.test_vmf_cuda_compile import compile_for_cuda


def kernels_of(s: NpmSettings) -> list[wp.Kernel]:
    mixture = make_vmf_mixture(s.n_lobes, s.direction)
    return [
        *npm_kernels.make_kernels(s.product, s.cosine_aware, s.learned_share, "sobol", mixture),
        *npm_kernels.make_training(s.product, s.mis_aware, s.product_cosine, s.vertex_loss, s.whole_emission),
        npm_kernels.sum_brightness,
        *npm_kernels.make_query(s.product, s.cosine_aware, mixture),
    ]


def compile_all(settings: NpmSettings, arch: int, folder) -> None:
    modules = {kernel.module: kernel for kernel in kernels_of(settings)}
    for i, kernel in enumerate(modules.values()):
        (folder / str(i)).mkdir()
        compile_for_cuda(kernel, arch, folder / str(i))


ALL = {"direction": "vector", "product_cosine": True, "learned_share": True, "whole_emission": True}


def test_npm_compiles_for_cuda(tmp_path):
    compile_all(NpmSettings(product=True, n_lobes=2, **ALL), 90, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("arch", [80, 90])
@pytest.mark.parametrize("options", [{}, ALL, {"cosine_aware": False, "mis_aware": False}])
@pytest.mark.parametrize("product", [False, True])
@pytest.mark.parametrize("n_lobes", [8, 16])
def test_all_of_npm_compiles_for_cuda(tmp_path, n_lobes, product, options, arch):
    compile_all(NpmSettings(product=product, n_lobes=n_lobes, **options), arch, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("product_cosine", [False, True])
def test_a_network_with_the_loss_of_all_techniques_compiles_for_cuda(tmp_path, product_cosine):
    loss = npm_kernels.make_vertex_loss(make_vmf_mixture(8, "vector"), True, product_cosine, True, True, 0.5)
    shape = tile_mlp.Shape(wp.float32, 64, "ReLU", "None", False)
    train = tile_mlp.make_train_kernel(shape, loss).kernel
    train.module.options["block_dim"] = shape.threads
    train.module.options["enable_mathdx_gemm"] = False
    compile_for_cuda(train, 90, tmp_path)
