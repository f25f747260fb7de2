"""Forward kinematics of a tree of joints, for many environments at once.

Bodies are the moving links, each with one joint whose axis is the body's z axis (the host rotates every link frame so
that this holds). Fixed links are folded into offsets. The controlled joints' motion is written as screws
`S_j = (w_j, m_j)`: a point at `p` moves with `m_j + w_j x (p - ref)` for unit velocity of joint j, where `ref` is a
point near the robot, which keeps float32 exact to a micrometre wherever the robot stands.
"""

# ruff: noqa: UP018 (float(0.0) declares a dynamic variable in a Warp kernel)
import warp as wp

from wbm.kernels import se3

wp.set_module_options({"enable_backward": False})


@wp.struct
class Tree:
    """Kinematic tables: B bodies, S spheres in G groups, F frames, J controlled joints."""

    body_parent: wp.array(dtype=wp.int32)  # [B] index of the parent body, -1 for the world
    body_pos: wp.array(dtype=wp.vec3)  # [B] joint origin in the parent body, m
    body_rot: wp.array(dtype=wp.mat33)  # [B] orientation in the parent body at q = 0
    body_slide: wp.array(dtype=wp.int32)  # [B] 1 slide, 0 hinge
    body_joint: wp.array(dtype=wp.int32)  # [B] index into q
    joint_body: wp.array(dtype=wp.int32)  # [J] body of a controlled joint
    ref_body: wp.int32  # body whose origin is the reference point of screws and wrenches
    frame_body: wp.array(dtype=wp.int32)  # [F]
    frame_pos: wp.array(dtype=wp.vec3)  # [F] in the body, m
    frame_rot: wp.array(dtype=wp.mat33)  # [F]
    sphere_body: wp.array(dtype=wp.int32)  # [S]
    sphere_pos: wp.array(dtype=wp.vec3)  # [S] in the body, m
    sphere_radius: wp.array(dtype=wp.float32)  # [S] m
    sphere_order: wp.array(dtype=wp.int32)  # [S] the caller's index of a sphere; here they are sorted by group
    group_start: wp.array(dtype=wp.int32)  # [G+1] spheres of group g are group_start[g] .. group_start[g+1]-1
    group_mask: wp.array(dtype=wp.int32)  # [G] one bit for each controlled joint that moves the group
    group_parent: wp.array(dtype=wp.int32)  # [G] an earlier group that the others of these joints do not move, or -1
    group_own: wp.array(dtype=wp.int32)  # [G+1] joints that move g beside those of its parent: group_joint[own[g]..]
    group_joint: wp.array(dtype=wp.int32)


@wp.func
def finite_or(x: float, fallback: float) -> float:
    """`x`, or `fallback` where x is NaN or infinite."""
    y = x
    if not wp.isfinite(x):
        y = fallback
    return y


@wp.kernel(enable_backward=False)
def forward_kinematics(
    # in:
    tree: Tree,
    q: wp.array2d(dtype=wp.float32),  # [N,nq]
    # out:
    body_rot_out: wp.array2d(dtype=wp.mat33),  # [N,B]
    body_pos_out: wp.array2d(dtype=wp.vec3),  # [N,B]
    frame_pos_out: wp.array2d(dtype=wp.vec3),  # [N,F]
    frame_quat_out: wp.array2d(dtype=wp.vec4),  # [N,F] w x y z
):
    """World poses of all bodies and frames, a thread an environment."""
    e = wp.tid()
    for b in range(tree.body_parent.shape[0]):
        parent = tree.body_parent[b]
        rot = tree.body_rot[b]
        pos = tree.body_pos[b]
        if parent >= 0:
            rot_parent = body_rot_out[e, parent]
            pos = body_pos_out[e, parent] + rot_parent * pos
            rot = rot_parent * rot
        angle = finite_or(q[e, tree.body_joint[b]], 0.0)
        if tree.body_slide[b] == 1:
            pos += angle * wp.vec3(rot[0, 2], rot[1, 2], rot[2, 2])
        else:
            c = wp.cos(angle)
            s = wp.sin(angle)
            rot = wp.mat33(
                c * rot[0, 0] + s * rot[0, 1], c * rot[0, 1] - s * rot[0, 0], rot[0, 2],
                c * rot[1, 0] + s * rot[1, 1], c * rot[1, 1] - s * rot[1, 0], rot[1, 2],
                c * rot[2, 0] + s * rot[2, 1], c * rot[2, 1] - s * rot[2, 0], rot[2, 2],
            )  # fmt: skip
        body_rot_out[e, b] = rot
        body_pos_out[e, b] = pos
    for f in range(tree.frame_body.shape[0]):
        b = tree.frame_body[f]
        rot = body_rot_out[e, b]
        frame_pos_out[e, f] = body_pos_out[e, b] + rot * tree.frame_pos[f]
        frame_quat_out[e, f] = se3.mat_to_quat_wxyz(rot * tree.frame_rot[f])


@wp.kernel(enable_backward=False)
def place_spheres(
    # in:
    tree: Tree,
    body_rot: wp.array2d(dtype=wp.mat33),  # [N,B]
    body_pos: wp.array2d(dtype=wp.vec3),  # [N,B]
    # out:
    screw_out: wp.array2d(dtype=wp.spatial_vector),  # [N,J] (w, m) about the reference point
    sphere_pos_out: wp.array2d(dtype=wp.vec3),  # [N,S] relative to the reference point, m
    group_ball_out: wp.array2d(dtype=wp.vec4),  # [N,G] centre relative to the reference point, radius
):
    """Screws of the controlled joints, sphere centres, and a ball around each group, a thread an environment."""
    e = wp.tid()
    ref = body_pos[e, tree.ref_body]
    for j in range(tree.joint_body.shape[0]):
        b = tree.joint_body[j]
        rot = body_rot[e, b]
        z = wp.vec3(rot[0, 2], rot[1, 2], rot[2, 2])
        if tree.body_slide[b] == 1:
            screw_out[e, j] = wp.spatial_vector(wp.vec3(), z)
        else:
            screw_out[e, j] = wp.spatial_vector(z, wp.cross(body_pos[e, b] - ref, z))
    for g in range(tree.group_start.shape[0] - 1):
        start = tree.group_start[g]
        end = tree.group_start[g + 1]
        centre = wp.vec3()
        for s in range(start, end):
            b = tree.sphere_body[s]
            p = (body_pos[e, b] - ref) + body_rot[e, b] * tree.sphere_pos[s]
            sphere_pos_out[e, s] = p
            centre += p
        centre = centre / float(end - start)
        radius = float(0.0)
        for s in range(start, end):
            radius = wp.max(radius, wp.length(sphere_pos_out[e, s] - centre) + tree.sphere_radius[s])
        group_ball_out[e, g] = wp.vec4(centre[0], centre[1], centre[2], radius)
