"""Scatter: samples the BSDF, updates the throughput, plays Russian roulette and queues the next ray."""

from __future__ import annotations

import functools

import warp as wp

from wavefront.bsdf.dispatch import make_bsdf
from wavefront.bsdf.frame import make_frame
from wavefront.bsdf.tables import MaterialTables
from wavefront.finite import is_finite, is_finite3, is_radiance
from wavefront.medium import medium_towards
from wavefront.queues import DEPTH, NONFINITE_SCATTER, Counters, Paths, Queue, Surfaces, push, queue_end, slot_at
from wavefront.rng import PURPOSE_BSDF
from wavefront.sampler import SAMPLERS
from wavefront.stage_kernel import stage_kernel
from wavefront.stages.ahead import make_fetch_textures
from wavefront.surface import spawn_origin
from wavefront.texture import TextureTables


@wp.func
def survival_probability(beta: wp.vec3, eta: float) -> float:
    """Of Russian roulette: the largest channel of the throughput, without the scaling of radiance in a medium of index
    `eta`, which is undone when the path leaves it. Never certain, so that a path between mirrors ends."""
    return wp.min(wp.max(beta) * eta * eta, 0.95)


@functools.cache
def make_scatter(
    bsdfs: tuple[str, ...],
    mask: bool,
    textures: tuple[str, ...],
    uvs: bool,
    tangents: bool,
    maps: tuple[str, ...],
    transmission: bool,
    roulette: bool,
    media: bool = False,
    sampler: str = "independent",
    ahead: bool = False,
):
    """Kernel of the stage; the arguments are the fields of `Features` of the same name."""
    _, sample_bsdf, _ = make_bsdf(bsdfs, mask, textures, tangents, bool(maps))
    frame_at, _ = make_frame(tangents, bool(maps))
    draw = SAMPLERS[sampler]

    fetch_textures = make_fetch_textures(textures, uvs, ahead)

    @stage_kernel
    def scatter_paths(
        materials: MaterialTables,
        textures: TextureTables,
        surfaces: Surfaces,
        hits: Queue,
        rr_depth: int,
        seed: wp.uint64,
        # in and out
        paths: Paths,
        # out
        rays: Queue,
        counters: Counters,
    ):
        for i in range(wp.tid(), queue_end(hits, wp.tid())):
            fetch_textures(materials, textures, surfaces, hits, i)
            slot = slot_at(hits, i)
            depth = counters.values[DEPTH]

            # propose
            u = draw(seed, paths.pixel[slot], paths.sample[slot], depth, PURPOSE_BSDF)
            uv = wp.vec2(0.0)
            if wp.static(uvs):
                uv = surfaces.uv[slot]
            bsdf = sample_bsdf(
                materials,
                textures,
                surfaces.material[slot],
                uv,
                frame_at(surfaces, slot),
                -paths.direction[slot],
                wp.vec3(u[0], u[1], u[2]),
            )

            # resolve
            beta = wp.cw_mul(paths.beta[slot], bsdf.weight)
            if not (is_radiance(beta) and is_finite3(bsdf.wi) and is_finite(bsdf.pdf)):
                wp.atomic_add(counters.values, NONFINITE_SCATTER, 1)
                continue
            if wp.max(beta) == 0.0:
                continue
            eta = float(1.0)
            if wp.static(transmission):
                eta = paths.eta[slot] * bsdf.eta
                paths.eta[slot] = eta
            if wp.static(roulette):
                if depth + 1 >= rr_depth:
                    survival = survival_probability(beta, eta)
                    if u[3] >= survival:
                        continue
                    beta /= survival
            wi = wp.normalize(bsdf.wi)
            paths.beta[slot] = beta
            paths.direction[slot] = wi
            paths.pdf[slot] = bsdf.pdf
            if wp.static(media):
                paths.medium[slot] = medium_towards(surfaces.media[slot], surfaces.geometric_normal[slot], wi)
            paths.origin[slot] = spawn_origin(
                surfaces.position[slot], surfaces.geometric_normal[slot], surfaces.offset[slot], wi
            )
            push(rays, slot, counters)

    return scatter_paths
