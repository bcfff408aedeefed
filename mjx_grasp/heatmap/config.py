"""Every number of the heatmap, in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from mjx_grasp.records.settings import (
    Count,
    NonNegative,
    Positive,
    Range,
    Settings,
    Several,
    Share,
)

Backend = Literal["auto", "bvh", "brute"]


@dataclass(frozen=True)
class HeatmapConfig(Settings):
    """Settings of the grasp-affordance heatmap (method §1)."""

    edge: Annotated[NonNegative, tyro.conf.arg(prefix_name=False)] = 0.010
    """longest edge: candidates are vertices, so coarse meshes are refined to it; 0 keeps the mesh
    as it is [m]"""
    wrap_offsets: Annotated[tuple[Positive, ...], Several(ascending=True)] = (
        0.005,
        0.010,
        0.015,
        0.020,
        0.025,
    )
    """h, half distances of the wrap seeds along the long axis, ascending; the smallest is for balls
    of which 10 mm is more than the friction cone's share [m]"""
    min_ray_fraction: Share = 1e-4
    """nearest opposing contact, as a share of the mesh's bounding-box diagonal [-]"""
    curvature_radius: Positive = 0.015
    """faces with centroids within this of the opposing contact give the long axis [m]"""
    curvature_min_faces: Count = 12
    """if fewer, the nearest this many [-]"""
    curvature_isotropy: Share = 0.05
    """eigenvalues within this of each other single out no axis [-]"""
    curvature_flatness: Share = 1e-4
    """nor do two below this share of the area [-]"""
    parallel_angle: Annotated[float, Range(0, math.pi / 2)] = 0.1745329
    """10°: a principal axis nearer than this to the normal is passed over [rad]"""
    narrow_sigma: Positive = 0.025
    """S_w: Gaussian tail below the hand's span; wide, for the tips can close on a thin wall [m]"""
    width_sigma: Positive = 0.010
    """S_w: Gaussian tail above it [m]"""
    opposition_width: Positive = 0.5
    """S_t, S_k: scale of the angle to the normal, as a share of the friction cone's [-]"""
    coherence_angle: Positive = 0.5235988
    """S_coh: 30°, scale of the angle between the wrap normals [rad]"""
    com_sigma: Positive = 0.030
    """S_COM: scale of the distance from the centre of mass to the grasp axis [m]"""
    full_separation: Positive = 0.030
    """S_sep: wrap contacts this far apart score 1 [m]"""
    tie_tolerance: NonNegative = 1e-4
    """scores closer than this, relatively, tie: the smaller h is kept [-]"""
    backend: Backend = "auto"
    """how meshes are queried: 'bvh' through NVIDIA Warp's hierarchies, 'brute' over all faces in
    JAX alone; 'auto' takes the faster one: 'bvh' on a CPU, on a GPU only for large meshes"""
    tile: Count | None = None
    """brute: queries worked on at once; memory is proportional to it; as the device likes it if
    None [-]"""


PUBLISHED = HeatmapConfig(wrap_offsets=(0.010, 0.015, 0.020, 0.025), narrow_sigma=0.010)
"""The publication's offsets, and one tail on both sides of the span. The defaults differ so that
small balls and thin walls have candidates (experiments/eligibility.py)."""
