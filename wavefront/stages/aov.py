"""First-hit features for denoisers and debugging: albedo, shading normal and depth of the camera rays' hits."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.dispatch import make_bsdf
from wavefront.bsdf.tables import MaterialTables
from wavefront.film import FilmArrays
from wavefront.queues import SAMPLE_COUNT, TILE_HEIGHT, TILE_WIDTH, TILE_X, TILE_Y, Paths, Surfaces
from wavefront.texture import TextureTables


@functools.cache
def make_aov(aovs: tuple[str, ...], bsdfs: tuple[str, ...], mask: bool, textures: tuple[str, ...], uvs: bool):
    """Kernel of the stage, one thread per pixel, launched after the camera rays' intersection.

    Args:
        aovs: Subset of ``("albedo", "depth", "normal")``; a ray that escapes adds zero to each.
        bsdfs, mask, textures, uvs: Fields of `Features`.
    """
    _, _, eval_albedo = make_bsdf(bsdfs, mask, textures, False, False)

    @wp.kernel(enable_backward=False, module="unique")
    def accumulate_aovs(
        materials: MaterialTables,
        textures: TextureTables,
        paths: Paths,
        surfaces: Surfaces,
        tile: wp.array[wp.int32],
        film_width: int,
        # out
        film: FilmArrays,
    ):
        local = wp.tid()
        if local >= tile[TILE_WIDTH] * tile[TILE_HEIGHT]:
            return
        samples = tile[SAMPLE_COUNT]
        x = tile[TILE_X] + local % tile[TILE_WIDTH]
        y = tile[TILE_Y] + local // tile[TILE_WIDTH]
        pixel = y * film_width + x
        for s in range(samples):
            slot = local * samples + s
            if surfaces.material[slot] >= 0:
                n = surfaces.shading_normal[slot]
                if wp.static("albedo" in aovs):
                    uv = wp.vec2(0.0)
                    if wp.static(uvs):
                        uv = surfaces.uv[slot]
                    a = eval_albedo(materials, textures, surfaces.material[slot], uv, n, -paths.direction[slot])
                    film.albedo[pixel] += wp.vec3d(wp.float64(a[0]), wp.float64(a[1]), wp.float64(a[2]))
                if wp.static("normal" in aovs):
                    film.normal[pixel] += wp.vec3d(wp.float64(n[0]), wp.float64(n[1]), wp.float64(n[2]))
                if wp.static("depth" in aovs):
                    film.depth[pixel] += wp.float64(wp.length(surfaces.position[slot] - paths.origin[slot]))

    return accumulate_aovs
