"""Random numbers as a pure function of who asks for them.

Philox-4x32-10 (Salmon, Moraes, Dror and Shaw 2011, "Parallel Random Numbers: As Easy as 1, 2, 3") maps a 128-bit
counter and a 64-bit key to 128 random bits. There is no state to carry: the key is the seed, and the counter says
which pixel, sample, bounce and purpose the numbers are for. So an image does not depend on the order in which paths
are processed, and any path can be traced again alone.
"""

import warp as wp

# Purposes: what the four numbers of one counter are used for. A new use takes a new number; numbers are never reused.
PURPOSE_CAMERA = wp.constant(0)  # position on the film and on the lens
PURPOSE_LIGHT = wp.constant(1)  # choice of a light and of a point on it
PURPOSE_BSDF = wp.constant(2)  # lobe, direction, and Russian roulette
PURPOSE_TECHNIQUE = wp.constant(3)  # whether the BSDF or the guide is sampled
PURPOSE_GUIDE = wp.constant(16)  # 16 to 31 belong to guiding methods

# Multipliers and Weyl increments of Salmon et al. 2011, section 3.3 (Weyl: golden ratio and sqrt(3) - 1).
_MULTIPLIER_0 = wp.constant(wp.uint64(0xD2511F53))
_MULTIPLIER_1 = wp.constant(wp.uint64(0xCD9E8D57))
_WEYL_0 = wp.constant(wp.uint32(0x9E3779B9))
_WEYL_1 = wp.constant(wp.uint32(0xBB67AE85))
_SHIFT_32 = wp.constant(wp.uint64(32))


@wp.func
def philox(counter: wp.vec4ui, key: wp.vec2ui) -> wp.vec4ui:
    """Ten rounds of Philox-4x32.

    A round multiplies two of the four words to 64 bits each and swaps the halves across, xor-ing the high halves with
    the other two words and the key. The key advances by a Weyl sequence between rounds.
    """
    c0 = counter[0]
    c1 = counter[1]
    c2 = counter[2]
    c3 = counter[3]
    k0 = key[0]
    k1 = key[1]
    for _ in range(10):
        product0 = _MULTIPLIER_0 * wp.uint64(c0)
        product1 = _MULTIPLIER_1 * wp.uint64(c2)
        c0 = wp.uint32(product1 >> _SHIFT_32) ^ c1 ^ k0
        c2 = wp.uint32(product0 >> _SHIFT_32) ^ c3 ^ k1
        c1 = wp.uint32(product1)
        c3 = wp.uint32(product0)
        k0 = k0 + _WEYL_0
        k1 = k1 + _WEYL_1
    return wp.vec4ui(c0, c1, c2, c3)


@wp.func
def to_unit_interval(bits: wp.uint32) -> float:
    """The upper 24 bits as a multiple of 2^-24 in [0, 1): exact in float32, and never 1."""
    return float(bits >> wp.uint32(8)) * 5.9604644775390625e-8


@wp.func
def uniform4(seed: wp.uint64, pixel: wp.uint32, sample: wp.uint32, bounce: wp.int32, purpose: wp.int32) -> wp.vec4:
    """Four independent numbers, uniform in [0, 1), that belong to these five integers alone."""
    bits = philox(
        wp.vec4ui(pixel, sample, wp.uint32(bounce), wp.uint32(purpose)),
        wp.vec2ui(wp.uint32(seed), wp.uint32(seed >> _SHIFT_32)),
    )
    return wp.vec4(
        to_unit_interval(bits[0]), to_unit_interval(bits[1]), to_unit_interval(bits[2]), to_unit_interval(bits[3])
    )
