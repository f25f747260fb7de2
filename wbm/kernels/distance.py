"""Signed distances from robot spheres to obstacles and to each other, with normals.

Geometry types are MuJoCo's numbers and half sizes: plane 0, sphere 2, capsule 3, cylinder 5, box 6. All positions are
relative to a reference point near the robot. A pair that is nearer than the reach becomes a candidate: the unit normal
`n` (from the obstacle to the sphere), its moment `(p - ref) x n`, the gap to the safety distance, and the bound
on its speed. `n^T p_dot = sum_j (w_j . moment + m_j . n) qd_j` then needs no Jacobian of the point itself.
"""

# ruff: noqa: RUF046, UP018 (float(0.0) declares a dynamic variable in a Warp kernel)
import warp as wp

from wbm.kernels import se3
from wbm.kernels.kinematics import Tree
from wbm.kernels.wbc_limits import approach_bound
from wbm.kernels.wbc_objectives import K_BRAKE, K_ESCAPE, K_GAMMA, K_SAFE_OBSTACLE, K_SAFE_SELF

wp.set_module_options({"enable_backward": False})

PLANE = wp.constant(0)
SPHERE = wp.constant(2)
CAPSULE = wp.constant(3)
CYLINDER = wp.constant(5)
BOX = wp.constant(6)
NO_OBSTACLE = wp.constant(-1)
BASE_BITS = wp.constant(7)  # base x, y, yaw lead the controlled joints
FAR = wp.constant(1.0e6)
EPS = wp.constant(1.0e-9)


@wp.func
def _radial(v: wp.vec3, fallback: wp.vec3) -> wp.vec4:
    """Unit vector along `v` and its length; `fallback` where the length is zero."""
    length = wp.length(v)
    n = fallback
    if length > EPS:
        n = v / length
    return wp.vec4(n[0], n[1], n[2], length)


@wp.func
def distance_box(p: wp.vec3, half: wp.vec3) -> wp.vec4:
    """Outward normal and signed distance of a point to a box with half sizes `half`, in the box frame."""
    a = wp.vec3(wp.abs(p[0]) - half[0], wp.abs(p[1]) - half[1], wp.abs(p[2]) - half[2])
    sign = wp.vec3(wp.where(p[0] < 0.0, -1.0, 1.0), wp.where(p[1] < 0.0, -1.0, 1.0), wp.where(p[2] < 0.0, -1.0, 1.0))
    inside = wp.max(a[0], wp.max(a[1], a[2]))
    out = wp.vec4(0.0, 0.0, sign[2], inside)
    if inside <= 0.0:
        if inside == a[0]:
            out = wp.vec4(sign[0], 0.0, 0.0, inside)
        elif inside == a[1]:
            out = wp.vec4(0.0, sign[1], 0.0, inside)
    else:
        m = wp.vec3(wp.max(a[0], 0.0), wp.max(a[1], 0.0), wp.max(a[2], 0.0))
        length = wp.length(m)
        out = wp.vec4(m[0] * sign[0] / length, m[1] * sign[1] / length, m[2] * sign[2] / length, length)
    return out


@wp.func
def distance_cylinder(p: wp.vec3, radius: float, half: float) -> wp.vec4:
    """Outward normal and signed distance of a point to a solid cylinder about z, in its frame."""
    r = wp.sqrt(p[0] * p[0] + p[1] * p[1])
    side = wp.vec3(1.0, 0.0, 0.0)
    if r > EPS:
        side = wp.vec3(p[0] / r, p[1] / r, 0.0)
    cap = wp.vec3(0.0, 0.0, wp.where(p[2] < 0.0, -1.0, 1.0))
    a = r - radius
    b = wp.abs(p[2]) - half
    n = side
    d = a
    if a > 0.0 and b > 0.0:
        d = wp.sqrt(a * a + b * b)
        n = (a * side + b * cap) / d
    elif b > a:
        n = cap
        d = b
    return wp.vec4(n[0], n[1], n[2], d)


@wp.func
def distance_local(kind: int, size: wp.vec3, p: wp.vec3) -> wp.vec4:
    """Outward normal and signed distance of a point to a primitive, in the primitive's frame.

    `size` as MuJoCo means it: sphere (r), capsule and cylinder (r, half length), box (half sizes), plane (ignored).
    """
    out = wp.vec4(0.0, 0.0, 1.0, FAR)
    if kind == BOX:
        out = distance_box(p, size)
    elif kind == PLANE:
        out = wp.vec4(0.0, 0.0, 1.0, p[2])
    elif kind == SPHERE:
        out = _radial(p, wp.vec3(0.0, 0.0, 1.0))
        out[3] = out[3] - size[0]
    elif kind == CAPSULE:
        axis = wp.vec3(0.0, 0.0, wp.clamp(p[2], -size[1], size[1]))
        out = _radial(p - axis, wp.vec3(1.0, 0.0, 0.0))
        out[3] = out[3] - size[0]
    elif kind == CYLINDER:
        out = distance_cylinder(p, size[0], size[1])
    return out


