"""Guides that have learned nothing, and know no better than to mislead: proofs that the protocol is general.

`HistogramGuide` needs two rounds: the second coordinate of a direction has a distribution that depends on the first.
`ResamplingGuide` has no density. `LobeGuide` is a closed form. `MeanGuide` learns a number, to see that it is kept;
`ChosenMeanGuide` is the same as a method that presets choose. `RampGuide` gives little weight to what it does before
it has learned.
"""

from __future__ import annotations

import functools
import json
from typing import Annotated

import msgspec
import numpy as np
import warp as wp

from guiding import registry
from wavefront.bsdf.dispatch import make_bsdf
from wavefront.bsdf.frame import make_frame
from wavefront.bsdf.tables import MaterialTables
from wavefront.guide import MIN_SAMPLE_WEIGHT, Guide, GuideContext, GuideState
from wavefront.proposals import INPUTS, Proposals
from wavefront.queues import DEPTH, Paths, Queue, Surfaces, queue_size
from wavefront.recording import FIELDS, RecordRequest, Records
from wavefront.rng import PURPOSE_GUIDE
from wavefront.sampler import SAMPLERS
from wavefront.texture import TextureTables
from wavefront.warp_samples import (
    cone_pdf,
    orthonormal_basis,
    sphere_pdf,
    square_to_cone,
    square_to_sphere,
    to_local,
    to_world,
)

BINS = wp.constant(8)
CELLS = wp.constant(16)


# --- histogram -------------------------------------------------------------------------------------------------------


@wp.func
def cell_of(position: wp.vec3) -> int:
    """A cell of a grid of 0.5 m, hashed to a table."""
    x = wp.uint32(wp.int32(wp.floor(2.0 * position[0])))
    y = wp.uint32(wp.int32(wp.floor(2.0 * position[1])))
    z = wp.uint32(wp.int32(wp.floor(2.0 * position[2])))
    key = x * wp.uint32(73856093) ^ y * wp.uint32(19349663) ^ z * wp.uint32(83492791)
    return int((key >> wp.uint32(7)) % wp.uint32(CELLS))


@wp.func
def draw_bin(table: wp.array[wp.float32], first: int, u: float) -> wp.vec2:
    """Bin of the masses table[first:first + BINS], and where in it, in [0, 1)."""
    rest = float(u)
    for i in range(BINS):
        mass = table[first + i]
        if rest < mass:
            return wp.vec2(float(i), wp.min(rest / mass, 1.0 - 5.9604645e-8))
        rest -= mass
    for k in range(BINS):  # the masses sum to less than one by roundings: the last bin that has one
        i = BINS - 1 - k
        if table[first + i] > 0.0:
            return wp.vec2(float(i), 0.5)
    return wp.vec2(0.0, 0.5)


