"""The closing task as learner and evaluation see it: protocol, summary, rewards."""

import inspect
from dataclasses import replace
from functools import partial
from typing import get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scripted import ScriptedPhysics, draw_of, still

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.trials import run_trials
from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.tasks.closing import ClosingTask
from mjx_grasp.tasks.config import ClosingTaskConfig, RewardConfig, StartNoise, SuccessConfig
from mjx_grasp.tasks.rewards import RewardTerm
from mjx_grasp.tasks.task import EpisodeSummary, Task, TaskTick

TICKS = 30
CONFIG = ClosingTaskConfig(episode_s=0.3, success=SuccessConfig(hold_s=0.05))
PUBLISHED = ("reach", "lift", "contact", "action_rate", "action_acceleration")
WORLDS = ("held", "dropped", "slipped", "left", "broken")


def script_of(starts):
    """What a small world of every kind goes through, with forces of its own."""
    script, rng = still(starts, [0] * len(WORLDS), TICKS), np.random.default_rng(0)
    measured, truth = script
    truth.tip_found[4:] = True
    truth.finger_force[:] = rng.uniform(0.5, 2.0, truth.finger_force.shape)
    measured.qd[:] = rng.normal(size=measured.qd.shape) * 0.1
    for x in (truth.object_pos, measured.palm_pos):
        x[10:, :3, 2] += 0.12
        x[13:, WORLDS.index("dropped"), 2] -= 0.12
    truth.object_pos[12:, WORLDS.index("slipped"), 1] += 0.05
    measured.q[7, WORLDS.index("broken")] = np.nan
    return script


def make(scene, starts, config=CONFIG, **settings):
    physics = ScriptedPhysics(scene, script_of(starts))
    return ClosingTask(physics, starts, config, StartNoise(offset_m=0.0), **settings)


@pytest.fixture(scope="module")
def task(scene, starts):
    return make(scene, starts)


def actions_of(seed=0):
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.uniform(-1, 1, (TICKS, len(WORLDS), 15)), jnp.float32)


def play(task, actions=None):
    """The last state, and what each tick yielded [t, w]."""
    actions = actions_of() if actions is None else actions
    start = task.start(draw_of([0] * len(WORLDS)))[0]
    return jax.device_get(jax.jit(lambda s: jax.lax.scan(task.tick, s, actions))(start))


@pytest.fixture(scope="module")
def played(task):
    return play(task)


def parameters(method):
    return [(p.name, p.kind, p.default) for p in inspect.signature(method).parameters.values()]


def test_the_closing_task_is_a_task(task):
    """Name by name, and argument by argument."""
    assert isinstance(task, Task) and not isinstance(task.closer, Task)
    methods = [n for n, f in vars(Task).items() if inspect.isfunction(f) and n[0] != "_"]
    assert len(methods) == 8
    for name in methods:
        assert parameters(getattr(ClosingTask, name)) == parameters(getattr(Task, name)), name
    facts = get_type_hints(Task)
    assert len(facts) == 5
    for name, kind in facts.items():
        assert kind not in (int, float) or type(getattr(task, name)) is kind, name


def test_its_numbers_are_those_of_its_settings(task, starts):
    assert (task.control_dt, task.episode_ticks, task.action_size) == (0.01, TICKS, 15)
    assert task.starts is starts
    assert task.reward_names == PUBLISHED
    draw = task.draw(jax.random.PRNGKey(0), 7)
    assert {x.shape[0] for x in jax.tree.leaves(draw)} == {7}


def test_a_tick_yields_what_it_says(task, played):
    _, out = played
    assert isinstance(out, TaskTick)
    shape = (TICKS, len(WORLDS))
    assert {n: r.shape for n, r in out.rewards.items()} == dict.fromkeys(PUBLISHED, shape)
    assert out.broken.shape == out.overflow.shape == shape
    assert out.obs["state"].shape == (*shape, 66)


