"""Teaches a network an image: position in, colour out.

    python -m tools.fit_image IMAGE [-o FOLDER] [--steps 1000] [--config FILE] [--device cuda]

The hello-world of neural fields: a hash grid (Müller et al. 2022) and a small network, trained on colours at random
positions. Writes a PNG of what the network knows at growing intervals, and prints its PSNR.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

import nn
from wavefront.errors import WavefrontError
from wavefront.scene.images import replacing

CONFIG = {
    "encoding": {"otype": "HashGrid", "n_levels": 16, "n_features_per_level": 2, "log2_hashmap_size": 15,
                 "base_resolution": 16, "per_level_scale": 1.5},
    "network": {"otype": "FullyFusedMLP", "activation": "ReLU", "output_activation": "None", "n_neurons": 64,
                "n_hidden_layers": 2},
    "loss": {"otype": "RelativeL2"},
    "optimizer": {"otype": "Adam", "learning_rate": 1e-2, "beta1": 0.9, "beta2": 0.99, "epsilon": 1e-15,
                  "l2_reg": 1e-6},
}  # fmt: skip


def load_image(path: str | os.PathLike) -> np.ndarray:
    """Colours from 0 to 1, ``[height, width, 3]``.

    Raises:
        nn.NnError: The file is not there or not an image.
    """
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"), np.float32) / 255
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise nn.NnError(f"{path}: {getattr(error, 'strerror', None) or error}") from None


def bilinear(image: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Colours of `image` at positions in the unit square ``[n, 2]`` (x, y from the upper left corner)."""
    height, width = image.shape[:2]
    p = position * np.array([width, height], np.float32) - np.float32(0.5)
    corner = np.floor(p).astype(np.int64)
    tx, ty = (p - corner).T[:, :, None]
    x0, x1 = np.clip(corner[:, 0], 0, width - 1), np.clip(corner[:, 0] + 1, 0, width - 1)
    y0, y1 = np.clip(corner[:, 1], 0, height - 1), np.clip(corner[:, 1] + 1, 0, height - 1)
    upper = image[y0, x0] * (1 - tx) + image[y0, x1] * tx
    lower = image[y1, x0] * (1 - tx) + image[y1, x1] * tx
    return upper * (1 - ty) + lower * ty


def pixel_centres(height: int, width: int) -> np.ndarray:
    """Positions of all pixels, row by row."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return np.stack([(x.ravel() + 0.5) / width, (y.ravel() + 0.5) / height], 1).astype(np.float32)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB, of values from 0 to 1."""
    error = float(np.mean((np.clip(a, 0, 1).astype(np.float64) - b) ** 2))
    return math.inf if error == 0 else -10 * math.log10(error)


class Fit:
    """Training of a model on an image.

    Args:
        image: Colours ``[height, width, 3]``.
        config: Of the model.
        batch: Positions per step.
        seed: Of the parameters and the positions.
        device: Where the model is.
    """

    def __init__(
        self, image: np.ndarray, config: object = CONFIG, batch: int = 1 << 16, seed: int = 0, device: str = "cpu"
    ):
        self.image, self.batch = image, batch
        self.model = nn.Model.from_config(config, 2, 3, device=device, seed=seed)
        self.rng = np.random.default_rng(seed)
        self.centres = pixel_centres(*image.shape[:2])

    def step(self) -> float:
        """One step; returns the loss."""
        x = self.rng.random((self.batch, 2), np.float32)
        return self.model.train_step(x, bilinear(self.image, x).astype(np.float32))

    def picture(self) -> np.ndarray:
        """What the network knows of the image."""
        return self.model.inference(self.centres).reshape(self.image.shape)


def save(path: Path, image: np.ndarray) -> None:
    """Writes a PNG.

    Raises:
        WavefrontError: It cannot be written.
    """
    with replacing(path) as temporary:
        Image.fromarray((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)).save(temporary, format="PNG")


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit status."""
    parser = argparse.ArgumentParser(prog="python -m tools.fit_image", description=__doc__.partition("\n")[0])
    parser.add_argument("image", help="PNG or JPEG")
    parser.add_argument("-o", "--output", default="fit", metavar="FOLDER", help="of the PNG sequence (default: fit)")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--batch", type=int, default=1 << 16)
    parser.add_argument("--config", metavar="FILE", help="JSON configuration of the model")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu", help="of Warp: cpu (the default) or cuda")
    options = parser.parse_args(arguments)
    try:
        run(options)
    except (nn.NnError, WavefrontError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def run(options: argparse.Namespace) -> None:
    """Trains, and shows and writes what the network knows.

    Raises:
        nn.NnError: An option, the image or the configuration is not allowed.
        WavefrontError: A picture cannot be written.
    """
    for name in ("steps", "batch"):
        if getattr(options, name) < 1:
            raise nn.NnError(f"--{name}: found {getattr(options, name)}; allowed: a positive number")
    if options.seed < 0:
        raise nn.NnError(f"--seed: found {options.seed}; allowed: 0 or more")
    fit = Fit(load_image(options.image), options.config or CONFIG, options.batch, options.seed, options.device)
    folder = Path(options.output)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WavefrontError(f"{folder}: cannot be written: {error.strerror}") from None
    pictures = {2**k for k in range(options.steps.bit_length())} | {options.steps}
    columns = [
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total}"),
        TimeRemainingColumn(),
    ]
    seconds = 0.0
    with Progress(*columns, console=Console(highlight=False)) as progress:
        task = progress.add_task("training", total=options.steps)
        for step in range(1, options.steps + 1):
            start = time.perf_counter()
            loss = fit.step()
            seconds += time.perf_counter() - start
            if step in pictures:
                picture = fit.picture()
                save(folder / f"{step:06d}.png", picture)
                progress.console.print(
                    f"step {step:6d}  loss {loss:.3e}  PSNR {psnr(picture, fit.image):.2f} dB  {seconds:.2f} s"
                )
            progress.update(task, advance=1, description=f"loss {loss:.2e}")


if __name__ == "__main__":
    sys.exit(main())
