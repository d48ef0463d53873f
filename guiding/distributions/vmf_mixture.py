"""Mixtures of von Mises-Fisher lobes whose parameters are the raw outputs of a network.

A lobe takes consecutive outputs, in the order of Dong et al. 2023 ("Neural Parametric Mixtures for Path Guiding"):

- a logit; the weights are the softmax of all logits;
- log kappa;
- the mean direction, either as two ``angles`` by the logistic function, theta = pi sigma(a) from +z and phi =
  2 pi sigma(b) from +x towards +y; or as a ``vector`` of three, which is normalised. Angles are theirs. They have
  poles, and a lobe cannot move across phi = 0, which no b reaches; a vector has neither, but no direction at zero.

Every raw output that is finite gives a mixture whose density, samples and gradients are finite. Nothing is done about
one that is not.

A mixture is decoded once per vertex, into a struct, and evaluated there for every direction. On one core of an AMD EPYC
and with 8 lobes, decoding takes 500 ns for angles and 240 ns for vectors, and then a density 28, its logarithm 44, a
sample 55 and the product with a lobe 140 ns; without the struct each of them would decode again. A gradient, which
decodes, takes 900 and 450 ns. Times are proportional to the number of lobes.
"""

import dataclasses
import functools

import warp as wp

from guiding.distributions.vmf import multiply_vmf, one_minus_cosine, sample_vmf, vmf_moments, vmf_peak
from nn.activations import sigmoid

DIRECTIONS = {"angles": 2, "vector": 3}  # raw outputs that each takes

# |log kappa| is held within this: 2e-9 is uniform in float32, and a lobe of 4.9e8 is 4.5e-5 rad wide, of which float32
# unit vectors resolve a thousandth. In a narrower one, a sample rounded to float32 no longer has the density it was
# drawn with.
LOG_KAPPA_LIMIT = 20.0

_PI = wp.constant(3.141592653589793)
_TWO_PI = wp.constant(6.283185307179586)
_SHORTEST = wp.constant(1.0e-6)  # a raw vector with no component beyond this has no direction: +z, without gradient


@dataclasses.dataclass(frozen=True)
class VmfMixture:
    """The functions of a mixture with a fixed number of lobes, for kernels. Directions are unit vectors.

    A kernel calls them as ``wp.static(mixture.pdf)``, or by names in the function that makes it.

    Attributes:
        n_lobes: K.
        direction: How raw outputs give mean directions, ``angles`` or ``vector``.
        n_params: Raw outputs of one mixture: 4 K or 5 K.
        Mixture: The struct of a decoded mixture.
        decode: (raw, offset) -> Mixture; of `n_params` numbers of the flat float32 array `raw` from `offset` on.
        pdf: (mixture, w) -> density in solid angle.
        log_pdf: (mixture, w) -> its logarithm, which is finite also where the density underflows.
        sample: (mixture, u) -> w, of three numbers in [0, 1): u[0] and u[1] give the direction and u[2] the lobe.
        multiply: (mixture, mu, kappa) -> Mixture; the normalised product with one lobe, again a mixture.
        log_pdf_gradient: (raw, offset, w, factor, gradient, gradient_offset) -> log pdf; writes `factor` times its
            derivatives with respect to the raw outputs to the flat array `gradient`, which must not overlap `raw`.
        product_log_pdf_gradient: (raw, offset, mu, kappa, w, factor, gradient, gradient_offset) -> log pdf; the same
            for the normalised product with one lobe.
        kl_loss: A loss for `nn.Model` (see `nn.losses`). The four columns of its target are w and the weight
            f(w) / q(w), f being the function to learn, not negative, and q the density that w was drawn with. Its
            value, -weight · log pdf(w), has the mean F · (KL(f / F || pdf) + entropy of f / F), where F is the integral
            of f. So its gradient is an estimate, by one sample, of F times that of the divergence.
    """

    n_lobes: int
    direction: str
    n_params: int
    Mixture: type
    decode: wp.Function
    pdf: wp.Function
    log_pdf: wp.Function
    sample: wp.Function
    multiply: wp.Function
    log_pdf_gradient: wp.Function
    product_log_pdf_gradient: wp.Function
    kl_loss: wp.Function


# --- directions of raw outputs ---------------------------------------------------------------------------------------


