"""What follows a training is of the training's own condition and task."""

import io
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import handmade
import numpy as np
import pytest
from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.closing.config import REACTING, GripConfig
from mjx_grasp.evaluation.conditions import read_groups
from mjx_grasp.evaluation.config import EvaluateConfig
from mjx_grasp.evaluation.results import read_results
from mjx_grasp.evaluation.run import evaluate, summarise
from mjx_grasp.evaluation.trials import Trials
from mjx_grasp.evaluation.verdict import verdict
from mjx_grasp.learning.controller import deployed_task
from mjx_grasp.learning.policy import load_policy
from mjx_grasp.sim.scene import SceneConfig
from mjx_grasp.tasks.assemble import World
from mjx_grasp.tasks.config import ClosingTaskConfig, RewardConfig, StartNoise
from mjx_grasp.training import after
from mjx_grasp.training.after import baselines, condition
from mjx_grasp.training.config import preset_config


class Asked(Exception):
    """What was asked for: the settings and noise of a task, or a scene."""


class Recorder(World):
    def __init__(self):
        pass

    def task(self, engine, worlds, task, noise, **settings):
        raise Asked(task, noise)


def test_the_evaluation_has_the_condition_of_the_training():
    noise = StartNoise(offset_m=0.002, angle_rad=0.1, friction=(0.4, 0.6))
    config = replace(preset_config("cpu"), noise=noise, seed=7)
    asked = condition(config, Path("results.json"))
    assert asked.noise.offset_m == pytest.approx(noise.offset_m)
    assert asked.noise.angle_rad == pytest.approx(noise.angle_rad)
    assert asked.noise.friction == pytest.approx((0.4, 0.6))
    assert asked.seed == 8 and asked.episodes == config.evaluation_episodes


def test_fixed_fingers_and_coarse_steps_are_for_the_training_alone(
    monkeypatch, tmp_path, scene, starts
):
    config = preset_config("cpu")
    assert config.scene.fix_idle_fingers and not preset_config("paper").scene.fix_idle_fingers
    (tmp_path / "policy.npz").write_bytes(asset_path("policy.npz").read_bytes())

    def asked(objects, robot, scene):
        raise Asked(objects, robot.name, scene)

    monkeypatch.setattr(after, "build_scene", asked)
    states = handmade.handoffs(scene.objects)
    with pytest.raises(Asked) as evaluation:
        after.evaluate_run(tmp_path, config, World(scene, starts), states, Console(quiet=True))
    exact = SceneConfig().physics_dt
    assert config.scene.physics_dt > exact
    moving = replace(config.scene, fix_idle_fingers=False, physics_dt=exact)
    assert evaluation.value.args == (scene.objects, "rizon4_hx5d20", moving)


def test_the_policy_that_a_training_began_with_is_evaluated_beside_it(
    monkeypatch, tmp_path, scene, starts
):
    """With the same budgets, under a name of its own."""
    config = replace(preset_config("cpu"), start_from="shipped")
    (tmp_path / "policy.npz").write_bytes(asset_path("policy.npz").read_bytes())
    asked = []

    def evaluated(world, names, chosen, policy, *_):
        asked.append(policy)
        no, zeros = np.zeros(2, bool), np.zeros(2, np.int32)
        forces = [np.array([2.0, 3.0])] * 5
        trials = Trials(zeros, ~no, no, no, no, no, zeros, *forces)
        task = deployed_task(policy, chosen.keeping_gain) if policy else config.task
        return [summarise("box", trials, chosen, np.zeros(9, bool), task)], {}

    for name, instead in (
        ("build_scene", lambda *_: scene),
        ("evaluate", evaluated),
        ("best_grasp", lambda *_: None),
        ("save_trajectory", lambda *_: None),
    ):
        monkeypatch.setattr(after, name, instead)
    states = handmade.handoffs(scene.objects)
    console = Console(record=True, file=io.StringIO(), width=200)
    after.evaluate_run(tmp_path, config, World(scene, starts), states, console)
    rows = read_results(tmp_path / "results.json").rows
    assert [(r.label, r.force_budget_n) for r in rows if r.controller == "policy"] == [
        (name, budget) for name in (None, after.BEGAN_WITH) for budget in after.FORCE_BUDGETS_N
    ]
    assert all(row.label is None for row in rows if row.controller != "policy")
    assert sum(policy is not None for policy in asked) == 2 * len(after.FORCE_BUDGETS_N)
    (said,) = verdict(read_groups([tmp_path / "results.json"]))
    way = "100.0 → 100.0 % at 2.5 N"
    assert f"Training did not change success beyond its 95 % interval ({way}, {way}); at" in said
    assert said in " ".join(console.export_text().split())


