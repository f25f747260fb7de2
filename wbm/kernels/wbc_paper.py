"""Equations (1) to (4) of the paper as printed, for the ablation.

    qd = (sum_i J_i^T W_i J_i + lambda I)^-1 (sum_i J_i^T W_i v_i)                       (1)
    v_ee = K_p (x* - x) - K_d x_dot                                                      (2)
    v_gaze = K (r_cam x r_obj)                                                           (3)
    v_col = eta (1/d - 1/d_safe) / d^2 grad_q d   where d < d_safe                       (4)

(2) needs the velocity that (1) is about to choose; the previous one stands in for it. (3) is written with the sign that
turns the camera towards the target. (4) needs a floor on d to be run at all. What leaves the controller is clamped to
the velocity and position limits, as a low-level controller would; nothing limits its change.
"""

# ruff: noqa: UP018 (float(0.0) declares a dynamic variable in a Warp kernel)
import warp as wp

from wbm.kernels import wbc_objectives as obj
from wbm.kernels.kinematics import Tree, finite_or
from wbm.kernels.wbc_assemble import Frames, Limits, Targets, moved, se3_axis
from wbm.kernels.wbc_dampers import damper_entry
from wbm.kernels.wbc_dense import cholesky_solve, task_hessian, task_linear

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def paper_tasks(
    # in:
    tree: Tree,
    frames: Frames,
    targets: Targets,
    qd_prev: wp.array2d(dtype=wp.float32),  # [N,J]
    body_pos: wp.array2d(dtype=wp.vec3),  # [N,B]
    frame_pos: wp.array2d(dtype=wp.vec3),  # [N,F]
    frame_quat: wp.array2d(dtype=wp.vec4),  # [N,F]
    screw: wp.array2d(dtype=wp.spatial_vector),  # [N,J]
    # in and out: the rows of `assemble_tasks`
    jac_out: wp.array3d(dtype=wp.float32),  # [N,9,J]
    vel_out: wp.array2d(dtype=wp.float32),  # [N,9]
    weight_out: wp.array2d(dtype=wp.float32),  # [N,9]
):
    """Adds the damping of (2) to the hand's rows and puts (3) in the place of gaze and viewing distance."""
    e = wp.tid()
    for r in range(6):
        speed = float(0.0)
        for j in range(screw.shape[1]):
            speed += jac_out[e, r, j] * qd_prev[e, j]
        vel_out[e, r] = vel_out[e, r] - targets.gains[e, obj.K_EE_DAMPING] * speed
    axis = se3_axis(frame_quat[e, frames.camera], 2)
    to_target = obj.finite3(targets.gaze_point[e] - frame_pos[e, frames.camera])
    error = targets.gains[e, obj.K_GAZE] * wp.cross(axis, wp.normalize(to_target))
    w_gaze = wp.clamp(finite_or(targets.gaze_weight[e], 0.0), 0.0, obj.HUGE) * targets.weights[e, obj.W_GAZE]
    for i in range(3):
        vel_out[e, 6 + i] = error[i]
        weight_out[e, 6 + i] = w_gaze
        for j in range(screw.shape[1]):
            jac_out[e, 6 + i, j] = moved(frames.camera_mask, j) * screw[e, j][i]


@wp.kernel(enable_backward=False)
def paper_repulsion(
    # in:
    tree: Tree,
    targets: Targets,
    screw: wp.array2d(dtype=wp.spatial_vector),  # [N,J]
    region_start: wp.array(dtype=wp.int32),  # [G+2]
    count: wp.array2d(dtype=wp.int32),  # [N,G+1]
    nearest: wp.array2d(dtype=wp.float32),  # [N,G+1]
    force: wp.array2d(dtype=wp.vec3),  # [N,C]
    moment: wp.array2d(dtype=wp.vec3),  # [N,C]
    gap: wp.array2d(dtype=wp.float32),  # [N,C]
    side: wp.array2d(dtype=wp.vec2i),  # [N,C]
    reach: wp.float32,
    floor: wp.float32,
    # in and out:
    diag_out: wp.array2d(dtype=wp.float32),  # [N,J]
    rhs_out: wp.array2d(dtype=wp.float32),  # [N,J]
    # out:
    min_distance_out: wp.array(dtype=wp.float32),  # [N]
):
    """(4) for every pair, with the identity as its Jacobian since its gradient is already in joint space."""
    e = wp.tid()
    closest = nearest[e, 0]
    weight = targets.weights[e, obj.W_COLLISION]
    last = count.shape[1] - 1
    for g in range(count.shape[1]):
        closest = wp.min(closest, nearest[e, g])
        keep = targets.gains[e, obj.K_SAFE_OBSTACLE]
        if g == last:
            keep = targets.gains[e, obj.K_SAFE_SELF]
        for i in range(region_start[g], region_start[g] + count[e, g]):
            d_safe = keep + reach
            d = wp.max(gap[e, i] + keep, floor)
            if d < d_safe:
                speed = targets.gains[e, obj.K_REPULSION] * (1.0 / d - 1.0 / d_safe) / (d * d)
                for j in range(screw.shape[1]):
                    a = float(damper_entry(tree, screw[e, j], moment[e, i], force[e, i], side[e, i], j))
                    diag_out[e, j] = diag_out[e, j] + weight
                    rhs_out[e, j] = rhs_out[e, j] + weight * speed * a
    min_distance_out[e] = closest


@wp.kernel(enable_backward=False)
def solve_paper(
    # in:
    jac: wp.array3d(dtype=wp.float32),  # [N,9,J]
    vel: wp.array2d(dtype=wp.float32),  # [N,9]
    weight: wp.array2d(dtype=wp.float32),  # [N,9]
    diag: wp.array2d(dtype=wp.float32),  # [N,J]
    rhs: wp.array2d(dtype=wp.float32),  # [N,J]
    q_from: wp.array2d(dtype=wp.float32),  # [N,J]
    limits: Limits,
    # out:
    low_out: wp.array2d(dtype=wp.float64),  # [N,J]
    high_out: wp.array2d(dtype=wp.float64),  # [N,J]
    x_out: wp.array2d(dtype=wp.float64),  # [N,J]
):
    """(1) by Cholesky, with the clamp's bounds where the other solver has its box."""
    e = wp.tid()
    n = jac.shape[2]
    linear = task_linear(e, n, jac, vel, weight, rhs)
    x = cholesky_solve(task_hessian(e, n, jac, weight, diag), linear, n)
    for i in range(n):
        speed = wp.float64(limits.speed[i])
        q = wp.float64(q_from[e, i])
        up = (wp.float64(limits.q_max[i]) - q) / limits.dt
        down = (wp.float64(limits.q_min[i]) - q) / limits.dt
        low_out[e, i] = wp.clamp(down, -speed, speed)
        high_out[e, i] = wp.clamp(up, -speed, speed)
        x_out[e, i] = x[i]
