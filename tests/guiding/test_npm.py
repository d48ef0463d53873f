"""Neural parametric mixtures away from a renderer: targets, loss, and learning what is known.

The oracle of mixtures is `tests.guiding.vmf_oracle`, in float64.
"""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from guiding.distributions.vmf import COSINE_KAPPA
from guiding.distributions.vmf_mixture import make_vmf_mixture
from guiding.npm import NpmGuide, NpmSettings
from guiding.npm_kernels import make_training, make_vertex_loss
from nn import Model
from tests.guiding import vmf_oracle as oracle
from wavefront.guide import GuideVertex
from wavefront.recording import FIELDS, RecordArrays, Recorder, Records
from wavefront.scene import description as d

DEVICE = "cpu"
BOUNDS = np.array([[-1.0, 0.0, 2.0], [3.0, 1.0, 2.5]])


def bound(**settings) -> NpmGuide:
    """A guide without a renderer, over `BOUNDS`."""
    guide = NpmGuide(NpmSettings(**settings), seed=3)
    scene = d.Scene(film=d.Film(width=64, height=64), integrator=d.PathIntegrator(max_depth=5))
    guide.bind(scene, SimpleNamespace(bounds=BOUNDS), SimpleNamespace(sampler="independent"), DEVICE)
    return guide


def unit(rng, n) -> np.ndarray:
    return oracle.unit(rng.normal(size=(n, 3)))


def made_records(n: int, rng, **columns) -> dict[str, np.ndarray]:
    """Random records, or those given."""
    made = {
        "position": BOUNDS[0] + rng.random((n, 3)) * (BOUNDS[1] - BOUNDS[0]),
        "wo": unit(rng, n),
        "normal": unit(rng, n),
        "wi": unit(rng, n),
        "pdf": rng.uniform(0.1, 2.0, n),
        "guide_pdf": rng.uniform(0.0, 2.0, n) * (rng.random(n) > 0.2),
        "bsdf_pdf": rng.uniform(0.0, 2.0, n),
        "roughness": rng.random(n),
        "transmits": rng.integers(0, 2, n),
        "weight": rng.random((n, 3)),
        "survival": rng.uniform(0.2, 1.0, n),
        "radiance": rng.exponential(size=(n, 3)),
        "taken": rng.exponential(size=(n, 3)),
        "pixel": np.zeros(n, int),
        "depth": np.zeros(n, int),
    } | columns
    return made


def on_device(made: dict[str, np.ndarray]) -> dict[str, wp.array]:
    return {
        name: wp.array(np.ascontiguousarray(made[name], np.int32 if dtype is wp.int32 else np.float32), dtype=dtype)
        for name, dtype in FIELDS.items()
    }


def records_of(made) -> Records:
    n = len(made["pdf"])
    return Records(count=n, path_count=n, camera=wp.zeros(n, dtype=wp.vec3, device=DEVICE), **on_device(made))


# --- targets ---------------------------------------------------------------------------------------------------------


def cosine_axis(made) -> np.ndarray:
    facing = np.where(np.sum(made["normal"] * made["wo"], axis=1) < 0.0, -1.0, 1.0)[:, None] * made["normal"]
    return np.where(made["transmits"][:, None] == 1, 0.0, facing)


OPTIONS = [
    o
    for o in itertools.product((False, True), repeat=5)
    if not o[2] or o[3]  # the product with the cosine has a loss that knows the vertex
]


