"""The grid on the CPU device: blocks of 64 rows, indices and weights computed in vectors, features added one by one.

The same definition as in `nn.encodings.grid`, whose kernels are Warp alone and several times slower here.
"""

import functools

import warp as wp

from nn.encodings.grid import Levels

# Cells and positions of rows `first` … `first + n` of one level, then index and weight of every corner.
_PREPARE = """
    typedef unsigned int u32;
    typedef float feature __attribute__((ext_vector_type({F}), aligned(4)));
    constexpr int D = {D}, F = {F}, C = {C}, B = 64;
    constexpr u32 prime[4] = {{1u, 2654435761u, 805459861u, 3674653429u}};
    const float scale = levels.scale.data[level];
    const u32 size = levels.size.data[level];
    const size_t offset = size_t(levels.offset.data[level]);
    const bool hashed = {HASHED} && levels.hashed.data[level];
    const int ldx = x.shape[1];
    const int lde = {ENCODED}.shape[1];
    const int first_column = column + level * F;
    u32 cell[D][B], idx[C][B];
    float p[D][B], t[D][B], w[C][B];
    auto prepare = [&](int first, int n) {{
        for (int d = 0; d < D; ++d)
            for (int i = 0; i < B; ++i) p[d][i] = i < n ? x.data[size_t(first + i) * ldx + first_dim + d] : 0.0f;
        for (int d = 0; d < D; ++d)
            for (int i = 0; i < B; ++i) {{
                const float v = p[d][i];
                float whole = __builtin_floorf(v * scale + 0.5f);
                const bool near = __builtin_fabsf(whole) < 1073741824.0f;  // false for NaN
                // The rounding of x · scale would be magnified by the differences between vertices, or miss the cell.
                float f = __builtin_fmaf(v, scale, 0.5f - whole);
                whole += f < 0.0f ? -1.0f : f >= 1.0f ? 1.0f : 0.0f;
                f = near ? __builtin_fmaf(v, scale, 0.5f - whole) : v - v;
                cell[d][i] = u32(static_cast<int>(near ? whole : 0.0f));
                p[d][i] = f;
                t[d][i] = {SMOOTH} ? f * f * (3.0f - 2.0f * f) : f;
            }}
        for (int c = 0; c < C; ++c) {{
            u32 beyond = 0;
            for (int i = 0; i < B; ++i) {{
                u32 sum = 0, mix = 0;
                float product = {NEAREST} ? 1.0f + (p[0][i] - p[0][i]) : 1.0f;  // NaN stays NaN
                for (int d = 0; d < D; ++d) {{
                    const u32 vertex = cell[d][i] + ((c >> d) & 1);
                    if ({HASHED}) mix ^= vertex * prime[d];
                    sum += vertex * levels.stride.data[level * 4 + d];
                    if (!{NEAREST}) product *= ((c >> d) & 1) ? t[d][i] : 1.0f - t[d][i];
                }}
                const u32 index = hashed ? mix & (size - 1) : sum;
                beyond |= index >= size;
                idx[c][i] = index;
                w[c][i] = product;
            }}
            if (beyond)
                for (int i = 0; i < B; ++i) idx[c][i] %= size;
        }}
    }};
"""

_FORWARD = """
    prepare(first_row, n_rows);
    const float* table = (const float*)features.data + offset * F;
    for (int i = 0; i < n_rows; ++i) {
        feature value = 0.0f;
        for (int c = 0; c < C; ++c) value += w[c][i] * *(const feature*)(table + size_t(idx[c][i]) * F);
        *(feature*)(encoded.data + size_t(first_row + i) * lde + first_column) = value;
    }
"""

_BACKWARD = """
    typedef double feature_sum __attribute__((ext_vector_type(F)));
    float* table = (float*)dL_dfeatures.data + offset * F;
    feature_sum run[C];  // of consecutive rows of one cell, whose rounding would add up
    u32 run_cell[D], run_idx[C];
    bool running = false;
    auto flush = [&]() {
        for (int c = 0; c < C; ++c)
            *(feature*)(table + size_t(run_idx[c]) * F) += __builtin_convertvector(run[c], feature);
        running = false;
    };
    for (int first = 0; first < n_rows; first += B) {
        const int n = n_rows - first < B ? n_rows - first : B;
        prepare(first, n);
        for (int i = 0; i < n; ++i) {
            const feature g = *(const feature*)(dL_dencoded.data + size_t(first + i) * lde + first_column);
            if (running) {
                bool same = true;
                for (int d = 0; d < D; ++d) same = same && cell[d][i] == run_cell[d];
                if (!same) flush();
            }
            if (!running && i + 1 < n) {
                bool same = true;
                for (int d = 0; d < D; ++d) same = same && cell[d][i] == cell[d][i + 1];
                if (same) {
                    running = true;
                    for (int d = 0; d < D; ++d) run_cell[d] = cell[d][i];
                    for (int c = 0; c < C; ++c) {
                        run_idx[c] = idx[c][i];
                        run[c] = 0.0;
                    }
                }
            }
            if (running) {
                for (int c = 0; c < C; ++c) run[c] += __builtin_convertvector(w[c][i] * g, feature_sum);
            } else {
                for (int c = 0; c < C; ++c) *(feature*)(table + size_t(idx[c][i]) * F) += w[c][i] * g;
            }
        }
    }
    if (running) flush();
"""

