"""From ranges to points, colours and flags, and from several images to one cloud of a fixed size."""

import warp as wp

from wbm.kernels.se3 import quat_wxyz_normalize, quat_wxyz_rotate, quat_wxyz_rotate_inv


@wp.kernel(enable_backward=False)
def fill_hits(
    # in:
    env_ids: wp.array[int],  # [n]
    pattern: wp.array[int],  # [N]
    ray: wp.array2d[wp.vec3],  # [Q,R] unit, sensor frame
    sensor_pos: wp.array[wp.vec3],  # [N]
    sensor_quat: wp.array[wp.vec4],  # [N] w x y z, frame of the rays
    frame_quat: wp.array[wp.vec4],  # [N] w x y z, frame of the points
    planar: bool,  # limits apply to depth instead of range
    min_range: float,
    max_range: float,
    ok: wp.array[int],  # [N]
    instance: wp.array2d[int],  # [N,R]
    inst_id: wp.array2d[int],  # [N,I]
    inst_color: wp.array2d[wp.vec3],  # [N,I]
    # inout: ranges outside the device's limits become -1
    range_io: wp.array2d[float],  # [N,R]
    # out:
    depth_out: wp.array2d[float],  # [N,R] coordinate along sensor z; -1 invalid
    id_out: wp.array2d[int],  # [N,R] -1 invalid
    color_out: wp.array2d[wp.vec3],  # [N,R]
    valid_out: wp.array2d[wp.bool],  # [N,R]
    point_s_out: wp.array2d[wp.vec3],  # [N,R] frame of `frame_quat`
    point_w_out: wp.array2d[wp.vec3],  # [N,R] world frame
):
    """Everything that follows from a range: planar depth, class, colour and points; zeros and flags where invalid."""
    i, r = wp.tid()
    env = env_ids[i]
    t = range_io[env, r]
    inst = instance[env, r]
    p = t * ray[pattern[env], r]
    measured = t
    if planar:
        measured = p[2]
    if ok[env] != 0 and inst >= 0 and measured >= min_range and measured <= max_range:
        depth_out[env, r] = p[2]
        id_out[env, r] = inst_id[env, inst]
        color_out[env, r] = inst_color[env, inst]
        valid_out[env, r] = True
        offset = quat_wxyz_rotate(quat_wxyz_normalize(sensor_quat[env]), p)
        point_s_out[env, r] = quat_wxyz_rotate_inv(quat_wxyz_normalize(frame_quat[env]), offset)
        point_w_out[env, r] = sensor_pos[env] + offset
    else:
        range_io[env, r] = -1.0
        depth_out[env, r] = -1.0
        id_out[env, r] = -1
        color_out[env, r] = wp.vec3(0.0, 0.0, 0.0)
        valid_out[env, r] = False
        point_s_out[env, r] = wp.vec3(0.0, 0.0, 0.0)
        point_w_out[env, r] = wp.vec3(0.0, 0.0, 0.0)
