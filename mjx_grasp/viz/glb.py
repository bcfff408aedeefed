"""A coloured mesh as browsers take it."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8


def coloured_glb(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    normals: Float[np.ndarray, "v 3"],
    colours: UInt8[np.ndarray, "v 3"],
) -> bytes:
    """A mesh as binary glTF, dull and seen from both sides.

    Args:
        vertices: In [m].
        faces: Indices of vertices.
        normals: Unit, outwards.
        colours: Of the vertices, as in pictures (sRGB).
    """
    mesh = trimesh.Trimesh(
        vertices, faces, process=False, vertex_normals=normals, vertex_colors=_linear(colours)
    )
    exported = mesh.export(file_type="glb", include_normals=True, tree_postprocessor=_matte)
    assert isinstance(exported, bytes)
    return exported


def _matte(tree: dict[str, Any]) -> None:
    """Gives a glTF tree a dull material: its default is bare metal, which swallows the colours."""
    dull = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
    tree["materials"] = [{"pbrMetallicRoughness": dull, "doubleSided": True}]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0


def _linear(colours: UInt8[np.ndarray, "v 3"]) -> UInt8[np.ndarray, "v 3"]:
    """The colours of glTF, which are linear, from those of pictures, which are not (sRGB)."""
    share: Float[np.ndarray, "v 3"] = colours / 255.0
    low = share <= 0.04045
    linear = np.where(low, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.round(255.0 * linear).astype(np.uint8)
