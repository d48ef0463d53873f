"""Textures: bitmaps in their file's own precision, and checkerboards.

All pixels of bitmaps of one type (8-bit and 16-bit integers, half and single precision) lie in one array; a record says
where a texture starts and how to read it. (u, v) = (0, 0) is the upper left corner of the image.
"""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from wavefront.film import LUMINANCE
from wavefront.finite import is_finite
from wavefront.prefetch import make_prefetch

KIND_CHECKERBOARD = wp.constant(0)
KIND_BYTES = wp.constant(1)
KIND_FLOATS = wp.constant(2)
KIND_SHORTS = wp.constant(3)
KIND_HALVES = wp.constant(4)
KINDS = {"checkerboard": 0, "bytes": 1, "floats": 2, "shorts": 3, "halves": 4}
IMAGE_TYPES = {"bytes": np.uint8, "shorts": np.uint16, "halves": np.float16, "floats": np.float32}

WRAP_REPEAT = wp.constant(0)
WRAP_MIRROR = wp.constant(1)
WRAP_CLAMP = wp.constant(2)
_RED, _BLUE = wp.constant(LUMINANCE[0]), wp.constant(LUMINANCE[2])
WRAP_MODES = {"repeat": 0, "mirror": 1, "clamp": 2}


@wp.struct
class TextureRecord:
    kind: wp.int32
    first: wp.int64  # index of the first value in the array of its kind
    width: wp.int32
    height: wp.int32
    channels: wp.int32  # 1 or 3
    srgb: wp.int32  # 1 if integers are sRGB-encoded
    nearest: wp.int32  # 1: no interpolation
    wrap: wp.int32
    scale: wp.vec3  # of a bitmap
    uv_row0: wp.vec3
    uv_row1: wp.vec3
    color0: wp.vec3  # of a checkerboard
    color1: wp.vec3


@wp.struct
class TextureTables:
    records: wp.array[TextureRecord]
    bytes: wp.array[wp.uint8]
    shorts: wp.array[wp.uint16]
    halves: wp.array[wp.float16]
    floats: wp.array[wp.float32]
    srgb_to_linear: wp.array[wp.float32]  # 256 entries, where some bytes are sRGB-encoded
    srgb16_to_linear: wp.array[wp.float32]  # 65536 entries, where some shorts are


