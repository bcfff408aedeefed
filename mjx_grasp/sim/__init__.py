"""Scenes and the two physics engines behind one interface."""
