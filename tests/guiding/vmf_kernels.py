"""Kernels that call the functions of a mixture, and their results in NumPy."""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from guiding.distributions.vmf_mixture import make_vmf_mixture

DEVICE = "cpu"


@functools.cache
def make_kernel(n_lobes: int, direction: str):
    f = make_vmf_mixture(n_lobes, direction)
    n_params = f.n_params
    decode, pdf, log_pdf, sample, multiply = f.decode, f.pdf, f.log_pdf, f.sample, f.multiply
    log_pdf_gradient, product_log_pdf_gradient = f.log_pdf_gradient, f.product_log_pdf_gradient

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(
        raw: wp.array[wp.float32],
        w: wp.array[wp.vec3],
        u: wp.array[wp.vec3],
        factor: wp.array[wp.float32],
        other_mu: wp.array[wp.vec3],
        other_kappa: wp.array[wp.float32],
        # outputs
        weights: wp.array2d[wp.float32],
        kappas: wp.array2d[wp.float32],
        mus: wp.array2d[wp.vec3],
        product_weights: wp.array2d[wp.float32],
        scalars: wp.array2d[wp.float32],
        samples: wp.array2d[wp.vec3],
        gradient: wp.array[wp.float32],
        product_gradient: wp.array[wp.float32],
    ):
        i = wp.tid()
        at = i * n_params
        m = decode(raw, at)
        product = multiply(m, other_mu[i], other_kappa[i])
        for k in range(n_lobes):
            weights[i, k] = m.weight[k]
            kappas[i, k] = m.kappa[k]
            mus[i, k] = wp.vec3(m.mu_x[k], m.mu_y[k], m.mu_z[k])
            product_weights[i, k] = product.weight[k]
        scalars[i, 0] = pdf(m, w[i])
        scalars[i, 1] = log_pdf(m, w[i])
        scalars[i, 2] = pdf(product, w[i])
        scalars[i, 3] = log_pdf(product, w[i])
        samples[i, 0] = sample(m, u[i])
        samples[i, 1] = sample(product, u[i])
        scalars[i, 4] = log_pdf_gradient(raw, at, w[i], factor[i], gradient, at)
        scalars[i, 5] = product_log_pdf_gradient(
            raw, at, other_mu[i], other_kappa[i], w[i], factor[i], product_gradient, at
        )

    return evaluate


def evaluate(raw, w, direction, u=0.5, factor=1.0, other_mu=(0.0, 0.0, 1.0), other_kappa=0.0) -> SimpleNamespace:
    """All functions of the mixtures of raw rows [n, P] at w [n, 3] or [3]; other arguments are broadcast too."""
    raw = np.ascontiguousarray(np.atleast_2d(raw), np.float32)
    n = max(len(raw), len(np.atleast_2d(w)))
    raw = np.ascontiguousarray(np.broadcast_to(raw, (n, raw.shape[1])))
    n_lobes = raw.shape[1] // {"angles": 4, "vector": 5}[direction]

    def vectors(v):
        full = np.broadcast_to(np.asarray(v, np.float32), (n, 3))
        return wp.array(np.ascontiguousarray(full), dtype=wp.vec3, device=DEVICE)

    def numbers(v):
        full = np.broadcast_to(np.asarray(v, np.float32), n)
        return wp.array(np.ascontiguousarray(full), dtype=wp.float32, device=DEVICE)

    def room(shape, dtype=wp.float32):
        return wp.zeros(shape, dtype=dtype, device=DEVICE)

    outputs = [room((n, n_lobes)), room((n, n_lobes)), room((n, n_lobes), wp.vec3), room((n, n_lobes)), room((n, 6))]
    outputs += [room((n, 2), wp.vec3), room(raw.size), room(raw.size)]
    inputs = [wp.array(raw.ravel(), device=DEVICE), vectors(w), vectors(u), numbers(factor), vectors(other_mu)]
    inputs.append(numbers(other_kappa))
    wp.launch(make_kernel(n_lobes, direction), dim=n, inputs=inputs, outputs=outputs, device=DEVICE)
    weight, kappa, mu, product_weight, scalars, samples, gradient, product_gradient = (a.numpy() for a in outputs)
    pdf, log_pdf, product_pdf, product_log_pdf, gradient_log_pdf, product_gradient_log_pdf = scalars.T
    return SimpleNamespace(
        weight=weight, kappa=kappa, mu=mu, product_weight=product_weight, pdf=pdf, log_pdf=log_pdf,
        product_pdf=product_pdf, product_log_pdf=product_log_pdf, gradient_log_pdf=gradient_log_pdf,
        product_gradient_log_pdf=product_gradient_log_pdf, sample=samples[:, 0], product_sample=samples[:, 1],
        gradient=gradient.reshape(raw.shape), product_gradient=product_gradient.reshape(raw.shape),
    )  # fmt: skip