@wp.func
def bounding_radius(kind: int, size: wp.vec3) -> float:
    """Radius of a ball about the primitive's origin that holds it; `FAR` for a plane."""
    r = FAR
    if kind == SPHERE:
        r = size[0]
    elif kind == CAPSULE:
        r = size[0] + size[1]
    elif kind == CYLINDER:
        r = wp.sqrt(size[0] * size[0] + size[1] * size[1])
    elif kind == BOX:
        r = wp.length(size)
    return r


@wp.func
def _finite3(v: wp.vec3) -> bool:
    return wp.isfinite(v[0]) and wp.isfinite(v[1]) and wp.isfinite(v[2])


@wp.kernel(enable_backward=False)
def place_obstacles(
    # in:
    tree: Tree,
    body_pos: wp.array2d(dtype=wp.vec3),  # [N,B]
    kind: wp.array2d(dtype=wp.int32),  # [N,M]
    size: wp.array2d(dtype=wp.vec3),  # [N,M]
    pos: wp.array2d(dtype=wp.vec3),  # [N,M]
    quat: wp.array2d(dtype=wp.vec4),  # [N,M] w x y z
    # out:
    rot_out: wp.array2d(dtype=wp.mat33),  # [N,M] R_WO
    ball_out: wp.array2d(dtype=wp.vec4),  # [N,M] centre relative to the reference point, radius (< 0: unused)
):
    """Rotation and bounding ball of each obstacle; one with a value that is not finite counts as unused."""
    e, k = wp.tid()
    radius = float(-1.0)
    centre = wp.vec3()
    if kind[e, k] != NO_OBSTACLE and _finite3(pos[e, k]) and _finite3(size[e, k]):
        radius = wp.min(bounding_radius(kind[e, k], size[e, k]), FAR)
        centre = pos[e, k] - body_pos[e, tree.ref_body]
        rot_out[e, k] = se3.quat_wxyz_to_mat(se3.quat_wxyz_normalize(quat[e, k]))
    ball_out[e, k] = wp.vec4(centre[0], centre[1], centre[2], radius)


@wp.func
def _slot(
    gap_array: wp.array2d(dtype=wp.float32),
    e: int,
    start: int,
    count: int,
    capacity: int,
    gap: float,
) -> int:
    """Where a candidate goes in a full or growing list: the next free cell, the worst one, or nowhere (-1)."""
    slot = start + count
    if count >= capacity:
        slot = int(-1)
        worst = gap
        for i in range(start, start + capacity):
            if gap_array[e, i] > worst:
                worst = gap_array[e, i]
                slot = i
    return slot


@wp.func
def damper_bound(gains: wp.array2d(dtype=wp.float32), e: int, gap: float, dt: float) -> float:
    """`approach_bound` with the environment's gains."""
    return approach_bound(gap, gains[e, K_GAMMA], gains[e, K_BRAKE], gains[e, K_ESCAPE], dt)


