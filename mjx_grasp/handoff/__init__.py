"""Handoff datasets: sampling, inverse kinematics, collision filter, file (method §4)."""
