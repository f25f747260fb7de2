"""Ray casting over per-environment instances: placement, bundle culling and exact intersection.

All rays of a sensor start at one point, so everything that depends on the origin alone is computed once an instance
(`place`). Rays come in bundles of neighbours; an instance enters a bundle's list only if it reaches into the bundle's
cone (`cull`), nearest first, so that rays stop at the first sphere that starts behind their hits (`trace`). Geometry
types and sizes use MuJoCo's numbers. Distances are along unit rays, in metres.

On a GPU these are three kernels of many threads; on a CPU one thread takes an environment through all three, so that
its data stay in the cache.
"""

# ruff: noqa: RUF046, UP018 (int(0) declares a dynamic variable in a Warp kernel)
import warp as wp

from wbm.kernels.rays_cones import is_out, meets, sphere_cone
from wbm.kernels.rays_data import Bundles, SceneView, Scratch, Slots
from wbm.kernels.rays_shapes import MESH, UNBOUNDED, bounding_radius, is_inside, ray_instance
from wbm.kernels.se3 import quat_wxyz_normalize, quat_wxyz_to_mat


@wp.func
def place(
    # in:
    env: int,
    pos: wp.vec3,
    quat: wp.vec4,  # w x y z
    exclude_body: int,
    rays: Bundles,
    scene: SceneView,
    # out:
    slots_out: Slots,
) -> int:
    """List the instances that the sensor may see, in its own frame; returns 0 where no ray can be trusted, else 1."""
    ok = wp.isfinite(pos) and wp.isfinite(quat) and wp.length_sq(quat) > 1.0e-12
    R_WS = quat_wxyz_to_mat(quat_wxyz_normalize(quat))
    count = int(0)
    for i in range(scene.type.shape[1]):
        kind = scene.type[env, i]
        body = scene.body[env, i]
        if ok and kind >= 0 and (body != exclude_body or body < 0):
            finite = wp.isfinite(scene.quat[env, i])
            R_WI = quat_wxyz_to_mat(quat_wxyz_normalize(scene.quat[env, i]))
            p_WI = scene.pos[env, i]
            if body >= 0:
                R_WB = quat_wxyz_to_mat(quat_wxyz_normalize(scene.body_quat[env, body]))
                p_WI = scene.body_pos[env, body] + R_WB * p_WI
                R_WI = R_WB * R_WI
                finite = finite and wp.isfinite(scene.body_quat[env, body])
            offset = p_WI - pos
            size = scene.size[env, i]
            mesh = wp.uint64(0)
            centre = wp.vec3(0.0, 0.0, 0.0)
            radius = bounding_radius(kind, size)
            if kind == MESH:
                index = scene.mesh[env, i]
                mesh = scene.mesh_ids[index]
                around = scene.mesh_sphere[index]
                centre = wp.vec3(around[0], around[1], around[2])
                radius = around[3]
                size = scene.mesh_half[index]
            origin = -wp.transpose(R_WI) * offset
            if not (finite and wp.isfinite(origin)):
                ok = False
            else:
                c = wp.transpose(R_WS) * (offset + R_WI * centre)
                distance = wp.length(c)
                if distance < radius and is_inside(kind, origin, size, mesh, radius):
                    ok = False
                along = wp.dot(c, rays.view_axis)
                aside = wp.sqrt(wp.max(distance * distance - along * along, 0.0))
                if distance - radius < rays.reach and aside * rays.view_cos - along * rays.view_sin <= radius * 1.001:
                    slots_out.inst[env, count] = i
                    slots_out.kind[env, count] = kind
                    slots_out.size[env, count] = size
                    slots_out.mesh[env, count] = mesh
                    slots_out.rot[env, count] = wp.transpose(R_WI) * R_WS
                    slots_out.origin[env, count] = origin
                    # Widened, so that rounding never loses a hit.
                    bound = wp.min(radius * 1.0001 + 1.0e-6 * distance, UNBOUNDED)
                    power = distance * distance * 0.999999 - bound * bound
                    slots_out.sphere[env, count] = wp.vec4(c[0], c[1], c[2], power)
                    slots_out.near[env, count] = wp.max(distance - bound, 0.0)
                    slots_out.cone[env, count] = sphere_cone(c, distance, bound)
                    count += 1
    if ok:
        slots_out.count[env] = count
        return 1
    slots_out.count[env] = 0
    return 0


