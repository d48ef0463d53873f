"""Samplers: where the four numbers of a decision come from.

``independent`` is Philox. ``sobol`` is a Sobol sequence of four dimensions with Owen's scrambling (Owen 1995, "Randomly
Permuted (t,m,s)-Nets and (t,s)-Sequences"), both scrambled and shuffled by hashing (Laine and Karras 2011; Burley 2020,
"Practical Hash-based Owen Scrambling"). It is padded: every pixel, bounce and purpose has a sequence of its own, in
which a sample is the point of its index. No two decisions share a dimension, and shuffling pairs their points at
random. So each decision alone is well distributed over the samples of a pixel, best where they are a power of two.

Both samplers are functions of (seed, pixel, sample, bounce, purpose) alone, and under both each number is uniform; only
under the first are the samples of a pixel independent. Another seed is an independent randomisation.

Dimensions of the sequence that a decision uses, by the component of the result:

=========== =========================================================================================
purpose     dimensions
=========== =========================================================================================
camera      0, 1: position on the film; 2, 3: on the lens
light       0: u[1] and 1: u[2], place on the light; 2: u[0], which light; 3: u[3], place in a cell of a map
BSDF        0, 1: direction; 2: lobe; 3: Russian roulette
others      0 to 3
=========== =========================================================================================

Dimensions 0 and 1 are a (0,2)-sequence: of the first 2^m points, and of any aligned block of so many, every elementary
interval of area 2^-m holds one. The first three are a (1,3)-sequence, all four a (3,4)-sequence, and each alone a
(0,1)-sequence (Niederreiter 1992).
"""

import warp as wp

from wavefront.rng import PURPOSE_LIGHT, philox, to_unit_interval, uniform4

_SHIFT_32 = wp.constant(wp.uint64(32))


@wp.func
def reverse_bits(x: wp.uint32) -> wp.uint32:
    """Bit 0 becomes bit 31: halves, bytes, nibbles, pairs and bits change places."""
    x = (x << wp.uint32(16)) | (x >> wp.uint32(16))
    x = ((x & wp.uint32(0x00FF00FF)) << wp.uint32(8)) | ((x >> wp.uint32(8)) & wp.uint32(0x00FF00FF))
    x = ((x & wp.uint32(0x0F0F0F0F)) << wp.uint32(4)) | ((x >> wp.uint32(4)) & wp.uint32(0x0F0F0F0F))
    x = ((x & wp.uint32(0x33333333)) << wp.uint32(2)) | ((x >> wp.uint32(2)) & wp.uint32(0x33333333))
    return ((x & wp.uint32(0x55555555)) << wp.uint32(1)) | ((x >> wp.uint32(1)) & wp.uint32(0x55555555))


@wp.func
def scramble(digits: wp.uint32, shift: wp.uint32, factor: wp.uint32) -> wp.uint32:
    """A nested uniform scramble of binary digits, of which bit 0 is the most significant.

    Sums and products carry from a bit to higher ones alone, so what happens to a digit depends on those of more
    significance, as in Owen's tree. The constants are those of Vegdahl 2021, "Building a Better LK Hash"; but where he
    derives the factor from the shift, these are two random numbers: the sum makes the result uniform, exactly, for any
    digits and any factor.
    """
    x = digits ^ (digits * wp.uint32(0x3D20ADEA))
    x = (x + shift) * (factor | wp.uint32(1))
    x = x ^ (x * wp.uint32(0x05526C56))
    return x ^ (x * wp.uint32(0x53A22864))


@wp.func
def shuffled_index(sample: wp.uint32, shift: wp.uint32, factor: wp.uint32) -> wp.uint32:
    """A permutation of the indices that maps every aligned block of a power of two to such a block.

    It is a scramble with the most significant digit first, less its value at zero. That is a constant digital shift of
    the points, which is lost in their own scrambling; without it the first 2^m indices stay the first, and have no
    digits beyond those needed to count them.
    """
    at_zero = scramble(wp.uint32(0), shift, factor)
    return reverse_bits(scramble(reverse_bits(sample), shift, factor) ^ at_zero)


@wp.func
def sobol_digits(index: wp.uint32) -> wp.vec4ui:
    """The point of an index in four dimensions of Sobol's sequence; bit k is the digit of weight 2^-(k+1).

    The primitive polynomials are x (van der Corput's sequence), x + 1, x^2 + x + 1 and x^3 + x + 1, and the first
    direction numbers those of Joe and Kuo 2008. The others follow by recurrence, which shifts to the left in this order
    of bits.
    """
    x1 = wp.uint32(0)
    x2 = wp.uint32(0)
    x3 = wp.uint32(0)
    # Direction numbers of the current digit of the index, and those that its successors need.
    a1 = wp.uint32(1)
    a2 = wp.uint32(1)
    b2 = wp.uint32(3)
    a3 = wp.uint32(1)
    b3 = wp.uint32(3)
    c3 = wp.uint32(4)
    rest = index
    while rest != wp.uint32(0):
        if (rest & wp.uint32(1)) != wp.uint32(0):
            x1 = x1 ^ a1
            x2 = x2 ^ a2
            x3 = x3 ^ a3
        a1 = a1 ^ (a1 << wp.uint32(1))
        next2 = b2 ^ a2 ^ (a2 << wp.uint32(2))
        a2 = b2
        b2 = next2
        next3 = b3 ^ a3 ^ (a3 << wp.uint32(3))
        a3 = b3
        b3 = c3
        c3 = next3
        rest = rest >> wp.uint32(1)
    return wp.vec4ui(index, x1, x2, x3)


@wp.func
def sobol4(seed: wp.uint64, pixel: wp.uint32, sample: wp.uint32, bounce: wp.int32, purpose: wp.int32) -> wp.vec4:
    """Four numbers in [0, 1): the point of index `sample` in the sequence of the other four integers."""
    key = wp.vec2ui(wp.uint32(seed), wp.uint32(seed >> _SHIFT_32))
    shifts = philox(wp.vec4ui(pixel, wp.uint32(0), wp.uint32(bounce), wp.uint32(purpose)), key)
    factors = philox(wp.vec4ui(pixel, wp.uint32(1), wp.uint32(bounce), wp.uint32(purpose)), key)
    # Only the shifts have to be the points' own for these to be uniform.
    digits = sobol_digits(shuffled_index(sample, factors[0], factors[1]))
    x0 = to_unit_interval(reverse_bits(scramble(digits[0], shifts[0], factors[2])))
    x1 = to_unit_interval(reverse_bits(scramble(digits[1], shifts[1], factors[3])))
    x2 = to_unit_interval(reverse_bits(scramble(digits[2], shifts[2], factors[0])))
    x3 = to_unit_interval(reverse_bits(scramble(digits[3], shifts[3], factors[1])))
    if purpose == PURPOSE_LIGHT:
        return wp.vec4(x2, x0, x1, x3)
    return wp.vec4(x0, x1, x2, x3)


# By the name in a scene: functions of (seed, pixel, sample, bounce, purpose), of which a kernel is built with one.
SAMPLERS = {"independent": uniform4, "sobol": sobol4}
