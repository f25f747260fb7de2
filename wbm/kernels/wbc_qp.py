"""Solves each environment's quadratic program by projected Newton steps, a thread an environment.

The slack is eliminated: `s_k = max(0, b_k - A_k x)`. What is left is a convex, piecewise quadratic function over a box,
which always has exactly one minimum, so the program cannot be infeasible. An iteration fixes the variables that press
against their bound, takes the Newton step of the others (Cholesky of at most 16 x 16 in float64: the slack's weight
makes the matrix stiff), projects it onto the box and halves it until the function falls (Bertsekas, 1982).
"""

# ruff: noqa: UP018 (float(0.0) declares a dynamic variable in a Warp kernel)
import warp as wp

wp.set_module_options({"enable_backward": False})

SIZE = 16
mat16 = wp.types.matrix(shape=(SIZE, SIZE), dtype=wp.float64)
vec16 = wp.types.vector(length=SIZE, dtype=wp.float64)

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
HALF = wp.constant(wp.float64(0.5))
PIVOT = wp.constant(wp.float64(1.0e-9))
DESCENT = wp.constant(wp.float64(1.0e-4))
TOLERANCE = wp.constant(wp.float64(1.0e-7))
"""Largest gradient of a free joint at which the iteration ends; with damping 1e-2 velocities are then exact to 1e-5."""


@wp.func
def task_hessian(
    e: int,
    n: int,
    jac: wp.array3d(dtype=wp.float32),
    weight: wp.array2d(dtype=wp.float32),
    diag: wp.array2d(dtype=wp.float32),
) -> mat16:
    """Upper triangle of `sum_r w_r J_r^T J_r + diag(h)`."""
    hessian = mat16()
    for r in range(jac.shape[1]):
        w = wp.float64(weight[e, r])
        if w > ZERO:
            for i in range(n):
                s = w * wp.float64(jac[e, r, i])
                if s != ZERO:
                    for j in range(i, n):
                        hessian[i, j] += s * wp.float64(jac[e, r, j])
    for i in range(n):
        hessian[i, i] += wp.max(wp.float64(diag[e, i]), wp.float64(1.0e-6))
    return hessian


@wp.func
def gradient_of(hessian: mat16, linear: vec16, x: vec16, n: int) -> vec16:
    """`H x - g` from the upper triangle of H."""
    out = -linear
    for i in range(n):
        out[i] += hessian[i, i] * x[i]
        for j in range(i + 1, n):
            out[i] += hessian[i, j] * x[j]
            out[j] += hessian[i, j] * x[i]
    return out


@wp.func
def cholesky_solve(matrix: mat16, rhs: vec16, n: int) -> vec16:
    """Solution of a symmetric positive definite system given by its upper triangle, `M = U^T D U`."""
    m = matrix
    y = rhs
    for k in range(n):
        pivot = wp.max(m[k, k], PIVOT)
        inverse = ONE / pivot
        y_k = y[k]
        for i in range(k + 1, n):
            factor = m[k, i] * inverse
            if factor != ZERO:
                y[i] -= factor * y_k
                for j in range(i, n):
                    m[i, j] -= factor * m[k, j]
        y[k] = y_k * inverse
        m[k, k] = inverse
    for back in range(n):
        k = n - 1 - back
        s = ZERO
        for j in range(k + 1, n):
            s += m[k, j] * y[j]
        y[k] -= s * m[k, k]
    return y


@wp.func
def damper_cost(
    e: int,
    n: int,
    rows: wp.array(dtype=wp.int32),
    row: wp.array3d(dtype=wp.float32),
    bound: wp.array2d(dtype=wp.float32),
    x: vec16,
) -> wp.float64:
    """`sum_k max(0, b_k - A_k x)^2`."""
    cost = ZERO
    for k in range(rows[e]):
        lack = wp.float64(bound[e, k])
        for i in range(n):
            lack -= wp.float64(row[e, k, i]) * x[i]
        if lack > ZERO:
            cost += lack * lack
    return cost


