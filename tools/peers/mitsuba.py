"""Mitsuba 3 as a peer: loads its own XML or our records, and renders with its `path` integrator.

Mitsuba is imported when a function needs it. Its *variant* (scalar, LLVM, CUDA) is a state of the process: choose it
with `use_variant` before anything is loaded, and load scenes again after changing it.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tools.peers.mitsuba_records import NEVER, from_records
from wavefront.errors import WavefrontError
from wavefront.scene import description

__all__ = ["from_records", "load_records", "load_xml", "missing", "render", "require", "use_variant"]

PATHS_PER_PASS = 1 << 24  # the arrays of a wavefront stay within some GB
_chosen: dict[str, int | None] = {"threads": None}  # by `use_variant`


def require():
    """The module `mitsuba`.

    Raises:
        WavefrontError: It is not installed.
    """
    try:
        import mitsuba
    except ImportError as error:
        raise WavefrontError(f"Mitsuba is not installed ({error}); it comes with pip install '.[mitsuba]'") from None
    return mitsuba


def missing(variant: str) -> str | None:
    """Why a variant such as ``scalar_rgb`` or ``llvm_ad_rgb`` cannot be used here, or None where it can."""
    try:
        mi = require()
    except WavefrontError as error:
        return str(error)
    if variant not in mi.variants():
        return f"this build of Mitsuba has no variant {variant}; it has {', '.join(mi.variants())}"
    import drjit

    # Without a variant there is no array type to look the backend up by.
    if variant.startswith("llvm") and not drjit.has_backend(drjit.JitBackend.LLVM):
        return f"{variant} needs the LLVM shared library (Debian and Ubuntu: apt install libllvm19)"
    if variant.startswith("cuda") and not drjit.has_backend(drjit.JitBackend.CUDA):
        return f"{variant} needs an NVIDIA GPU and its driver"
    return None


def use_variant(name: str, threads: int | None = None):
    """Makes a variant the current one.

    Args:
        name: Such as ``scalar_rgb``.
        threads: How many threads render from now on, the calling one among them; None: as many as cores.

    Returns:
        The module `mitsuba`.

    Raises:
        WavefrontError: The variant cannot be used, with the reason.
    """
    reason = missing(name)
    if reason is not None:
        raise WavefrontError(reason)
    mi = require()
    mi.set_variant(name)
    mi.set_log_level(mi.LogLevel.Error)
    import drjit

    _chosen["threads"] = drjit.thread_count() if threads is None else threads
    drjit.set_thread_count(max(drjit.thread_count(), 2))  # see `_rendering_threads`
    return mi


@contextlib.contextmanager
def _rendering_threads(threads: int | None):
    """Limits the threads of Mitsuba to these, and to those of `use_variant` for None, for as long as it renders.

    Never for longer: with one thread, Mitsuba 3.9 waits forever when it reads an OpenEXR file.
    """
    import drjit

    before = drjit.thread_count()
    drjit.set_thread_count(threads or _chosen["threads"] or before)
    try:
        yield
    finally:
        drjit.set_thread_count(max(before, 2))


# --- scenes ------------------------------------------------------------------------------------------------------


def load_xml(path: str | Path, width: int, height: int, parameters: Mapping[str, object] | None = None):
    """Loads a Mitsuba XML scene of any dialect, with a film of ours: this size, float32, box filter.

    Nothing is written; the edit is made in Mitsuba's parsed form of the file. The integrator of the file is replaced by
    `path`, for `render` brings its own and the plugin may not exist here.

    Args:
        path: The file.
        width: Of the film, pixels.
        height: Of the film, pixels.
        parameters: Values for ``$name`` in the file.

    Returns:
        A `mitsuba.Scene` of the current variant.

    Raises:
        WavefrontError: The file is missing, or Mitsuba does not take it.
    """
    mi = _current()
    from mitsuba import parser

    path = Path(path)
    if not path.is_file():
        raise WavefrontError(f"{path}: file not found")
    config = parser.ParserConfig(mi.variant())
    # Files in the wild have both; neither changes the image.
    config.unused_parameters = config.unused_properties = mi.LogLevel.Debug
    config.parallel = False  # the order of emitters, and so the image of a seed, must not vary
    given = {name: str(value) for name, value in (parameters or {}).items()}
    previous = mi.file_resolver()
    resolver = mi.FileResolver(previous)
    resolver.prepend(str(path.resolve().parent))  # where the file's meshes and textures are
    mi.set_file_resolver(resolver)
    try:
        state = parser.parse_file(config, str(path.resolve()), **given)
        parser.transform_all(config, state)
        _replace_film(mi, parser, state, path, width, height)
        return parser.instantiate(config, state)
    except RuntimeError as error:
        raise WavefrontError(f"{path}: Mitsuba: {' '.join(str(error).split())}") from None
    finally:
        mi.set_file_resolver(previous)


def _replace_film(mi, parser, state, path, width, height):
    """Gives the first sensor a new film, and makes every integrator `path`."""
    # Appending moves the list in memory, and a reference to a node does not survive that: append first.
    rfilter = _append(parser, state, mi.ObjectType.ReconstructionFilter, mi.Properties("box"))
    properties = mi.Properties("hdrfilm")
    properties["width"], properties["height"] = width, height
    properties["pixel_format"], properties["component_format"] = "rgb", "float32"
    properties["rfilter"] = mi.Properties.ResolvedReference(rfilter)
    film = _append(parser, state, mi.ObjectType.Film, properties)
    kinds = [state.nodes[i].type for i in range(len(state.nodes))]
    if mi.ObjectType.Sensor not in kinds:
        raise WavefrontError(f"{path}: the scene has no sensor")
    for i, kind in enumerate(kinds):
        if kind == mi.ObjectType.Integrator:
            integrator = state.nodes[i].props
            for key in list(integrator.keys()):
                del integrator[key]
            integrator.set_plugin_name("path")
    sensor = state.nodes[kinds.index(mi.ObjectType.Sensor)].props
    for key in list(sensor.keys()):
        child = sensor[key]
        if isinstance(child, mi.Properties.ResolvedReference) and kinds[child.index()] == mi.ObjectType.Film:
            del sensor[key]
    sensor["film"] = mi.Properties.ResolvedReference(film)


def _append(parser, state, kind, properties):
    node = parser.SceneNode()
    node.type, node.props = kind, properties
    state.nodes.append(node)
    return len(state.nodes) - 1


def load_records(scene: description.Scene):
    """Loads our records into Mitsuba, by way of `from_records` and temporary mesh files.

    Returns:
        A `mitsuba.Scene` of the current variant, with the film and the filter of the records.

    Raises:
        WavefrontError: The records say what Mitsuba cannot, or Mitsuba does not take the scene.
    """
    mi = _current()
    with tempfile.TemporaryDirectory(prefix="wavefront-peer-") as folder:
        try:
            return mi.load_dict(from_records(scene, folder), parallel=False)  # as in load_xml
        except RuntimeError as error:
            raise WavefrontError(f"Mitsuba: {' '.join(str(error).split())}") from None


# --- rendering ---------------------------------------------------------------------------------------------------


def render(
    scene,
    spp: int,
    seed: int = 0,
    max_depth: int = 16,
    rr_depth: int | None = None,
    threads: int | None = None,
    sensor: int = 0,
    integrator: str = "path",
) -> np.ndarray:
    """Renders with Mitsuba: next-event estimation, independent sampler.

    Args:
        scene: From `load_xml` or `load_records`.
        spp: Samples per pixel.
        seed: 0 to 2^20 - 1; images of different seeds are independent.
        max_depth: Longest path in segments, as ours counts.
        rr_depth: Depth from which Russian roulette may end a path; None: never.
        threads: As in `use_variant`.
        sensor: Index of the sensor.
        integrator: ``path``, which ignores media, or ``volpath``.

    Returns:
        Mean radiance, [height, width, 3] float64. Mitsuba itself adds samples up in float32.

    Raises:
        WavefrontError: `spp`, `seed` or a depth is out of range.
    """
    mi = _current()
    if spp < 1 or not 0 <= seed < 1 << 20:
        raise WavefrontError(f"spp {spp}, seed {seed}; allowed: spp of 1 or more, seeds from 0 to {(1 << 20) - 1}")
    if max_depth < 1 or (rr_depth is not None and rr_depth < 1):
        raise WavefrontError(f"max_depth {max_depth}, rr_depth {rr_depth}; allowed: 1 or more")
    rr_depth = NEVER if rr_depth is None else rr_depth
    plugin = mi.load_dict({"type": integrator, "max_depth": max_depth, "rr_depth": rr_depth})
    camera = scene.sensors()[sensor]
    pixels = int(np.prod(np.array(camera.film().crop_size())))
    largest = max(1, PATHS_PER_PASS // pixels)
    passes = -(-spp // largest)
    if passes > 1 << 12:
        raise WavefrontError(f"{spp} samples of {pixels} pixels are more than this peer renders")
    total, done = 0.0, 0
    with _rendering_threads(threads):
        for i in range(passes):
            samples = (spp * (i + 1)) // passes - done
            image = mi.render(scene, sensor=camera, integrator=plugin, spp=samples, seed=(seed << 12) + i)
            total = total + samples * np.array(image, np.float64)[..., :3]
            done += samples
    return total / spp


def _current():
    mi = require()
    if mi.variant() is None:
        raise WavefrontError("no variant of Mitsuba is chosen; call use_variant first")
    return mi
