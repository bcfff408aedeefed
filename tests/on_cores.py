"""Commands on a number of cores: compiled code may round its sums otherwise on several."""

import os
import subprocess

import pytest


def run_on_cores(command, count):
    """Runs a command that may use the first so many cores; skips where there are fewer."""
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < count:
        pytest.skip(f"needs {count} cores")
    os.sched_setaffinity(0, cores[:count])  # what is started now has those
    try:
        done = subprocess.run(
            list(map(str, command)), capture_output=True, text=True, timeout=900, check=False
        )
    finally:
        os.sched_setaffinity(0, cores)
    assert done.returncode == 0, done.stderr
