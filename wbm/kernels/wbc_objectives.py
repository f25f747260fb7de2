"""The controller's objectives as rows `J qd = v` with a weight each, one function an objective.

Rows 0-2 are the hand's linear velocity, 3-5 its angular velocity, 6-7 the gaze, 8 the viewing distance. Posture,
joint-limit centring, base weight, base smoothness, facing and damping act on single joints and are a diagonal.
"""

# ruff: noqa: RUF046, UP018 (float(0.0) declares a dynamic variable in a Warp kernel)
import warp as wp

from wbm.kernels import se3
from wbm.kernels.kinematics import finite_or

wp.set_module_options({"enable_backward": False})

ROWS = 9
ROW_GAZE = wp.constant(6)
ROW_DISTANCE = wp.constant(8)

# Columns of the live arrays `weights` and `gains`, one row an environment.
WEIGHT_NAMES = (
    "ee_position", "ee_rotation", "gaze", "distance", "posture", "posture_base",
    "centring", "base", "smoothness", "damping", "look", "face", "collision",
)  # fmt: skip
GAIN_NAMES = (
    "ee_position", "ee_rotation", "gaze", "distance", "posture", "centring", "ee_speed", "ee_turn", "gaze_turn",
    "distance_min", "distance_max", "safe_obstacle", "safe_self", "gamma", "brake", "escape",
    "ee_damping", "repulsion",
)  # fmt: skip
(
    W_EE_POSITION, W_EE_ROTATION, W_GAZE, W_DISTANCE, W_POSTURE, W_POSTURE_BASE,
    W_CENTRING, W_BASE, W_SMOOTHNESS, W_DAMPING, W_LOOK, W_FACE, W_COLLISION,
) = (wp.constant(i) for i in range(len(WEIGHT_NAMES)))  # fmt: skip
(
    K_EE_POSITION, K_EE_ROTATION, K_GAZE, K_DISTANCE, K_POSTURE, K_CENTRING, K_EE_SPEED, K_EE_TURN, K_GAZE_TURN,
    K_DISTANCE_MIN, K_DISTANCE_MAX, K_SAFE_OBSTACLE, K_SAFE_SELF, K_GAMMA, K_BRAKE, K_ESCAPE,
    K_EE_DAMPING, K_REPULSION,
) = (wp.constant(i) for i in range(len(GAIN_NAMES)))  # fmt: skip

HUGE = wp.constant(1.0e6)
POSTURE_SPEED = wp.constant(0.5)
NEAR_CAMERA = wp.constant(0.05)
CENTRING_BAND = wp.constant(0.1)
LOOK_ANGLE = wp.constant(0.5)  # rad, gaze error from which the neck's posture has its full weight
LOOK_SPEED = wp.constant(1.5)  # rad/s
HELP_ANGLE = wp.constant(0.8)  # rad, gaze error from which the base does nothing for the gaze
FACE_HAND = wp.constant(1.15)  # rad, azimuth of the hand's goal in the base frame from which the base turns
FACE_SIGHT = wp.constant(2.0)  # rad, the same of the target to look at
FACE_BAND = wp.constant(0.3)  # rad over which the weight of turning rises
FACE_NEAR = wp.constant(0.3)  # m from the base's axis within which the azimuth says little
FACE_SPEED = wp.constant(0.8)  # rad/s
FACE_WAIT = wp.constant(0.9)  # share of the hand's weight that waits for the base to face its goal
TOO_NEAR = wp.constant(10.0)  # factor on the viewing distance's weight when the camera is too near
FULL_TURN = wp.constant(6.2831855)  # rad
AZIMUTH_FACTOR_MAX = wp.constant(1.5707964)


@wp.func
def finite3(v: wp.vec3) -> wp.vec3:
    """`v` with NaN as 0 and everything else within +-1e6."""
    return wp.vec3(
        wp.clamp(wp.where(wp.isnan(v[0]), 0.0, v[0]), -HUGE, HUGE),
        wp.clamp(wp.where(wp.isnan(v[1]), 0.0, v[1]), -HUGE, HUGE),
        wp.clamp(wp.where(wp.isnan(v[2]), 0.0, v[2]), -HUGE, HUGE),
    )