@functools.cache
def histogram_kernels(sampler: str):
    draw = SAMPLERS[sampler]

    @wp.kernel(enable_backward=False, module="unique")
    def prepare(surfaces: Surfaces, guided: Queue, cells: wp.array[wp.int32]):
        i = wp.tid()
        if i < queue_size(guided):
            slot = guided.slots[i]
            cells[slot] = cell_of(surfaces.position[slot])

    @wp.kernel(enable_backward=False, module="unique")
    def propose_first(
        paths: Paths,
        proposed: Queue,
        seed: wp.uint64,
        counters: wp.array[wp.int32],
        cells: wp.array[wp.int32],
        first: wp.array[wp.float32],
        coordinate: wp.array[wp.float32],
    ):
        i = wp.tid()
        if i < queue_size(proposed):
            slot = proposed.slots[i]
            u = draw(seed, paths.pixel[slot], paths.sample[slot], counters[DEPTH], PURPOSE_GUIDE)
            found = draw_bin(first, cells[slot] * BINS, u[0])
            coordinate[slot] = (found[0] + found[1]) / float(BINS)

    @wp.kernel(enable_backward=False, module="unique")
    def propose_second(
        paths: Paths,
        proposed: Queue,
        seed: wp.uint64,
        counters: wp.array[wp.int32],
        cells: wp.array[wp.int32],
        second: wp.array[wp.float32],
        coordinate: wp.array[wp.float32],
        proposals: Proposals,
    ):
        i = wp.tid()
        if i < queue_size(proposed):
            slot = proposed.slots[i]
            u = draw(seed, paths.pixel[slot], paths.sample[slot], counters[DEPTH], PURPOSE_GUIDE + 1)
            a = wp.min(int(coordinate[slot] * float(BINS)), BINS - 1)
            found = draw_bin(second, (cells[slot] * BINS + a) * BINS, u[0])
            proposals.wi[slot] = square_to_sphere(wp.vec2(coordinate[slot], (found[0] + found[1]) / float(BINS)))

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(
        queue: Queue,
        cells: wp.array[wp.int32],
        first: wp.array[wp.float32],
        second: wp.array[wp.float32],
        directions: wp.array[wp.vec3],
        pdfs: wp.array[wp.float32],
    ):
        i = wp.tid()
        if i < queue_size(queue):
            slot = queue.slots[i]
            w = directions[slot]
            turn = wp.atan2(w[1], w[0]) / wp.static(2.0 * wp.pi)
            x = 0.5 * (1.0 - w[2])
            y = turn - wp.floor(turn)
            a = wp.clamp(int(x * float(BINS)), 0, BINS - 1)
            b = wp.clamp(int(y * float(BINS)), 0, BINS - 1)
            row = cells[slot] * BINS + a
            pdfs[slot] = first[row] * second[row * BINS + b] * float(BINS * BINS) * sphere_pdf()

    return prepare, propose_first, propose_second, evaluate


def masses(rng, *shape, zeros=0.0) -> np.ndarray:
    """Random tables whose last axis sums to one, a share of them zero (but not all along that axis)."""
    weights = rng.random(shape) ** 3 * (rng.random(shape) >= zeros)
    weights[..., 0] += weights.sum(axis=-1) == 0.0
    return (weights / weights.sum(axis=-1, keepdims=True)).astype(np.float32)


class HistogramGuide(Guide):
    """Random piecewise constant densities over the equal-area square of directions, one for each cell of space.

    Args:
        zeros: Share of the bins that are never proposed.
        seed: Of the tables.
    """

    name, rounds = "histogram", 2

    def __init__(self, zeros: float = 0.3, seed: int = 0, bsdf_share: float = 0.5):
        self.zeros, self.table_seed, self.bsdf_share = zeros, seed, bsdf_share

    def bind(self, scene, device_scene, features, device):
        rng = np.random.default_rng(self.table_seed)
        self.kernels = histogram_kernels(features.sampler)
        tables = masses(rng, CELLS, BINS, zeros=self.zeros), masses(rng, CELLS, BINS, BINS, zeros=self.zeros)
        self.first, self.second = (wp.array(t.ravel(), dtype=wp.float32, device=device) for t in tables)

    def modules(self):
        return [kernel.module for kernel in self.kernels]

    def make_state(self, context):
        return HistogramState(self, context)

    def bytes_per_slot(self):
        return 8

    def identity(self):
        return {"zeros": self.zeros, "seed": self.table_seed, "bsdf_share": self.bsdf_share}

    def arrays(self):
        return {"first": self.first, "second": self.second}


class HistogramState(GuideState):
    def __init__(self, guide: HistogramGuide, context: GuideContext):
        self.guide, self.c = guide, context
        self.cells = wp.zeros(context.capacity, dtype=wp.int32, device=context.device)
        self.coordinate = wp.zeros(context.capacity, dtype=wp.float32, device=context.device)

    def launch(self, kernel, count, *inputs):
        wp.launch(kernel, dim=count, inputs=list(inputs), device=self.c.device)

    def prepare(self, guided, count):
        self.launch(self.guide.kernels[0], count, self.c.surfaces, guided, self.cells)

    def propose(self, proposed, count, round):
        c, g = self.c, self.guide
        common = c.paths, proposed, c.seed, c.counters, self.cells
        if round == 0:
            self.launch(g.kernels[1], count, *common, g.first, self.coordinate)
        else:
            self.launch(g.kernels[2], count, *common, g.second, self.coordinate, c.proposals)

    def evaluate(self, queue, count, directions, pdfs, purpose):
        g = self.guide
        self.launch(g.kernels[3], count, queue, self.cells, g.first, g.second, directions, pdfs)


