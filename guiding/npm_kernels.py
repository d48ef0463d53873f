"""Kernels and loss of neural parametric mixtures: see `guiding.npm`."""

import functools
import math

import warp as wp

from guiding.distributions.vmf import COSINE_KAPPA
from guiding.distributions.vmf_mixture import VmfMixture
from nn.activations import sigmoid
from wavefront.proposals import Proposals
from wavefront.queues import DEPTH, Paths, Queue, Surfaces, queue_size
from wavefront.recording import RecordArrays
from wavefront.rng import PURPOSE_GUIDE
from wavefront.sampler import SAMPLERS
from wavefront.stage_kernel import stage_kernel

_INV_PI = wp.constant(1.0 / math.pi)
_SMALLEST_COSINE = wp.constant(1.0e-4)  # f = (f cos) / cos is not known below; such records do not train
_PRIOR = wp.constant(16.0)  # records


@wp.func
def cosine_axis(normal: wp.vec3, wo: wp.vec3, through: int) -> wp.vec3:
    """The axis of the cosine lobe: the normal on the side of wo; zero, for no lobe, where light comes from both."""
    if through != 0:
        return wp.vec3(0.0)
    return wp.where(wp.dot(normal, wo) < 0.0, -normal, normal)


@wp.func
def cosine_kappa(axis: wp.vec3) -> float:
    return wp.where(wp.dot(axis, axis) > 0.5, COSINE_KAPPA, 0.0)


@functools.cache
def make_write_inputs(product: bool):
    """`write_inputs(x, row, position, normal, wo, roughness, through, origin, scale)`: a row of inputs, in [0, 1]."""

    @wp.func
    def write_inputs(
        x: wp.array2d[wp.float32],
        row: int,
        position: wp.vec3,
        normal: wp.vec3,
        wo: wp.vec3,
        roughness: float,
        through: int,
        origin: wp.vec3,
        scale: wp.vec3,
    ):
        for i in range(3):
            x[row, i] = wp.clamp((position[i] - origin[i]) * scale[i], 0.0, 1.0)
        if wp.static(product):
            n = normal  # on the side of wo, unless both sides count
            if through == 0 and wp.dot(n, wo) < 0.0:
                n = -n
            for i in range(3):
                x[row, 3 + i] = 0.5 + 0.5 * wo[i]
            turn = 0.5 * _INV_PI * wp.atan2(n[1], n[0])
            x[row, 6] = _INV_PI * wp.acos(wp.clamp(n[2], -1.0, 1.0))
            x[row, 7] = turn - wp.floor(turn)
            x[row, 8] = 1.0 - wp.exp(-roughness)

    return write_inputs