@wp.func
def limit_norm(v: wp.vec3, largest: float) -> wp.vec3:
    """`v`, shortened to the length `largest`."""
    length = wp.length(v)
    out = v
    if length > largest:
        out = v * (largest / length)
    return out


@wp.func
def ee_linear_velocity(p_WD: wp.vec3, p_WE: wp.vec3, feed_forward: wp.vec3, gain: float, speed: float) -> wp.vec3:
    """`v* = sat(k (p_WD - p_WE), speed) + v_ff`, m/s, against the rows `J_WE_W[0:3]`."""
    return limit_norm(gain * finite3(p_WD - p_WE), speed) + limit_norm(finite3(feed_forward), 2.0 * speed)


@wp.func
def ee_angular_velocity(q_WD: wp.vec4, q_WE: wp.vec4, feed_forward: wp.vec3, gain: float, turn: float) -> wp.vec3:
    """`omega* = sat(k log(R_WD R_WE^T), turn) + omega_ff`, rad/s, against the rows `J_WE_W[3:6]`."""
    e = se3.rotation_error(se3.quat_wxyz_normalize(q_WD), q_WE)
    return limit_norm(gain * e, turn) + limit_norm(finite3(feed_forward), 2.0 * turn)


@wp.func
def gaze_basis(axis: wp.vec3, sight: wp.vec3, fallback: wp.vec3):
    """Angle `theta` from the optical axis to the line of sight (unit vectors), and the axes of turning.

    `u = axis x sight / |axis x sight|` is the axis that turns the camera onto the target the shortest way and
    `t = sight x u` completes it. Along and against the optical axis `u` is undefined: `fallback` (unit, across the
    optical axis) takes its place, so that a camera with the target straight behind it turns too.
    """
    cross = wp.cross(axis, sight)
    h = wp.length(cross)
    theta = wp.atan2(h, wp.dot(axis, sight))
    u = fallback
    if h > 1.0e-5:
        u = cross / h
    return theta, u, wp.cross(sight, u)


@wp.func
def gaze_rows(w: wp.vec3, v: wp.vec3, theta: float, u: wp.vec3, t: wp.vec3, distance: float) -> wp.vec2:
    """One joint's entries of the gaze Jacobian; `w`, `v` the camera's twist for unit velocity of the joint.

    The angle-axis error `e = theta u`, written in the camera frame, changes by `theta_dot = -u.w + t.v/D` along itself
    and by `(theta / sin theta) (t.w + u.v/D)` across (exact; D the distance to the target). The second row asks
    for zero. Its factor grows without bound near 180 degrees and is held at its value at 90 degrees there: beyond
    it the camera may leave the great circle, which costs nothing.
    """
    factor = float(1.0)
    if theta > 0.01:
        factor = AZIMUTH_FACTOR_MAX
        if theta < AZIMUTH_FACTOR_MAX:
            factor = theta / wp.sin(theta)
    return wp.vec2(
        wp.dot(t, v) / distance - wp.dot(u, w),
        factor * (wp.dot(t, w) + wp.dot(u, v) / distance),
    )


@wp.func
def distance_velocity(distance: float, nearest: float, farthest: float, gain: float) -> float:
    """`D_dot* = k (clamp(D, nearest, farthest) - D)`, m/s, at most 0.3; zero inside the band. Its row is `-sight.v`.

    Too near it has ten times the weight: a camera that is drawn to its target by the rest sees nothing there.
    """
    return wp.clamp(gain * (wp.clamp(distance, nearest, farthest) - distance), -0.3, 0.3)


@wp.func
def posture_velocity(q_posture: float, q: float, gain: float) -> float:
    """`qd* = sat(k (q_posture - q), 0.5)`, against the joint itself."""
    return wp.clamp(gain * finite_or(q_posture - q, 0.0), -POSTURE_SPEED, POSTURE_SPEED)


