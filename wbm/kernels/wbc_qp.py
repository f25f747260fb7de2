"""Solves each environment's quadratic program by projected Newton steps, a thread an environment.

The slack is eliminated: `s_k = max(0, b_k - A_k x)`. What is left is a convex, piecewise quadratic function over a box,
which always has exactly one minimum, so the program cannot be infeasible. An iteration fixes the variables that press
against their bound, takes the Newton step of the others (Cholesky of at most 16 x 16 in float64: the slack's weight
makes the matrix stiff), projects it onto the box (Bertsekas, 1982) and goes where the function is least on the way.
Mostly two such steps do. Where projection bends the step across an active damper they zigzag, so that later steps are
those of a primal active-set method: straight to the first bound, which is then held until the rest is at its minimum.
"""

# ruff: noqa: RUF046, UP018 (float(0.0) declares a dynamic variable in a Warp kernel)
import warp as wp

from wbm.kernels.kinematics import Tree

wp.set_module_options({"enable_backward": False})

SIZE = 16
mat16 = wp.types.matrix(shape=(SIZE, SIZE), dtype=wp.float64)
vec16 = wp.types.vector(length=SIZE, dtype=wp.float64)

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
HALF = wp.constant(wp.float64(0.5))
LEAST_DAMPING = wp.constant(wp.float64(1.0e-6))
PIVOT = wp.constant(wp.float64(1.0e-9))
DESCENT = wp.constant(wp.float64(1.0e-4))
PROJECTED = wp.constant(3)
SEARCH = wp.constant(12)
FINE = wp.constant(wp.float64(1.0e-12))
TOLERANCE = wp.constant(wp.float64(1.0e-7))
"""Largest gradient of a free joint at which the iteration ends; with damping 1e-2 velocities are then exact to 1e-5."""


@wp.func
def task_row(e: int, r: int, n: int, jac: wp.array3d(dtype=wp.float32)) -> vec16:
    """Row r of an environment's Jacobian."""
    row = vec16()
    for i in range(n):
        row[i] = wp.float64(jac[e, r, i])
    return row


@wp.func
def task_hessian(
    e: int,
    n: int,
    jac: wp.array3d(dtype=wp.float32),
    weight: wp.array2d(dtype=wp.float32),
    diag: wp.array2d(dtype=wp.float32),
) -> mat16:
    """`sum_r w_r J_r^T J_r + diag(h)`, built and kept row by row, which fills vector registers."""
    hessian = mat16()
    for r in range(jac.shape[1]):
        w = wp.float64(weight[e, r])
        if w > ZERO:
            row = task_row(e, r, n, jac)
            for i in range(n):
                s = w * row[i]
                if s != ZERO:
                    hessian[i] = hessian[i] + s * row
    for i in range(n):
        hessian[i, i] += wp.max(wp.float64(diag[e, i]), LEAST_DAMPING)
    return hessian


@wp.func
def task_linear(
    e: int,
    n: int,
    jac: wp.array3d(dtype=wp.float32),
    vel: wp.array2d(dtype=wp.float32),
    weight: wp.array2d(dtype=wp.float32),
    rhs: wp.array2d(dtype=wp.float32),
) -> vec16:
    """`sum_r w_r J_r^T v_r + g`."""
    linear = vec16()
    for i in range(n):
        linear[i] = wp.float64(rhs[e, i])
    for r in range(jac.shape[1]):
        s = wp.float64(weight[e, r]) * wp.float64(vel[e, r])
        if s != ZERO:
            linear += s * task_row(e, r, n, jac)
    return linear


@wp.func
def times(matrix: mat16, x: vec16, n: int) -> vec16:
    """`M x` of a symmetric matrix."""
    out = vec16()
    for i in range(n):
        out += x[i] * matrix[i]
    return out


