"""The table of success against force: policy, squeeze and grip from the same states, in one file.

Each condition runs the policy with each budget, the squeeze at each force and the answering grip at
each friction and least force, from the same draws. Native MuJoCo is the reference; `--engine mjx`
gives the training engine's figures for the comparison of both. A file of the same settings and
revision is gone on with. A new policy need not wait for what is known of the others, nor more
budgets for those that the same policy had:

  python experiments/evaluate_controllers.py --objects-dir DIR --out FILE.json
  python experiments/evaluate_controllers.py --objects-dir DIR --policy P.npz --known FILE.json \
    --out NEW.json
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import tyro
from compared import load_comparable
from jaxtyping import Bool
from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.closing.config import REACTING
from mjx_grasp.closing.learned import KEEPING
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.config import EvaluateConfig
from mjx_grasp.evaluation.results import ResultRow, read_results, row_from_record, write_results
from mjx_grasp.evaluation.run import evaluate_beside
from mjx_grasp.evaluation.tables import success_table
from mjx_grasp.evaluation.trials import evenly, incidents, room_for
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.states import shipped_handoffs, with_states
from mjx_grasp.learning.controller import policy_task
from mjx_grasp.learning.policy import Policy
from mjx_grasp.records.journal import Journal, goes_on, journaled
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import (
    Count,
    NonNegative,
    Positive,
    Seed,
    Several,
    added,
    from_record,
    to_record,
)
from mjx_grasp.records.spread import Spread, unspread
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.engines import Engine
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.assemble import TaskConfig, World, build_scene_of, build_world
from mjx_grasp.tasks.config import RobotErrors

CONDITIONS = {
    "nominal": {},
    "offset10": dict(offset_mm=10.0, angle_deg=5.0),
    "offset20": dict(offset_mm=20.0, angle_deg=10.0),
    "friction04": dict(friction=0.4),
    "friction05": dict(friction=0.5),
    "friction11": dict(friction=1.1),
    "light": dict(mass_scale=0.5),
    "heavy": dict(mass_scale=2.0),
    "hard": dict(offset_mm=10.0, friction=0.5),
    "soft": dict(stiffness=(0.5, 0.5)),
    "stiff": dict(stiffness=(2.0, 2.0)),
}
"""By what each differs from ±5 mm at friction 0.8."""
Condition = Literal[
    "nominal", "offset10", "offset20", "friction04", "friction05", "friction11",
    "light", "heavy", "hard", "soft", "stiff",
]  # fmt: skip
_TOGETHER = 4
"""Objects of a job in native MuJoCo: so few that there are enough jobs for many cores, so many that
compiling a controller is the smaller part of one. In MJX a job is of all of them, and of as many
conditions as have room."""
NOISY_TORQUE = RobotErrors(torque_std=0.02, torque_step=0.01, friction=0.3)


@dataclass(frozen=True)
class ComparisonConfig(Spread):
    """Which controllers to compare, on what."""

    out: Path
    objects: tuple[str, ...] = ("eight",)
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    policy: Path | None = None
    """policy file; the shipped one by default"""
    handoffs: Path | None = None
    """handoff set; the shipped one by default"""
    states: Literal["evaluation", "training", "all"] = "evaluation"
    conditions: Annotated[tuple[Condition, ...], Several(once=True)] = ("nominal",)
    """of nominal (object offset ±5 mm, friction 0.8) and what differs from it: offset10 (±10 mm and
    5°), offset20 (±20 mm and 10°), friction04, friction05, friction11, light (half the mass), heavy
    (twice), hard (±10 mm, friction 0.5), soft (half the position gains of the fingers), stiff
    (twice)"""
    noisy_torque: bool = False
    """each of them with torque sensors of a noise of 0.02 N m, in steps of 0.01, and a model of
    joint friction that is off by up to three tenths"""
    with_policy: bool = True
    """whether the policy is among the controllers"""
    force_budgets: tuple[Positive, ...] = (3.0,)
    """that a policy which knows a budget is given, one after the other [N]"""
    keeping_gain: NonNegative = added(KEEPING.gain, absent=0.0)
    """how fast the budget that it is told follows what it spares or spends too much; 0: it is told
    its own, as in its training [1/s]"""
    squeeze_forces: tuple[NonNegative, ...] = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0)
    """commanded forces of the squeeze [N]"""
    squeeze_splits: tuple[Literal["even", "balanced"], ...] = ("even",)
    """how the squeeze shares each of them out"""
    grip_frictions: tuple[Positive, ...] = ()
    """frictions μ₀ that the grip assumes when it answers to load [-]"""
    grip_forces: tuple[Positive, ...] = added((REACTING.force,), absent=(REACTING.force,))
    """with each of these as its least force per finger [N]"""
    own_task: bool = added(False, absent=False)
    """whether squeeze and grip have the lift and times of the policy's task, not today's"""
    known: tuple[Path, ...] = ()
    """earlier comparisons from the same states: their squeezes and grips are not run again, nor
    what they have of the same policy"""
    engine: Engine = "mujoco"
    episodes: Count = 64
    worlds: Count | None = None
    """of a batch; by default 256 in native MuJoCo and 4,096 in MJX [-]"""
    seed: Seed = 1


def asked_controllers(
    base: EvaluateConfig, config: ComparisonConfig, knows_budget: bool
) -> list[EvaluateConfig]:
    """Every controller under one condition.

    Args:
        base: The condition.
        config: Which controllers.
        knows_budget: Whether the policy is given a force budget.
    """
    budgets = config.force_budgets if knows_budget else config.force_budgets[:1]
    alone = replace(base, keeping_gain=0.0)  # who has no budget is the same whatever it is
    return [
        *(replace(base, force_budget=budget) for budget in budgets if config.with_policy),
        *(
            replace(alone, controller="squeeze", squeeze_force=force, squeeze_split=split)
            for split in config.squeeze_splits
            for force in config.squeeze_forces
        ),
        *(
            replace(alone, controller="grip", grip=replace(REACTING, friction=mu, force=force))
            for mu in config.grip_frictions
            for force in config.grip_forces
        ),
    ]


def asked_of(config: ComparisonConfig, knows_budget: bool) -> list[EvaluateConfig]:
    """Every controller under every condition, in the order of the file."""
    return [
        each
        for name in config.conditions
        for each in asked_controllers(under(name, config), config, knows_budget)
    ]


def under(condition: Condition, config: ComparisonConfig) -> EvaluateConfig:
    """An evaluation under one of the conditions."""
    changes: dict[str, Any] = dict(CONDITIONS[condition])
    errors = NOISY_TORQUE if config.noisy_torque else RobotErrors()
    return EvaluateConfig(
        out=config.out,
        engine=config.engine,
        episodes=config.episodes,
        worlds=config.worlds,
        seed=config.seed,
        robot_errors=replace(errors, stiffness=changes.pop("stiffness", errors.stiffness)),
        keeping_gain=config.keeping_gain,
        **changes,
    )


class Known(NamedTuple):
    """What an earlier comparison has that need not be run again."""

    rows: dict[EvaluateConfig, list[ResultRow]]
    """object by object"""
    origin: dict[str, Any]
    """its provenance, what it knew from others, and counts of incidents"""


def what_is_known(
    path: Path, config: ComparisonConfig, names: list[str], sha256: dict[str, str]
) -> Known:
    """What an earlier comparison has of what is asked for.

    Args:
        path: Its file.
        config: What is asked for now.
        names: Objects with start states.
        sha256: Of the policy and the start states.

    Raises:
        InputError: It is the file to write.
        FileError: It is of other states, objects, physics or draws.
    """
    if path.resolve() == config.out.resolve():
        raise InputError("--known", path, "another file than --out")
    stored = read_results(path)
    settings = stored.extra.get("settings")
    if isinstance(settings, dict):  # where it has its rows from does not matter
        settings = {name: value for name, value in settings.items() if name != "known"}
    try:
        earlier = from_record(ComparisonConfig, settings, "settings")
    except InputError as error:
        raise FileError(path, str(error), "a comparison of controllers") from None
    for name in ("objects", "states", "noisy_torque", "own_task", "engine", "episodes", "seed"):
        found, expected = getattr(earlier, name), getattr(config, name)
        if found != expected:
            raise FileError(path, f"{name} {found!r}", f"{expected!r}, as asked for now")
    files = stored.extra.get("sha256", {})
    if files.get("handoffs") != sha256["handoffs"]:
        raise FileError(path, "results from other start states", "those of --handoffs")
    each, same = len(names), replace(earlier, out=config.out, worlds=config.worlds)
    knew_budget = any(row.force_budget_n is not None for row in stored.rows)
    known = {}
    for k, chosen in enumerate(asked_of(same, knew_budget)):
        rows = list(stored.rows[k * each : (k + 1) * each])
        of_policy = chosen.controller == "policy" or config.own_task
        reusable = not of_policy or files.get("policy") == sha256["policy"]
        if reusable and [row.object for row in rows] == names:
            known[chosen] = rows
    more = {key: stored.extra[key] for key in ("known", *incidents(())) if key in stored.extra}
    return Known(known, stored.provenance | more)


def before(
    config: ComparisonConfig, made_of: dict[str, Any]
) -> tuple[list[ResultRow], dict[str, Any], Counter[str]]:
    """What an interrupted comparison has left: rows, provenance, and counts of incidents.

    Results of other settings, or of another revision of the code, are made anew.
    """
    made = provenance(config.seed)
    if not config.out.exists():
        return [], made, Counter()
    kept = read_results(config.out)
    if not goes_on(kept.extra | {"provenance": kept.provenance}, made_of, made["git"]):
        return [], made, Counter()
    counted = Counter({name: int(kept.extra[name]) for name in incidents(()) if name in kept.extra})
    return list(kept.rows), kept.provenance, counted


class _Evaluator(NamedTuple):
    """What every evaluation of a comparison needs."""

    world: World
    names: list[str]
    without: list[str]
    """objects without start states"""
    policy: Policy
    reached: Bool[np.ndarray, " n"]
    task: TaskConfig | None
    """of squeeze and grip, if not today's"""

    def asked(self, config: ComparisonConfig) -> list[EvaluateConfig]:
        """All controllers under all conditions."""
        return asked_of(config, policy_task(self.policy).observation.budget)


