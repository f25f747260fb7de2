"""Writes each environment's quadratic program: task rows, diagonal and box.

min 1/2 sum_r w_r (J_r qd - v_r)^2 + 1/2 sum_i (h_i qd_i^2 - 2 g_i qd_i) + 1/2 rho sum_k s_k^2
subject to low <= qd <= high, A_k qd + s_k >= b_k, s_k >= 0
"""

# ruff: noqa: UP018 (float(0.0) declares a dynamic variable in a Warp kernel)
import warp as wp

from wbm.kernels import se3
from wbm.kernels import wbc_objectives as obj
from wbm.kernels.kinematics import Tree, finite_or
from wbm.kernels.wbc_limits import velocity_bounds

wp.set_module_options({"enable_backward": False})


@wp.struct
class Targets:
    """What the caller asks for; N environments, J = 16 controlled joints."""

    ee_pos: wp.array(dtype=wp.vec3)
    ee_quat: wp.array(dtype=wp.vec4)
    ee_lin_vel: wp.array(dtype=wp.vec3)
    ee_ang_vel: wp.array(dtype=wp.vec3)
    gaze_point: wp.array(dtype=wp.vec3)
    gaze_weight: wp.array(dtype=wp.float32)
    q_posture: wp.array2d(dtype=wp.float32)
    weights: wp.array2d(dtype=wp.float32)
    gains: wp.array2d(dtype=wp.float32)


@wp.struct
class Limits:
    """Limits of the controlled joints [J], the step, and which of them are the base's."""

    joint: wp.array(dtype=wp.int32)  # index into q
    q_min: wp.array(dtype=wp.float32)
    q_max: wp.array(dtype=wp.float32)
    speed: wp.array(dtype=wp.float32)
    acceleration: wp.array(dtype=wp.float32)
    base_scale: wp.array(dtype=wp.float32)  # lever (m) that makes a base joint's unit a metre, 0 for arm and neck
    dt: wp.float64
    lead_time: wp.float32  # how far, in seconds at full speed, the target may run ahead of the measured joint
    from_target: wp.int32  # 1 integrate from the previous target, 0 from the measured position


@wp.struct
class Frames:
    """The frames that the objectives use: index of the frame and bits of the joints that move it."""

    ee: wp.int32
    ee_mask: wp.int32
    camera: wp.int32
    camera_mask: wp.int32
    base: wp.int32
    yaw: wp.int32  # controlled joint that turns the base
    pan: wp.int32  # controlled joint that turns the camera's arm about the vertical
    pan_mount: wp.vec3  # its place in the base frame, m
    pan_zero: wp.float32  # azimuth of the optical axis at pan 0 in the home pose, rad


@wp.func
def moved(mask: int, j: int) -> float:
    """1 if bit j of `mask` is set, else 0."""
    return float((mask >> j) & 1)