@wp.func
def _half_angle(raw: float, period: float) -> wp.vec3:
    """cos and sin of period · sigma(raw) and the derivative of that angle; period is pi or 2 pi.

    They are those of the angle from the nearer end, period · sigma(-|raw|), which is exact where it is small.
    """
    s = sigmoid(-wp.abs(raw))
    return wp.vec3(wp.cos(period * s), wp.sin(period * s), period * s * (1.0 - s))


@wp.func
def _polar(raw: wp.array[wp.float32], at: int) -> wp.vec3:
    """cos theta, sin theta, d theta / d raw."""
    half = _half_angle(raw[at], _PI)
    return wp.vec3(wp.where(raw[at] < 0.0, half[0], -half[0]), half[1], half[2])


@wp.func
def _azimuth(raw: wp.array[wp.float32], at: int) -> wp.vec3:
    """cos phi, sin phi, d phi / d raw."""
    half = _half_angle(raw[at], _TWO_PI)
    return wp.vec3(half[0], wp.where(raw[at] < 0.0, half[1], -half[1]), half[2])


@wp.func
def _angles_to_direction(raw: wp.array[wp.float32], at: int) -> wp.vec3:
    polar = _polar(raw, at)
    azimuth = _azimuth(raw, at + 1)
    return wp.vec3(polar[1] * azimuth[0], polar[1] * azimuth[1], polar[0])


@wp.func
def _angles_gradient(raw: wp.array[wp.float32], at: int, dmu: wp.vec3, gradient: wp.array[wp.float32], to: int):
    """Writes the derivatives along the raw angles of a function whose gradient with respect to mu is dmu."""
    polar = _polar(raw, at)
    azimuth = _azimuth(raw, at + 1)
    outwards = dmu[0] * azimuth[0] + dmu[1] * azimuth[1]
    gradient[to] = polar[2] * (outwards * polar[0] - dmu[2] * polar[1])
    gradient[to + 1] = azimuth[2] * polar[1] * (dmu[1] * azimuth[0] - dmu[0] * azimuth[1])


@wp.func
def _scaled_vector(raw: wp.array[wp.float32], at: int):
    """The raw vector over its greatest component, so that squares stay in range, and that component; or +z and zero."""
    v = wp.vec3(raw[at], raw[at + 1], raw[at + 2])
    size = wp.max(wp.abs(v[0]), wp.max(wp.abs(v[1]), wp.abs(v[2])))
    if size <= _SHORTEST:
        return wp.vec3(0.0, 0.0, 1.0), 0.0
    return wp.vec3(v[0] / size, v[1] / size, v[2] / size), size


@wp.func
def _vector_to_direction(raw: wp.array[wp.float32], at: int) -> wp.vec3:
    v, _size = _scaled_vector(raw, at)
    return v / wp.length(v)


@wp.func
def _vector_gradient(raw: wp.array[wp.float32], at: int, dmu: wp.vec3, gradient: wp.array[wp.float32], to: int):
    """As `_angles_gradient`, for the raw vector: the part of dmu across it, over its length."""
    v, size = _scaled_vector(raw, at)
    length = wp.length(v)
    mu = v / length
    across = (dmu - wp.dot(dmu, mu) * mu) / length
    for i in range(3):
        gradient[to + i] = wp.where(size > 0.0, across[i] / size, 0.0)


_FROM_RAW = {
    "angles": (_angles_to_direction, _angles_gradient),
    "vector": (_vector_to_direction, _vector_gradient),
}


# --- mixtures --------------------------------------------------------------------------------------------------------


def make_vmf_mixture(n_lobes: int, direction: str = "angles", log_kappa_limit: float = LOG_KAPPA_LIMIT) -> VmfMixture:
    """The functions of mixtures of `n_lobes` lobes.

    Args:
        n_lobes: At least 1.
        direction: ``angles`` or ``vector``.
        log_kappa_limit: The raw log kappa is clamped to plus or minus this, beyond which its gradient is zero. The
            greatest one allowed is the default, `LOG_KAPPA_LIMIT`.

    Raises:
        ValueError: An argument is not allowed.
    """
    if n_lobes < 1:
        raise ValueError(f"n_lobes: found {n_lobes}; allowed: 1 or more")
    if direction not in DIRECTIONS:
        raise ValueError(f"direction: found {direction!r}; allowed: {', '.join(DIRECTIONS)}")
    if not 0.0 < log_kappa_limit <= LOG_KAPPA_LIMIT:
        raise ValueError(f"log_kappa_limit: found {log_kappa_limit}; allowed: above 0, at most {LOG_KAPPA_LIMIT}")
    return _make(int(n_lobes), direction, float(log_kappa_limit))


