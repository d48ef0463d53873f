"""Generate camera rays: reads the tile and the camera, fills every slot and queues it."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.camera import Camera, make_camera_ray
from wavefront.film import FilmWindow
from wavefront.queues import (
    CONTINUE,
    DEPTH,
    EMISSIVE,
    ESCAPED,
    FIRST_SAMPLE,
    HITS,
    RAYS,
    SAMPLE_COUNT,
    SHADOW,
    TILE_HEIGHT,
    TILE_WIDTH,
    TILE_X,
    TILE_Y,
    TOTAL_PATHS,
    Counters,
    Paths,
    Queue,
)
from wavefront.rng import PURPOSE_CAMERA
from wavefront.sampler import SAMPLERS
from wavefront.stage_kernel import stage_kernel
from wavefront.warp_samples import square_to_gaussian, square_to_tent


@functools.cache
def make_generate(camera_kind: str, filter_kind: str, transmission: bool, sampler: str = "independent"):
    """Kernel of the stage.

    Args:
        camera_kind: See `wavefront.camera.make_camera_ray`.
        filter_kind: Reconstruction filter, ``box``, ``tent`` or ``gaussian``, sampled so that each sample counts for
            its own pixel alone (Ernst, Stamminger and Greiner 2006, "Filter Importance Sampling").
        transmission: Whether paths track the index of refraction.
        sampler: A key of `wavefront.sampler.SAMPLERS`.
    """
    camera_ray = make_camera_ray(camera_kind)
    draw = SAMPLERS[sampler]

    @stage_kernel
    def generate_rays(
        camera: Camera,
        tile: wp.array[wp.int32],
        window: FilmWindow,
        filter_scale: float,
        seed: wp.uint64,
        # out
        paths: Paths,
        rays: Queue,
        counters: Counters,
        totals: wp.array[wp.int64],
    ):
        slot = wp.tid()
        samples = tile[SAMPLE_COUNT]
        count = tile[TILE_WIDTH] * tile[TILE_HEIGHT] * samples
        if slot >= count:
            return
        if slot == 0:
            counters.values[RAYS] = count
            counters.values[HITS] = 0
            counters.values[ESCAPED] = 0
            counters.values[EMISSIVE] = 0
            counters.values[SHADOW] = 0
            counters.values[DEPTH] = 0
            counters.values[CONTINUE] = 1
            totals[TOTAL_PATHS] += wp.int64(count)
        local = slot // samples
        # Pixels are numbered over the whole film, so that those of a window draw the same random numbers.
        x = window.x + tile[TILE_X] + local % tile[TILE_WIDTH]
        y = window.y + tile[TILE_Y] + local // tile[TILE_WIDTH]
        pixel = wp.uint32(y) * wp.uint32(window.film_width) + wp.uint32(x)
        sample = wp.uint32(tile[FIRST_SAMPLE] + slot % samples)
        u = draw(seed, pixel, sample, 0, PURPOSE_CAMERA)
        square = wp.vec2(u[0], u[1])
        offset = wp.vec2(u[0] - 0.5, u[1] - 0.5)
        if wp.static(filter_kind == "tent"):
            offset = filter_scale * square_to_tent(square)
        if wp.static(filter_kind == "gaussian"):
            offset = filter_scale * square_to_gaussian(square)
        ray = camera_ray(camera, float(x) + 0.5 + offset[0], float(y) + 0.5 + offset[1], wp.vec2(u[2], u[3]))
        paths.origin[slot] = ray.origin
        paths.direction[slot] = ray.direction
        paths.beta[slot] = wp.vec3(1.0)
        paths.L[slot] = wp.vec3(0.0)
        paths.pdf[slot] = 0.0
        paths.pixel[slot] = pixel
        paths.sample[slot] = sample
        if wp.static(transmission):
            paths.eta[slot] = 1.0
        rays.slots[slot] = slot

    return generate_rays
