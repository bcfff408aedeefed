"""Grasp-affordance heatmaps: where to grasp a mesh."""
