import csv
import functools
import io
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections import deque
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from mjx_grasp.errors import FileError, InputError

sys.path.insert(0, str(Path(__file__).parent))
import tiny_training as tiny

from mjx_grasp.learning import ppo as ppo_module
from mjx_grasp.learning import run as run_module
from mjx_grasp.learning.checkpoint import (
    checkpoints,
    newest_checkpoint,
    restore_checkpoint,
    save_checkpoint,
)
from mjx_grasp.learning.config import PPOConfig
from mjx_grasp.learning.log import MetricLog
from mjx_grasp.learning.ppo import init_state, make_iteration, make_networks, make_optimizer
from mjx_grasp.learning.run import COLUMNS, LoopConfig, TrainingDiverged


@pytest.fixture(scope="module")
def env():
    return tiny.make_env()


made_once = functools.cache(make_iteration)


@pytest.fixture(autouse=True)
def _loops_of_the_same_settings_compile_once(monkeypatch):
    monkeypatch.setattr(run_module, "make_iteration", made_once)


@pytest.fixture(scope="module")
def iterate(env):
    return jax.jit(make_iteration(tiny.ppo(), env))


@pytest.fixture(scope="module")
def trained(env, iterate):
    """States after 0, 1, 2 and 3 iterations, and the metrics of each."""
    states, metrics = [init_state(tiny.ppo(), env, seed=0)], []
    for _ in range(3):
        state, m = iterate(states[-1])
        states.append(state)
        metrics.append(jax.device_get(m))
    return states, metrics


def same(a, b):
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(np.asarray(x), np.asarray(y)), a, b)


def test_second_iteration_does_not_compile_again(trained, iterate):
    assert iterate._cache_size() == 1


def test_iteration_changes_what_it_should_and_counts(trained):
    states, metrics = trained
    for before, after in itertools.pairwise(states):
        assert int(after.iteration) == int(before.iteration) + 1
        for a, b in zip(jax.tree.leaves(before.params), jax.tree.leaves(after.params), strict=True):
            assert (np.asarray(a) != np.asarray(b)).any()
        assert (before.key != after.key).any()
    # The statistics have seen every observation once.
    assert int(states[3].normalizer.count.lo) == 3 * tiny.ppo().steps_per_iteration
    # 12 steps of episodes of 10: staggered first ones do not count, some world ends a whole one.
    assert sum(m["episodes"] for m in metrics) >= 1
    assert all(np.isfinite(m["total_loss"]) and m["broken_worlds"] == 0 for m in metrics)
    assert set(COLUMNS) - {"iteration", "env_steps", "seconds", "steps_per_s"} <= set(metrics[0])


def test_what_hardly_changes_is_not_blown_up(trained):
    """Flags that were always 0 in these short episodes, as an example."""
    deviations = jnp.concatenate(jax.tree.leaves(trained[0][3].normalizer.std))
    assert deviations.min() == pytest.approx(0.1) and deviations.max() > 0.1


def test_every_epoch_takes_every_minibatch(trained):
    steps = tiny.ppo().epochs * tiny.ppo().minibatches
    assert [int(s.optimizer[-1].count) for s in trained[0]] == [0, steps, 2 * steps, 3 * steps]


def test_the_settings_reach_the_loss(env, trained, monkeypatch):
    given, loss = {}, ppo_module.losses.compute_ppo_loss

    def spy(*arguments, **settings):
        given.update(settings)
        return loss(*arguments, **settings)

    monkeypatch.setattr(ppo_module.losses, "compute_ppo_loss", spy)
    config = tiny.ppo(
        **dict(discount=0.9, gae_lambda=0.8, clip=0.1, entropy=0.02),
        **dict(reward_scale=0.3, value_weight=0.7, value_clip=0.4),
    )
    jax.eval_shape(make_iteration(config, env), trained[0][0])
    del given["ppo_network"]
    assert given == {
        **dict(discounting=0.9, gae_lambda=0.8, clipping_epsilon=0.1, entropy_cost=0.02),
        **dict(reward_scaling=0.3, vf_coefficient=0.7, clipping_epsilon_value=0.4),
    }


def test_long_gradients_are_shortened_and_the_rate_is_the_configured_one():
    optimizer = make_optimizer(tiny.ppo(gradient_norm=0.5, learning_rate=0.01))
    gradient = {"w": jnp.array([30.0, -40.0]), "b": jnp.array([0.0])}
    updates, state = optimizer.update(gradient, optimizer.init(gradient))
    first_moment = state[-1].inner_state[0].mu["w"]  # Adam keeps a tenth of the first gradient
    np.testing.assert_allclose(first_moment, [0.03, -0.04], rtol=1e-5)
    np.testing.assert_allclose(updates["w"], [-0.01, 0.01], rtol=1e-3)