@pytest.mark.parametrize(("lifted", "shown"), [((), 0), ((5,), 5), ((3, 6), 3)])
def test_the_episode_that_is_shown_is_a_successful_one_if_there_is_any(
    monkeypatch, scene, starts, lifted, shown
):
    trials = SimpleNamespace(success=np.isin(np.arange(8), lifted))
    of_episode = np.broadcast_to(np.arange(8.0)[:, None], (2, 8, scene.model.nq))
    monkeypatch.setattr(World, "task", lambda *_, **__: None)
    monkeypatch.setattr(after, "record_trials", lambda *_: (trials, of_episode))
    policy = load_policy(asset_path("policy.npz"))
    world = World(scene, starts)
    found = after.best_grasp(world, scene.object_names[0], policy, StartNoise(), seed=0)
    np.testing.assert_array_equal(found.qpos, np.full((2, scene.model.nq), float(shown)))


@pytest.mark.parametrize(
    ("untrained", "forces"), [(1.0, [1, 3, 5, 8]), (5.0, [3, 5, 8]), (0.0, [0, 3, 5, 8])]
)
def test_the_untrained_policy_is_among_the_baselines_once(untrained, forces):
    base = EvaluateConfig(out=Path("x.json"), offset_mm=2.0)
    found = baselines(base, ClosingTaskConfig(grip=GripConfig(force=untrained)))
    assert [c.squeeze_force for c in found] == forces
    assert {c.controller for c in found} == {"squeeze"}
    assert {c.offset_mm for c in found} == {2.0}


def test_a_squeeze_beside_a_policy_is_in_its_task():
    """But for the rewards, which no evaluation reads, and its force, which each start brings.

    Tasks that pay or press otherwise share a program.
    """
    task = preset_config("paper").task
    assert task.lift.delay_s == 0.0 and not task.grip.together
    config = EvaluateConfig(out=Path("x.json"), controller="squeeze", squeeze_force=4.0)
    with pytest.raises(Asked) as asked:
        evaluate(Recorder(), ["apple"], config, None, np.zeros(9, bool), Console(), task)
    own = replace(task, reward=RewardConfig(reach=0.0))
    assert asked.value.args == (own, config.noise)


def test_beside_a_policy_a_squeeze_is_plain_and_a_grip_its_own():
    """In the policy's lift and times, whatever its own grip is."""
    paper = preset_config("paper").task
    task = replace(paper, grip=replace(REACTING, ramp_s=0.3))
    out = Path("x.json")
    squeeze = EvaluateConfig(out, "squeeze", squeeze_force=4.0, squeeze_split="balanced")
    plain = GripConfig(split="balanced", ramp_s=0.3)
    grip = EvaluateConfig(out, "grip", grip=replace(REACTING, friction=0.5))
    for config, expected in ((squeeze, plain), (grip, grip.grip)):
        with pytest.raises(Asked) as asked:
            evaluate(Recorder(), ["apple"], config, None, np.zeros(9, bool), Console(), task)
        own = replace(task, grip=expected, reward=RewardConfig(reach=0.0))
        assert asked.value.args == (own, config.noise)


def test_a_policy_on_an_answering_grip_is_compared_with_that_grip():
    base = EvaluateConfig(out=Path("x.json"), mass_scale=2.0)
    found = baselines(base, ClosingTaskConfig(grip=REACTING))
    squeezes = [c for c in found if c.controller == "squeeze"]
    grips = [c for c in found if c.controller == "grip"]
    assert [c.squeeze_force for c in squeezes] == [3, 5, 8]
    assert REACTING in [c.grip for c in grips] and len(grips) > 1
    assert {replace(c.grip, friction=REACTING.friction) for c in grips} == {REACTING}
    assert {c.mass_scale for c in found} == {2.0} and len(squeezes) + len(grips) == len(found)
