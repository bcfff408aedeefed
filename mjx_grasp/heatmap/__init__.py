"""Grasp-affordance heatmaps: contacts, scores, steering (method §1)."""

from mjx_grasp.heatmap.compute import compute_heatmap, compute_heatmaps, heatmap_of, heatmaps_of
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.heatmap.steering import Heatmap, steer, steer_many

__all__ = [
    "Heatmap",
    "HeatmapConfig",
    "compute_heatmap",
    "compute_heatmaps",
    "heatmap_of",
    "heatmaps_of",
    "steer",
    "steer_many",
]
