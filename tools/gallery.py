"""The picture of all scenes of this repository that the README shows: ``python -m tools.gallery``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from tools.bench_common import ROOT
from wavefront.errors import WavefrontError
from wavefront.output import tone_map
from wavefront.renderer import Renderer
from wavefront.scene import load_scene
from wavefront.scene.images import replacing

TILE = (160, 120)  # pixels
COLUMNS = 9


def tile(path: Path, spp: int) -> Image.Image:
    """A scene, cut to the shape of a tile around its middle."""
    scene = load_scene(path)
    film = scene.film
    scale = max(TILE[0] / film.width, TILE[1] / film.height)
    film.width, film.height, film.aovs = round(film.width * scale), round(film.height * scale), []
    image = Image.fromarray(tone_map(Renderer(scene, guide=None).render(spp=spp)))
    left, top = (image.width - TILE[0]) // 2, (image.height - TILE[1]) // 2
    return image.crop((left, top, left + TILE[0], top + TILE[1]))


def main(arguments: list[str] | None = None) -> int:
    """The command. Returns its exit code: 0, or 2 after an error, of which one line is printed."""
    parser = argparse.ArgumentParser(prog="python -m tools.gallery", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "scenes" / "images" / "gallery.jpg")
    parser.add_argument("--spp", type=int, default=48, metavar="N", help="samples per pixel; default 48")
    options = parser.parse_args(arguments)
    try:
        scenes = sorted(path for path in (ROOT / "scenes").iterdir() if path.suffix in (".json", ".glb"))
        tiles = [np.asarray(tile(path, options.spp)) for path in scenes]
        tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % COLUMNS)
        rows = [np.concatenate(tiles[i : i + COLUMNS], axis=1) for i in range(0, len(tiles), COLUMNS)]
        with replacing(options.output) as temporary:
            Image.fromarray(np.concatenate(rows)).save(temporary, format="JPEG", quality=85)
    except (WavefrontError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{options.output}: {len(scenes)} scenes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
