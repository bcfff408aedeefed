"""Pre-grasp states: sampling, inverse kinematics, the dataset file."""