@pytest.mark.parametrize(
    ("product", "mis_aware", "product_cosine", "vertex_loss", "whole_emission"), OPTIONS[::2] + OPTIONS[1::4]
)
def test_targets(product, mis_aware, product_cosine, vertex_loss, whole_emission):
    """Inputs and weights by their definitions, of every third record."""
    n, first, stride, share = 200, 2, 3, 0.3
    made = made_records(n, np.random.default_rng(1))
    arrays = RecordArrays()
    for name, array in on_device(made).items():
        setattr(arrays, name, array)
    rows = range(first, n, stride)
    x = wp.zeros((len(rows), 9 if product else 3), dtype=wp.float32, device=DEVICE)
    target = wp.zeros((len(rows), 8), dtype=wp.float32, device=DEVICE)
    weigh, gather = make_training(product, mis_aware, product_cosine, vertex_loss, whole_emission)
    weights, cells = wp.zeros(n, dtype=wp.float32, device=DEVICE), wp.zeros(1, dtype=wp.float64, device=DEVICE)
    wp.launch(weigh, dim=n, inputs=[arrays, share], outputs=[weights], device=DEVICE)
    origin, scale = wp.vec3(*BOUNDS[0]), wp.vec3(*(1.0 / (BOUNDS[1] - BOUNDS[0])))
    inputs = [arrays, weights, cells, 0, first, stride, origin, scale]
    wp.launch(gather, dim=len(rows), inputs=inputs, outputs=[x, target], device=DEVICE)

    m = {name: values[first::stride] for name, values in made.items()}
    expected = [(m["position"] - BOUNDS[0]) / (BOUNDS[1] - BOUNDS[0])]
    if product:
        flip = (m["transmits"] == 0) & (np.sum(m["normal"] * m["wo"], axis=1) < 0.0)
        normal = np.where(flip[:, None], -m["normal"], m["normal"])
        angles = np.arccos(normal[:, 2]) / np.pi, np.arctan2(normal[:, 1], normal[:, 0]) / (2.0 * np.pi) % 1.0
        expected += [0.5 + 0.5 * m["wo"], np.stack([*angles, 1.0 - np.exp(-m["roughness"])], axis=1)]
    np.testing.assert_allclose(x.numpy(), np.concatenate(expected, axis=1), atol=1e-6)

    # The function that is learned over the density of the direction, before the part of the guide.
    L = m["radiance"] + (m["taken"] if whole_emission else 0.0)
    cosine = np.abs(np.sum(m["normal"] * m["wi"], axis=1))
    if product:
        L = m["weight"] * m["pdf"][:, None] / cosine[:, None] * L  # f Li
    weight = L.mean(axis=1) * (cosine if product_cosine else 1.0) / m["pdf"] / m["survival"]
    if mis_aware and not vertex_loss:
        weight *= (1.0 - share) * m["guide_pdf"] / m["pdf"]
    elif mis_aware:
        weight *= m["guide_pdf"] > 0.0
    got = target.numpy()
    np.testing.assert_allclose(got[:, :3], m["wi"], atol=1e-7)
    np.testing.assert_allclose(got[:, 3], weight, rtol=2e-5)
    if vertex_loss:
        np.testing.assert_allclose(got[:, 4:7], cosine_axis(m), atol=1e-7)
        np.testing.assert_allclose(got[:, 7], m["bsdf_pdf"], rtol=1e-6)


def test_brightness():
    """Weights are divided by the mean weight of the records of their cell so far, of 16 more that have that of all."""
    R, n = 4, 3000
    guide = bound(product=False, mis_aware=False, brightness_cells=R, **SMALL)
    sums, counts = np.zeros(R**3), np.zeros(R**3)
    batches = []
    step = guide.model.train_step

    def train_step(x, target, **options):
        batches.append(target.numpy().copy())
        return step(x, target, **options)

    guide.model.train_step = train_step
    for seed in (1, 2):
        made = made_records(n, np.random.default_rng(seed))
        guide.train(records_of(made))
        weight = made["radiance"].mean(axis=1) / made["pdf"] / made["survival"]
        index = np.floor((made["position"] - BOUNDS[0]) / (BOUNDS[1] - BOUNDS[0]) * R).astype(int)
        cell = (index[:, 0] * R + index[:, 1]) * R + index[:, 2]
        np.add.at(sums, cell, weight)
        np.add.at(counts, cell, 1.0)
        mean = (sums + 16.0 * sums.sum() / counts.sum()) / (counts + 16.0)
        steps = guide.settings.steps_per_spp
        for k, batch in enumerate(batches[-steps:]):
            np.testing.assert_allclose(batch[:, 3], (weight / mean[cell])[k::steps], rtol=1e-4)


