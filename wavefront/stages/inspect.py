"""What the other stages decide and do not keep, told again for one path: its hit, the light that it sampled, and how
the surface scatters."""

import functools

import warp as wp

from wavefront.accel.geometry import Geometry, hit_type
from wavefront.accel.intersector import make_intersector
from wavefront.bsdf.dispatch import is_smooth, make_bsdf
from wavefront.bsdf.frame import make_frame
from wavefront.bsdf.tables import MaterialTables
from wavefront.light.sampling import LightSample, make_light_sampler, select_light
from wavefront.light.tables import LightTables
from wavefront.queues import DEPTH, Counters, Paths, Surfaces
from wavefront.rng import PURPOSE_LIGHT
from wavefront.sampler import SAMPLERS
from wavefront.stage_kernel import stage_kernel
from wavefront.texture import TextureTables


@functools.cache
def make_inspect_hit(triangles: bool, spheres: bool, instances: tuple[str, ...], accel: str):
    """Kernel that finds the primitive which the ray in slot 0 meets; the arguments are fields of `Features`."""
    closest_hit = make_intersector(triangles, spheres, instances, accel).closest_hit
    AnyHit = hit_type(instances)

    @stage_kernel
    def inspect_hit(
        geometry: Geometry,
        paths: Paths,
        # out
        hit: wp.array[AnyHit],
    ):
        hit[0] = closest_hit(geometry, paths.origin[0], paths.direction[0])

    return inspect_hit


@functools.cache
def make_inspect_light(lights: tuple[str, ...], light_textures: tuple[str, ...], sampler: str = "independent"):
    """Kernel that draws the light sample of slot 0 as the direct-light stage does, with the same random numbers.

    The arguments are fields of `Features`. The index of the light is -1 where that stage draws none, on a surface that
    only reflects or refracts like a mirror.
    """
    sample_light, _ = make_light_sampler(lights, light_textures)
    draw = SAMPLERS[sampler]

    @stage_kernel
    def inspect_light(
        geometry: Geometry,
        materials: MaterialTables,
        textures: TextureTables,
        lights: LightTables,
        paths: Paths,
        surfaces: Surfaces,
        seed: wp.uint64,
        counters: Counters,
        # out
        index: wp.array[wp.int32],
        sample: wp.array[LightSample],
    ):
        index[0] = -1
        cos_o = -wp.dot(surfaces.shading_normal[0], paths.direction[0])
        if is_smooth(materials.materials[surfaces.material[0]], cos_o):
            u = draw(seed, paths.pixel[0], paths.sample[0], counters.values[DEPTH], PURPOSE_LIGHT)
            index[0] = select_light(lights, u[0])
            sample[0] = sample_light(lights, geometry, textures, surfaces.position[0], u)

    return inspect_light


@functools.cache
def make_inspect_bsdf(
    bsdfs: tuple[str, ...], mask: bool, textures: tuple[str, ...], uvs: bool, tangents: bool, maps: tuple[str, ...]
):
    """Kernel that evaluates the BSDF at the vertex in slot 0, a thread per direction: f |cos| and the density of BSDF
    sampling, without deltas. The arguments are fields of `Features`."""
    eval_bsdf, _, _ = make_bsdf(bsdfs, mask, textures, tangents, bool(maps))
    frame_at, _ = make_frame(tangents, bool(maps))

    @stage_kernel
    def inspect_bsdf(
        materials: MaterialTables,
        textures: TextureTables,
        paths: Paths,
        surfaces: Surfaces,
        directions: wp.array[wp.vec3],
        # out
        values: wp.array[wp.vec3],
        pdfs: wp.array[wp.float32],
    ):
        i = wp.tid()
        uv = wp.vec2(0.0)
        if wp.static(uvs):
            uv = surfaces.uv[0]
        wo = -paths.direction[0]
        bsdf = eval_bsdf(materials, textures, surfaces.material[0], uv, frame_at(surfaces, 0), wo, directions[i])
        values[i] = bsdf.value
        pdfs[i] = bsdf.pdf

    return inspect_bsdf
