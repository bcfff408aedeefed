"""Closing: guidance, grip, observer, stages and scripted lift, as one controller."""
