"""Trials, success, statistics and result files."""