@wp.kernel(enable_backward=False)
def assemble_tasks(
    # in:
    tree: Tree,
    frames: Frames,
    targets: Targets,
    limits: Limits,
    q: wp.array2d(dtype=wp.float32),  # [N,nq]
    qd_prev: wp.array2d(dtype=wp.float32),  # [N,J]
    body_pos: wp.array2d(dtype=wp.vec3),  # [N,B]
    frame_pos: wp.array2d(dtype=wp.vec3),  # [N,F]
    frame_quat: wp.array2d(dtype=wp.vec4),  # [N,F]
    screw: wp.array2d(dtype=wp.spatial_vector),  # [N,J]
    # out:
    jac_out: wp.array3d(dtype=wp.float32),  # [N,9,J]
    vel_out: wp.array2d(dtype=wp.float32),  # [N,9]
    weight_out: wp.array2d(dtype=wp.float32),  # [N,9]
    diag_out: wp.array2d(dtype=wp.float32),  # [N,J] h
    rhs_out: wp.array2d(dtype=wp.float32),  # [N,J] g
):
    """Objectives of one environment: rows of hand, gaze and viewing distance, and the joints' diagonal."""
    e = wp.tid()
    ref = body_pos[e, tree.ref_body]
    k_pos = targets.gains[e, obj.K_EE_POSITION]
    p_ee = frame_pos[e, frames.ee]
    lin = obj.ee_linear_velocity(
        targets.ee_pos[e], p_ee, targets.ee_lin_vel[e], k_pos, targets.gains[e, obj.K_EE_SPEED]
    )
    ang = obj.ee_angular_velocity(
        targets.ee_quat[e],
        frame_quat[e, frames.ee],
        targets.ee_ang_vel[e],
        targets.gains[e, obj.K_EE_ROTATION],
        targets.gains[e, obj.K_EE_TURN],
    )
    p_cam = frame_pos[e, frames.camera]
    axis = se3_axis(frame_quat[e, frames.camera], 2)
    image_y = se3_axis(frame_quat[e, frames.camera], 1)
    to_target = obj.finite3(targets.gaze_point[e] - p_cam)
    distance = wp.length(to_target)
    w_gaze = wp.clamp(finite_or(targets.gaze_weight[e], 0.0), 0.0, obj.HUGE)
    sight = axis
    if distance > obj.NEAR_CAMERA:
        sight = to_target / distance
    else:
        w_gaze = 0.0
        distance = obj.NEAR_CAMERA
    theta, u, t = obj.gaze_basis(axis, sight, image_y)
    turn = -wp.min(targets.gains[e, obj.K_GAZE] * theta, targets.gains[e, obj.K_GAZE_TURN])
    radial = obj.distance_velocity(
        distance,
        targets.gains[e, obj.K_DISTANCE_MIN],
        targets.gains[e, obj.K_DISTANCE_MAX],
        targets.gains[e, obj.K_DISTANCE],
    )
    for i in range(3):
        vel_out[e, i] = lin[i]
        vel_out[e, 3 + i] = ang[i]
        weight_out[e, i] = targets.weights[e, obj.W_EE_POSITION]
        weight_out[e, 3 + i] = targets.weights[e, obj.W_EE_ROTATION]
    vel_out[e, obj.ROW_DISTANCE] = radial
    weight_out[e, obj.ROW_GAZE] = w_gaze * targets.weights[e, obj.W_GAZE]
    weight_out[e, obj.ROW_GAZE + 1] = w_gaze * targets.weights[e, obj.W_GAZE]
    w_distance = wp.where(radial == 0.0, 0.0, w_gaze * targets.weights[e, obj.W_DISTANCE])
    weight_out[e, obj.ROW_DISTANCE] = wp.where(radial > 0.0, obj.TOO_NEAR, 1.0) * w_distance
    carried = wp.vec2(0.0, 0.0)
    helps = obj.base_helps(theta)
    for j in range(screw.shape[1]):
        w = wp.spatial_top(screw[e, j])
        m = wp.spatial_bottom(screw[e, j])
        v_ee = m + wp.cross(w, p_ee - ref)
        on_ee = moved(frames.ee_mask, j)
        for i in range(3):
            jac_out[e, i, j] = on_ee * v_ee[i]
            jac_out[e, 3 + i, j] = on_ee * w[i]
        v_cam = m + wp.cross(w, p_cam - ref)
        on_cam = moved(frames.camera_mask, j)
        rows = obj.gaze_rows(w, v_cam, theta, u, t, distance)
        if limits.base_scale[j] > 0.0:
            # What the base does not do for the gaze, the neck makes up for: the base's last velocity is fed forward.
            carried += (1.0 - helps) * qd_prev[e, j] * rows
            rows = helps * rows
        jac_out[e, obj.ROW_GAZE, j] = on_cam * rows[0]
        jac_out[e, obj.ROW_GAZE + 1, j] = on_cam * rows[1]
        jac_out[e, obj.ROW_DISTANCE, j] = -on_cam * wp.dot(sight, v_cam)
    vel_out[e, obj.ROW_GAZE] = turn - carried[0]
    vel_out[e, obj.ROW_GAZE + 1] = -carried[1]
    target_b = se3.pose_inv_mul_pos(frame_pos[e, frames.base], frame_quat[e, frames.base], p_cam + to_target)
    pan = obj.look_pan(target_b, frames.pan_mount, frames.pan_zero)
    look = wp.min(theta / obj.LOOK_ANGLE, 1.0)
    look = wp.min(w_gaze, 1.0) * look * look * targets.weights[e, obj.W_LOOK]
    joint_diagonal(e, frames, targets, limits, q, qd_prev, look, pan, diag_out, rhs_out)
    hand_b = se3.pose_inv_mul_pos(
        frame_pos[e, frames.base], frame_quat[e, frames.base], p_ee + obj.finite3(targets.ee_pos[e] - p_ee)
    )
    yaw = frames.yaw
    q_yaw = finite_or(q[e, limits.joint[yaw]], 0.0)
    turn_base = obj.face_turn(hand_b, target_b, w_gaze > 0.0, q_yaw, limits.q_min[yaw], limits.q_max[yaw])
    share = obj.face_share(turn_base, hand_b)
    face = share * targets.weights[e, obj.W_FACE]
    for i in range(6):
        weight_out[e, i] = weight_out[e, i] * (1.0 - obj.FACE_WAIT * wp.min(face, share))
    diag_out[e, yaw] = diag_out[e, yaw] + face
    rhs_out[e, yaw] = rhs_out[e, yaw] + face * wp.clamp(2.0 * turn_base, -obj.FACE_SPEED, obj.FACE_SPEED)