@functools.cache
def make_kernels(product: bool, cosine_aware: bool, learned_share: bool, sampler: str, mixture: VmfMixture):
    """Kernels of the state: `gather_vertices`, `decode_mixtures`, `draw_directions` and `evaluate_directions`."""
    write_inputs = make_write_inputs(product)
    decode, multiply, pdf, sample = mixture.decode, mixture.multiply, mixture.pdf, mixture.sample
    n_params = mixture.n_params
    Mixture = mixture.Mixture
    draw = SAMPLERS[sampler]

    @stage_kernel
    def gather_vertices(
        paths: Paths,
        surfaces: Surfaces,
        proposals: Proposals,
        guided: Queue,
        origin: wp.vec3,
        scale: wp.vec3,
        # out
        x: wp.array2d[wp.float32],
    ):
        i = wp.tid()
        if i >= queue_size(guided):
            return
        slot = guided.slots[i]
        wo = -paths.direction[slot]
        normal = surfaces.shading_normal[slot]
        roughness = float(0.0)
        if wp.static(product):
            roughness = proposals.roughness[slot]
        write_inputs(x, i, surfaces.position[slot], normal, wo, roughness, proposals.transmits[slot], origin, scale)

    @stage_kernel
    def decode_mixtures(
        paths: Paths,
        surfaces: Surfaces,
        guided: Queue,
        raw: wp.array2d[wp.float32],
        flat: wp.array[wp.float32],  # the same
        share_offset: float,
        # out
        mixtures: wp.array[Mixture],
        proposals: Proposals,
    ):
        i = wp.tid()
        if i >= queue_size(guided):
            return
        slot = guided.slots[i]
        m = decode(flat, i * raw.shape[1])
        if wp.static(cosine_aware):
            axis = cosine_axis(surfaces.shading_normal[slot], -paths.direction[slot], proposals.transmits[slot])
            kappa = cosine_kappa(axis)
            if kappa > 0.0:
                m = multiply(m, axis, kappa)
        mixtures[slot] = m
        if wp.static(learned_share):
            proposals.share[slot] = sigmoid(share_offset + raw[i, n_params])

    @stage_kernel
    def draw_directions(
        paths: Paths,
        proposed: Queue,
        mixtures: wp.array[Mixture],
        seed: wp.uint64,
        counters: wp.array[wp.int32],
        # out
        proposals: Proposals,
    ):
        i = wp.tid()
        if i >= queue_size(proposed):
            return
        slot = proposed.slots[i]
        u = draw(seed, paths.pixel[slot], paths.sample[slot], counters[DEPTH], PURPOSE_GUIDE)
        proposals.wi[slot] = sample(mixtures[slot], wp.vec3(u[0], u[1], u[2]))

    @stage_kernel
    def evaluate_directions(
        queue: Queue,
        mixtures: wp.array[Mixture],
        directions: wp.array[wp.vec3],
        # out
        pdfs: wp.array[wp.float32],
    ):
        i = wp.tid()
        if i >= queue_size(queue):
            return
        slot = queue.slots[i]
        pdfs[slot] = pdf(mixtures[slot], directions[slot])

    return gather_vertices, decode_mixtures, draw_directions, evaluate_directions


@functools.cache
def make_training(product: bool, mis_aware: bool, product_cosine: bool, vertex_loss: bool, whole_emission: bool):
    """Kernels of training: `weigh_records` and `gather_batch`; the arguments as in `NpmSettings`."""
    write_inputs = make_write_inputs(product)

    @stage_kernel
    def weigh_records(
        records: RecordArrays,
        bsdf_share: float,
        # out
        weights: wp.array[wp.float32],
    ):
        """Target over the density of the direction, one thread per record; zero if it is not finite."""
        i = wp.tid()
        pdf = records.pdf[i]
        L = records.radiance[i]
        if wp.static(whole_emission):
            L += records.taken[i]
        weight = float(0.0)
        if wp.static(product):  # f |cos| / p is in the record
            L = wp.cw_mul(records.weight[i], L)
            weight = (L[0] + L[1] + L[2]) / 3.0
            if wp.static(not product_cosine):
                cosine = wp.abs(wp.dot(records.normal[i], records.wi[i]))
                weight = wp.where(cosine > _SMALLEST_COSINE, weight / cosine, 0.0)
        else:
            weight = (L[0] + L[1] + L[2]) / (3.0 * pdf)
            if wp.static(product_cosine):
                weight *= wp.abs(wp.dot(records.normal[i], records.wi[i]))
        weight /= records.survival[i]
        if wp.static(mis_aware):
            if wp.static(vertex_loss):  # the loss weighs by what the guide is then
                weight *= wp.where(records.guide_pdf[i] > 0.0, 1.0, 0.0)
            else:
                weight *= (1.0 - bsdf_share) * records.guide_pdf[i] / pdf
        weights[i] = wp.where(wp.isfinite(weight), weight, 0.0)

    @stage_kernel
    def gather_batch(
        records: RecordArrays,
        weights: wp.array[wp.float32],
        cells: wp.array[wp.float64],
        cells_per_axis: int,
        first: int,
        stride: int,
        origin: wp.vec3,
        scale: wp.vec3,
        # out
        x: wp.array2d[wp.float32],
        target: wp.array2d[wp.float32],
    ):
        """Inputs and targets of a batch: every `stride`-th record from `first` on."""
        row = wp.tid()
        i = first + row * stride
        wo = records.wo[i]
        normal = records.normal[i]
        through = records.transmits[i]
        roughness = float(0.0)
        if wp.static(product):
            roughness = records.roughness[i]
        write_inputs(x, row, records.position[i], normal, wo, roughness, through, origin, scale)
        weight = weights[i]
        if cells_per_axis > 0:
            weight /= brightness(cells, cells_per_axis, cell_of(records.position[i], origin, scale, cells_per_axis))
        wi = records.wi[i]
        target[row, 0] = wi[0]
        target[row, 1] = wi[1]
        target[row, 2] = wi[2]
        target[row, 3] = weight
        if wp.static(vertex_loss):
            axis = cosine_axis(normal, wo, through)
            target[row, 4] = axis[0]
            target[row, 5] = axis[1]
            target[row, 6] = axis[2]
            target[row, 7] = records.bsdf_pdf[i]

    return weigh_records, gather_batch


