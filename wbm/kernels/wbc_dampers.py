"""Collision rows of the program: velocity dampers over all candidates, and the search along a step.

A damper's row is only written out where it acts; elsewhere `A x` follows from the twists of the groups of spheres,
which costs six products a candidate in place of sixteen joints.
"""

import warp as wp

from wbm.kernels.kinematics import Tree
from wbm.kernels.wbc_dense import ONE, PIVOT, ZERO, vec16

wp.set_module_options({"enable_backward": False})

HALF = wp.constant(wp.float64(0.5))
SEARCH = wp.constant(12)
FINE = wp.constant(wp.float64(1.0e-12))


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
def damper_row(e: int, n: int, tree: Tree, dampers: Dampers, i: int) -> vec16:
    """Row `A_i` of candidate i."""
    row = vec16()
    for j in range(n):
        row[j] = damper_entry(
            tree, dampers.screw[e, j], dampers.moment[e, i], dampers.force[e, i], dampers.side[e, i], j
        )
    return row


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
