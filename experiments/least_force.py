"""The least force that the contacts of the start states need to hold their objects: a bound.

For each start state a linear programme spreads the object's weight over its three contacts so that
the mean net force per finger is least. Contacts are those of MuJoCo (`condim` 4): a normal force, a
friction inside its cone, a torque about the normal. No controller can hold the object there with
less; one whose fingers end elsewhere, or roll, may.

  python experiments/least_force.py --objects-dir SCANS

Objects without a start state are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from jaxtyping import Float, Int
from rich.console import Console
from scipy.linalg import null_space
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.errors import InputError
from mjx_grasp.grasp.wrench_margin import ContactConfig
from mjx_grasp.handoff.dataset import HandoffSet, load_handoffs
from mjx_grasp.handoff.states import eligible, shipped_handoffs, states_of
from mjx_grasp.objects.catalogue import find_objects
from mjx_grasp.objects.model import ObjectModel, load_objects
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.journal import Journal
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import CommandSettings, Positive, Several, to_record
from mjx_grasp.robot.spec import load_robot

SCHEMA = "mjx_grasp.least_force/1"
_RINGS, _AROUND = np.linspace(0.0, 1.0, 9), 24
"""Shares of the friction, and directions of it, that contact forces are made of."""
_LENGTH = 0.05
"""That torques are divided by, to be of the size of forces [m]"""


@dataclass(frozen=True)
class LeastForceConfig(CommandSettings):
    """Which objects, which friction."""

    objects: tuple[str, ...] = ("eight",)
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    handoffs: Path | None = None
    """handoff set; the shipped one by default. Its states for evaluation are looked at"""
    frictions: Annotated[tuple[Positive, ...], Several(strictly=True)] = (0.8, 0.5)
    """of the contacts [-]"""
    out: Path = Path("experiments/results/least_force.json")


def least_mean_force(
    contact: Float[np.ndarray, "3 3"],
    inward: Float[np.ndarray, "3 3"],
    centre: Float[np.ndarray, " 3"],
    weight: float,
    config: ContactConfig,
) -> float:
    """The least mean net force per finger that holds a weight [N]; +inf where none does.

    At most about 1 % too large: forces are sums of those of a fine fan inside the cone.

    Args:
        contact: Points on the surface; world frame [m].
        inward: Unit normals there, into the object.
        centre: Centre of mass [m].
        weight: Of the object [N].
        config: Friction.
    """
    wrenches, sizes = [], []
    for point, normal in zip(contact, inward, strict=True):
        across = null_space(normal[None]).T
        for share in _RINGS:
            torsion = config.torsion * np.sqrt(1.0 - share**2)
            for angle in np.arange(_AROUND if share else 1) * 2 * np.pi / _AROUND:
                tangent = np.cos(angle) * across[0] + np.sin(angle) * across[1]
                force = normal + config.friction * share * tangent
                for turn in (-torsion, torsion) if torsion else (0.0,):
                    torque = np.cross(point - centre, force) + turn * normal
                    wrenches.append([*force, *(torque / _LENGTH)])
                    sizes.append(np.linalg.norm(force))
    found = linprog(sizes, A_eq=np.transpose(wrenches), b_eq=[0, 0, weight, 0, 0, 0])
    return float(found.fun) / len(contact) if found.status == 0 else float("inf")


def main(config: LeastForceConfig) -> None:
    """Looks at every state."""
    check_writable("--out", config.out)
    path = config.handoffs or shipped_handoffs(config.objects_dir)
    stored = load_handoffs(path, robot=load_robot())
    names, without = eligible([asked.name for asked in find_objects(config.objects)], stored)
    if not names:
        raise InputError("--objects", without, f"some of {', '.join(stored.object_names)}")
    objects = {obj.name: obj for obj in load_objects(names, config.objects_dir)}
    states = states_of(stored, names, "evaluation")
    made, digests = provenance(0), file_digests(handoffs=path)
    journal = Journal(config.out, {"settings": to_record(config)} | digests, made["git"])
    rows: list[dict[str, Any]] = []
    with counting_progress(Console(stderr=True)) as bar:
        job = bar.add_task("start states", total=len(states) * len(config.frictions))
        for friction in config.frictions:
            for k, name in enumerate(names):
                obj, own = objects[name], np.flatnonzero(states.object_index == k)
                forces = journal.once(
                    f"{name} {friction:g}", _forces_of, states, own, obj, friction
                )
                bar.update(job, advance=len(own))
                common = {"object": name, "friction": friction, "mass_kg": obj.mass}
                rows.append(common | {"forces_n": forces})
    record = {
        "schema": SCHEMA,
        "settings": to_record(config),
        "not_eligible": without,
        "sha256": digests,
        "provenance": made,
        "rows": rows,
    }
    write_json(config.out, record)
    journal.close()


def _forces_of(
    states: HandoffSet, own: Int[np.ndarray, " n"], obj: ObjectModel, friction: float
) -> list[float | None]:
    """The least of some states, as the file has it."""
    least = [_least_of(states, state, obj, friction) for state in own]
    return [round(x, 3) if np.isfinite(x) else None for x in least]


def _least_of(states: HandoffSet, state: int, obj: ObjectModel, friction: float) -> float:
    """The least mean force per finger with which a state's targets hold the object [N]."""
    turned = Rotation.from_quat(states.object_quat[state], scalar_first=True)
    centre = states.object_pos[state] + turned.apply(obj.com)
    contact = ContactConfig(friction=friction)
    inward = -states.target_normal[state]
    return least_mean_force(states.target_pos[state], inward, centre, obj.weight, contact)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(LeastForceConfig, description=__doc__)))
