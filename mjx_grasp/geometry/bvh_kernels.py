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
    face: wp.array(dtype=int),
):
    """The face nearest to each point, sought within a bound first; −1 if none."""
    i = start + wp.tid()
    o = owner[i]
    query = wp.mesh_query_point_no_sign(meshes[o], points[i], bound[i])
    if not query.result:
        query = wp.mesh_query_point_no_sign(
            meshes[o], points[i], wp.length(points[i]) + 2.0 * diagonal[o]
        )
    face[i] = -1
    if query.result:
        face[i] = first_face[o] + query.face


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
    # Widened until enough faces are inside; the second round takes no more than are needed.
    ball = radius
    search = int(1)
    while search == 1:
        count = int(0)
        j = int(0)
        query = wp.bvh_query_sphere(trees[o], point, slack * ball)
        while wp.bvh_query_next(query, j):
            d = squared_distance(offset + j, point, normal, centroids, face_normals, areas)
            if d >= 0.0 and d <= slack * ball * ball:
                count += 1
        if count >= min_faces or ball > wp.length(point) + 2.0 * diagonal[o]:
            search = 0
        else:
            ball = 2.0 * ball
    if ball > radius:
        count = int(0)
        more = int(1)
        while count < min_faces and more == 1:
            nearer = float(-1.0)
            count = int(0)
            j = int(0)
            query = wp.bvh_query_sphere(trees[o], point, slack * ball)
            while wp.bvh_query_next(query, j):
                d = squared_distance(offset + j, point, normal, centroids, face_normals, areas)
                if d >= 0.0:
                    if d <= reach:
                        count += 1
                    elif nearer < 0.0 or d < nearer:
                        nearer = d
            if count < min_faces:
                if nearer < 0.0:
                    more = 0
                else:
                    reach = slack * nearer

    # In double precision, so that large moments may be subtracted.
    area = wp.float64(0.0)
    sx = wp.float64(0.0)
    sy = wp.float64(0.0)
    sxx = wp.float64(0.0)
    sxy = wp.float64(0.0)
    syy = wp.float64(0.0)
    j = int(0)
    query = wp.bvh_query_sphere(trees[o], point, slack * wp.sqrt(reach))
    while wp.bvh_query_next(query, j):
        f = offset + j
        d = squared_distance(f, point, normal, centroids, face_normals, areas)
        if d >= 0.0 and d <= reach:
            a = wp.float64(areas[f])
            x = wp.float64(wp.dot(face_normals[f], t1))
            y = wp.float64(wp.dot(face_normals[f], t2))
            area += a
            sx += a * x
            sy += a * y
            sxx += a * x * x
            sxy += a * x * y
            syy += a * y * y
    if area > wp.float64(0.0):
        mx = sx / area
        my = sy / area
        out[i] = wp.vec3(
            float(sxx / area - mx * mx), float(sxy / area - mx * my), float(syy / area - my * my)
        )
