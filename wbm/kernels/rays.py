"""Ray casting over per-environment instances: placement, bundle culling and exact intersection.

All rays of a sensor start at one point, so everything that depends on the origin alone is computed once an instance
(`place_instances`). Rays come in bundles of neighbours; an instance enters a bundle's list only if its bounding sphere
touches the bundle's cone (`cull_bundles`), nearest first, so that a ray stops at the first sphere that starts behind
its hit (`trace_rays`). Geometry types and sizes use MuJoCo's numbers. Distances are along unit rays, in metres.
"""

# ruff: noqa: RUF046, SIM109, UP018 (int(0) declares a dynamic variable in a Warp kernel; `in` is not compiled)
import warp as wp

from wbm.kernels.rays_shapes import BOX, CYLINDER, MESH, PLANE, UNBOUNDED, bounding_radius, is_inside, ray_instance
from wbm.kernels.se3 import quat_wxyz_normalize, quat_wxyz_to_mat


@wp.kernel(enable_backward=False)
def place_instances(
    # in:
    env_ids: wp.array[int],  # [n]
    sensor_pos: wp.array[wp.vec3],  # [N]
    sensor_quat: wp.array[wp.vec4],  # [N] w x y z
    exclude_body: int,
    view_axis: wp.vec3,  # sensor frame
    view_cos: float,
    view_sin: float,
    max_range: float,
    body_pos: wp.array2d[wp.vec3],  # [N,B]
    body_quat: wp.array2d[wp.vec4],  # [N,B] w x y z
    inst_type: wp.array2d[int],  # [N,I]
    inst_size: wp.array2d[wp.vec3],
    inst_mesh: wp.array2d[int],
    inst_body: wp.array2d[int],
    inst_pos: wp.array2d[wp.vec3],
    inst_quat: wp.array2d[wp.vec4],
    mesh_ids: wp.array[wp.uint64],  # [K]
    mesh_sphere: wp.array[wp.vec4],  # [K] centre, radius
    # out:
    ok_out: wp.array[int],  # [N]
    count_out: wp.array[int],  # [N]
    inst_out: wp.array2d[int],  # [N,I] slot -> instance
    kind_out: wp.array2d[int],
    size_out: wp.array2d[wp.vec3],
    mesh_out: wp.array2d[wp.uint64],
    rot_out: wp.array2d[wp.mat33],  # sensor frame -> instance frame
    origin_out: wp.array2d[wp.vec3],  # sensor origin in the instance frame
    sphere_out: wp.array2d[wp.vec4],  # centre c of the bounding sphere in the sensor frame, |c|^2 - r^2
    cone_out: wp.array2d[wp.vec4],  # direction of its centre, cosine of its angular radius
    near_out: wp.array2d[float],  # its nearest range, 0 if it holds the sensor
):
    """List the instances that the sensor may see, in its own frame; `ok` is 0 where no ray can be trusted."""
    env = env_ids[wp.tid()]
    pos = sensor_pos[env]
    quat = sensor_quat[env]
    ok = wp.isfinite(pos) and wp.isfinite(quat) and wp.length_sq(quat) > 1.0e-12
    R_WS = quat_wxyz_to_mat(quat_wxyz_normalize(quat))
    count = int(0)
    for i in range(inst_type.shape[1]):
        kind = inst_type[env, i]
        body = inst_body[env, i]
        if ok and kind >= 0 and (body != exclude_body or body < 0):
            finite = wp.isfinite(inst_quat[env, i])
            R_WI = quat_wxyz_to_mat(quat_wxyz_normalize(inst_quat[env, i]))
            p_WI = inst_pos[env, i]
            if body >= 0:
                R_WB = quat_wxyz_to_mat(quat_wxyz_normalize(body_quat[env, body]))
                p_WI = body_pos[env, body] + R_WB * p_WI
                R_WI = R_WB * R_WI
                finite = finite and wp.isfinite(body_quat[env, body])
            offset = p_WI - pos
            size = inst_size[env, i]
            mesh = wp.uint64(0)
            centre = wp.vec3(0.0, 0.0, 0.0)
            radius = bounding_radius(kind, size)
            if kind == MESH:
                index = inst_mesh[env, i]
                mesh = mesh_ids[index]
                centre = wp.vec3(mesh_sphere[index][0], mesh_sphere[index][1], mesh_sphere[index][2])
                radius = mesh_sphere[index][3]
            origin = -wp.transpose(R_WI) * offset
            if not (finite and wp.isfinite(origin)):
                ok = False
            else:
                c = wp.transpose(R_WS) * (offset + R_WI * centre)
                distance = wp.length(c)
                if distance < radius and is_inside(kind, origin, size, mesh, radius):
                    ok = False
                along = wp.dot(c, view_axis)
                aside = wp.sqrt(wp.max(distance * distance - along * along, 0.0))
                if distance - radius < max_range and aside * view_cos - along * view_sin <= radius * 1.001:
                    inst_out[env, count] = i
                    kind_out[env, count] = kind
                    size_out[env, count] = size
                    mesh_out[env, count] = mesh
                    rot_out[env, count] = wp.transpose(R_WI) * R_WS
                    origin_out[env, count] = origin
                    # Widened, so that rounding never loses a hit.
                    bound = wp.min(radius * 1.0001 + 1.0e-6 * distance, UNBOUNDED)
                    sphere_out[env, count] = wp.vec4(c[0], c[1], c[2], distance * distance * 0.999999 - bound * bound)
                    near_out[env, count] = wp.max(distance - bound, 0.0)
                    u = c / wp.max(distance, 1.0e-9)
                    sine = wp.min(bound / wp.max(distance, 1.0e-9), 1.0)
                    cone_out[env, count] = wp.vec4(u[0], u[1], u[2], wp.sqrt(1.0 - sine * sine))
                    count += 1
    if ok:
        ok_out[env] = 1
        count_out[env] = count
    else:
        ok_out[env] = 0
        count_out[env] = 0


