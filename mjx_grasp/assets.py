"""Where the shipped data lies: beside the sources in a checkout, inside the package in a wheel."""

from __future__ import annotations

from pathlib import Path

from mjx_grasp.errors import FileError

_PACKAGE = Path(__file__).parent


def asset_path(*parts: str) -> Path:
    """The path of a shipped asset, for example ``asset_path("catalogue.yaml")``.

    Raises:
        FileError: The asset is in neither place.
    """
    candidates = [_PACKAGE / "_assets" / Path(*parts), _PACKAGE.parent / "assets" / Path(*parts)]
    for path in candidates:
        if path.exists():
            return path
    raise FileError(candidates[-1], "no such asset", "an asset shipped with mjx_grasp")
