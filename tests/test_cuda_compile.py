"""Every kernel compiles for CUDA, which needs a CUDA compiler (Warp brings one) but no GPU."""

from __future__ import annotations

import dataclasses

import pytest
import warp as wp

from tests.guides import histogram_kernels, lobe_kernels, resampling_kernel
from wavefront.bsdf.tables import KINDS
from wavefront.features import Features
from wavefront.film import FIRST_HIT
from wavefront.guided import make_guided_kernels
from wavefront.integrator import make_kernels
from wavefront.proposals import INPUTS
from wavefront.recording import FIELDS, make_gather
from wavefront.stages.inspect import make_inspect_bsdf, make_inspect_hit, make_inspect_light

CORNELL_BOX = Features(
    triangles=True,
    spheres=False,
    instances=(),
    accel="bvh",
    streams=False,
    ahead=False,
    smooth=False,
    uvs=False,
    tangents=False,
    maps=(),
    bsdfs=("diffuse",),
    mask=False,
    media=False,
    textures=(),
    lights=("triangle",),
    light_textures=(),
    nee=True,
    roulette=True,
    sampler="independent",
    camera="perspective",
    filter="box",
    aovs=(),
    variance=False,
)
EVERYTHING = Features(
    triangles=True,
    spheres=True,
    instances=("spheres", "triangles"),
    accel="bvh",
    streams=False,
    ahead=False,
    smooth=True,
    uvs=True,
    tangents=True,
    maps=("bump", "normal"),
    bsdfs=tuple(sorted(KINDS)),
    mask=True,
    media=True,
    textures=("bytes", "checkerboard", "floats", "halves", "shorts"),
    lights=("constant", "sphere", "triangle"),
    light_textures=("bytes", "checkerboard", "floats", "halves", "shorts"),
    nee=True,
    roulette=True,
    sampler="independent",
    camera="perspective",
    filter="gaussian",
    aovs=FIRST_HIT,
    variance=True,
)
CHANGES = [
    {},
    {"triangles": False, "lights": ("sphere",), "instances": ("spheres",)},
    {"spheres": False, "lights": ("triangle",), "instances": ("triangles",)},
    {"instances": ()},
    {"textures": (), "light_textures": (), "uvs": False, "lights": ("constant",)},
    {"lights": ("envmap_floats", "triangle")},
    {"lights": ("envmap_bytes",), "light_textures": ("halves",)},
    {"lights": ("envmap_halves",)},
    {"lights": ("constant", "directional", "point", "spot", "sun", "triangle")},
    {"lights": ("point",)},
    {"lights": ("sun",), "nee": False},
    {"nee": False, "filter": "tent", "mask": False, "tangents": False, "maps": (), "media": False},
    {"bsdfs": ("conductor",), "roulette": False, "filter": "box"},
    {"bsdfs": ("principled",)},
    {"bsdfs": ("dielectric",), "aovs": ("albedo",), "variance": False},
    {"camera": "thin_lens", "sampler": "sobol"},
    {"camera": "orthographic", "aovs": ("shape_index",)},
    {"camera": "spherical"},
]


def compile_for_cuda(features: Features, arch: int, folder) -> int:
    """Compiles all stages for `arch`, writes PTX or CUBIN to `folder`, and returns the number of modules."""
    return compile_modules(make_kernels(features).modules(), arch, folder)


def inspectors(f: Features) -> list:
    """Modules of the kernels of a traced path."""
    kernels = [
        make_inspect_hit(f.triangles, f.spheres, f.instances, f.accel),
        make_inspect_bsdf(f.bsdfs, f.mask, f.textures, f.uvs, f.tangents, f.maps),
    ]
    if f.light_sampling:
        kernels.append(make_inspect_light(f.lights, f.light_textures, f.sampler))
    return [kernel.module for kernel in kernels]


def compile_modules(modules: list, arch: int, folder) -> int:
    for module in modules:
        wp.compile_aot_module(module, arch=arch, module_dir=str(folder))
    return len(modules)


def built(folder) -> int:
    """Files of compiled code."""
    return len([path for path in folder.iterdir() if path.suffix in (".ptx", ".cubin")])


def test_one_feature_set_compiles_for_cuda(tmp_path):
    assert compile_for_cuda(CORNELL_BOX, 90, tmp_path) == built(tmp_path) == 9
    assert all(path.stat().st_size > 500 for path in tmp_path.iterdir() if path.suffix in (".ptx", ".cubin"))


def test_kernels_of_a_traced_path_compile_for_cuda(tmp_path):
    assert compile_modules(inspectors(CORNELL_BOX), 90, tmp_path) == built(tmp_path) == 3


def test_kernels_that_draw_sobol_points_compile_for_cuda(tmp_path):
    kernels = make_kernels(dataclasses.replace(CORNELL_BOX, sampler="sobol"))
    modules = [kernel.module for kernel in (kernels.generate, kernels.direct, kernels.scatter)]
    assert compile_modules(modules, 90, tmp_path) == built(tmp_path) == 3


def guided_modules(features: Features) -> list:
    """Modules of the stages that only guided bounces have, with all that records can hold and with none."""
    kernels = []
    for records in ((), tuple(FIELDS)):
        for guide_pdf in (True, False):
            inputs = tuple(INPUTS) if records else ()
            guided = dataclasses.replace(
                features, guide=("any",), guide_pdf=guide_pdf, guide_inputs=inputs, records=records
            )
            kernels += [*make_guided_kernels(guided).values(), make_kernels(guided).advance]
    kernels += make_gather(tuple(FIELDS))
    kernels.append(make_kernels(dataclasses.replace(guided, variance=True, weighted=True)).accumulate)
    return list(dict.fromkeys(kernel.module for kernel in kernels))


def test_kernels_of_a_guided_bounce_compile_for_cuda(tmp_path):
    """Those of guides too."""
    modules = guided_modules(CORNELL_BOX)
    kernels = [*histogram_kernels("independent"), *lobe_kernels("independent", True)]
    bsdf = CORNELL_BOX.bsdfs, CORNELL_BOX.mask, CORNELL_BOX.textures
    kernels.append(resampling_kernel(3, True, bsdf, False, False, False, "independent"))
    modules += [kernel.module for kernel in kernels]
    assert compile_modules(modules, 90, tmp_path) == built(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("arch", [80, 90])
def test_all_feature_sets_compile_for_cuda(tmp_path, arch):
    """Sets share most of their modules, and the largest take a minute: each module is compiled once."""
    modules = []
    for change in CHANGES:
        features = dataclasses.replace(EVERYTHING, **change)
        modules += make_kernels(features).modules() + inspectors(features)
    modules += guided_modules(EVERYTHING)
    modules = list(dict.fromkeys(modules))
    compile_modules(modules, arch, tmp_path)
    assert built(tmp_path) == len(modules)
