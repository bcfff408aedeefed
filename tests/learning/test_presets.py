"""Which preset `auto` takes, and that a training says so."""

import json
import sys

import pytest

from mjx_grasp import train as command
from mjx_grasp.assets import asset_path
from mjx_grasp.errors import InputError
from mjx_grasp.tasks import assemble
from mjx_grasp.training import config as config_module
from mjx_grasp.training import job
from mjx_grasp.training.command_line import parse
from mjx_grasp.training.config import preset_config


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
