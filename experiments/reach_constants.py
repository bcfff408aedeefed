"""Which constants that the publication leaves open make the published controller reach more often.

One at a time is changed from the preset `paper`, on poses of a tuning seed and until 3 s of fine
adjustment. Then those that help are put together, the best first, and each stays if more reaches
converge with it. The best ones and all together are judged by the whole sweep of the ablation, on
its poses; what that has swept already is taken over. A run that was stopped goes on where it was.

  python experiments/reach_constants.py
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from reach_constants_tables import name_of, rate, tried_table
from rich.console import Console
from variations import changed, value_of

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.evaluation.reach.poses import TUNING_SEEDS, CylinderPoses, SweepConfig
from mjx_grasp.evaluation.reach.results import held_up_by
from mjx_grasp.evaluation.reach.run import SweepRun, run_sweep
from mjx_grasp.grasp.config import SelectionConfig
from mjx_grasp.posture.body import robot_body
from mjx_grasp.reaching.config import LimitConfig, ReachConfig
from mjx_grasp.reaching.presets import PRESETS, ReachPreset, for_sweep
from mjx_grasp.records.atomic import check_writable, read_json, write_json
from mjx_grasp.records.journal import Journal
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Seed, WholeNumber, to_record
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.spec import load_robot

SCHEMA = "mjx_grasp.reach_constants/1"
Changes = Mapping[str, Any]
"""Values of fields of `Reaching`, by their paths."""
OPEN: dict[str, tuple[Any, ...]] = {
    "selection.targets.min_goal_height": (0.012,),
    "selection.targets.min_height": (0.03,),
    "reach.limits.clearances.object": (0.005, 0.002),
    "reach.limits.clearances.hand_table": (0.006, 0.002),
    "reach.limits.clearances.arm_table": (0.02,),
    "reach.limits.clearances.fingers": (0.0,),
    "reach.limits.clearances.joint_limits": (0.01,),
    "reach.limits.horizon": (0.2,),
    "reach.fields.speed": (1.0,),
    "reach.fields.slow_down": (0.03,),
    "reach.fields.path_clearance": (0.0,),
    "reach.fields.via_radius": (0.12,),
    "reach.fields.orientation_weight": (0.0003, 0.03),
    "reach.solver.arm_effort": (0.005,),
    "reach.solver.hand_effort": (0.01,),
    "reach.solver.smoothness": (0.001,),
    "reach.solver.iterations": (200,),
    "selection.angle_weight": (0.3,),
    "selection.hysteresis": (0.3,),
    "robot.arm.home": (
        # The wrist turned by 45°.
        (-0.4363323, -0.6981317, 0.6108652, 1.7453293, 0.8726646, 0.5235988, 0.2617994),
    ),
}
"""Values that are tried, by the path of a constant: none of them does the publication give, whose
own are the standoffs, the wraps' spread, the timer's distance, and when a reach has converged."""
_ASKED = ("out", "ablation", "together", "singles")
"""Settings that say which sweeps there are, and nothing of how they come about."""
_KEPT = ("rate_percent", "at_20mm_3s", "failures_percent", "handoff_mm", "limits", "seconds")


@dataclass(frozen=True)
class ConstantsConfig(CommandSettings):
    """How much is swept."""

    out: Path = Path("experiments/results/reach_constants.json")
    """results file to write (.json)"""
    ablation: Path = Path("experiments/results/reach_ablation.json")
    """of whole sweeps: those of the same settings need not be made again"""
    tuning_poses: Count = 256
    tuning_seed: Seed = TUNING_SEEDS[0]
    poses: Count = 2752
    """of whole sweeps"""
    seed: Seed = SweepConfig().seed
    """of their poses"""
    together: Count = 6
    """constants at most that are put together"""
    singles: WholeNumber = 1
    """best ones that are judged by themselves, too"""


@dataclass(frozen=True)
class Reaching:
    """All that has constants."""

    robot: RobotSpec
    reach: ReachConfig
    selection: SelectionConfig

    @property
    def preset(self) -> ReachPreset:
        """The controller's settings."""
        return ReachPreset(self.reach, self.selection, None)


def with_changes(robot: RobotSpec, changes: Changes) -> Reaching:
    """The published controller with other constants."""
    paper = PRESETS["paper"]
    reaching = Reaching(robot, paper.reach, paper.selection)
    for path, value in changes.items():
        reaching = changed(reaching, path, value)
    return reaching


def _as_record(changes: Changes) -> dict[str, Any]:
    """Values by their paths as JSON, which knows no infinity."""
    return {path: to_record(value) for path, value in changes.items()}


def until_3_s(settings: ReachPreset) -> ReachPreset:
    """The ends of a sweep without what comes after 3 s of fine adjustment."""
    return for_sweep(settings, fine_timeout=3.02, timeout=6.0)


def put_together(
    singles: Sequence[Changes], most: int, rate_of: Callable[[Changes], float]
) -> dict[str, Any]:
    """The constants that help, one after the other, the best first; each has to help the others.

    Args:
        singles: One change each.
        most: How many constants are looked at.
        rate_of: How often it reaches with such changes, and without any.
    """
    best: dict[str, Changes] = {}
    for change in sorted(singles, key=rate_of, reverse=True):
        (path,) = change
        if path not in best and rate_of(change) > rate_of({}):
            best[path] = change
    together: dict[str, Any] = {}
    for change in list(best.values())[:most]:
        more = together | dict(change)
        if rate_of(more) > rate_of(together):
            together = more
    return together


