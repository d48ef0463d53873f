"""Neural parametric mixtures: a network maps a vertex to a mixture of von Mises-Fisher lobes (Dong et al. 2023).

Dong, Wang and Li, "Neural Parametric Mixtures for Path Guiding", SIGGRAPH 2023. A vertex x (with wo, the normal n and
the roughness in the product variant) is encoded by a dense multiresolution grid, spherical harmonics and one-blobs; a
small network turns that into the raw parameters of a mixture v(w). Training minimises KL(target || v) by its gradient
from one sample per record (their equation 10): -(target / p) grad log v, with p the density that the direction was
drawn with. Targets are, of the mean of the colour channels,

    radiance   Li(x, w)
    product    f(x, wo, w) Li(x, w)

Directions are drawn from the product of v with a lobe that stands for the cosine (their equation 12).

Training happens between passes of one sample per pixel, in a fixed number of optimisation steps per pass: the records
of the pass, dealt out to the batches in turn, so that every batch is spread over the image.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import warp as wp

from guiding import npm_kernels
from guiding.distributions.vmf_mixture import DIRECTIONS, make_vmf_mixture
from nn import Model
from wavefront.guide import (
    MIN_SAMPLE_WEIGHT,
    PRODUCT,
    RADIANCE,
    RADIANCE_COSINE,
    Guide,
    GuideContext,
    GuideState,
    GuideVertex,
)
from wavefront.queues import Queue
from wavefront.recording import RecordArrays, RecordRequest, Records

Fraction = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Decay = Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0.0)]

LEAST_RECORD = 128  # bytes that a record takes of the memory for records, at least: its row, and what becomes of it


class NpmSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All that can be chosen; `guiding/presets` has the choices of the paper.

    Attributes:
        product: Learn f Li from position, wo, normal and roughness; else Li from the position.
        n_lobes: Lobes of the mixture.
        direction: How the network gives mean directions: two ``angles``, or a ``vector`` that is normalised.
        cosine_aware: Draw from the product of the mixture with the cosine lobe.
        product_cosine: Train that product, on the target times the cosine; else the mixture alone, on the target.
        mis_aware: Weight the target by the guide's part of the density of the mixture of techniques.
        learned_share: The network also gives the share of BSDF sampling, from `bsdf_share` at the beginning.
        brightness_cells: Divide the target by its mean in cells of a grid of so many per axis, so that dark places are
            learned like bright ones; 0: do not. The optimum at each place is the same.
        whole_emission: With light sampling: learn all light; else the emission that lights are sampled for counts by
            its weight against light sampling.
        bsdf_share: Probability of sampling the BSDF, more than 0.
        train_share: Of the samples, or of the time: passes of training until that is done.
        steps_per_spp: Optimisation steps per pass.
        record_depth: Scatterings of a path that train, from the camera.
        sample_weighting: While training, a frame counts by the share of the training that is done.
        n_levels, n_features, base_resolution, per_level_scale, interpolation: Of the grid over the bounds of the scene.
        wo_degree: Bands of the spherical harmonics of wo (`product`).
        n_bins: Of the one-blobs of the two angles of the normal and of 1 - exp(-roughness) (`product`).
        n_neurons, n_hidden_layers: Of the network.
        learning_rate, beta1, beta2, epsilon, l2_reg: Of Adam.
        ema: Decay of the moving average of the parameters that directions are drawn with; 0: none.
        gradient_clipping: Largest Euclidean norm of a gradient; 0: none.
        precision: Of the network.
        loss_scale: Of the gradients.
    """

    product: bool
    n_lobes: Annotated[int, msgspec.Meta(ge=1, le=64)] = 8
    direction: Literal["angles", "vector"] = "angles"
    cosine_aware: bool = True
    product_cosine: bool = False
    mis_aware: bool = True
    learned_share: bool = False
    brightness_cells: Annotated[int, msgspec.Meta(ge=0, le=256)] = 0
    whole_emission: bool = False
    bsdf_share: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.5
    train_share: Fraction = 0.25
    steps_per_spp: Annotated[int, msgspec.Meta(ge=1, le=1024)] = 6
    record_depth: Annotated[int, msgspec.Meta(ge=1, le=64)] = 6
    sample_weighting: bool = True
    n_levels: Annotated[int, msgspec.Meta(ge=1, le=16)] = 8
    n_features: Literal[1, 2, 4, 8] = 4
    base_resolution: Annotated[int, msgspec.Meta(ge=1, le=512)] = 8
    per_level_scale: Annotated[float, msgspec.Meta(ge=1.0, le=4.0)] = 1.405
    interpolation: Literal["linear", "smoothstep"] = "smoothstep"
    wo_degree: Annotated[int, msgspec.Meta(ge=1, le=8)] = 2
    n_bins: Annotated[int, msgspec.Meta(ge=1, le=64)] = 4
    n_neurons: Literal[16, 32, 64, 128] = 64
    n_hidden_layers: Annotated[int, msgspec.Meta(ge=1, le=16)] = 3
    learning_rate: Positive = 0.005
    beta1: Decay = 0.9
    beta2: Decay = 0.99
    epsilon: NonNegative = 1e-15
    l2_reg: NonNegative = 1e-6
    ema: Decay = 0.95
    gradient_clipping: NonNegative = 0.0
    precision: Literal["fp32", "fp16", "bf16"] = "fp32"
    loss_scale: Positive | Literal["dynamic"] = 1.0

    @property
    def n_inputs(self) -> int:
        """Of the network: position; wo, two angles of the normal and roughness."""
        return 9 if self.product else 3

    @property
    def n_outputs(self) -> int:
        """Of the network: raw parameters of the mixture; the share of BSDF sampling."""
        return (2 + DIRECTIONS[self.direction]) * self.n_lobes + self.learned_share

    @property
    def vertex_loss(self) -> bool:
        """Whether the loss knows more of the vertex than the direction and the target."""
        return self.product_cosine or self.learned_share

    @property
    def n_targets(self) -> int:
        """Columns of a target: direction and weight; axis of the cosine lobe, or zero, and density of BSDF sampling."""
        return 8 if self.vertex_loss else 4

    def model(self) -> dict[str, Any]:
        """The configuration of the network, for `nn.Model`."""
        grid = {
            "otype": "DenseGrid",
            "n_levels": self.n_levels,
            "n_features_per_level": self.n_features,
            "base_resolution": self.base_resolution,
            "per_level_scale": self.per_level_scale,
            "interpolation": self.interpolation.capitalize(),
        }
        parts = [grid | {"n_dims_to_encode": 3}]
        if self.product:
            parts += [
                {"otype": "SphericalHarmonics", "n_dims_to_encode": 3, "degree": self.wo_degree},
                {"otype": "OneBlob", "n_dims_to_encode": 3, "n_bins": self.n_bins},
            ]
        optimizer = {
            "otype": "Adam",
            "learning_rate": self.learning_rate,
            "beta1": self.beta1,
            "beta2": self.beta2,
            "epsilon": self.epsilon,
            "l2_reg": self.l2_reg,
        }
        if self.ema > 0.0:
            optimizer = {"otype": "EMA", "decay": self.ema, "nested": optimizer}
        config = {
            "encoding": {"otype": "Composite", "nested": parts},
            "network": {
                "otype": "FullyFusedMLP",
                "n_neurons": self.n_neurons,
                "n_hidden_layers": self.n_hidden_layers,
                "activation": "ReLU",
                "output_activation": "None",
            },
            "optimizer": optimizer,
            "precision": self.precision,
            "loss_scale": self.loss_scale,
        }
        if self.gradient_clipping > 0.0:
            config["gradient_clipping"] = {"global_norm": self.gradient_clipping}
        return config


