"""Trainings of several seeds in step: each as if it were alone."""

import csv
import dataclasses
import itertools
from contextlib import nullcontext
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_training as tiny
from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError, InputError, MjxGraspError
from mjx_grasp.learning.checkpoint import checkpoints, restore_checkpoint
from mjx_grasp.learning.policy import load_policy
from mjx_grasp.learning.ppo import init_state
from mjx_grasp.learning.run import LoopConfig, Member, TrainingDiverged, train_together
from mjx_grasp.training import job
from mjx_grasp.training.command_line import parse

SEEDS = (3, 4)


@pytest.fixture(scope="module")
def env():
    return tiny.make_env()


def members(env, folder, count=2):
    return [
        Member(folder / str(seed), init_state(tiny.ppo(count), env, seed), {"seed": seed})
        for seed in SEEDS
    ]


@pytest.fixture(scope="module")
def together(env, tmp_path_factory):
    folder = tmp_path_factory.mktemp("together")
    for seed in SEEDS:
        (folder / str(seed)).mkdir()
    loop = LoopConfig(checkpoint_every=1)
    return folder, train_together(members(env, folder), env, tiny.ppo(2), loop)


def rows(folder):
    with (folder / "metrics.csv").open() as stream:
        return list(csv.DictReader(stream))


def test_each_learns_what_it_learns_alone(env, together, tmp_path):
    folder, states = together
    for seed, state in zip(SEEDS, states, strict=True):
        (tmp_path / str(seed)).mkdir()
        start = init_state(tiny.ppo(), env, seed)
        alone = tiny.train_loop(tmp_path / str(seed), start, env, tiny.ppo(2), LoopConfig(), {})
        np.testing.assert_allclose(tiny.parameters(state), tiny.parameters(alone), atol=2e-5)
        for mine, its in zip(rows(folder / str(seed)), rows(tmp_path / str(seed)), strict=True):
            for name in ("reward", "policy_loss", "episodes", "env_steps", "iteration"):
                np.testing.assert_allclose(float(mine[name]), float(its[name]), atol=1e-4)
    first, second = map(tiny.parameters, states)
    assert np.abs(first - second).max() > 1e-2, "seeds differ"


def test_each_keeps_checkpoints_of_its_own(env, together):
    folder, states = together
    for seed, state in zip(SEEDS, states, strict=True):
        kept = checkpoints(folder / str(seed) / "checkpoints")
        assert [path.name[-1] for path in kept] == ["1", "2"]
        back, goes_on = restore_checkpoint(kept[-1], init_state(tiny.ppo(), env, 9), env)
        assert goes_on
        np.testing.assert_array_equal(tiny.parameters(back), tiny.parameters(state))


def test_one_that_diverges_is_named(env, tmp_path):
    (a, b) = members(env, tmp_path)
    for member in (a, b):
        member.folder.mkdir()
    bad = jax.tree.map(lambda x: x * jnp.nan, b.state.params)
    with pytest.raises(TrainingDiverged, match=r"4/diverged\.npz.*iteration 1; "):
        train_together(
            [a, b._replace(state=b.state._replace(params=bad))], env, tiny.ppo(2), LoopConfig()
        )
    assert (b.folder / "diverged.npz").exists() and not (a.folder / "diverged.npz").exists()
    (kept,) = checkpoints(a.folder / "checkpoints")
    assert kept.name.endswith("1") and not checkpoints(b.folder / "checkpoints")


def configs(tmp_path, *flags):
    states = str(asset_path("handoffs_standins.npz"))
    fixed = ["--preset", "cpu", "--objects", "foam_brick", "--start-from", "None", "--handoffs"]
    return [
        parse([*fixed, states, *flags, "--seed", str(seed), "--out", str(tmp_path / str(seed))])
        for seed in SEEDS
    ]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"mass": 0.2}, "one setting, several seeds"),
        ({"handoffs": None}, "--handoffs"),
        ({"out": None}, "--out: found 'the same"),
        ({"loop": LoopConfig(wandb_project="grasps")}, "--loop.wandb-project"),
    ],
)
def test_what_cannot_go_on_in_step_is_refused(tmp_path, monkeypatch, change, says):
    first, second = configs(tmp_path)
    monkeypatch.setattr(job, "require_wandb", lambda project: None)
    if "mass" not in change:
        first = dataclasses.replace(first, **change)
    with pytest.raises(InputError, match=says):
        job.run_together([first, dataclasses.replace(second, **change)], Console(quiet=True))
    assert not list(tmp_path.iterdir())


