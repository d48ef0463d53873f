"""The kernels that are meant for both devices compile for CUDA, which needs no GPU."""

from __future__ import annotations

import pytest
import warp as wp

from nn import optimizers
from nn.encodings import kernels
from nn.encodings.grid import make_grid_kernels

SHARED = [
    kernels.identity_forward,
    optimizers.decide,
    optimizers.make_step(True, True, 1),
    optimizers.make_step(False, False, 1),
]


def compile_for_cuda(kernel, arch, folder):
    wp.compile_aot_module(kernel.module, arch=arch, module_dir=str(folder))


def test_encodings_and_optimisers_compile_for_cuda(tmp_path):
    for kernel in [*SHARED, make_grid_kernels(3, 2, "Smoothstep", True)[0]]:
        compile_for_cuda(kernel, 90, tmp_path)
    built = [path for path in tmp_path.iterdir() if path.suffix in (".ptx", ".cubin")]
    assert len(built) == len(SHARED) + 1
    assert all(path.stat().st_size > 500 for path in built)


@pytest.mark.slow
@pytest.mark.parametrize("arch", [80, 90])
@pytest.mark.parametrize("n_dims", [1, 2, 3, 4])
def test_all_grids_compile_for_cuda(tmp_path, n_dims, arch):
    for n_features in (1, 2, 4, 8):
        for interpolation in ("Linear", "Smoothstep", "Nearest"):
            for hashed in (False, True):
                compile_for_cuda(make_grid_kernels(n_dims, n_features, interpolation, hashed)[0], arch, tmp_path)