# --- the loss --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("learned_share", [False, True])
@pytest.mark.parametrize("product_cosine", [False, True])
def test_vertex_loss_is_that_of_the_mixture_of_techniques(product_cosine, learned_share):
    """-weight log(share p_bsdf + (1 - share) g) and its gradient, by complex steps in float64.

    Without `product_cosine` the mixture alone is trained while g is its product with the cosine: the gradient of g is
    then replaced by that of the mixture, at the same weight.
    """
    K, n, share = 3, 60, 0.35
    rng = np.random.default_rng(5)
    mixture = make_vmf_mixture(K, "vector")
    loss = make_vertex_loss(mixture, True, product_cosine, True, learned_share, share)
    P = mixture.n_params + learned_share
    y = rng.normal(size=(n, P)).astype(np.float32)
    axis = np.where(rng.random(n)[:, None] < 0.3, 0.0, unit(rng, n))
    target = np.concatenate([unit(rng, n), rng.exponential(size=(n, 1)), axis, rng.uniform(0.0, 1.0, (n, 1))], axis=1)
    target = target.astype(np.float32)
    target[:3, 3] = 0.0

    @wp.kernel(enable_backward=False, module="unique")
    def run(
        y: wp.array[wp.float32],
        target: wp.array2d[wp.float32],
        factor: float,
        # out
        values: wp.array[wp.float32],
        dL_dy: wp.array[wp.float32],
    ):
        i = wp.tid()
        values[i] = loss(y, i * P, target, i, factor, dL_dy, i * P)

    values, dL_dy = (wp.full(size, 7.0, dtype=wp.float32, device=DEVICE) for size in (n, n * P))
    flat = wp.array(y.ravel(), dtype=wp.float32, device=DEVICE)
    inputs = [flat, wp.array(target, dtype=wp.float32, device=DEVICE), 2.0]
    wp.launch(run, dim=n, inputs=inputs, outputs=[values, dL_dy], device=DEVICE)

    t = target.astype(np.float64)
    w, weight, p_bsdf = t[:, :3], t[:, 3], t[:, 7]
    kappa = np.where(np.abs(t[:, 4:7]).sum(axis=1) > 0.0, float(COSINE_KAPPA), 0.0)
    axis = np.where(kappa[:, None] > 0.0, t[:, 4:7], [0.0, 0.0, 1.0])
    raw = y[:, : mixture.n_params].astype(np.float64)
    s = np.full(n, share)
    if learned_share:
        s = 1.0 / (1.0 + np.exp(-y[:, -1].astype(np.float64)) * (1.0 - share) / share)
    decoded = oracle.decode(raw, "vector")
    g = np.exp(oracle.product_log_pdf(decoded, w, axis, kappa))
    q = s * p_bsdf + (1.0 - s) * g
    np.testing.assert_allclose(values.numpy(), -weight * np.log(q), rtol=1e-4, atol=1e-5)

    def log_v(m):
        return oracle.product_log_pdf(m, w, axis, kappa) if product_cosine else oracle.log_pdf(m, w)

    part = (1.0 - s) * g / q
    expected = -2.0 * (weight * part)[:, None] * oracle.gradient(log_v, raw, "vector")
    if learned_share:
        slope = -2.0 * weight * s * (1.0 - s) * (p_bsdf - g) / q
        expected = np.concatenate([expected, slope[:, None]], axis=1)
    np.testing.assert_allclose(dL_dy.numpy().reshape(n, P), expected, rtol=1e-3, atol=2e-5)


# --- learning --------------------------------------------------------------------------------------------------------


def field(position: np.ndarray):
    """Mixtures of two lobes that turn, open and fade with the position, and how bright they are."""
    x, y, z = np.moveaxis((position - BOUNDS[0]) / (BOUNDS[1] - BOUNDS[0]), -1, 0)
    turn = 2.0 + 2.5 * x
    first = np.stack([np.cos(turn), np.sin(turn), 0.6 * y - 0.2], axis=-1)
    second = np.stack([0.3 + 0.0 * x, -0.5 * z, 0.8 - 1.2 * x], axis=-1)
    log_weight = np.log(np.stack([0.3 + 0.4 * y, 0.7 - 0.4 * y], axis=-1))
    kappa = np.stack([np.exp(1.0 + 2.5 * z), np.exp(3.0 - x)], axis=-1)
    mu = oracle.unit(np.stack([first, second], axis=-2))
    return (log_weight, kappa, mu), 1.0 + 2.0 * x


def learning_records(rng, n: int) -> dict[str, np.ndarray]:
    """Directions that are drawn uniformly, and what arrives there."""
    made = made_records(n, rng)
    mixture, brightness = field(made["position"])
    L = brightness * np.exp(oracle.log_pdf(mixture, made["wi"]))
    cosine = np.abs(np.sum(made["normal"] * made["wi"], axis=1))
    quarter = np.full(n, 1.0 / (4.0 * np.pi))
    return made | {
        "pdf": quarter,
        "guide_pdf": quarter,
        "bsdf_pdf": quarter,
        "survival": np.ones(n),
        "radiance": np.repeat(L[:, None], 3, axis=1),
        "weight": np.repeat((cosine / quarter)[:, None], 3, axis=1),  # f = 1
    }


def divergence(guide: NpmGuide, rng, vertices: int = 40):
    """Mean KL(field || guide) over random vertices, and mean brightness times (KL + entropy)."""
    w, area = oracle.quadrature((0.0, 0.0, 1.0), 2.0, 64, 128)
    kls, losses = [], []
    for _ in range(vertices):
        position = BOUNDS[0] + rng.random(3) * (BOUNDS[1] - BOUNDS[0])
        vertex = GuideVertex(position, unit(rng, 1)[0], unit(rng, 1)[0], roughness=rng.random())
        v = guide.query(vertex, w).astype(np.float64)
        assert abs(v @ area - 1.0) < 2e-3, "the density integrates to one"
        mixture, brightness = field(position[None])
        repeated = [np.repeat(part, len(w), axis=0) for part in mixture]
        log_p = oracle.log_pdf(repeated, w)
        p = np.exp(log_p)
        kls.append((p * (log_p - np.log(v))) @ area)
        losses.append(brightness[0] * -((p * np.log(v)) @ area))
    return np.mean(kls), np.array(losses)


