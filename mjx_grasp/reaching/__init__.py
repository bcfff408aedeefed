"""Reactive reaching: velocity fields, a joint-space QP, and the controller around it (§3)."""
