"""The image-fitting example, and with it the whole of the networks: how well an image is known after some steps."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from tools import fit_image


def test_quality_after_200_steps():
    """Rings and a checkerboard, 96 × 64: sharp edges and smooth slopes."""
    y, x = np.mgrid[:64, :96].astype(np.float32) / 64
    rings = 0.5 + 0.5 * np.sin(40 * ((x - 0.7) ** 2 + (y - 0.5) ** 2))
    checks = ((x * 8).astype(int) + (y * 8).astype(int)) % 2
    image = np.stack([rings, 0.8 * checks + 0.1, 0.5 * (x / 1.5 + y)], -1).astype(np.float32)
    fit = fit_image.Fit(image, batch=4096, seed=1)
    for _ in range(200):
        fit.step()
    assert fit_image.psnr(fit.picture(), image) > 29.5  # 30.4 dB when it was written


def test_bilinear_meets_the_pixels():
    image = np.random.default_rng(0).random((5, 7, 3)).astype(np.float32)
    np.testing.assert_allclose(
        fit_image.bilinear(image, fit_image.pixel_centres(5, 7)).reshape(image.shape), image, atol=1e-5
    )


def test_command(tmp_path, capsys):
    picture = tmp_path / "in.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (8, 12, 3)).astype(np.uint8)).save(picture)
    assert fit_image.main([str(picture), "-o", str(tmp_path / "out"), "--steps", "5", "--batch", "64"]) == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [f"{n:06d}.png" for n in (1, 2, 4, 5)]
    assert Image.open(tmp_path / "out" / "000005.png").size == (12, 8)
    assert "PSNR" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["absent.png"], "error: absent.png: No such file or directory\n"),
        (["absent.png", "--steps", "0"], "error: --steps: found 0; allowed: a positive number\n"),
        (["absent.png", "--seed", "-1"], "error: --seed: found -1; allowed: 0 or more\n"),
    ],
)
def test_errors_are_one_line(arguments, words, capsys):
    assert fit_image.main(arguments) == 2
    assert capsys.readouterr().err == words


def test_a_folder_that_cannot_be_is_named(tmp_path, capsys):
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    assert fit_image.main([str(tmp_path / "a.png"), "-o", str(tmp_path / "a.png")]) == 2
    assert capsys.readouterr().err == f"error: {tmp_path / 'a.png'}: cannot be written: File exists\n"


def test_an_unknown_device_is_named(tmp_path, capsys):
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    assert fit_image.main([str(tmp_path / "a.png"), "--device", "gpu"]) == 2
    assert capsys.readouterr().err == "error: device: found 'gpu'; Invalid device identifier: gpu\n"
