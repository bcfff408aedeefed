"""Every reward term is in the logs of a training under its own name."""

import csv
import struct
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event

sys.path.insert(0, str(Path(__file__).parent))
import tiny_training as tiny

from mjx_grasp.learning.ppo import init_state
from mjx_grasp.learning.run import COLUMNS, LoopConfig
from mjx_grasp.tasks.rewards import RewardTerm

PUBLISHED = ("reach", "lift", "contact", "action_rate", "action_acceleration")
EXTRA = (
    RewardTerm("always", -0.25, lambda m: jnp.ones(m.slip.shape)),
    RewardTerm("low", 3.0, lambda m: 1.0 - m.measured.palm_pos[..., 2]),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two iterations with two terms of one's own."""
    folder = tmp_path_factory.mktemp("run")
    env = tiny.make_env(extra_terms=EXTRA)
    state = init_state(tiny.ppo(), env, seed=0)
    tiny.train_loop(folder, state, env, tiny.ppo(), LoopConfig(), tiny.CONFIG)
    return folder


@pytest.fixture(scope="module")
def rows(folder):
    with (folder / "metrics.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_the_table_has_a_column_for_each_term(rows):
    terms = [f"reward/{name}" for name in (*PUBLISHED, "always", "low")]
    assert len(rows) == 2
    assert list(rows[0]) == [*COLUMNS, *terms]
    for row in rows:
        assert float(row["reward/always"]) == -0.25
        assert 0 < float(row["reward/low"]) < 3
        assert float(row["reward/action_rate"]) < 0 <= float(row["reward/contact"])
        total = sum(float(row[name]) for name in terms)
        np.testing.assert_allclose(total, float(row["reward"]), rtol=1e-5)


def scalars(folder):
    """What TensorBoard is shown: values by name and step."""
    (path,) = folder.glob("events.out.*")
    data, at, found = path.read_bytes(), 0, {}
    while at < len(data):
        (length,) = struct.unpack_from("<Q", data, at)
        event = Event.FromString(data[at + 12 : at + 12 + length])
        for value in event.summary.value:
            found[value.tag, event.step] = value.simple_value
        at += 16 + length
    return found


def test_tensorboard_shows_the_same(folder, rows):
    found = scalars(folder / "tensorboard")
    for row in rows:
        for name in (*PUBLISHED, "always", "low"):
            shown = found[f"reward/{name}", int(float(row["env_steps"]))]
            np.testing.assert_allclose(shown, float(row[f"reward/{name}"]), rtol=1e-6)
