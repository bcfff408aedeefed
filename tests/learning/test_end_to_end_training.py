"""Trainings of the end-to-end task: its curriculum goes with them, its files say what they are."""

import csv
import sys
from dataclasses import replace
from pathlib import Path

import handmade
import jax
import numpy as np
import pytest
from rich.console import Console

sys.path.insert(0, str(Path(__file__).parent))
import tiny_training as tiny

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.config import EvaluateConfig
from mjx_grasp.evaluation.grasps.run import loaded_grasper
from mjx_grasp.evaluation.run import evaluate
from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.learning.checkpoint import checkpoints, restore_checkpoint
from mjx_grasp.learning.controller import load_controller, policy_task
from mjx_grasp.learning.policy import policy_from_training
from mjx_grasp.learning.ppo import init_state
from mjx_grasp.learning.run import LoopConfig
from mjx_grasp.records.settings import to_record
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.tasks.assemble import World
from mjx_grasp.tasks.config import ClosingTaskConfig, EndToEndConfig, StartNoise
from mjx_grasp.tasks.curriculum import CurriculumConfig
from mjx_grasp.tasks.end_to_end import EndToEndTask
from mjx_grasp.tasks.starts import build_starts
from mjx_grasp.training import config as training_config
from mjx_grasp.training.after import baselines
from mjx_grasp.training.command_line import parse
from mjx_grasp.training.config import from_stored, preset_config

SHORT = EndToEndConfig(
    **dict(episode_s=0.1, reach_s=0.05, postures=3),
    curriculum=CurriculumConfig("forced", start=0.1, until=1.0),
)
PPO = tiny.ppo(3, privileged_critic=False)


@pytest.fixture(scope="module")
def env():
    scene, handoffs = handmade.box_handoffs_scene()
    physics = NativePhysics(scene, threads=1)
    starts = build_starts(scene, handoffs, physics.substeps)
    return BraxTask(EndToEndTask(physics, starts, SHORT, StartNoise()), PPO.worlds)


@pytest.fixture(scope="module")
def run(env, tmp_path_factory):
    """Three iterations in one go: their folder, the last state, and the one before it."""
    folder = tmp_path_factory.mktemp("run")
    loop = LoopConfig(checkpoint_every=1)
    last = tiny.train_loop(folder, init_state(PPO, env, seed=0), env, PPO, loop, tiny.CONFIG)
    second = checkpoints(folder / "checkpoints")[0]
    kept, goes_on = restore_checkpoint(second, init_state(PPO, env, seed=9), env)
    assert goes_on and second.name == "iteration_00000002"
    return folder, last, kept


def rows(folder):
    with (folder / "metrics.csv").open() as stream:
        return list(csv.DictReader(stream))


@pytest.mark.long
def test_the_level_rises_with_the_iterations_and_is_logged(run):
    folder, last, kept = run
    levels = [float(row["reach_level"]) for row in rows(folder)]
    np.testing.assert_allclose(levels, [0.4, 0.7, 1.0], atol=1e-6)
    np.testing.assert_allclose(kept.env.pipeline_state.beside.level, 0.7, atol=1e-6)
    np.testing.assert_array_equal(last.env.pipeline_state.beside.level, 1.0)
    assert all(float(row["broken_worlds"]) == 0 for row in rows(folder))


@pytest.mark.long
def test_a_resumed_training_goes_on_as_if_nothing_had_been(env, run, tmp_path):
    _, last, kept = run
    again = tiny.train_loop(tmp_path, kept, env, PPO, LoopConfig(), tiny.CONFIG)
    np.testing.assert_array_equal(tiny.parameters(again), tiny.parameters(last))
    for found, expected in zip(*map(jax.tree.leaves, (again.env, last.env)), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_closing_trainings_know_no_level():
    assert tiny.make_env().pace_names == ()


@pytest.fixture
def stored(env, run, robot, tmp_path):
    state, meta = run[1], {"task": to_record(SHORT)}
    path = tmp_path / "policy.npz"
    policy_from_training(state.params.policy, state.normalizer, meta, robot.identity).save(path)
    return path


@pytest.mark.long
def test_its_policy_is_evaluated_in_its_own_task_and_closes_for_no_other(stored, robot):
    policy = load_controller(stored, robot)
    assert policy_task(policy) == SHORT and policy.observation_size == 84

    class Asked(Exception):
        pass

    class Recorder(World):
        def __init__(self):
            pass

        def task(self, engine, worlds, task, *others, **settings):
            raise Asked(task)

    config = EvaluateConfig(Path("x.json"))
    with pytest.raises(Asked) as asked:
        evaluate(Recorder(), ["box"], config, policy, np.zeros(3, bool), Console())
    assert asked.value.args == (SHORT,)
    with pytest.raises(FileError, match="reaches by itself"):
        loaded_grasper(robot, stored)


def test_it_is_compared_with_squeezes_from_the_handoffs():
    task = replace(SHORT, grip=replace(SHORT.grip, ramp_s=0.2))
    assert type(task.closing) is ClosingTaskConfig
    assert task.closing.episode_s == 4.0 and task.closing.grip == task.grip
    found = baselines(EvaluateConfig(Path("x.json")), task.closing)
    assert {c.controller for c in found} == {"squeeze"}


def test_the_preset_is_as_published_and_comes_back_from_its_file(monkeypatch):
    preset = preset_config("end-to-end")
    task, ppo = preset.task, preset.ppo
    assert isinstance(task, EndToEndConfig) and preset.objects == ("train",)
    assert (task.episode_s, task.reach_s, task.episode_ticks) == (9.0, 3.0, 900)
    assert (ppo.worlds, ppo.unroll, ppo.privileged_critic) == (1024, 64, False)
    assert 30e6 < ppo.steps_per_iteration * ppo.iterations < 32e6
    paper = preset_config("paper").task
    assert (task.lift, task.grip, task.reward) == (paper.lift, paper.grip, paper.reward)
    assert task.observation == replace(paper.observation, targets=True)
    assert task.action == replace(paper.action, arm_rate=0.5)
    assert replace(preset, preset="paper", task=paper) == preset_config("paper")
    for config in (preset, preset_config("paper"), training_config.settings_of("cpu")):
        assert from_stored(to_record(config)) == config


def test_the_command_line_changes_it_by_its_names(capsys):
    flags = ["--task.curriculum.kind", "measured", "--task.reach-s", "2", "--task.assisted"]
    task = parse(["--preset", "end-to-end", *flags]).task
    expected = EndToEndConfig(
        **dict(reach_s=2.0, assisted=True, curriculum=CurriculumConfig("measured")),
        **{n: getattr(preset_config("end-to-end").task, n) for n in ("lift", "grip", "reward")},
    )
    assert task == expected
    with pytest.raises((InputError, SystemExit)):
        parse(["--preset", "end-to-end", "--task.curriculum.start", "2"])
    with pytest.raises(SystemExit):
        parse(["--preset", "paper", "--task.reach-s", "2"])
