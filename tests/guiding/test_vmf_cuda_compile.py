"""The functions of a mixture compile for CUDA, which needs no GPU."""

import pytest
import warp as wp

from guiding.distributions.vmf_mixture import make_vmf_mixture
from tests.guiding.vmf_kernels import make_kernel


def compile_for_cuda(kernel, arch, folder):
    wp.compile_aot_module(kernel.module, arch=arch, module_dir=str(folder))
    built = [path for path in folder.iterdir() if path.suffix in (".ptx", ".cubin")]
    assert len(built) == 1
    assert built[0].stat().st_size > 500


def test_a_mixture_compiles_for_cuda(tmp_path):
    compile_for_cuda(make_kernel(2, "angles"), 90, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("arch", [80, 90])
@pytest.mark.parametrize("direction", ["angles", "vector"])
@pytest.mark.parametrize("n_lobes", [1, 8, 16, 32])
def test_mixtures_compile_for_cuda(tmp_path, n_lobes, direction, arch):
    compile_for_cuda(make_kernel(n_lobes, direction), arch, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("n_lobes", [1, 8])
def test_a_network_with_this_loss_compiles_for_cuda(tmp_path, n_lobes):
    from nn import tile_mlp

    shape = tile_mlp.Shape(wp.float32, 64, "ReLU", "None", False)
    train = tile_mlp.make_train_kernel(shape, make_vmf_mixture(n_lobes).kl_loss).kernel
    train.module.options["block_dim"] = shape.threads
    train.module.options["enable_mathdx_gemm"] = False
    compile_for_cuda(train, 90, tmp_path)
