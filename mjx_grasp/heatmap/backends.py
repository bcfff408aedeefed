"""Which of the two ways to query meshes is faster, and what both have in common."""

from __future__ import annotations

import jax
from jaxtyping import Array, Float

from mjx_grasp.geometry.curvature import axes_of_spread
from mjx_grasp.heatmap.candidates import Masses, Thumbs
from mjx_grasp.heatmap.config import HeatmapConfig

# Faces up to which a GPU is faster with every face than with building a hierarchy (between 10,000
# and 100,000 on an H200: experiments/results/heatmap_h200.json).
_BRUTE_ON_GPU = 12_000


def backend_for(faces: int, config: HeatmapConfig) -> str:
    """'bvh' or 'brute', for a mesh of so many faces on this device."""
    if config.backend != "auto":
        return config.backend
    platform = jax.default_backend()
    if platform == "cpu":
        return "bvh"
    return "bvh" if platform == "gpu" and faces > _BRUTE_ON_GPU else "brute"


def long_axes(
    masses: Masses,
    thumbs: Thumbs,
    spread: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    config: HeatmapConfig,
) -> Float[Array, "n 3"]:
    """Long axes ℓ at the opposing contacts (method §1, step 2); unit. See `axes_of_spread`.

    Args:
        masses: Of the meshes.
        thumbs: Whose opposing contacts these are.
        spread: Of the normals around each.
        normals: Unit normals there.
        config: Settings.
    """
    return axes_of_spread(
        spread,
        normals,
        masses.axes[thumbs.owner],
        isotropy=config.curvature_isotropy,
        flatness=config.curvature_flatness,
        parallel_angle=config.parallel_angle,
    )
