"""Execution of an MLP on the CPU device: blocks of rows go through all layers within the cache.

Rows are samples. A matrix product C = A·B keeps 8 rows × 32 columns of C in vector registers and reads A by scalars, so
the forward pass (B = Wᵀ), the gradient of the inputs (B = W) and that of the weights (A = dL/dyᵀ, B = x) are one
routine over row-major blocks without any transposition of samples. Columns are padded to 16 with zeros.

The sizes of a network are run-time tables, so all networks share the kernels. Only the CPU device can run them.
"""

from __future__ import annotations

import functools

import warp as wp

from nn.activations import RELU, activate, derivative

PRECISIONS = ("fp32", "fp16", "bf16")  # by code
BLOCK = 128  # rows; a multiple of 8
N_CHUNKS = 16  # of a batch, whose weight gradients are summed in order: the same sums for any number of threads
# Columns of the layer table.
N_IN, IN_PAD, N_OUT, OUT_PAD, WT, W, BIAS, GRAD, ACTIVATION, OUTPUT, INPUT_OF_ACTIVATION, FROM_INPUT, HAS_BIAS = range(
    13
)

wp.set_module_options({"enable_backward": False})

_GEMM = """
    typedef float vec __attribute__((ext_vector_type(16), aligned(4)));
    const float* const A = a.data + a_offset;
    const float* const B = b.data + b_offset;
    float* const C = c.data + c_offset;
    const float* const mask = relu_mask.data + mask_offset;
    const bool has_bias = bias_offset >= 0;
    auto columns = [&](int j, auto* width) __attribute__((noinline)) {  // one body for all products
        constexpr int V = sizeof(*width);  // vectors of columns at a time
        for (int r = 0; r < m; r += 8) {
            vec acc[8][V];
            #pragma unroll
            for (int i = 0; i < 8; ++i)
                #pragma unroll
                for (int v = 0; v < V; ++v)
                    acc[i][v] = has_bias ? *(const vec*)(b.data + bias_offset + j + 16 * v) : (vec)(0.0f);
            const float* p = A + r * a_row;
            const float* q = B + j;
            for (int l = 0; l < k; ++l) {
                vec x[V];
                #pragma unroll
                for (int v = 0; v < V; ++v) x[v] = *(const vec*)(q + 16 * v);
                #pragma unroll
                for (int i = 0; i < 8; ++i) {
                    const float s = p[i * a_row];
                    #pragma unroll
                    for (int v = 0; v < V; ++v) acc[i][v] += s * x[v];
                }
                p += a_column;
                q += b_stride;
            }
            #pragma unroll
            for (int i = 0; i < 8; ++i)
                #pragma unroll
                for (int v = 0; v < V; ++v) {
                    vec y = acc[i][v];
                    // sums of sums: rounding grows with the number of blocks, not of rows
                    if (accumulate) y += *(const vec*)(C + (r + i) * c_stride + j + 16 * v);
                    if (epilogue == 1) y = y < 0.0f ? (vec)(0.0f) : y;
                    if (epilogue == 2)
                        y = *(const vec*)(mask + (r + i) * c_stride + j + 16 * v) > 0.0f ? y : (vec)(0.0f);
                    *(vec*)(C + (r + i) * c_stride + j + 16 * v) = y;
                }
        }
    };
    int j = 0;
    for (; j + 32 <= n; j += 32) columns(j, (char(*)[2])0);
    if (j < n) columns(j, (char(*)[1])0);
"""


@wp.func_native(_GEMM)
def multiply(
    a: wp.array[wp.float32],
    a_offset: wp.int64,
    a_row: int,
    a_column: int,
    b: wp.array[wp.float32],
    b_offset: wp.int64,
    b_stride: int,
    bias_offset: int,
    c: wp.array[wp.float32],
    c_offset: wp.int64,
    c_stride: int,
    m: int,
    n: int,
    k: int,
    accumulate: int,
    epilogue: int,
    relu_mask: wp.array[wp.float32],
    mask_offset: wp.int64,
):
    """C[m, n] (+)= A[m, k] · B[k, n]; m is a multiple of 8, n of 16.

    `epilogue`: 1 applies ReLU, 2 keeps the entries where `relu_mask` (laid out as C) is positive.
    """
    ...


