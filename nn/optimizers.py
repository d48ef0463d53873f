"""Optimisers: Adam and SGD, EMA and learning-rate decay around them, clipping, loss scaling, and skipped batches.

One step is two kernels and nothing is read back: `measure` sums the squares of all gradients, `decide` turns them and
the device's own state into the factors of this step, and `step` updates parameters, moments and average in one pass and
clears the gradients. A batch with a gradient that is not finite changes nothing but its counter.

Adam keeps a step count per parameter, as the schema's home does, so that an entry of a grid which is seldom met is
corrected for its own few steps. Steps of the average and of the decay count whole batches.
"""

import functools
import math

import numpy as np
import warp as wp

from nn import config as c

# Entries of the state.
STEP, SKIPPED, LOSS_SCALE, GOOD_STEPS, LEARNING_RATE, GRADIENT_FACTOR, SKIP, EMA_OLD, EMA_NEW, NORM, LOW, HIGH = range(
    12
)
STATE_SIZE = 12
N_RANGES = 64  # of gradients whose squares are summed apart; fixed, so that sums do not depend on threads
N_STRIDED = 1 << 14  # of them on a GPU, each of every so many-th gradient
GROWTH_INTERVAL = 2000.0
LARGEST_LOSS_SCALE = 2.0**24
SMALLEST_LOSS_SCALE = 2.0**-24

wp.set_module_options({"enable_backward": False})


@wp.struct
class Hyperparameters:
    """What a step needs; see `nn.config`."""

    learning_rate: wp.float32
    beta1: wp.float32
    beta2: wp.float32
    epsilon: wp.float32
    l2_reg: wp.float32
    relative_decay: wp.float32
    absolute_decay: wp.float32
    adabound: wp.int32
    clipping_magnitude: wp.float32
    non_matrix_factor: wp.float32
    optimize_matrix: wp.int32
    optimize_non_matrix: wp.int32
    n_matrix: wp.int32  # parameters before this index belong to matrices
    n_corrections: wp.int32
    ema_decay: wp.float32
    decay_base: wp.float64
    decay_start: wp.float64
    decay_end: wp.float64
    decay_interval: wp.float64
    max_norm: wp.float64
    dynamic_scale: wp.int32
    adam: wp.int32


@wp.kernel
def measure(gradients: wp.array[wp.float32], first_range: int, sums: wp.array[wp.float64]):
    """Sum of squares of a range of the gradients, not finite if one of them is not; one thread per range."""
    part = first_range + wp.tid()
    n = wp.int64(gradients.shape[0])
    i = wp.int32(n * wp.int64(part) / wp.int64(N_RANGES))
    end = wp.int32(n * wp.int64(part + 1) / wp.int64(N_RANGES))
    a = wp.float64(0.0)
    b = wp.float64(0.0)
    while i + 1 < end:
        g = wp.float64(gradients[i])
        h = wp.float64(gradients[i + 1])
        a += g * g
        b += h * h
        i += 2
    if i < end:
        g = wp.float64(gradients[i])
        a += g * g
    sums[part] = a + b


@wp.kernel
def measure_strided(gradients: wp.array[wp.float32], sums: wp.array[wp.float64]):
    """As `measure`, of every so many-th gradient, so that neighbouring threads read neighbours."""
    total = wp.float64(0.0)
    i = wp.tid()
    while i < gradients.shape[0]:
        g = wp.float64(gradients[i])
        total += g * g
        i += wp.static(N_STRIDED)
    sums[wp.tid()] = total


