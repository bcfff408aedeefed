"""What each part of the method contributes to whole grasps: the full system without one thing.

Objects lie at random on the table and are grasped from home in MuJoCo. The full system is
the shipped policy with a force budget on top of planned reaching; every variant leaves out one part
of it, or takes the published one instead, and has the same poses and draws. The selection has no
setting by which it would choose once only: while a plan is followed its candidate stays the best,
and without plans, in `paper-reaching`, it is the published selection of every tick.

What is in the file already, of the same settings, files and revision of the code, is left alone, so
that an interrupted run goes on; `--processes N` shares the parts of the trials.

  python experiments/pipeline_ablation.py --objects-dir SCANS
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import tyro
from pipeline_tables import FULL
from rich.console import Console
from variations import changed

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.closing.config import REACTING, CloserConfig, GripConfig
from mjx_grasp.closing.learned import LearnedPolicy
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.grasps.blocks import Part, joined
from mjx_grasp.evaluation.grasps.config import GraspsConfig, warn_without_gpu
from mjx_grasp.evaluation.grasps.makers import MakeGrasper, Makers, compiled_for
from mjx_grasp.evaluation.grasps.run import loaded_policy
from mjx_grasp.evaluation.grasps.scenario import Scenario, load_scenarios
from mjx_grasp.evaluation.grasps.tables import scenario_table
from mjx_grasp.objects.model import ObjectModel
from mjx_grasp.pipeline.assemble import grasper_of, whole_grasps
from mjx_grasp.pipeline.config import GrasperConfig
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.reaching.approach import Approach
from mjx_grasp.reaching.presets import GATES, ReachPreset
from mjx_grasp.records.atomic import check_writable, read_json, write_json
from mjx_grasp.records.journal import Journal, goes_on, journaled
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import Settings, Several, Suffix, to_record
from mjx_grasp.records.spread import Spread, unspread
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.spec import load_robot

SCHEMA = "mjx_grasp.pipeline_ablation/1"
_NEVER = math.inf
_NO_TORQUE = 1e6  # N m: none of the joints has as much
_PERCENT = 100
_KEPT = ("object", "outcome", "failure", "lifted_s", "force_mean_n")
"""Of a trial's row."""
_ASKED = ("out", "variants", "scenarios")
"""Settings that say which results there are, and nothing of how they come about."""


@dataclass(frozen=True)
class System(Settings):
    """Everything that controls a whole grasp."""

    closing: CloserConfig
    """with the policy that of its training"""
    policy: bool = True
    """whether a policy closes on top of it"""
    budget: float | None = None
    """mean force per finger that the policy may take; None: that of the command [N]"""
    reaching: ReachPreset = field(default_factory=whole_grasps)
    grasper: GrasperConfig = field(default_factory=GrasperConfig)


class Variant(NamedTuple):
    """The full system but for one thing."""

    says: str
    system: Mapping[str, Any] = {}
    """fields of `System`, by their paths"""
    scenario: Mapping[str, Any] = {}
    """fields of `Scenario`: what the controller is told"""


def _squeeze(force: float) -> Variant:
    closing = CloserConfig(grip=GripConfig(force=force))
    return Variant(f"a squeeze of {force:g} N closes", {"closing": closing, "policy": False})