@wp.kernel(enable_backward=False)
def solve_qp(
    # in:
    jac: wp.array3d(dtype=wp.float32),  # [N,9,J]
    vel: wp.array2d(dtype=wp.float32),  # [N,9]
    weight: wp.array2d(dtype=wp.float32),  # [N,9]
    diag: wp.array2d(dtype=wp.float32),  # [N,J]
    rhs: wp.array2d(dtype=wp.float32),  # [N,J]
    low: wp.array2d(dtype=wp.float64),  # [N,J]
    high: wp.array2d(dtype=wp.float64),  # [N,J]
    rows: wp.array(dtype=wp.int32),  # [N]
    row: wp.array3d(dtype=wp.float32),  # [N,K,J]
    bound: wp.array2d(dtype=wp.float32),  # [N,K]
    slack_weight: wp.float64,  # rho
    iterations: wp.int32,
    qd_start: wp.array2d(dtype=wp.float32),  # [N,J]
    # out:
    x_out: wp.array2d(dtype=wp.float64),  # [N,J]
    iterations_out: wp.array(dtype=wp.int32),  # [N]
):
    """Joint velocities that minimise the program, within the box exactly."""
    e = wp.tid()
    n = low.shape[1]
    hessian = task_hessian(e, n, jac, weight, diag)
    linear = vec16()
    x = vec16()
    for i in range(n):
        s = wp.float64(rhs[e, i])
        for r in range(jac.shape[1]):
            s += wp.float64(weight[e, r]) * wp.float64(vel[e, r]) * wp.float64(jac[e, r, i])
        linear[i] = s
        x[i] = wp.clamp(wp.float64(qd_start[e, i]), low[e, i], high[e, i])
    smooth = gradient_of(hessian, linear, x, n)
    cost = HALF * (wp.dot(x, smooth) - wp.dot(x, linear)) + HALF * slack_weight * damper_cost(e, n, rows, row, bound, x)
    done = int(0)
    used = int(0)
    while done == 0 and used < iterations:
        used += 1
        gradient = smooth
        matrix = hessian
        for k in range(rows[e]):
            lack = wp.float64(bound[e, k])
            for i in range(n):
                lack -= wp.float64(row[e, k, i]) * x[i]
            if lack > ZERO:
                for i in range(n):
                    a = slack_weight * wp.float64(row[e, k, i])
                    if a != ZERO:
                        gradient[i] -= lack * a
                        for j in range(i, n):
                            matrix[i, j] += a * wp.float64(row[e, k, j])
        step = vec16()
        largest = ZERO
        for i in range(n):
            held = (x[i] <= low[e, i] and gradient[i] >= ZERO) or (x[i] >= high[e, i] and gradient[i] <= ZERO)
            if held:
                for j in range(i):
                    matrix[j, i] = ZERO
                for j in range(i + 1, n):
                    matrix[i, j] = ZERO
                matrix[i, i] = ONE
            else:
                step[i] = -gradient[i]
                largest = wp.max(largest, wp.abs(gradient[i]))
        if largest < TOLERANCE:
            done = 1
        else:
            step = cholesky_solve(matrix, step, n)
            length = ONE
            accepted = int(0)
            for _attempt in range(6):
                if accepted == 0:
                    trial = vec16()
                    slope = ZERO
                    for i in range(n):
                        trial[i] = wp.clamp(x[i] + length * step[i], low[e, i], high[e, i])
                        slope += gradient[i] * (trial[i] - x[i])
                    trial_smooth = gradient_of(hessian, linear, trial, n)
                    trial_cost = HALF * (wp.dot(trial, trial_smooth) - wp.dot(trial, linear))
                    trial_cost += HALF * slack_weight * damper_cost(e, n, rows, row, bound, trial)
                    if trial_cost <= cost + DESCENT * slope:
                        accepted = 1
                        cost = trial_cost
                        x = trial
                        smooth = trial_smooth
                    length *= HALF
            if accepted == 0:
                done = 1
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
