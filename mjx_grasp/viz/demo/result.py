"""What came of a demo: its phases, its tries, and what `result.json` holds."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mjx_grasp.evaluation.grasps.kept import GraspEnd, Trace
from mjx_grasp.evaluation.grasps.results import GraspRow
from mjx_grasp.geometry import so3
from mjx_grasp.geometry.vectors import turned_back
from mjx_grasp.objects.model import ObjectModel
from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.sim.scene import Scene
from mjx_grasp.viz.demo.place import Steered
from mjx_grasp.viz.demo.plots import Stage

SCHEMA = "mjx_grasp.demo/1"
_ASIDE_MM = 20.0
"""Contacts so much farther from the place than the nearest ones are not what was asked for."""


def stages_of(trace: Trace, dt: float) -> list[Stage]:
    """The phases one after the other.

    Args:
        trace: Of one grasp.
        dt: Control period [s].
    """
    phase = np.asarray(trace.phase)[:, 0]
    starts = np.flatnonzero(np.diff(phase, prepend=-1))
    ends = [*starts[1:].tolist(), len(phase)]
    return [
        Stage(Phase(int(phase[a])).name.lower(), round(a * dt, 3), round(b * dt, 3))
        for a, b in zip(starts.tolist(), ends, strict=True)
    ]


def tries_of(
    stages: list[Stage],
    trace: Trace,
    scene: Scene,
    anchor: Float[np.ndarray, " 3"] | None,
    dt: float,
) -> list[dict[str, float | None]]:
    """When the hand closed, and how far from the place the contacts were that it closed on.

    Args:
        stages: From `stages_of`.
        trace: Of one grasp.
        scene: In which it was.
        anchor: The place, object frame [m]; None of none.
        dt: Control period [s].
    """
    found = []
    for stage in stages:
        if stage.name == Phase.CLOSING.name.lower():
            tick = round(stage.start / dt)
            pose = jnp.asarray(trace.qpos)[tick, 0, scene.addresses.object_qpos]
            contacts = turned_back(so3.quat_to_mat(pose[3:]), trace.contacts[tick, 0] - pose[:3])
            apart = from_anchor(anchor, np.asarray(contacts, np.float64))
            found.append({"start_s": stage.start, "from_anchor_mm": apart})
    return found


def from_anchor(
    anchor: Float[np.ndarray, " 3"] | None, contacts: Float[np.ndarray, "3 3"]
) -> float | None:
    """Mean distance of contacts from the place that was asked for [mm]; None of no place."""
    if anchor is None:
        return None
    return round(1e3 * float(np.linalg.norm(contacts - anchor, axis=1).mean()), 1)


def placed(tries: list[dict[str, float | None]], best_mm: float | None) -> dict[str, Any]:
    """How near to the place the contacts of the last try were, and whether that is as asked.

    Nothing is said of a hand that has not closed, or without a place.

    Args:
        tries: From `tries_of`.
        best_mm: Distance of the contacts with the best score, see `from_anchor` [mm].
    """
    apart = tries[-1]["from_anchor_mm"] if tries else None
    near = None if apart is None or best_mm is None else apart <= best_mm + _ASIDE_MM
    return {"from_anchor_mm": apart, "at_best_mm": best_mm, "as_asked": near}


def result_of(
    obj: ObjectModel,
    steered: Steered,
    row: GraspRow,
    stages: list[Stage],
    tries: list[dict[str, float | None]],
    contacts: Float[np.ndarray, "3 3"],
    end: GraspEnd,
    seconds: dict[str, float],
    made: dict[str, Any],
) -> dict[str, Any]:
    """What `result.json` holds.

    Args:
        obj: The object.
        steered: Where it was to be grasped.
        row: What came of the grasp.
        stages: From `stages_of`.
        tries: From `tries_of`.
        contacts: That the hand closed on last, object frame [m].
        end: Of the grasp.
        seconds: That each step took [s].
        made: Provenance.
    """
    normals = np.asarray(end.state.closing.contacts.normal[0], np.float64)
    return {
        "schema": SCHEMA,
        "object": obj.name,
        "mesh": obj.source,
        "mass_kg": round(obj.mass, 4),
        "asked": steered.source,
        "anchor_m": None if steered.anchor is None else np.round(steered.anchor, 4).tolist(),
        "success": row.outcome == "success",
        "phases": [stage._asdict() for stage in stages],
        "tries": tries,
        "contacts_m": np.round(contacts, 4).tolist(),
        **placed(tries, from_anchor(steered.anchor, steered.best)),
        "normals": np.round(normals, 4).tolist(),
        "grasp": asdict(row),
        "seconds": seconds,
        "provenance": made,
    }
