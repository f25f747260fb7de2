"""Exact intersection of a ray with one geometry in the geometry's own frame; types and sizes are MuJoCo's."""

import warp as wp

PLANE = wp.constant(0)
SPHERE = wp.constant(2)
CAPSULE = wp.constant(3)
CYLINDER = wp.constant(5)
BOX = wp.constant(6)
MESH = wp.constant(7)

MISS = wp.constant(1.0e30)
UNBOUNDED = wp.constant(1.0e12)


@wp.func
def ray_plane(o: wp.vec3, d: wp.vec3, size: wp.vec3) -> float:
    """Front side of z = 0, bounded to `|x| <= size.x`, `|y| <= size.y` where those are positive."""
    if d[2] > -1.0e-9 or o[2] < 0.0:
        return MISS
    t = -o[2] / d[2]
    if size[0] > 0.0 and wp.abs(o[0] + t * d[0]) > size[0]:
        return MISS
    if size[1] > 0.0 and wp.abs(o[1] + t * d[1]) > size[1]:
        return MISS
    return t


@wp.func
def ray_sphere(o: wp.vec3, d: wp.vec3, radius: float) -> float:
    """Sphere about the origin; the discriminant is taken at the closest approach, where float32 loses nothing."""
    t_mid = -wp.dot(o, d)
    q = o + t_mid * d
    h = radius * radius - wp.dot(q, q)
    if h < 0.0:
        return MISS
    h = wp.sqrt(h)
    t = t_mid - h
    if t < 0.0:
        t = t_mid + h
    if t < 0.0:
        return MISS
    return t


@wp.func
def ray_capsule(o: wp.vec3, d: wp.vec3, radius: float, half: float) -> float:
    """Capsule along z: the first point outward of its cylinder wall and its two caps."""
    a = d[0] * d[0] + d[1] * d[1]
    t_side = MISS
    if a > 1.0e-12:
        t_mid = -(o[0] * d[0] + o[1] * d[1]) / a
        x = o[0] + t_mid * d[0]
        y = o[1] + t_mid * d[1]
        h = radius * radius - x * x - y * y
        if h < 0.0:
            return MISS
        h = wp.sqrt(h / a)
        t = t_mid - h
        if t >= 0.0 and wp.abs(o[2] + t * d[2]) <= half:
            return t
        t = t_mid + h
        if t >= 0.0 and wp.abs(o[2] + t * d[2]) <= half:
            t_side = t
    # A cap counts only outside the wall's span, where it is the surface.
    t_cap = MISS
    for side in range(2):
        z = half * (2.0 * float(side) - 1.0)
        s = z / wp.max(half, 1.0e-9)
        oc = wp.vec3(o[0], o[1], o[2] - z)
        t_mid = -wp.dot(oc, d)
        q = oc + t_mid * d
        h = radius * radius - wp.dot(q, q)
        if h >= 0.0:
            h = wp.sqrt(h)
            t = t_mid - h
            if t >= 0.0 and s * (oc[2] + t * d[2]) >= 0.0:
                t_cap = wp.min(t_cap, t)
            t = t_mid + h
            if t >= 0.0 and s * (oc[2] + t * d[2]) >= 0.0:
                t_cap = wp.min(t_cap, t)
    return wp.min(t_side, t_cap)


@wp.func
def ray_cylinder(o: wp.vec3, d: wp.vec3, radius: float, half: float) -> float:
    """Cylinder along z: the interval inside the wall cut with the interval between the ends."""
    t0 = -MISS
    t1 = MISS
    a = d[0] * d[0] + d[1] * d[1]
    if a > 1.0e-12:
        t_mid = -(o[0] * d[0] + o[1] * d[1]) / a
        x = o[0] + t_mid * d[0]
        y = o[1] + t_mid * d[1]
        h = radius * radius - x * x - y * y
        if h < 0.0:
            return MISS
        h = wp.sqrt(h / a)
        t0 = t_mid - h
        t1 = t_mid + h
    elif o[0] * o[0] + o[1] * o[1] > radius * radius:
        return MISS
    if wp.abs(d[2]) > 1.0e-12:
        mid = -o[2] / d[2]
        ext = wp.abs(half / d[2])
        t0 = wp.max(t0, mid - ext)
        t1 = wp.min(t1, mid + ext)
    elif wp.abs(o[2]) > half:
        return MISS
    if t0 > t1 or t1 < 0.0:
        return MISS
    if t0 < 0.0:
        return t1
    return t0


