"""Turns the robot model into the flat tables that the kernels read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from wbm.kernels.kinematics import Tree
from wbm.robot.joints import BASE, NECK, WBC
from wbm.robot.model import FIXED, SLIDE, RobotModel, forward_kinematics, frame_poses
from wbm.robot.rotations import quat_to_mat
from wbm.robot.spheres import SphereSet


@dataclass(frozen=True)
class Tables:
    """Host tables; B moving bodies, S spheres (in the caller's order), G groups of spheres, Q blocks of P pairs.

    `body_of_link [L]`, `link_pos [L,3]`, `link_rot [L,3,3]` place a link in its body.
    `mask` fields hold one bit for each controlled joint that moves a thing.
    """

    tree: dict[str, np.ndarray]
    ref_body: int
    frame_names: tuple[str, ...]
    frame_mask: dict[str, int]
    block: np.ndarray
    pair: np.ndarray

    def upload(self, device: wp.context.Device) -> Tree:  # pyright: ignore[reportGeneralTypeIssues]
        """The device struct of these tables."""
        tree = Tree()
        for name, value in self.tree.items():
            kind = {(): wp.int32, (3,): wp.vec3, (3, 3): wp.mat33}[value.shape[1:]]
            if value.ndim == 1 and value.dtype.kind == "f":
                kind = wp.float32
            setattr(tree, name, wp.array(value, dtype=kind, device=device))
        tree.ref_body = self.ref_body
        return tree


def build_tables(robot: RobotModel, spheres: SphereSet, pairs: np.ndarray, joints: np.ndarray = WBC) -> Tables:
    """Fold fixed links into their bodies, turn joint axes onto z, and group the spheres.

    Args:
        robot: the kinematic tree.
        spheres: collision spheres on its links.
        pairs: self-collision pairs of spheres [P,2]; those that no controlled joint moves apart are left out.
        joints: indices of the controlled joints [J].
    """
    body, body_rot, body_pos, parents, offsets = _bodies(robot)
    count = len(parents)
    joint_of = np.array([robot.joint_index[i] for i in range(len(body)) if robot.joint_type[i] != FIXED])
    slide = np.array([robot.joint_type[i] == SLIDE for i in range(len(body)) if robot.joint_type[i] != FIXED])
    slot = {int(j): k for k, j in enumerate(joints)}
    mask = np.zeros(count, dtype=np.int64)
    for b in range(count):
        above = mask[parents[b]] if parents[b] >= 0 else 0
        mask[b] = above | (1 << slot[int(joint_of[b])] if int(joint_of[b]) in slot else 0)

    group = np.array([_group(robot, link, set(joints.tolist())) for link in spheres.link])
    order = np.argsort(group, kind="stable").astype(np.int32)
    names, starts = np.unique(group[order], return_index=True)
    group_mask = np.array([_mask_of(mask, body[name]) for name in names], dtype=np.int64)  # pyright: ignore[reportArgumentType]
    pairs = np.asarray(pairs).reshape(-1, 2)
    moved_by = np.array([_mask_of(mask, int(body[link])) for link in group])
    block, pair = _blocks(pairs[moved_by[pairs[:, 0]] != moved_by[pairs[:, 1]]], group, names, order)
    group_parent, group_own, group_joint = _group_chain(group_mask, len(joints))
    sphere_body = np.array([body[link] for link in spheres.link[order]], dtype=np.int32)
    if (sphere_body < 0).any():
        raise ValueError("spheres: every sphere must sit on a link that a joint moves")
    sphere_pos = np.array(
        [body_pos[link] + body_rot[link] @ p for link, p in zip(spheres.link[order], spheres.pos[order], strict=True)]
    )
    frames = robot.frames
    tree = {
        "body_parent": parents.astype(np.int32),
        "body_pos": np.array([p for _, p in offsets]),
        "body_rot": np.array([r for r, _ in offsets]),
        "body_slide": slide.astype(np.int32),
        "body_joint": joint_of.astype(np.int32),
        "joint_body": np.array([int(np.flatnonzero(joint_of == j)[0]) for j in joints], dtype=np.int32),
        "frame_body": np.array([body[f.link] for f in frames.values()], dtype=np.int32),
        "frame_pos": np.array([body_pos[f.link] + body_rot[f.link] @ f.pos for f in frames.values()]),
        "frame_rot": np.array([body_rot[f.link] @ quat_to_mat(f.quat) for f in frames.values()]),
        "sphere_body": sphere_body,
        "sphere_pos": sphere_pos,
        "sphere_radius": np.asarray(spheres.radius, dtype=np.float64)[order],
        "sphere_order": order,
        "group_mask": group_mask.astype(np.int32),
        "group_parent": group_parent,
        "group_own": group_own,
        "group_joint": group_joint,
        "group_start": np.r_[starts, len(order)].astype(np.int32),
    }
    return Tables(
        tree=tree,
        ref_body=int(body[frames["base"].link]),
        frame_names=tuple(frames),
        frame_mask={name: _mask_of(mask, body[f.link]) for name, f in frames.items()},
        block=block,
        pair=pair,
    )


def neck_pan(robot: RobotModel) -> tuple[np.ndarray, float]:
    """Place of the neck's first joint in the base frame (m), and the azimuth of the home pose's optical axis (rad)."""
    q = robot.q_home.copy()
    q[BASE] = 0.0
    _, pos = forward_kinematics(robot, q)
    joint = int(np.flatnonzero(robot.joint_index == NECK.start)[0])
    axis = frame_poses(robot, q)["camera"][0][:, 2]
    return pos[joint], float(np.arctan2(axis[1], axis[0]) - robot.q_home[NECK.start])


def _bodies(robot: RobotModel):
    """Body index, rotation and position of each link in its body; parent and offset of each body."""
    num = len(robot.link_names)
    body = np.full(num, -1)
    rot, pos = np.tile(np.eye(3), (num, 1, 1)), np.zeros((num, 3))
    parents: list[int] = []
    offsets: list[tuple[np.ndarray, np.ndarray]] = []
    local = quat_to_mat(robot.link_quat)
    for i in range(1, num):
        p = robot.parent[i]
        in_body_pos = pos[p] + rot[p] @ robot.link_pos[i]
        in_body_rot = rot[p] @ local[i]
        if robot.joint_type[i] == FIXED:
            body[i], rot[i], pos[i] = body[p], in_body_rot, in_body_pos
            continue
        turn = _z_onto(robot.joint_axis[i])
        body[i] = len(parents)
        rot[i] = turn.T  # link frame in the body frame, whose z is the joint axis
        parents.append(int(body[p]))
        offsets.append((in_body_rot @ turn, in_body_pos))
    return body, rot, pos, np.array(parents), offsets


def _z_onto(axis: np.ndarray) -> np.ndarray:
    """A rotation that takes z onto `axis`; the identity for z itself."""
    z = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    x = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = x - z * (x @ z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _group(robot: RobotModel, link: int, controlled: set[int]) -> int:
    """The link that stands for a sphere's group: links below joints that the controller does not move share one."""
    chain = [link]
    while robot.parent[chain[-1]] > 0:
        chain.append(int(robot.parent[chain[-1]]))
    top = link
    for above in chain:
        if robot.joint_type[above] != FIXED and int(robot.joint_index[above]) not in controlled:
            top = int(robot.parent[above])
    return top


def _mask_of(mask: np.ndarray, body: int) -> int:
    return int(mask[body]) if body >= 0 else 0


def _group_chain(group_mask: np.ndarray, joints: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each group the earlier group that shares most of its joints, and the joints beside those."""
    parent, own, joint = [], [0], []
    for g, bits in enumerate(group_mask.tolist()):
        inside = [h for h in range(g) if group_mask[h] & ~bits == 0]
        best = max(inside, key=lambda h: int(group_mask[h]).bit_count(), default=-1)
        rest = bits & ~(int(group_mask[best]) if best >= 0 else 0)
        joint += [j for j in range(joints) if rest >> j & 1]
        parent.append(best)
        own.append(len(joint))
    return tuple(np.array(x, dtype=np.int32) for x in (parent, own, joint))  # type: ignore[return-value]


def _blocks(pairs: np.ndarray, group: np.ndarray, names: np.ndarray, order: np.ndarray):
    """Pairs sorted into blocks of equal groups: group a, group b, first pair, end."""
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    index = {int(name): k for k, name in enumerate(names)}
    rows = sorted((index[int(group[a])], index[int(group[b])], int(rank[a]), int(rank[b])) for a, b in pairs)
    block: list[list[int]] = []
    for k, (ga, gb, _, _) in enumerate(rows):
        if block and block[-1][:2] == [ga, gb]:
            block[-1][3] = k + 1
        else:
            block.append([ga, gb, k, k + 1])
    pair = np.array([(a, b) for _, _, a, b in rows], dtype=np.int32).reshape(-1, 2)
    return np.array(block, dtype=np.int32).reshape(-1, 4), pair
