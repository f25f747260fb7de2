"""What the ray kernels share: the scene, the sorted rays, the instances in reach, and working memory."""

import warp as wp


@wp.struct
class SceneView:
    """Instances [N,I] of every environment, the live poses of their bodies [N,B], and meshes [K]."""

    body_pos: wp.array2d[wp.vec3]  # [N,B]
    body_quat: wp.array2d[wp.vec4]  # [N,B] w x y z
    type: wp.array2d[int]  # [N,I] negative: unused
    size: wp.array2d[wp.vec3]
    mesh: wp.array2d[int]
    body: wp.array2d[int]  # negative: fixed in the world
    pos: wp.array2d[wp.vec3]
    quat: wp.array2d[wp.vec4]
    mesh_ids: wp.array[wp.uint64]  # [K]
    mesh_sphere: wp.array[wp.vec4]  # [K] centre, radius
    mesh_half: wp.array[wp.vec3]  # [K] half extents about that centre


@wp.struct
class Bundles:
    """Q patterns of R rays sorted into G bundles, which are culled in groups and subgroups and traced in parts.

    A cone is its axis and the cosine of its half angle, or zeros where it is not narrow.
    """

    direction: wp.array2d[wp.vec3]  # [Q,R] unit, bundle order, sensor frame
    order: wp.array2d[int]  # [Q,R] bundle order -> ray
    cone: wp.array2d[wp.vec4]  # [Q,G]
    group_cone: wp.array2d[wp.vec4]  # [Q,G/group]
    subgroup_cone: wp.array2d[wp.vec4]  # [Q,G/subgroup]
    part_cone: wp.array2d[wp.vec4]  # [Q,R/part]
    bundle: int  # rays
    group: int  # bundles
    subgroup: int  # bundles
    part: int  # rays
    chunk: int  # rays of a thread
    view_axis: wp.vec3  # cone that holds all rays
    view_cos: float
    view_sin: float
    reach: float  # m


@wp.struct
class Slots:
    """The instances that a sensor may see, in its own frame: `count` of them, in places called slots."""

    count: wp.array[int]  # [N]
    inst: wp.array2d[int]  # [N,I] slot -> instance
    kind: wp.array2d[int]
    size: wp.array2d[wp.vec3]  # a mesh's half extents
    mesh: wp.array2d[wp.uint64]
    rot: wp.array2d[wp.mat33]  # sensor frame -> instance frame
    origin: wp.array2d[wp.vec3]  # sensor origin in the instance frame
    sphere: wp.array2d[wp.vec4]  # centre c of the bounding sphere in the sensor frame, |c|^2 - r^2
    cone: wp.array2d[wp.vec4]  # its cone as `meets` takes it
    near: wp.array2d[float]  # its nearest range, 0 if it holds the sensor


@wp.struct
class Scratch:
    """Lists of slots for groups and bundles, and the hits so far in bundle order."""

    group_slot: wp.array3d[wp.int16]  # [N,G/group,I]
    subgroup_slot: wp.array3d[wp.int16]  # [N,G/group,I] of one subgroup after the other
    count: wp.array2d[int]  # [N,G]
    slot: wp.array3d[wp.int16]  # [N,G,I] nearest first
    best: wp.array2d[float]  # [N,R] m
    inst: wp.array2d[int]  # [N,R]
    far: wp.array2d[float]  # [N,R/part] farthest of a part's `best`, m