@pytest.mark.long
def test_the_critic_may_learn_at_a_rate_of_its_own(env, trained):
    """As fast as the actor it is what it is without; at next to none only the actor changes."""
    (first, *_), _ = trained

    def after(**rates):
        config = tiny.ppo(desired_kl=None, learning_rate=1e-3, **rates)
        return jax.jit(make_iteration(config, env))(first)[0].params

    def change(params, of):
        pairs = zip(
            jax.tree.leaves(getattr(params, of)),
            jax.tree.leaves(getattr(first.params, of)),
            strict=True,
        )
        return max(float(jnp.abs(a - b).max()) for a, b in pairs)

    plain, same, slow = after(), after(critic_rate=1e-3), after(critic_rate=1e-9)
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(same), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)
    assert change(slow, "value") < 1e-7 < 1e-4 < change(slow, "policy")


@pytest.mark.long
def test_the_critic_moves_no_further_in_an_iteration_than_its_bound(env, trained):
    """At a rate at which it would otherwise run far."""
    (first, *_), _ = trained

    def moved(**clip):
        config = tiny.ppo(desired_kl=None, critic_rate=0.03, reward_scale=10.0, epochs=8, **clip)
        state = jax.jit(make_iteration(config, env))(first)[0]
        value = make_networks(config, env).value_network.apply
        obs = env.reset(jax.random.PRNGKey(0)).obs
        before, after = (value(s.normalizer, s.params.value, obs) for s in (first, state))
        return float(jnp.abs(after - before).mean())

    assert moved(value_clip=0.05) < 0.5 * moved()


@pytest.mark.long
def test_the_last_iterations_keep_one_rate(env, trained):
    """What the divergence says of the rate counts until then."""
    (first, *_), _ = trained
    config = tiny.ppo(3, learning_rate=1e-3, desired_kl=1e3, tuning=1)
    iterate, state, rates = jax.jit(make_iteration(config, env)), first, []
    for _ in range(3):
        state, _ = iterate(state)
        rates.append(float(state.optimizer[-1].hyperparams["learning_rate"]))
    assert rates[1] > rates[0] > 2e-3 and rates[2] == np.float32(1e-3)


@pytest.mark.long
def test_the_critic_may_learn_alone_at_first(env, trained):
    """The actor and the rate stay; afterwards both learn."""
    state, config = trained[0][0], tiny.ppo(2, learning_rate=1e-4, critic_first=0.5)
    iterate = jax.jit(make_iteration(config, env))
    first, metrics = iterate(state)
    same(first.params.policy, state.params.policy)
    same(first.policy, state.policy)
    assert metrics["learning_rate"] == np.float32(1e-4)
    critics = (jax.tree.leaves(s.params.value) for s in (state, first))
    assert all(np.abs(a - b).max() > 0 for a, b in zip(*critics, strict=True))
    actors = (jax.tree.leaves(s.params.policy) for s in (first, iterate(first)[0]))
    assert all(np.abs(a - b).max() > 0 for a, b in zip(*actors, strict=True))


def test_the_policy_is_the_mean_of_the_last_weights(env, trained):
    """Of those of the iterations that are asked for; of none it is the last ones, to the bit."""
    state = trained[0][0]
    iterate = jax.jit(make_iteration(tiny.ppo(3, averaged=0.67), env))
    states = []
    for _ in range(3):
        state, _ = iterate(state)
        states.append(state)
    for one in (*trained[0], *states[:2]):
        same(one.policy, one.params.policy)
    last = (states[1].params.policy, states[2].params.policy)
    assert jax.tree.reduce(max, jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), *last)) > 0
    for mean, a, b in zip(*map(jax.tree.leaves, (states[2].policy, *last)), strict=True):
        np.testing.assert_allclose(mean, (a + b) / 2, rtol=1e-5, atol=1e-8)


def test_actor_sees_66_numbers_and_the_critic_more(env, trained):
    params = trained[0][0].params
    assert params.policy["params"]["MLP_0"]["hidden_0"]["kernel"].shape == (66, 8)
    critic = jax.tree.leaves(params.value["params"]["hidden_0"]["kernel"])[0]
    assert critic.shape[0] == env.observation_size["privileged_state"][0] > 66
    from dataclasses import replace

    paper = replace(tiny.ppo(), privileged_critic=False)
    blind = make_networks(paper, env).value_network.init(jax.random.PRNGKey(0))
    assert blind["params"]["hidden_0"]["kernel"].shape[0] == 66


