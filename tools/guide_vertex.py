"""A vertex of a path as a guide is asked about it: what it is, how it scatters, and what light arrives there."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import msgspec
import numpy as np
import warp as wp

from tools.guide_map import DirectionMap, Side
from wavefront import Renderer
from wavefront.errors import WavefrontError
from wavefront.guide import GuideVertex
from wavefront.proposals import INPUTS, Proposals
from wavefront.queues import QueueSet, allocate_struct
from wavefront.scene import description
from wavefront.stages.guided_vertices import make_guided_vertices
from wavefront.stages.inspect import make_inspect_bsdf
from wavefront.trace import TraceWorker, Vertex

WITHOUT_EXTENT = (description.Directional, description.Point, description.Spot)


def centred(scene: description.Scene) -> description.Scene:
    """The scene as it is traced from: unguided, without Russian roulette, camera rays through the centres of pixels;
    with the albedo as an AOV."""
    replace = msgspec.structs.replace
    film = replace(scene.film, filter=description.TentFilter(radius=1e-6), aovs=["albedo"])  # too narrow for float32
    return replace(scene, film=film, integrator=replace(scene.integrator, guide=None, rr_depth=None))


@dataclasses.dataclass(frozen=True)
class FoundVertex:
    """A vertex that a guide would have a say at.

    Attributes:
        traced: As the tracer saw it.
        asked: As the guide is asked about it.
        delta: Probability that a sample of the BSDF is a delta.
        front: Geometric normal on the side that is seen.
        offset: How far along it a ray must start, metres.
        media: Absorption in 1/m, RGB, on the side that is seen and behind it; None in vacuum.
    """

    traced: Vertex
    asked: GuideVertex
    delta: float
    front: np.ndarray
    offset: float
    media: tuple[list[float] | None, list[float] | None]


class VertexWorker(TraceWorker):
    """Traces a path up to a vertex and keeps the state there.

    Args:
        renderer: Of a scene of `centred`.
    """

    def __init__(self, renderer: Renderer):
        super().__init__(renderer)
        f = renderer.features
        self.wanted, self.seen, self.found = 0, 0, None
        self.proposals = allocate_struct(Proposals, 1, self.device)
        self.own = QueueSet(1, self.device, ("guided",))
        bsdf = f.bsdfs, f.mask, f.textures, f.uvs
        self.look = make_guided_vertices(*bsdf, f.mixed_deltas, tuple(INPUTS))
        self.evaluate = make_inspect_bsdf(*bsdf, f.tangents, f.maps)

    def find(self, x: int, y: int, number: int) -> FoundVertex:
        """The vertex `number`, from 1, of those on the path through the centre of a pixel whose BSDF is not all deltas.

        Raises:
            WavefrontError: No such pixel or vertex, with what the path meets instead.
        """
        self.wanted, self.seen, self.found = number, 0, None
        traced = self.trace(x, y, 0)
        if self.found is None:
            if traced.vertices[0].position is None:
                raise WavefrontError(f"pixel {x},{y} sees nothing of the scene")
            raise WavefrontError(
                f"pixel {x},{y} has no vertex {number}: its path has {self.seen} with a BSDF that is more than deltas, "
                f"of {sum(v.position is not None for v in traced.vertices)}, and ends with: {self.end}"
            )
        return self.found

    def _observe_scatter(self, stage, size):
        scene = self.renderer.device_scene
        self.own.counters.zero_()
        inputs = [scene.materials, scene.textures, self.paths, self.surfaces, self.queues["hits"], 0.5]
        outputs = [self.proposals, self.own["guided"], self.own.counter_struct]
        wp.launch(self.look, dim=1, inputs=inputs, outputs=outputs, device=self.device)
        self.seen += int(self.own["guided"].count.numpy()[0])
        if self.seen == self.wanted:
            self.found = self._describe()
            return  # without a next ray the path ends here
        super()._observe_scatter(stage, size)

    def _describe(self) -> FoundVertex:
        traced, p = self.vertices[-1], self.proposals
        wo = -np.asarray(traced.direction)
        front = np.asarray(traced.geometric_normal, np.float32)
        behind = np.dot(front, wo) < 0.0
        media = [None, None]
        if self.renderer.features.media:
            table = self.renderer.device_scene.geometry.sigma_a.numpy()
            indices = self.surfaces.media.numpy()[0]
            media = [table[i].tolist() if i > 0 else None for i in (indices[::-1] if behind else indices)]
        asked = GuideVertex(
            position=traced.position,
            normal=traced.shading_normal,
            wo=wo.tolist(),
            roughness=float(p.roughness.numpy()[0]),
            transmits=bool(p.transmits.numpy()[0]),
        )
        delta = float(p.delta.numpy()[0]) if self.renderer.features.mixed_deltas else 0.0
        offset = float(self.surfaces.offset.numpy()[0])
        return FoundVertex(traced, asked, delta, -front if behind else front, offset, tuple(media))

    def bsdf(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """f |cos| and the density of BSDF sampling at the vertex found, both without deltas.

        Args:
            directions: Unit vectors, float32 [n, 3].

        Returns:
            float32 [n, 3] and [n].
        """
        scene = self.renderer.device_scene
        w = wp.array(directions, dtype=wp.vec3, device=self.device)
        values = wp.empty(w.shape[0], dtype=wp.vec3, device=self.device)
        pdfs = wp.empty(w.shape[0], dtype=wp.float32, device=self.device)
        inputs = [scene.materials, scene.textures, self.paths, self.surfaces, w]
        wp.launch(self.evaluate, dim=w.shape[0], inputs=inputs, outputs=[values, pdfs], device=self.device)
        return values.numpy(), pdfs.numpy()


def incident_sides(
    scene: description.Scene,
    vertex: FoundVertex,
    directions: DirectionMap,
    rays: int,
    make_renderer: Callable[[description.Scene], Renderer],
) -> tuple[list[Side], list[Side]]:
    """Light that arrives at a vertex, by a spherical camera there: of the first and of the second half of the rays.

    Paths have the segments that are left of `max_depth`. Light sampling is used wherever it changes no more than the
    noise: also in a scene that has it off, if rays can find all of its lights.

    Args:
        scene: As rendered.
        vertex: Where.
        directions: The map.
        rays: Paths per cell, an even number.
        make_renderer: Of an unguided scene.

    Returns:
        The sides in each half: the one that is seen, and the other if the surface transmits.

    Raises:
        WavefrontError: The longest path ends at the vertex.
    """
    replace = msgspec.structs.replace
    left = scene.integrator.max_depth - vertex.traced.depth
    if left < 1:
        raise WavefrontError(f"integrator.max_depth {scene.integrator.max_depth}: no light arrives at this vertex")
    found_by_rays = not any(isinstance(emitter, WITHOUT_EXTENT) for emitter in scene.emitters)
    nee = scene.integrator.nee or found_by_rays
    integrator = replace(scene.integrator, guide=None, max_depth=left, nee=nee)
    w = directions.directions.reshape(-1, 3)
    in_front = w @ vertex.front > 0.0
    shares = [in_front, ~in_front]
    if not vertex.asked.transmits:
        n = np.asarray(vertex.asked.normal)
        shares = [in_front & (w @ n * np.sign(n @ vertex.asked.wo) > 0.0)]
    halves = [], []
    position = np.asarray(vertex.asked.position, np.float32)
    for sign, share, medium in zip((1.0, -1.0), shares, vertex.media, strict=False):
        origin = position + np.float32(sign * vertex.offset) * vertex.front  # as `surface.spawn_origin`
        camera = description.Spherical(
            to_world=[description.TransformStep(translate=tuple(map(float, origin)))],
            medium=description.Homogeneous(sigma_a=medium) if medium is not None else None,
        )
        film = description.Film(width=directions.width, height=directions.height)
        renderer = make_renderer(replace(scene, camera=camera, film=film, integrator=integrator))
        first = renderer.render(spp=rays // 2).astype(np.float64)
        both = renderer.render(spp=rays // 2).astype(np.float64)
        for half, radiance in zip(halves, (first, np.maximum(2.0 * both - first, 0.0)), strict=True):
            half.append(Side(radiance, share.astype(np.float64)))
    return halves
