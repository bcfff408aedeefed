"""Which objects there are scans of."""

from __future__ import annotations

from pathlib import Path

from mjx_grasp.errors import FileError
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.objects.meshes import find_scan


def has_scan(name: str, objects_dir: Path) -> bool:
    """Whether a folder holds a scan of an object of the catalogue."""
    try:
        find_scan(objects_dir, load_catalogue()[name].scan_names)
    except FileError:
        return False
    return True