@functools.cache
def _make_struct(K: int) -> tuple[type, type]:
    """A vector with an entry per lobe, and the struct: one of each for all mixtures of as many lobes. Warp takes two
    kernels for one if they read alike, and would then meet the other struct in its arguments."""
    lobes = wp.types.vector(K, wp.float32)

    @wp.struct
    class Mixture:
        weight: lobes  # sum to one
        log_peak: lobes  # log of the weighted density at the mean direction
        kappa: lobes
        mu_x: lobes
        mu_y: lobes
        mu_z: lobes

    return lobes, Mixture


@functools.cache
def _make(K: int, direction: str, limit: float) -> VmfMixture:
    stride = 2 + DIRECTIONS[direction]
    to_direction, direction_gradient = _FROM_RAW[direction]
    lobes, Mixture = _make_struct(K)

    # A field of the struct is read once, into a variable: reading an entry of it copies the whole field wherever Warp
    # leaves a loop as it is, which is beyond 16 lobes.

    @wp.func
    def normalized(logs: lobes, log_peak: lobes, kappa: lobes, x: lobes, y: lobes, z: lobes) -> Mixture:
        """The mixture of weights exp(logs) over their sum; `log_peak` comes without weights."""
        highest = wp.max(logs)
        weight = lobes()
        total = float(0.0)
        for k in range(K):
            weight[k] = wp.exp(logs[k] - highest)
            total += weight[k]
        log_total = wp.log(total)
        for k in range(K):
            weight[k] = weight[k] / total
            log_peak[k] = log_peak[k] + (logs[k] - highest - log_total)
        return Mixture(weight, log_peak, kappa, x, y, z)

    @wp.func
    def decode(raw: wp.array[wp.float32], offset: int) -> Mixture:
        logits = lobes()
        log_peak = lobes()
        kappas = lobes()
        x = lobes()
        y = lobes()
        z = lobes()
        for k in range(K):
            at = offset + k * stride
            logits[k] = raw[at]
            kappa = wp.exp(wp.clamp(raw[at + 1], -limit, limit))
            kappas[k] = kappa
            log_peak[k] = wp.log(vmf_peak(kappa))
            mu = to_direction(raw, at + 2)
            x[k] = mu[0]
            y[k] = mu[1]
            z[k] = mu[2]
        return normalized(logits, log_peak, kappas, x, y, z)

    @wp.func
    def log_terms(m: Mixture, w: wp.vec3) -> lobes:
        """Logarithms of the weighted densities of the lobes."""
        log_peak = m.log_peak
        kappa = m.kappa
        x = m.mu_x
        y = m.mu_y
        z = m.mu_z
        terms = lobes()
        for k in range(K):
            terms[k] = log_peak[k] - kappa[k] * one_minus_cosine(wp.vec3(x[k], y[k], z[k]), w)
        return terms

    @wp.func
    def pdf(m: Mixture, w: wp.vec3) -> float:
        terms = log_terms(m, w)
        total = float(0.0)
        for k in range(K):
            total += wp.exp(terms[k])  # no overflow: the peaks are bounded
        return total

    @wp.func
    def log_pdf(m: Mixture, w: wp.vec3) -> float:
        terms = log_terms(m, w)
        highest = wp.max(terms)
        total = float(0.0)
        for k in range(K):
            total += wp.exp(terms[k] - highest)
        return highest + wp.log(total)

    @wp.func
    def sample(m: Mixture, u: wp.vec3) -> wp.vec3:
        weight = m.weight
        kappa = m.kappa
        x = m.mu_x
        y = m.mu_y
        z = m.mu_z
        # The last lobe with weight whose interval begins at or before u[2]: rounding of the sum leaves no gap.
        lobe_kappa = kappa[0]
        lobe_mu = wp.vec3(x[0], y[0], z[0])
        begin = weight[0]
        for k in range(1, K):
            if weight[k] > 0.0 and begin <= u[2]:
                lobe_kappa = kappa[k]
                lobe_mu = wp.vec3(x[k], y[k], z[k])
            begin += weight[k]
        return sample_vmf(lobe_mu, lobe_kappa, wp.vec2(u[0], u[1]))

    @wp.func
    def multiply(m: Mixture, other_mu: wp.vec3, other_kappa: float) -> Mixture:
        log_peak = m.log_peak
        kappa = m.kappa
        x = m.mu_x
        y = m.mu_y
        z = m.mu_z
        logs = lobes()
        for k in range(K):
            mu, product_kappa, loss = multiply_vmf(wp.vec3(x[k], y[k], z[k]), kappa[k], other_mu, other_kappa)
            product_log_peak = wp.log(vmf_peak(product_kappa))
            logs[k] = log_peak[k] - product_log_peak - loss
            log_peak[k] = product_log_peak
            kappa[k] = product_kappa
            x[k] = mu[0]
            y[k] = mu[1]
            z[k] = mu[2]
        return normalized(logs, log_peak, kappa, x, y, z)

    @wp.func
    def write_gradient(
        raw: wp.array[wp.float32],
        offset: int,
        m: Mixture,
        share: lobes,
        other_mu: wp.vec3,
        other_kappa: float,
        w: wp.vec3,
        factor: float,
        gradient: wp.array[wp.float32],
        gradient_offset: int,
    ) -> float:
        """Of the mixture m times a lobe, and log pdf of m alone. A kappa of zero leaves m alone.

        log p = log sum_k exp(t_k) - log sum_k exp(z_k) + log other(w), with t_k the logarithm of a weighted density and
        z_k of the mass of its product. The gradients are means of those of t_k and z_k over lobes, by responsibility
        and by `share`, the weights of the product.
        """
        kappas = m.kappa
        x = m.mu_x
        y = m.mu_y
        z = m.mu_z
        terms = log_terms(m, w)
        highest = wp.max(terms)
        total = float(0.0)
        for k in range(K):
            terms[k] = wp.exp(terms[k] - highest)
            total += terms[k]
        for k in range(K):
            at = offset + k * stride
            to = gradient_offset + k * stride
            kappa = kappas[k]
            mu = wp.vec3(x[k], y[k], z[k])
            responsibility = terms[k] / total
            moments = vmf_moments(kappa)
            dkappa = responsibility * (moments[0] - one_minus_cosine(mu, w))
            dmu = (responsibility * kappa) * (w - mu)
            if other_kappa > 0.0:
                # d z / d kappa = A' mu · mu' - A and d z / d mu = A' kappa mu', A and A' the mean cosines of the lobe
                # and of its product; 1 - mu · mu' and the part of mu' across mu follow from other_mu
                _mu, product_kappa, loss = multiply_vmf(mu, kappa, other_mu, other_kappa)
                product = vmf_moments(product_kappa)
                pull = share[k] * product[1] * other_kappa
                turn = one_minus_cosine(mu, other_mu) * (2.0 * other_kappa - loss)
                dkappa -= share[k] * (moments[0] - product[0])
                dkappa += pull * turn / (kappa + other_kappa + product_kappa)
                dmu -= (pull * kappa) * (other_mu - mu)
            gradient[to] = factor * (responsibility - share[k])
            gradient[to + 1] = wp.where(wp.abs(raw[at + 1]) < limit, factor * (kappa * dkappa), 0.0)
            direction_gradient(raw, at + 2, factor * dmu, gradient, to + 2)
        return highest + wp.log(total)

    @wp.func
    def log_pdf_gradient(
        raw: wp.array[wp.float32],
        offset: int,
        w: wp.vec3,
        factor: float,
        gradient: wp.array[wp.float32],
        gradient_offset: int,
    ) -> float:
        m = decode(raw, offset)
        return write_gradient(raw, offset, m, m.weight, w, 0.0, w, factor, gradient, gradient_offset)

    @wp.func
    def product_log_pdf_gradient(
        raw: wp.array[wp.float32],
        offset: int,
        other_mu: wp.vec3,
        other_kappa: float,
        w: wp.vec3,
        factor: float,
        gradient: wp.array[wp.float32],
        gradient_offset: int,
    ) -> float:
        m = decode(raw, offset)
        product = multiply(m, other_mu, other_kappa)
        write_gradient(raw, offset, m, product.weight, other_mu, other_kappa, w, factor, gradient, gradient_offset)
        return log_pdf(product, w)

    @wp.func
    def kl_loss(
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
            for i in range(K * stride):
                dL_dy[dL_dy_offset + i] = 0.0
            return 0.0
        w = wp.vec3(target[row, 0], target[row, 1], target[row, 2])
        return -weight * log_pdf_gradient(y, y_offset, w, -weight * factor, dL_dy, dL_dy_offset)

    return VmfMixture(
        K,
        direction,
        K * stride,
        Mixture,
        decode,
        pdf,
        log_pdf,
        sample,
        multiply,
        log_pdf_gradient,
        product_log_pdf_gradient,
        kl_loss,
    )