# --- resampling ------------------------------------------------------------------------------------------------------


@wp.func
def misleading_target(position: wp.vec3, w: wp.vec3) -> float:
    """Positive everywhere, with stripes that turn with the position: nothing that light does."""
    return 1.1 + wp.sin(7.0 * w[0] + 3.0 * position[0]) * wp.sin(5.0 * w[1] - 4.0 * position[1])


@functools.cache
def resampling_kernel(candidates: int, from_bsdf: bool, bsdf: tuple, uvs: bool, tangents: bool, maps: bool, sampler):
    _, sample_bsdf, _ = make_bsdf(*bsdf, tangents, maps)
    frame_at, _ = make_frame(tangents, maps)
    draw = SAMPLERS[sampler]

    @wp.kernel(enable_backward=False, module="unique")
    def propose(
        materials: MaterialTables,
        textures: TextureTables,
        paths: Paths,
        surfaces: Surfaces,
        proposed: Queue,
        seed: wp.uint64,
        counters: wp.array[wp.int32],
        proposals: Proposals,
    ):
        i = wp.tid()
        if i >= queue_size(proposed):
            return
        slot = proposed.slots[i]
        position = surfaces.position[slot]
        total = float(0.0)
        wi = wp.vec3(0.0)
        for k in range(candidates):
            u = draw(seed, paths.pixel[slot], paths.sample[slot], counters[DEPTH], PURPOSE_GUIDE + k)
            candidate = square_to_sphere(wp.vec2(u[0], u[1]))
            pdf = sphere_pdf()
            if wp.static(from_bsdf):
                uv = wp.vec2(0.0)
                if wp.static(uvs):
                    uv = surfaces.uv[slot]
                bsdf_sample = sample_bsdf(
                    materials,
                    textures,
                    surfaces.material[slot],
                    uv,
                    frame_at(surfaces, slot),
                    -paths.direction[slot],
                    wp.vec3(u[0], u[1], u[2]),
                )
                candidate = wp.normalize(bsdf_sample.wi)
                pdf = bsdf_sample.pdf
            if pdf > 0.0:
                weight = misleading_target(position, candidate) / pdf
                total += weight
                # Weighted reservoir of one: the newcomer wins with the share of its weight.
                if u[3] * total < weight:
                    wi = candidate
        proposals.wi[slot] = wi
        proposals.guide_pdf[slot] = total / (float(candidates) * misleading_target(position, wi))

    return propose


class ResamplingGuide(Guide):
    """Resampled importance sampling (Talbot et al. 2005) of a target that has nothing to do with the scene.

    Args:
        candidates: 1 to 4.
        from_bsdf: Candidates come from the BSDF, else uniformly from the sphere.
    """

    name, has_pdf = "resampling", False

    def __init__(self, candidates: int, from_bsdf: bool = False, bsdf_share: float = 0.5):
        self.candidates, self.from_bsdf, self.bsdf_share = candidates, from_bsdf, bsdf_share
        self.key = (candidates, from_bsdf)

    def bind(self, scene, device_scene, features, device):
        f = features
        bsdf = f.bsdfs, f.mask, f.textures
        self.kernel = resampling_kernel(
            self.candidates, self.from_bsdf, bsdf, f.uvs, f.tangents, bool(f.maps), f.sampler
        )

    def modules(self):
        return [self.kernel.module]

    def make_state(self, context):
        return ResamplingState(self, context)


class ResamplingState(GuideState):
    def __init__(self, guide: ResamplingGuide, context: GuideContext):
        self.guide, self.c = guide, context

    def prepare(self, guided, count):
        pass

    def propose(self, proposed, count, round):
        c = self.c
        inputs = [c.scene.materials, c.scene.textures, c.paths, c.surfaces, proposed, c.seed, c.counters, c.proposals]
        wp.launch(self.guide.kernel, dim=count, inputs=inputs, device=c.device)


