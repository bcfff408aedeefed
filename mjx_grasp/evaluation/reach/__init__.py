"""The reach sweep: how often the reaching controller reaches, and how fast (method §3)."""