@wp.func
def cholesky_solve(matrix: mat16, rhs: vec16, n: int) -> vec16:
    """Solution of a symmetric positive definite system by `M = U^T D U`."""
    m = matrix
    y = rhs
    for k in range(n):
        inverse = ONE / wp.max(m[k, k], PIVOT)
        pivot_row = m[k]
        y_k = y[k]
        for i in range(k + 1, n):
            factor = pivot_row[i] * inverse
            if factor != ZERO:
                y[i] -= factor * y_k
                m[i] = m[i] - factor * pivot_row
        y[k] = y_k * inverse
        m[k, k] = inverse
    for back in range(n):
        k = n - 1 - back
        s = ZERO
        for j in range(k + 1, n):
            s += m[k, j] * y[j]
        y[k] -= s * m[k, k]
    return y


@wp.struct
class Dampers:
    """Collision rows `n^T J x + s >= b`, kept as candidates: the row itself is written out only where it acts."""

    region_start: wp.array(dtype=wp.int32)  # [G+2]
    count: wp.array2d(dtype=wp.int32)  # [N,G+1]
    force: wp.array2d(dtype=wp.vec3)  # [N,C]
    moment: wp.array2d(dtype=wp.vec3)  # [N,C]
    bound: wp.array2d(dtype=wp.float32)  # [N,C]
    side: wp.array2d(dtype=wp.vec2i)  # [N,C]
    screw: wp.array2d(dtype=wp.spatial_vector)  # [N,J]


@wp.func
def damper_entry(
    tree: Tree, screw: wp.spatial_vector, moment: wp.vec3, force: wp.vec3, side: wp.vec2i, j: int
) -> wp.float64:
    """`dd/dq_j`: the speed of a pair's distance for unit velocity of joint j."""
    sign = (tree.group_mask[side[0]] >> j) & 1
    if side[1] >= 0:
        sign -= (tree.group_mask[side[1]] >> j) & 1
    entry = ZERO
    if sign != 0:
        entry = wp.float64(
            float(sign) * (wp.dot(wp.spatial_top(screw), moment) + wp.dot(wp.spatial_bottom(screw), force))
        )
    return entry


@wp.func
def group_twists(
    e: int,
    tree: Tree,
    screw: wp.array2d(dtype=wp.spatial_vector),
    x: vec16,
    twist_out: wp.array2d(dtype=wp.spatial_vectord),
):
    """Twist of every group of spheres at the joint velocities x, along the tree."""
    for g in range(tree.group_parent.shape[0]):
        twist = wp.spatial_vectord()
        if tree.group_parent[g] >= 0:
            twist = twist_out[e, tree.group_parent[g]]
        for i in range(tree.group_own[g], tree.group_own[g + 1]):
            j = tree.group_joint[i]
            twist += x[j] * wp.spatial_vectord(screw[e, j])
        twist_out[e, g] = twist


@wp.func
def damper_speed(e: int, i: int, dampers: Dampers, twist: wp.array2d(dtype=wp.spatial_vectord)) -> wp.float64:
    """`A_i x` of candidate i, with x in the form of the groups' twists."""
    side = dampers.side[e, i]
    v = twist[e, side[0]]
    if side[1] >= 0:
        v -= twist[e, side[1]]
    m = dampers.moment[e, i]
    f = dampers.force[e, i]
    speed = v[0] * wp.float64(m[0]) + v[1] * wp.float64(m[1]) + v[2] * wp.float64(m[2])
    return speed + v[3] * wp.float64(f[0]) + v[4] * wp.float64(f[1]) + v[5] * wp.float64(f[2])


@wp.func
def all_speeds(
    e: int,
    tree: Tree,
    dampers: Dampers,
    x: vec16,
    twist_out: wp.array2d(dtype=wp.spatial_vectord),
    speed_out: wp.array2d(dtype=wp.float64),
):
    """`A x` for every candidate."""
    group_twists(e, tree, dampers.screw, x, twist_out)
    for g in range(dampers.count.shape[1]):
        start = dampers.region_start[g]
        for i in range(start, start + dampers.count[e, g]):
            speed_out[e, i] = damper_speed(e, i, dampers, twist_out)