# --- a lobe ----------------------------------------------------------------------------------------------------------


@functools.cache
def lobe_kernels(sampler: str, varied_share: bool):
    draw = SAMPLERS[sampler]

    @wp.kernel(enable_backward=False, module="unique")
    def prepare(surfaces: Surfaces, guided: Queue, proposals: Proposals):
        """A quarter for some vertices, up to 1 for others, which are declined."""
        i = wp.tid()
        if i < queue_size(guided):
            slot = guided.slots[i]
            cell = cell_of(surfaces.position[slot])
            if wp.static(varied_share):
                proposals.share[slot] = float(1 + cell % 4) / 4.0

    @wp.kernel(enable_backward=False, module="unique")
    def propose(
        paths: Paths,
        proposed: Queue,
        seed: wp.uint64,
        counters: wp.array[wp.int32],
        axis: wp.vec3,
        one_minus_cos: float,
        proposals: Proposals,
    ):
        i = wp.tid()
        if i < queue_size(proposed):
            slot = proposed.slots[i]
            u = draw(seed, paths.pixel[slot], paths.sample[slot], counters[DEPTH], PURPOSE_GUIDE)
            s, t = orthonormal_basis(axis)
            proposals.wi[slot] = to_world(s, t, axis, square_to_cone(wp.vec2(u[0], u[1]), one_minus_cos))

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(
        queue: Queue,
        axis: wp.vec3,
        one_minus_cos: float,
        directions: wp.array[wp.vec3],
        pdfs: wp.array[wp.float32],
    ):
        i = wp.tid()
        if i < queue_size(queue):
            slot = queue.slots[i]
            s, t = orthonormal_basis(axis)
            w = to_local(s, t, axis, directions[slot])
            inside = w[2] >= 1.0 - one_minus_cos
            pdfs[slot] = wp.where(inside, cone_pdf(one_minus_cos), 0.0)

    return prepare, propose, evaluate


class LobeGuide(Guide):
    """One cone of directions everywhere, also below surfaces; a whole sphere of them by default.

    Args:
        axis: Of the cone, unit length.
        one_minus_cos: Of its half angle, up to 2.
        varied_share: The share of BSDF sampling varies from 1/4 to 1 over the vertices.
    """

    name = "lobe"

    def __init__(
        self,
        axis: tuple[float, float, float] = (0.0, 0.0, 1.0),
        one_minus_cos: float = 2.0,
        bsdf_share: float = 0.5,
        varied_share: bool = False,
    ):
        self.axis, self.one_minus_cos, self.bsdf_share = wp.vec3(*axis), one_minus_cos, bsdf_share
        self.varied_share = varied_share

    def bind(self, scene, device_scene, features, device):
        self.kernels = lobe_kernels(features.sampler, self.varied_share)

    def modules(self):
        return [kernel.module for kernel in self.kernels]

    def make_state(self, context):
        return LobeState(self, context)

    def query(self, vertex, directions):
        inside = directions @ np.array(self.axis) >= 1.0 - self.one_minus_cos
        return np.where(inside, 1.0 / (2.0 * np.pi * self.one_minus_cos), 0.0).astype(np.float32)

    def identity(self):
        return {"axis": list(self.axis), "one_minus_cos": self.one_minus_cos, "bsdf_share": self.bsdf_share}


class LobeState(GuideState):
    def __init__(self, guide: LobeGuide, context: GuideContext):
        self.guide, self.c = guide, context

    @property
    def lobe(self):
        return [self.guide.axis, self.guide.one_minus_cos]

    def launch(self, kernel, count, *inputs):
        wp.launch(kernel, dim=count, inputs=list(inputs), device=self.c.device)

    def prepare(self, guided, count):
        self.launch(self.guide.kernels[0], count, self.c.surfaces, guided, self.c.proposals)

    def propose(self, proposed, count, round):
        c = self.c
        self.launch(self.guide.kernels[1], count, c.paths, proposed, c.seed, c.counters, *self.lobe, c.proposals)

    def evaluate(self, queue, count, directions, pdfs, purpose):
        self.launch(self.guide.kernels[2], count, queue, *self.lobe, directions, pdfs)


