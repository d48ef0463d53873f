"""Kernels of the encodings without parameters, and of the columns that encodings share.

Every kernel has one thread per row and writes columns ``column …`` of row ``first_row + tid`` of `encoded`. The
backward kernels add to `dL_dx`, so that parts which read the same dimension can follow each other.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

PI = wp.constant(wp.float32(3.14159265358979323846))


@wp.func
def reduced(x: wp.float32):
    """x less the nearest whole number, which is exact; NaN for NaN and infinity."""
    return x - wp.rint(x)


@wp.func_native("""
    const float* from = x.data + size_t(row) * x.shape[1] + first_dim;
    float* to = encoded.data + size_t(row) * encoded.shape[1] + column;
    for (int d = 0; d < n_dims; ++d) to[d] = from[d] * scale + offset;
""")
def scale_row(
    x: wp.array2d[wp.float32],
    row: int,
    first_dim: int,
    n_dims: int,
    scale: wp.float32,
    offset: wp.float32,
    encoded: wp.array2d[wp.float32],
    column: int,
): ...


@wp.func_native("""
    const unsigned int* bits = (const unsigned int*)(x.data + size_t(row) * x.shape[1]);
    int bad = 0;
    for (int d = 0; d < n_dims; ++d) bad |= (bits[d] & 0x7f800000u) == 0x7f800000u;
    return bad;