# Brightness: sums of weights and numbers of records, by cell of a grid over the bounds, and of all at the end.


@wp.func
def cell_of(position: wp.vec3, origin: wp.vec3, scale: wp.vec3, cells_per_axis: int) -> int:
    cell = int(0)
    for i in range(3):
        part = int((position[i] - origin[i]) * scale[i] * float(cells_per_axis))
        cell = cell * cells_per_axis + wp.clamp(part, 0, cells_per_axis - 1)
    return cell


@wp.func
def brightness(cells: wp.array[wp.float64], cells_per_axis: int, cell: int) -> float:
    """Mean weight of the records of a cell, of `_PRIOR` more that have the mean of all; 1 where nothing is known."""
    last = 2 * cells_per_axis * cells_per_axis * cells_per_axis
    mean = cells[last] / wp.max(cells[last + 1], wp.float64(1.0))
    prior = wp.float64(_PRIOR)
    value = (cells[2 * cell] + prior * mean) / (cells[2 * cell + 1] + prior)
    return wp.where(value > wp.float64(0.0), wp.float32(value), 1.0)


@stage_kernel
def sum_brightness(
    position: wp.array[wp.vec3],
    weights: wp.array[wp.float32],
    origin: wp.vec3,
    scale: wp.vec3,
    cells_per_axis: int,
    # out
    cells: wp.array[wp.float64],
):
    """Adds all records; one launch on the CPU device, in their order."""
    i = wp.tid()
    weight = wp.float64(weights[i])
    cell = cell_of(position[i], origin, scale, cells_per_axis)
    last = 2 * cells_per_axis * cells_per_axis * cells_per_axis
    wp.atomic_add(cells, 2 * cell, weight)
    wp.atomic_add(cells, 2 * cell + 1, wp.float64(1.0))
    wp.atomic_add(cells, last, weight)
    wp.atomic_add(cells, last + 1, wp.float64(1.0))


