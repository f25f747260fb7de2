"""Turns velocities into position targets and actuator commands."""

import warp as wp

from wbm.kernels.wbc_dense import ZERO

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def integrate(
    # in:
    x: wp.array2d(dtype=wp.float64),  # [N,J]
    low: wp.array2d(dtype=wp.float64),  # [N,J]
    high: wp.array2d(dtype=wp.float64),  # [N,J]
    q_from: wp.array2d(dtype=wp.float32),  # [N,J]
    q_min: wp.array(dtype=wp.float32),  # [J]
    q_max: wp.array(dtype=wp.float32),  # [J]
    dt: wp.float64,
    lag: wp.float32,  # seconds by which the actuators trail their command
    # out:
    qd_out: wp.array2d(dtype=wp.float32),  # [N,J]
    q_target_out: wp.array2d(dtype=wp.float32),  # [N,J]
    ctrl_out: wp.array2d(dtype=wp.float32),  # [N,J]
    fresh_out: wp.array(dtype=wp.int32),  # [N]
):
    """Velocity, its integral and the actuator command, all within the position limits once the joint is."""
    e = wp.tid()
    for j in range(x.shape[1]):
        v = wp.clamp(x[e, j], low[e, j], high[e, j])
        if not wp.isfinite(v):
            v = wp.clamp(ZERO, low[e, j], high[e, j])
        start = q_from[e, j]
        # A joint that starts outside its range may stay as far outside as it is, never farther.
        least = wp.min(q_min[j], start)
        most = wp.max(q_max[j], start)
        target = wp.clamp(float(wp.float64(start) + v * dt), least, most)
        qd_out[e, j] = float(v)
        q_target_out[e, j] = target
        ctrl_out[e, j] = wp.clamp(target + lag * float(v), least, most)
    fresh_out[e] = 0
