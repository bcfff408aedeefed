"""Training on several devices: CPUs that XLA pretends to have, and processes of one device each."""

import os
import random
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.sharding import Mesh

from mjx_grasp.errors import InputError
from mjx_grasp.learning import devices
from mjx_grasp.learning.checkpoint import checkpoints
from mjx_grasp.learning.devices import ONE_DEVICE, RunOn, check_even, find_devices, join_hosts

SCRIPT = Path(__file__).parent / "many_devices.py"


def script(*arguments):
    return subprocess.Popen(
        [sys.executable, str(SCRIPT), *map(str, arguments)],
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def output_of(process):
    output = process.communicate(timeout=400)[0]
    assert process.returncode == 0, output
    return output


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    out = tmp_path_factory.mktemp("devices") / "found.npz"
    output_of(script(out))
    with np.load(out) as stored:
        return dict(stored)


@pytest.mark.long
def test_devices_that_see_the_same_learn_what_one_learns(found):
    """The mean of equal gradients is the gradient; observations count once for each device."""
    np.testing.assert_allclose(found["twins"], found["lone"], rtol=1e-4, atol=1e-6)
    assert list(found["counts"]) == [2 * 24 * 8, 24 * 8]


@pytest.mark.long
def test_every_device_has_the_same_weights_and_rate_and_worlds_of_its_own(found):
    assert np.ptp(found["copies"], axis=0).max() == 0.0
    assert len(found["rates"]) == 4 and np.ptp(found["rates"]) == 0.0
    places = found["places"].ravel()
    assert found["places"].shape == (4, 16) and len(np.unique(places)) == 64


@pytest.mark.long
def test_metrics_are_those_of_all_devices(found):
    np.testing.assert_allclose(found["reward"], found["terms"], rtol=1e-4)
    assert found["reward"][-1] > found["reward"][0]
    assert 0 < found["episodes"] <= 64


@pytest.mark.long
def test_tasks_are_told_on_every_device_of_the_episodes_of_all(found):
    """And of them alike: what a curriculum makes of it is the same everywhere."""
    assert found["told"].shape == (4, 4, 3)
    np.testing.assert_array_equal(found["told"].reshape(16, 3), [found["logged"]] * 16)
    share, episodes, successes = found["logged"]
    assert (share, episodes) == (1.0, 16) and 0 <= successes <= 16


@pytest.fixture(scope="module", params=["homing", pytest.param("closing", marks=pytest.mark.long)])
def kept(request, tmp_path_factory):
    out = tmp_path_factory.mktemp("kept") / "kept.npz"
    output_of(script(out, request.param))
    with np.load(out) as stored:
        return dict(stored)


@pytest.mark.long
def test_a_checkpoint_goes_on_as_if_nothing_had_been(kept):
    np.testing.assert_array_equal(kept["resumed"], kept["unbroken"])
    assert np.abs(kept["unbroken"] - kept["kept"]).max() > 0


@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.long
def test_a_checkpoint_of_two_devices_is_read_on_any_number(kept, count):
    """The same weights, and every world where it stood."""
    assert kept[f"goes_on_{count}"]
    np.testing.assert_array_equal(kept[f"kept_{count}"], kept["kept"])
    np.testing.assert_array_equal(kept[f"stood_{count}"], kept["stood"])
    assert kept["after"][0] == 3 and np.isfinite(kept["after"][1])


def free_port():
    with socket.socket() as opened:
        opened.bind(("localhost", 0))
        return opened.getsockname()[1]


@pytest.mark.long
def test_two_processes_train_together_and_one_goes_on_alone(tmp_path):
    def train(folder, count, iterations):
        at = f"localhost:{free_port()}"
        started = [script(folder, at, count, k, iterations) for k in range(count)]
        return [output_of(process) for process in started]

    together, broken = tmp_path / "together", tmp_path / "broken"
    for folder in (together, broken):
        folder.mkdir()
    train(together, 2, 3)
    first, second = (np.load(together / f"weights_{k}.npy") for k in range(2))
    np.testing.assert_array_equal(first, second)
    assert len(checkpoints(together / "checkpoints")) == 2
    lines = (together / "metrics.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ["iteration", "1", "2", "3"]
    # Stopped after two iterations and resumed: the same weights with as many processes.
    train(broken, 2, 2)
    assert all("from 2 True" in output for output in train(broken, 2, 3))
    np.testing.assert_array_equal(np.load(broken / "weights_1.npy"), first)
    (output,) = train(broken, 1, 4)
    assert "from 3 True" in output
    assert [p.name[-1] for p in checkpoints(broken / "checkpoints")] == ["3", "4"]


@pytest.mark.long
def test_two_processes_train_in_mjx(tmp_path):
    """Each has the model on a device of its own, and none waits for one that is gone.

    Once all have trained they part, and the first one evaluates alone.
    """
    flags = (
        "--preset cpu --engine mjx --objects foam_brick --handoffs assets/handoffs_standins.npz "
        "--ppo.worlds 16 --ppo.minibatches 4 --ppo.unroll 4 --ppo.iterations 2 "
        f"--evaluation-episodes 1 --coordinator localhost:{free_port()} --processes 2"
    )
    out = tmp_path / "run"
    command = [sys.executable, "-m", "mjx_grasp.train", *flags.split(), "--out", str(out)]
    started = [
        subprocess.Popen(
            [*command, "--process", str(k)],
            cwd=Path(__file__).parents[2],
            env=os.environ | {"JAX_PLATFORMS": "cpu"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for k in range(2)
    ]
    try:
        for process in reversed(started):
            said, _ = process.communicate(timeout=400)  # they wait for each other without an end
            assert process.returncode == 0, said
    finally:
        for process in started:
            process.kill()
    assert len((out / "metrics.csv").read_text().splitlines()) == 3
    assert (out / "results.json").exists()


@pytest.mark.long
def test_ten_times_killed_and_resumed_on_other_devices_no_finished_iteration_is_lost(tmp_path):
    """Killed at any moment: what was kept is gone on with, and logged once."""
    rng, kills, start = random.Random(0), 10, 0
    for k in range(kills):
        process = script(tmp_path, (1, 2, 4)[k % 3], 10_000)
        deadline = time.monotonic() + 120
        while newest(tmp_path) < start + 2:
            assert process.poll() is None and time.monotonic() < deadline, process.stdout.read()
            time.sleep(0.02)
        time.sleep(rng.uniform(0.0, 0.6))
        process.kill()
        output, last = process.communicate()[0], newest(tmp_path)
        assert f"from {start} True" in output if start else "from" not in output
        # An iteration that was logged may be cut short while it is written.
        assert last <= len(iterations_logged(tmp_path)) <= last + 1
        start = last
    output_of(script(tmp_path, 2, start + 2))
    assert iterations_logged(tmp_path) == list(range(1, start + 3))


def newest(folder):
    kept = checkpoints(folder / "checkpoints")
    return int(kept[-1].name.split("_")[1]) if kept else 0


def iterations_logged(folder):
    lines = (folder / "metrics.csv").read_text().splitlines()[1:]
    return [int(line.split(",")[0]) for line in lines if line.count(",") > 5]


def test_one_device_is_the_default_on_a_cpu():
    assert find_devices(RunOn()) == ONE_DEVICE and ONE_DEVICE.count == 1
    assert ONE_DEVICE.writes and ONE_DEVICE.agreed(True, False) == (True, False)


def test_devices_that_are_not_there_and_uneven_worlds_are_refused():
    said = r"--devices: found .*here\)', expected at most \d, or auto"
    with pytest.raises(InputError, match=said):
        find_devices(RunOn(devices=len(jax.devices()) + 1))
    check_even(8, 2, ONE_DEVICE)
    with pytest.raises(InputError, match=r"--ppo\.worlds: found 9.*1 devices × 2 minibatches"):
        check_even(9, 2, ONE_DEVICE)


def test_several_devices_keep_the_state_beside_the_next_unless_told_otherwise(monkeypatch):
    here = jax.devices()[:1]
    monkeypatch.setattr(jax, "devices", lambda: 2 * here)
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    monkeypatch.setattr(devices, "Mesh", lambda *_: Mesh(np.array(here), (devices.AXIS,)))
    assert not find_devices(RunOn(devices=2)).donates
    assert find_devices(RunOn(devices=2, donate=True)).donates
    assert find_devices(RunOn(devices=1)).donates
    assert not find_devices(RunOn(devices=1, donate=False)).donates


def test_processes_without_a_meeting_place_are_refused():
    join_hosts(RunOn())
    with pytest.raises(InputError, match=r"--process: found 1.*coordinator"):
        join_hosts(RunOn(process=1))
