"""Velocity bounds that keep a joint inside its position, velocity and acceleration limits for ever.

With `a dt` as the unit of velocity and `a dt^2` as the unit of distance, a joint that moves with velocity u in this
step and then brakes as hard as it may travels `S(u) = u + (u-1)+ + (u-2)+ + ...`. `S(u) <= D` keeps it within the
distance D of its limit in discrete time, exactly. If it holds in one step, braking fully makes it hold in the next:
`S(u-1) = S(u) - u <= D - u`. So the bounds from above and below and the acceleration's window always share a point.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

ROUNDING = wp.constant(wp.float64(5.0e-7))
"""Taken off the acceleration's window (m/s or rad/s), so that rounding to float32 cannot leave it."""
RETURN_TIME = wp.constant(wp.float64(0.2))
ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))


@wp.func
def stoppable_speed(distance: wp.float64, unit: wp.float64, dt: wp.float64) -> wp.float64:
    """Largest speed from which a stop within `distance` >= 0 is possible; `unit` is acceleration times dt."""
    d = distance / (unit * dt)
    m = wp.floor((wp.sqrt(ONE + wp.float64(8.0) * d) - ONE) * wp.float64(0.5))
    return unit * (d + wp.float64(0.5) * m * (m + ONE)) / (m + ONE)


@wp.func
def speed_towards(distance: wp.float64, unit: wp.float64, speed: wp.float64, dt: wp.float64) -> wp.float64:
    """Largest velocity towards a limit at `distance`; negative (a return in 0.2 s) when the limit is passed."""
    out = speed
    if distance < ZERO:
        out = wp.max(-speed, wp.max(distance / wp.max(RETURN_TIME, dt), -ONE))
    elif distance * unit < speed * (speed + unit) * dt:
        # Beyond this distance even the full speed can be stopped: S(u) <= u (u + 1) / 2 + 1/8.
        out = wp.min(speed, stoppable_speed(distance, unit, dt))
    return out


@wp.func
def velocity_bounds(
    q: wp.float64,
    qd_prev: wp.float64,
    q_min: wp.float64,
    q_max: wp.float64,
    speed: wp.float64,
    acceleration: wp.float64,
    dt: wp.float64,
    lead_low: wp.float64,
    lead_high: wp.float64,
):
    """Lower and upper bound of a joint's velocity in this step, never crossed.

    Args:
        q, qd_prev: position from which the velocity is integrated, and the previous velocity.
        lead_low, lead_high: further bounds (<= 0 <= ) that yield to the acceleration limit.

    The acceleration's window comes last and wins: velocity never jumps, whatever the other bounds say.
    """
    unit = acceleration * dt - ROUNDING
    window_low = qd_prev - unit
    window_high = qd_prev + unit
    high = wp.min(speed_towards(q_max - q, unit, speed, dt), lead_high)
    low = wp.max(-speed_towards(q - q_min, unit, speed, dt), lead_low)
    if q > q_max:
        low = wp.min(low, high)
    high = wp.max(high, low)
    return wp.clamp(low, window_low, window_high), wp.clamp(high, window_low, window_high)


@wp.func
def approach_bound(gap: float, gamma: float, brake: float, escape: float, dt: float) -> float:
    """Velocity damper `n^T J qd >= b`: `b = -min(gamma gap / dt, v_stop(gap))`, or an escape speed inside the gap.

    `v_stop` is the speed that a deceleration of `brake` (m/s^2) can stop within the gap in discrete time (the inverse
    of S), so that the bound asks for no more than the joints' acceleration limits can give.
    """
    bound = wp.min(-gamma * gap / dt, escape)
    if gap > 0.0:
        unit = wp.max(brake, 1.0e-3) * dt
        d = gap / (unit * dt)
        m = wp.floor((wp.sqrt(1.0 + 8.0 * d) - 1.0) * 0.5)
        bound = wp.max(-gamma * gap / dt, -unit * (d + 0.5 * m * (m + 1.0)) / (m + 1.0))
    return bound
