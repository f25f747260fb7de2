"""Where a rolling scan stands at an environment's step."""

import warp as wp

from wbm.kernels.se3 import quat_wxyz_mul, quat_wxyz_normalize


@wp.kernel(enable_backward=False)
def spin_sensor(
    # in:
    env_ids: wp.array[int],  # [n]
    step: wp.array[int],  # [N]
    turn: wp.float64,  # revolutions of the head in a step
    num_patterns: int,
    mount_pos: wp.array[wp.vec3],  # [N]
    mount_quat: wp.array[wp.vec4],  # [N] w x y z
    # out:
    pattern_out: wp.array[int],  # [N]
    pos_out: wp.array[wp.vec3],
    quat_out: wp.array[wp.vec4],
):
    """Pose of the spinning head about the mount's z axis and the phase of its sweep."""
    env = env_ids[wp.tid()]
    s = wp.max(step[env], 0)
    # float64: the angle after many steps keeps the precision of the first.
    revolutions = wp.float64(s) * turn
    half = wp.float32(revolutions - wp.floor(revolutions)) * wp.pi
    pattern_out[env] = s % num_patterns
    pos_out[env] = mount_pos[env]
    quat = mount_quat[env]
    if wp.isfinite(quat):
        quat = quat_wxyz_mul(quat_wxyz_normalize(quat), wp.vec4(wp.cos(half), 0.0, 0.0, wp.sin(half)))
    quat_out[env] = quat
