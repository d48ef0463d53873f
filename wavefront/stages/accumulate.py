"""Accumulate: adds the samples of each pixel of the tile to the film, in the order of the samples."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.film import FilmArrays, luminance
from wavefront.finite import is_finite3
from wavefront.queues import (
    NONFINITE_ACCUMULATE,
    SAMPLE_COUNT,
    TILE_HEIGHT,
    TILE_WIDTH,
    TILE_X,
    TILE_Y,
    Counters,
    Paths,
)
from wavefront.stage_kernel import stage_kernel


@functools.cache
def make_accumulate(variance: bool, weighted: bool = False):
    """Kernel of the stage, one thread per pixel.

    Args:
        variance: Also sum what the variance is estimated from.
        weighted: Samples have the weight `FilmArrays.weights[0]`.
    """

    @stage_kernel
    def accumulate_samples(
        paths: Paths,
        tile: wp.array[wp.int32],
        film_width: int,
        # out
        film: FilmArrays,
        counters: Counters,
    ):
        local = wp.tid()
        if local >= tile[TILE_WIDTH] * tile[TILE_HEIGHT]:
            return
        samples = tile[SAMPLE_COUNT]
        x = tile[TILE_X] + local % tile[TILE_WIDTH]
        y = tile[TILE_Y] + local // tile[TILE_WIDTH]
        pixel = y * film_width + x
        total = film.L[pixel]
        square = wp.float64(0.0)
        weighted_luminance = wp.float64(0.0)
        weight = wp.float64(1.0)
        if wp.static(weighted):
            weight = film.weights[0]
        if wp.static(variance):
            square = film.luminance_squared[pixel]
            if wp.static(weighted):
                weighted_luminance = film.weighted_luminance[pixel]
        for s in range(samples):
            L = paths.L[local * samples + s]
            if not is_finite3(L):  # each contribution was finite, their sum overflowed
                wp.atomic_add(counters.values, NONFINITE_ACCUMULATE, 1)
                L = wp.vec3(0.0)
            contribution = wp.vec3d(wp.float64(L[0]), wp.float64(L[1]), wp.float64(L[2]))
            if wp.static(weighted):
                contribution = weight * contribution
            total += contribution
            if wp.static(variance):
                y_sample = wp.float64(luminance(L))
                if wp.static(weighted):
                    y_sample = weight * y_sample
                    weighted_luminance += weight * y_sample
                square += y_sample * y_sample
        film.L[pixel] = total
        if wp.static(variance):
            film.luminance_squared[pixel] = square
            if wp.static(weighted):
                film.weighted_luminance[pixel] = weighted_luminance

    return accumulate_samples