@wp.kernel
def decide(sums: wp.array[wp.float64], h: Hyperparameters, state: wp.array[wp.float64]):
    """Advances the state by one batch; one thread."""
    total = wp.float64(0.0)
    for i in range(sums.shape[0]):
        total += sums[i]
    scale = state[LOSS_SCALE]
    norm = wp.sqrt(total) / scale
    state[NORM] = norm
    if not wp.isfinite(total):
        state[SKIP] = wp.float64(1.0)
        state[SKIPPED] = state[SKIPPED] + wp.float64(1.0)
        state[GOOD_STEPS] = wp.float64(0.0)
        if h.dynamic_scale != 0:
            state[LOSS_SCALE] = wp.max(scale * wp.float64(0.5), wp.float64(SMALLEST_LOSS_SCALE))
        return
    step = state[STEP]  # before this one
    state[SKIP] = wp.float64(0.0)
    rate = wp.float64(h.learning_rate)
    one = wp.float64(1.0)
    if h.decay_interval > wp.float64(0.0) and step >= h.decay_start:
        last = wp.min(step, h.decay_end)
        rate *= wp.pow(h.decay_base, wp.floor((last - h.decay_start) / h.decay_interval) + one)
    state[LEARNING_RATE] = rate
    factor = one / scale
    if h.max_norm > wp.float64(0.0) and norm > h.max_norm:
        factor *= h.max_norm / norm
    state[GRADIENT_FACTOR] = factor
    decay = wp.float64(h.ema_decay)
    state[EMA_OLD] = decay * (one - wp.pow(decay, step)) / (one - wp.pow(decay, step + one))
    state[EMA_NEW] = (one - decay) / (one - wp.pow(decay, step + one))
    if h.adabound != 0:
        t = (one - wp.float64(h.beta2)) * (step + one)
        state[LOW] = wp.float64(0.1) - wp.float64(0.1) / (t + one)
        state[HIGH] = wp.float64(0.1) + wp.float64(0.1) / t
    state[STEP] = step + one
    good = state[GOOD_STEPS] + one
    if h.dynamic_scale != 0 and good >= wp.float64(GROWTH_INTERVAL):
        state[LOSS_SCALE] = wp.min(scale * wp.float64(2.0), wp.float64(LARGEST_LOSS_SCALE))
        good = wp.float64(0.0)
    state[GOOD_STEPS] = good


# One definition for both devices: a thread of CUDA takes one parameter, one of the CPU device thousands, in loops
# without branches that the compiler turns into vector instructions.
_STEP = """
    float* __restrict__ P = parameters.data;
    float* __restrict__ G = gradients.data;
    float* __restrict__ M = first_moments.data;
    float* __restrict__ V = second_moments.data;
    int* __restrict__ T = steps.data;
    float* __restrict__ E = averages.data;
    const float* __restrict__ table = corrections.data;
    if (state.data[{SKIP}] != 0.0) {{
        for (int i = begin; i < end; ++i) G[i] = 0.0f;
        return;
    }}
    const float factor = static_cast<float>(state.data[{GRADIENT_FACTOR}]);
    const float base_rate = static_cast<float>(state.data[{LEARNING_RATE}]);
    const float ema_old = static_cast<float>(state.data[{EMA_OLD}]);
    const float ema_new = static_cast<float>(state.data[{EMA_NEW}]);
    const float low = h.adabound ? static_cast<float>(state.data[{LOW}]) : 0.0f;
    const float high = h.adabound ? static_cast<float>(state.data[{HIGH}]) : 3.4e38f;
    const float limit = h.clipping_magnitude > 0.0f ? h.clipping_magnitude : 3.4e38f;
    const float beta1 = h.beta1, beta2 = h.beta2, epsilon = h.epsilon, l2 = h.l2_reg;
    const float other_factor = h.non_matrix_factor;
    const float relative = h.relative_decay, absolute = h.absolute_decay;
    const int n_matrix = h.n_matrix, last = h.n_corrections - 1;
    const int move_matrix = h.optimize_matrix, move_other = h.optimize_non_matrix;
    for (int first = begin; first < end; first += 64) {{
        const int past = first + 64 < end ? first + 64 : end;
        int any = first < n_matrix || !{ADAM};
        for (int i = first; i < past; ++i) any |= G[i] != 0.0f;
        if (any)
            for (int i = first; i < past; ++i) {{
                const int matrix = i < n_matrix;
                const float raw = G[i], w = P[i];
                G[i] = 0.0f;
                if ({ADAM}) {{
                    const int moves = matrix ? move_matrix : move_other & (raw != 0.0f);
                    const float g = raw * factor + (matrix ? l2 * w : 0.0f);
                    const float m = beta1 * M[i] + (1.0f - beta1) * g;
                    const float v = beta2 * V[i] + (1.0f - beta2) * g * g;
                    const int t = T[i];
                    const float rate = base_rate * (matrix ? 1.0f : other_factor) * table[t < last ? t : last];
                    float own = rate / (SQUARE_ROOT(v) + epsilon);
                    own = own < low ? low : own > high ? high : own;
                    float next = (1.0f - relative * rate) * w - (w < 0.0f ? -absolute : absolute) * rate - own * m;
                    next = next < -limit ? -limit : next > limit ? limit : next;
                    M[i] = moves ? m : M[i];
                    V[i] = moves ? v : V[i];
                    T[i] = t + (moves ? 1 : 0);
                    P[i] = moves ? next : w;
                }} else {{
                    P[i] = w - base_rate * (raw * factor + l2 * w);
                }}
            }}
        if ({EMA})
            for (int i = first; i < past; ++i) E[i] = E[i] * ema_old + P[i] * ema_new;
    }}
"""
# The square root of the C library may set errno, which no vector instruction does.
_SQUARE_ROOT = """
#if defined(__CUDA_ARCH__)
#define SQUARE_ROOT sqrtf
#else
#define SQUARE_ROOT __builtin_elementwise_sqrt
#endif
"""


