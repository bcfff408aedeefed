"""What other weights in the search for plans would make of an object's start states.

A plan is the cheapest of many postures; what it costs that a finger stays short of its contact,
that a contact lies near an edge, or that contacts ask for much force, are settings. Each variant
makes states of its own, from the same poses, and the shipped policy and a squeeze try them all.
The object is one of the training's. A run that was killed goes on with the variants that it had not
finished.

  python experiments/plan_weights.py --objects-dir SCANS
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import tyro
from compared import Comparison, Runner, contestants_of
from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.handoff.config import HandoffConfig
from mjx_grasp.handoff.dataset import HandoffSet
from mjx_grasp.handoff.reached import ReachedGenerator, reach_settings
from mjx_grasp.learning.controller import load_controller
from mjx_grasp.objects.model import ObjectModel, load_objects
from mjx_grasp.reaching.plan_config import PlanConfig
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.journal import Journal, journaled
from mjx_grasp.records.provenance import file_digests, provenance
from mjx_grasp.records.settings import Count, Positive, Seed, to_record
from mjx_grasp.records.spread import Spread, unspread
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.tasks.config import StartNoise

SCHEMA = "mjx_grasp.plan_weights/1"
VARIANTS: dict[str, dict[str, float]] = {
    "as it is": {},
    "edges three times": {"edge_weight": 3.0},
    "edges ten times": {"edge_weight": 10.0},
    "fingers nearer": {"touch_error": 0.75, "touch_weight": 2.0},
    "force three times": {"hold_weight": 3.0},
    "all of them": {"edge_weight": 2.0, "touch_weight": 2.0, "hold_weight": 3.0},
    "three times the starts": {"starts": 3.0},
}
"""settings of the plan, as factors"""


@dataclass(frozen=True)
class PlanWeightsConfig(Spread):
    """Which object, how many states and trials."""

    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one"""
    object: str = "sugar_box"
    states: Count = 96
    """of each variant"""
    episodes: Count = 192
    """trials of each controller from them"""
    budgets: tuple[Positive, ...] = (3.0, 8.0)
    """force budgets of the policy [N]"""
    squeeze: Positive = 10.0
    """force of the squeeze [N]"""
    seed: Seed = 3
    out: Path = Path("experiments/results/plan_weights.json")


def main(config: PlanWeightsConfig) -> None:
    """Runs what is not there yet."""
    check_writable("--out", config.out)
    made = provenance(config.seed)
    identity = {
        "schema": SCHEMA,
        "settings": to_record(unspread(config)),
        "sha256": file_digests(policy=asset_path("policy.npz")),
    }
    journal = Journal(config.out, identity, made["git"])
    results = journaled(config, _rows, list(VARIANTS.items()), partial(Tried, config), journal)
    variants = {}
    with counting_progress(Console(stderr=True)) as bar:
        for name in bar.track(VARIANTS, description="variants"):
            variants[name] = {"factors": VARIANTS[name], **next(results)}
    write_json(config.out, identity | {"variants": variants, "provenance": made})
    journal.close()


def _rows(tried: Tried, factors: dict[str, float]) -> dict[str, Any]:
    return tried.rows(factors)


class Tried:
    """Makes the states of variants and has them tried.

    Args:
        config: The script's settings.
    """

    def __init__(self, config: PlanWeightsConfig):
        self._config, self._robot = config, load_robot()
        (self._object,) = load_objects((config.object,), config.objects_dir)

    def rows(self, factors: dict[str, float]) -> dict[str, Any]:
        """How many states there are, and what came of the trials of each controller.

        Args:
            factors: On settings of the plan.
        """
        config, robot, obj = self._config, self._robot, self._object
        states = states_with(factors, obj, robot, config)
        policy = load_controller(asset_path("policy.npz"), robot)
        contestants = contestants_of(policy, config.budgets, [config.squeeze])
        found = Comparison({}, contestants, [obj.name], [obj], robot, states)
        runner = Runner(found, config.episodes, config.seed)
        runs = [runner.rows(name, [({"controller": name}, StartNoise())]) for name in contestants]
        return {"states": len(states), "rows": [row for (of,) in runs for row in of]}


def states_with(
    factors: dict[str, float], obj: ObjectModel, robot: RobotSpec, config: PlanWeightsConfig
) -> HandoffSet:
    """Reached states of an object, by plans with other weights.

    Args:
        factors: On settings of the plan.
        obj: The object.
        robot: Arm and hand.
        config: How many, and the seed.
    """
    asked = HandoffConfig(
        out=Path("none.npz"),  # of the command, which is not run
        objects=(config.object,),
        objects_dir=config.objects_dir,
        kind="reached",
        per_object=config.states,
        seed=config.seed,
    )
    settings = reach_settings(asked)
    assert settings.plan is not None
    settings = replace(settings, plan=weighed(settings.plan, factors))
    return ReachedGenerator(robot, asked, settings).generate(obj)[0]


def weighed(plan: PlanConfig, factors: dict[str, float]) -> PlanConfig:
    """A plan's settings, some of them times a factor; `starts` stands for the number of starts."""
    changes: dict[str, Any] = {
        name: factor * getattr(plan, name) for name, factor in factors.items() if name != "starts"
    }
    if "starts" in factors:
        starts = plan.starts
        more = {n: round(factors["starts"] * getattr(starts, n)) for n in ("count", "ranked")}
        changes["starts"] = replace(starts, **more)
    return replace(plan, **changes)


if __name__ == "__main__":
    import plan_weights as script  # by a name under which other processes find it

    run_command(lambda: script.main(tyro.cli(script.PlanWeightsConfig, description=__doc__)))