SMALL = {"n_levels": 3, "n_features": 2, "base_resolution": 4, "per_level_scale": 2.0, "n_hidden_layers": 2}


@pytest.mark.parametrize("product", [False, True])
@pytest.mark.parametrize("direction", ["angles", "vector"])
def test_a_known_field_is_learned(product, direction):
    """To a divergence of 0.05 from more than 0.5, and the loss is the divergence up to the entropy: within 5 standard
    errors, of both."""
    rng = np.random.default_rng(7)
    guide = bound(
        product=product,
        direction=direction,
        cosine_aware=False,
        mis_aware=False,
        steps_per_spp=8,
        n_lobes=4,
        ema=0.99,
        **SMALL,
    )
    before, _ = divergence(guide, rng, 10)
    assert before > 0.5
    for _ in range(100):
        guide.train(records_of(learning_records(rng, 1 << 14)))
    after, losses = divergence(guide, rng)
    assert after < 0.05

    # The loss of fresh records, by the parameters that directions are drawn with.
    n = 1 << 16
    arrays = RecordArrays()
    for name, array in on_device(learning_records(rng, n)).items():
        setattr(arrays, name, array)
    x, target = guide._batch(n)
    weights = wp.zeros(n, dtype=wp.float32, device=DEVICE)
    wp.launch(guide.weigh_records, dim=n, inputs=[arrays, 0.5], outputs=[weights], device=DEVICE)
    inputs = [arrays, weights, guide.cells, 0, 0, 1, *guide.unit_cube]
    wp.launch(guide.gather_batch, dim=n, inputs=inputs, outputs=[x, target], device=DEVICE)
    wp.copy(guide.model.parameters, guide.model.inference_parameters)
    loss = guide.model.compute_gradients(x, target, guide.kl_loss) * guide.settings.n_outputs
    per_record = np.std(target.numpy()[:, 3]) * np.log(4.0 * np.pi) / np.sqrt(n)
    error = np.hypot(losses.std() / np.sqrt(len(losses)), per_record)
    assert abs(loss - losses.mean()) < 5.0 * error


@pytest.mark.parametrize("product", [False, True])
@pytest.mark.parametrize(("width", "depth"), [(64, 4), (64, 12), (4096, 12)])
def test_memory_of_training(product, width, depth):
    """No pass has more records than the memory is planned for."""
    guide = NpmGuide(NpmSettings(product=product, **SMALL), seed=3)
    scene = d.Scene(film=d.Film(width=width, height=width), integrator=d.PathIntegrator(max_depth=depth))
    guide.bind(scene, SimpleNamespace(bounds=BOUNDS), SimpleNamespace(sampler="independent"), DEVICE)
    recorder = Recorder(guide.records, depth, width, width, DEVICE)
    assert recorder.rows.count * recorder.rows.depth <= guide.most_records
    assert guide.nbytes() < 1 << 30


def test_zero_and_one_record():
    guide = bound(product=True, **SMALL)
    guide.train(records_of(made_records(0, np.random.default_rng(1))))
    assert guide.passes == 1 and guide.record_count == 0 and guide.model.statistics["steps"] == 0
    guide.train(records_of(made_records(1, np.random.default_rng(1))))
    assert guide.model.statistics["steps"] == 1, "no more batches than records"
    assert np.isfinite(guide.model.parameters.numpy()).all()
    assert guide.statistics()["records"] == 1


def test_steps_and_batches():
    """A fixed number of steps per pass; every record is in one batch."""
    guide = bound(product=False, steps_per_spp=5, **SMALL)
    counts = []
    step = guide.model.train_step
    guide.model.train_step = lambda x, target, **options: counts.append(x.shape[0]) or step(x, target, **options)
    for n in (1003, 12):
        guide.train(records_of(made_records(n, np.random.default_rng(2))))
    assert counts == [201, 201, 201, 200, 200, 3, 3, 2, 2, 2]


@pytest.mark.parametrize("product", [False, True])
def test_model_is_the_published_one(product):
    """Parameters of the grid and sizes of the layers, worked out by hand."""
    guide = NpmGuide(NpmSettings(product=product))
    s = guide.settings
    model = Model.from_config(s.model(), s.n_inputs, s.n_outputs, device=DEVICE, seed=0)
    resolutions = [int(np.ceil(8 * 1.405**level - 1.0)) + 1 for level in range(8)]
    assert resolutions[0] == 8 and resolutions[-1] == 87
    features = 32 + (4 + 3 * 4 if product else 0)
    weights = features * 64 + 2 * 64 * 64 + 64 * 32
    assert model.n_matrix_params == weights
    grid = sum(-(-(r**3) // 8) * 8 for r in resolutions) * 4
    assert abs(model.n_params - weights - grid) < 8 * 4 * 8