@wp.func
def se3_axis(quat: wp.vec4, k: int) -> wp.vec3:
    """Column k of the rotation matrix of a unit quaternion (w x y z)."""
    axis = wp.vec3(0.0, 0.0, 0.0)
    axis[k] = 1.0
    r = wp.vec3(quat[1], quat[2], quat[3])
    c = 2.0 * wp.cross(r, axis)
    return axis + quat[0] * c + wp.cross(r, c)


@wp.func
def joint_diagonal(
    e: int,
    frames: Frames,
    targets: Targets,
    limits: Limits,
    q: wp.array2d(dtype=wp.float32),
    qd_prev: wp.array2d(dtype=wp.float32),
    look: float,
    pan: float,
    diag_out: wp.array2d(dtype=wp.float32),
    rhs_out: wp.array2d(dtype=wp.float32),
):
    """`h_i qd_i^2 - 2 g_i qd_i` of each joint: posture, facing the target, centring, base weight and smoothness."""
    for j in range(qd_prev.shape[1]):
        lever = limits.base_scale[j]
        q_j = finite_or(q[e, limits.joint[j]], 0.0)
        posture = targets.weights[e, obj.W_POSTURE]
        h = targets.weights[e, obj.W_DAMPING]
        g = float(0.0)
        if lever > 0.0:
            posture = targets.weights[e, obj.W_POSTURE_BASE]
            smooth = lever * lever * targets.weights[e, obj.W_SMOOTHNESS]
            h += smooth + lever * lever * targets.weights[e, obj.W_BASE]
            g += smooth * qd_prev[e, j]
        else:
            inward = obj.centring(q_j, limits.q_min[j], limits.q_max[j])
            weight = wp.abs(inward) * targets.weights[e, obj.W_CENTRING]
            h += weight
            g += weight * targets.gains[e, obj.K_CENTRING] * inward
        if lever == 0.0 and moved(frames.camera_mask, j) == 1.0:
            goal = targets.q_posture[e, j]
            if j == frames.pan:
                goal = wp.clamp(pan, limits.q_min[j], limits.q_max[j])
            weight = look
            if j != frames.pan:
                # Once the pan is right the other joints are free to tilt the camera as the gaze rows ask.
                weight *= wp.clamp(2.0 * wp.abs(pan - q[e, limits.joint[frames.pan]]), 0.1, 1.0)
            h += weight
            g += weight * wp.clamp(2.0 * finite_or(goal - q_j, 0.0), -obj.LOOK_SPEED, obj.LOOK_SPEED)
        h += posture
        g += posture * obj.posture_velocity(targets.q_posture[e, j], q_j, targets.gains[e, obj.K_POSTURE])
        diag_out[e, j] = h
        rhs_out[e, j] = g


@wp.kernel(enable_backward=False)
def bound_velocities(
    # in:
    limits: Limits,
    q: wp.array2d(dtype=wp.float32),  # [N,nq] measured
    q_command: wp.array2d(dtype=wp.float32),  # [N,J] previous target
    qd_prev: wp.array2d(dtype=wp.float32),  # [N,J]
    fresh: wp.array(dtype=wp.int32),  # [N] 1 after a reset
    # out:
    q_from_out: wp.array2d(dtype=wp.float32),  # [N,J] position from which to integrate
    qd_from_out: wp.array2d(dtype=wp.float32),  # [N,J] previous velocity, 0 after a reset
    low_out: wp.array2d(dtype=wp.float64),  # [N,J]
    high_out: wp.array2d(dtype=wp.float64),  # [N,J]
):
    """The box of the program, a thread an environment."""
    e = wp.tid()
    dt = limits.dt
    for j in range(limits.joint.shape[0]):
        measured = finite_or(q[e, limits.joint[j]], 0.0)
        start = measured
        previous = qd_prev[e, j]
        lead = wp.float64(limits.lead_time) * wp.float64(limits.speed[j])
        if fresh[e] == 1:
            previous = 0.0
        elif limits.from_target == 1:
            start = q_command[e, j]
        ahead = wp.float64(start) - wp.float64(measured)
        low, high = velocity_bounds(
            wp.float64(start),
            wp.float64(previous),
            wp.float64(limits.q_min[j]),
            wp.float64(limits.q_max[j]),
            wp.float64(limits.speed[j]),
            wp.float64(limits.acceleration[j]),
            dt,
            wp.min((-lead - ahead) / dt, wp.float64(0.0)),
            wp.max((lead - ahead) / dt, wp.float64(0.0)),
        )
        q_from_out[e, j] = start
        qd_from_out[e, j] = previous
        low_out[e, j] = low
        high_out[e, j] = high
