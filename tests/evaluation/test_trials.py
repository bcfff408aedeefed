from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.tree_util import Partial

import mjx_grasp.evaluation.trials as module
from mjx_grasp.closing.config import REACTING, GripConfig
from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.trials import (
    Trials,
    by_object,
    evenly,
    force_apart,
    incidents,
    paired_draws,
    record_trials,
    room_for,
    run_trials,
    zero_controller,
)
from mjx_grasp.tasks.closing import ClosingTask
from mjx_grasp.tasks.config import ClosingTaskConfig, StartNoise

NOISE = StartNoise(offset_m=0.004, friction=(0.6, 0.9))
SHORT = ClosingTaskConfig(episode_s=0.2)


@pytest.fixture(scope="module")
def task(starts, native):
    return ClosingTask(native, starts, SHORT, NOISE, with_privileged=False)


def test_controllers_of_one_seed_start_alike(starts):
    draws = [paired_draws(starts, [1], 20, NOISE, seed=5) for _ in range(2)]
    jax.tree.map(np.testing.assert_array_equal, *draws)
    other = paired_draws(starts, [1], 20, NOISE, seed=6)
    assert (np.asarray(draws[0].offset) != np.asarray(other.offset)).any()


@pytest.mark.parametrize("episodes", [1, 2, 3, 7, 12])
@pytest.mark.parametrize("k", range(3))
def test_every_handoff_is_used_once_before_any_twice(starts, episodes, k):
    rows = np.asarray(paired_draws(starts, [k], episodes, NOISE, seed=0).row)
    assert set(rows) <= set(range(3 * k, 3 * k + 3)) and len(rows) == episodes
    counts = np.bincount(rows, minlength=9)[3 * k : 3 * k + 3]
    assert counts.max() - counts.min() <= 1


def test_order_of_handoffs_depends_on_the_seed(starts):
    orders = {tuple(np.asarray(paired_draws(starts, [0], 3, NOISE, s).row)) for s in range(20)}
    assert len(orders) > 3


def test_object_without_starts_is_refused(starts):
    with pytest.raises(InputError, match="start states"):
        paired_draws(starts, [3], 4, NOISE, seed=0)


def test_padding_of_the_last_batch_changes_nothing(task, starts):
    draw = paired_draws(starts, [0], 5, NOISE, seed=1)
    controller = zero_controller(task)
    together, padded = (run_trials(task, controller, draw, w) for w in (5, 3))
    np.testing.assert_array_equal(together.row, draw.row)
    for name, a, b in zip(together._fields, together, padded, strict=True):
        assert a.shape == b.shape == (5,)
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4, err_msg=name)


def test_controller_decides_the_actions_from_the_observations(task, starts):
    draw = paired_draws(starts, [0], 2, NOISE, seed=1)

    def push(obs):
        return jnp.broadcast_to(jnp.sign(obs["state"][:, :1]), (len(obs["state"]), 15))

    still, pushed = (run_trials(task, c, draw, 2) for c in (zero_controller(task), push))
    np.testing.assert_array_equal(still.row, pushed.row)
    assert (np.abs(still.reward - pushed.reward) > 1e-3).all()


def test_controllers_that_differ_in_what_they_are_told_are_compiled_once(task, starts):
    draw = paired_draws(starts, [0], 2, NOISE, seed=1)

    def push(sign, obs, half):
        return half * jnp.broadcast_to(
            sign * jnp.sign(obs["state"][:, :1]), (len(obs["state"]), 15)
        )

    half = jnp.float32(0.5)
    told = [run_trials(task, Partial(push, jnp.float32(x), half=half), draw, 2) for x in (0.0, 1.0)]
    assert module._compiled(task, push)._cache_size() == 1
    alone = [run_trials(task, partial(push, x, half=0.5), draw, 2) for x in (0.0, 1.0)]
    for one, other in zip(told, alone, strict=True):
        for name, a, b in zip(one._fields, one, other, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4, err_msg=name)
    assert (np.abs(told[0].reward - told[1].reward) > 1e-3).all()


