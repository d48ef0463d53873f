"""What rays meet, as kernels read it.

A hit names a primitive: triangles come first, spheres after them; of each, those of the scene itself first, then those
of its groups.
"""

import warp as wp

from wavefront.accel.bvh import Bvh
from wavefront.accel.instance import Group, Instance

INFINITE = wp.constant(3.0e38)


@wp.struct
class Shape:
    """What the triangles of one mesh, or one sphere, share."""

    material: wp.int32
    first_light: wp.int32  # light of its first primitive; -1 if it does not emit
    first_primitive: wp.int32
    smooth: wp.int32  # 1: has vertex normals
    flip: wp.int32  # 1: a sphere that faces inwards
    two_sided: wp.int32  # 1: the back emits too
    polar: wp.int32  # 1: u is the distance from the centre of a disk, v the angle
    index: wp.int32  # place in the scene's list of shapes
    exterior: wp.int32  # medium in front; -1: the shape bounds no medium
    interior: wp.int32  # medium behind


@wp.struct
class Geometry:
    bvh: Bvh  # all hierarchies
    own: Group  # the scene itself
    triangle_count: wp.int32
    points: wp.array[wp.vec3]
    indices: wp.array[wp.int32]
    normals: wp.array[wp.vec3]  # per vertex; empty if no mesh has any
    uvs: wp.array[wp.vec2]  # per vertex; empty if nothing reads UVs or needs a tangent
    spheres: wp.array[wp.vec4]  # centre and radius
    sphere_to_local: wp.array[wp.mat33]  # world normals to the sphere's own axes; empty as `uvs`
    shape_of: wp.array[wp.int32]  # shape of each primitive
    shapes: wp.array[Shape]
    instance_root: wp.int32  # of the hierarchy of their boxes
    instances: wp.array[Instance]  # empty if there are none
    groups: wp.array[Group]
    sigma_a: wp.array[wp.vec3]  # of each medium, 1/m; the first is vacuum; empty if none absorbs
    camera_medium: wp.int32


@wp.struct
class Hit:
    t: wp.float32
    primitive: wp.int32  # -1: none
    u: wp.float32  # weights of the triangle's first and second vertex
    v: wp.float32


@wp.struct
class InstanceHit:
    """A hit in a scene with instances."""

    t: wp.float32
    primitive: wp.int32
    u: wp.float32
    v: wp.float32
    instance: wp.int32  # -1: the primitive is the scene's own


@wp.struct
class RayHits:
    """Hits of rays that go in streams, one entry per slot; allocated if there are such."""

    primitive: wp.array[wp.int32]
    t: wp.array[wp.float32]
    uv: wp.array[wp.vec2]
    instance: wp.array[wp.int32]  # allocated if there are instances


def hit_type(instances: tuple[str, ...]):
    """The struct of a hit."""
    return InstanceHit if instances else Hit