def test_all_in_step_have_folders_or_none_has(tmp_path, monkeypatch):
    opens = job.open_run

    def open_run(config, *more):
        if config.seed == SEEDS[1]:
            raise OSError("no space left")
        opens(config, *more)
        assert (tmp_path / str(config.seed) / "config.json").exists()

    monkeypatch.setattr(job, "open_run", open_run)
    with pytest.raises(OSError, match="no space left"):
        job.run_together(configs(tmp_path), Console(quiet=True))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("failed", [False, True])
def test_no_process_goes_on_without_the_first(failed):
    worked, devices = [], SimpleNamespace(writes=False, agreed=lambda *_: (failed,))
    with pytest.raises(MjxGraspError, match="the first") if failed else nullcontext():
        job._first_alone(devices, lambda: worked.append(1))
    assert not worked, "which is the first one's"


class Asked(Exception):
    """For how many bytes worlds were to fit."""


@pytest.mark.parametrize("together", [1, 2])
def test_trainings_in_step_share_the_devices_memory(tmp_path, monkeypatch, together):
    def asked(scene, ppo, memory_bytes, devices):
        raise Asked(memory_bytes)

    monkeypatch.setattr(job, "device_memory", lambda: 10**10)
    monkeypatch.setattr(job, "worlds_that_fit", asked)
    some = [dataclasses.replace(config, fit_memory=True) for config in configs(tmp_path)]
    with pytest.raises(Asked) as room:
        job.run_together(some[:together], Console(quiet=True))
    assert room.value.args == (10**10 // together,)


def test_trainings_that_stand_at_different_iterations_are_refused(tmp_path, monkeypatch):
    first, second = (
        dataclasses.replace(c, resume=tmp_path / str(k)) for k, c in enumerate(configs(tmp_path))
    )
    at = {"0": "iteration_20", "1": "iteration_20"}

    def newest(folder):
        name = at[folder.parent.name]
        return None if name is None else folder / name

    monkeypatch.setattr(job, "newest_checkpoint", newest)
    assert [path.name for path in job._to_resume([first, second])] == 2 * ["iteration_20"]
    for other, stands in (("iteration_30", "iteration_30"), (None, "no checkpoint")):
        at["1"] = other
        with pytest.raises(FileError, match=f"1: found {stands}, expected iteration_20"):
            job._to_resume([first, second])
    at["0"] = None
    assert job._to_resume([first, second]) == [None, None]
    assert job._to_resume([dataclasses.replace(first, resume=None)]) == [None]


@pytest.mark.long
def test_runs_in_mjx_are_those_of_single_trainings(tmp_path):
    small = ["--ppo.worlds", "4", "--ppo.minibatches", "2", "--ppo.unroll", "4"]
    small += ["--ppo.iterations", "2", "--evaluation-episodes", "0", "--engine", "mjx"]
    folders = job.run_together(configs(tmp_path, *small), Console(quiet=True))
    assert folders == [tmp_path / str(seed) for seed in SEEDS]
    assert all((folder / "policy.npz").exists() for folder in folders)
    for a, b in itertools.pairwise(folders):
        assert (a / "policy.npz").read_bytes() != (b / "policy.npz").read_bytes()
        assert (a / "config.json").read_text() != (b / "config.json").read_text()
    (tmp_path / "alone").mkdir()
    for config, folder in zip(configs(tmp_path / "alone", *small), folders, strict=True):
        job.run_training(config, Console(quiet=True))
        alone, mine = (load_policy(at / "policy.npz") for at in (config.out, folder))
        leaves = [jax.tree.leaves(p._arrays) for p in (alone, mine)]
        for x, y in zip(*leaves, strict=True):
            np.testing.assert_allclose(x, y, atol=5e-3)
