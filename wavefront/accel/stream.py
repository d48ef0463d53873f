"""Rays against hierarchies on the CPU device: many rays in flight, eight boxes or four triangles an instruction.

A processor waits for memory most of the time that it follows one ray through a hierarchy that does not fit its caches,
and much of the rest for branches that it guessed wrong. So a thread takes turns with `IN_FLIGHT` rays of a queue: each
goes one node further and asks for the next one, which arrives while the others have their turns. And a node is tested
without a branch on its outcome: a sorting network puts the distances of its children in order, and all eight places go
onto the stack, of which the stack counts those that were met. A ray that meets the box of an instance goes through the
group's hierarchies in the group's space, on the same stack, and comes back when its part of the stack is empty. The
arithmetic is that of `wavefront.accel.traverse`, `spheres` and `intersector`.

The C++ uses the vector types of Clang, which compiles kernels for the CPU device, and no instructions by name.
"""

import functools
from typing import NamedTuple

import warp as wp

from wavefront.accel.bvh import BLOCK_VECTORS, MAX_BLOCKS, NODE_VECTORS, STACK_SIZE
from wavefront.accel.collapse import EMPTY
from wavefront.accel.geometry import INFINITE, Geometry, RayHits
from wavefront.accel.traverse import FAR_SLACK, NEAR_SLACK, NETWORK, STEEPEST

IN_FLIGHT = 16  # rays; 4 gain half of what 16 do on a million triangles, and more little (tools.bench_accel)


def _layer(pairs) -> str:
    """C++ of a layer of the sorting network: orders pairs of the vector `key`, the greater first."""
    partner, source = list(range(8)), list(range(8))
    for first, second in pairs:
        partner[first], partner[second] = second, first
        source[second] += 8  # from the vector of the lesser
    join = ", ".join
    return f"""{{
                    const int8 other = __builtin_shufflevector(key, key, {join(map(str, partner))});
                    const int8 greater = key > other ? key : other, lesser = key > other ? other : key;
                    key = __builtin_shufflevector(greater, lesser, {join(map(str, source))});
                }}"""


