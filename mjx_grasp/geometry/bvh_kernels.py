"""Kernels of NVIDIA Warp for :mod:`.bvh`: one query of a mesh per thread.

Each takes the first of the threads it works for (`start`), the meshes or trees, the first face and
the diagonal of each, and which of them each query is for (`owner`).
"""

# In a kernel `int(0)` is a variable where `0` is a constant; types are Warp's own.
# ruff: noqa: UP018, RUF046
# mypy: ignore-errors

import warp as wp

from mjx_grasp.geometry.curvature import SAME_DISTANCE, SQUARE


@wp.kernel
def farthest(
    start: int,
    meshes: wp.array(dtype=wp.uint64),
    first_face: wp.array(dtype=int),
    diagonal: wp.array(dtype=float),
    owner: wp.array(dtype=int),
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    face: wp.array(dtype=int),
):
    """The face that each ray meets farthest from its origin; −1 if none."""
    i = start + wp.tid()
    o = owner[i]
    # Back from beyond the mesh: the first hit met there is the farthest one of the ray.
    reach = 2.0 * diagonal[o]
    query = wp.mesh_query_ray(meshes[o], origins[i] + reach * directions[i], -directions[i], reach)
    face[i] = -1
    if query.result:
        face[i] = first_face[o] + query.face


@wp.kernel
def nearest(
    start: int,
    meshes: wp.array(dtype=wp.uint64),
    first_face: wp.array(dtype=int),
    diagonal: wp.array(dtype=float),
    owner: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3),
    bound: wp.array(dtype=float),
    chains: int,
    length: int,
    face: wp.array(dtype=int),
):
    """The face nearest to each point of a chain; −1 if none."""
    i = start + wp.tid()
    o = owner[i]
    mesh = meshes[o]
    slack = 1.0e-4 * diagonal[o]
    contact = wp.vec3()
    known = int(0)
    for k in range(length):
        at = k * chains + i
        point = points[at]
        # The last point's contact is on the mesh too: no need to look farther than that.
        limit = bound[at]
        if known == 1:
            limit = wp.min(limit, wp.length(point - contact) + slack)
        query = wp.mesh_query_point_no_sign(mesh, point, limit)
        if not query.result:
            query = wp.mesh_query_point_no_sign(mesh, point, wp.length(point) + 2.0 * diagonal[o])
        face[at] = -1
        if query.result:
            face[at] = first_face[o] + query.face
            contact = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
            known = 1


@wp.func
def squared_distance(
    j: int,
    point: wp.vec3,
    normal: wp.vec3,
    centroids: wp.array(dtype=wp.vec3),
    face_normals: wp.array(dtype=wp.vec3),
    areas: wp.array(dtype=float),
):
    """From a point to a face that faces the same way; negative for the others."""
    squared = float(-1.0)
    if areas[j] > 0.0 and wp.dot(face_normals[j], normal) > wp.static(SQUARE):
        r = centroids[j] - point
        squared = wp.dot(r, r)
    return squared


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
            d = squared_distance(offset + j, point, normal, centroids, face_normals, areas)
            if d >= 0.0 and d <= ball * ball:
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
            d = squared_distance(offset + j, point, normal, centroids, face_normals, areas)
            if d > reach:
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
def spread(
    start: int,
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
    """Spread of the normals around each point: see ``normal_spread`` in :mod:`.curvature`."""
    i = start + wp.tid()
    o = owner[i]
    point = points[i]
    normal = normals[i]
    t1 = tangents_1[i]
    t2 = tangents_2[i]
    offset = first_face[o]
    slack = 1.0 + wp.static(SAME_DISTANCE)
    reach = slack * radius * radius
    # Once as a rule; where too few faces are near, with the reach that holds enough of them.
    area = wp.float64(0.0)
    sx = wp.float64(0.0)
    sy = wp.float64(0.0)
    sxx = wp.float64(0.0)
    sxy = wp.float64(0.0)
    syy = wp.float64(0.0)
    count = int(-1)
    while count < min_faces:
        if count >= 0:
            wider = reach_of(
                trees[o], offset, point, normal, centroids, face_normals, areas, min_faces,
                radius, 2.0 * diagonal[o] + wp.length(point),
            )  # fmt: skip
            # As many as there are: no reach holds more.
            min_faces = 0
            reach = wp.max(reach, slack * wider)
        area = wp.float64(0.0)
        sx = wp.float64(0.0)
        sy = wp.float64(0.0)
        sxx = wp.float64(0.0)
        sxy = wp.float64(0.0)
        syy = wp.float64(0.0)
        count = int(0)
        j = int(0)
        query = wp.bvh_query_sphere(trees[o], point, slack * wp.sqrt(reach))
        while wp.bvh_query_next(query, j):
            f = offset + j
            d = squared_distance(f, point, normal, centroids, face_normals, areas)
            if d >= 0.0 and d <= reach:
                # In double precision, so that large moments may be subtracted.
                a = wp.float64(areas[f])
                x = wp.float64(wp.dot(face_normals[f], t1))
                y = wp.float64(wp.dot(face_normals[f], t2))
                area += a
                sx += a * x
                sy += a * y
                sxx += a * x * x
                sxy += a * x * y
                syy += a * y * y
                count += 1
    if area > wp.float64(0.0):
        mx = sx / area
        my = sy / area
        out[i] = wp.vec3(
            float(sxx / area - mx * mx), float(sxy / area - mx * my), float(syy / area - my * my)
        )
