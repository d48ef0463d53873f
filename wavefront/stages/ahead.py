"""What a stage will read for a vertex is fetched while it works on those before, on the CPU device.

A thread waits for memory that is in no cache, and there is no other that runs meanwhile as on CUDA. Scenes whose
geometry and textures fit a core's cache do without.
"""

from __future__ import annotations

import functools

import warp as wp

from wavefront.accel.geometry import Geometry, RayHits
from wavefront.bsdf.tables import MaterialTables
from wavefront.prefetch import make_prefetch
from wavefront.queues import Queue, Surfaces, slot_at
from wavefront.texture import TextureTables, make_prefetch_texture

AHEAD = wp.constant(4)  # entries of a queue: some hundred nanoseconds

_prefetch_index, _prefetch_vec3 = make_prefetch(wp.int32), make_prefetch(wp.vec3)
_prefetch_vec2 = make_prefetch(wp.vec2)


@wp.func
def slot_ahead(queue: Queue, i: int, ahead: int) -> int:
    """The slot of the entry `ahead` after `i`, or some slot where there is none."""
    return slot_at(queue, wp.min(i + ahead, queue.slots.shape[0] - 1))


@functools.cache
def make_fetch_textures(textures: tuple[str, ...], uvs: bool, ahead: bool):
    """`fetch_textures(materials, textures, surfaces, queue, i)`: for a stage that looks textures up at entry `i`.

    The arguments are the fields of `Features` of the same name.
    """
    prefetch_texture = make_prefetch_texture(textures)
    fetches = ahead and uvs and bool(textures)

    @wp.func
    def fetch_textures(materials: MaterialTables, textures: TextureTables, surfaces: Surfaces, queue: Queue, i: int):
        if wp.static(fetches):
            slot = slot_ahead(queue, i, AHEAD)
            texture = materials.materials[surfaces.material[slot]].texture
            if texture >= 0:
                prefetch_texture(textures, texture, surfaces.uv[slot])

    return fetch_textures


@functools.cache
def make_fetch_triangles(smooth: bool, uvs: bool, ahead: bool):
    """`fetch_triangles(geometry, hits, queue, i)`: for a stage that makes a vertex of the hit at entry `i`.

    The arguments are the fields of `Features` of the same name.
    """

    @wp.func
    def fetch_triangles(geometry: Geometry, hits: RayHits, queue: Queue, i: int):
        if wp.static(ahead):
            # Indices first, for they say where the corners are.
            primitive = hits.primitive[slot_ahead(queue, i, 2 * AHEAD)]
            _prefetch_index(geometry.indices, wp.int64(3) * wp.int64(primitive))
            _prefetch_index(geometry.shape_of, wp.int64(primitive))
            primitive = hits.primitive[slot_ahead(queue, i, AHEAD)]
            if primitive >= 0 and primitive < geometry.triangle_count:
                for k in range(3):
                    corner = wp.int64(geometry.indices[3 * primitive + k])
                    _prefetch_vec3(geometry.points, corner)
                    if wp.static(smooth):
                        _prefetch_vec3(geometry.normals, corner)
                    if wp.static(uvs):
                        _prefetch_vec2(geometry.uvs, corner)

    return fetch_triangles
