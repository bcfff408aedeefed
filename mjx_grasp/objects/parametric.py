"""Parametric stand-ins for all objects of the catalogue, drawn from their published dimensions.

They lie in ``stand_ins.npz``, which ``experiments/stand_ins.py`` makes: of each ``NAME.vertices``
[m] and ``NAME.faces``. Where the published dimensions and the public scans disagree (drill,
airplane, banana, clamp, mustard bottle, soccer ball), the scan's extents are taken. Hollow objects
have inner walls; handles and the parts of tools are closed components that overlap the body.
"""

from __future__ import annotations

import numpy as np
import trimesh

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import InputError


def stand_in(name: str, scale: float = 1.0) -> trimesh.Trimesh:
    """The stand-in of an object in its object frame [m], axis-aligned box centred at the origin.

    Args:
        name: The object's name without a suffix for its scale.
        scale: Uniform scale.

    Raises:
        InputError: There is no stand-in of this name.
    """
    with np.load(asset_path("stand_ins.npz")) as stored:
        if f"{name}.faces" not in stored:
            known = sorted(key.removesuffix(".faces") for key in stored if key.endswith(".faces"))
            raise InputError("object", name, f"one of {', '.join(known)}")
        vertices, faces = stored[f"{name}.vertices"], stored[f"{name}.faces"]
    return trimesh.Trimesh(vertices * scale, faces.astype(np.int64), process=False)