def _load(config: ComparisonConfig) -> _Evaluator:
    """Makes a process's evaluator."""
    file = config.policy or asset_path("policy.npz")
    handoffs = config.handoffs or shipped_handoffs(config.objects_dir)
    robot = load_robot()
    policy, stored = load_comparable(file, robot), load_handoffs(handoffs, robot=robot)
    scene = build_scene_of(config.objects, config.objects_dir, robot, SceneConfig())
    names, without, states = with_states(scene.object_names, stored, config.states)
    if not names:
        raise InputError("--objects", config.objects, f"some of {', '.join(stored.object_names)}")
    world = build_world(scene, states, TaskConfig().control_dt)
    task = policy_task(policy) if config.own_task else None
    return _Evaluator(world, names, without, policy, states.reached, task)


class _Job(NamedTuple):
    """A controller under some conditions, on some of the objects."""

    chosen: list[EvaluateConfig]
    """one, or in MJX as many as have room beside each other and share compiled functions"""
    names: list[str]
    room: int
    """conditions for which the batches have room that share these functions"""


def _compiled(one: EvaluateConfig) -> Hashable:
    """What of an evaluation decides which functions are compiled; the rest is drawn."""
    grip = one.squeeze_split, one.grip
    return one.controller, *grip, one.angle_deg > 0, one.robot_errors, one.keeping_gain


