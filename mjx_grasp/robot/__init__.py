"""The arm-and-hand description, its MJCF, and its kinematics in JAX."""