def shares(robot: RobotSpec, limits: LimitConfig, run: SweepRun) -> dict[str, Any]:
    """What reaches had come up against in the end, and how often some of the poses are reached.

    Args:
        robot: What reached.
        limits: Of the controller.
        run: The sweep.
    """
    failed = run.classes >= 0
    against = held_up_by(robot_body(robot), limits, run.record)
    ended = {"failed": failed, "converged": ~failed}

    def percent(of: np.ndarray) -> float | None:
        return round(100.0 * float(np.mean(of)), 3) if len(of) else None

    return {
        "against_percent_of": {
            how: {name: percent(by[which]) for name, by in against.items()}
            for how, which in ended.items()
        },
        "at_20mm_3s_percent_of": {
            name: percent(~failed[which]) for name, which in halves(run.poses).items()
        },
    }


def halves(poses: CylinderPoses) -> dict[str, np.ndarray]:
    """Which poses are in one half of what is drawn, by the name of the half."""
    far, y = np.linalg.norm(poses.p_wo[:, :2], axis=1), poses.p_wo[:, 1]
    drawn = {
        ("thin", "thick"): poses.radius,
        ("short", "long"): poses.half_length,
        ("near", "far"): far,
        ("right", "left"): y,
    }
    found = {}
    for (less, more), values in drawn.items():
        found |= {less: values < np.median(values), more: values >= np.median(values)}
    return found


class Sweeps:
    """Sweeps, each made once.

    Args:
        config: The script's settings.
        journal: Where what was swept is kept.
        console: Where progress is shown.
    """

    def __init__(self, config: ConstantsConfig, journal: Journal, console: Console):
        self._config, self._journal, self._console = config, journal, console
        self._robot = load_robot()

    def short(self, changes: Changes) -> dict[str, Any]:
        """Of the tuning poses, until 3 s."""
        config = self._config
        work = partial(self._swept, config.tuning_poses, config.tuning_seed, ends=until_3_s)
        return self._journal.once(f"tuning: {name_of(changes)}", work, changes)

    def whole(self, changes: Changes) -> dict[str, Any]:
        """Of the poses that count."""
        config = self._config
        work = partial(self._swept, config.poses, config.seed, ends=for_sweep)
        known = self._known(changes)
        return known or self._journal.once(f"judged: {name_of(changes)}", work, changes)

    def _swept(self, poses: int, seed: int, changes: Changes, **ends: Any) -> dict[str, Any]:
        reaching = with_changes(self._robot, changes)
        self._console.print(name_of(changes))
        run = run_sweep(
            reaching.robot,
            reaching.preset,
            poses,
            seed,
            bound=False,
            console=self._console,
            **ends,
        )
        kept = {name: run.result[name] for name in _KEPT}
        kept |= shares(reaching.robot, reaching.reach.limits, run)
        return {"changes": _as_record(changes), **kept, "provenance": provenance(seed)}

    def _known(self, changes: Changes) -> dict[str, Any] | None:
        config, reaching = self._config, with_changes(self._robot, changes)
        same = [name for name, preset in PRESETS.items() if preset == reaching.preset]
        if not same or reaching.robot != self._robot or not config.ablation.exists():
            return None
        stored = read_json(config.ablation, "results of the ablation")
        asked = config.poses, config.seed
        if (stored["poses"], stored["provenance"]["seed"]) != asked:
            return None
        row = stored["rows"][same[0]]
        return {"changes": _as_record(changes), **row}


def main(config: ConstantsConfig) -> None:
    """Sweeps what is not there yet, prints what was tried, writes the file."""
    check_writable("--out", config.out)
    made, console = provenance(config.seed), Console(stderr=True)
    settings = to_record(config)
    swept = {name: of for name, of in settings.items() if name not in _ASKED}
    journal = Journal(config.out, {"schema": SCHEMA, "settings": swept}, made["git"])
    sweeps = Sweeps(config, journal, console)
    singles = [{path: value} for path, values in OPEN.items() for value in values]
    with counting_progress(console) as bar:
        tried = [sweeps.short(c) for c in bar.track([{}, *singles], description="constants")]
    combined: dict[str, dict[str, Any]] = {}

    def rate_of(changes: Changes) -> float:
        row = sweeps.short(changes)
        if len(changes) > 1:
            combined[name_of(changes)] = row
        return rate(row)

    together = put_together(singles, config.together, rate_of)
    best = sorted(singles, key=rate_of, reverse=True)[: config.singles]
    asked = {name_of(changes): changes for changes in (together, {}, *best)}
    last, *judged = [sweeps.whole(changes) for changes in asked.values()]
    content = {
        "schema": SCHEMA,
        "settings": settings,
        "tuning_seeds": TUNING_SEEDS,
        "paper": _as_record(
            {path: value_of(with_changes(load_robot(), {}), path) for path in OPEN}
        ),
        "tried": tried,
        "combined": list(combined.values()),
        "judged": [*judged, last],
        "provenance": made,
    }
    write_json(config.out, content)
    journal.close()
    console.print(tried_table(content))


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(ConstantsConfig, description=__doc__)))