def test_the_summary_is_what_trials_say(task, starts):
    """Trial by trial, with their forces; nan where trials say that there was no lift."""
    names = [n for n in WORLDS if n != "broken"]
    last, _ = play(task, 0 * actions_of())
    summary = jax.device_get(task.summary(jax.tree.map(jnp.asarray, last)))
    trials = run_trials(task, lambda obs: jnp.zeros((len(WORLDS), 15)), draw_of([0] * 5), 5)
    for name in set(EpisodeSummary._fields) - {"lifting", "force_mean", "force_peak"}:
        found, expected = getattr(summary, name)[:4], getattr(trials, name)[:4]
        np.testing.assert_allclose(found, expected, rtol=1e-5, err_msg=name)
    for name in ("force_mean", "force_peak"):
        found = np.where(summary.lifting, getattr(summary, name), np.nan)[:4]
        np.testing.assert_allclose(found, getattr(trials, name)[:4], rtol=1e-5)
    classes = ("success", "not_held", "slipped", "never_lifted")
    what = {w: [c for c in classes if getattr(summary, c)[i]] for i, w in enumerate(names)}
    assert what == {
        **{"held": ["success"], "dropped": ["not_held"]},
        **{"slipped": ["slipped"], "left": ["never_lifted"]},
    }


def test_a_summary_can_be_asked_for_at_any_time(task):
    """Before the first tick nothing has come of anything."""
    summary = task.summary(task.start(draw_of([0, 4]))[0])
    np.testing.assert_array_equal(summary.row, [0, 4])
    assert not summary.success.any() and not summary.lifting.any()
    assert summary.never_lifted.all()
    for name in ("force_mean", "force_peak", "peak_rise"):
        np.testing.assert_array_equal(getattr(summary, name), 0.0)


def test_a_task_goes_on_from_what_was_packed(task):
    actions = actions_of(1)
    state, _ = jax.jit(lambda s: jax.lax.scan(task.tick, s, actions[:9]))(
        task.start(draw_of([0] * 5))[0]
    )
    stored = jax.tree.map(np.asarray, task.pack(state))
    again = task.unpack(jax.tree.map(jnp.asarray, stored))
    on = jax.jit(lambda s: jax.lax.scan(task.tick, s, actions[9:]))
    jax.tree.map(np.testing.assert_array_equal, on(again), on(state))


# Rewards.


def test_terms_sum_to_what_a_learner_is_paid(task, played):
    """Tick by tick, and their record beside it; a broken world's tick pays nothing."""
    env, actions, (_, out) = BraxTask(task, len(WORLDS), stagger=False), actions_of(), played
    state, step = jax.jit(env.reset)(jax.random.PRNGKey(0)), jax.jit(env.step)
    # The same start as in `played`: rows of the scripted worlds say nothing.
    state = state.replace(pipeline_state=task.start(draw_of([0] * len(WORLDS)))[0])
    whole = slice(0, WORLDS.index("broken"))
    for t in range(TICKS - 1):
        state = step(state, actions[t])
        terms = np.asarray(state.info["reward_terms"])
        assert terms.shape == (len(WORLDS), len(PUBLISHED))
        np.testing.assert_allclose(terms.sum(-1), state.reward, rtol=1e-5, atol=1e-6)
        for k, name in enumerate(PUBLISHED):
            np.testing.assert_allclose(
                terms[whole, k], out.rewards[name][t, whole], rtol=1e-5, atol=1e-6
            )
        if t == 7:
            assert state.done[-1] and not terms[-1].any()


@pytest.mark.parametrize(
    "name",
    ["lift", *(pytest.param(n, marks=pytest.mark.long) for n in PUBLISHED if n != "lift")],
)
def test_a_weight_scales_its_own_term_and_no_other(scene, starts, played, name):
    weight = getattr(CONFIG.reward, name)
    heavier = replace(CONFIG, reward=replace(CONFIG.reward, **{name: -2.5 * weight}))
    _, out = play(make(scene, starts, heavier))
    _, before = played
    assert np.abs(before.rewards[name]).max() > 1e-3
    for other, reward in out.rewards.items():
        times = -2.5 if other == name else 1.0
        np.testing.assert_allclose(reward, times * before.rewards[other], rtol=1e-5, atol=1e-7)


