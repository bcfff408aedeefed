"""Kernels of NVIDIA Warp for :mod:`.bvh`: one query of a mesh per thread.

Each takes the meshes, trees or grids, the first face and the diagonal of each mesh, and which of
them each query is for (`owner`).
"""

# Types in a kernel are Warp's own.
# mypy: ignore-errors

import warp as wp

from mjx_grasp.geometry.curvature import SAME_DISTANCE, SQUARE
from mjx_grasp.geometry.rays import GRAZING

Moments = wp.types.vector(length=6, dtype=wp.float64)


@wp.func
def edge_on(normal: wp.vec3, direction: wp.vec3, cosine: float):
    """Whether a face is seen from its edge, or has no area."""
    squared = wp.length_sq(normal) * wp.length_sq(direction)
    along = wp.dot(normal, direction)
    return along * along <= cosine * cosine * squared


@wp.func
def met_at(mesh: wp.uint64, j: int, origin: wp.vec3, direction: wp.vec3):
    """Where a ray meets a face, along the ray; below 0 if nowhere. See :mod:`.rays`."""
    corner = wp.mesh_get_point(mesh, 3 * j)
    edge1 = wp.mesh_get_point(mesh, 3 * j + 1) - corner
    edge2 = wp.mesh_get_point(mesh, 3 * j + 2) - corner
    t = float(-1.0)
    if not edge_on(wp.cross(edge1, edge2), direction, wp.static(2.0 * GRAZING)):
        p = wp.cross(direction, edge2)
        determinant = wp.dot(edge1, p)
        s = origin - corner
        q = wp.cross(s, edge1)
        u = wp.dot(s, p) / determinant
        v = wp.dot(direction, q) / determinant
        if u >= 0.0 and v >= 0.0 and u + v <= 1.0:
            t = wp.dot(edge2, q) / determinant
    return t


@wp.kernel
def farthest(
    meshes: wp.array(dtype=wp.uint64),
    first_face: wp.array(dtype=int),
    diagonal: wp.array(dtype=float),
    owner: wp.array(dtype=int),
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    face: wp.array(dtype=int),
):
    """The face that each ray meets farthest from its origin; −1 if none.

    The faces are widened: Warp's search, which rounds boxes, slips through at edges and corners.
    """
    i = wp.tid()
    o = owner[i]
    mesh = meshes[o]
    # Back from beyond the mesh: the first hit met there is the farthest one of the ray.
    reach = 2.0 * diagonal[o]
    beyond = origins[i] + reach * directions[i]
    query = wp.mesh_query_ray(mesh, beyond, -directions[i], reach)
    found = int(-1)
    if query.result:
        found = query.face
        # That a ray runs along does not count, and may hide what it ends at: rare, so one by one.
        if edge_on(query.normal, directions[i], wp.static(100.0 * GRAZING)):
            found = int(-1)
            best = float(0.0)
            j = int(0)
            low = wp.min(origins[i], beyond)
            near = wp.mesh_query_aabb(mesh, low, wp.max(origins[i], beyond))
            while wp.mesh_query_aabb_next(near, j):
                t = met_at(mesh, j, origins[i], directions[i])
                if t > best:
                    best = t
                    found = j
    face[i] = -1
    if found >= 0:
        face[i] = first_face[o] + found


@wp.kernel
def nearest(
    meshes: wp.array(dtype=wp.uint64),
    first_face: wp.array(dtype=int),
    diagonal: wp.array(dtype=float),
    owner: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3),
    near: wp.array(dtype=int),
    sides: int,
    padded: int,
    length: int,
    face: wp.array(dtype=int),
):
    """The face nearest to each point of a chain; −1 if none."""
    side, i = wp.tid()
    o = owner[i]
    mesh = meshes[o]
    slack = 1.0e-3 * diagonal[o]
    # The last point's contact is on the mesh: no need to look farther than that.
    known = near[i]
    contact = wp.vec3()
    if known >= 0:
        contact = wp.mesh_eval_position(mesh, known - first_face[o], 1.0, 0.0)
    for k in range(length):
        at = (k * sides + side) * padded + i
        point = points[at]
        limit = wp.length(point) + 2.0 * diagonal[o]
        if known >= 0:
            limit = wp.length(point - contact) + slack
        query = wp.mesh_query_point_no_sign(mesh, point, limit)
        face[at] = -1
        if query.result:
            known = first_face[o] + query.face
            face[at] = known
            contact = wp.mesh_eval_position(mesh, query.face, query.u, query.v)


@wp.func
def alike(
    j: int,
    normal: wp.vec3,
    face_normals: wp.array(dtype=wp.vec3),
    areas: wp.array(dtype=float),
):
    """Whether a face has an area and faces the same way."""
    return areas[j] > 0.0 and wp.dot(face_normals[j], normal) > wp.static(SQUARE)


@wp.func
def moments(
    j: int,
    t1: wp.vec3,
    t2: wp.vec3,
    face_normals: wp.array(dtype=wp.vec3),
    areas: wp.array(dtype=float),
):
    """A face's area and moments of its normal: 1, x, y, xx, xy, yy along the tangents.

    In double precision, so that large moments may be subtracted.
    """
    a = wp.float64(areas[j])
    x = wp.float64(wp.dot(face_normals[j], t1))
    y = wp.float64(wp.dot(face_normals[j], t2))
    return Moments(a, a * x, a * y, a * x * x, a * x * y, a * y * y)