@wp.func
def cull(
    # in:
    env: int,
    row: int,  # of the ray table
    h: int,  # group of bundles
    rays: Bundles,
    slots: Slots,
    # out:
    work_out: Scratch,
):
    """Slots of the instances that may reach into each bundle's cone, sorted by their nearest range."""
    whole = rays.group_cone[row, h]
    sin_whole = wp.sqrt(wp.max(1.0 - whole[3] * whole[3], 0.0))
    # Written always and counted where it fits: a branch that nobody can predict costs more than the test.
    found = int(0)
    for s in range(slots.count[env]):
        work_out.group_slot[env, h, found] = wp.int16(s)
        found += wp.where(meets(slots.cone[env, s], whole, sin_whole), 1, 0)
    fewer = int(0)
    for g in range(h * rays.group, wp.min((h + 1) * rays.group, rays.cone.shape[1])):
        if g % rays.subgroup == 0:
            some = rays.subgroup_cone[row, g // rays.subgroup]
            sin_some = wp.sqrt(wp.max(1.0 - some[3] * some[3], 0.0))
            fewer = int(0)
            for m in range(found):
                s = int(work_out.group_slot[env, h, m])
                work_out.subgroup_slot[env, h, fewer] = wp.int16(s)
                fewer += wp.where(meets(slots.cone[env, s], some, sin_some), 1, 0)
        c4 = rays.cone[row, g]
        axis = wp.vec3(c4[0], c4[1], c4[2])
        sin_half = wp.sqrt(wp.max(1.0 - c4[3] * c4[3], 0.0))
        near_by = int(0)
        for m in range(fewer):
            s = int(work_out.subgroup_slot[env, h, m])
            work_out.slot[env, g, near_by] = wp.int16(s)
            near_by += wp.where(meets(slots.cone[env, s], c4, sin_half), 1, 0)
        num = int(0)
        for m in range(near_by):
            s = int(work_out.slot[env, g, m])
            out = bool(False)
            if c4[3] > 0.0:
                out = is_out(
                    slots.kind[env, s], slots.size[env, s], slots.sphere[env, s], slots.origin[env, s],
                    slots.rot[env, s], axis, c4[3], sin_half,
                )  # fmt: skip
            if not out:
                key = slots.near[env, s]
                j = int(num)
                while j > 0 and slots.near[env, int(work_out.slot[env, g, j - 1])] > key:
                    work_out.slot[env, g, j] = work_out.slot[env, g, j - 1]
                    j -= 1
                work_out.slot[env, g, j] = wp.int16(s)
                num += 1
        work_out.count[env, g] = num


@wp.func
def trace(
    # in:
    env: int,
    row: int,  # of the ray table
    c: int,  # chunk of rays
    rays: Bundles,
    slots: Slots,
    # inout:
    work_io: Scratch,
    # out:
    range_out: wp.array2d[float],  # [N,R] -1 where nothing is hit
    instance_out: wp.array2d[int],  # [N,R] -1 where nothing is hit
):
    """Nearest hit of every ray of a chunk along its bundle's list."""
    first = c * rays.chunk
    end = wp.min(first + rays.chunk, rays.direction.shape[1])
    g = first // rays.bundle
    part = first // rays.part
    part_end = (end + rays.part - 1) // rays.part
    for k in range(first, end):
        work_io.best[env, k] = rays.reach
        work_io.inst[env, k] = -1
    for b in range(part, part_end):
        work_io.far[env, b] = rays.reach
    # A part, and the chunk, is done with when all its hits lie before the next sphere. The data of an instance are
    # left in memory until a ray meets its sphere.
    farthest = float(rays.reach)
    for j in range(work_io.count[env, g]):
        s = int(work_io.slot[env, g, j])
        start = slots.near[env, s]
        if start > farthest:
            break
        s4 = slots.sphere[env, s]
        centre = wp.vec3(s4[0], s4[1], s4[2])
        around = slots.cone[env, s]
        farthest = float(0.0)
        for b in range(part, part_end):
            far = work_io.far[env, b]
            if start <= far:
                c4 = rays.part_cone[row, b]
                if meets(around, c4, wp.sqrt(wp.max(1.0 - c4[3] * c4[3], 0.0))):
                    far = float(0.0)
                    for k in range(b * rays.part, wp.min((b + 1) * rays.part, end)):
                        best = work_io.best[env, k]
                        if start <= best:
                            d = rays.direction[row, k]
                            along = wp.dot(centre, d)
                            if s4[3] <= 0.0 or (along > 0.0 and along * along >= s4[3]):
                                t = ray_instance(
                                    slots.kind[env, s], slots.origin[env, s], slots.rot[env, s] * d,
                                    slots.size[env, s], slots.mesh[env, s], best,
                                )  # fmt: skip
                                if t < best:
                                    best = t
                                    work_io.best[env, k] = t
                                    work_io.inst[env, k] = slots.inst[env, s]
                        far = wp.max(far, best)
                    work_io.far[env, b] = far
            farthest = wp.max(farthest, far)
    for k in range(first, end):
        out = rays.order[row, k]
        inst = work_io.inst[env, k]
        instance_out[env, out] = inst
        if inst >= 0:
            range_out[env, out] = work_io.best[env, k]
        else:
            range_out[env, out] = -1.0


@wp.kernel(enable_backward=False)
def cast_rays(
    # in:
    env_ids: wp.array[int],  # [n]
    pattern: wp.array[int],  # [N] row of the ray table
    sensor_pos: wp.array[wp.vec3],  # [N]
    sensor_quat: wp.array[wp.vec4],  # [N] w x y z
    exclude_body: int,
    rays: Bundles,
    scene: SceneView,
    # scratch:
    slots_scratch: Slots,
    work_scratch: Scratch,
    # out:
    ok_out: wp.array[int],  # [N]
    range_out: wp.array2d[float],  # [N,R]
    instance_out: wp.array2d[int],  # [N,R]
):
    """All three steps for one environment a thread."""
    env = env_ids[wp.tid()]
    row = pattern[env]
    ok_out[env] = place(env, sensor_pos[env], sensor_quat[env], exclude_body, rays, scene, slots_scratch)
    for h in range(rays.group_cone.shape[1]):
        cull(env, row, h, rays, slots_scratch, work_scratch)
    for c in range((rays.direction.shape[1] + rays.chunk - 1) // rays.chunk):
        trace(env, row, c, rays, slots_scratch, work_scratch, range_out, instance_out)


@wp.kernel(enable_backward=False)
def place_instances(
    # in:
    env_ids: wp.array[int],  # [n]
    sensor_pos: wp.array[wp.vec3],  # [N]
    sensor_quat: wp.array[wp.vec4],  # [N] w x y z
    exclude_body: int,
    rays: Bundles,
    scene: SceneView,
    # out:
    slots_out: Slots,
    ok_out: wp.array[int],  # [N]
):
    """`place` with a thread an environment."""
    env = env_ids[wp.tid()]
    ok_out[env] = place(env, sensor_pos[env], sensor_quat[env], exclude_body, rays, scene, slots_out)


@wp.kernel(enable_backward=False)
def cull_bundles(
    # in:
    env_ids: wp.array[int],  # [n]
    pattern: wp.array[int],  # [N]
    rays: Bundles,
    slots: Slots,
    # out:
    work_out: Scratch,
):
    """`cull` with a thread a group."""
    i, h = wp.tid()
    env = env_ids[i]
    cull(env, pattern[env], h, rays, slots, work_out)


@wp.kernel(enable_backward=False)
def trace_rays(
    # in:
    env_ids: wp.array[int],  # [n]
    pattern: wp.array[int],  # [N]
    rays: Bundles,
    slots: Slots,
    # scratch:
    work_scratch: Scratch,
    # out:
    range_out: wp.array2d[float],  # [N,R]
    instance_out: wp.array2d[int],  # [N,R]
):
    """`trace` with a thread a chunk."""
    i, c = wp.tid()
    env = env_ids[i]
    trace(env, pattern[env], c, rays, slots, work_scratch, range_out, instance_out)
