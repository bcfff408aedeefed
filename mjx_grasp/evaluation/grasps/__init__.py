"""Whole grasps in simulation, from the home posture to an object that is held up."""
