"""From ranges to points, colours and flags, and from a scan to a cloud of a fixed size."""

# ruff: noqa: RUF046, UP018 (int(0) declares a dynamic variable in a Warp kernel)
import warp as wp

from wbm.kernels.noise import (
    STREAM_BURST,
    STREAM_RAY,
    STREAM_SAMPLE,
    RayNoise,
    noise_state,
    noise_stream,
    noisy_range,
)
from wbm.kernels.se3 import quat_wxyz_normalize, quat_wxyz_rotate_inv


@wp.kernel(enable_backward=False)
def fill_hits(
    # in:
    env_ids: wp.array[int],  # [n]
    pattern: wp.array[int],  # [N]
    step: wp.array[int],  # [N]
    key: wp.array[int],  # [N]
    level: wp.array[float],  # [N]
    noise: RayNoise,
    chunk: int,  # rays of a thread
    ray: wp.array2d[wp.vec3],  # [Q,R] unit, head frame
    sensor_pos: wp.array[wp.vec3],  # [N] as believed
    head: wp.array[wp.mat33],  # [N] head -> sensor frame
    sensor_rot: wp.array[wp.mat33],  # [N] sensor -> world, as believed
    planar: bool,  # limits apply to depth instead of range
    min_range: float,
    max_range: float,
    hit: wp.array2d[float],  # [N,R] true range, negative: none
    slot: wp.array2d[int],  # [N,R] instance
    inst_id: wp.array2d[int],  # [N,I]
    inst_color: wp.array2d[wp.vec3],  # [N,I]
    # out:
    range_out: wp.array2d[float],  # [N,R] -1 invalid
    depth_out: wp.array2d[float],  # [N,R] coordinate along sensor z; -1 invalid
    instance_out: wp.array2d[int],  # [N,R] -1 invalid
    id_out: wp.array2d[int],  # [N,R] -1 invalid
    color_out: wp.array2d[wp.vec3],  # [N,R]
    valid_out: wp.array2d[wp.bool],  # [N,R]
    point_s_out: wp.array2d[wp.vec3],  # [N,R] sensor frame
    point_w_out: wp.array2d[wp.vec3],  # [N,R] world frame
):
    """The measured return and all that follows from it; zeros and flags where there is none."""
    i, c = wp.tid()
    env = env_ids[i]
    row = pattern[env]
    rot = sensor_rot[env]
    pos = sensor_pos[env]
    turn = head[env]
    ray_stream = noise_stream(noise.seed, key[env], step[env], STREAM_RAY)
    burst_stream = noise_stream(noise.seed, key[env], step[env], STREAM_BURST)
    for r in range(c * chunk, wp.min((c + 1) * chunk, ray.shape[1])):
        inst = slot[env, r]
        t = float(hit[env, r])
        if t >= 0.0 and noise.active != 0:
            t = noisy_range(noise, ray, hit, row, env, r, ray_stream, burst_stream, level[env], max_range)
        p = t * ray[row, r]
        measured = t
        if planar:
            measured = p[2]
        if t >= 0.0 and measured >= min_range and measured <= max_range:
            p_s = turn * p
            range_out[env, r] = t
            depth_out[env, r] = p_s[2]
            instance_out[env, r] = inst
            id_out[env, r] = inst_id[env, inst]
            color_out[env, r] = inst_color[env, inst]
            valid_out[env, r] = True
            point_s_out[env, r] = p_s
            point_w_out[env, r] = pos + rot * p_s
        else:
            range_out[env, r] = -1.0
            depth_out[env, r] = -1.0
            instance_out[env, r] = -1
            id_out[env, r] = -1
            color_out[env, r] = wp.vec3(0.0, 0.0, 0.0)
            valid_out[env, r] = False
            point_s_out[env, r] = wp.vec3(0.0, 0.0, 0.0)
            point_w_out[env, r] = wp.vec3(0.0, 0.0, 0.0)


@wp.func
def to_base(p_w: wp.vec3, base_pos: wp.vec3, base_quat: wp.vec4) -> wp.vec3:
    """World point in the base frame."""
    return quat_wxyz_rotate_inv(base_quat, p_w - base_pos)


