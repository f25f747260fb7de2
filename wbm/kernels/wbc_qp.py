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
from wbm.kernels.wbc_dampers import FINE, Dampers, all_speeds, damper_row, exact_length
from wbm.kernels.wbc_dense import ONE, ZERO, cholesky_solve, task_hessian, task_linear, times, vec16

wp.set_module_options({"enable_backward": False})

DESCENT = wp.constant(wp.float64(1.0e-4))
PROJECTED = wp.constant(3)
TOLERANCE = wp.constant(wp.float64(1.0e-7))
"""Largest gradient of a free joint at which the iteration ends; with damping 1e-2 velocities are then exact to 1e-5."""


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
                    row = damper_row(e, n, tree, dampers, c)
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
