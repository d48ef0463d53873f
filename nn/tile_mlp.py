"""Execution of an MLP by thread blocks: a tile of rows goes through all layers in shared memory (CUDA).

There are three products: a tile of rows times the transpose of a square block of weights, the same times the block
itself, and the transpose of a tile times a tile. Wider inputs and outputs are several blocks, so all networks of one
width share their kernels, whatever their depth. Products accumulate in float32; their operands have the precision of
the network (`Shape.dtype`).

A training block takes its tiles one after the other and adds their weight gradients to matrices of its own, so that
sums do not depend on timing. What the hidden layers gave it keeps in a scratch of its own, which stays in the L2 cache.

The CPU device runs the same kernels in tests, one launch at a time: its tiles share one static arena.

Warp leaves functions that are arguments of `tile_map` out of the hash of a module, unless they are static expressions:
`wp.static` around them keeps kernels that differ in nothing else apart.
"""

import dataclasses
import functools
import types

import warp as wp

from nn.activations import CODES, FROM_INPUT, activate, derivative


@dataclasses.dataclass(frozen=True)
class Shape:
    """What the kernels of a network are built for.

    Attributes:
        dtype: Of the operands of products, a Warp scalar type.
        width: Of the hidden layers and of the blocks of weights.
        activation: Of the hidden layers.
        output_activation: Of the last layer.
        bias: Layers have biases.
    """

    dtype: type
    width: int
    activation: str
    output_activation: str
    bias: bool

    @property
    def rows(self) -> int:
        """Of a tile: what lets at least one training block of the widest network fit a multiprocessor."""
        if self.dtype is wp.float32:
            return 32 if self.width == 128 else 64
        return 64 if self.width == 128 else 128

    @property
    def threads(self) -> int:
        """Of a thread block."""
        return min(max(self.rows * self.width // 32, 64), 256)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def synchronize():
    """Waits for all threads of the block, and makes visible what they wrote."""
    ...


@functools.cache
def make_functions(shape: Shape):
    """The steps that inference and training share.

    Returns:
        The struct of a network, and functions over tiles; see their docstrings.
    """
    M, T, dtype = shape.rows, shape.width, shape.dtype
    code, out_code = CODES[shape.activation], CODES[shape.output_activation]
    from_input, bias = shape.activation in FROM_INPUT, shape.bias
    Operand = wp.tile(dtype=dtype, shape=(M, T), storage="shared")
    Sum = wp.tile(dtype=wp.float32, shape=(M, T), storage="shared")
    BETA = 1.0 if bias else 0.0  # of a layer's first product: sums begin with the biases, or with nothing

    @wp.struct
    class Network:
        """A network as the kernels read it; a layer of several blocks has those of one output side by side."""

        weights: wp.array2d[dtype]  # [blocks · width, width]
        biases: wp.array2d[wp.float32]  # [hidden layers + blocks of outputs, width]
        depth: int  # hidden layers
        n_in: int  # blocks of features
        n_out: int  # blocks of outputs
        n_outputs: int  # their columns
        n_blocks: int  # of weights, in all

    @wp.func
    def operand(x: wp.float32):
        return dtype(x)

    @wp.func
    def single(x: dtype):
        return wp.float32(x)

    @wp.func
    def value(z: wp.float32):
        """What is kept of a hidden sum: its activation, or itself where the derivative needs that."""
        if wp.static(from_input):
            return dtype(z)
        return dtype(activate(code, z))

    @wp.func
    def activation(v: dtype):
        """The activation of a kept value."""
        if wp.static(from_input):
            return dtype(activate(code, wp.float32(v)))
        return v

    @wp.func
    def slope(g: wp.float32, v: dtype):
        return dtype(g * derivative(code, wp.float32(v)))

    @wp.func
    def output(z: wp.float32):
        return activate(out_code, z)

    @wp.func
    def load_operand(a: wp.array2d[wp.float32], row: int, block: int, h: Operand):
        """A block of columns; zeros beyond the array."""
        wp.tile_assign(h, wp.tile_map(wp.static(operand), wp.tile_load(a, shape=(M, T), offset=(row, block * T))))

    @wp.func
    def begin(biases: wp.array2d[wp.float32], row: int, z: Sum):
        """Starts the sums of a layer with its biases."""
        if wp.static(bias):
            b = wp.tile_load(biases, shape=(1, T), offset=(row, 0), storage="shared")
            wp.tile_assign(z, wp.tile_broadcast(b, shape=(M, T)))
            synchronize()

    @wp.func
    def multiply(h: Operand, weights: wp.array2d[dtype], block: int, z: Sum, beta: wp.float32):
        """z = h · Wᵀ + beta z"""
        w = wp.tile_load(weights, shape=(T, T), offset=(block * T, 0), storage="shared")
        wp.tile_matmul(h, wp.tile_transpose(w), z, beta=beta)

    @wp.func
    def multiply_back(g: Operand, weights: wp.array2d[dtype], block: int, z: Sum, beta: wp.float32):
        """z = g · W + beta z"""
        w = wp.tile_load(weights, shape=(T, T), offset=(block * T, 0), storage="shared")
        wp.tile_matmul(g, w, z, beta=beta)

    @wp.func
    def accumulate(g: Operand, h: Operand, dL_dweights: wp.array2d[wp.float32], block: int):
        """Adds gᵀ · h to a block of gradients of weights."""
        total = wp.tile_load(dL_dweights, shape=(T, T), offset=(block * T, 0), storage="shared")
        wp.tile_matmul(wp.tile_transpose(g), h, total)
        wp.tile_store(dL_dweights, total, offset=(block * T, 0))
        synchronize()  # before the room of `total` is another's

    @wp.func
    def accumulate_biases(g: Operand, dL_dbiases: wp.array2d[wp.float32], row: int):
        """Adds the sums of columns to the gradients of biases."""
        if wp.static(bias):
            sums = wp.tile_sum(wp.tile_map(wp.static(single), g), axis=0)
            total = wp.tile_load(dL_dbiases[row], shape=T, offset=0)
            wp.tile_store(dL_dbiases[row], total + sums, offset=0)
            synchronize()

    @wp.func
    def hidden_layers(
        features: wp.array2d[wp.float32],
        row: int,
        net: Network,
        h: Operand,
        z: Sum,
        values: wp.array2d[dtype],
        kept: int,
    ):
        """What the last hidden layer gives, in `h`; the values of all are kept from row `kept` on, if that is not
        negative."""
        for layer in range(net.depth):
            begin(net.biases, layer, z)
            if layer == 0:
                for block in range(net.n_in):
                    load_operand(features, row, block, h)
                    multiply(h, net.weights, block, z, wp.where(block == 0, BETA, 1.0))
            else:
                multiply(h, net.weights, net.n_in + layer - 1, z, BETA)
            v = wp.tile_map(wp.static(value), z)
            if kept >= 0:
                wp.tile_store(values, v, offset=(kept + layer * M, 0))
            wp.tile_assign(h, wp.tile_map(wp.static(activation), v))

    @wp.func
    def output_layer(features: wp.array2d[wp.float32], row: int, net: Network, block: int, h: Operand, z: Sum):
        """A block of outputs before their activation, in `z`."""
        begin(net.biases, net.depth + block, z)
        if net.depth > 0:
            multiply(h, net.weights, net.n_in + net.depth - 1 + block, z, BETA)
        else:
            for column in range(net.n_in):
                load_operand(features, row, column, h)
                multiply(h, net.weights, block * net.n_in + column, z, wp.where(column == 0, BETA, 1.0))

    return types.SimpleNamespace(**locals())


@functools.cache
def make_infer_kernel(shape: Shape):
    """The forward pass of a tile of rows; one thread block per tile."""
    f = make_functions(shape)
    M, T, dtype, Network, output = f.M, f.T, f.dtype, f.Network, f.output
    hidden_layers, output_layer = f.hidden_layers, f.output_layer

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def infer(
        features: wp.array2d[wp.float32],
        net: Network,
        # out
        y: wp.array2d[wp.float32],
    ):
        tile, _lane = wp.tid()
        row = tile * M
        h = wp.tile_empty(shape=(M, T), dtype=dtype, storage="shared")
        z = wp.tile_empty(shape=(M, T), dtype=wp.float32, storage="shared")
        hidden_layers(features, row, net, h, z, net.weights, -1)
        for block in range(net.n_out):
            output_layer(features, row, net, block, h, z)
            wp.tile_store(y, wp.tile_map(wp.static(output), z), offset=(row, block * T))

    return infer


@functools.cache
def make_train_kernel(shape: Shape, loss):
    """The forward pass, the loss and the backward pass over tiles of rows; a thread block takes a range of tiles.

    Args:
        shape: Of the network.
        loss: A wp.func of `nn.losses.make_loss`; None: `target` is dL/dy already.
    """
    f = make_functions(shape)
    M, T, dtype, Network = f.M, f.T, f.dtype, f.Network
    hidden_layers, output_layer, load_operand = f.hidden_layers, f.output_layer, f.load_operand
    multiply_back, accumulate, accumulate_biases = f.multiply_back, f.accumulate, f.accumulate_biases
    activation, slope = f.activation, f.slope
    out_code, before_needed = f.out_code, shape.output_activation in FROM_INPUT

    @wp.struct
    class Scratch:
        """Room of the training blocks, block after block."""

        values: wp.array2d[dtype]  # of hidden layers, [blocks · depth · rows, width]
        sums: wp.array2d[wp.float32]  # outputs before their activation, [blocks · rows, padded outputs]
        outputs: wp.array[wp.float32]
        gradients: wp.array2d[wp.float32]  # with respect to `sums`
        flat_gradients: wp.array[wp.float32]  # the same memory

    @wp.func
    def store_sums(z: f.Sum, sums: wp.array2d[wp.float32], row: int, block: int):
        wp.tile_store(sums, z, offset=(row, block * T))

    @wp.func
    def load_activations(values: wp.array2d[dtype], row: int, h: f.Operand):
        wp.tile_assign(h, wp.tile_map(wp.static(activation), wp.tile_load(values, shape=(M, T), offset=(row, 0))))

    @wp.func
    def multiply_by_slopes(z: f.Sum, values: wp.array2d[dtype], row: int, g: f.Operand):
        """Gradients with respect to hidden sums from those with respect to what the layer gave."""
        wp.tile_assign(g, wp.tile_map(wp.static(slope), z, wp.tile_load(values, shape=(M, T), offset=(row, 0))))

    @wp.func
    def write_input_gradient(
        z: f.Sum, factor: wp.float32, dL_dfeatures: wp.array2d[wp.float32], row: int, block: int, add: bool
    ):
        scaled = z * factor
        if add:
            scaled += wp.tile_load(dL_dfeatures, shape=(M, T), offset=(row, block * T))
        wp.tile_store(dL_dfeatures, scaled, offset=(row, block * T))

    @wp.func
    def differentiate_rows(
        first_row: int,
        n_rows: int,
        lane: int,
        base: int,
        n_out: int,
        target: wp.array2d[wp.float32],
        factor: wp.float32,
        scratch: Scratch,
        y: wp.array2d[wp.float32],
    ):
        """Outputs, loss, and gradients with respect to the sums of the last layer, of the rows of one thread."""
        stride = scratch.sums.shape[1]
        total = wp.float64(0.0)
        r = int(lane)
        while r < M:
            at = (base + r) * stride
            if first_row + r < n_rows:
                for i in range(n_out):
                    scratch.outputs[at + i] = activate(out_code, scratch.sums[base + r, i])
                if wp.static(loss is None):
                    for i in range(n_out):
                        scratch.gradients[base + r, i] = target[first_row + r, i] * factor
                else:
                    total += wp.float64(
                        loss(scratch.outputs, at, target, first_row + r, factor, scratch.flat_gradients, at)
                    )
                if y.shape[0] > 0:
                    for i in range(n_out):
                        y[first_row + r, i] = scratch.outputs[at + i]
                for i in range(n_out):
                    v = scratch.outputs[at + i]
                    if wp.static(before_needed):
                        v = scratch.sums[base + r, i]
                    scratch.gradients[base + r, i] = scratch.gradients[base + r, i] * derivative(out_code, v)
            else:
                for i in range(n_out):
                    scratch.gradients[base + r, i] = 0.0
            r += wp.block_dim()
        return total

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def train(
        features: wp.array2d[wp.float32],
        n_rows: int,
        net: Network,
        target: wp.array2d[wp.float32],
        scale: wp.array[wp.float64],
        scale_factor: wp.float64,
        feature_factor: wp.float32,
        want_input: int,
        scratch: Scratch,
        # out
        y: wp.array2d[wp.float32],
        losses: wp.array2d[wp.float64],
        dL_dweights: wp.array2d[wp.float32],
        dL_dbiases: wp.array2d[wp.float32],
        dL_dfeatures: wp.array2d[wp.float32],
    ):
        """Gradients of a network.

        Those inside it are `scale` times `scale_factor` times that of the loss, summed over rows and outputs;
        `feature_factor` is applied to those of the features on top. `want_input`: 0 leaves dL/dfeatures alone, 1 writes
        it, 2 adds to it.
        """
        chunk, lane = wp.tid()
        n_tiles = (n_rows + M - 1) / M
        tile = wp.int32(wp.int64(n_tiles) * wp.int64(chunk) / wp.int64(losses.shape[0]))
        end = wp.int32(wp.int64(n_tiles) * wp.int64(chunk + 1) / wp.int64(losses.shape[0]))
        h = wp.tile_empty(shape=(M, T), dtype=dtype, storage="shared")
        g = wp.tile_empty(shape=(M, T), dtype=dtype, storage="shared")
        z = wp.tile_empty(shape=(M, T), dtype=wp.float32, storage="shared")
        base = chunk * M
        kept = base * net.depth
        weights = chunk * net.n_blocks
        biases = chunk * (net.depth + net.n_out)
        factor = wp.float32(scale[0] * scale_factor)
        last = net.n_blocks - net.n_out
        total = wp.float64(0.0)
        while tile < end:
            row = tile * M
            hidden_layers(features, row, net, h, z, scratch.values, kept)
            for block in range(net.n_out):
                output_layer(features, row, net, block, h, z)
                store_sums(z, scratch.sums, base, block)
            synchronize()
            total += differentiate_rows(row, n_rows, lane, base, net.n_outputs, target, factor, scratch, y)
            synchronize()
            for block in range(net.n_out):
                load_operand(scratch.gradients, base, block, g)
                accumulate_biases(g, dL_dbiases, biases + net.depth + block)
                if net.depth > 0:
                    accumulate(g, h, dL_dweights, weights + last + block)
                    multiply_back(g, net.weights, last + block, z, wp.where(block == 0, 0.0, 1.0))
                else:
                    for column in range(net.n_in):
                        load_operand(features, row, column, h)
                        accumulate(g, h, dL_dweights, weights + block * net.n_in + column)
                        if want_input != 0:
                            multiply_back(g, net.weights, block * net.n_in + column, z, 0.0)
                            write_input_gradient(
                                z, feature_factor, dL_dfeatures, row, column, want_input == 2 or block > 0
                            )
            for step in range(net.depth):
                layer = net.depth - 1 - step
                multiply_by_slopes(z, scratch.values, kept + layer * M, g)
                accumulate_biases(g, dL_dbiases, biases + layer)
                if layer > 0:
                    load_activations(scratch.values, kept + (layer - 1) * M, h)
                    accumulate(g, h, dL_dweights, weights + net.n_in + layer - 1)
                    multiply_back(g, net.weights, net.n_in + layer - 1, z, 0.0)
                else:
                    for column in range(net.n_in):
                        load_operand(features, row, column, h)
                        accumulate(g, h, dL_dweights, weights + column)
                        if want_input != 0:
                            multiply_back(g, net.weights, column, z, 0.0)
                            write_input_gradient(z, feature_factor, dL_dfeatures, row, column, want_input == 2)
            synchronize()  # before the scratch is written again
            tile += 1
        losses[chunk, lane] = total

    return types.SimpleNamespace(kernel=train, Scratch=Scratch)


@functools.cache
def make_pack_kernel(dtype):
    """Copies parameters to where the products read them."""

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def pack(parameters: wp.array[wp.float32], source: wp.array[wp.int32], packed: wp.array[dtype]):
        """`source`: the parameter of each entry; -1: none, it stays zero."""
        i = wp.tid()
        if source[i] >= 0:
            packed[i] = dtype(parameters[source[i]])

    return pack


@wp.kernel(module="unique", module_options={"enable_backward": False})
def add_chunks(
    source: wp.array[wp.int32],
    n_chunks: int,
    factor: wp.float64,
    # in and out
    chunks: wp.array[wp.float32],
    gradients: wp.array[wp.float32],
):
    """Adds the sums of all blocks, in order and times a factor, to the gradients of the parameters, and clears them."""
    i = wp.tid()
    total = wp.float64(0.0)
    for chunk in range(n_chunks):
        at = chunk * source.shape[0] + i
        total += wp.float64(chunks[at])
        chunks[at] = 0.0
    if source[i] >= 0:
        gradients[source[i]] = gradients[source[i]] + wp.float32(total * factor)