@wp.func
def point_class(
    valid: bool,
    id: int,
    p: wp.vec3,
    crop_min: wp.vec3,
    crop_max: wp.vec3,
    target_id: int,
    robot_id: int,
    self_filter: bool,
) -> int:
    """0: not eligible, 1: on the target, 2: anything else."""
    if not valid:
        return 0
    if self_filter and id == robot_id:
        return 0
    if p[0] < crop_min[0] or p[1] < crop_min[1] or p[2] < crop_min[2]:
        return 0
    if p[0] > crop_max[0] or p[1] > crop_max[1] or p[2] > crop_max[2]:
        return 0
    if id == target_id:
        return 1
    return 2


@wp.kernel(enable_backward=False)
def assemble_cloud(
    # in:
    env_ids: wp.array[int],  # [n]
    step: wp.array[int],  # [N]
    key: wp.array[int],  # [N]
    seed: int,
    base_pos: wp.array[wp.vec3],  # [N]
    base_quat: wp.array[wp.vec4],  # [N] w x y z
    crop_min: wp.vec3,  # base frame
    crop_max: wp.vec3,
    target_id: int,
    robot_id: int,
    self_filter: bool,
    target_quota: int,
    valid: wp.array2d[wp.bool],  # [N,R]
    id: wp.array2d[int],
    color: wp.array2d[wp.vec3],
    point_w: wp.array2d[wp.vec3],
    # scratch:
    class_scratch: wp.array2d[wp.int8],  # [N,R]
    # out:
    xyz_out: wp.array2d[wp.vec3],  # [N,P] base frame
    rgb_out: wp.array2d[wp.vec3],
    valid_out: wp.array2d[wp.bool],
    target_out: wp.array2d[wp.bool],
    robot_out: wp.array2d[wp.bool],
    id_out: wp.array2d[int],
):
    """Crop a scan and draw P of its points without replacement (Knuth's Algorithm S), each class by its own quota.

    At most `target_quota` points lie on the target while others can fill the rest; a shortage of either class is made
    up by the other, and places that remain are flagged invalid with zeros.
    """
    env = env_ids[wp.tid()]
    num_points = xyz_out.shape[1]
    pos = base_pos[env]
    quat = quat_wxyz_normalize(base_quat[env])
    left_target = int(0)
    left_other = int(0)
    if wp.isfinite(pos) and wp.isfinite(base_quat[env]):
        for r in range(valid.shape[1]):
            p = to_base(point_w[env, r], pos, quat)
            c = point_class(valid[env, r], id[env, r], p, crop_min, crop_max, target_id, robot_id, self_filter)
            class_scratch[env, r] = wp.int8(c)
            if c == 1:
                left_target += 1
            elif c == 2:
                left_other += 1
    # Others give way to the quota; what they cannot fill goes back to the target.
    need_target = wp.min(left_target, target_quota)
    need_other = wp.min(left_other, num_points - need_target)
    need_target = wp.min(left_target, num_points - need_other)
    total = need_target + need_other
    state = noise_state(seed, key[env], step[env], STREAM_SAMPLE, 0)
    k = int(0)
    r = int(0)
    while k < total:
        c = int(class_scratch[env, r])
        take = bool(False)
        if c == 1:
            take = wp.randf(state) * float(left_target) < float(need_target)
            left_target -= 1
            if take:
                need_target -= 1
        elif c == 2:
            take = wp.randf(state) * float(left_other) < float(need_other)
            left_other -= 1
            if take:
                need_other -= 1
        if take:
            xyz_out[env, k] = to_base(point_w[env, r], pos, quat)
            rgb_out[env, k] = color[env, r]
            valid_out[env, k] = True
            target_out[env, k] = c == 1
            robot_out[env, k] = id[env, r] == robot_id
            id_out[env, k] = id[env, r]
            k += 1
        r += 1
    for j in range(total, num_points):
        xyz_out[env, j] = wp.vec3(0.0, 0.0, 0.0)
        rgb_out[env, j] = wp.vec3(0.0, 0.0, 0.0)
        valid_out[env, j] = False
        target_out[env, j] = False
        robot_out[env, j] = False
        id_out[env, j] = -1