_STREAM = """
    #pragma clang fp contract(off)
    using namespace wp;
    typedef float float8 __attribute__((ext_vector_type(8), aligned(16)));
    typedef float float4 __attribute__((ext_vector_type(4), aligned(16)));
    typedef int int8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef int int4 __attribute__((ext_vector_type(4), aligned(16)));
    typedef unsigned char bytes8 __attribute__((ext_vector_type(8), aligned(8)));
    typedef bool bool8 __attribute__((ext_vector_type(8)));
    typedef bool bool4 __attribute__((ext_vector_type(4)));
    constexpr int node_size = 4 * NODE_VECTORS, block_size = 4 * BLOCK_VECTORS;  // floats
    constexpr bool any = ANY;  // whether any hit will do
    constexpr bool own_triangles = OWN_TRIANGLES, own_spheres = OWN_SPHERES;
    constexpr bool group_triangles = GROUP_TRIANGLES, group_spheres = GROUP_SPHERES;
    constexpr bool triangles = own_triangles || group_triangles, spheres = own_spheres || group_spheres;
    constexpr bool instances = group_triangles || group_spheres;
    constexpr bool mixed = triangles + spheres + instances > 1;
    const float* const nodes = (const float*)geometry.bvh.nodes.data;
    const float* const blocks = (const float*)geometry.bvh.blocks.data;
    // What the leaves of a hierarchy hold, in the order in which a ray goes through those of a space.
    enum Kind { NONE, TRIANGLE, SPHERE, INSTANCE };
    struct Space {
        vec3 o, d;
        float far_o[3], near_slope[3], far_slope[3];
        int near_side[3], far_side[3];  // bytes from the beginning of a node
        int kx, ky, kz;
        float shear_x, shear_y, shear_z;
    };
    struct Ray : Space {  // in the space where it is
        Space world;  // while it is in another
        Kind kind;  // of the hierarchy where it is
        int inside, base;  // instance where it is (-1: none), and how much of the stack is the world's
        float t, u, v;
        int primitive, instance;  // that it met
        int index, link, size;
        // Of a place on the stack: distance with its last three bits exchanged for the number of the child, and node.
        int keys[(instances + 1) * STACK_SIZE + 8], nodes[(instances + 1) * STACK_SIZE + 8];
    };
    Ray rays[IN_FLIGHT];
    int next = 0, active = 0;
    auto set_space = [](Space& r, const vec3& o, const vec3& d) {
        r.o = o;
        r.d = d;
        for (int k = 0; k < 3; ++k) {
            const bool along = __builtin_fabsf(d[k]) < 1.0f / STEEPEST;
            const float slope = along ? __builtin_copysignf(STEEPEST, d[k]) : 1.0f / d[k];
            r.near_slope[k] = slope * NEAR_SLACK;
            r.far_slope[k] = slope * FAR_SLACK;
            // See `far_origin`.
            const float back = along ? __builtin_fmaxf(1.2e-7f * __builtin_fabsf(o[k]), 1.0e-17f) : 0.0f;
            r.far_o[k] = o[k] - __builtin_copysignf(back, d[k]);
            r.near_side[k] = 64 + 8 * k + (slope < 0.0f ? 24 : 0);
            r.far_side[k] = 64 + 8 * k + (slope < 0.0f ? 0 : 24);
        }
        r.kz = 0;
        if (__builtin_fabsf(d[1]) > __builtin_fabsf(d[r.kz])) r.kz = 1;
        if (__builtin_fabsf(d[2]) > __builtin_fabsf(d[r.kz])) r.kz = 2;
        r.kx = (r.kz + 1) % 3;
        r.ky = (r.kx + 1) % 3;
        if (d[r.kz] < 0.0f) { const int k = r.kx; r.kx = r.ky; r.ky = k; }
        r.shear_x = d[r.kx] / d[r.kz];
        r.shear_y = d[r.ky] / d[r.kz];
        r.shear_z = 1.0f / d[r.kz];
    };
    // Goes to the root of the next hierarchy of the space where the ray is.
    auto next_root = [&](Ray& r) -> bool {
        const bool inside = instances && r.inside >= 0;
        const auto& group = inside ? geometry.groups.data[geometry.instances.data[r.inside].group] : geometry.own;
        if (r.kind < TRIANGLE) {
            r.kind = TRIANGLE;
            r.link = group.root;
            if ((inside ? group_triangles : own_triangles) && r.link >= 0) return true;
        }
        if (r.kind < SPHERE) {
            r.kind = SPHERE;
            r.link = group.sphere_root;
            if ((inside ? group_spheres : own_spheres) && r.link >= 0) return true;
        }
        if (instances && !inside && r.kind < INSTANCE) {
            r.kind = INSTANCE;
            r.link = geometry.instance_root;
            return true;
        }
        return false;
    };
    // Takes the next ray of the queue.
    auto begin = [&](Ray& r) -> bool {
        if (next >= count) return false;
        const int slot = slots.data[next];
        set_space(r, origin.data[slot], direction.data[slot]);
        r.t = LIMIT;
        r.u = r.v = 0.0f;
        r.primitive = r.instance = r.inside = -1;
        r.index = next++;
        r.size = r.base = 0;
        r.kind = NONE;
        return next_root(r);
    };
    // Whether a hit comes before what the ray met so far.
    auto before = [](const Ray& r, float t, int primitive) -> bool {
        if (t != r.t) return t < r.t;
        if (instances && r.inside != r.instance) return r.inside < r.instance;
        return primitive < r.primitive;
    };
    auto accept = [](Ray& r, float t, float u, float v, int primitive) {
        r.t = t;
        r.u = u;
        r.v = v;
        r.primitive = primitive;
        r.instance = r.inside;
    };
    // Of a triangle with a corner at the origin: ax by - ay bx, see `difference_of_products`.
    auto twice_area = [](float4 ax, float4 ay, float4 bx, float4 by) -> float4 {
        const float4 product = ay * bx;
        return __builtin_elementwise_fma(ax, by, -product) + __builtin_elementwise_fma(-ay, bx, product);
    };
    while (active < IN_FLIGHT && begin(rays[active])) ++active;
    while (active > 0) {
        for (int a = 0; a < active; ++a) {
            Ray& r = rays[a];
            if (r.link >= 0) {
                const float* const node = nodes + (size_t)r.link * node_size;
                auto side = [&](int axis, int place, float origin) -> float8 {
                    const float8 cells = __builtin_convertvector(*(const bytes8*)((const char*)node + place), float8);
                    const float8 corners = __builtin_elementwise_fma(
                        cells, (float8)(node[4 + axis]), (float8)(node[axis]));
                    return corners - origin;
                };
                const float8 nx = side(0, r.near_side[0], r.o[0]) * r.near_slope[0];
                const float8 ny = side(1, r.near_side[1], r.o[1]) * r.near_slope[1];
                const float8 nz = side(2, r.near_side[2], r.o[2]) * r.near_slope[2];
                const float8 fx = side(0, r.far_side[0], r.far_o[0]) * r.far_slope[0];
                const float8 fy = side(1, r.far_side[1], r.far_o[1]) * r.far_slope[1];
                const float8 fz = side(2, r.far_side[2], r.far_o[2]) * r.far_slope[2];
                float8 near = nx > ny ? nx : ny, far = fx < fy ? fx : fy;
                near = near > nz ? near : nz;
                far = far < fz ? far : fz;
                near = near > 0.0f ? near : (float8)(0.0f);
                far = far < r.t ? far : (float8)(r.t);
                const auto met = near <= far;
                // Distances are not negative, and so their bits are in the order of their values.
                int8 key = (__builtin_bit_cast(int8, near) & ~7) | (int8){0, 1, 2, 3, 4, 5, 6, 7};
                key = met ? key : (int8)(-1);
                SORT
                *(int8*)(r.keys + r.size) = key;
                *(int8*)(r.nodes + r.size) = (int8)(r.link);
                r.size += __builtin_popcount(__builtin_bit_cast(unsigned char, __builtin_convertvector(met, bool8)));
            } else if (triangles && (!mixed || r.kind == TRIANGLE)) {
                const int kx = 4 * r.kx, ky = 4 * r.ky, kz = 4 * r.kz;
                const float ox = r.o[r.kx], oy = r.o[r.ky], oz = r.o[r.kz];
                const float* block = blocks + (size_t)(~r.link / MAX_BLOCKS) * block_size;
                for (int n = ~r.link % MAX_BLOCKS; n >= 0; --n, block += block_size) {
                    const float4 az = *(const float4*)(block + kz) - oz;
                    const float4 bz = *(const float4*)(block + 12 + kz) - oz;
                    const float4 cz = *(const float4*)(block + 24 + kz) - oz;
                    const float4 ax = (*(const float4*)(block + kx) - ox) - r.shear_x * az;
                    const float4 ay = (*(const float4*)(block + ky) - oy) - r.shear_y * az;
                    const float4 bx = (*(const float4*)(block + 12 + kx) - ox) - r.shear_x * bz;
                    const float4 by = (*(const float4*)(block + 12 + ky) - oy) - r.shear_y * bz;
                    const float4 cx = (*(const float4*)(block + 24 + kx) - ox) - r.shear_x * cz;
                    const float4 cy = (*(const float4*)(block + 24 + ky) - oy) - r.shear_y * cz;
                    const float4 u = twice_area(cx, cy, bx, by);
                    const float4 v = twice_area(ax, ay, cx, cy);
                    const float4 w = twice_area(bx, by, ax, ay);
                    const int4 front = (u >= 0.0f) & (v >= 0.0f) & (w >= 0.0f);
                    const int4 back = (u <= 0.0f) & (v <= 0.0f) & (w <= 0.0f);
                    if (!__builtin_reduce_or(front | back)) continue;
                    const float4 det = u + v + w;
                    const float4 weight_a = u / det, weight_b = v / det;
                    const float4 t = r.shear_z * (weight_a * az + weight_b * bz + (w / det) * cz);
                    const int4 met = (front | back) & (det != 0.0f) & (t > 0.0f) & (t <= r.t);
                    if (any) {
                        if (!__builtin_reduce_or(met & (t < r.t))) continue;
                        r.primitive = 0;
                        goto end;
                    }
                    // Mostly none or one: nothing to guess for each of the four.
                    unsigned lanes = __builtin_bit_cast(unsigned char, __builtin_convertvector(met, bool4));
                    for (; lanes != 0; lanes &= lanes - 1) {
                        const int i = __builtin_ctz(lanes);
                        const int primitive = ((const int*)(block + 36))[i];
                        if (before(r, t[i], primitive)) accept(r, t[i], weight_a[i], weight_b[i], primitive);
                    }
                }
            } else if (spheres && (!mixed || r.kind == SPHERE)) {
                const int index = ~r.link;
                const auto& sphere = geometry.spheres.data[index];
                const float radius = sphere[3];
                const vec3 f = sub(r.o, vec3(sphere[0], sphere[1], sphere[2]));
                const float dd = dot(r.d, r.d), b = -dot(f, r.d);
                const vec3 nearest = add(f, mul(b / dd, r.d));
                const float discriminant = radius * radius - dot(nearest, nearest);
                if (!(discriminant < 0.0f)) {
                    const float root = sqrt(dd * discriminant);
                    const float c = (length(f) - radius) * (length(f) + radius);
                    const float q = b < 0.0f ? b - root : b + root;
                    const float t0 = q == 0.0f ? 0.0f : c / q, t1 = q == 0.0f ? 0.0f : q / dd;
                    const float near = min(t0, t1), far = max(t0, t1), t = near > 0.0f ? near : far;
                    const int primitive = geometry.triangle_count + index;
                    if (t > 0.0f && before(r, t, primitive)) {
                        accept(r, t, 0.0f, 0.0f, primitive);
                        if (any) goto end;
                    }
                }
            } else if (instances) {
                r.inside = ~r.link;
                r.world = r;
                const auto& instance = geometry.instances.data[r.inside];
                set_space(r, mul(instance.to_local, sub(r.o, instance.translation)), mul(instance.to_local, r.d));
                r.base = r.size;
                r.kind = NONE;
            }
        pop:
            while (r.size > (instances ? r.base : 0)) {
                --r.size;
                const int key = r.keys[r.size];
                if ((key & ~7) <= __builtin_bit_cast(int, r.t)) {
                    r.link = ((const int*)nodes)[(size_t)r.nodes[r.size] * node_size + 8 + (key & 7)];
                    if (r.link == EMPTY) continue;
                    const char* const memory = r.link >= 0
                        ? (const char*)(nodes + (size_t)r.link * node_size)
                        : (const char*)(blocks + (size_t)(~r.link / MAX_BLOCKS) * block_size);
                    __builtin_prefetch(memory);
                    __builtin_prefetch(memory + 64);
                    __builtin_prefetch(memory + 128);
                    goto turn;
                }
            }
            if (mixed && next_root(r)) goto turn;
            if (instances && r.inside >= 0) {
                static_cast<Space&>(r) = r.world;
                r.inside = -1;
                r.base = 0;
                r.kind = INSTANCE;
                goto pop;
            }
        end:
            RESULT
            if (!begin(r)) {
                --active;
                if (a < active) { r = rays[active]; --a; }
            }
        turn:;
        }
    }
"""


