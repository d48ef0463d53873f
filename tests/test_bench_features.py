"""The worst case that specialised kernels are compared with is the whole of it, and the figures are the compiler's."""

from __future__ import annotations

from pathlib import Path

import warp as wp

from tools.bench_features import cubin_resources
from tools.every_feature import with_every_feature
from wavefront.bsdf.tables import KINDS
from wavefront.integrator import make_features
from wavefront.scene import load_scene
from wavefront.scene.device import upload_scene

CORNELL_BOX = Path(__file__).parent.parent / "scenes" / "cornell-box.json"
LOCAL_FLOATS = 64


@wp.kernel(enable_backward=False, module="unique")
def plain(x: wp.array[float]):
    x[wp.tid()] = 1.0


@wp.kernel(enable_backward=False, module="unique")
def with_local_array(indices: wp.array[int], x: wp.array[float]):
    values = wp.zeros(shape=LOCAL_FLOATS, dtype=float)
    for i in range(indices.shape[0]):
        values[indices[i]] = float(i)
    x[wp.tid()] = values[indices[wp.tid()]]


def test_every_feature():
    scene = with_every_feature(load_scene(CORNELL_BOX))
    features = make_features(scene, upload_scene(scene, "cpu"))
    assert set(features.bsdfs) == set(KINDS)
    assert features.triangles and features.spheres and features.smooth and features.uvs and features.mask
    assert features.media and features.tangents and len(features.maps) == len(features.instances) == 2
    assert {"triangle", "sphere", "sun", "directional", "point", "spot"} <= set(features.lights)


def test_registers_and_stack(tmp_path):
    """The stack of a local array that is indexed at run time is at least the array."""
    found = []
    for kernel in (plain, with_local_array):
        (path,) = wp.compile_aot_module(kernel.module, arch=90, module_dir=str(tmp_path), use_ptx=False)
        found.append(cubin_resources(Path(path).read_bytes()))
    assert all(8 <= f["registers"] <= 255 for f in found)
    assert found[0]["stack"] < 4 * LOCAL_FLOATS <= found[1]["stack"]
