"""Grasp-affordance heatmaps: contacts, scores, steering (method §1)."""

from mjx_grasp.heatmap.compute import compute_heatmap, heatmap_of
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.heatmap.steering import Heatmap, steer

__all__ = ["Heatmap", "HeatmapConfig", "compute_heatmap", "heatmap_of", "steer"]
