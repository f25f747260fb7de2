"""Pictures for people: shading of traced rays with soft shadows."""

# ruff: noqa: UP018 (float(0.0) declares a dynamic variable in a Warp kernel)
import warp as wp

from wbm.kernels.rays_data import SceneView, Slots
from wbm.kernels.rays_shapes import BOX, CAPSULE, CYLINDER, MESH, PLANE, SPHERE, ray_instance
from wbm.kernels.se3 import quat_wxyz_normalize, quat_wxyz_to_mat

CHECKER = wp.constant(0.5)  # side of the floor's squares, m
FOG = wp.constant(14.0)  # distance at which the floor is half faded, m
SHADOW_BIAS = wp.constant(2.0e-3)  # m


@wp.func
def surface_normal(kind: int, p: wp.vec3, size: wp.vec3) -> wp.vec3:
    """Outward unit normal of a primitive at a point of its surface, in its own frame."""
    if kind == SPHERE:
        return wp.normalize(p)
    if kind == CAPSULE:
        return wp.normalize(wp.vec3(p[0], p[1], p[2] - wp.clamp(p[2], -size[1], size[1])))
    if kind == CYLINDER:
        if size[1] - wp.abs(p[2]) < size[0] - wp.sqrt(p[0] * p[0] + p[1] * p[1]):
            return wp.vec3(0.0, 0.0, wp.sign(p[2]))
        return wp.normalize(wp.vec3(p[0], p[1], 0.0))
    if kind == BOX:
        gap = wp.vec3(size[0] - wp.abs(p[0]), size[1] - wp.abs(p[1]), size[2] - wp.abs(p[2]))
        if gap[0] <= gap[1] and gap[0] <= gap[2]:
            return wp.vec3(wp.sign(p[0]), 0.0, 0.0)
        if gap[1] <= gap[2]:
            return wp.vec3(0.0, wp.sign(p[1]), 0.0)
        return wp.vec3(0.0, 0.0, wp.sign(p[2]))
    return wp.vec3(0.0, 0.0, 1.0)


@wp.func
def sky(d: wp.vec3) -> wp.vec3:
    """Background along a direction: pale at the horizon, blue above."""
    up = wp.sqrt(wp.clamp(d[2], 0.0, 1.0))
    return (1.0 - up) * wp.vec3(0.86, 0.89, 0.93) + up * wp.vec3(0.42, 0.58, 0.80)


@wp.kernel(enable_backward=False)
def shade_rays(
    # in:
    ray: wp.array2d[wp.vec3],  # [1,R] unit, camera frame
    cam_pos: wp.array[wp.vec3],  # [1]
    cam_quat: wp.array[wp.vec4],  # [1] w x y z
    hit: wp.array2d[float],  # [1,R]
    hit_inst: wp.array2d[int],  # [1,R]
    scene: SceneView,  # one environment
    inst_color: wp.array2d[wp.vec3],  # [1,I]
    light_pos: wp.array[wp.vec3],  # [K] samples of one area light
    light: Slots,  # instances as placed from each light sample
    # out:
    rgb_out: wp.array[wp.vec3],  # [R] linear
):
    """Lambert's law under an area light and a sky, a soft highlight, a checkered floor that fades into the horizon."""
    r = wp.tid()
    R_WC = quat_wxyz_to_mat(quat_wxyz_normalize(cam_quat[0]))
    d = R_WC * ray[0, r]
    i = hit_inst[0, r]
    if i < 0:
        rgb_out[r] = sky(d)
        return
    t = hit[0, r]
    p = cam_pos[0] + t * d
    R_WI = quat_wxyz_to_mat(quat_wxyz_normalize(scene.quat[0, i]))
    p_WI = scene.pos[0, i]
    body = scene.body[0, i]
    if body >= 0:
        R_WB = quat_wxyz_to_mat(quat_wxyz_normalize(scene.body_quat[0, body]))
        p_WI = scene.body_pos[0, body] + R_WB * p_WI
        R_WI = R_WB * R_WI
    kind = scene.type[0, i]
    R_IW = wp.transpose(R_WI)
    n = surface_normal(kind, R_IW * (p - p_WI), scene.size[0, i])
    if kind == MESH:
        query = wp.mesh_query_ray(scene.mesh_ids[scene.mesh[0, i]], R_IW * (cam_pos[0] - p_WI), R_IW * d, 2.0 * t + 1.0)
        n = wp.normalize(query.normal)
    n = R_WI * n
    if wp.dot(n, d) > 0.0:
        n = -n
    color = inst_color[0, i]
    if kind == PLANE:
        odd = (int(wp.floor(p[0] / CHECKER)) + int(wp.floor(p[1] / CHECKER))) % 2
        if odd != 0:
            color = 0.78 * color
    lit = float(0.0)
    shine = float(0.0)
    for k in range(light_pos.shape[0]):
        to_point = p - light_pos[k]
        distance = wp.length(to_point)
        u = to_point / distance
        facing = -wp.dot(n, u)
        if facing > 0.0:
            free = float(1.0)
            for s in range(light.count[k]):
                s4 = light.sphere[k, s]
                along = s4[0] * u[0] + s4[1] * u[1] + s4[2] * u[2]
                ahead = s4[3] <= 0.0 or (along > 0.0 and along * along >= s4[3])
                if free > 0.0 and light.near[k, s] < distance and ahead:
                    limit = distance - SHADOW_BIAS
                    u_I = light.rot[k, s] * u
                    met = ray_instance(
                        light.kind[k, s], light.origin[k, s], u_I, light.size[k, s], light.mesh[k, s], limit
                    )
                    if met < limit:
                        free = 0.0
            lit += free * facing
            half = wp.normalize(u + d)
            shine += free * wp.pow(wp.abs(wp.dot(half, n)), 40.0)
    samples = float(light_pos.shape[0])
    ambient = 0.42 + 0.16 * n[2]
    rgb = color * (ambient + 0.62 * lit / samples)
    if kind != PLANE:
        rgb = rgb + 0.10 * shine / samples * wp.vec3(1.0, 1.0, 1.0)
    else:
        keep = 1.0 / (1.0 + (t / FOG) * (t / FOG))
        rgb = keep * rgb + (1.0 - keep) * sky(d)
    rgb_out[r] = rgb
