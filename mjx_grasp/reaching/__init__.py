"""Reactive reaching: velocity fields, a joint-space QP, and the controller around it (method §3)."""
