"""The kernels that are meant for both devices compile for CUDA, which needs no GPU."""

from __future__ import annotations

from typing import get_args

import pytest
import warp as wp

from nn import config, optimizers, tile_mlp
from nn.activations import CODES
from nn.encodings import kernels
from nn.encodings.grid import make_grid_kernels
from nn.losses import make_loss
from nn.tile_network import DTYPES, WIDTHS

SHARED = [
    kernels.identity_forward,
    optimizers.decide,
    tile_mlp.add_chunks,
    tile_mlp.make_pack_kernel(wp.float16),
    optimizers.make_step(True, True, 1),
    optimizers.make_step(False, False, 1),
]


def compile_for_cuda(kernel, arch, folder):
    wp.compile_aot_module(kernel.module, arch=arch, module_dir=str(folder))


def compile_network(kernel, shape, arch, folder, libraries=True):
    """`libraries`: products by tensor cores, each of which takes the compiler many seconds."""
    kernel.module.options["block_dim"] = shape.threads
    kernel.module.options["enable_mathdx_gemm"] = libraries
    compile_for_cuda(kernel, arch, folder)


def check(folder, count):
    built = [path for path in folder.iterdir() if path.suffix in (".ptx", ".cubin")]
    assert len(built) == count
    assert all(path.stat().st_size > 500 for path in built)


@pytest.mark.parametrize("arch", [pytest.param(80, marks=pytest.mark.slow), 90])
def test_encodings_and_optimisers_compile_for_cuda(tmp_path, arch):
    for kernel in [*SHARED, make_grid_kernels(3, 2, "Smoothstep", True)[0]]:
        compile_for_cuda(kernel, arch, tmp_path)
    check(tmp_path, len(SHARED) + 1)


def test_a_network_compiles_for_cuda(tmp_path):
    """Inference with tensor cores, which is one product of three; training with all, by the compiler alone."""
    shape = tile_mlp.Shape(wp.float16, 64, "ReLU", "None", False)
    compile_network(tile_mlp.make_infer_kernel(shape), shape, 90, tmp_path)
    train = tile_mlp.make_train_kernel(shape, make_loss("RelativeL2Luminance")).kernel
    compile_network(train, shape, 90, tmp_path, libraries=False)
    check(tmp_path, 2)


@pytest.mark.slow
@pytest.mark.parametrize("arch", [80, 90])
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("precision", DTYPES)
def test_all_networks_compile_for_cuda(tmp_path, precision, width, arch):
    """Within the shared memory of a multiprocessor."""
    shape = tile_mlp.Shape(DTYPES[precision], width, "SiLU", "Sigmoid", True)
    kernels = [tile_mlp.make_infer_kernel(shape), tile_mlp.make_train_kernel(shape, make_loss("L2")).kernel]
    for kernel in kernels:
        compile_network(kernel, shape, arch, tmp_path)
        assert kernel.adj.get_total_required_shared() <= 160 * 1024
    check(tmp_path, 2)


@pytest.mark.slow
@pytest.mark.parametrize("arch", [80, 90])
def test_all_losses_and_activations_compile_for_cuda(tmp_path, arch):
    shapes = [tile_mlp.Shape(wp.bfloat16, 16, name, name, False) for name in CODES]
    kernels = [(tile_mlp.make_train_kernel(shape, None).kernel, shape) for shape in shapes]
    kernels += [
        (tile_mlp.make_train_kernel(shapes[0], make_loss(loss.__struct_config__.tag)).kernel, shapes[0])
        for loss in get_args(config.Loss)
    ]
    for kernel, shape in kernels:
        compile_network(kernel, shape, arch, tmp_path, libraries=False)
    check(tmp_path, len(kernels))


@pytest.mark.slow
@pytest.mark.parametrize("arch", [80, 90])
@pytest.mark.parametrize("n_dims", [1, 2, 3, 4])
def test_all_grids_compile_for_cuda(tmp_path, n_dims, arch):
    for n_features in (1, 2, 4, 8):
        for interpolation in ("Linear", "Smoothstep", "Nearest"):
            for hashed in (False, True):
                compile_for_cuda(make_grid_kernels(n_dims, n_features, interpolation, hashed)[0], arch, tmp_path)
    check(tmp_path, 24)