@wp.func
def is_leaving(kind: int, o: wp.vec3, size: wp.vec3, axis: wp.vec3, cos_half: float, sin_half: float) -> bool:
    """Whether a flat face's outer half space holds the origin and every ray of a cone leads further out.

    For a box, a plane and the ends of a cylinder, in the instance's frame.

    The least component of a cone's directions along a face normal n is `cos(angle(axis, n) + half)`.
    """
    for i in range(3):
        extent = size[i]
        if kind == PLANE:
            extent = 0.0
        if kind == CYLINDER:
            extent = size[1]
        side = wp.sign(o[i])
        if (kind == BOX or i == 2) and wp.abs(o[i]) > extent:
            a = side * axis[i]
            if a * cos_half - wp.sqrt(wp.max(1.0 - a * a, 0.0)) * sin_half > 1.0e-4:
                return True
    return False


@wp.func
def cones_meet(cone: wp.vec4, cos_other: float, axis_other: wp.vec3) -> bool:
    """Whether two cones with one apex overlap: the angle between their axes is at most the sum of their half angles."""
    sines = wp.sqrt(wp.max(1.0 - cone[3] * cone[3], 0.0) * wp.max(1.0 - cos_other * cos_other, 0.0))
    between = cone[0] * axis_other[0] + cone[1] * axis_other[1] + cone[2] * axis_other[2]
    return cos_other < 0.0 or between >= cone[3] * cos_other - sines - 1.0e-5