def test_checkpoint_restores_every_bit(env, trained, iterate, tmp_path):
    states, _ = trained
    path = save_checkpoint(tmp_path, states[1], env, tiny.CONFIG)
    assert path.name == "iteration_00000001"
    assert json.loads((path / "config" / "metadata").read_text()) == tiny.CONFIG
    back, goes_on = restore_checkpoint(path, init_state(tiny.ppo(), env, seed=9), env)
    assert goes_on
    assert jax.tree.structure(back) == jax.tree.structure(states[1])
    same(back, states[1])
    # Going on from it is going on: parameters, optimiser, statistics, worlds, key.
    same(iterate(back)[0], states[2])


def test_only_the_newest_checkpoints_stay(env, trained, tmp_path):
    for state in trained[0]:
        save_checkpoint(tmp_path, state, env, tiny.CONFIG, keep=2)
    assert [p.name for p in checkpoints(tmp_path)] == ["iteration_00000002", "iteration_00000003"]
    assert checkpoints(tmp_path / "nowhere") == []


def test_unfinished_checkpoints_are_not_taken_for_finished_ones(env, trained, tmp_path):
    left = tmp_path / "iteration_00000002.orbax-checkpoint-tmp"
    (left / "state").mkdir(parents=True)
    save_checkpoint(tmp_path, trained[0][1], env, tiny.CONFIG)
    assert [p.name for p in checkpoints(tmp_path)] == ["iteration_00000001"]
    save_checkpoint(tmp_path, trained[0][2], env, tiny.CONFIG)
    template = init_state(tiny.ppo(), env, seed=9)
    same(restore_checkpoint(checkpoints(tmp_path)[-1], template, env)[0], trained[0][2])


def test_what_a_kill_has_left_of_checkpoints_goes_with_the_next_one(env, trained, tmp_path):
    for name in ("iteration_00000099", "iteration_00000098.orbax-checkpoint-tmp"):
        (tmp_path / name / "learner").mkdir(parents=True)
    others = {"notes", "iteration_00000001_best", "iteration_notes.txt"}
    for name in others - {"iteration_notes.txt"}:
        (tmp_path / name).mkdir()
    (tmp_path / "iteration_notes.txt").touch()
    save_checkpoint(tmp_path, trained[0][1], env, tiny.CONFIG)
    assert {p.name for p in tmp_path.iterdir()} == {"iteration_00000001", *others}


def data_files(path):
    """The files that hold a checkpoint's numbers."""
    return [f for f in path.rglob("*") if f.is_file() and f.parent.name == "d"]


@pytest.mark.parametrize("how", ["missing", "truncated"])
def test_damaged_checkpoint_is_refused_by_name(env, trained, tmp_path, how):
    path = save_checkpoint(tmp_path, trained[0][1], env, tiny.CONFIG)
    for file in data_files(path):
        if how == "missing":
            file.unlink()
        else:
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(FileError, match="iteration_00000001"):
        restore_checkpoint(path, trained[0][0], env)


def test_damaged_checkpoint_is_refused_with_the_one_to_take_instead(env, trained, tmp_path):
    older, newest = (save_checkpoint(tmp_path, s, env, tiny.CONFIG) for s in trained[0][1:3])
    assert newest_checkpoint(tmp_path) == newest
    data_files(newest)[0].unlink()
    with pytest.raises(FileError, match=f"{older.name} is intact: remove {newest.name}"):
        newest_checkpoint(tmp_path)
    data_files(older)[0].unlink()
    with pytest.raises(FileError, match=newest.name) as error:
        newest_checkpoint(tmp_path)
    assert "intact" not in str(error.value)
    assert newest_checkpoint(tmp_path / "nowhere") is None


