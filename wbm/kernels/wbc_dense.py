"""Dense 16 x 16 algebra in float64, a thread a matrix, and the normal equations of the task rows.

Matrices are kept whole and worked on row by row, which fills vector registers; that is twice as fast as loops over a
triangle. Sizes are those of the controller's joints; a smaller robot leaves rows unused.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

SIZE = 16
mat16 = wp.types.matrix(shape=(SIZE, SIZE), dtype=wp.float64)
vec16 = wp.types.vector(length=SIZE, dtype=wp.float64)

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
LEAST_DAMPING = wp.constant(wp.float64(1.0e-6))
PIVOT = wp.constant(wp.float64(1.0e-9))


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
