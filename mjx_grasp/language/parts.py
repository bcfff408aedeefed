"""The embedded grounder: named parts of the catalogue, and the sides of the bounding box."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from mjx_grasp.language.grounding import Anchor, GroundingError, Target
from mjx_grasp.objects.catalogue import Part

SIDES: Mapping[str, tuple[float, float, float]] = {
    "top": (0.0, 0.0, 1.0),
    "bottom": (0.0, 0.0, -1.0),
    "left": (-1.0, 0.0, 0.0),
    "right": (1.0, 0.0, 0.0),
    "front": (0.0, -1.0, 0.0),
    "back": (0.0, 1.0, 0.0),
    "middle": (0.0, 0.0, 0.0),
}
"""Directions from the middle of the bounding box, object frame: z up, seen from −y."""

SYNONYMS: Mapping[str, tuple[str, ...]] = {
    "handle": ("grip", "handhold", "haft", "hilt"),
    "rim": ("lip", "brim", "edge", "mouth", "opening"),
    "cap": ("lid", "cover", "stopper", "nozzle", "cork"),
    "neck": ("throat",),
    "stem": ("stalk", "shank"),
    "foot": ("base", "pedestal"),
    "chuck": ("bit",),
    "jaws": ("jaw", "tip", "tips"),
    "wing": ("wings",),
    "tail": ("fin", "rudder"),
    "top": ("upper", "uppermost", "above", "head"),
    "bottom": ("lower", "lowest", "below", "underside", "beneath", "underneath", "base"),
    "left": ("leftmost",),
    "right": ("rightmost",),
    "front": ("foremost",),
    "back": ("rear", "behind", "backside"),
    "middle": ("body", "centre", "center", "waist", "belly", "torso"),
}
"""Other words for parts and sides."""

_NEGATIONS = frozenset(
    [
        "not",
        "no",
        "never",
        "without",
        "avoid",
        "except",
        "nowhere",
        "nothing",
        "neither",
        "nor",
        "away",
        "far",
        "opposite",
        "rather",
        "instead",
        "dont",
        "cannot",
    ]
)
_OTHER_NOTS = re.compile(r"n['’]t\b|\b(?:any|every|all)\w*\s+but\b")


class PartGrounder:
    """Maps an instruction to a named part of the object, or to a side of its bounding box.

    It looks for the words it knows and ignores the others, so "by the handle" and "pick it up at
    the grip, please" mean the same. It never guesses: no known word, two different ones, or a
    negation are errors that say what it knows of the object.
    """

    def ground(self, instruction: str, target: Target) -> Anchor:
        """The centre of the part or side that the instruction names, with a part's size.

        Raises:
            GroundingError: The instruction names none or several that this object has.
        """
        regions = _regions(target)
        words = re.findall(r"[a-z]+", _OTHER_NOTS.sub(" not", instruction.lower()))
        known = f"one of {', '.join(regions)}"
        if _NEGATIONS.intersection(words):
            raise GroundingError(instruction, "a negation", f"where to grasp: {known}")
        named = {name for word in words for name in _meant(word, regions)}
        if not named:
            raise GroundingError(instruction, f"no known part or side of {target.name}", known)
        if len(named) > 1:
            several = " and ".join(name for name in regions if name in named)
            raise GroundingError(instruction, f"{several} at once", known)
        (name,) = named
        kind = "part" if name in target.parts else "side"
        part = regions[name]
        return Anchor(np.array(part.at), f"{kind}: {name}", np.array(part.size))


def _regions(target: Target) -> dict[str, Part]:
    """Parts, then sides, by name. A part hides a side's name."""
    low, high = target.vertices.min(axis=0), target.vertices.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    sides = {name: middle + half * direction for name, direction in SIDES.items()}
    points = {n: Part((float(p[0]), float(p[1]), float(p[2]))) for n, p in sides.items()}
    return {**target.parts, **{n: p for n, p in points.items() if n not in target.parts}}


def _meant(word: str, regions: Mapping[str, Part]) -> set[str]:
    """Regions of this object that a word names; a part's synonym goes before a side's."""
    if word in regions:
        return {word}
    meant = [name for name in regions if word in SYNONYMS.get(name, ())]
    return set(meant[:1])
