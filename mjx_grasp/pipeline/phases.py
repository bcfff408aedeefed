"""Where a grasp stands, and why it failed."""

from __future__ import annotations

from enum import IntEnum


class Phase(IntEnum):
    """The stages of a grasp in their order, and its failure."""

    REACHING = 0
    """towards the standoffs of the selected contacts"""
    CLOSING = 1
    """from the handoff to lift onset"""
    LIFTING = 2
    """from lift onset to the end of the scripted lift"""
    HOLDING = 3
    """at the top; the grip goes on"""
    FAILED = 4
    """the last targets are kept"""


class Failure(IntEnum):
    """Why a grasp failed; of what the controller itself can know."""

    NONE = 0
    """it has not"""
    NO_CANDIDATE = 1
    """no admissible candidate within the time of reaching"""
    NOT_REACHED = 2
    """out of time and re-selections before the handoff"""
    NO_CONTACT = 3
    """too few fingers felt or told of a contact to begin the lift"""
    DROPPED = 4
    """the object left its place in the palm after lift onset"""
    TIME_OUT = 5
    """of the whole grasp"""