@wp.kernel(enable_backward=False)
def obstacle_candidates(
    # in:
    tree: Tree,
    sphere_pos: wp.array2d(dtype=wp.vec3),  # [N,S]
    group_ball: wp.array2d(dtype=wp.vec4),  # [N,G]
    kind: wp.array2d(dtype=wp.int32),  # [N,M]
    size: wp.array2d(dtype=wp.vec3),  # [N,M]
    rot: wp.array2d(dtype=wp.mat33),  # [N,M]
    ball: wp.array2d(dtype=wp.vec4),  # [N,M]
    margin: wp.array2d(dtype=wp.float32),  # [N,S] added to the safety distance, m, in the caller's order
    gains: wp.array2d(dtype=wp.float32),  # [N,K] column K_SAFE_OBSTACLE
    reach: wp.float32,  # gaps above this are ignored, m
    dt: wp.float32,  # s
    region_start: wp.array(dtype=wp.int32),  # [G+2] where each group's candidates go
    # out:
    count_out: wp.array2d(dtype=wp.int32),  # [N,G+1]
    nearest_out: wp.array2d(dtype=wp.float32),  # [N,G+1] smallest distance, m
    force_out: wp.array2d(dtype=wp.vec3),  # [N,C] normal
    moment_out: wp.array2d(dtype=wp.vec3),  # [N,C] (p - ref) x normal, m
    gap_out: wp.array2d(dtype=wp.float32),  # [N,C] distance less safety distance, m
    bound_out: wp.array2d(dtype=wp.float32),  # [N,C] least speed of the gap, m/s
    side_out: wp.array2d(dtype=wp.vec2i),  # [N,C] group of the sphere; group of the other sphere or -1
):
    """Pairs of a group's spheres and the obstacles within reach, a thread an (environment, group)."""
    e, g = wp.tid()
    safe = gains[e, K_SAFE_OBSTACLE]
    first = tree.group_start[g]
    last = tree.group_start[g + 1]
    start = region_start[g]
    capacity = region_start[g + 1] - start
    rolls = (tree.group_mask[g] & ~BASE_BITS) == 0  # what only the base moves cannot hit the floor that it rolls on
    count = int(0)
    nearest = FAR
    worst_margin = float(-FAR)
    for s in range(first, last):
        worst_margin = wp.max(worst_margin, margin[e, tree.sphere_order[s]])
    centre = wp.vec3(group_ball[e, g][0], group_ball[e, g][1], group_ball[e, g][2])
    span = group_ball[e, g][3] + reach + wp.max(safe + worst_margin, 0.0)
    if worst_margin > -FAR:
        for k in range(kind.shape[1]):
            if ball[e, k][3] >= 0.0:
                origin = wp.vec3(ball[e, k][0], ball[e, k][1], ball[e, k][2])
                offset = centre - origin
                bound = span + ball[e, k][3]
                if wp.dot(offset, offset) < bound * bound:
                    rot_k = rot[e, k]
                    centre_k = wp.transpose(rot_k) * offset
                    if distance_local(kind[e, k], size[e, k], centre_k)[3] < span:
                        for s in range(first, last):
                            p = sphere_pos[e, s]
                            hit = distance_local(kind[e, k], size[e, k], wp.transpose(rot_k) * (p - origin))
                            d = hit[3] - tree.sphere_radius[s]
                            gap = d - safe - margin[e, tree.sphere_order[s]]
                            if rolls and kind[e, k] == PLANE and wp.abs(rot_k[2, 2]) > 0.99:
                                gap = FAR
                            if gap < FAR:
                                nearest = wp.min(nearest, d)
                            if gap < reach:
                                slot = _slot(gap_out, e, start, count, capacity, gap)
                                if slot >= 0:
                                    n = rot_k * wp.vec3(hit[0], hit[1], hit[2])
                                    force_out[e, slot] = n
                                    moment_out[e, slot] = wp.cross(p, n)
                                    gap_out[e, slot] = gap
                                    bound_out[e, slot] = damper_bound(gains, e, gap, dt)
                                    side_out[e, slot] = wp.vec2i(g, -1)
                                    count = wp.min(count + 1, capacity)
    count_out[e, g] = count
    nearest_out[e, g] = nearest


@wp.kernel(enable_backward=False)
def self_candidates(
    # in:
    tree: Tree,
    sphere_pos: wp.array2d(dtype=wp.vec3),  # [N,S]
    group_ball: wp.array2d(dtype=wp.vec4),  # [N,G]
    block: wp.array(dtype=wp.vec4i),  # [Q] group a, group b, first pair, last pair + 1
    pair: wp.array(dtype=wp.vec2i),  # [P] sphere a, sphere b
    gains: wp.array2d(dtype=wp.float32),  # [N,K] column K_SAFE_SELF
    reach: wp.float32,
    dt: wp.float32,
    region_start: wp.array(dtype=wp.int32),  # [G+2]
    # out:
    count_out: wp.array2d(dtype=wp.int32),
    nearest_out: wp.array2d(dtype=wp.float32),
    force_out: wp.array2d(dtype=wp.vec3),
    moment_out: wp.array2d(dtype=wp.vec3),
    gap_out: wp.array2d(dtype=wp.float32),
    bound_out: wp.array2d(dtype=wp.float32),
    side_out: wp.array2d(dtype=wp.vec2i),
):
    """Self-collision pairs within reach, culled by the groups' balls, a thread an environment."""
    e = wp.tid()
    region = region_start.shape[0] - 2
    start = region_start[region]
    capacity = region_start[region + 1] - start
    count = int(0)
    nearest = FAR
    safe = gains[e, K_SAFE_SELF]
    limit = reach + safe
    for i in range(block.shape[0]):
        a = group_ball[e, block[i][0]]
        b = group_ball[e, block[i][1]]
        offset = wp.vec3(a[0] - b[0], a[1] - b[1], a[2] - b[2])
        bound = a[3] + b[3] + limit
        if wp.dot(offset, offset) < bound * bound:
            for j in range(block[i][2], block[i][3]):
                sa = pair[j][0]
                sb = pair[j][1]
                v = sphere_pos[e, sa] - sphere_pos[e, sb]
                touch = tree.sphere_radius[sa] + tree.sphere_radius[sb]
                if wp.dot(v, v) < (touch + limit) * (touch + limit):
                    hit = _radial(v, wp.vec3(0.0, 0.0, 1.0))
                    d = hit[3] - touch
                    nearest = wp.min(nearest, d)
                    slot = _slot(gap_out, e, start, count, capacity, d - safe)
                    if slot >= 0:
                        n = wp.vec3(hit[0], hit[1], hit[2])
                        force_out[e, slot] = n
                        moment_out[e, slot] = wp.cross(sphere_pos[e, sa], n)
                        gap_out[e, slot] = d - safe
                        bound_out[e, slot] = damper_bound(gains, e, d - safe, dt)
                        side_out[e, slot] = wp.vec2i(block[i][0], block[i][1])
                        count = wp.min(count + 1, capacity)
    count_out[e, region] = count
    nearest_out[e, region] = nearest
