"""Online three-point selection: which candidate, and its three targets (method §2)."""
