"""AOVs: what the camera rays hit first, for denoisers, compositing and debugging."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.dispatch import make_bsdf
from wavefront.bsdf.tables import MaterialTables
from wavefront.film import FilmArrays
from wavefront.queues import FIRST_SAMPLE, SAMPLE_COUNT, TILE_HEIGHT, TILE_WIDTH, TILE_X, TILE_Y, Paths, Surfaces
from wavefront.stage_kernel import stage_kernel
from wavefront.texture import TextureTables


@wp.func
def to_double(v: wp.vec3) -> wp.vec3d:
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@functools.cache
def make_aov(arrays: tuple[str, ...], bsdfs: tuple[str, ...], mask: bool, textures: tuple[str, ...], uvs: bool):
    """Kernel of the stage, one thread per pixel, launched after the camera rays' intersection.

    A hit is the first surface on a ray, however transparent. A ray that escapes adds zero to each sum.

    Args:
        arrays: Subset of `wavefront.film.FIRST_HIT`: the arrays of the film to fill.
        bsdfs, mask, textures, uvs: Fields of `Features`.
    """
    _, _, eval_albedo = make_bsdf(bsdfs, mask, textures, False, False)

    @stage_kernel
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
        if wp.static("shape_index" in arrays):
            # An index has no mean: that of the first sample of the render.
            if tile[FIRST_SAMPLE] == 0:
                slot = local * samples
                film.shape_index[pixel] = wp.where(surfaces.material[slot] >= 0, surfaces.shape[slot], -1)
        for s in range(samples):
            slot = local * samples + s
            if surfaces.material[slot] >= 0:
                n = surfaces.shading_normal[slot]
                if wp.static("albedo" in arrays):
                    uv = wp.vec2(0.0)
                    if wp.static(uvs):
                        uv = surfaces.uv[slot]
                    a = eval_albedo(materials, textures, surfaces.material[slot], uv, n, -paths.direction[slot])
                    film.albedo[pixel] += to_double(a)
                if wp.static("normal" in arrays):
                    film.normal[pixel] += to_double(n)
                if wp.static("geometric_normal" in arrays):
                    film.geometric_normal[pixel] += to_double(surfaces.geometric_normal[slot])
                if wp.static("depth" in arrays):
                    film.depth[pixel] += wp.float64(wp.length(surfaces.position[slot] - paths.origin[slot]))
                if wp.static("position" in arrays):
                    film.position[pixel] += to_double(surfaces.position[slot])
                if wp.static("uv" in arrays):
                    st = surfaces.uv[slot]
                    film.uv[pixel] += wp.vec2d(wp.float64(st[0]), wp.float64(st[1]))

    return accumulate_aovs