def test_a_force_of_the_start_is_a_force_of_the_settings(starts, native):
    """Of a grip that keeps it; one that answers to its load has it in its settings."""
    forces = 2.0, 6.0
    runs = []
    for force in forces:
        config = replace(SHORT, episode_s=1.5, grip=GripConfig(force=force))
        apart, drawn = force_apart(config)
        assert drawn == force and apart == replace(config, grip=GripConfig())
        own, shared = (ClosingTask(native, starts, c, NOISE, False) for c in (config, apart))
        draws = [paired_draws(starts, [0], 2, NOISE, 1, x) for x in (None, force)]
        each = zip((own, shared), draws, strict=True)
        one, other = (run_trials(t, zero_controller(t), draw, 2) for t, draw in each)
        for name, a, b in zip(one._fields, one, other, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4, err_msg=name)
        runs.append(one.force_peak)
    assert np.isfinite(runs).all() and (runs[1] > runs[0] + 1.0).all()
    assert force_apart(replace(SHORT, grip=REACTING)) == (replace(SHORT, grip=REACTING), None)


def test_recorded_trials_are_the_same_trials(task, starts):
    draw = paired_draws(starts, [0], 2, NOISE, seed=2)
    trials, qpos = record_trials(task, zero_controller(task), draw)
    expected = run_trials(task, zero_controller(task), draw, 2)
    for name, a, b in zip(trials._fields, trials, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4, err_msg=name)
    assert qpos.shape == (20, 2, task.physics.scene.model.nq)
    at = task.physics.scene.addresses.object_qpos[:2]
    np.testing.assert_allclose(
        qpos[0][:, at],
        np.asarray(starts.truth.object_pos)[draw.row][:, :2] + np.asarray(draw.offset),
        atol=1e-3,
    )


def test_world_that_broke_or_overflowed_is_told_of_however_it_is_run(scene, starts):
    """Broken in the middle, finite again at the end; a buffer that was too small in two ticks."""
    from scripted import ScriptedPhysics, draw_of, still

    script = still(starts, [0, 0], 20)
    script.measured.q[5, 1] = np.nan
    script.truth.overflow[[2, 9], 0] = True
    task = ClosingTask(ScriptedPhysics(scene, script), starts, SHORT, StartNoise(offset_m=0.0))
    run = run_trials(task, zero_controller(task), draw_of([0, 0]), 2)
    recorded, _ = record_trials(task, zero_controller(task), draw_of([0, 0]))
    for trials in (run, recorded):
        np.testing.assert_array_equal(trials.broken, [False, True])
        np.testing.assert_array_equal(trials.overflow_ticks, [2, 0])
        assert incidents([trials, trials]) == {"overflows": 4, "broken_worlds": 2}


def test_draws_of_several_objects_are_those_of_each_and_their_trials_come_apart_again(starts):
    both, *alone = (paired_draws(starts, of, 4, NOISE, seed=5) for of in ([2, 0], [2], [0]))
    for k, own in enumerate(alone):
        for joined, one in zip(jax.tree.leaves(both), jax.tree.leaves(own), strict=True):
            np.testing.assert_array_equal(joined[4 * k : 4 * k + 4], one)
    ran = Trials(*[np.asarray(both.row)] * len(Trials._fields))
    for own, apart in zip(alone, by_object(ran, 2), strict=True):
        np.testing.assert_array_equal(apart.row, own.row)
        np.testing.assert_array_equal(apart.force_mean, own.row)


@given(st.lists(st.integers(), max_size=40), st.integers(1, 12))
def test_items_in_parts_that_are_as_even_as_can_be(items, most):
    parts = evenly(items, most)
    sizes = [len(part) for part in parts]
    assert [item for part in parts for item in part] == items
    assert len(parts) == -(-len(items) // most)
    assert sizes == sorted(sizes, reverse=True)
    assert not sizes or (sizes[0] <= most and sizes[0] - sizes[-1] <= 1)


def test_conditions_have_room_beside_each_other_on_a_gpu():
    assert room_for("mjx", 512) == 8
    assert room_for("mjx", 3584) == room_for("mjx", 9000) == 1
    assert room_for("mjx", 100, worlds=450) == 4
    assert room_for("mujoco", 8) == 1