""")
def has_nonfinite(x: wp.array2d[wp.float32], row: int, n_dims: int) -> int:
    """1 if an entry of the row is infinite or NaN."""
    ...


@wp.kernel
def identity_forward(
    x: wp.array2d[wp.float32],
    first_row: int,
    first_dim: int,
    n_dims: int,
    scale: wp.float32,
    offset: wp.float32,
    # out
    encoded: wp.array2d[wp.float32],
    column: int,
):
    scale_row(x, first_row + wp.tid(), first_dim, n_dims, scale, offset, encoded, column)


@wp.kernel
def identity_backward(
    x: wp.array2d[wp.float32],
    first_row: int,
    first_dim: int,
    n_dims: int,
    scale: wp.float32,
    dL_dencoded: wp.array2d[wp.float32],
    column: int,
    # out
    dL_dx: wp.array2d[wp.float32],
):
    row = first_row + wp.tid()
    for d in range(n_dims):
        dL_dx[row, first_dim + d] = dL_dx[row, first_dim + d] + dL_dencoded[row, column + d] * scale


@wp.kernel
def frequency_forward(
    x: wp.array2d[wp.float32],
    first_row: int,
    first_dim: int,
    n_dims: int,
    n_frequencies: int,
    # out
    encoded: wp.array2d[wp.float32],
    column: int,
):
    row = first_row + wp.tid()
    for d in range(n_dims):
        # In turns; taking them modulo a whole turn before every doubling is exact.
        turn = reduced(x[row, first_dim + d] * 0.5)
        for f in range(n_frequencies):
            angle = turn * (2.0 * PI)
            c = column + (d * n_frequencies + f) * 2
            encoded[row, c] = wp.sin(angle)
            encoded[row, c + 1] = wp.cos(angle)
            turn = reduced(turn * 2.0)


@wp.kernel
def frequency_backward(
    x: wp.array2d[wp.float32],
    first_row: int,
    first_dim: int,
    n_dims: int,
    n_frequencies: int,
    dL_dencoded: wp.array2d[wp.float32],
    column: int,
    # out
    dL_dx: wp.array2d[wp.float32],
):
    row = first_row + wp.tid()
    for d in range(n_dims):
        turn = reduced(x[row, first_dim + d] * 0.5)
        factor = wp.float32(PI)
        total = wp.float32(0.0)
        for f in range(n_frequencies):
            angle = turn * (2.0 * PI)
            c = column + (d * n_frequencies + f) * 2
            total += factor * (wp.cos(angle) * dL_dencoded[row, c] - wp.sin(angle) * dL_dencoded[row, c + 1])
            turn = reduced(turn * 2.0)
            factor = factor * 2.0
        dL_dx[row, first_dim + d] = dL_dx[row, first_dim + d] + total


@wp.kernel
def triangle_wave_forward(
    x: wp.array2d[wp.float32],
    first_row: int,
    first_dim: int,
    n_dims: int,
    n_frequencies: int,
    # out
    encoded: wp.array2d[wp.float32],
    column: int,
):
    row = first_row + wp.tid()
    for d in range(n_dims):
        period = reduced(x[row, first_dim + d] * 0.5)
        for f in range(n_frequencies):
            phase = period + 0.25 * wp.float32(f % 4)
            phase = phase - wp.floor(phase)
            encoded[row, column + d * n_frequencies + f] = wp.abs(phase - 0.5) * 4.0 - 1.0
            period = reduced(period * 2.0)


@wp.kernel
def triangle_wave_backward(
    x: wp.array2d[wp.float32],
    first_row: int,
    first_dim: int,
    n_dims: int,
    n_frequencies: int,
    dL_dencoded: wp.array2d[wp.float32],
    column: int,
    # out
    dL_dx: wp.array2d[wp.float32],
):
    row = first_row + wp.tid()
    for d in range(n_dims):
        period = reduced(x[row, first_dim + d] * 0.5)
        slope = wp.float32(2.0)
        total = wp.float32(0.0)
        for f in range(n_frequencies):
            phase = period + 0.25 * wp.float32(f % 4)
            phase = phase - wp.floor(phase)
            total += wp.where(phase < 0.5, -slope, slope) * dL_dencoded[row, column + d * n_frequencies + f]
            period = reduced(period * 2.0)
            slope = slope * 2.0
        dL_dx[row, first_dim + d] = dL_dx[row, first_dim + d] + total


@wp.func
def quartic_cdf(u: wp.float32):
    """Integral of the kernel 15/16 (1 - u²)² from -1 to u, for u within its support."""
    u2 = u * u
    return 0.9375 * u * (1.0 - (2.0 / 3.0) * u2 + 0.2 * u2 * u2) + 0.5


@wp.func
def blob_cdf(u: wp.float32):
    """Integral of the blob up to u, in units of bins."""
    return quartic_cdf(wp.clamp(u, -1.0, 1.0))


@wp.func
def blob_pdf(u: wp.float32):
    t = wp.max(1.0 - u * u, 0.0)
    return 0.9375 * t * t


@wp.kernel
def one_blob_forward(
    x: wp.array2d[wp.float32],
    first_row: int,
    first_dim: int,
    n_dims: int,
    n_bins: int,
    # out
    encoded: wp.array2d[wp.float32],
    column: int,
):
    row = first_row + wp.tid()
    n = wp.float32(n_bins)
    for d in range(n_dims):
        v = x[row, first_dim + d]
        u = -v * n
        keep = v - v  # NaN for what is not finite, which the clamp would hide
        left = blob_cdf(u) + blob_cdf(u - n) + blob_cdf(u + n)
        for k in range(n_bins):
            b = u + wp.float32(k + 1)
            right = blob_cdf(b) + blob_cdf(b - n) + blob_cdf(b + n)
            encoded[row, column + d * n_bins + k] = right - left + keep
            left = right


@wp.kernel
def one_blob_backward(
    x: wp.array2d[wp.float32],
    first_row: int,
    first_dim: int,
    n_dims: int,
    n_bins: int,
    dL_dencoded: wp.array2d[wp.float32],
    column: int,
    # out
    dL_dx: wp.array2d[wp.float32],
):
    row = first_row + wp.tid()
    n = wp.float32(n_bins)
    for d in range(n_dims):
        u = -x[row, first_dim + d] * n
        left = blob_pdf(u) + blob_pdf(u - n) + blob_pdf(u + n)
        total = wp.float32(0.0)
        for k in range(n_bins):
            b = u + wp.float32(k + 1)
            right = blob_pdf(b) + blob_pdf(b - n) + blob_pdf(b + n)
            total += (left - right) * dL_dencoded[row, column + d * n_bins + k]
            left = right
        dL_dx[row, first_dim + d] = dL_dx[row, first_dim + d] + total * n


@wp.kernel
def spherical_harmonics_forward(
    x: wp.array2d[wp.float32],
    first_row: int,
    first_dim: int,
    degree: int,
    factors: wp.array2d[wp.float32],
    # out
    encoded: wp.array2d[wp.float32],
    column: int,
):
    row = first_row + wp.tid()
    vx = x[row, first_dim] * 2.0 - 1.0
    vy = x[row, first_dim + 1] * 2.0 - 1.0
    vz = x[row, first_dim + 2] * 2.0 - 1.0
    re = wp.float32(1.0)  # of (vx + i vy)^m
    im = wp.float32(0.0)
    for m in range(degree):
        before = wp.float32(0.0)
        q = factors[m * 8 + m, 0]
        for band in range(m, degree):
            if band > m:
                q_next = factors[band * 8 + m, 0] * vz * q - factors[band * 8 + m, 1] * before
                before = q
                q = q_next
            c = column + band * band + band
            if m == 0:
                encoded[row, c] = q
            else:
                encoded[row, c + m] = q * re
                encoded[row, c - m] = q * im
        re_next = vx * re - vy * im
        im = vx * im + vy * re
        re = re_next


@wp.kernel
def spherical_harmonics_backward(
    x: wp.array2d[wp.float32],
    first_row: int,
    first_dim: int,
    degree: int,
    factors: wp.array2d[wp.float32],
    dL_dencoded: wp.array2d[wp.float32],
    column: int,
    # out
    dL_dx: wp.array2d[wp.float32],
):
    row = first_row + wp.tid()
    vx = x[row, first_dim] * 2.0 - 1.0
    vy = x[row, first_dim + 1] * 2.0 - 1.0
    vz = x[row, first_dim + 2] * 2.0 - 1.0
    re = wp.float32(1.0)
    im = wp.float32(0.0)
    re_before = wp.float32(0.0)  # of the power m - 1
    im_before = wp.float32(0.0)
    total = wp.vec3(0.0)
    for m in range(degree):
        before = wp.float32(0.0)
        d_before = wp.float32(0.0)
        q = factors[m * 8 + m, 0]
        dq = wp.float32(0.0)
        for band in range(m, degree):
            if band > m:
                a = factors[band * 8 + m, 0]
                b = factors[band * 8 + m, 1]
                q_next = a * vz * q - b * before
                dq_next = a * (q + vz * dq) - b * d_before
                before = q
                d_before = dq
                q = q_next
                dq = dq_next
            c = column + band * band + band
            if m == 0:
                total[2] += dq * dL_dencoded[row, c]
            else:
                g_re = dL_dencoded[row, c + m]
                g_im = dL_dencoded[row, c - m]
                k = wp.float32(m) * q
                total[0] += k * (re_before * g_re + im_before * g_im)
                total[1] += k * (re_before * g_im - im_before * g_re)
                total[2] += dq * (re * g_re + im * g_im)
        re_before = re
        im_before = im
        re = vx * re_before - vy * im_before
        im = vx * im_before + vy * re_before
    for d in range(3):
        dL_dx[row, first_dim + d] = dL_dx[row, first_dim + d] + 2.0 * total[d]


@wp.kernel
def gather_columns(
    latent: wp.array2d[wp.float32],
    index: wp.array[wp.int32],
    first_row: int,
    n_columns: int,
    # out
    encoded: wp.array2d[wp.float32],
    column: int,
):
    """Copies row ``index[row]`` of a latent that was encoded before; NaN if there is no such row."""
    row = first_row + wp.tid()
    source = index[row]
    for c in range(n_columns):
        value = wp.float32(wp.nan)
        if source >= 0 and source < latent.shape[0]:
            value = latent[source, c]
        encoded[row, column + c] = value


@wp.kernel
def count_nonfinite_rows(
    x: wp.array2d[wp.float32], first_row: int, n_dims: int, counter: wp.array[wp.int32], slot: int
):
    if has_nonfinite(x, first_row + wp.tid(), n_dims) != 0:
        wp.atomic_add(counter, slot, 1)


@wp.kernel
def add_sums(first: int, sums: wp.array[wp.float64], gradients: wp.array[wp.float32]):
    """Adds sums to the gradients from index `first`, and clears them."""
    i = wp.tid()
    if sums[i] != wp.float64(0.0):
        gradients[first + i] = gradients[first + i] + wp.float32(sums[i])
        sums[i] = wp.float64(0.0)
