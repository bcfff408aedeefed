"""Which preset `auto` takes, and that a training says so."""

import json
import sys

import pytest

from mjx_grasp import train as command
from mjx_grasp.assets import asset_path
from mjx_grasp.errors import InputError
from mjx_grasp.learning.config import PPOConfig
from mjx_grasp.tasks import assemble
from mjx_grasp.training import config as config_module
from mjx_grasp.training import job
from mjx_grasp.training.command_line import parse
from mjx_grasp.training.config import TrainConfig, preset_config, settings_of


@pytest.fixture(params=["gpu", "cpu"])
def backend(request, monkeypatch):
    """A machine on which JAX has, or has not, found a GPU."""
    monkeypatch.setattr(config_module, "has_gpu", lambda: request.param == "gpu")
    return request.param


@pytest.mark.parametrize(("backend_name", "found"), [("gpu", True), ("cpu", False)])
def test_there_is_a_gpu_where_jax_computes_on_one(monkeypatch, backend_name, found):
    monkeypatch.setattr(assemble.jax, "default_backend", lambda: backend_name)
    assert assemble.has_gpu() is found


def test_auto_takes_what_the_machine_has(backend):
    engine = {"gpu": "mjx", "cpu": "mujoco"}[backend]
    for config in (preset_config("auto"), parse([]), parse(["--preset", "auto", "--seed", "1"])):
        assert (config.preset, config.engine) == (backend, engine)
        assert config.fit_memory is (backend == "gpu")
    assert preset_config("paper").engine == engine


def test_paper_leaves_out_what_the_publication_does_not_have():
    """No timer or distance of arrival, no frozen command, no delay, a constant speed to lift at."""
    paper, usual = settings_of("paper"), TrainConfig()
    grip, ppo = paper.task.grip, paper.ppo
    assert (grip.arrival, grip.approach_s, grip.freezes, grip.together) == (0.0, None, False, False)
    assert (usual.task.grip.freezes, usual.task.reward.lift_speed) == (True, None)
    assert (paper.task.lift.delay_s, paper.task.reward.lift_speed) == (0.0, 0.15)
    assert (paper.handoffs_kind, paper.handoffs_gate, paper.objects) == (
        *("reached", "paper"),
        ("train",),
    )
    assert 24 * paper.handoffs_per_object >= 1000
    assert (ppo.iterations - ppo.tuning, ppo.tuning, ppo.learning_rate) == (460, 10, 1e-3)
    assert ppo.iterations * ppo.steps_per_iteration == pytest.approx(30.8e6, rel=1e-3)
    assert not ppo.privileged_critic and paper.task.action.residual == "integrated"


def test_impossible_combinations_are_refused():
    with pytest.raises(InputError, match=r"--handoffs-gate: found 'paper'"):
        TrainConfig(handoffs_gate="paper")
    with pytest.raises(InputError, match="tuning: found 5, expected at most 4"):
        PPOConfig(iterations=4, tuning=5)


def test_a_preset_that_is_asked_for_is_not_changed(backend):
    assert parse(["--preset", "cpu"]).preset == "cpu"
    assert parse(["--preset", "paper"]).preset == "paper"
    if backend == "gpu":
        assert parse(["--preset", "gpu"]).preset == "gpu"
    else:
        with pytest.raises(InputError, match="no GPU here"):
            parse(["--preset", "gpu"])


def test_a_training_says_which_preset_it_took(tmp_path, monkeypatch, capsys, backend):
    """The command as it is typed, up to the first iteration."""
    folder = tmp_path / "run"
    shipped = asset_path("handoffs_standins.npz")
    small = ["--objects", "foam_brick", "--ppo.worlds", "4", "--ppo.minibatches", "2"]
    arguments = [*small, "--handoffs", str(shipped), "--out", str(folder), "--no-fit-memory"]
    monkeypatch.setattr(sys, "argv", ["train", *arguments])
    monkeypatch.setenv("COLUMNS", "400")  # the width of the console
    monkeypatch.setattr(job, "BraxTask", lambda *_: None)
    monkeypatch.setattr(assemble.World, "task", lambda *_: None)

    class Begun(Exception):
        """Where the training would start to compile."""

    def begin(*_):
        raise Begun

    monkeypatch.setattr(job, "init_state", begin)
    with pytest.raises(Begun):
        command.main()
    engine = {"gpu": "mjx", "cpu": "mujoco"}[backend]
    assert f"preset {backend}: 1 object(s), 4 worlds in {engine}" in capsys.readouterr().err
    assert json.loads((folder / "config.json").read_text())["preset"] == backend
