"""All SE(3) functions of the project, as Warp functions.

Quaternions in arrays are `wp.vec4` in the order w x y z; functions on them are named `quat_wxyz_*`. Warp's own
`wp.quatf` holds x y z w; functions on it say `quat_xyzw`. A pose `X_AB` is a position `p_AB` and a quaternion `q_AB`.
Rotation vectors are axis times angle in rad. No function returns NaN for finite input: a quaternion of zero length
counts as the identity, and limits replace quotients near zero angles.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

SMALL_ANGLE = wp.constant(1.0e-3)


@wp.func
def quat_wxyz_identity() -> wp.vec4:
    """The rotation by nothing."""
    return wp.vec4(1.0, 0.0, 0.0, 0.0)


@wp.func
def quat_wxyz_normalize(q: wp.vec4) -> wp.vec4:
    """`q / |q|`; the identity where `|q|` is zero or not finite."""
    scale = wp.max(wp.max(wp.abs(q[0]), wp.abs(q[1])), wp.max(wp.abs(q[2]), wp.abs(q[3])))
    unit = quat_wxyz_identity()
    if scale > 1.0e-30 and scale < 1.0e38:
        # Scaling first keeps the squares inside the range of float32.
        r = wp.vec4(q[0] / scale, q[1] / scale, q[2] / scale, q[3] / scale)
        unit = r / wp.sqrt(wp.dot(r, r))
    return unit


@wp.func
def quat_wxyz_inverse(q: wp.vec4) -> wp.vec4:
    """Inverse of a unit quaternion."""
    return wp.vec4(q[0], -q[1], -q[2], -q[3])


@wp.func
def quat_wxyz_mul(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    """`q_AC = q_AB q_BC`."""
    return wp.vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def quat_wxyz_rotate(q: wp.vec4, v: wp.vec3) -> wp.vec3:
    """`v_A = R(q_AB) v_B` for a unit quaternion."""
    u = wp.vec3(q[1], q[2], q[3])
    t = 2.0 * wp.cross(u, v)
    return v + q[0] * t + wp.cross(u, t)


@wp.func
def quat_wxyz_rotate_inv(q: wp.vec4, v: wp.vec3) -> wp.vec3:
    """`v_B = R(q_AB)^T v_A` for a unit quaternion."""
    u = wp.vec3(q[1], q[2], q[3])
    t = 2.0 * wp.cross(u, v)
    return v - q[0] * t + wp.cross(u, t)


@wp.func
def quat_wxyz_to_mat(q: wp.vec4) -> wp.mat33:
    """Rotation matrix `R_AB` of a unit quaternion `q_AB`."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def mat_to_quat_wxyz(m: wp.mat33) -> wp.vec4:
    """Unit quaternion (w x y z, w >= 0) of a rotation matrix, by its largest component."""
    t0 = 1.0 + m[0, 0] + m[1, 1] + m[2, 2]
    t1 = 1.0 + m[0, 0] - m[1, 1] - m[2, 2]
    t2 = 1.0 - m[0, 0] + m[1, 1] - m[2, 2]
    t3 = 1.0 - m[0, 0] - m[1, 1] + m[2, 2]
    q = wp.vec4(t0, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1])
    if t1 > t0 and t1 >= t2 and t1 >= t3:
        q = wp.vec4(m[2, 1] - m[1, 2], t1, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0])
    elif t2 > t0 and t2 >= t3:
        q = wp.vec4(m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], t2, m[1, 2] + m[2, 1])
    elif t3 > t0:
        q = wp.vec4(m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], t3)
    q = quat_wxyz_normalize(q)
    if q[0] < 0.0:
        q = -q
    return q


@wp.func
def quat_wxyz_exp(r: wp.vec3) -> wp.vec4:
    """Unit quaternion of the rotation vector `r` (rad): `(cos |r|/2, sin(|r|/2) r/|r|)`."""
    angle = wp.length(r)
    k = 0.5 - angle * angle / 48.0
    if angle > SMALL_ANGLE:
        k = wp.sin(0.5 * angle) / angle
    return wp.vec4(wp.cos(0.5 * angle), k * r[0], k * r[1], k * r[2])


@wp.func
def quat_wxyz_log(q: wp.vec4) -> wp.vec3:
    """Rotation vector (rad) of a unit quaternion, the shorter way round: `|r| <= pi`."""
    w = q[0]
    v = wp.vec3(q[1], q[2], q[3])
    if w < 0.0:
        w = -w
        v = -v
    s = wp.length(v)
    k = 2.0 / wp.max(w, 0.5)  # atan2(s, w)/s for s -> 0, where w -> 1
    if s > SMALL_ANGLE:
        k = 2.0 * wp.atan2(s, w) / s
    return k * v


@wp.func
def rotation_error(q_WD: wp.vec4, q_WB: wp.vec4) -> wp.vec3:
    """Angle-axis error `log(R_WD R_WB^T)` in the world frame, rad: the rotation that takes B onto D."""
    return quat_wxyz_log(quat_wxyz_mul(q_WD, quat_wxyz_inverse(q_WB)))


@wp.func
def pose_inv_mul_pos(p_AB: wp.vec3, q_AB: wp.vec4, p_AC: wp.vec3) -> wp.vec3:
    """`p_BC = R_AB^T (p_AC - p_AB)`: a point from frame A into frame B."""
    return quat_wxyz_rotate_inv(q_AB, p_AC - p_AB)