class NpmGuide(Guide):
    """See the module.

    Args:
        settings: What is chosen.
        seed: Of the network.
    """

    name = "npm"

    def __init__(self, settings: NpmSettings, seed: int = 0):
        s = self.settings = settings
        self.seed, self.bsdf_share, self.weighted = seed, s.bsdf_share, s.sample_weighting
        self.target = PRODUCT if s.product else RADIANCE_COSINE if s.cosine_aware else RADIANCE
        self.mixture = make_vmf_mixture(s.n_lobes, s.direction)
        self.key = (s.product, s.cosine_aware, s.learned_share, s.n_lobes, s.direction)
        self.inputs = ("transmits", *(("roughness",) if s.product else ()))
        fields = ["position", "wo", "normal", "wi", "pdf", "guide_pdf", "survival", "radiance", *self.inputs]
        fields += [name for name, used in (("weight", s.product), ("bsdf_pdf", s.vertex_loss)) if used]
        fields += ["taken"] if s.whole_emission else []
        self.records = RecordRequest(tuple(fields), depth=s.record_depth)
        self.passes, self.record_count, self.loss = 0, 0, math.nan

    def bind(self, scene, device_scene, features, device):
        s, self.device = self.settings, device
        pixels, depth = scene.film.window.width * scene.film.window.height, scene.integrator.max_depth - 1
        self.most_records = min(pixels * min(depth, s.record_depth), self.records.memory // LEAST_RECORD)
        low, high = np.asarray(device_scene.bounds, np.float64)
        extent = np.where(high > low, high - low, 1.0)
        self.unit_cube = wp.vec3(*low), wp.vec3(*(1.0 / extent))
        self.model = Model.from_config(
            s.model(), s.n_inputs, s.n_outputs, device=device, seed=self.seed, threads=self.threads
        )
        self.kernels = npm_kernels.make_kernels(
            s.product, s.cosine_aware, s.learned_share, features.sampler, self.mixture
        )
        self.weigh_records, self.gather_batch = npm_kernels.make_training(
            s.product, s.mis_aware, s.product_cosine, s.vertex_loss, s.whole_emission
        )
        cells = 2 * s.brightness_cells**3 + 2
        self.cells = wp.zeros(cells if s.brightness_cells else 1, dtype=wp.float64, device=device)
        self.kl_loss = self.mixture.kl_loss
        if s.vertex_loss:
            self.kl_loss = npm_kernels.make_vertex_loss(
                self.mixture, s.cosine_aware, s.product_cosine, s.mis_aware, s.learned_share, s.bsdf_share
            )
        self.account = wp.zeros(2, dtype=wp.int64, device=device)  # passes, records
        self.batch, self.weights = (wp.zeros(0, dtype=wp.float32, device=device) for _ in range(2))

    def modules(self):
        training = self.weigh_records, self.gather_batch, npm_kernels.sum_brightness
        return [kernel.module for kernel in (*self.kernels, *training)]

    def make_state(self, context):
        return NpmState(self, context)

    def bytes_per_slot(self):
        mixture = 6 * 4 * self.settings.n_lobes
        return 4 * (self.settings.n_inputs + self.settings.n_outputs) + mixture

    def nbytes(self):
        learned = self.model.gradients.capacity + sum(array.capacity for array in self.arrays().values())
        columns = self.settings.n_inputs + self.settings.n_targets + 2 * self.model.encoding.stride  # and its gradient
        return learned + 4 * self.most_records + 4 * columns * -(-self.most_records // self.settings.steps_per_spp)

    # --- training --------------------------------------------------------------------------------------------------

    def trains(self, progress):
        return progress < self.settings.train_share

    def sample_weight(self, progress):
        share = self.settings.train_share
        if not self.settings.sample_weighting or progress >= share:
            return 1.0
        return max(progress / share, MIN_SAMPLE_WEIGHT)

    def train(self, records: Records):
        s, n = self.settings, records.count
        steps = min(s.steps_per_spp, n)
        arrays = RecordArrays()
        for name in self.records.fields:
            setattr(arrays, name, getattr(records, name))
        if self.weights.size < n:
            self.weights = wp.empty(n, dtype=wp.float32, device=self.device)
        self._launch(self.weigh_records, n, [arrays, s.bsdf_share], [self.weights])
        if s.brightness_cells:
            inputs = [records.position, self.weights, *self.unit_cube, s.brightness_cells]
            self._launch(npm_kernels.sum_brightness, n, inputs, [self.cells])
        for k in range(steps):
            count = len(range(k, n, steps))
            x, target = self._batch(count)
            inputs = [arrays, self.weights, self.cells, s.brightness_cells, k, steps, *self.unit_cube]
            self._launch(self.gather_batch, count, inputs, [x, target])
            last = k == steps - 1
            loss = self.model.train_step(x, target, loss=self.kl_loss, report=last)
        if steps:
            self.loss = loss * s.n_outputs  # the network's loss is a mean over its outputs
        self.passes += 1
        self.record_count += n
        self.account.assign(np.array([self.passes, self.record_count], np.int64))

    def _launch(self, kernel: wp.Kernel, count: int, inputs: list, outputs: list) -> None:
        if count:
            wp.launch(kernel, dim=count, inputs=inputs, outputs=outputs, device=self.device)

    def _batch(self, count: int) -> tuple[wp.array, wp.array]:
        """Inputs and targets of a batch, in storage that grows to the largest so far."""
        widths = self.settings.n_inputs, self.settings.n_targets
        if self.batch.size < count * sum(widths):
            self.batch = wp.empty(count * sum(widths), dtype=wp.float32, device=self.device)
        split = count * widths[0]
        x = self.batch[:split].reshape((count, widths[0]))
        return x, self.batch[split : split + count * widths[1]].reshape((count, widths[1]))

    # --- accounts --------------------------------------------------------------------------------------------------

    def identity(self):
        return {"seed": self.seed} | msgspec.structs.asdict(self.settings)

    def arrays(self):
        network = {"parameters": self.model.parameters, **self.model.optimizer.arrays()}
        learned = network | {"account": self.account, "brightness": self.cells}
        return {name: array for name, array in learned.items() if array.size}

    def restored(self):
        self.passes, self.record_count = (int(value) for value in self.account.numpy())

    def progress(self):
        return f"loss {self.loss:.4g}, step {self.model.statistics['steps']}" if self.passes else ""

    def statistics(self):
        loss = None if math.isnan(self.loss) else self.loss
        network = self.model.statistics
        return {
            "training_passes": self.passes,
            "steps": network["steps"],
            "records": self.record_count,
            "loss": loss,
            "skipped_batches": network["skipped_batches"],
            "parameters": self.model.n_params,
        }

    def query(self, vertex: GuideVertex, directions: np.ndarray) -> np.ndarray:
        s = self.settings
        fill_inputs, evaluate_query = npm_kernels.make_query(s.product, s.cosine_aware, self.mixture)
        x = wp.zeros((1, s.n_inputs), dtype=wp.float32, device=self.device)
        position, normal, wo = (wp.vec3(*map(float, v)) for v in (vertex.position, vertex.normal, vertex.wo))
        through = int(vertex.transmits)
        wp.launch(
            fill_inputs,
            dim=1,
            inputs=[position, normal, wo, vertex.roughness, through, *self.unit_cube],
            outputs=[x],
            device=self.device,
        )
        raw = self.model.inference(x).flatten()
        w = wp.array(np.asarray(directions, np.float32), dtype=wp.vec3, device=self.device)
        pdfs = wp.empty(w.shape[0], dtype=wp.float32, device=self.device)
        wp.launch(
            evaluate_query, dim=w.shape[0], inputs=[raw, normal, wo, through, w], outputs=[pdfs], device=self.device
        )
        return pdfs.numpy()


class NpmState(GuideState):
    """The mixtures of a worker's vertices."""

    def __init__(self, guide: NpmGuide, context: GuideContext):
        s, self.guide, self.c = guide.settings, guide, context
        self.x = wp.zeros((context.capacity, s.n_inputs), dtype=wp.float32, device=context.device)
        self.raw = wp.zeros((context.capacity, s.n_outputs), dtype=wp.float32, device=context.device)
        self.mixtures = wp.zeros(context.capacity, dtype=guide.mixture.Mixture, device=context.device)
        share = min(s.bsdf_share, 1.0 - 1e-6)
        self.share_offset = math.log(share / (1.0 - share))

    def _launch(self, kernel: wp.Kernel, count: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=count, inputs=inputs, outputs=outputs, device=self.c.device)

    def prepare(self, guided: Queue, count: int):
        c, (gather, decode, _, _) = self.c, self.guide.kernels
        x, raw = self.x[:count], self.raw[:count]
        self._launch(gather, count, [c.paths, c.surfaces, c.proposals, guided, *self.guide.unit_cube], [x])
        self.guide.model.inference(x, raw, threads=1)
        inputs = [c.paths, c.surfaces, guided, raw, self.raw.flatten(), self.share_offset]
        self._launch(decode, count, inputs, [self.mixtures, c.proposals])

    def propose(self, proposed: Queue, count: int, round: int):
        c = self.c
        inputs = [c.paths, proposed, self.mixtures, c.seed, c.counters]
        self._launch(self.guide.kernels[2], count, inputs, [c.proposals])

    def evaluate(self, queue: Queue, count: int, directions: wp.array, pdfs: wp.array, purpose: str):
        self._launch(self.guide.kernels[3], count, [queue, self.mixtures, directions], [pdfs])