def srgb_to_linear(value: np.ndarray) -> np.ndarray:
    """Inverse of the sRGB transfer function (IEC 61966-2-1), values in [0, 1]."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


@wp.func
def luminance(rgb: wp.vec3) -> float:
    """Of linear Rec. 709; that of a grey is its value to the last bit."""
    return rgb[1] + _RED * (rgb[0] - rgb[1]) + _BLUE * (rgb[2] - rgb[1])


@wp.func
def wrap_coordinate(i: int, size: int, mode: int) -> int:
    """Index of the pixel that coordinate `i` falls on; `i` may be any integer."""
    if mode == WRAP_CLAMP:
        return wp.clamp(i, 0, size - 1)
    period = wp.where(mode == WRAP_MIRROR, 2 * size, size)
    # One period at most is what a coordinate is off as a rule, and a division takes long.
    m = wp.where(i < 0, i + period, wp.where(i >= period, i - period, i))
    if m < 0 or m >= period:
        m = i % period
        if m < 0:
            m += period
    return wp.where(m < size, m, period - 1 - m)


@wp.func
def texture_uv(record: TextureRecord, surface_uv: wp.vec2) -> wp.vec2:
    uv1 = wp.vec3(surface_uv[0], surface_uv[1], 1.0)
    return wp.vec2(wp.dot(record.uv_row0, uv1), wp.dot(record.uv_row1, uv1))


@wp.func
def pixel_position(record: TextureRecord, uv: wp.vec2) -> wp.vec2:
    """Where `uv`, which is finite, falls on a bitmap, in pixels.

    Whole periods of the largest wrap mode are taken off first, so that the product with the size is exact enough and
    fits an int however far the coordinate is.
    """
    u = uv[0]
    v = uv[1]
    if record.wrap == WRAP_CLAMP:
        u = wp.clamp(u, -1.0, 2.0)
        v = wp.clamp(v, -1.0, 2.0)
    else:
        u -= 2.0 * wp.floor(0.5 * u)
        v -= 2.0 * wp.floor(0.5 * v)
    return wp.vec2(u * float(record.width), v * float(record.height))


@functools.cache
def make_fetch(kinds: tuple[str, ...]):
    """`fetch(tables, record, x, y) -> vec3`: a pixel of a bitmap, linear, not scaled; any integers are wrapped.

    Args:
        kinds: As for `make_eval_texture`.
    """
    has_bytes = "bytes" in kinds
    has_shorts = "shorts" in kinds
    has_halves = "halves" in kinds
    has_floats = "floats" in kinds

    @wp.func
    def fetch(tables: TextureTables, record: TextureRecord, x: int, y: int) -> wp.vec3:
        pixel = wrap_coordinate(y, record.height, record.wrap) * record.width
        pixel += wrap_coordinate(x, record.width, record.wrap)
        i = record.first + wp.int64(pixel) * wp.int64(record.channels)
        rgb = wp.vec3(0.0)
        if wp.static(has_bytes):
            if record.kind == KIND_BYTES:
                r = wp.int32(tables.bytes[i])
                g = r
                b = r
                if record.channels == 3:
                    g = wp.int32(tables.bytes[i + wp.int64(1)])
                    b = wp.int32(tables.bytes[i + wp.int64(2)])
                if record.srgb == 1:
                    rgb = wp.vec3(tables.srgb_to_linear[r], tables.srgb_to_linear[g], tables.srgb_to_linear[b])
                else:
                    rgb = wp.vec3(float(r), float(g), float(b)) / 255.0
        if wp.static(has_shorts):
            if record.kind == KIND_SHORTS:
                r = wp.int32(tables.shorts[i])
                g = r
                b = r
                if record.channels == 3:
                    g = wp.int32(tables.shorts[i + wp.int64(1)])
                    b = wp.int32(tables.shorts[i + wp.int64(2)])
                if record.srgb == 1:
                    rgb = wp.vec3(tables.srgb16_to_linear[r], tables.srgb16_to_linear[g], tables.srgb16_to_linear[b])
                else:
                    rgb = wp.vec3(float(r), float(g), float(b)) / 65535.0
        if wp.static(has_halves):
            if record.kind == KIND_HALVES:
                grey = float(tables.halves[i])
                rgb = wp.vec3(grey)
                if record.channels == 3:
                    rgb = wp.vec3(grey, float(tables.halves[i + wp.int64(1)]), float(tables.halves[i + wp.int64(2)]))
        if wp.static(has_floats):
            if record.kind == KIND_FLOATS:
                grey = tables.floats[i]
                rgb = wp.vec3(grey)
                if record.channels == 3:
                    rgb = wp.vec3(grey, tables.floats[i + wp.int64(1)], tables.floats[i + wp.int64(2)])
        return rgb

    return fetch


_prefetch_byte, _prefetch_short = make_prefetch(wp.uint8), make_prefetch(wp.uint16)
_prefetch_half, _prefetch_float = make_prefetch(wp.float16), make_prefetch(wp.float32)


@functools.cache
def make_prefetch_texture(kinds: tuple[str, ...]):
    """`prefetch_texture(tables, texture, uv)`: has the pixels around `uv` on their way.

    On CUDA, where other threads run meanwhile, it does nothing.

    Args:
        kinds: As for `make_eval_texture`.
    """
    has_bytes = "bytes" in kinds
    has_shorts = "shorts" in kinds
    has_halves = "halves" in kinds
    has_floats = "floats" in kinds

    @wp.func
    def prefetch_texture(tables: TextureTables, texture: int, surface_uv: wp.vec2):
        record = tables.records[texture]
        uv = texture_uv(record, surface_uv)
        if record.kind == KIND_CHECKERBOARD or not is_finite(uv[0] + uv[1]):
            return
        position = pixel_position(record, uv)
        x = wrap_coordinate(int(wp.floor(position[0] - 0.5)), record.width, record.wrap)
        y = int(wp.floor(position[1] - 0.5))
        for k in range(2):
            pixel = wrap_coordinate(y + k, record.height, record.wrap) * record.width + x
            i = record.first + wp.int64(pixel) * wp.int64(record.channels)
            if wp.static(has_bytes):
                if record.kind == KIND_BYTES:
                    _prefetch_byte(tables.bytes, i)
            if wp.static(has_shorts):
                if record.kind == KIND_SHORTS:
                    _prefetch_short(tables.shorts, i)
            if wp.static(has_halves):
                if record.kind == KIND_HALVES:
                    _prefetch_half(tables.halves, i)
            if wp.static(has_floats):
                if record.kind == KIND_FLOATS:
                    _prefetch_float(tables.floats, i)

    return prefetch_texture


@functools.cache
def make_eval_texture(kinds: tuple[str, ...]):
    """`eval_texture(tables, texture, uv) -> vec3` for the kinds of texture in a scene.

    Args:
        kinds: Subset of `KINDS`, sorted.
    """
    has_images = any(kind in IMAGE_TYPES for kind in kinds)
    has_checkerboard = "checkerboard" in kinds
    fetch = make_fetch(kinds)

    @wp.func
    def eval_texture(tables: TextureTables, texture: int, surface_uv: wp.vec2) -> wp.vec3:
        record = tables.records[texture]
        uv = texture_uv(record, surface_uv)
        if not is_finite(uv[0] + uv[1]):
            return wp.vec3(0.0)
        if wp.static(has_checkerboard):
            if record.kind == KIND_CHECKERBOARD:
                in_left = uv[0] - wp.floor(uv[0]) < 0.5
                in_top = uv[1] - wp.floor(uv[1]) < 0.5
                return wp.where(in_left == in_top, record.color0, record.color1)
        if wp.static(has_images):
            position = pixel_position(record, uv)
            if record.nearest == 1:
                pixel = fetch(tables, record, int(wp.floor(position[0])), int(wp.floor(position[1])))
                return wp.cw_mul(record.scale, pixel)
            x = position[0] - 0.5  # pixel centres are at half-integers
            y = position[1] - 0.5
            x0 = int(wp.floor(x))
            y0 = int(wp.floor(y))
            fx = x - wp.floor(x)
            fy = y - wp.floor(y)
            top = (1.0 - fx) * fetch(tables, record, x0, y0) + fx * fetch(tables, record, x0 + 1, y0)
            bottom = (1.0 - fx) * fetch(tables, record, x0, y0 + 1) + fx * fetch(tables, record, x0 + 1, y0 + 1)
            return wp.cw_mul(record.scale, (1.0 - fy) * top + fy * bottom)
        return wp.vec3(0.0)

    @wp.func
    def no_texture(tables: TextureTables, texture: int, surface_uv: wp.vec2) -> wp.vec3:
        return wp.vec3(1.0)

    return eval_texture if kinds else no_texture


@functools.cache
def make_eval_gradient(kinds: tuple[str, ...]):
    """`eval_gradient(tables, texture, uv) -> vec2`: derivatives of a bilinear bitmap's luminance by u and v of the
    surface, which jump from one cell between pixel centres to the next.

    Args:
        kinds: As for `make_eval_texture`; a checkerboard has none.
    """
    fetch = make_fetch(kinds)

    @wp.func
    def eval_gradient(tables: TextureTables, texture: int, surface_uv: wp.vec2) -> wp.vec2:
        record = tables.records[texture]
        uv = texture_uv(record, surface_uv)
        if record.kind == KIND_CHECKERBOARD or not is_finite(uv[0] + uv[1]):
            return wp.vec2(0.0)
        position = pixel_position(record, uv) - wp.vec2(0.5)
        x = int(wp.floor(position[0]))
        y = int(wp.floor(position[1]))
        fx = position[0] - wp.floor(position[0])
        fy = position[1] - wp.floor(position[1])
        v00 = luminance(wp.cw_mul(record.scale, fetch(tables, record, x, y)))
        v10 = luminance(wp.cw_mul(record.scale, fetch(tables, record, x + 1, y)))
        v01 = luminance(wp.cw_mul(record.scale, fetch(tables, record, x, y + 1)))
        v11 = luminance(wp.cw_mul(record.scale, fetch(tables, record, x + 1, y + 1)))
        by_u = float(record.width) * wp.lerp(v10 - v00, v11 - v01, fy)
        by_v = float(record.height) * wp.lerp(v01 - v00, v11 - v10, fx)
        return wp.vec2(
            by_u * record.uv_row0[0] + by_v * record.uv_row1[0], by_u * record.uv_row0[1] + by_v * record.uv_row1[1]
        )

    return eval_gradient


@functools.cache
def make_eval_parameter(kinds: tuple[str, ...]):
    """`eval_parameter(tables, value, texture, uv) -> vec3`: the value, or the texture's where `texture` is not -1."""
    textured = bool(kinds)
    eval_texture = make_eval_texture(kinds)

    @wp.func
    def eval_parameter(tables: TextureTables, value: wp.vec3, texture: int, uv: wp.vec2) -> wp.vec3:
        if wp.static(textured):
            if texture >= 0:
                return eval_texture(tables, texture, uv)
        return value

    return eval_parameter
