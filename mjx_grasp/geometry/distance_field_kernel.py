"""Kernel of NVIDIA Warp for :mod:`.distance_field`: one row of the grid per thread."""

# Types in a kernel are Warp's own.
# mypy: ignore-errors

import warp as wp

# How many radii away the faces of a branch are summed up instead of one by one.
ACCURACY = 2.0
# Over the spacing, for rounding: where no surface can lie between two grid points.
SLACK = 1.1


@wp.kernel
def signed_rows(
    mesh: wp.uint64,
    closed: bool,
    low: wp.vec3,
    spacing: float,
    farthest: float,
    first: int,
    out: wp.array3d(dtype=float),
):
    """Signed distances of rows along z, from the row of index ``first`` along x on."""
    row, j = wp.tid()
    i = first + row
    sign = float(1.0)
    before = float(0.0)
    limit = farthest
    for k in range(out.shape[2]):
        point = low + spacing * wp.vec3(float(i), float(j), float(k))
        found = wp.mesh_query_point_no_sign(mesh, point, limit)
        distance = wp.length(wp.mesh_eval_position(mesh, found.face, found.u, found.v) - point)
        # Between points that are farther from the surface than from each other the sign stays,
        # unless the surface is open.
        if before + distance < wp.static(SLACK) * spacing or k == 0 or not closed:
            reach = wp.static(SLACK) * distance + spacing
            sided = wp.mesh_query_point_sign_winding_number(
                mesh, point, reach, wp.static(ACCURACY), 0.5
            )
            sign = sided.sign
        out[i, j, k] = sign * distance
        before = distance
        # The next one is one spacing farther at most.
        limit = distance + wp.static(SLACK) * spacing
