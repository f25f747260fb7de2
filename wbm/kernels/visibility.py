"""Whether a camera sees a target: a few rays to points inside it, against robot and obstacles; no picture is drawn."""

# ruff: noqa: RUF046, UP018 (int(0) declares a dynamic variable in a Warp kernel)
import warp as wp

from wbm.kernels.rays_shapes import bounding_radius, ray_instance
from wbm.kernels.se3 import quat_wxyz_inverse, quat_wxyz_mul, quat_wxyz_rotate, quat_wxyz_rotate_inv

wp.set_module_options({"enable_backward": False})


@wp.func
def in_the_way(centre: wp.vec3, radius: float, view: wp.vec3, length: float, width: float) -> bool:
    """Whether a sphere may touch a ray that ends within `width` of `length * view`; vectors from the camera."""
    along = wp.dot(centre, view)
    aside = wp.length(centre - along * view)
    return along > -radius and along < length + width + radius and aside < width + radius


@wp.func
def is_blocked(
    kind: int, size: wp.vec3, pos: wp.vec3, quat: wp.vec4, origin: wp.vec3, d: wp.vec3, length: float
) -> bool:
    """Whether a primitive at a world pose is hit within `length` along the unit ray `d` from `origin`."""
    o = quat_wxyz_rotate_inv(quat, origin - pos)
    return ray_instance(kind, o, quat_wxyz_rotate_inv(quat, d), size, wp.uint64(0), length) < length


@wp.kernel(enable_backward=False)
def count_visible(
    # in:
    link_pos: wp.array2d(dtype=wp.vec3),  # [N,L] m
    link_quat: wp.array2d(dtype=wp.vec4),  # [N,L] w x y z
    camera_link: int,
    camera_pos: wp.vec3,  # optical frame in the camera's link
    camera_quat: wp.vec4,
    reach: wp.vec4,  # tangents of half the horizontal and vertical field of view, nearest and farthest depth, m
    geom_type: wp.array(dtype=wp.int32),  # [G] the robot's primitives
    geom_link: wp.array(dtype=wp.int32),
    geom_size: wp.array(dtype=wp.vec3),
    geom_pos: wp.array(dtype=wp.vec3),
    geom_quat: wp.array(dtype=wp.vec4),
    obstacle_type: wp.array2d(dtype=wp.int32),  # [N,M], negative where unused
    obstacle_size: wp.array2d(dtype=wp.vec3),
    obstacle_pos: wp.array2d(dtype=wp.vec3),  # world
    obstacle_quat: wp.array2d(dtype=wp.vec4),
    target_pos: wp.array(dtype=wp.vec3),  # [N] centre of its bounding box
    target_quat: wp.array(dtype=wp.vec4),
    target_half: wp.array(dtype=wp.vec3),
    num_points: int,  # up to 7: the centre of the target's bounding box, then two points on each of its axes
    spread: float,  # points on the axes lie at this share of the half extents
    enough: int,  # stop counting here
    # scratch:
    near_scratch: wp.array2d(dtype=wp.int16),  # [N,G+M]
    # out:
    count_out: wp.array(dtype=wp.int32),  # [N] visible points, at most `enough`
):
    """Count the points in view and range whose ray from the camera is free; a thread an environment."""
    e = wp.tid()
    q_WL = link_quat[e, camera_link]
    origin = link_pos[e, camera_link] + quat_wxyz_rotate(q_WL, camera_pos)
    q_CW = quat_wxyz_inverse(quat_wxyz_mul(q_WL, camera_quat))
    half = target_half[e]
    offset = target_pos[e] - origin
    away = wp.max(wp.length(offset), 1.0e-6)
    view = offset / away
    width = wp.length(half)
    num_geoms = geom_type.shape[0]
    near = int(0)
    seen = int(0)
    c = quat_wxyz_rotate(q_CW, offset)
    possible = c[2] > reach[2] - width and c[2] < reach[3] + width
    possible = possible and wp.abs(c[0]) - reach[0] * c[2] < width * (1.0 + reach[0])
    if possible and wp.abs(c[1]) - reach[1] * c[2] < width * (1.0 + reach[1]):
        # What may be in the way of any point is listed once.
        for g in range(num_geoms):
            link = geom_link[g]
            if link != camera_link:
                centre = link_pos[e, link] + quat_wxyz_rotate(link_quat[e, link], geom_pos[g]) - origin
                if in_the_way(centre, bounding_radius(geom_type[g], geom_size[g]), view, away, width):
                    near_scratch[e, near] = wp.int16(g)
                    near += 1
        for m in range(obstacle_type.shape[1]):
            kind = obstacle_type[e, m]
            if kind >= 0:
                radius = bounding_radius(kind, obstacle_size[e, m])
                if in_the_way(obstacle_pos[e, m] - origin, radius, view, away, width):
                    near_scratch[e, near] = wp.int16(num_geoms + m)
                    near += 1
        for k in range(num_points):
            shift = wp.vec3(0.0, 0.0, 0.0)
            if k > 0:
                axis = (k - 1) // 2
                shift[axis] = half[axis] * spread * (2.0 * float((k - 1) % 2) - 1.0)
            ray = offset + quat_wxyz_rotate(target_quat[e], shift)
            c = quat_wxyz_rotate(q_CW, ray)
            free = c[2] > reach[2] and c[2] < reach[3] and seen < enough
            free = free and wp.abs(c[0]) < reach[0] * c[2] and wp.abs(c[1]) < reach[1] * c[2]
            length = wp.length(ray)
            d = ray / wp.max(length, 1.0e-6)
            j = int(0)
            while free and j < near:
                i = int(near_scratch[e, j])
                if i < num_geoms:
                    q_WB = link_quat[e, geom_link[i]]
                    pos = link_pos[e, geom_link[i]] + quat_wxyz_rotate(q_WB, geom_pos[i])
                    quat = quat_wxyz_mul(q_WB, geom_quat[i])
                    free = not is_blocked(geom_type[i], geom_size[i], pos, quat, origin, d, length)
                else:
                    m = i - num_geoms
                    free = not is_blocked(
                        obstacle_type[e, m], obstacle_size[e, m], obstacle_pos[e, m], obstacle_quat[e, m], origin, d,
                        length,
                    )  # fmt: skip
                j += 1
            if free:
                seen += 1
    count_out[e] = seen