def _evaluated(own: _Evaluator, job: _Job) -> list[dict[str, Any]]:
    """Rows of each condition, and incidents, for the journal."""
    policy = own.policy if job.chosen[0].controller == "policy" else None
    quiet = Console(quiet=True)  # the bar is of all of them, and the file counts the incidents
    beside = job.names, job.chosen, policy, own.reached, quiet
    found = evaluate_beside(own.world, *beside, own.task, job.room)
    return [
        {"rows": [asdict(row) for row in rows], "incidents": incidents(trials.values())}
        for rows, trials in found
    ]


def main(config: ComparisonConfig) -> None:
    """Runs the comparison."""
    if not (config.with_policy or config.squeeze_forces or config.grip_frictions):
        raise InputError("--squeeze-forces", "no controller at all", "one controller or more")
    console = Console(stderr=True)
    own = _load(config)
    sha256 = file_digests(
        policy=config.policy or asset_path("policy.npz"),
        handoffs=config.handoffs or shipped_handoffs(config.objects_dir),
    )
    found = [what_is_known(path, config, own.names, sha256) for path in config.known]
    known = {each: rows for part in found for each, rows in part.rows.items()}
    files = {f"known_{k}": path for k, path in enumerate(config.known)}
    made_of = {
        "settings": to_record(unspread(config)),
        "sha256": sha256 | file_digests(**files),
    }
    if found:
        made_of["known"] = [part.origin for part in found]
    rows, made, counted = before(config, made_of)
    asked, finished = own.asked(config), len(rows) // len(own.names)
    together = len(own.names) if config.engine == "mjx" else _TOGETHER
    parts = [own.names[k : k + together] for k in range(0, len(own.names), together)]
    ended: dict[int, tuple[list[ResultRow], dict[str, int]]]
    ended = {k: (known[each], {}) for k, each in enumerate(asked) if each in known}
    # What is beside what does not depend on what is finished: the journal knows it by that.
    alike: dict[Hashable, list[int]] = {}
    for k in range(len(asked)):
        if k not in ended:
            alike.setdefault(_compiled(asked[k]), []).append(k)
    room = room_for(config.engine, config.episodes * len(own.names), config.worlds)
    # One after the other those that share compiled functions: these are kept of one task alone.
    groups, jobs = [], []
    for of_a_kind in alike.values():
        batches = evenly(of_a_kind, room)
        for some in batches:
            if max(some) >= finished:
                groups.append(some)
                chosen, name = [asked[k] for k in some], f"controllers {some}"
                jobs += [
                    (f"{name}, from {of[0]}", _Job(chosen, of, len(batches[0]))) for of in parts
                ]
    setup = (lambda: own) if config.alone else partial(_load, config)
    journal = Journal(config.out, made_of, made["git"])
    results = journaled(
        config, _evaluated, jobs, setup, journal, kind=lambda job: _compiled(job.chosen[0])
    )

    def write() -> None:
        """Writes all whose turn has come: an interrupted comparison keeps what it has."""
        while (k := len(rows) // len(own.names)) in ended:
            more, happened = ended.pop(k)
            rows.extend(more)
            counted.update(happened)
        if rows:
            about = made_of | counted
            robot = load_robot().identity
            write_results(config.out, rows, made, robot, not_eligible=own.without, **about)

    with counting_progress(console) as bar:
        left = sum(map(len, groups))
        job = bar.add_task("controllers", total=len(asked), completed=len(asked) - left)
        write()
        for some in groups:
            for k, *done in zip(some, *islice(results, len(parts)), strict=True):
                records = (record for part in done for record in part["rows"])
                own_rows = [
                    row_from_record(journal.path, number, record, ResultRow)
                    for number, record in enumerate(records)
                ]
                each = [part["incidents"] for part in done]
                ended[k] = own_rows, {what: sum(of[what] for of in each) for what in each[0]}
                bar.update(job, advance=1)
            write()
    journal.close()
    count = len(asked) // len(config.conditions) * len(own.names)
    for k in range(len(config.conditions)):
        of = rows[k * count : (k + 1) * count]
        Console().print(success_table(of, scans=config.objects_dir is not None))


if __name__ == "__main__":
    import evaluate_controllers as script  # by a name under which other processes find it

    run_command(lambda: script.main(tyro.cli(script.ComparisonConfig, description=__doc__)))
