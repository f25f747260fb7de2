"""World poses of every link of a robot, for what must draw or see the whole body rather than control it."""

import warp as wp

from wbm.kernels import se3

wp.set_module_options({"enable_backward": False})

FIXED = wp.constant(0)
HINGE = wp.constant(1)


@wp.kernel(enable_backward=False)
def link_poses(
    # in:
    parent: wp.array(dtype=wp.int32),  # [L], parents first; link 0 is the world
    link_pos: wp.array(dtype=wp.vec3),  # [L] in the parent, m
    link_quat: wp.array(dtype=wp.vec4),  # [L] in the parent at q = 0, w x y z
    joint_type: wp.array(dtype=wp.int32),  # [L] 0 fixed, 1 hinge, 2 slide
    joint_axis: wp.array(dtype=wp.vec3),  # [L] link frame
    joint_index: wp.array(dtype=wp.int32),  # [L] index into q
    q: wp.array2d(dtype=wp.float32),  # [N,nq]
    # out:
    pos_out: wp.array2d(dtype=wp.vec3),  # [N,L]
    quat_out: wp.array2d(dtype=wp.vec4),  # [N,L] w x y z
):
    """Forward kinematics, a thread an environment."""
    e = wp.tid()
    pos_out[e, 0] = wp.vec3()
    quat_out[e, 0] = wp.vec4(1.0, 0.0, 0.0, 0.0)
    for i in range(1, parent.shape[0]):
        p = parent[i]
        up = quat_out[e, p]
        pos = pos_out[e, p] + se3.quat_wxyz_rotate(up, link_pos[i])
        quat = se3.quat_wxyz_mul(up, link_quat[i])
        if joint_type[i] != FIXED:
            value = q[e, joint_index[i]]
            if joint_type[i] == HINGE:
                half = 0.5 * value
                v = wp.sin(half) * joint_axis[i]
                quat = se3.quat_wxyz_mul(quat, wp.vec4(wp.cos(half), v[0], v[1], v[2]))
            else:
                pos += se3.quat_wxyz_rotate(quat, value * joint_axis[i])
        pos_out[e, i] = pos
        quat_out[e, i] = quat / wp.length(quat)