@wp.func
def spread_of(sums: Moments):
    """Second moments of the normals about their mean, over the area, from the sums."""
    spread = wp.vec3()
    area = sums[0]
    if area > wp.float64(0.0):
        x = sums[1] / area
        y = sums[2] / area
        xx = sums[3] / area - x * x
        xy = sums[4] / area - x * y
        yy = sums[5] / area - y * y
        spread = wp.vec3(float(xx), float(xy), float(yy))
    return spread


@wp.kernel
def spread(
    grids: wp.array(dtype=wp.uint64),
    first_face: wp.array(dtype=int),
    owner: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    tangents_1: wp.array(dtype=wp.vec3),
    tangents_2: wp.array(dtype=wp.vec3),
    centroids: wp.array(dtype=wp.vec3),
    face_normals: wp.array(dtype=wp.vec3),
    areas: wp.array(dtype=float),
    radius: float,
    counts: wp.array(dtype=int),
    out: wp.array(dtype=wp.vec3),
):
    """Spread of the normals within a radius: see ``normal_spread`` in :mod:`.curvature`."""
    i = wp.tid()
    o = owner[i]
    offset = first_face[o]
    point = points[i]
    normal = normals[i]
    t1 = tangents_1[i]
    t2 = tangents_2[i]
    slack = 1.0 + wp.static(SAME_DISTANCE)
    reach = slack * radius * radius
    count = int(0)
    sums = Moments()
    j = int(0)
    query = wp.hash_grid_query(grids[o], point, slack * radius)
    while wp.hash_grid_query_next(query, j):
        f = offset + j
        # Most are too far: the rest is read for the others alone.
        if wp.length_sq(centroids[f] - point) <= reach and alike(f, normal, face_normals, areas):
            count += 1
            sums += moments(f, t1, t2, face_normals, areas)
    counts[i] = count
    out[i] = spread_of(sums)


@wp.func
def reach_of(
    tree: wp.uint64,
    offset: int,
    point: wp.vec3,
    normal: wp.vec3,
    centroids: wp.array(dtype=wp.vec3),
    face_normals: wp.array(dtype=wp.vec3),
    areas: wp.array(dtype=float),
    wanted: int,
    radius: float,
    farthest_away: float,
):
    """Squared distance of the ``wanted``-th nearest face, or of the last one if there are fewer."""
    ball = radius
    enough = int(0)
    while enough < wanted and ball < farthest_away:
        ball = 2.0 * ball
        enough = int(0)
        j = int(0)
        query = wp.bvh_query_sphere(tree, point, ball)
        while wp.bvh_query_next(query, j):
            d = wp.length_sq(centroids[offset + j] - point)
            if d <= ball * ball and alike(offset + j, normal, face_normals, areas):
                enough += 1
    # From the nearest on, distance by distance.
    reach = float(-1.0)
    count = int(0)
    more = int(1)
    while count < wanted and more == 1:
        following = float(-1.0)
        ties = int(0)
        j = int(0)
        query = wp.bvh_query_sphere(tree, point, ball)
        while wp.bvh_query_next(query, j):
            d = wp.length_sq(centroids[offset + j] - point)
            if d > reach and alike(offset + j, normal, face_normals, areas):
                if following < 0.0 or d < following:
                    following = d
                    ties = int(1)
                elif d == following:
                    ties += 1
        if following < 0.0:
            more = 0
        else:
            reach = following
            count += ties
    return reach


@wp.kernel
def wider_spread(
    rows: wp.array(dtype=int),
    trees: wp.array(dtype=wp.uint64),
    first_face: wp.array(dtype=int),
    diagonal: wp.array(dtype=float),
    owner: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    tangents_1: wp.array(dtype=wp.vec3),
    tangents_2: wp.array(dtype=wp.vec3),
    centroids: wp.array(dtype=wp.vec3),
    face_normals: wp.array(dtype=wp.vec3),
    areas: wp.array(dtype=float),
    radius: float,
    min_faces: int,
    out: wp.array(dtype=wp.vec3),
):
    """Spread of the normals of the nearest ``min_faces``, for some rows."""
    i = rows[wp.tid()]
    o = owner[i]
    point = points[i]
    normal = normals[i]
    t1 = tangents_1[i]
    t2 = tangents_2[i]
    offset = first_face[o]
    slack = 1.0 + wp.static(SAME_DISTANCE)
    wider = reach_of(
        trees[o], offset, point, normal, centroids, face_normals, areas, min_faces,
        radius, 2.0 * diagonal[o] + wp.length(point),
    )  # fmt: skip
    reach = slack * wp.max(radius * radius, wider)
    sums = Moments()
    j = int(0)
    query = wp.bvh_query_sphere(trees[o], point, slack * wp.sqrt(reach))
    while wp.bvh_query_next(query, j):
        f = offset + j
        if wp.length_sq(centroids[f] - point) <= reach and alike(f, normal, face_normals, areas):
            sums += moments(f, t1, t2, face_normals, areas)
    out[i] = spread_of(sums)