# --- one that learns -------------------------------------------------------------------------------------------------


class MeanGuide(LobeGuide):
    """A lobe around the mean direction of the light so far, learned until a share of the render is done.

    `passes` keeps the records of all passes, on the host.
    """

    name, inputs = "mean", tuple(INPUTS)

    def __init__(self, train_share: float = 0.5, keep: bool = False, depth: int = 16, memory: int = 1 << 26, **lobe):
        super().__init__(**lobe)
        self.train_share, self.keep, self.passes = train_share, keep, []
        self.records = RecordRequest(tuple(FIELDS), depth=depth, memory=memory)

    def bind(self, scene, device_scene, features, device):
        super().bind(scene, device_scene, features, device)
        self.sum = wp.zeros(4, dtype=wp.float64, device=device)

    def trains(self, progress):
        return progress < self.train_share

    def train(self, records: Records):
        host = {name: getattr(records, name).numpy() for name in FIELDS}
        if self.keep:
            kept = {name: array.copy() for name, array in host.items()}
            self.passes.append(kept | {"camera": records.camera.numpy().copy()})
        light = host["radiance"].sum(axis=1, dtype=np.float64) / host["pdf"] / host["survival"]
        self.sum.assign(self.sum.numpy() + np.append(light @ host["wi"].astype(np.float64), records.count))
        self.point()

    def point(self):
        direction = self.sum.numpy()[:3]
        length = np.linalg.norm(direction)
        if length > 0.0:
            self.axis = wp.vec3(*(direction / length))

    def identity(self):
        return super().identity() | {"axis": None, "train_share": self.train_share}

    def arrays(self):
        return {"sum": self.sum}

    def restored(self):
        self.point()

    def statistics(self):
        return {"records": int(self.sum.numpy()[3])}


class MeanSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Of `ChosenMeanGuide`."""

    one_minus_cos: Annotated[float, msgspec.Meta(gt=0.0, le=2.0)]
    train_share: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.5
    bsdf_share: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.5


class ChosenMeanGuide(MeanGuide):
    """`MeanGuide` with what a method of `guiding.registry` has: settings, a seed, and words for its progress."""

    def __init__(self, settings: MeanSettings, seed: int = 0):
        super().__init__(**msgspec.structs.asdict(settings))
        self.settings, self.first_seed = settings, seed

    def identity(self):
        return {"seed": self.first_seed} | msgspec.structs.asdict(self.settings)

    def progress(self):
        return f"records so far {self.statistics()['records']}"


MEAN_PRESET = {
    "method": "mean",
    "description": "A cone around the mean direction of the light.",
    "settings": {"one_minus_cos": 1.0, "train_share": 0.5, "bsdf_share": 0.5},
    "sources": {"one_minus_cos": "ours", "train_share": "paper", "bsdf_share": "paper"},
}


def use_mean_preset(monkeypatch, folder) -> None:
    """Has `guiding.registry` know the preset ``mean``, and no other."""
    (folder / "mean.json").write_text(json.dumps(MEAN_PRESET))
    monkeypatch.setattr(registry, "FOLDER", folder)
    monkeypatch.setitem(registry.METHODS, "mean", ("tests.guides", "MeanSettings", "ChosenMeanGuide"))


class RampGuide(MeanGuide):
    """One that learns, with sample weights that grow with the progress: 1 from `full` on."""

    name, weighted = "ramp", True

    def __init__(self, train_share: float = 0.5, full: float = 0.75, **settings):
        super().__init__(train_share, **settings)
        self.full = full

    def sample_weight(self, progress):
        return min(max(progress / self.full, MIN_SAMPLE_WEIGHT), 1.0)

    def identity(self):
        return super().identity() | {"full": self.full}