@wp.func
def exact_length(
    e: int,
    dampers: Dampers,
    lack: wp.array2d(dtype=wp.float64),
    rate: wp.array2d(dtype=wp.float64),
    slope: wp.float64,
    curvature: wp.float64,
    slack_weight: wp.float64,
) -> wp.float64:
    """Where in [0, 1] the function is least along a step downhill: Newton's method on its slope, bracketed.

    `slope` and `curvature` are those of the smooth part, `lack - t rate` is what dampers lack at t. The slope is
    piecewise linear and rising, so a few steps do. Landing on the far side of a damper's kink is what makes the
    damper act in the next iteration.
    """
    least = ZERO
    most = ONE
    length = ONE
    for _search in range(SEARCH):
        rise = slope + length * curvature
        bend = curvature
        for g in range(dampers.count.shape[1]):
            start = dampers.region_start[g]
            for i in range(start, start + dampers.count[e, g]):
                left = lack[e, i] - length * rate[e, i]
                if left > ZERO:
                    rise -= slack_weight * left * rate[e, i]
                    bend += slack_weight * rate[e, i] * rate[e, i]
        if rise > ZERO:
            most = length
        else:
            least = length
            if length == ONE:
                return length
        guess = length - rise / wp.max(bend, PIVOT)
        if wp.abs(guess - length) < FINE:
            return wp.clamp(guess, least, most)
        if guess <= least or guess >= most:
            guess = HALF * (least + most)
        length = guess
    return most


@wp.func
def straight_move(
    e: int,
    n: int,
    x: vec16,
    step: vec16,
    low: wp.array2d(dtype=wp.float64),
    high: wp.array2d(dtype=wp.float64),
) -> vec16:
    """The step without what leaves the box at once, shortened (never lengthened) to the first bound it meets."""
    length = ONE
    move = step
    for i in range(n):
        room = high[e, i] - x[i]
        if step[i] < ZERO:
            room = x[i] - low[e, i]
        if room <= ZERO:
            move[i] = ZERO
        elif wp.abs(step[i]) > room:
            length = wp.min(length, room / wp.abs(step[i]))
    return length * move


@wp.func
def snap(x: wp.float64, low: wp.float64, high: wp.float64) -> wp.float64:
    """`x` within the box, and on a bound that it misses by rounding."""
    out = wp.clamp(x, low, high)
    if out - low < FINE:
        out = low
    elif high - out < FINE:
        out = high
    return out


