"""The object moves, jumps and turns, an obstacle crosses the way: the controller follows."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.signed_distance import Cylinder
from mjx_grasp.reaching.controller import Outcome, Reacher
from mjx_grasp.reaching.planning import plan_reach, start_library
from mjx_grasp.reaching.presets import preset
from mjx_grasp.reaching.surroundings import Surroundings
from mjx_grasp.selection import cylinder_candidates

TICKS, DT = 600, 0.01
SCENARIOS = ("still", "drift", "jump", "turn", "obstacle")
# Upright and lying cylinders, none under the hand at home.
SHAPES = np.array([[0.03, 0.06], [0.035, 0.05], [0.03, 0.08]], np.float32)
CENTRES = np.array([[0.5, -0.15, 0.06], [0.45, -0.1, 0.035], [0.6, -0.12, 0.08]], np.float32)
LYING = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]], np.float32)
ROTATIONS = np.stack([np.eye(3, dtype=np.float32), LYING, np.eye(3, dtype=np.float32)])


def _pose(scenario, p, R, tick):
    """Where the object is at a tick: it moves between 0.6 s and 1.6 s."""
    moving = jnp.clip((tick - 60) * DT, 0.0, 1.0)
    drift = jnp.asarray([0.0, 0.1, 0.0]) * moving
    jump = jnp.asarray([0.0, 0.05, 0.0]) * (tick >= 100)
    turn = so3.exp(jnp.asarray([0.0, 0.0, 0.6]) * moving)
    p = p + jnp.where(scenario == 1, drift, 0.0) + jnp.where(scenario == 2, jump, 0.0)
    return p, jnp.where(scenario == 3, turn, jnp.eye(3)) @ R


def _obstacle(scenario, p, tick):
    """A ball of 30 mm that crosses above the object at 0.1 m/s and stays away afterwards."""
    along = -0.30 + 0.1 * jnp.minimum(tick * DT, 6.0)
    centre = p + jnp.asarray([0.0, 0.0, 0.14]) + jnp.asarray([1.0, 0.0, 0.0]) * along
    centre = jnp.where(scenario == 4, centre, jnp.asarray([0.0, 0.0, 5.0]))
    return jnp.append(centre, 0.03)[None]


@pytest.fixture(scope="module")
def runs(body):
    """All scenarios with a preset, made once."""
    return cache(lambda name: _run(name, body))


@pytest.fixture(scope="module", params=["paper", "default"])
def run(request, runs):
    return runs(request.param)


def _run(name, body):
    """All scenarios of all objects: ticks of ``[scenario, object, time, …]``."""
    settings = preset(name)
    config = settings.reach
    never = replace(
        config.controller,
        handoff_midpoint=-1.0,
        handoff_largest=-1.0,
        fine_timeout=np.inf,
        timeout=np.inf,
    )
    config = replace(config, controller=never)
    if config.fields.via_points:
        config = replace(config, fields=replace(config.fields, via_points=30))
    # Obstacles are followed in both: their velocity is no part of the published controller.
    config = replace(config, limits=replace(config.limits, follow_object=True))
    reacher = Reacher(body, config, settings.selection)
    home = jnp.asarray(body.home)

    def candidates_of(shape):
        return cylinder_candidates(shape.radius, shape.half_length, body.robot.hand.span)

    plans = None
    if settings.plan:
        plan = replace(settings.plan, library=20_000)
        library = start_library(body, plan)

        def planned(shape, p, R):
            return plan_reach(
                body,
                config,
                settings.selection,
                plan,
                library,
                candidates_of(shape),
                Surroundings.still(shape, p, R),
                home,
                jax.random.key(0),
            ).plans

        shapes = Cylinder(SHAPES[:, 0], SHAPES[:, 1])
        plans = jax.jit(jax.vmap(planned))(shapes, CENTRES, ROTATIONS)

    def world(scenario, shape, p, R, plans):
        candidates = candidates_of(shape)
        state = reacher.start(home, candidates, p, R, plans, obstacles=1)

        def tick(carry, t):
            state, q = carry
            p_t, R_t = _pose(scenario, p, R, t)
            ball = _obstacle(scenario, p, t)
            state, done = reacher.tick(state, q, shape, candidates, p_t, R_t, ball, plans)
            report = done.report
            kept = (q, done.velocity, report.error, report.object_distance)
            kept += (report.obstacle_distance, report.feasible, done.goals, state.outcome)
            return (state, q + DT * done.velocity), kept

        return jax.lax.scan(tick, (state, home), jnp.arange(TICKS))[1]

    over_objects = jax.vmap(world, in_axes=(None, 0, 0, 0, 0))
    over_all = jax.jit(jax.vmap(over_objects, in_axes=(0, None, None, None, None)))
    shapes = Cylinder(SHAPES[:, 0], SHAPES[:, 1])
    found = over_all(jnp.arange(len(SCENARIOS)), shapes, CENTRES, ROTATIONS, plans)
    names = ("q", "velocity", "error", "object", "obstacle", "feasible", "goals", "outcome")
    return dict(zip(names, map(np.asarray, found), strict=True))


def test_limits_hold_on_every_tick(run, body):
    assert np.all(np.abs(run["velocity"]) <= body.velocity_limit * (1 + 1e-6))
    assert np.all(run["q"] >= body.lower - 1e-5) and np.all(run["q"] <= body.upper + 1e-5)
    assert np.all(run["outcome"] == Outcome.RUNNING)


def test_clearance_is_held(run):
    """10 mm are asked for; half of it may go while a jump or a motion is made up for."""
    jumped = SCENARIOS.index("jump")
    others = np.arange(len(SCENARIOS)) != jumped
    assert run["object"][others].min() > 0.005
    assert run["obstacle"].min() > 0.005
    # A jump of 50 mm may put the object into the hand; it is out again within a second.
    assert run["object"][jumped, :, :100].min() > 0.005
    assert run["object"][jumped, :, 200:].min() > 0.005


def test_targets_follow_the_object(run):
    drift = SCENARIOS.index("drift")
    moved = run["goals"][drift] - run["goals"][SCENARIOS.index("still")]
    before = np.linalg.norm(moved[:, :50], axis=-1)
    assert before.max() < 1e-5


def test_the_hand_arrives_though_the_object_moves(runs):
    """With the default; how often the published controller arrives is measured by the sweep."""
    last = runs("default")["error"][:, :, -50:].max(axis=(2, 3))
    assert np.all(last[SCENARIOS.index("still")] < 0.01), last
    # A planned posture need not be within the arm's reach any more after the object has turned or
    # moved 100 mm; then only a new plan helps, which is not made here.
    for name in ("drift", "turn", "jump"):
        assert np.sum(last[SCENARIOS.index(name)] < 0.02) >= 2, (name, last)
    # The obstacle drives the hand away from above the object; not all are back within 3 s.
    assert np.any(last[SCENARIOS.index("obstacle")] < 0.02), last


def test_commands_do_not_jump_without_cause(run):
    """Between ticks of the undisturbed reach, arm commands change smoothly."""
    arm = run["velocity"][SCENARIOS.index("still"), :, 5:, :7]
    change = np.abs(np.diff(arm, axis=1))
    assert np.percentile(change, 99) < 0.3