_BACKWARD_INPUTS = """
    if ({NEAREST}) return;
    const float* table = (const float*)features.data + offset * F;
    prepare(first_row, n_rows);
    float s[C][B], total[D][B];
    for (int i = 0; i < n_rows; ++i) {{
        const feature g = *(const feature*)(dL_dencoded.data + size_t(first_row + i) * lde + first_column);
        for (int c = 0; c < C; ++c) {{
            const feature product = g * *(const feature*)(table + size_t(idx[c][i]) * F);
            float sum = 0.0f;
            for (int f = 0; f < F; ++f) sum += product[f];
            s[c][i] = sum;
        }}
    }}
    for (int d = 0; d < D; ++d) {{
        for (int i = 0; i < B; ++i) total[d][i] = 0.0f;
        for (int c = 0; c < C; ++c)
            for (int i = 0; i < n_rows; ++i) {{
                float slope = ((c >> d) & 1) ? scale : -scale;
                if ({SMOOTH}) slope *= 6.0f * p[d][i] * (1.0f - p[d][i]);
                for (int o = 0; o < D; ++o)
                    if (o != d) slope *= ((c >> o) & 1) ? t[o][i] : 1.0f - t[o][i];
                total[d][i] += s[c][i] * slope;
            }}
        for (int i = 0; i < n_rows; ++i) dL_dx.data[size_t(first_row + i) * ldx + first_dim + d] += total[d][i];
    }}
"""


@functools.cache
def make_cpu_grid_kernels(n_dims: int, n_features: int, interpolation: str, hashed: bool):
    """Kernels of one kind of grid for the CPU device; arguments as of `nn.encodings.grid.make_grid_kernels`.

    Returns:
        forward (threads: blocks of 64 rows × levels), backward to parameters (one thread per level), backward to inputs
        (one thread per block of 64 rows).
    """
    Feature = wp.types.vector(n_features, wp.float32)
    values = {
        "D": n_dims,
        "F": n_features,
        "C": 1 if interpolation == "Nearest" else 1 << n_dims,
        "SMOOTH": int(interpolation == "Smoothstep"),
        "NEAREST": int(interpolation == "Nearest"),
        "HASHED": int(hashed),
    }
    kernel = wp.kernel(
        enable_backward=False, module=f"nn.encodings.cpu_grid_{n_dims}_{n_features}_{interpolation}_{int(hashed)}"
    )

    def snippet(body, encoded):
        return _PREPARE.format(**values, ENCODED=encoded) + body

    @wp.func_native(snippet(_FORWARD, "encoded"))
    def forward_block(
        x: wp.array2d[wp.float32],
        first_row: int,
        n_rows: int,
        first_dim: int,
        levels: Levels,
        level: int,
        features: wp.array[Feature],
        encoded: wp.array2d[wp.float32],
        column: int,
    ): ...

    @wp.func_native(snippet(_BACKWARD, "dL_dencoded"))
    def backward_level(
        x: wp.array2d[wp.float32],
        n_rows: int,
        first_dim: int,
        levels: Levels,
        level: int,
        dL_dencoded: wp.array2d[wp.float32],
        column: int,
        dL_dfeatures: wp.array[Feature],
    ): ...

    @wp.func_native(snippet(_BACKWARD_INPUTS.format(**values), "dL_dencoded"))
    def backward_inputs_block(
        x: wp.array2d[wp.float32],
        first_row: int,
        n_rows: int,
        first_dim: int,
        levels: Levels,
        level: int,
        features: wp.array[Feature],
        dL_dencoded: wp.array2d[wp.float32],
        column: int,
        dL_dx: wp.array2d[wp.float32],
    ): ...

    @kernel
    def forward(
        x: wp.array2d[wp.float32],
        first_row: int,
        end_row: int,
        first_dim: int,
        levels: Levels,
        features: wp.array[Feature],
        # out
        encoded: wp.array2d[wp.float32],
        column: int,
    ):
        block, level = wp.tid()  # a block stays in the cache for all its levels
        row = first_row + block * 64
        forward_block(x, row, wp.min(64, end_row - row), first_dim, levels, level, features, encoded, column)

    @kernel
    def backward(
        x: wp.array2d[wp.float32],
        n_rows: int,
        first_dim: int,
        levels: Levels,
        first_level: int,
        dL_dencoded: wp.array2d[wp.float32],
        column: int,
        # out
        dL_dfeatures: wp.array[Feature],
    ):
        backward_level(x, n_rows, first_dim, levels, first_level + wp.tid(), dL_dencoded, column, dL_dfeatures)

    @kernel
    def backward_inputs(
        x: wp.array2d[wp.float32],
        first_row: int,
        end_row: int,
        first_dim: int,
        levels: Levels,
        n_levels: int,
        features: wp.array[Feature],
        dL_dencoded: wp.array2d[wp.float32],
        column: int,
        # out
        dL_dx: wp.array2d[wp.float32],
    ):
        row = first_row + wp.tid() * 64
        for level in range(n_levels):
            backward_inputs_block(
                x, row, wp.min(64, end_row - row), first_dim, levels, level, features, dL_dencoded, column, dL_dx
            )

    return forward, backward, backward_inputs