@wp.kernel(enable_backward=False)
def solve_qp(
    # in:
    tree: Tree,
    jac: wp.array3d(dtype=wp.float32),  # [N,9,J]
    vel: wp.array2d(dtype=wp.float32),  # [N,9]
    weight: wp.array2d(dtype=wp.float32),  # [N,9]
    diag: wp.array2d(dtype=wp.float32),  # [N,J]
    rhs: wp.array2d(dtype=wp.float32),  # [N,J]
    low: wp.array2d(dtype=wp.float64),  # [N,J]
    high: wp.array2d(dtype=wp.float64),  # [N,J]
    dampers: Dampers,
    nearest: wp.array2d(dtype=wp.float32),  # [N,G+1]
    slack_weight: wp.float64,  # rho
    iterations: wp.int32,
    qd_start: wp.array2d(dtype=wp.float32),  # [N,J]
    # out:
    twist_out: wp.array2d(dtype=wp.spatial_vectord),  # [N,G] scratch
    lack_out: wp.array2d(dtype=wp.float64),  # [N,C] scratch: b - A x
    rate_out: wp.array2d(dtype=wp.float64),  # [N,C] scratch: A times the step
    x_out: wp.array2d(dtype=wp.float64),  # [N,J]
    iterations_out: wp.array(dtype=wp.int32),  # [N]
    min_distance_out: wp.array(dtype=wp.float32),  # [N]
):
    """Joint velocities that minimise the program, within the box exactly."""
    e = wp.tid()
    n = low.shape[1]
    hessian = task_hessian(e, n, jac, weight, diag)
    linear = task_linear(e, n, jac, vel, weight, rhs)
    x = vec16()
    for i in range(n):
        x[i] = wp.clamp(wp.float64(qd_start[e, i]), low[e, i], high[e, i])
    smooth = times(hessian, x, n) - linear
    all_speeds(e, tree, dampers, x, twist_out, lack_out)
    for g in range(dampers.count.shape[1]):
        start = dampers.region_start[g]
        for c in range(start, start + dampers.count[e, g]):
            lack_out[e, c] = wp.float64(dampers.bound[e, c]) - lack_out[e, c]
    done = int(0)
    used = int(0)
    held = int(0)  # bits of the variables that this iteration keeps on their bounds
    while done == 0 and used < iterations:
        used += 1
        gradient = smooth
        matrix = hessian
        for g in range(dampers.count.shape[1]):
            start = dampers.region_start[g]
            for c in range(start, start + dampers.count[e, g]):
                lack = lack_out[e, c]
                if lack > ZERO:
                    row = vec16()
                    for i in range(n):
                        row[i] = damper_entry(
                            tree, dampers.screw[e, i], dampers.moment[e, c], dampers.force[e, c], dampers.side[e, c], i
                        )
                    for i in range(n):
                        a = slack_weight * row[i]
                        if a != ZERO:
                            matrix[i] = matrix[i] + a * row
                    gradient -= (slack_weight * lack) * row
        # A variable on its bound is well placed if the gradient presses it there; one that is not may move.
        placed = int(0)
        wrong = int(-1)
        most_wrong = ZERO
        residual = ZERO
        subspace = ZERO
        for i in range(n):
            size = wp.abs(gradient[i])
            if (x[i] <= low[e, i] and gradient[i] >= ZERO) or (x[i] >= high[e, i] and gradient[i] <= ZERO):
                placed |= 1 << i
            else:
                residual = wp.max(residual, size)
                if (held >> i) & 1 == 0:
                    subspace = wp.max(subspace, size)
                elif size > most_wrong:
                    most_wrong = size
                    wrong = i
        if residual < TOLERANCE:
            done = 1
        else:
            if used <= PROJECTED:
                held = placed
            elif subspace < TOLERANCE and wrong >= 0:
                held &= ~(1 << wrong)
            step = vec16()
            for i in range(n):
                step[i] = -gradient[i]
                if (held >> i) & 1 == 1:
                    step[i] = ZERO
                    matrix[i] = vec16()
                    for j in range(n):
                        matrix[j, i] = ZERO
                    matrix[i, i] = ONE
            step = cholesky_solve(matrix, step, n)
            slope = ZERO
            newton_slope = ZERO
            move = vec16()
            for i in range(n):
                move[i] = wp.clamp(x[i] + step[i], low[e, i], high[e, i]) - x[i]
                slope += gradient[i] * move[i]
                newton_slope += gradient[i] * step[i]
            if used > PROJECTED or slope > DESCENT * newton_slope:
                move = straight_move(e, n, x, step, low, high)
            all_speeds(e, tree, dampers, move, twist_out, rate_out)
            turned = times(hessian, move, n)
            length = exact_length(
                e, dampers, lack_out, rate_out, wp.dot(smooth, move), wp.dot(turned, move), slack_weight
            )
            smooth += length * turned
            for i in range(n):
                x[i] = snap(x[i] + length * move[i], low[e, i], high[e, i])
                if step[i] != ZERO and (x[i] <= low[e, i] or x[i] >= high[e, i]):
                    held |= 1 << i
            for g in range(dampers.count.shape[1]):
                start = dampers.region_start[g]
                for c in range(start, start + dampers.count[e, g]):
                    lack_out[e, c] = lack_out[e, c] - length * rate_out[e, c]
    closest = nearest[e, 0]
    for g in range(1, nearest.shape[1]):
        closest = wp.min(closest, nearest[e, g])
    min_distance_out[e] = closest
    for i in range(n):
        x_out[e, i] = x[i]
    iterations_out[e] = used


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
