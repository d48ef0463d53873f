"""Groups of shapes, and the instances that put a group into the scene: rays are traced in the group's own space."""

import warp as wp


@wp.struct
class Group:
    """Shapes in a space of their own, or the scene's in the world."""

    root: wp.int32  # of its triangles in `Geometry.bvh`; -1: it has none
    sphere_root: wp.int32  # of its spheres; -1: it has none
    mesh: wp.uint64  # its triangles for `wp.Mesh` queries; 0 unless they were chosen
    first_triangle: wp.int32  # of the mesh


def no_shapes() -> Group:
    group = Group()
    group.root = group.sphere_root = -1
    return group


@wp.struct
class Instance:
    """Where a group is: p = to_world p_local + translation.

    The translation is taken off before a point goes to local space, so that digits are not lost far from the origin.
    """

    to_world: wp.mat33
    to_local: wp.mat33  # its inverse
    translation: wp.vec3
    group: wp.int32


@wp.func
def point_to_local(instance: Instance, p: wp.vec3) -> wp.vec3:
    return instance.to_local * (p - instance.translation)


@wp.func
def point_to_world(instance: Instance, p: wp.vec3) -> wp.vec3:
    return instance.to_world * p + instance.translation


@wp.func
def normal_to_world(instance: Instance, n: wp.vec3) -> wp.vec3:
    """A normal goes by the inverse transpose, also under a mirror: what was outside stays outside. Of unit length.

    Tangents go by `to_world`.
    """
    return wp.normalize(wp.transpose(instance.to_local) * n)


@wp.func
def absolute(m: wp.mat33) -> wp.mat33:
    a = wp.mat33()
    for i in range(3):
        for j in range(3):
            a[i, j] = wp.abs(m[i, j])
    return a


@wp.func
def offset_to_world(instance: Instance, offset: float, reach: wp.vec3, normal: wp.vec3, rounding: float) -> float:
    """How far along the world normal a ray must start so that it cannot meet its own primitive again, in metres.

    With M = `to_world`, a displacement by d along the world normal M^-T n / |M^-T n| moves the point by d |M^-T n| off
    the plane in local space. That must exceed what `offset` covers there, and the roundings of the way between the
    spaces: a point p rounds to M p + translation, and M^-1 takes what is left of it back, as it does the direction of
    the ray over the extent of the primitive. Seen along n, M^-1 turns a world vector of roundings w into at most
    |n| |M^-1| |w|, component by component.

    Args:
        instance: Of the primitive.
        offset: Off the plane, in local space, of a ray that is traced there.
        reach: Bounds, by coordinate, the sum of the local position and of the extent of the primitive.
        normal: Unit normal in local space.
        rounding: Bound of the relative error of a few operations.
    """
    reach_world = absolute(instance.to_world) * reach
    error = wp.dot(wp.transpose(absolute(instance.to_local)) * wp.abs(normal), reach_world)
    covector = wp.transpose(instance.to_local) * normal
    return (offset + rounding * (error + wp.dot(wp.abs(covector), wp.abs(instance.translation)))) / wp.length(covector)
