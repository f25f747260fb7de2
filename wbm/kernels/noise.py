"""Counter-based randomness and the error models of the devices.

Every draw is a hash of (seed, episode key, step, stream, item), so it does not depend on which environments are
rendered together or in which order. Streams keep the draws of different models apart.
"""

import warp as wp

from wbm.kernels.se3 import quat_wxyz_exp, quat_wxyz_mul, quat_wxyz_normalize, quat_wxyz_rotate, quat_wxyz_to_mat

STREAM_EXTRINSIC = wp.constant(1)
STREAM_RAY = wp.constant(2)
STREAM_BURST = wp.constant(3)
STREAM_SAMPLE = wp.constant(4)
STREAM_DELAY = wp.constant(5)
STREAM_FRAME = wp.constant(6)


@wp.struct
class RayNoise:
    """Error model of a return; a zero switches a term off.

    axial: k in sigma(z) = k z^2, 1/m. sigma: constant range deviation, m. drop: chance of losing any return.
    drop_far: further chance at the greatest range, growing with the square of the range. edge: chance at a depth
    discontinuity of more than `edge_jump` times the nearer depth, on an image of `width` columns (0: no image).
    burst: chance of losing `burst_len` consecutive rays together.
    """

    active: int
    seed: int
    axial: float
    sigma: float
    drop: float
    drop_far: float
    edge: float
    edge_jump: float
    width: int
    burst: float
    burst_len: int


@wp.func
def noise_state(seed: int, key: int, step: int, stream: int, item: int) -> wp.uint32:
    """Generator state of one item, by hashing its coordinates one after the other."""
    return item_state(noise_stream(seed, key, step, stream), item)


@wp.func
def noise_stream(seed: int, key: int, step: int, stream: int) -> wp.uint32:
    """What the states of all items of a stream begin with."""
    s = wp.rand_init(seed, key)
    s = wp.rand_init(int(s), step)
    return wp.rand_init(int(s), stream)


@wp.func
def item_state(stream: wp.uint32, item: int) -> wp.uint32:
    """Generator state of one item of a stream."""
    return wp.rand_init(int(stream), item)


@wp.func
def is_jump(depth: float, other: float, jump: float) -> bool:
    """Whether two neighbouring depths belong to different surfaces; a miss (negative) is infinitely far."""
    if other < 0.0:
        return True
    return wp.abs(depth - other) > jump * wp.min(depth, other)


@wp.func
def is_edge(
    ray: wp.array2d[wp.vec3], hit: wp.array2d[float], row: int, env: int, r: int, depth: float, width: int, jump: float
) -> bool:
    """Whether a pixel has a depth discontinuity towards one of its four neighbours."""
    x = r % width
    if x > 0 and is_jump(depth, hit[env, r - 1] * ray[row, r - 1][2], jump):
        return True
    if x < width - 1 and is_jump(depth, hit[env, r + 1] * ray[row, r + 1][2], jump):
        return True
    if r >= width and is_jump(depth, hit[env, r - width] * ray[row, r - width][2], jump):
        return True
    return r + width < hit.shape[1] and is_jump(depth, hit[env, r + width] * ray[row, r + width][2], jump)


@wp.func
def noisy_range(
    noise: RayNoise,
    ray: wp.array2d[wp.vec3],
    hit: wp.array2d[float],
    row: int,
    env: int,
    r: int,
    ray_stream: wp.uint32,
    burst_stream: wp.uint32,
    level: float,
    max_range: float,
) -> float:
    """Measured range of a hit, -1 where the return is lost; `level` scales deviations and chances."""
    t = hit[env, r]
    z = t * ray[row, r][2]
    state = item_state(ray_stream, r)
    chance = noise.drop + noise.drop_far * (t / max_range) * (t / max_range)
    if wp.randf(state) < chance * level:
        return -1.0
    edge = noise.edge > 0.0 and wp.randf(state) < noise.edge * level
    if edge and is_edge(ray, hit, row, env, r, z, noise.width, noise.edge_jump):
        return -1.0
    if noise.burst > 0.0:
        burst_state = item_state(burst_stream, r // noise.burst_len)
        if wp.randf(burst_state) < noise.burst * level:
            return -1.0
    if noise.axial > 0.0:
        # An error in depth moves the point along its ray: t' / t = z' / z.
        t = t * (1.0 + noise.axial * level * z * wp.randn(state))
    if noise.sigma > 0.0:
        t = t + noise.sigma * level * wp.randn(state)
    return wp.max(t, 0.0)


@wp.kernel(enable_backward=False)
def aim_sensors(
    # in:
    env_ids: wp.array[int],  # [n]
    step: wp.array[int],  # [N]
    key: wp.array[int],  # [N] episode
    level: wp.array[float],  # [N]
    seed: int,
    sigma_pos: float,  # m
    sigma_rot: float,  # rad
    turn: wp.float64,  # revolutions of the sensor's head in a step
    num_patterns: int,
    nominal_pos: wp.array[wp.vec3],  # [N]
    nominal_quat: wp.array[wp.vec4],  # [N] w x y z
    # out:
    pattern_out: wp.array[int],  # [N]
    true_pos_out: wp.array[wp.vec3],
    true_quat_out: wp.array[wp.vec4],  # frame of the rays: mounting error and head included
    head_out: wp.array[wp.mat33],  # head -> sensor frame
    nominal_out: wp.array[wp.mat33],  # sensor frame -> world, as believed
):
    """Where the rays really start: `X_WS' = X_WS exp(xi)`, xi ~ N(0, diag(sigma)^2) once an episode, then the head."""
    env = env_ids[wp.tid()]
    s = wp.max(step[env], 0)
    pattern_out[env] = s % num_patterns
    # float64: the angle after many steps keeps the precision of the first.
    revolutions = wp.float64(s) * turn
    half = wp.float32(revolutions - wp.floor(revolutions)) * wp.pi
    head = wp.vec4(wp.cos(half), 0.0, 0.0, wp.sin(half))
    pos = nominal_pos[env]
    quat = nominal_quat[env]
    if not (wp.isfinite(pos) and wp.isfinite(quat) and wp.length_sq(quat) > 1.0e-12):
        # Passed on as not a number, which place_instances refuses.
        true_pos_out[env] = wp.vec3(wp.nan, wp.nan, wp.nan)
        true_quat_out[env] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        return
    quat = quat_wxyz_normalize(quat)
    head_out[env] = quat_wxyz_to_mat(head)
    nominal_out[env] = quat_wxyz_to_mat(quat)
    if sigma_pos > 0.0 or sigma_rot > 0.0:
        state = noise_state(seed, key[env], 0, STREAM_EXTRINSIC, 0)
        d_pos = sigma_pos * level[env] * wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state))
        d_rot = sigma_rot * level[env] * wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state))
        pos = pos + quat_wxyz_rotate(quat, d_pos)
        quat = quat_wxyz_mul(quat, quat_wxyz_exp(d_rot))
    true_pos_out[env] = pos
    true_quat_out[env] = quat_wxyz_mul(quat, head)