class Streams(NamedTuple):
    """Functions that trace queues of rays, `slots` and `count`, of directions of any length.

    Attributes:
        closest: `(geometry, slots, count, origin, direction, hits)`: what rays meet first.
        occluded: `(geometry, slots, count, origin, direction, t_max, blocked)`: whether they meet something before
            `t_max`: 1 or 0.
    """

    closest: wp.Function
    occluded: wp.Function


@functools.cache
def make_streams(triangles: bool, spheres: bool, instances: tuple[str, ...] = ()) -> Streams:
    """Functions for the kinds of primitive in a scene, of which there must be some; as of `make_intersector`."""

    def source(limit: str, any_will_do: bool, result: str) -> str:
        text = _STREAM.replace("SORT\n", "\n                ".join(map(_layer, NETWORK)) + "\n")
        constants = {
            "IN_FLIGHT": IN_FLIGHT,
            "STACK_SIZE": STACK_SIZE,
            "NODE_VECTORS": NODE_VECTORS,
            "BLOCK_VECTORS": BLOCK_VECTORS,
            "MAX_BLOCKS": MAX_BLOCKS,
            "EMPTY": f"({EMPTY + 1} - 1)",
            "NEAR_SLACK": f"{float(NEAR_SLACK)}f",
            "FAR_SLACK": f"{float(FAR_SLACK)}f",
            "STEEPEST": f"{float(STEEPEST)}f",
            "OWN_TRIANGLES": int(triangles),
            "OWN_SPHERES": int(spheres),
            "GROUP_TRIANGLES": int("triangles" in instances),
            "GROUP_SPHERES": int("spheres" in instances),
            "LIMIT": limit,
            "ANY": int(any_will_do),
            "RESULT": result,
        }
        for name, value in constants.items():
            text = text.replace(name, str(value))
        return text

    write_instance = "hits.instance.data[slot] = r.instance;" if instances else ""

    @wp.func_native(
        source(
            f"{float(INFINITE)}f",
            False,
            f"""{{
                const int slot = slots.data[r.index];
                hits.primitive.data[slot] = r.primitive;
                hits.t.data[slot] = r.t;
                hits.uv.data[slot] = vec2(r.u, r.v);
                {write_instance}
            }}""",
        )
    )
    def closest(
        geometry: Geometry,
        slots: wp.array[wp.int32],
        count: int,
        origin: wp.array[wp.vec3],
        direction: wp.array[wp.vec3],
        # out
        hits: RayHits,
    ): ...

    @wp.func_native(source("t_max.data[slot]", True, "blocked.data[slots.data[r.index]] = r.primitive >= 0;"))
    def occluded(
        geometry: Geometry,
        slots: wp.array[wp.int32],
        count: int,
        origin: wp.array[wp.vec3],
        direction: wp.array[wp.vec3],
        t_max: wp.array[wp.float32],
        # out
        blocked: wp.array[wp.int32],
    ): ...

    return Streams(closest, occluded)