@wp.func_native("""
    typedef float vec __attribute__((ext_vector_type(16), aligned(4)));
    for (int j = 0; j < n; j += 16) {
        vec sum = *(const vec*)(out.data + out_offset + j);
        for (int r = 0; r < rows; ++r) sum += *(const vec*)(a.data + a_offset + r * n + j);
        *(vec*)(out.data + out_offset + j) = sum;
    }
""")
def add_column_sums(
    a: wp.array[wp.float32], a_offset: int, rows: int, n: int, out: wp.array[wp.float32], out_offset: wp.int64
): ...


@wp.func_native("""
    for (int r = 0; r < rows; ++r) {
        const float* from = scratch.data + offset + r * stride;
        float* to = y.data + size_t(row + r) * y.shape[1];
        for (int i = 0; i < y.shape[1]; ++i) to[i] = from[i];
    }
""")
def write_rows(
    scratch: wp.array[wp.float32], offset: int, stride: int, rows: int, row: int, y: wp.array2d[wp.float32]
): ...


@wp.func_native("""
    unsigned int* const bits = (unsigned int*)(a.data + offset);
    float* const values = a.data + offset;
    if (precision == 1)
        for (int i = 0; i < n; ++i) {
            const float x = values[i], size = __builtin_fabsf(x);
            // to 10 bits of mantissa; to a multiple of 2^-24 below 2^-14, by the rounding of a sum
            const unsigned int even = (bits[i] + 0x0fffu + ((bits[i] >> 13) & 1u)) & ~0x1fffu;
            const float small = __builtin_copysignf((size + 0.75f) - 0.75f, x);
            float y = size < 6.103515625e-5f ? small : __builtin_bit_cast(float, even);
            y = size >= 65520.0f ? __builtin_copysignf(__builtin_inff(), x) : y;
            values[i] = x != x ? x : y;
        }
    if (precision == 2)
        for (int i = 0; i < n; ++i) {
            const unsigned int even = (bits[i] + 0x7fffu + ((bits[i] >> 16) & 1u)) & ~0xffffu;
            values[i] = values[i] != values[i] ? values[i] : __builtin_bit_cast(float, even);
        }
""")
def round_to_precision(a: wp.array[wp.float32], offset: wp.int64, n: int, precision: int):
    """Rounds `n` numbers to the nearest of half precision (1) or bfloat16 (2), ties to even."""
    ...


@wp.func_native("""
    for (int i = 0; i < n; ++i)
        to.data[to_offset + i] = (add ? to.data[to_offset + i] : 0.0f) + factor * source.data[offset + i];
""")
def write_scaled(
    source: wp.array[wp.float32],
    offset: int,
    n: int,
    factor: wp.float32,
    add: int,
    to: wp.array[wp.float32],
    to_offset: wp.int64,
): ...


@wp.struct
class Network:
    """A network as the kernels read it."""

    table: wp.array2d[wp.int32]  # a row per layer
    packed: wp.array[wp.float32]  # weights both ways, and biases
    scratch_size: int  # floats per worker
    gradient: int  # offset in a scratch of two blocks that hold dL/dy of a layer
    gradient_stride: int  # size of each
    gradient_size: int  # floats of one chunk of weight gradients
    precision: int  # of the operands of products