@functools.cache
def make_step(adam: bool, ema: bool, elements: int):
    """The update; each thread takes `elements` parameters. Arrays that the optimiser does without may be empty."""
    places = {"SKIP": SKIP, "GRADIENT_FACTOR": GRADIENT_FACTOR, "LEARNING_RATE": LEARNING_RATE, "EMA_OLD": EMA_OLD,
              "EMA_NEW": EMA_NEW, "LOW": LOW, "HIGH": HIGH}  # fmt: skip

    @wp.func_native(_SQUARE_ROOT + _STEP.format(**places, ADAM=int(adam), EMA=int(ema)))
    def step_range(
        begin: int,
        end: int,
        h: Hyperparameters,
        corrections: wp.array[wp.float32],
        state: wp.array[wp.float64],
        parameters: wp.array[wp.float32],
        gradients: wp.array[wp.float32],
        first_moments: wp.array[wp.float32],
        second_moments: wp.array[wp.float32],
        steps: wp.array[wp.int32],
        averages: wp.array[wp.float32],
    ): ...

    @wp.kernel(enable_backward=False, module=f"nn.step_{int(adam)}{int(ema)}_{elements}")
    def step(
        h: Hyperparameters,
        corrections: wp.array[wp.float32],
        state: wp.array[wp.float64],
        first: int,
        # in and out
        parameters: wp.array[wp.float32],
        gradients: wp.array[wp.float32],
        first_moments: wp.array[wp.float32],
        second_moments: wp.array[wp.float32],
        steps: wp.array[wp.int32],
        averages: wp.array[wp.float32],
    ):
        begin = (first + wp.tid()) * wp.static(elements)
        end = wp.min(begin + wp.static(elements), parameters.shape[0])
        step_range(
            begin, end, h, corrections, state, parameters, gradients, first_moments, second_moments, steps, averages
        )  # fmt: skip

    return step


def bias_corrections(beta1: float, beta2: float) -> np.ndarray:
    """√(1 - beta2^t) / (1 - beta1^t) for t = 1 …, until it is 1 in float32 (the last entry holds from there on)."""
    slowest = max(beta1, beta2)
    n = 1 if slowest == 0 else min(max(math.ceil(math.log(1e-9) / math.log(slowest)), 1), 1 << 20)
    t = np.arange(1, n + 1, dtype=np.float64)
    return (np.sqrt(-np.expm1(t * _log(beta2))) / -np.expm1(t * _log(beta1))).astype(np.float32)


def _log(beta):
    return math.log(beta) if beta > 0 else -math.inf