@wp.func
def ray_box(o: wp.vec3, d: wp.vec3, size: wp.vec3) -> float:
    """Box by slabs; a direction component of zero gives infinite slab ends of the right sign."""
    t0 = -MISS
    t1 = MISS
    for i in range(3):
        if wp.abs(d[i]) > 1.0e-12:
            inv = 1.0 / d[i]
            mid = -o[i] * inv
            ext = wp.abs(size[i] * inv)
            t0 = wp.max(t0, mid - ext)
            t1 = wp.min(t1, mid + ext)
        elif wp.abs(o[i]) > size[i]:
            t1 = -MISS
    if t0 > t1 or t1 < 0.0:
        return MISS
    if t0 < 0.0:
        return t1
    return t0


@wp.func
def ray_instance(kind: int, o: wp.vec3, d: wp.vec3, size: wp.vec3, mesh: wp.uint64, limit: float) -> float:
    """Range to one instance in its own frame, `MISS` if there is none; meshes are searched up to `limit`."""
    if kind == BOX:
        return ray_box(o, d, size)
    if kind == CAPSULE:
        return ray_capsule(o, d, size[0], size[1])
    if kind == PLANE:
        return ray_plane(o, d, size)
    if kind == CYLINDER:
        return ray_cylinder(o, d, size[0], size[1])
    if kind == SPHERE:
        return ray_sphere(o, d, size[0])
    query = wp.mesh_query_ray(mesh, o, d, limit)
    if query.result:
        return query.t
    return MISS


@wp.func
def bounding_radius(kind: int, size: wp.vec3) -> float:
    """Radius about the geometry's own origin that encloses a primitive."""
    if kind == SPHERE:
        return size[0]
    if kind == CAPSULE:
        return size[0] + size[1]
    if kind == CYLINDER:
        return wp.sqrt(size[0] * size[0] + size[1] * size[1])
    if kind == BOX:
        return wp.length(size)
    return UNBOUNDED


@wp.func
def support(kind: int, n: wp.vec3, size: wp.vec3) -> float:
    """Farthest extent of a bounded geometry about its own centre along a unit vector; `size` of a mesh is its box."""
    if kind == SPHERE:
        return size[0]
    if kind == CAPSULE:
        return size[0] + size[1] * wp.abs(n[2])
    if kind == CYLINDER:
        return size[0] * wp.sqrt(n[0] * n[0] + n[1] * n[1]) + size[1] * wp.abs(n[2])
    return size[0] * wp.abs(n[0]) + size[1] * wp.abs(n[1]) + size[2] * wp.abs(n[2])


@wp.func
def is_inside(kind: int, o: wp.vec3, size: wp.vec3, mesh: wp.uint64, mesh_radius: float) -> bool:
    """Whether a point in the instance's frame lies strictly inside it (below it, for a plane)."""
    if kind == PLANE:
        return o[2] < 0.0
    if kind == SPHERE:
        return wp.length(o) < size[0]
    if kind == CAPSULE:
        return wp.length(wp.vec3(o[0], o[1], o[2] - wp.clamp(o[2], -size[1], size[1]))) < size[0]
    if kind == CYLINDER:
        return o[0] * o[0] + o[1] * o[1] < size[0] * size[0] and wp.abs(o[2]) < size[1]
    if kind == BOX:
        return wp.abs(o[0]) < size[0] and wp.abs(o[1]) < size[1] and wp.abs(o[2]) < size[2]
    query = wp.mesh_query_point_sign_winding_number(mesh, o, 2.0 * mesh_radius)
    return query.result and query.sign < 0.0