@wp.kernel
def pack(parameters: wp.array[wp.float32], offsets: wp.array2d[wp.int32], net: Network):
    """Copies the parameters to where the products read them; threads: layers × outputs of the widest."""
    layer, o = wp.tid()
    if o >= net.table[layer, N_OUT]:
        return
    n_in = net.table[layer, N_IN]
    weight = offsets[layer, 0] + o * n_in
    for i in range(n_in):
        at = net.table[layer, W] + o * net.table[layer, IN_PAD] + i
        net.packed[at] = parameters[weight + i]
        round_to_precision(net.packed, wp.int64(at), 1, net.precision)
        net.packed[net.table[layer, WT] + i * net.table[layer, OUT_PAD] + o] = net.packed[at]
    if net.table[layer, HAS_BIAS] != 0:
        net.packed[net.table[layer, BIAS] + o] = parameters[offsets[layer, 1] + o]


@wp.func
def forward_block(
    net: Network,
    encoded: wp.array[wp.float32],
    first: wp.int64,
    rows: int,
    scratch: wp.array[wp.float32],
    base: int,
):
    """Activations of `rows` rows into the scratch at `base`; `first` is the offset of the first row of `encoded`."""
    m = (rows + 7) / 8 * 8
    hidden = net.table.shape[0] - 1
    round_to_precision(encoded, first, m * net.table[0, IN_PAD], net.precision)
    for layer in range(net.table.shape[0]):
        out_pad = net.table[layer, OUT_PAD]
        code = net.table[layer, ACTIVATION]
        out = base + net.table[layer, OUTPUT]
        target = out
        if net.table[layer, FROM_INPUT] != 0:
            target = base + net.table[layer, INPUT_OF_ACTIVATION]
        bias = int(-1)
        if net.table[layer, HAS_BIAS] != 0:
            bias = net.table[layer, BIAS]
        relu = wp.where(code == RELU, 1, 0)
        k = net.table[layer, N_IN]
        wt = wp.int64(net.table[layer, WT])
        to = wp.int64(target)
        if layer == 0:
            multiply(
                encoded, first, net.table[0, IN_PAD], 1, net.packed, wt, out_pad, bias, scratch, to, out_pad, m,
                out_pad, k, 0, relu, scratch, to,
            )  # fmt: skip
        else:
            before = wp.int64(base + net.table[layer - 1, OUTPUT])
            multiply(
                scratch, before, net.table[layer, IN_PAD], 1, net.packed, wt, out_pad, bias, scratch, to, out_pad, m,
                out_pad, k, 0, relu, scratch, to,
            )  # fmt: skip
        if layer < hidden:
            round_to_precision(scratch, wp.int64(target), m * out_pad, net.precision)
        if code > RELU:
            for i in range(m * out_pad):
                scratch[out + i] = activate(code, scratch[target + i])
            if layer < hidden:
                round_to_precision(scratch, wp.int64(out), m * out_pad, net.precision)


