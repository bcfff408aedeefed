"""A signed-distance grid of a mesh, built once per object, from exact point–triangle distances.

The sign comes from the generalised winding number (Jacobson et al. 2013), which needs no watertight
surface and takes overlapping parts for their union. Both from NVIDIA Warp's hierarchy of the faces,
on CPUs and CUDA GPUs.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.geometry.mesh import is_closed
from mjx_grasp.geometry.signed_distance import DistanceField
from mjx_grasp.records.provenance import usable_cores

BORDER_M = 0.03
"""How far grids reach beyond their mesh [m]."""


def distance_field(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    spacing: float = 0.0015,
    border: float = BORDER_M,
) -> DistanceField:
    """Samples the signed distance to a mesh on a regular grid around it.

    Args:
        vertices: In the object frame, [m].
        faces: Indices, wound so that normals point outwards.
        spacing: Between grid points, [m]. The interpolation is off by up to half of it where
            surfaces meet at an edge or the nearest one changes; scan by scan in
            experiments/results/signed_distance_scans.json.
        border: How far the grid reaches beyond the mesh, [m].

    Raises:
        InputError: No face with an area, or lengths that make no grid.
    """
    vertices = np.asarray(vertices, np.float64)
    if not 0 < spacing < np.ptp(vertices, axis=0).max() or border < spacing:
        raise InputError("spacing, border", (spacing, border), "0 < spacing <= border, in m")
    low = vertices.min(axis=0) - border
    shape = np.ceil((vertices.max(axis=0) + border - low) / spacing).astype(int) + 1
    return _sampled(vertices, np.asarray(faces), low, shape, spacing)


def distance_cube(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    points: int = 64,
) -> DistanceField:
    """The same on a cube of so many points, for all meshes alike: one compiled program serves all.

    It reaches at least `BORDER_M` beyond the mesh.

    Args:
        vertices: In the object frame, [m].
        faces: Indices, wound so that normals point outwards.
        points: Along each edge; their spacing is as wide as the longest side of the mesh needs.

    Raises:
        InputError: No face with an area, or fewer than two points.
    """
    if points < 2:
        raise InputError("points", points, "two or more")
    vertices = np.asarray(vertices, np.float64)
    low, high = vertices.min(axis=0) - BORDER_M, vertices.max(axis=0) + BORDER_M
    size = float((high - low).max())
    shape = np.full(3, points)
    return _sampled(
        vertices, np.asarray(faces), 0.5 * (low + high - size), shape, size / (points - 1)
    )


def _sampled(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    low: Float[np.ndarray, " 3"],
    shape: Int[np.ndarray, " 3"],
    spacing: float,
) -> DistanceField:
    """The distances on a grid from its first point on."""
    # Warp takes half a second to import.
    import warp as wp

    from mjx_grasp.geometry import distance_field_kernel
    from mjx_grasp.geometry.warp_device import device, in_threads, launch, load, put

    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if not normals.any():
        raise InputError("faces", f"{len(faces)} without an area", "at least one with an area")
    farthest = 2.0 * float(np.linalg.norm(shape * spacing))
    load(distance_field_kernel)
    mesh = wp.Mesh(
        put(vertices, wp.vec3),
        put(faces.astype(np.int32).ravel(), wp.int32),
        support_winding_number=True,
    )
    values = wp.empty(tuple(shape), dtype=wp.float32, device=device())
    known = [mesh.id, is_closed(faces, vertices), wp.vec3(*low), spacing, farthest]

    def rows(part: np.ndarray) -> None:
        inputs = [*known, int(part[0]), values]
        launch(distance_field_kernel.signed_rows, (len(part), int(shape[1])), inputs)

    # More parts than cores, for some have more surface than others.
    parts = min(8 * usable_cores(), shape[0]) if device().is_cpu else 1
    in_threads(rows, np.array_split(np.arange(shape[0]), parts))
    f32 = jnp.float32
    return DistanceField(jnp.asarray(values.numpy()), jnp.asarray(low, f32), f32(spacing))