class Optimizer:
    """An optimiser's state for `n_params` parameters.

    Args:
        cfg: The optimiser; wrappers may nest in any order, each at most once.
        n_params: Parameters.
        n_matrix: How many of them, from the first, belong to matrices.
        loss_scale: A factor, or ``"dynamic"``.
        max_norm: Of all gradients together; 0: no clipping.
        device: Where the arrays live.
        blocks: A thread takes blocks of parameters, as suits the CPU device, not one.
    """

    def __init__(
        self, cfg: c.Optimizer, n_params: int, n_matrix: int, loss_scale, max_norm: float, device, blocks: bool
    ):
        h = Hyperparameters()
        self.ema = False
        while isinstance(cfg, (c.EMA, c.ExponentialDecay)):
            if isinstance(cfg, c.EMA):
                self.ema = True
                h.ema_decay = cfg.decay
            else:
                h.decay_base, h.decay_interval = cfg.decay_base, cfg.decay_interval
                h.decay_start, h.decay_end = cfg.decay_start, cfg.decay_end
            cfg = cfg.nested
        self.adam = isinstance(cfg, c.Adam)
        h.learning_rate, h.l2_reg = cfg.learning_rate, cfg.l2_reg
        h.n_matrix, h.optimize_matrix, h.optimize_non_matrix = n_matrix, 1, 1
        if self.adam:
            h.beta1, h.beta2, h.epsilon = cfg.beta1, cfg.beta2, cfg.epsilon
            h.relative_decay, h.absolute_decay = cfg.relative_decay, cfg.absolute_decay
            h.adabound, h.clipping_magnitude = int(cfg.adabound), cfg.clipping_magnitude
            h.non_matrix_factor = cfg.non_matrix_learning_rate_factor
            h.optimize_matrix, h.optimize_non_matrix = (
                int(cfg.optimize_matrix_params),
                int(cfg.optimize_non_matrix_params),
            )
        corrections = bias_corrections(cfg.beta1, cfg.beta2) if self.adam else np.ones(1, np.float32)
        h.n_corrections, h.max_norm, h.dynamic_scale = len(corrections), max_norm, int(loss_scale == "dynamic")
        self.hyperparameters, self.device, self.n_params = h, device, n_params
        self.corrections = wp.array(corrections, dtype=wp.float32, device=device)
        size = n_params if self.adam else 0
        self.first_moments = wp.zeros(size, dtype=wp.float32, device=device)
        self.second_moments = wp.zeros(size, dtype=wp.float32, device=device)
        self.steps = wp.zeros(size, dtype=wp.int32, device=device)
        self.averages = wp.zeros(n_params if self.ema else 0, dtype=wp.float32, device=device)
        self.sums = wp.zeros(N_RANGES if blocks else N_STRIDED, dtype=wp.float64, device=device)
        self.total = self.sums if blocks else wp.zeros(1, dtype=wp.float64, device=device)
        state = np.zeros(STATE_SIZE)
        state[LOSS_SCALE] = 2.0**15 if loss_scale == "dynamic" else loss_scale
        self.state = wp.array(state, dtype=wp.float64, device=device)
        self.loss_scale = self.state[LOSS_SCALE : LOSS_SCALE + 1]
        self.elements = 4096 if blocks else 1
        self.blocks = blocks
        self.kernel = make_step(self.adam, self.ema, self.elements)

    def step(self, parameters: wp.array, gradients: wp.array, parallel) -> None:
        """One update; `gradients` are zero afterwards. `parallel(launch, n)` spreads launches over threads."""
        if self.blocks:
            parallel(
                lambda first, n, worker: wp.launch(
                    measure, dim=n, inputs=[gradients, first], outputs=[self.sums], device=self.device
                ),
                N_RANGES,
            )
        else:
            wp.launch(measure_strided, dim=N_STRIDED, inputs=[gradients], outputs=[self.sums], device=self.device)
            wp.utils.array_sum(self.sums, out=self.total)
        wp.launch(decide, dim=1, inputs=[self.total, self.hyperparameters], outputs=[self.state], device=self.device)
        arrays = [self.first_moments, self.second_moments, self.steps, self.averages]
        parallel(
            lambda first, n, worker: wp.launch(
                self.kernel,
                dim=n,
                inputs=[self.hyperparameters, self.corrections, self.state, first],
                outputs=[parameters, gradients, *arrays],
                device=self.device,
            ),
            -(-self.n_params // self.elements),
        )

    def arrays(self) -> dict[str, wp.array]:
        """Everything that a checkpoint holds."""
        return {
            "first_moments": self.first_moments,
            "second_moments": self.second_moments,
            "steps": self.steps,
            "averages": self.averages,
            "state": self.state,
        }