@wp.func
def backward_block(
    net: Network,
    encoded: wp.array[wp.float32],
    first: wp.int64,
    rows: int,
    scratch: wp.array[wp.float32],
    base: int,
    dL_dweights: wp.array[wp.float32],
    chunk: wp.int64,
    want_input: int,
    feature_factor: wp.float32,
    dL_dencoded: wp.array[wp.float32],
):
    """From dL/d(output) in the first gradient block of the scratch to weights (added) and features.

    `want_input`: 0 leaves dL/dencoded alone, 1 writes it, 2 adds to it, times `feature_factor`.
    """
    m = (rows + 7) / 8 * 8
    n_layers = net.table.shape[0]
    current = base + net.gradient
    other = current + net.gradient_stride
    code = net.table[n_layers - 1, ACTIVATION]
    if code != 0:
        multiply_by_derivative(net, n_layers - 1, m, scratch, base, current)
    round_to_precision(scratch, wp.int64(current), m * net.table[n_layers - 1, OUT_PAD], net.precision)
    for step in range(n_layers):
        layer = n_layers - 1 - step
        in_pad = net.table[layer, IN_PAD]
        out_pad = net.table[layer, OUT_PAD]
        n_out = net.table[layer, N_OUT]
        grad = chunk + wp.int64(net.table[layer, GRAD])
        rows_of_w = (n_out + 7) / 8 * 8
        if layer == 0:
            multiply(
                scratch, wp.int64(current), 1, out_pad, encoded, first, in_pad, -1, dL_dweights, grad, in_pad,
                rows_of_w, in_pad, rows, 1, 0, scratch, wp.int64(0),
            )  # fmt: skip
        else:
            x = wp.int64(base + net.table[layer - 1, OUTPUT])
            multiply(
                scratch, wp.int64(current), 1, out_pad, scratch, x, in_pad, -1, dL_dweights, grad, in_pad, rows_of_w,
                in_pad, rows, 1, 0, scratch, wp.int64(0),
            )  # fmt: skip
        if net.table[layer, HAS_BIAS] != 0:
            add_column_sums(scratch, current, rows, out_pad, dL_dweights, grad + wp.int64(out_pad * in_pad))
        w = wp.int64(net.table[layer, W])
        if layer > 0:
            code = net.table[layer - 1, ACTIVATION]
            x = wp.int64(base + net.table[layer - 1, OUTPUT])
            multiply(
                scratch, wp.int64(current), out_pad, 1, net.packed, w, in_pad, -1, scratch, wp.int64(other), in_pad, m,
                in_pad, n_out, 0, wp.where(code == RELU, 2, 0), scratch, x,
            )  # fmt: skip
            if code > RELU:
                multiply_by_derivative(net, layer - 1, m, scratch, base, other)
            round_to_precision(scratch, wp.int64(other), m * in_pad, net.precision)
            swap = current
            current = other
            other = swap
        elif want_input != 0 and feature_factor == 1.0:
            multiply(
                scratch, wp.int64(current), out_pad, 1, net.packed, w, in_pad, -1, dL_dencoded, first, in_pad, m,
                in_pad, n_out, wp.where(want_input == 2, 1, 0), 0, scratch, wp.int64(0),
            )  # fmt: skip
        elif want_input != 0:
            multiply(
                scratch, wp.int64(current), out_pad, 1, net.packed, w, in_pad, -1, scratch, wp.int64(other), in_pad, m,
                in_pad, n_out, 0, 0, scratch, wp.int64(0),
            )  # fmt: skip
            write_scaled(scratch, other, m * in_pad, feature_factor, want_input - 1, dL_dencoded, first)


@wp.func
def multiply_by_derivative(
    net: Network, layer: int, rows: int, scratch: wp.array[wp.float32], base: int, gradient: int
):
    code = net.table[layer, ACTIVATION]
    value = base + net.table[layer, OUTPUT]
    if net.table[layer, FROM_INPUT] != 0:
        value = base + net.table[layer, INPUT_OF_ACTIVATION]
    n = net.table[layer, N_OUT]
    stride = net.table[layer, OUT_PAD]
    for r in range(rows):
        for i in range(n):
            at = r * stride + i
            scratch[gradient + at] = scratch[gradient + at] * derivative(code, scratch[value + at])


@wp.kernel
def infer(
    encoded: wp.array[wp.float32],
    first_row: int,
    end_row: int,
    net: Network,
    worker: int,
    scratch: wp.array[wp.float32],
    # out
    y: wp.array2d[wp.float32],
):
    """Forward pass, one thread per block of rows."""
    row = first_row + wp.tid() * BLOCK
    rows = wp.min(BLOCK, end_row - row)
    base = worker * net.scratch_size
    forward_block(net, encoded, wp.int64(row) * wp.int64(net.table[0, IN_PAD]), rows, scratch, base)
    last = net.table.shape[0] - 1
    write_rows(scratch, base + net.table[last, OUTPUT], net.table[last, OUT_PAD], rows, row, y)


