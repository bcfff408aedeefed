"""Grasp-affordance heatmaps: contacts, scores, steering (method §1)."""
