"""Pictures for the READMEs, small enough to be kept in the repository."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from mjx_grasp.errors import InputError
from mjx_grasp.records.atomic import replacing

_TONE_STEPS = (1, 2, 3, 4, 6, 8)  # of 255; 4 is not seen on shaded surfaces


def write_png(path: str | Path, sheet: Image.Image, max_bytes: int) -> None:
    """Writes a sheet as PNG, all or nothing; with fewer tones where it would be too large.

    Raises:
        InputError: It is larger than asked for even with the fewest tones.
    """
    tones = np.asarray(sheet)
    with replacing(path) as temporary:
        for step in _TONE_STEPS:
            coarse = np.where(tones == 255, 255, np.round(tones / step) * step).clip(0, 255)
            Image.fromarray(coarse.astype(np.uint8)).save(temporary, optimize=True)
            size = temporary.stat().st_size
            if size <= max_bytes:
                return
        raise InputError("max_bytes", max_bytes, f"at least {size} bytes: fewer or smaller cells")
