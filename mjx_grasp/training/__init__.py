"""A training run as a whole: its settings, its folder, what follows it."""
