"""Batches of samples of one scene from ours and from the peers, for `tools.image_test`."""

from __future__ import annotations

import zlib
from collections.abc import Iterator

import numpy as np

from tools.image_test import ROUNDING
from tools.peers import cycles
from tools.peers import mitsuba as peer
from wavefront.errors import WavefrontError
from wavefront.renderer import Renderer
from wavefront.scene import description

# Light from a small sphere far away: on the floor of veach-mis, that of the sphere of radius 0.05 is 0.06 to 0.17 %
# more in Mitsuba 3.9 than in closed form, from which ours differs by 0.003 %; tiles of the two differ by up to 0.26 %.
ROUNDINGS = {"veach-mis": 0.004}


def rounding_of(name: str) -> float:
    """What may differ in a tile of the scene of this name, relative to its mean."""
    return ROUNDINGS.get(name, ROUNDING)


def like_the_peer(scene: description.Scene, width: int, height: int, max_depth: int, nee: bool = True):
    """The scene with a film and an integrator as the peer has them: box filter, no Russian roulette,
    independent samples."""
    scene.film = description.Film(width=width, height=height)
    scene.integrator = description.PathIntegrator(max_depth=max_depth, rr_depth=None, nee=nee)
    return scene


def our_batches(scene: description.Scene, spp: int, name: str, **settings) -> Iterator[np.ndarray]:
    """Means of consecutive samples of one render, which are independent; so are renders of different names.

    Args:
        scene: Valid records.
        spp: Samples per pixel and batch.
        name: Makes the seed.
        settings: Of the `Renderer`.

    Yields:
        Mean radiance, [height, width, 3] float64.

    Raises:
        WavefrontError: A contribution was left out because it was not finite.
    """
    renderer = Renderer(scene, seed=zlib.crc32(name.encode()), **({"guide": None} | settings))
    before, weight_before = np.zeros(1), 0.0
    while True:
        renderer.render(spp=spp)
        if any(renderer.statistics.nonfinite.values()):
            raise WavefrontError(f"contributions that are not finite: {renderer.statistics.nonfinite}")
        total = renderer.film.arrays.L.numpy().copy()  # float64 sums
        weight = renderer.film.weight_sums[0]
        mean = (total - before) / (weight - weight_before)
        yield mean.reshape(renderer.film.height, renderer.film.width, 3)
        before, weight_before = total, weight


def their_batches(scene, max_depth: int, spp: int, seed: int = 0, integrator: str = "path") -> Iterator[np.ndarray]:
    """Means of Mitsuba's renders with seeds from `seed` on; arguments as in `tools.peers.mitsuba.render`."""
    while True:
        yield peer.render(scene, spp, seed, max_depth, integrator=integrator)
        seed += 1


def cycles_batches(session: cycles.Session, spp: int, seed: int = 0) -> Iterator[np.ndarray]:
    """Means of renders of Cycles with seeds from `seed` on."""
    while True:
        yield session.render(spp, seed)
        seed += 1