VARIANTS = {
    FULL: Variant("the full system"),
    "observer-alone": Variant("no touch flags, the observer alone", scenario={"told": False}),
    "weight-unknown": Variant(
        "the grip does not begin with the force for the known weight, nor has the policy less of "
        "its budget for light objects",
        scenario={"weighed": False},
    ),
    "budgets-alike": Variant(
        "the policy has the same budget for light objects", {"grasper.budget_per_weight": 0.0}
    ),
    "walls-alike": Variant(
        "thin walls are gripped no harder than all else", {"grasper.across_walls": 0.0}
    ),
    "grip": Variant(
        "the grip that answers to load closes, no policy",
        {"closing": CloserConfig(grip=REACTING), "policy": False},
    ),
    "budget-3": Variant("the policy has a budget of 3 N", {"budget": 3.0}),
    "squeeze-3": _squeeze(3.0),
    "squeeze-5": _squeeze(5.0),
    "paper-reaching": Variant(
        "reaching as published, without plans", {"reaching": whole_grasps("paper")}
    ),
    "no-guide": Variant(
        "plans choose the contacts and do not guide the hand",
        {"reaching.reach.guide.enabled": False},
    ),
    "no-look-ahead": Variant(
        "plans do not look ahead to closing and lift",
        {
            "reaching.plan.lift_error": _NEVER,
            "reaching.plan.touch_error": _NEVER,
            "reaching.plan.pad_weight": 0.0,
        },
    ),
    "no-statics": Variant(
        "plans do not look at what the contacts and the thumb can hold",
        {
            "reaching.plan.hold_weight": 0.0,
            "reaching.plan.lever_weight": 0.0,
            "reaching.plan.edge_weight": 0.0,
            "reaching.plan.press_weight": 0.0,
            "reaching.plan.heavier": _NEVER,
            "reaching.plan.must_hold": _NEVER,
        },
    ),
    "sideways": Variant(
        "plans come in sideways, also to walls that turn round",
        {"reaching.plan.way_out": 0.0},
    ),
    "paper-gate": Variant(
        "handoff as published, by the midpoint alone",
        {"reaching.reach.controller.gate": GATES["paper"]},
    ),
    "no-new-plans": Variant(
        "no new plans while the hand reaches", {"reaching.reach.controller.replan_moved": _NEVER}
    ),
    "no-follow": Variant(
        "reaching takes the object to be at rest",
        {"reaching.reach.limits.follow_object": False},
    ),
    "one-try": Variant(
        "no other plan after a stall or a time-out, no second grasp",
        {"reaching.reach.controller.reselections": 0, "grasper.retries": 0},
    ),
    "no-return": Variant(
        "closing goes on where the object has moved away", {"grasper.lost": _NEVER}
    ),
    "flags-alone": Variant(
        "no observer, touch flags alone", {"closing.observer.contact_torque": _NO_TORQUE}
    ),
}


@dataclass(frozen=True, kw_only=True)
class PipelineAblationConfig(GraspsConfig, Spread):
    """What to leave out, and under which circumstances."""

    out: Annotated[Path, Suffix((".json",))] = Path("experiments/results/pipeline_ablation.json")
    """results file (.json); one that an interrupted run left is gone on with"""
    variants: Annotated[tuple[str, ...], Several()] = ("all",)
    """by name, or all of them"""
    scenarios: tuple[str, ...] = ("nominal", "moved_before_closing", "noisy_pose")


def chosen(names: Sequence[str]) -> list[str]:
    """Names of variants, in their own order.

    Raises:
        InputError: There is no such variant.
    """
    for name in names:
        if name not in ("all", *VARIANTS):
            raise InputError("--variants", name, f"all, or some of {', '.join(VARIANTS)}")
    return [name for name in VARIANTS if name in names or "all" in names]


def system_of(variant: Variant, closing: CloserConfig) -> System:
    """What controls in a variant.

    Args:
        variant: The full system but for one thing.
        closing: The policy's.
    """
    system = System(closing)
    for path, value in variant.system.items():
        system = changed(system, path, value)
    return system


def maker(system: System, policy: LearnedPolicy) -> MakeGrasper:
    """What makes the controller of a system."""
    given = policy if system.budget is None else replace(policy, budget=system.budget)

    def make(robot: RobotSpec, approach: Approach) -> Grasper:
        reaching = system.reaching
        if reaching.plan is not None:
            reaching = changed(reaching, "plan.approach", approach)
        learned = given if system.policy else None
        return grasper_of(robot, system.closing, learned, reaching, system.grasper)

    return make


def about(variant: Variant, scenario: Scenario, objects: Sequence[ObjectModel]) -> dict[str, Any]:
    """What decides a result beside what all in the file share."""
    changes = {k: to_record(v) for k, v in {**variant.system, **variant.scenario}.items()}
    meshes = {obj.name: obj.content_hash for obj in objects}
    return {"changes": changes, "settings": to_record(scenario), "meshes": meshes}


def kept(path: Path, header: dict[str, Any], git: str, console: Console) -> dict[str, Any]:
    """What a run with the same settings, files and revision has finished, by variant and scenario.

    Raises:
        FileError: The file is another one's.
    """
    if not path.exists():
        return {}
    before = read_json(path, "results of this script")
    if before.get("schema") != SCHEMA:
        raise FileError(path, f"schema {before.get('schema')!r}", f"none, or {SCHEMA}")
    if not goes_on(before, header, git):
        console.print(f"{path}: of other settings, files or code; begun anew")
        return {}
    return before["results"]


