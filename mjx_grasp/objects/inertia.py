"""Mass, centre of mass and inertia of a mesh of uniform density."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float


def mass_properties(
    mesh: trimesh.Trimesh, mass: float
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Centre of mass (m) and inertia about it (kg m^2, mesh axes) at uniform density.

    Where closed components overlap, the overlap counts twice.

    Args:
        mesh: Closed, wound outwards.
        mass: kg.
    """
    vertices = np.asarray(mesh.vertices)
    middle = vertices.mean(axis=0)  # near the solid: keeps the sums small
    a, b, c = np.moveaxis((vertices - middle)[np.asarray(mesh.faces)], 1, 0)
    sixfold = (a * np.cross(b, c)).sum(axis=1)  # six times the volume of each face's tetrahedron
    volume = sixfold.sum() / 6.0
    total = a + b + c
    com = (sixfold[:, None] * total).sum(axis=0) / (24.0 * volume)
    # Second moments of a tetrahedron with one corner at the origin.
    second = np.einsum("f,fi,fj->ij", sixfold, total, total)
    for corner in (a, b, c):
        second += np.einsum("f,fi,fj->ij", sixfold, corner, corner)
    covariance = second / (120.0 * volume) - np.outer(com, com)
    inertia = mass * (np.trace(covariance) * np.eye(3) - covariance)
    return com + middle, 0.5 * (inertia + inertia.T)