@functools.cache
def make_vertex_loss(
    mixture: VmfMixture,
    cosine_aware: bool,
    product_cosine: bool,
    mis_aware: bool,
    learned_share: bool,
    bsdf_share: float,
):
    """A loss for `nn.Model` with targets of 8 columns: -weight log q(w), up to a constant.

    q is the density v(w) that is trained, the mixture or its product with the cosine lobe. With `mis_aware` or
    `learned_share` it stands in a mixture of techniques, share p_bsdf + (1 - share) g, g being the density that
    directions are drawn with: the gradient of log v is then weighted by the guide's part (1 - share) g / q, and the
    share has the gradient of log q.
    """
    decode, multiply, pdf = mixture.decode, mixture.multiply, mixture.pdf
    gradient, product_gradient = mixture.log_pdf_gradient, mixture.product_log_pdf_gradient
    n_params = mixture.n_params
    share_offset = math.log(bsdf_share / (1.0 - bsdf_share)) if bsdf_share < 1.0 else 20.0
    mixed = mis_aware or learned_share

    @wp.func
    def loss(
        y: wp.array[wp.float32],
        y_offset: int,
        target: wp.array2d[wp.float32],
        row: int,
        factor: float,
        dL_dy: wp.array[wp.float32],
        dL_dy_offset: int,
    ) -> float:
        weight = target[row, 3]
        if weight == 0.0:
            for i in range(n_params + wp.static(int(learned_share))):
                dL_dy[dL_dy_offset + i] = 0.0
            return 0.0
        w = wp.vec3(target[row, 0], target[row, 1], target[row, 2])
        axis = wp.vec3(target[row, 4], target[row, 5], target[row, 6])
        kappa = cosine_kappa(axis)
        part = float(1.0)
        log_q = float(0.0)
        if wp.static(mixed):
            m = decode(y, y_offset)
            if wp.static(cosine_aware):
                if kappa > 0.0:
                    m = multiply(m, axis, kappa)
            share = float(bsdf_share)
            if wp.static(learned_share):
                share = sigmoid(share_offset + y[y_offset + n_params])
            guide_pdf = pdf(m, w)
            bsdf_pdf = target[row, 7]
            q = share * bsdf_pdf + (1.0 - share) * guide_pdf
            if not (q > 0.0 and wp.isfinite(q)):
                q = 1.0
                guide_pdf = 0.0
                bsdf_pdf = 0.0
            part = (1.0 - share) * guide_pdf / q
            log_q = wp.log(q)
            if wp.static(learned_share):
                slope = share * (1.0 - share) * (bsdf_pdf - guide_pdf) / q
                dL_dy[dL_dy_offset + n_params] = -weight * factor * slope
        scaled = -weight * factor
        if wp.static(mis_aware):
            scaled *= part
        log_v = float(0.0)
        if wp.static(product_cosine):
            if kappa > 0.0:
                log_v = product_gradient(y, y_offset, axis, kappa, w, scaled, dL_dy, dL_dy_offset)
            else:
                log_v = gradient(y, y_offset, w, scaled, dL_dy, dL_dy_offset)
        else:
            log_v = gradient(y, y_offset, w, scaled, dL_dy, dL_dy_offset)
        return -weight * wp.where(wp.static(mixed), log_q, log_v)

    return loss


@functools.cache
def make_query(product: bool, cosine_aware: bool, mixture: VmfMixture):
    """Kernels for one vertex: `fill_inputs`, and `evaluate_query` with a thread per direction."""
    write_inputs = make_write_inputs(product)
    decode, multiply, pdf = mixture.decode, mixture.multiply, mixture.pdf

    @stage_kernel
    def fill_inputs(
        position: wp.vec3,
        normal: wp.vec3,
        wo: wp.vec3,
        roughness: float,
        through: int,
        origin: wp.vec3,
        scale: wp.vec3,
        # out
        x: wp.array2d[wp.float32],
    ):
        write_inputs(x, 0, position, normal, wo, roughness, through, origin, scale)

    @stage_kernel
    def evaluate_query(
        raw: wp.array[wp.float32],
        normal: wp.vec3,
        wo: wp.vec3,
        through: int,
        directions: wp.array[wp.vec3],
        # out
        pdfs: wp.array[wp.float32],
    ):
        m = decode(raw, 0)
        if wp.static(cosine_aware):
            axis = cosine_axis(normal, wo, through)
            kappa = cosine_kappa(axis)
            if kappa > 0.0:
                m = multiply(m, axis, kappa)
        pdfs[wp.tid()] = pdf(m, directions[wp.tid()])

    return fill_inputs, evaluate_query