class Systems:
    """What runs the variants: their controllers, and what their runs share.

    Args:
        config: Which variants, with what.
        progress: Told which share of a run is done.

    Raises:
        InputError, FileError: A variant that there is not, or a robot or policy that cannot be had.
    """

    def __init__(
        self,
        config: PipelineAblationConfig,
        progress: Callable[[float], None] = lambda share: None,
    ):
        robot = load_robot(config.robot)
        self.file = config.policy or asset_path("policy.npz")
        closing, policy = loaded_policy(robot, self.file, config.force_budget)
        self.of = {name: system_of(VARIANTS[name], closing) for name in chosen(config.variants)}
        self.makers, self._progress = Makers(config, robot), progress
        self._make = {system: maker(system, policy) for system in self.of.values()}

    def check(self, name: str, scenario: Scenario) -> None:
        """Refuses a run before anything long starts.

        Raises:
            InputError: The variant cannot do it, or the objects cannot be had.
        """
        if self.of[name].reaching.plan is None and scenario.approach != "any":
            free = f"one without an approach: {name} does not plan"
            raise InputError("--scenarios", scenario.approach, free)
        self.makers.objects(scenario)

    def kind(self, name: str, scenario: Scenario) -> Hashable:
        """What decides which functions are compiled for a variant."""
        return self._make[self.of[name]], compiled_for(scenario)

    def part(self, job: tuple[str, list[Scenario], Part]) -> list[dict[str, Any]]:
        """A part of the trials under each of some scenarios, of a variant or its like."""
        name, scenarios, part = job
        return self.makers.part(scenarios, self._make[self.of[name]], part, self._progress)


def _first(job: tuple[str, list[Scenario], Part]) -> tuple[str, Scenario]:
    name, (scenario, *_), _ = job
    return name, scenario


def main(config: PipelineAblationConfig) -> None:
    """Runs what is not there yet."""
    check_writable("--out", config.out)
    scenarios, made = load_scenarios(config.scenarios), provenance(config.seed)
    console = Console(stderr=True)
    warn_without_gpu(config.engine, console)
    with counting_progress(console) as bar:
        one = bar.add_task("", total=_PERCENT, visible=config.alone)
        systems = Systems(config, lambda share: bar.update(one, completed=round(_PERCENT * share)))
        given = {
            (name, at): replace(scenario, **VARIANTS[name].scenario)
            for at, scenario in scenarios.items()
            for name in systems.of
        }
        for (name, _), scenario in given.items():
            systems.check(name, scenario)
        asked = {k: v for k, v in to_record(unspread(config)).items() if k not in _ASKED}
        header = {"schema": SCHEMA, "config": asked, "sha256": file_digests(policy=systems.file)}
        header |= {"device": jax.default_backend()}
        results = kept(config.out, header, made["git"], console)
        by = {
            (name, at): about(VARIANTS[name], scenario, systems.makers.objects(scenario))
            for (name, at), scenario in given.items()
        }

        def is_done(name: str, at: str) -> bool:
            found = results.get(name, {}).get(at, {})
            return all(found.get(what) == value for what, value in by[name, at].items())

        parts, left = systems.makers.parts(), [pair for pair in given if not is_done(*pair)]
        batches = systems.makers.batches(left, lambda pair: systems.kind(pair[0], given[pair]))
        jobs = [
            (
                json.dumps([[*pair, by[pair]] for pair in pairs] + [part]),
                (pairs[0][0], [given[pair] for pair in pairs], part),
            )
            for pairs in batches
            for part in parts
        ]
        journal = Journal(config.out, header, made["git"])
        runs = bar.add_task("parts of the trials", total=len(given) * len(parts))
        bar.update(runs, completed=(len(given) - len(left)) * len(parts))
        setup = (lambda: systems) if config.alone else partial(Systems, config)
        done = journaled(
            config, Systems.part, jobs, setup, journal, kind=lambda job: systems.kind(*_first(job))
        )
        for pairs in batches:
            found = []
            for _ in parts:
                bar.reset(one, description="; ".join(", ".join(pair) for pair in pairs))
                found.append(next(done))
                bar.update(runs, advance=len(pairs))
            for (name, at), own in zip(pairs, zip(*found, strict=True), strict=True):
                whole = by[name, at] | joined(own)
                whole["rows"] = [{of: row[of] for of in _KEPT} for row in whole["rows"]]
                results.setdefault(name, {})[at] = whole
            ordered = {name: results[name] for name in VARIANTS if name in results}
            says = {name: VARIANTS[name].says for name in ordered}
            content = header | {"variants": says, "results": ordered, "provenance": made}
            write_json(config.out, content)
    journal.close()
    table = {f"{n}, {at}": results[n][at] for n in systems.of for at in scenarios}
    Console().print(scenario_table(table))
    console.print(f"written: {config.out}")


if __name__ == "__main__":
    import pipeline_ablation as script  # by a name under which other processes find it

    run_command(lambda: script.main(tyro.cli(script.PipelineAblationConfig, description=__doc__)))