@wp.func
def wrapped(angle: float) -> float:
    """The angle modulo a full turn, in -pi..pi."""
    return wp.atan2(wp.sin(angle), wp.cos(angle))


@wp.func
def look_pan(target_b: wp.vec3, mount_b: wp.vec3, zero: float) -> float:
    """Pan angle (rad, -pi..pi) at which the neck's posture faces a point; all in the base frame.

    The gaze rows alone take the shortest turn, which can end at a joint limit with the target out of sight. In joint
    space the pan's whole range is open, so a posture that faces the target leads out of every such corner.
    """
    return wrapped(wp.atan2(target_b[1] - mount_b[1], target_b[0] - mount_b[0]) - zero)


@wp.func
def base_helps(theta: float) -> float:
    """Share (0..1) of the base's columns in the gaze rows: none from an error of 0.8 rad on, all at zero.

    A camera that faces away turns over whatever axis is the shortest, and a base that turned with it would often put
    the target farther behind. Near the target the base moves the arm out of the camera's way.
    """
    return wp.clamp(1.0 - theta / HELP_ANGLE, 0.0, 1.0)


@wp.func
def face_turn(hand_b: wp.vec3, target_b: wp.vec3, looks: bool, yaw: float, yaw_min: float, yaw_max: float) -> float:
    """Turn of the base (rad) that brings the hand's goal ahead of it and the target into the neck's range.

    With azimuths `a` (goal) and `b` (target, if the camera looks at one) in the base frame it is the smallest `x`
    within yaw's range with `|a - x| <= 1.15` and `|b - x| <= 2`, modulo a full turn. The two sectors fill more than
    the circle, so there is one. Behind the base the arm twists itself up, and left behind it the neck is blind.
    """
    a = wp.atan2(hand_b[1], hand_b[0])
    b = wp.atan2(target_b[1], target_b[0])
    reach = float(FACE_SIGHT)
    if not looks:
        b = a
        reach = FACE_HAND
    best = float(0.0)
    if wp.abs(a) > FACE_HAND or wp.abs(b) > reach:
        found = int(0)
        b = a + wrapped(b - a)
        for k in range(3):
            for m in range(3):
                hand = a + float(k - 1) * FULL_TURN
                seen = b + float(k + m - 2) * FULL_TURN
                low = wp.max(wp.max(hand - FACE_HAND, seen - reach), yaw_min - yaw)
                high = wp.min(wp.min(hand + FACE_HAND, seen + reach), yaw_max - yaw)
                x = wp.clamp(0.0, low, high)
                if low <= high and (found == 0 or wp.abs(x) < wp.abs(best)):
                    best = x
                    found = 1
    return best


@wp.func
def face_share(turn: float, hand_b: wp.vec3) -> float:
    """How far (0..1) the turn `x` of `face_turn` is an objective: `yaw_dot* = sat(2 x, 0.8)` with the weight `w share`.

    It grows with the square of `x` up to 0.3 rad: nothing happens while the base faces both points, and nothing abrupt
    where it stops. The hand's own rows have `1 - 0.9 share` of their weight meanwhile: it waits for the base (less so
    with a weight below 1).
    """
    share = wp.min(wp.abs(turn) / FACE_BAND, 1.0)
    near = wp.min((hand_b[0] * hand_b[0] + hand_b[1] * hand_b[1]) / (FACE_NEAR * FACE_NEAR), 1.0)
    return share * share * near


@wp.func
def centring(q: float, q_min: float, q_max: float) -> float:
    """How far (-1..1) a joint is into the outer tenth of its range, positive when it should move up.

    The objective is `qd* = k c` with the weight `w |c|`: it vanishes with its derivative where the band begins.
    """
    band = CENTRING_BAND * (q_max - q_min)
    return wp.clamp((q_min + band - q) / band, 0.0, 1.0) - wp.clamp((q - q_max + band) / band, 0.0, 1.0)
