"""Postures of the whole robot: its body, its surroundings, inverse kinematics, where they start."""
