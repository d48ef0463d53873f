"""Combines renders of one scene with different seeds: ``python -m tools.merge a.exr b.exr … -o out.exr``.

The result is the image of all their samples together: means are weighted by the number of samples, the variance of the
mean is that of the joint sample, sample counts add up, and indices of shapes and BSDFs are those of the first image.
Where a guide gave weights to samples, radiance is weighted by their sums, and the variance is that of such a mean.
Machines that share nothing but a folder render one image in this way, each with its own ``--seed``.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from wavefront.errors import WavefrontError
from wavefront.film import LUMINANCE
from wavefront.identity import explain_differences
from wavefront.output import check_writable
from wavefront.scene.images import replacing

BLOCK_VALUES = 1 << 22  # of one image that are in memory at once
VARIANCE = "variance.Y"
# Channels that are not means over samples, by their first name in lower case without underscores.
INDICES = frozenset(("shape", "bsdf", "shapeindex", "bsdfindex"))
COUNTS = frozenset(("samplecount",))


@dataclasses.dataclass
class Render:
    """An image, with what its header says of its making."""

    path: Path
    image: oiio.ImageInput
    samples: int
    weight: float | None  # sum over the samples of a pixel; None if they have no weights
    seeds: list[int]
    scene_hash: str
    settings: dict
    renderer: str

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(self.image.spec().channelnames)

    @property
    def window(self) -> tuple[int, ...]:
        s = self.image.spec()
        return s.x, s.y, s.width, s.height, s.full_x, s.full_y, s.full_width, s.full_height


def open_render(path: Path) -> Render:
    """Opens an image.

    Raises:
        WavefrontError: No such file, no OpenEXR image, or none that says how it was made.
    """
    if not path.is_file():
        raise WavefrontError(f"{path}: file not found")
    image = oiio.ImageInput.open(str(path))
    if image is None or image.format_name() != "openexr":
        reason = " ".join(oiio.geterror().split()) or "not an OpenEXR image"
        raise WavefrontError(f"{path}: cannot be read: {reason}")
    found = {a.name: a.value for a in image.spec().extra_attribs}
    try:
        samples, seeds = int(found["samplesPerPixel"]), [int(seed) for seed in found["seed"].split(",")]
        settings = json.loads(found["settings"])
        weight = float(found["sumOfWeights"]) if "sumOfWeights" in found else None
        render = Render(path, image, samples, weight, seeds, found["sceneHash"], settings, found["renderer"])
    except KeyError as error:
        raise WavefrontError(
            f"{path}: its header has no {error.args[0]!r}; allowed: images of wavefront.render"
        ) from None
    except (ValueError, AttributeError):
        raise WavefrontError(
            f"{path}: its header is damaged: samplesPerPixel, sumOfWeights, seed or settings"
        ) from None
    if samples < 1:
        raise WavefrontError(f"{path}: an image of {samples} samples per pixel; allowed: 1 or more")
    if weight is not None and not 0.0 < weight <= samples:
        raise WavefrontError(f"{path}: a sum of weights of {weight:g}; allowed: more than 0, up to one per sample")
    return render


def check_alike(renders: Sequence[Render]) -> None:
    """Refuses images that are not independent samples of one image.

    Raises:
        WavefrontError: Names the file, and what differs from the first, or which seed is there twice.
    """
    first = renders[0]
    taken: dict[int, Path] = {}
    for render in renders:
        if render.scene_hash != first.scene_hash:
            differs = explain_differences(render.settings, first.settings, str(first.path))
            raise WavefrontError(f"{render.path}: " + (differs or f"is of another scene than {first.path}"))
        if render.window != first.window:
            raise WavefrontError(f"{render.path}: has another size or window than {first.path}")
        if render.channels != first.channels:
            names = sorted(set(render.channels) ^ set(first.channels))
            raise WavefrontError(f"{render.path}: has other channels than {first.path}: {', '.join(names)}")
        for seed in render.seeds:
            if seed in taken:
                raise WavefrontError(
                    f"{render.path}: has seed {seed}, as {taken[seed]} has: the same samples twice; "
                    "allowed: a --seed for each render"
                )
            taken[seed] = render.path


def combine(
    blocks: Sequence[np.ndarray],
    samples: Sequence[int],
    channels: Sequence[str],
    weights: Sequence[float] | None = None,
) -> np.ndarray:
    """Pixels of the joint sample.

    Of n_i samples with mean m_i, the variance v_i of the mean gives the sum of squares about it, n_i (n_i - 1) v_i.
    About the joint mean m of N samples it is larger by n_i (m_i - m)^2, and the variance of m is the sum of all these
    over N (N - 1): the same as if the samples had been taken at once (Chan, Golub and LeVeque 1983).

    The squares of samples with weights cannot be had from v_i. Then the joint mean is sum(W_i m_i) / sum(W_i) with the
    sums of weights W_i, and its variance sum(W_i^2 v_i) / sum(W_i)^2, because images are independent of each other; it
    is not a number where one of them has a single sample.

    Args:
        blocks: Pixels of each image, shape [..., C], float32.
        samples: Of each image, per pixel.
        channels: C names.
        weights: Sums over the samples of a pixel, of each image; None if samples have no weights.

    Returns:
        Float32, shape [..., C].
    """
    total = sum(samples)
    mean = sum(n * block.astype(np.float64) for n, block in zip(samples, blocks, strict=True)) / total
    shares = None if weights is None else np.asarray(weights) / sum(weights)
    for c, name in enumerate(channels):
        kind = name.split(".")[0].replace("_", "").lower()
        if kind in INDICES:
            mean[..., c] = blocks[0][..., c]
        elif kind in COUNTS:
            mean[..., c] = sum(block[..., c].astype(np.float64) for block in blocks)
        elif shares is not None and name in ("R", "G", "B", VARIANCE):
            powers = shares**2 if name == VARIANCE else shares
            mean[..., c] = sum(p * block[..., c].astype(np.float64) for p, block in zip(powers, blocks, strict=True))
        elif name == VARIANCE:
            rgb = [channels.index(colour) for colour in "RGB"]
            y = mean[..., rgb] @ np.asarray(LUMINANCE)
            squares = 0.0
            for n, block in zip(samples, blocks, strict=True):
                if n > 1:  # the variance of one sample is not a number
                    squares += n * (n - 1.0) * block[..., c].astype(np.float64)
                squares += n * (block[..., rgb].astype(np.float64) @ np.asarray(LUMINANCE) - y) ** 2
            mean[..., c] = squares / (total * (total - 1.0))
    return mean.astype(np.float32)


def merge(paths: Sequence[str | os.PathLike], out: str | os.PathLike) -> int:
    """Writes the combination of images, some rows at a time; the file appears whole or not at all.

    Args:
        paths: Two or more images, which `wavefront.render` or this function wrote.
        out: An ``.exr`` file. Its header says how it was made, so that it can be combined further.

    Returns:
        Samples per pixel in all.

    Raises:
        WavefrontError: An image that cannot be read or does not fit the first, or an output that cannot be written.
    """
    out = Path(out)
    if len(paths) < 2:
        raise WavefrontError("one image; allowed: two or more")
    if out.suffix.lower() != ".exr":
        raise WavefrontError(f"{out}: the output is an OpenEXR file; allowed: a name that ends in .exr")
    if os.path.realpath(out) in map(os.path.realpath, paths):
        raise WavefrontError(f"{out}: would be overwritten, but is one of the images; choose another name with -o")
    check_writable(out)
    renders = [open_render(Path(path)) for path in paths]
    check_alike(renders)
    samples, channels = [render.samples for render in renders], renders[0].channels
    weights = None
    if any(render.weight is not None for render in renders):  # a sample without has 1
        weights = [render.samples if render.weight is None else render.weight for render in renders]
    spec = oiio.ImageSpec(renders[0].image.spec())
    spec.set_format(oiio.FLOAT)
    spec.attribute("samplesPerPixel", sum(samples))
    if weights is not None:
        spec.attribute("sumOfWeights", repr(float(sum(weights))))
    spec.attribute("seed", ",".join(str(seed) for render in renders for seed in render.seeds))
    spec.attribute("renderer", ", ".join(dict.fromkeys(render.renderer for render in renders)))
    rows = max(16, BLOCK_VALUES // (spec.width * len(channels)) // 16 * 16)  # whole chunks of the ZIP compression
    with replacing(out) as temporary:
        output = oiio.ImageOutput.create(str(temporary))
        done = output.open(str(temporary), spec)
        for y in range(spec.y, spec.y + spec.height, rows):
            end = min(y + rows, spec.y + spec.height)
            blocks = [_read_rows(render, y, end, len(channels)) for render in renders]
            done = done and output.write_scanlines(y, end, 0, combine(blocks, samples, channels, weights))
        if not (output.close() and done):
            raise OSError(" ".join(output.geterror().split()))
    return sum(samples)


def _read_rows(render: Render, begin: int, end: int, channels: int) -> np.ndarray:
    pixels = render.image.read_scanlines(0, 0, begin, end, 0, 0, channels, oiio.FLOAT)
    if pixels is None:
        raise WavefrontError(f"{render.path}: cannot be read: {' '.join(render.image.geterror().split())}")
    return pixels.reshape(end - begin, -1, channels)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code: 0, or 2 after an error, of which one line is printed."""
    parser = argparse.ArgumentParser(prog="python -m tools.merge", description=__doc__.split("\n\n")[0])
    parser.add_argument("images", nargs="+", metavar="IMAGE.exr", help="renders of one scene with different seeds")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.exr", help="the image to write")
    options = parser.parse_args(arguments)
    try:
        samples = merge(options.images, options.output)
    except WavefrontError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{options.output}: {samples} samples per pixel of {len(options.images)} images", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
