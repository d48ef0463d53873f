"""A path tracer in one kernel: a plain loop over bounces per path, the oracle for the stages and their queues.

It shares the functions of BSDFs, lights and geometry, which have tests of their own, and the random numbers, so that
it follows the same paths. What it does not share is everything the stages do: slots, queues, depth, weights, roulette,
who adds what and when. Its kernel knows every material and light, whether a scene has them or not, so a renderer whose
features leave out too much differs from it.
"""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from wavefront.accel.geometry import INFINITE, Geometry
from wavefront.accel.intersector import make_intersector
from wavefront.bsdf.dispatch import is_smooth, make_bsdf
from wavefront.bsdf.frame import ShadingFrame
from wavefront.bsdf.maps import make_mapped_frame
from wavefront.bsdf.tables import KINDS as BSDF_KINDS
from wavefront.bsdf.tables import MaterialTables
from wavefront.camera import Camera, camera_kind, make_camera, make_camera_ray
from wavefront.light.envmap import make_envmap
from wavefront.light.sampling import make_light_sampler
from wavefront.light.tables import KIND_CONSTANT, LightTables
from wavefront.light.tables import KINDS as LIGHT_KINDS
from wavefront.renderer import Renderer
from wavefront.rng import PURPOSE_BSDF, PURPOSE_CAMERA, PURPOSE_LIGHT
from wavefront.sampler import SAMPLERS
from wavefront.surface import make_vertex, spawn_origin
from wavefront.texture import TextureTables, make_eval_parameter
from wavefront.warp_samples import square_to_gaussian, square_to_tent

TEXTURES = ("bytes", "checkerboard", "floats")
BOX, TENT, GAUSSIAN = wp.constant(0), wp.constant(1), wp.constant(2)
CAMERAS = ("perspective", "thin_lens", "orthographic", "spherical")
THIN_LENS, ORTHOGRAPHIC, SPHERICAL = wp.constant(1), wp.constant(2), wp.constant(3)
FILTERS = {"box": 0, "tent": 1, "gaussian": 2}


@wp.struct
class Settings:
    width: wp.int32
    samples: wp.int32
    first_sample: wp.int32
    max_depth: wp.int32
    rr_depth: wp.int32  # 2^30: never
    nee: wp.int32
    camera: wp.int32
    filter: wp.int32
    filter_scale: wp.float32
    seed: wp.uint64


@wp.func
def absorbed(sigma_a: wp.array[wp.vec3], medium: int, distance: float) -> wp.vec3:
    """What a medium leaves of light; the table is empty where the scene has none."""
    left = wp.vec3(1.0)
    if sigma_a.shape[0] > 0:
        for k in range(3):
            if sigma_a[medium][k] > 0.0:
                left[k] = wp.where(distance < INFINITE, wp.exp(-sigma_a[medium][k] * distance), 0.0)
    return left