def test_changed_byte_is_refused_or_does_no_harm(env, trained, tmp_path):
    """A training must never go on from numbers that it did not write."""
    path = save_checkpoint(tmp_path, trained[0][1], env, tiny.CONFIG)
    for file in data_files(path):
        content = file.read_bytes()
        for place in range(len(content) // 8, len(content), len(content) // 4):
            changed = bytearray(content)
            changed[place] ^= 0xFF
            file.write_bytes(bytes(changed))
            try:
                back, _ = restore_checkpoint(path, trained[0][0], env)
            except FileError:
                continue
            same(back, trained[0][1])
        file.write_bytes(content)


def test_checkpoint_of_another_configuration_is_refused(env, trained, tmp_path):
    path = save_checkpoint(tmp_path, trained[0][1], env, tiny.CONFIG)
    wider = init_state(tiny.ppo(hidden=(16, 8)), env, seed=0)
    with pytest.raises(FileError, match="iteration_00000001"):
        restore_checkpoint(path, wider, env)


def test_resumed_training_is_the_unbroken_one(env, trained, tmp_path):
    """Two iterations, a checkpoint, and the third in a new loop: the parameters of three."""
    loop = LoopConfig(checkpoint_every=1)
    state = init_state(tiny.ppo(2), env, seed=0)
    tiny.train_loop(tmp_path, state, env, tiny.ppo(2), loop, tiny.CONFIG)
    path = checkpoints(tmp_path / "checkpoints")[-1]
    state, _ = restore_checkpoint(path, init_state(tiny.ppo(3), env, seed=0), env)
    final = tiny.train_loop(tmp_path, state, env, tiny.ppo(3), loop, tiny.CONFIG)
    same(final, trained[0][3])
    with (tmp_path / "metrics.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [int(r["iteration"]) for r in rows] == [1, 2, 3]
    assert [int(r["env_steps"]) for r in rows] == [16, 32, 48]


def test_numbers_that_are_none_stop_the_training(env, trained, tmp_path):
    """The checkpoint from before stays as it is, and the bad state is kept aside."""
    folder = tmp_path / "run"
    folder.mkdir()
    good = trained[0][1]
    save_checkpoint(folder / "checkpoints", good, env, {})
    state = jax.tree.map(jnp.copy, good)  # the loop gives away what it is given
    bad = state._replace(
        params=state.params.replace(
            policy=jax.tree.map(lambda x: x.at[(0,) * x.ndim].set(jnp.nan), state.params.policy)
        )
    )
    with pytest.raises(TrainingDiverged, match=r"diverged\.npz.*iteration 2; .*00000001"):
        tiny.train_loop(folder, bad, env, tiny.ppo(3), LoopConfig(checkpoint_every=1), {})
    assert [p.name for p in checkpoints(folder / "checkpoints")] == ["iteration_00000001"]
    back, _ = restore_checkpoint(
        checkpoints(folder / "checkpoints")[-1], init_state(tiny.ppo(3), env, seed=0), env
    )
    same(back, good)
    with np.load(folder / "diverged.npz") as stored:
        assert any(not np.isfinite(stored[n]).all() for n in stored.files)


@pytest.fixture
def counting(monkeypatch, env, trained):
    """The loop with iterations that only count, from a state of its own."""
    rewards = ppo_module.reward_columns(env.task.reward_names).values()
    numbers = dict.fromkeys((*COLUMNS, *rewards, "total_loss"), 1.0) | dict.fromkeys(
        ("broken_worlds", "overflows"), 0.0
    )
    monkeypatch.setattr(
        run_module,
        "make_iteration",
        lambda ppo, env: lambda state: (state._replace(iteration=state.iteration + 1), numbers),
    )
    return jax.tree.map(jnp.copy, trained[0][0])


def test_a_normaliser_that_is_none_reaches_no_checkpoint(env, counting, tmp_path):
    """Loss and parameters are what they should be: they were worked out before it broke."""
    statistics = counting.normalizer
    mean = jax.tree.map(lambda x: x.at[0].set(jnp.nan), statistics.mean)
    broken = counting._replace(normalizer=statistics.replace(mean=mean))
    with pytest.raises(TrainingDiverged, match="normaliser is not finite at iteration 1"):
        loop = LoopConfig(checkpoint_every=1)
        tiny.train_loop(tmp_path, broken, env, tiny.ppo(3), loop, tiny.CONFIG)
    assert not checkpoints(tmp_path / "checkpoints")


def test_an_interrupted_training_keeps_the_iteration_it_was_in(
    env, trained, counting, tmp_path, monkeypatch
):
    write = MetricLog.write

    def interrupted(log, row):
        write(log, row)
        if row["iteration"] == 3:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(MetricLog, "write", interrupted)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt, match="after iteration 3"):
            tiny.train_loop(tmp_path, counting, env, tiny.ppo(9), LoopConfig(), tiny.CONFIG)
    finally:
        signal.signal(signal.SIGINT, before)
    (path,) = checkpoints(tmp_path / "checkpoints")
    back, _ = restore_checkpoint(path, init_state(tiny.ppo(9), env, seed=9), env)
    assert int(back.iteration) == 3
    same(back.params, trained[0][0].params)


def test_the_time_of_a_resumed_training_goes_on(env, counting, tmp_path):
    header = ",".join(COLUMNS)
    row = ",".join({"iteration": "1", "seconds": "500.0"}.get(name, "16") for name in COLUMNS)
    (tmp_path / "metrics.csv").write_text(f"{header}\n{row}\n")
    state = counting._replace(iteration=jnp.ones((), jnp.int32))
    tiny.train_loop(tmp_path, state, env, tiny.ppo(3), LoopConfig(), tiny.CONFIG)
    with (tmp_path / "metrics.csv").open() as stream:
        seconds = [float(r["seconds"]) for r in csv.DictReader(stream)]
    assert seconds[0] == 500 < seconds[1] < seconds[2] < 600


@pytest.mark.parametrize("speed, known", [(2345.0, 1), (112_345.0, 1), (2345.0, 0)])
def test_count_and_times_are_whole_on_a_narrow_terminal(speed, known):
    figures = {"return": 123.0, "success": 0.67, "force_n": 1.3}
    recent = {name: deque([x][:known]) for name, x in figures.items()}
    counted = {"broken_worlds": 0.0, "overflows": 0.0}
    text = run_module._describe(speed, recent, counted)
    with run_module._progress() as progress:
        progress.add_task(text, total=240, completed=67)
        console = Console(file=io.StringIO(), width=80)
        console.print(progress.get_renderable())
    (line,) = console.file.getvalue().splitlines()
    assert text in line and "67/240 0:00:00 left -:--:--" in line
    assert "return 123, success 67 %, 1.3 N" in line if known else "return -, success - %" in line


def script(folder, iterations, seconds=0.0):
    return subprocess.Popen(
        [sys.executable, str(Path(tiny.__file__)), str(folder), str(iterations), str(seconds)],
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.mark.long
def test_killed_training_resumes_to_the_same_parameters(tmp_path, capsys):
    killed = script(tmp_path / "killed", 4, seconds=0.5)
    deadline = time.monotonic() + 240
    while not checkpoints(tmp_path / "killed" / "checkpoints"):
        assert killed.poll() is None and time.monotonic() < deadline, killed.stdout.read()
        time.sleep(0.05)
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    assert not (tmp_path / "killed" / "parameters.npy").exists()
    # Both at once: the resumed one and, in this process, one that nothing disturbed.
    resumed = script(tmp_path / "killed", 4)
    with jax.default_device(jax.devices("cpu")[0]):
        tiny.main(tmp_path / "unbroken", 4, 0.0)
    output = resumed.communicate(timeout=300)[0]
    assert resumed.returncode == 0, output
    assert '"from": 0' not in output, "nothing was resumed"
    assert '"from": 0' in capsys.readouterr().out
    found, expected = (np.load(tmp_path / n / "parameters.npy") for n in ("killed", "unbroken"))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    "field, value",
    [("worlds", 0), ("unroll", 0), ("worlds", 10), ("discount", 1.5), ("action_std", 0.0)],
)
def test_impossible_training_settings_are_refused_by_name(field, value):
    with pytest.raises(InputError, match=rf"PPOConfig\.{field}"):
        PPOConfig(**{field: value})


OLD = Path(__file__).parent.parent / "data"


@pytest.mark.parametrize("version", [1, 2])
def test_a_checkpoint_of_an_older_version_is_read(env, version):
    """What was learnt is as it was. Before version 3 the policy was that of the last weights."""
    path = OLD / f"v{version}" / "iteration_00000002"
    template = init_state(tiny.ppo(), env, seed=0)
    state, goes_on = restore_checkpoint(path, template, env)
    assert int(state.iteration) == 2
    if version == 1:  # the worlds of then are others, so that they start anew
        assert not goes_on
        same(env.pack(state.env), env.pack(template.env))
    np.testing.assert_array_equal(
        tiny.parameters(state), np.load(path.parent / f"{path.name}_parameters.npy")
    )
    same(state.policy, state.params.policy)


def test_worlds_with_other_arrays_start_anew(env, trained, tmp_path):
    path = save_checkpoint(tmp_path, trained[0][1], env, {})
    more = tiny.make_env(worlds=8)
    template = init_state(tiny.ppo(worlds=8), more, seed=0)
    state, goes_on = restore_checkpoint(path, template, more)
    assert not goes_on
    same(state.params, trained[0][1].params)


def test_a_checkpoint_of_a_newer_version_is_refused(env, trained, tmp_path):
    path = save_checkpoint(tmp_path, trained[0][1], env, {})
    manifest = json.loads((path / "manifest.json").read_text())
    (path / "manifest.json").write_text(json.dumps(manifest | {"version": 4}))
    with pytest.raises(FileError, match="version 4, which needs a newer package"):
        restore_checkpoint(path, trained[0][0], env)
