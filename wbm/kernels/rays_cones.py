"""Whether an instance can be seen from within a cone of rays: conservative tests with one apex, the sensor's origin."""

# ruff: noqa: SIM109 (`in` is not compiled)
import warp as wp

from wbm.kernels.rays_shapes import BOX, CYLINDER, PLANE, UNBOUNDED, support


@wp.func
def sphere_cone(c: wp.vec3, distance: float, radius: float) -> wp.vec4:
    """The cone around a sphere at `c` in the form that `meets` takes: (u, cos) / sin of its direction u and half angle.

    A sphere that holds the apex gives a cone that meets every other.
    """
    if radius >= distance:
        return wp.vec4(0.0, 0.0, 0.0, -UNBOUNDED)
    # The sine is radius / distance.
    inverse = 1.0 / radius
    cosine = wp.sqrt(distance * distance - radius * radius) - 1.0e-5 * distance
    return inverse * wp.vec4(c[0], c[1], c[2], cosine)


@wp.func
def meets(sphere: wp.vec4, bundle: wp.vec4, sin_half: float) -> bool:
    """Whether two cones with one apex overlap: the angle between their axes is at most the sum of their half angles.

    `cos(angle) >= cos(a + b) = cos a cos b - sin a sin b`, divided by the sine of the first.

    Args:
        sphere: first cone, from `sphere_cone`.
        bundle: axis and cosine of the half angle of the second; zeros for one that meets all.
        sin_half: sine of its half angle.
    """
    return sphere[0] * bundle[0] + sphere[1] * bundle[1] + sphere[2] * bundle[2] >= sphere[3] * bundle[3] - sin_half


@wp.func
def is_leaving(kind: int, o: wp.vec3, size: wp.vec3, axis: wp.vec3, cos_half: float, sin_half: float) -> bool:
    """Whether a flat face's outer half space holds the origin and every ray of a cone leads further out.

    For a box, a plane and the ends of a cylinder, in the instance's frame.

    The least component of a cone's directions along a face normal n is `cos(angle(axis, n) + half)`.
    """
    for i in range(3):
        extent = size[i]
        if kind == PLANE:
            extent = 0.0
        if kind == CYLINDER:
            extent = size[1]
        side = wp.sign(o[i])
        if (kind == BOX or i == 2) and wp.abs(o[i]) > extent:
            a = side * axis[i]
            if a * cos_half - wp.sqrt(wp.max(1.0 - a * a, 0.0)) * sin_half > 1.0e-4:
                return True
    return False


@wp.func
def is_beside(
    kind: int, c: wp.vec3, size: wp.vec3, rot: wp.mat33, axis: wp.vec3, cos_half: float, sin_half: float
) -> bool:
    """Whether a plane through the apex parts an instance from a cone: tighter than the sphere where it is slender.

    The plane touches the cone on the side of the instance's centre `c` (sensor frame); its normal n points to the cone
    and the instance lies behind it if `n . c + max (n . p) < 0` over the instance's points p about c.
    """
    aside = c - wp.dot(c, axis) * axis
    length = wp.length(aside)
    if length < 1.0e-6:
        return False
    n = sin_half * axis - (cos_half / length) * aside
    return wp.dot(n, c) + support(kind, rot * n, size) < 0.0


@wp.func
def is_out(
    kind: int,
    size: wp.vec3,
    sphere: wp.vec4,
    origin: wp.vec3,
    rot: wp.mat33,
    axis: wp.vec3,
    cos_half: float,
    sin_half: float,
) -> bool:
    """Whether an instance whose sphere meets a cone (axis and half angle, sensor frame) is clear of it all the same."""
    if kind != PLANE and is_beside(kind, wp.vec3(sphere[0], sphere[1], sphere[2]), size, rot, axis, cos_half, sin_half):
        return True
    if kind == BOX or kind == PLANE or kind == CYLINDER:
        return is_leaving(kind, origin, size, rot * axis, cos_half, sin_half)
    return False