def test_no_weight_no_pay(scene, starts):
    none = RewardConfig(**dict.fromkeys(PUBLISHED, 0.0))
    _, out = play(make(scene, starts, replace(CONFIG, reward=none)))
    assert out.rewards.keys() == set(PUBLISHED)
    assert not any(r.any() for r in out.rewards.values())


def test_extra_terms_are_paid_beside_the_tasks_own(scene, starts, played):
    extra = (
        RewardTerm("high", 2.0, lambda m: m.truth.object_pos[:, 2]),
        RewardTerm("always", -0.5, lambda m: jnp.ones(m.slip.shape)),
    )
    task = make(scene, starts, extra_terms=extra)
    assert task.reward_names == (*PUBLISHED, "high", "always")
    state, out = play(task)
    truth, sound = script_of(starts).truth, ~out.broken
    np.testing.assert_allclose(out.rewards["high"], 2.0 * truth.object_pos[..., 2] * sound)
    np.testing.assert_array_equal(out.rewards["always"], -0.5 * sound)
    for name in PUBLISHED:
        np.testing.assert_array_equal(out.rewards[name], played[1].rewards[name])
    # What is paid changes nothing else.
    jax.tree.map(partial(np.testing.assert_allclose, atol=1e-6), state, played[0])


def test_terms_see_the_tick_that_they_are_paid_for(scene, starts, played):
    """Actions of this tick and the two before it, the stage it began in, what came of it."""
    actions = actions_of()
    seen = {
        "action": lambda m: m.action[:, 3],
        "last_action": lambda m: m.last_action[:, 3],
        "before_last": lambda m: m.before_last[:, 3],
        "lifting": lambda m: m.lifting.astype(jnp.float32),
        "slip": lambda m: m.slip,
        "lift_speed": lambda m: m.lift_speed,
        "joint": lambda m: m.measured.q[:, 2],
        "force": lambda m: m.truth.finger_force[:, 1, 0],
    }
    extra = tuple(RewardTerm(f"see {name}", 1.0, value) for name, value in seen.items())
    _, out = play(make(scene, starts, extra_terms=extra))
    found = {name: out.rewards[f"see {name}"][:, :4] for name in seen}
    measured, truth = script_of(starts)
    acted = np.concatenate([np.zeros((2, 4)), actions[:, :4, 3]])
    for back, name in enumerate(("action", "last_action", "before_last")):
        np.testing.assert_allclose(found[name], acted[2 - back : len(acted) - back])
    # All three touch after tick 4: the lift is the stage from tick 5 on.
    np.testing.assert_array_equal(found["lifting"], np.arange(TICKS)[:, None] >= [5] * 4)
    np.testing.assert_allclose(found["joint"], measured.q[:, :4, 2])
    np.testing.assert_allclose(found["force"], truth.finger_force[:, :4, 1, 0])
    slipped = found["slip"][:, WORLDS.index("slipped")]
    np.testing.assert_allclose(slipped[:12], 0.0, atol=1e-6)
    np.testing.assert_allclose(slipped[12:], 0.05, atol=1e-6)
    np.testing.assert_array_equal(found["lift_speed"], 0.0)  # its delay is not over


@pytest.mark.parametrize("names", [("reach",), ("mine", "mine")])
def test_two_terms_of_one_name_are_refused(scene, starts, names):
    extra = tuple(RewardTerm(name, 1.0, lambda m: m.slip) for name in names)
    with pytest.raises(InputError, match=f"extra_terms: found '.*{names[-1]}.*another name"):
        make(scene, starts, extra_terms=extra)