@functools.cache
def make_megakernel(
    triangles: bool,
    spheres: bool,
    smooth: bool,
    uvs: bool,
    tangents: bool,
    maps: bool,
    nee: bool,
    instances: tuple[str, ...],
    envmap: str,
    sampler: str,
):
    """Only what a scene lacks memory for is left out: kinds of primitive, vertex normals, UVs, tables of sampling."""
    perspective, thin_lens, orthographic, spherical = (make_camera_ray(kind) for kind in CAMERAS)
    closest_hit, occluded = make_intersector(triangles, spheres, instances)[:2]
    vertex_of = make_vertex(triangles, spheres, smooth, uvs, tangents, maps, instances)
    eval_bsdf, sample_bsdf, _ = make_bsdf(tuple(sorted(BSDF_KINDS)), True, TEXTURES, tangents, maps)
    mapped_frame = make_mapped_frame(TEXTURES, True)
    kinds = tuple(sorted(kind for kind in LIGHT_KINDS if not kind.startswith("envmap") or kind == f"envmap_{envmap}"))
    sample_light, light_pdf = make_light_sampler(kinds, TEXTURES)
    eval_envmap, _ = make_envmap(envmap, nee)
    envmap_kind = wp.constant(LIGHT_KINDS[f"envmap_{envmap}"])
    eval_parameter = make_eval_parameter(TEXTURES)
    draw = SAMPLERS[sampler]

    @wp.kernel(enable_backward=False, module="unique")
    def trace_paths(
        camera: Camera,
        geometry: Geometry,
        materials: MaterialTables,
        textures: TextureTables,
        lights: LightTables,
        settings: Settings,
        # out
        result: wp.array[wp.vec3],
    ):
        i = wp.tid()
        pixel = i // settings.samples
        key = wp.uint32(pixel)
        sample = wp.uint32(settings.first_sample + i % settings.samples)
        seed = settings.seed

        u = draw(seed, key, sample, 0, PURPOSE_CAMERA)
        shift = wp.vec2(u[0], u[1]) - wp.vec2(0.5, 0.5)
        if settings.filter == TENT:
            shift = settings.filter_scale * square_to_tent(wp.vec2(u[0], u[1]))
        if settings.filter == GAUSSIAN:
            shift = settings.filter_scale * square_to_gaussian(wp.vec2(u[0], u[1]))
        x = float(pixel % settings.width) + 0.5 + shift[0]
        y = float(pixel // settings.width) + 0.5 + shift[1]
        ray = perspective(camera, x, y, wp.vec2(u[2], u[3]))
        if settings.camera == THIN_LENS:
            ray = thin_lens(camera, x, y, wp.vec2(u[2], u[3]))
        if settings.camera == ORTHOGRAPHIC:
            ray = orthographic(camera, x, y, wp.vec2(u[2], u[3]))
        if settings.camera == SPHERICAL:
            ray = spherical(camera, x, y, wp.vec2(u[2], u[3]))
        origin = ray.origin
        direction = ray.direction

        L = wp.vec3(0.0)
        beta = wp.vec3(1.0)
        bsdf_pdf = float(0.0)
        eta = float(1.0)  # index of refraction relative to the camera's
        inside = geometry.camera_medium
        left = origin  # where the segment begins, without the offset of its ray
        for segment in range(1, settings.max_depth + 1):
            hit = closest_hit(geometry, origin, direction)
            if hit.primitive < 0:
                beta = wp.cw_mul(beta, absorbed(geometry.sigma_a, inside, INFINITE))
                if lights.environment >= 0:
                    sky = lights.lights[lights.environment]
                    Le = wp.vec3(0.0)
                    b = float(0.0)
                    if sky.kind == KIND_CONSTANT:
                        Le = lights.emitters[sky.emitter].radiance
                        b = sky.pmf / wp.static(4.0 * wp.pi)
                    if sky.kind == envmap_kind:
                        found = eval_envmap(lights.envmap, direction)
                        Le = found.L
                        b = sky.pmf * found.pdf
                    w = float(1.0)
                    if settings.nee == 1 and bsdf_pdf > 0.0:
                        a = bsdf_pdf
                        w = a * a / (a * a + b * b)
                    L += w * wp.cw_mul(beta, Le)
                for k in range(lights.sun_count):
                    index = lights.first_sun + k
                    disc = lights.distant[lights.lights[index].emitter]
                    if wp.length_sq(direction - disc.direction) <= 2.0 * disc.one_minus_cos:
                        w = float(1.0)
                        if settings.nee == 1 and bsdf_pdf > 0.0:
                            b = lights.lights[index].pmf / (wp.static(2.0 * wp.pi) * disc.one_minus_cos)
                            ratio = b / bsdf_pdf
                            w = 1.0 / (1.0 + ratio * ratio)
                        L += w * wp.cw_mul(beta, disc.emitted)
                break
            vertex = vertex_of(geometry, origin, direction, hit)
            shape = geometry.shapes[geometry.shape_of[hit.primitive]]
            beta = wp.cw_mul(beta, absorbed(geometry.sigma_a, inside, wp.length(vertex.position - left)))
            emits = wp.dot(vertex.geometric_normal, direction) < 0.0 or shape.two_sided == 1
            if shape.first_light >= 0 and emits:
                index = shape.first_light + hit.primitive - shape.first_primitive
                emitter = lights.emitters[lights.lights[index].emitter]
                w = float(1.0)
                if settings.nee == 1 and bsdf_pdf > 0.0:
                    b = light_pdf(lights, geometry, index, origin, direction, vertex.position, vertex.geometric_normal)
                    ratio = b / bsdf_pdf
                    w = 1.0 / (1.0 + ratio * ratio)
                Le = eval_parameter(textures, emitter.radiance, emitter.radiance_texture, vertex.uv)
                L += w * wp.cw_mul(beta, Le)
            if segment == settings.max_depth:
                break
            front = inside
            back = inside
            if shape.exterior >= 0:
                front = shape.exterior
                back = shape.interior

            wo = -direction
            frame = ShadingFrame()
            frame.normal = vertex.shading_normal
            frame.tangent = vertex.tangent
            if wp.static(maps):
                frame = mapped_frame(materials, textures, shape.material, vertex, wo)
            facing = is_smooth(materials.materials[shape.material], wp.dot(frame.normal, wo))
            if settings.nee == 1 and facing and lights.lights.shape[0] > 0:
                u = draw(seed, key, sample, segment - 1, PURPOSE_LIGHT)
                light = sample_light(lights, geometry, textures, vertex.position, u)
                if wp.max(light.L) > 0.0:
                    f = eval_bsdf(materials, textures, shape.material, vertex.uv, frame, wo, light.wi)
                    if wp.max(f.value) > 0.0:
                        start = spawn_origin(vertex.position, vertex.geometric_normal, vertex.offset, light.wi)
                        to_light = light.wi
                        if light.t_max < INFINITE:
                            to_light = light.target - start
                        through = wp.where(wp.dot(light.wi, vertex.geometric_normal) < 0.0, back, front)
                        distance = float(INFINITE)
                        if light.t_max < INFINITE:
                            distance = wp.length(light.target - vertex.position)
                        Ld = wp.cw_mul(light.L, absorbed(geometry.sigma_a, through, distance))
                        if not occluded(geometry, start, to_light, light.t_max):
                            ratio = f.pdf / light.pdf
                            w = 1.0 / (1.0 + ratio * ratio)
                            if light.delta == 1:
                                w = 1.0
                            L += (w / light.pdf) * wp.cw_mul(beta, wp.cw_mul(f.value, Ld))

            u = draw(seed, key, sample, segment - 1, PURPOSE_BSDF)
            s = sample_bsdf(materials, textures, shape.material, vertex.uv, frame, wo, wp.vec3(u[0], u[1], u[2]))
            beta = wp.cw_mul(beta, s.weight)
            if not wp.max(beta) > 0.0:
                break
            eta *= s.eta
            if segment >= settings.rr_depth:
                q = wp.min(0.95, wp.max(beta) * eta * eta)
                if u[3] >= q:
                    break
                beta = beta / q
            direction = wp.normalize(s.wi)
            origin = spawn_origin(vertex.position, vertex.geometric_normal, vertex.offset, direction)
            left = vertex.position
            bsdf_pdf = s.pdf
            inside = wp.where(wp.dot(direction, vertex.geometric_normal) < 0.0, back, front)
        result[i] = L

    return trace_paths


def render_megakernel(renderer: Renderer, spp: int) -> np.ndarray:
    """The image that `renderer.render(spp)` should give, from its uploaded scene; float64, [height, width, 3]."""
    scene, device_scene, f = renderer.scene, renderer.device_scene, renderer.features
    film, integrator = scene.film, scene.integrator
    settings = Settings()
    settings.width, settings.samples, settings.first_sample = film.width, spp, 0
    settings.max_depth, settings.nee = integrator.max_depth, int(integrator.nee)
    settings.rr_depth = 2**30 if integrator.rr_depth is None else integrator.rr_depth
    kind = film.filter.__struct_config__.tag
    settings.filter = FILTERS[kind]
    settings.filter_scale = {"box": 0.5}.get(kind) or getattr(film.filter, "radius", 0.0) or film.filter.stddev
    settings.camera = CAMERAS.index(camera_kind(scene.camera))
    settings.seed = renderer.seed
    n = film.width * film.height * spp
    result = wp.zeros(n, dtype=wp.vec3, device="cpu")
    envmap = "halves" if "envmap_halves" in f.lights else "floats"
    kernel = make_megakernel(
        f.triangles, f.spheres, f.smooth, f.uvs, f.tangents, bool(f.maps), f.nee, f.instances, envmap, f.sampler
    )
    d = device_scene
    inputs = [make_camera(scene.camera, film), d.geometry, d.materials, d.textures, d.lights, settings]
    wp.launch(kernel, dim=n, inputs=inputs, outputs=[result], device="cpu")
    samples = result.numpy().astype(np.float64).reshape(film.height, film.width, spp, 3)
    return samples.sum(axis=2) / spp
