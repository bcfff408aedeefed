"""Steerable and reactive three-finger dexterous grasping on JAX and MuJoCo MJX.

Importing the package starts no device and prints nothing.
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("mjx_grasp")
except PackageNotFoundError:  # a source tree that is not installed
    __version__ = "0.0.0"

__all__ = ["__version__"]
