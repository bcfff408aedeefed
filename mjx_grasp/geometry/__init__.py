"""SO(3) and surface geometry in pure JAX."""