@functools.cache
def make_train_kernel(loss):
    """The forward pass, the loss and the backward pass of a chunk of rows, one thread per chunk.

    Args:
        loss: A wp.func of `nn.losses.make_loss`; None: `target` is dL/dy already.
    """

    @wp.kernel(enable_backward=False, module="unique")
    def train(
        encoded: wp.array[wp.float32],
        n_rows: int,
        first_chunk: int,
        n_chunks: int,
        net: Network,
        worker: int,
        scratch: wp.array[wp.float32],
        target: wp.array2d[wp.float32],
        scale: wp.array[wp.float64],
        scale_factor: wp.float64,
        feature_factor: wp.float32,
        want_input: int,
        # out
        y: wp.array2d[wp.float32],
        losses: wp.array[wp.float64],
        dL_dweights: wp.array[wp.float32],
        dL_dencoded: wp.array[wp.float32],
    ):
        """Gradients inside the network are `scale` times `scale_factor` times those of the loss, summed over rows and
        outputs."""
        chunk = first_chunk + wp.tid()
        blocks = (n_rows + wp.static(BLOCK - 1)) / BLOCK
        block = wp.int32(wp.int64(blocks) * wp.int64(chunk) / wp.int64(n_chunks))
        end = wp.int32(wp.int64(blocks) * wp.int64(chunk + 1) / wp.int64(n_chunks))
        base = worker * net.scratch_size
        last = net.table.shape[0] - 1
        out = base + net.table[last, OUTPUT]
        stride = net.table[last, OUT_PAD]
        n_out = net.table[last, N_OUT]
        gradient = base + net.gradient
        factor = wp.float32(scale[0] * scale_factor)
        total = wp.float64(0.0)
        while block < end:
            row = block * BLOCK
            rows = wp.min(BLOCK, n_rows - row)
            first = wp.int64(row) * wp.int64(net.table[0, IN_PAD])
            forward_block(net, encoded, first, rows, scratch, base)
            for r in range(rows):
                for i in range(n_out, stride):
                    scratch[gradient + r * stride + i] = 0.0
                if wp.static(loss is None):
                    for i in range(n_out):
                        scratch[gradient + r * stride + i] = target[row + r, i] * factor
                else:
                    total += wp.float64(
                        loss(scratch, out + r * stride, target, row + r, factor, scratch, gradient + r * stride)
                    )
            if y.shape[0] > 0:
                write_rows(scratch, out, stride, rows, row, y)
            for i in range(rows * stride, (rows + 7) / 8 * 8 * stride):
                scratch[gradient + i] = 0.0
            backward_block(
                net,
                encoded,
                first,
                rows,
                scratch,
                base,
                dL_dweights,
                wp.int64(chunk) * wp.int64(net.gradient_size),
                want_input,
                feature_factor,
                dL_dencoded,
            )
            block += 1
        losses[chunk] = total

    return train


@wp.kernel
def add_chunks(
    net: Network,
    offsets: wp.array2d[wp.int32],
    n_chunks: int,
    factor: wp.float64,
    # in and out
    dL_dweights: wp.array[wp.float32],
    gradients: wp.array[wp.float32],
):
    """Adds the chunks, in order and times a factor, to the gradients of all parameters.

    Threads: layers × outputs of the widest.
    """
    layer, o = wp.tid()
    if o >= net.table[layer, N_OUT]:
        return
    n_in = net.table[layer, N_IN]
    in_pad = net.table[layer, IN_PAD]
    to = offsets[layer, 0] + o * n_in
    for i in range(n_in + net.table[layer, HAS_BIAS]):
        at = net.table[layer, GRAD] + o * in_pad + i
        where = to + i
        if i == n_in:
            at = net.table[layer, GRAD] + net.table[layer, OUT_PAD] * in_pad + o
            where = offsets[layer, 1] + o
        total = wp.float64(0.0)
        for chunk in range(n_chunks):
            total += wp.float64(dL_dweights[chunk * net.gradient_size + at])
        gradients[where] = gradients[where] + wp.float32(total * factor)


def n_blocks(n: int) -> int:
    """Blocks that hold `n` rows."""
    return -(-n // BLOCK)
