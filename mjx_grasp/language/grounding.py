"""What every grounder takes and gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8

from mjx_grasp.errors import MjxGraspError
from mjx_grasp.language.camera import PinholeCamera
from mjx_grasp.objects.catalogue import Part


class GroundingError(MjxGraspError, ValueError):
    """An instruction, an answer or a picture that leads to no point on the object.

    Args:
        instruction: What was asked for.
        found: What came of it.
        expected: What would have worked.
    """

    def __init__(self, instruction: str, found: str, expected: str):
        self.instruction, self.found, self.expected = instruction, found, expected
        super().__init__(f"instruction: found {instruction!r}, {found}; expected {expected}")


@dataclass(frozen=True, eq=False)
class View:
    """What a camera sees of the object."""

    image: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    """Along the optical axis [m]; 0, negative or not finite where it was not measured."""
    camera: PinholeCamera
    R_wo: Float[np.ndarray, "3 3"]
    """Object's orientation in the world."""
    p_wo: Float[np.ndarray, " 3"]
    """Object's origin in the world [m]."""


@dataclass(frozen=True, eq=False)
class Target:
    """The object that instructions are about. Lengths in [m], object frame."""

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    parts: Mapping[str, Part] = field(default_factory=dict)
    """Named parts."""
    view: View | None = None
    """For grounders that look."""


@dataclass(frozen=True, eq=False)
class Anchor:
    """A point on or near the object that steers the heatmap."""

    point: Float[np.ndarray, " 3"]
    """Object frame [m]."""
    source: str
    """Where it comes from, in words: a part, a side, a pixel."""
    size: Float[np.ndarray, " 3"] = field(default_factory=lambda: np.zeros(3))
    """Edges of the box around it that a part fills, along the object's axes [m]; 0 of a point."""


class Grounder(Protocol):
    """Anything that finds the anchor that an instruction means."""

    def ground(self, instruction: str, target: Target) -> Anchor:
        """The anchor in the object frame.

        Raises:
            GroundingError: The instruction leads to no point on the object.
        """
        ...


def target_of(name: str, mesh: trimesh.Trimesh, parts: Mapping[str, Part] | None = None) -> Target:
    """A mesh as a target, with its parts moved to the frame of the mesh, wherever its origin lies.

    Args:
        name: Of the object.
        mesh: In [m].
        parts: Named parts relative to the centre of the bounding box [m], as the catalogue and
            `parts_of` have them.
    """
    centre = np.asarray(mesh.bounds, np.float64).mean(axis=0)
    x, y, z = (float(c) for c in centre)
    moved = {
        name: part._replace(at=(part.at[0] + x, part.at[1] + y, part.at[2] + z))
        for name, part in (parts or {}).items()
    }
    return Target(name, np.asarray(mesh.vertices), np.asarray(mesh.faces), moved)
