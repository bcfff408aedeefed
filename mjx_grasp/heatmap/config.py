"""Every number of the heatmap, in one place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from mjx_grasp.errors import InputError

Backend = Literal["auto", "bvh", "brute"]


@dataclass(frozen=True)
class HeatmapConfig:
    """Settings of the grasp-affordance heatmap (method §1)."""

    wrap_offsets: tuple[float, ...] = (0.010, 0.015, 0.020, 0.025)
    """h, half distances of the wrap seeds along the long axis, ascending [m]"""
    min_ray_fraction: float = 1e-4
    """nearest opposing contact, as a share of the mesh's bounding-box diagonal [-]"""
    curvature_radius: float = 0.015
    """faces with centroids within this of the opposing contact give the long axis [m]"""
    curvature_min_faces: int = 12
    """if fewer, the nearest this many [-]"""
    curvature_isotropy: float = 0.05
    """eigenvalues within this of each other single out no axis [-]"""
    curvature_flatness: float = 1e-4
    """nor do two below this share of the area [-]"""
    parallel_angle: float = 0.1745329
    """10°: a principal axis nearer than this to the normal is passed over [rad]"""
    width_sigma: float = 0.010
    """S_w: Gaussian tails outside the hand's span [m]"""
    coherence_angle: float = 0.5235988
    """S_coh: 30°, scale of the angle between the wrap normals [rad]"""
    com_sigma: float = 0.030
    """S_COM: scale of the distance from the centre of mass to the grasp axis [m]"""
    full_separation: float = 0.030
    """S_sep: wrap contacts this far apart score 1 [m]"""
    tie_tolerance: float = 1e-4
    """scores closer than this, relatively, tie: the smaller h is kept [-]"""
    backend: Backend = "auto"
    """how meshes are queried: 'bvh' through NVIDIA Warp's hierarchies, 'brute' over all faces in
    JAX alone; 'auto' takes the faster one: 'bvh' on a CPU, on a GPU only for large meshes"""
    tile: int | None = None
    """brute: queries worked on at once; memory is proportional to it; as the device likes it if
    None [-]"""

    def __post_init__(self):
        offsets = self.wrap_offsets
        if not offsets or min(offsets) <= 0 or tuple(sorted(offsets)) != tuple(offsets):
            raise InputError("wrap_offsets", offsets, "positive lengths in ascending order")
        for name in (
            "curvature_radius",
            "width_sigma",
            "coherence_angle",
            "com_sigma",
            "full_separation",
            "curvature_min_faces",
        ):
            if not getattr(self, name) > 0:
                raise InputError(name, getattr(self, name), "a positive number")
        if self.tile is not None and self.tile < 1:
            raise InputError("tile", self.tile, "a positive number or None")
        if self.backend not in get_args(Backend):
            raise InputError("backend", self.backend, f"one of {', '.join(get_args(Backend))}")
