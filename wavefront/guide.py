"""The Guide protocol: what a guiding method must provide, and what it is given.

A guide proposes directions for paths to go on in, from what it has learned of the light in the scene. The bounce loop
never asks which method it runs. A guided bounce is (`wavefront.guided`)

    intersect, perturb, escaped, emission, aov as ever
    vertices       queues `guided`: the vertices whose BSDF has more than delta directions
    prepare        the guide: per-slot parameters of these vertices
    direct         proposes a light sample each, with f |cos|; queues `lit`
    evaluate       the guide: its density in the directions of the lights
    light          weights light samples, queues `shadow`; then the shadow rays
    propose        chooses a technique for each vertex, the BSDF with probability `share`; samples the BSDF, or queues
                   `proposed`; queues `smooth`: every vertex whose direction will not be a delta
    propose        the guide: directions of `proposed`, in one or more rounds
    directions     evaluates the BSDF in these directions
    evaluate       the guide: its density in the directions of `smooth`, the BSDF's and its own
    resolve        one-sample MIS: next direction, throughput, roulette, next ray

Delta directions are left to the BSDF. With p = share p_bsdf + (1 - share) p_guide the weight of any other direction is
f |cos| / p whichever technique it came from, and that of a delta its weight by the BSDF over `share`. p is also what
light sampling is weighted against. See `wavefront.proposals` for guides without a density, and for how `share` makes up
for deltas.

Everything here is in world space. Device functions draw random numbers with `SAMPLERS[features.sampler]` from
`wavefront.sampler`, for (seed, paths.pixel[slot], paths.sample[slot], counters[DEPTH], purpose) with a purpose from
`PURPOSE_GUIDE` to `PURPOSE_GUIDE` + 15: then an image depends on nothing else.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from wavefront.errors import WavefrontError
from wavefront.proposals import INPUTS, Proposals
from wavefront.queues import Paths, Queue, Surfaces
from wavefront.recording import FIELDS, RecordRequest, Records

if TYPE_CHECKING:
    from wavefront.features import Features
    from wavefront.scene.description import Scene
    from wavefront.scene.device import DeviceScene

# Least weight of a sample; the largest is 1. So small that a pass with it hardly counts; more than zero, so that a
# render of one pass has an image, and enough that float64 sums of squares of both keep the digits of the variance.
MIN_SAMPLE_WEIGHT = 1e-3

# Purposes of `GuideState.evaluate`.
LIGHTS = "lights"
DIRECTIONS = "directions"

# What the density of a guide may be meant to be proportional to, at a vertex.
RADIANCE = "radiance"  # Li
RADIANCE_COSINE = "radiance-cosine"  # Li |cos|
PRODUCT = "product"  # f Li |cos|
TARGETS = (RADIANCE, RADIANCE_COSINE, PRODUCT)


@dataclasses.dataclass(frozen=True)
class GuideVertex:
    """A vertex that a guide is asked about from outside of a render. World space.

    Attributes:
        position: vec3, metres.
        normal: vec3, unit length: shading normal.
        wo: vec3, unit length: towards the viewer.
        roughness, transmits: As `wavefront.proposals.INPUTS`.
    """

    position: Sequence[float]
    normal: Sequence[float]
    wo: Sequence[float]
    roughness: float = 1.0
    transmits: bool = False


@dataclasses.dataclass(frozen=True)
class GuideContext:
    """What the state of a guide works on: the arrays of one worker, which owns them.

    Attributes:
        device: Warp device; pass it to every launch and allocation.
        capacity: Slots.
        features: Of the kernels.
        scene: Tables of geometry, materials, textures and lights.
        seed: Of the random numbers.
        paths: State of the paths, by slot; `direction` is that of the ray which arrived, `-wo`. To be read only.
        surfaces: The vertices, by slot; `shading_normal` is that of the BSDF. To be read only.
        proposals: By slot, with the `inputs` that the guide asked for. A guide may write `share` in `prepare`, `wi`
            and, without a density, `guide_pdf` in `propose`; no more.
        counters: `counters[wavefront.queues.DEPTH]` is the number of scatterings so far.
    """

    device: str
    capacity: int
    features: Features
    scene: DeviceScene
    seed: wp.uint64
    paths: Paths
    surfaces: Surfaces
    proposals: Proposals
    counters: wp.array


class GuideState(ABC):
    """What a guide needs for the paths of one worker: its buffers, and the launches that fill them.

    On the CPU device several workers run at once, each on a thread of its own with its own state. Methods are called
    from that thread, so they write to nothing that another state has, and only read what the guide has learned.

    Every method gets a queue (slots and their count, both on the device) and `count`: the number of threads to launch.
    That is the number of entries on the CPU device, and a bound of it on CUDA, where `wavefront.queues.queue_size`
    tells the number itself. The order of entries is not defined, and nothing may depend on it. A method is not called
    for an empty queue where the host knows that it is empty. Launches go to the current stream and need no
    synchronisation; a guided pass is not captured, so methods may also read from the device.
    """

    @abstractmethod
    def prepare(self, guided: Queue, count: int) -> None:
        """Parameters of the vertices of `guided`, from position, direction and material, into buffers of the state.

        They must stay valid until the bounce ends. May write `proposals.share[slot]`: the probability of sampling the
        BSDF at this vertex if it had no deltas, where the guide's `bsdf_share` is already. 1 declines the vertex:
        nothing of the guide is used for it. Values below `proposals.MIN_SHARE` are raised to it.
        """

    @abstractmethod
    def propose(self, proposed: Queue, count: int, round: int) -> None:
        """Round `round` of the guide's `rounds`, for vertices that were prepared.

        After the last one `proposals.wi[slot]` is a direction of unit length, or zero where the guide has none to
        offer, which ends the path there: its density then integrates to less than one. A guide without a density also
        writes to `proposals.guide_pdf[slot]` the weight W of the contribution, with E[W g(wi)] equal to the integral
        of g over the sphere of directions, for every function g that vanishes where the BSDF's sampling density does.
        """

    def evaluate(
        self, queue: Queue, count: int, directions: wp.array[wp.vec3], pdfs: wp.array[wp.float32], purpose: str
    ) -> None:
        """Writes the guide's density in solid angle, in direction `directions[slot]`, to `pdfs[slot]`.

        The density must be the one that `propose` has, of any direction: finite and not negative. A vertex may come
        up more than once in a bounce, with another purpose.

        Args:
            queue: Slots of vertices that were prepared.
            directions, pdfs: One entry per slot.
            purpose: ``LIGHTS``: directions of light samples. ``DIRECTIONS``: what the BSDF or the guide proposes.
        """
        raise NotImplementedError("a guide without a density has none to evaluate")


class Guide(ABC):
    """A guiding method and what it has learned. It belongs to one renderer at a time.

    Attributes:
        name: Of the method, for checkpoints and accounts.
        key: Hashable values that tell this guide's kernels from those of other settings; with the name in `Features`.
        has_pdf: Whether the density of its directions is known. False for resampling.
        target: One of `TARGETS`: what the density is to be compared with, as `tools.inspect_guide` does.
        weighted: Whether samples enter the film with the weight of `sample_weight`, else with 1.
        rounds: Calls of `GuideState.propose` per bounce, 1 or more.
        bsdf_share: Probability of sampling the BSDF where `GuideState.prepare` does not say otherwise; more than 0, at
            most 1. No guide is trusted with all samples: what it never proposes is found by the BSDF.
        inputs: What the guide asks to know of the surface at a vertex, keys of `wavefront.proposals.INPUTS`.
        records: What training needs; None for a guide that does not learn.
        threads: Set by the renderer before `bind`: how many threads of the CPU device may train; None: all cores.
    """

    name: str
    key: tuple = ()
    has_pdf: bool = True
    target: str = PRODUCT
    weighted: bool = False
    rounds: int = 1
    bsdf_share: float = 0.5
    inputs: tuple[str, ...] = ()
    records: RecordRequest | None = None
    threads: int | None = None

    @abstractmethod
    def bind(self, scene: Scene, device_scene: DeviceScene, features: Features, device: str) -> None:
        """Called once by the renderer, before anything else: makes kernels and allocates what is learned.

        Args:
            scene: The records.
            device_scene: Its tables on the device.
            features: Of the renderer's kernels, this guide's `key` included.
            device: Warp device.
        """

    @abstractmethod
    def modules(self) -> list[wp.Module]:
        """Warp modules of all kernels that the guide and its states launch, so that they are compiled before the first
        launch, in parallel, and loaded before threads start."""

    @abstractmethod
    def make_state(self, context: GuideContext) -> GuideState:
        """The state of a worker."""

    def bytes_per_slot(self) -> int:
        """Memory that a state takes per slot."""
        return 0

    def nbytes(self) -> int:
        """Memory that the guide takes besides, training included."""
        return 0

    # --- training --------------------------------------------------------------------------------------------------

    def trains(self, progress: float) -> bool:
        """Whether the next pass is one of training: of one sample per pixel, with records.

        Args:
            progress: Share of the samples (or of the time, if that is what the render is given) that is done, in
                [0, 1).
        """
        return False

    def train(self, records: Records) -> None:
        """Learns from the records of a pass. Called between passes from one thread; states see the result next."""
        raise NotImplementedError("a guide that trains implements this")

    def sample_weight(self, progress: float) -> float:
        """Weight in the film of the samples of the next pass, if the guide is `weighted`.

        So that noisy samples of a guide that has learned little do not dominate the error, as in the code of Dong, Wang
        and Li (2023), "Neural Parametric Mixtures for Path Guiding". The image is the mean by these weights. It
        stays unbiased, because a weight is given before its samples are seen: it must depend on the progress alone. A
        pass whose weight is not 1 has one sample per pixel, so from where the weight is 1 it must stay 1; else the
        image depends on the length of passes.

        Args:
            progress: As in `trains`, which is asked first.

        Returns:
            `MIN_SAMPLE_WEIGHT` to 1; anything else ends the render with an error.
        """
        return 1.0

    # --- accounts --------------------------------------------------------------------------------------------------

    def identity(self) -> dict[str, Any]:
        """All settings as plain JSON values; a checkpoint is refused by a guide with others."""
        return {}

    def arrays(self) -> dict[str, wp.array]:
        """All that is learned, with the state of the optimiser: one-dimensional arrays of fixed size, none of them
        empty, by name. They are written to a checkpoint, and filled in place by one."""
        return {}

    def restored(self) -> None:  # noqa: B027 (most guides have nothing to do)
        """Called after `arrays` were filled from a checkpoint."""

    def query(self, vertex: GuideVertex, directions: np.ndarray) -> np.ndarray:
        """The density in solid angle that the guide, as it is now, would propose directions with: for pictures of it.

        Args:
            vertex: Where.
            directions: Unit vectors, float32 [n, 3].

        Returns:
            float32 [n].
        """
        raise NotImplementedError("a guide without a density has none to show")

    def statistics(self) -> dict[str, Any]:
        """What a user may want to know of the guide so far, as plain JSON values."""
        return {}

    def progress(self) -> str:
        """How training goes, in a few words such as ``loss 1.234, step 600``: shown after each pass that trains."""
        return ""


def check_guide(guide: Guide) -> None:
    """Raises WavefrontError for attributes that are out of range."""
    if not 0.0 < guide.bsdf_share <= 1.0:
        raise WavefrontError(f"guide {guide.name}: a BSDF share of {guide.bsdf_share}; allowed: more than 0, up to 1")
    if guide.rounds < 1:
        raise WavefrontError(f"guide {guide.name}: {guide.rounds} rounds of proposals; allowed: 1 or more")
    if guide.target not in TARGETS:
        raise WavefrontError(f"guide {guide.name}: target {guide.target!r}; allowed: {', '.join(TARGETS)}")
    unknown = [name for name in guide.inputs if name not in INPUTS]
    if unknown:
        raise WavefrontError(f"guide {guide.name}: inputs {', '.join(unknown)}; allowed: {', '.join(INPUTS)}")
    if guide.records is not None:
        missing = [name for name in guide.records.fields if name in INPUTS and name not in guide.inputs]
        if missing:
            raise WavefrontError(
                f"guide {guide.name}: records of {', '.join(missing)}; allowed: only with inputs of the same name"
            )
        unknown = [name for name in guide.records.fields if name not in FIELDS]
        if unknown or not guide.records.fields:
            raise WavefrontError(
                f"guide {guide.name}: fields of records {', '.join(unknown) or 'missing'}; allowed: {', '.join(FIELDS)}"
            )
        if guide.records.depth < 1 or guide.records.memory < 1:
            raise WavefrontError(f"guide {guide.name}: depth and memory of records; allowed: 1 or more")