@wp.kernel(enable_backward=False)
def cull_bundles(
    # in:
    env_ids: wp.array[int],  # [n]
    pattern: wp.array[int],  # [N] row of the ray table
    cone: wp.array2d[wp.vec4],  # [Q,G] axis, cosine of the half angle
    group_cone: wp.array2d[wp.vec4],  # [Q,G'] the same around `group` bundles
    group: int,
    count: wp.array[int],  # [N]
    slot_cone: wp.array2d[wp.vec4],  # [N,I]
    near: wp.array2d[float],  # [N,I]
    kind: wp.array2d[int],
    size: wp.array2d[wp.vec3],
    rot: wp.array2d[wp.mat33],
    origin: wp.array2d[wp.vec3],
    # scratch:
    group_scratch: wp.array3d[wp.int16],  # [N,G',I]
    # out:
    cand_count_out: wp.array2d[int],  # [N,G]
    cand_out: wp.array3d[wp.int16],  # [N,G,I] slots, nearest first
):
    """Slots whose bounding sphere meets each bundle's cone and that lie ahead, sorted by their nearest range."""
    i, h = wp.tid()
    env = env_ids[i]
    row = pattern[env]
    whole = group_cone[row, h]
    axis = wp.vec3(whole[0], whole[1], whole[2])
    found = int(0)
    for s in range(count[env]):
        if near[env, s] <= 0.0 or cones_meet(slot_cone[env, s], whole[3], axis):
            group_scratch[env, h, found] = wp.int16(s)
            found += 1
    for g in range(h * group, wp.min((h + 1) * group, cone.shape[1])):
        c4 = cone[row, g]
        axis = wp.vec3(c4[0], c4[1], c4[2])
        sin_half = wp.sqrt(wp.max(1.0 - c4[3] * c4[3], 0.0))
        num = int(0)
        for m in range(found):
            s = int(group_scratch[env, h, m])
            key = near[env, s]
            if key <= 0.0 or cones_meet(slot_cone[env, s], c4[3], axis):
                leaving = bool(False)
                shape = kind[env, s]
                if c4[3] > 0.0 and (shape == BOX or shape == PLANE or shape == CYLINDER):
                    ahead = rot[env, s] * axis
                    leaving = is_leaving(shape, origin[env, s], size[env, s], ahead, c4[3], sin_half)
                if not leaving:
                    j = int(num)
                    while j > 0 and near[env, int(cand_out[env, g, j - 1])] > key:
                        cand_out[env, g, j] = cand_out[env, g, j - 1]
                        j -= 1
                    cand_out[env, g, j] = wp.int16(s)
                    num += 1
        cand_count_out[env, g] = num


@wp.kernel(enable_backward=False)
def trace_rays(
    # in:
    env_ids: wp.array[int],  # [n]
    pattern: wp.array[int],  # [N]
    direction: wp.array2d[wp.vec3],  # [Q,R] unit, bundle order, sensor frame
    order: wp.array2d[int],  # [Q,R] bundle order -> ray
    bundle: int,
    chunk: int,  # rays of a thread
    max_range: float,
    slot_inst: wp.array2d[int],  # [N,I]
    kind: wp.array2d[int],
    size: wp.array2d[wp.vec3],
    mesh: wp.array2d[wp.uint64],
    rot: wp.array2d[wp.mat33],
    origin: wp.array2d[wp.vec3],
    sphere: wp.array2d[wp.vec4],
    near: wp.array2d[float],
    cand_count: wp.array2d[int],  # [N,G]
    cand: wp.array3d[wp.int16],  # [N,G,I]
    # scratch:
    best_scratch: wp.array2d[float],  # [N,R] bundle order
    inst_scratch: wp.array2d[int],  # [N,R]
    # out:
    range_out: wp.array2d[float],  # [N,R] -1 where nothing is hit
    instance_out: wp.array2d[int],  # [N,R] -1 where nothing is hit
):
    """Nearest hit of every ray along its bundle's list."""
    i, c = wp.tid()
    env = env_ids[i]
    row = pattern[env]
    first = c * chunk
    end = wp.min(first + chunk, direction.shape[1])
    g = first // bundle
    for k in range(first, end):
        best_scratch[env, k] = max_range
        inst_scratch[env, k] = -1
    # A sphere is loaded once for all rays of the thread, which stops when all its hits lie before the next sphere. The
    # rest of an instance's data is left in memory until a ray meets its sphere.
    farthest = float(max_range)
    for j in range(cand_count[env, g]):
        s = int(cand[env, g, j])
        start = near[env, s]
        if start > farthest:
            break
        s4 = sphere[env, s]
        centre = wp.vec3(s4[0], s4[1], s4[2])
        farthest = float(0.0)
        for k in range(first, end):
            best = best_scratch[env, k]
            if start <= best:
                d = direction[row, k]
                along = wp.dot(centre, d)
                if s4[3] <= 0.0 or (along > 0.0 and along * along >= s4[3]):
                    t = ray_instance(kind[env, s], origin[env, s], rot[env, s] * d, size[env, s], mesh[env, s], best)
                    if t < best:
                        best = t
                        best_scratch[env, k] = t
                        inst_scratch[env, k] = slot_inst[env, s]
            farthest = wp.max(farthest, best)
    for k in range(first, end):
        out = order[row, k]
        inst = inst_scratch[env, k]
        instance_out[env, out] = inst
        if inst >= 0:
            range_out[env, out] = best_scratch[env, k]
        else:
            range_out[env, out] = -1.0
