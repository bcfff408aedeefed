"""Ticks whose programme has no solution: deep inside the object, not all clearances at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.signed_distance import Cylinder
from mjx_grasp.grasp.candidates import cylinder_candidates
from mjx_grasp.posture.body import FINGERS, PALM
from mjx_grasp.posture.clearances import proximities
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.command import programme
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.presets import reach_preset
from mjx_grasp.reaching.state import ReachOutcome

SHAPE = Cylinder(jnp.float32(0.03), jnp.float32(0.08))
NONE = jnp.zeros((0, 4))
STATES = 24


@pytest.fixture(scope="module")
def pressed(body):
    """Poses of an object between palm and fingertips of the hand at home, which it overlaps."""
    motion = body.kinematics.motion(jnp.asarray(body.home))
    palm, tips = np.asarray(motion.pos[PALM]), np.asarray(motion.pos[:FINGERS]).mean(axis=0)
    rng = np.random.default_rng(0)
    share = rng.uniform(0, 1, (STATES, 1))
    p = palm + share * (tips - palm) + rng.normal(scale=0.02, size=(STATES, 3))
    R = jax.vmap(so3.exp)(jnp.asarray(rng.normal(size=(STATES, 3)), jnp.float32))
    return jnp.asarray(p, jnp.float32), R


def _tick(body, name, p, R):
    """One tick of each state: what it did and solved, distances before and after it, [m]."""
    settings = reach_preset(name)
    reacher = Reacher(body, settings.reach, settings.selection)
    candidates = cylinder_candidates(SHAPE.radius, SHAPE.half_length, body.robot.hand.span)
    q = jnp.asarray(body.home)

    def distances(q, p, R):
        around = Surroundings.still(SHAPE, p, R)
        clearances = settings.reach.limits.clearances
        near, safe = proximities(body, body.kinematics.motion(q), around, clearances)
        return jnp.concatenate([part.distance for part in near.values()]), safe

    def one(p, R):
        state = reacher.start(q, candidates, p, R)
        situation = SHAPE, candidates, p, R, NONE
        aim = reacher.aim(state, q, *situation)
        built = programme(body, settings.reach, q, aim.goals, aim.around, state.memory)
        state, done = reacher.tick(state, q, *situation)
        before, safe = distances(q, p, R)
        after, _ = distances(q + settings.reach.controller.dt * done.velocity, p, R)
        return state, done, built.problem, before, after, safe

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(p, R))


def test_an_infeasible_tick_commands_zero_and_is_counted(body, pressed):
    state, done, *_ = _tick(body, "paper", *pressed)
    assert done.targets.valid.all() and np.all(state.outcome == ReachOutcome.RUNNING)
    infeasible = ~done.report.feasible
    assert 0.5 * STATES < infeasible.sum() < STATES
    assert np.all(done.report.object_distance[infeasible] < 0)
    assert np.all(done.velocity[infeasible] == 0.0)
    np.testing.assert_array_equal(state.infeasible, infeasible)
    # Not because of the poses: what has a solution moves.
    assert np.all(np.abs(done.velocity[~infeasible]).max(axis=1) > 0)


@pytest.mark.long
def test_an_infeasible_tick_that_escapes_is_counted_and_makes_nothing_worse(body, pressed):
    state, done, problem, before, after, safe = _tick(body, "default", *pressed)
    assert done.targets.valid.all()
    infeasible = ~done.report.feasible
    assert infeasible.sum() > 0.5 * STATES
    np.testing.assert_array_equal(state.infeasible, infeasible)
    moving = infeasible & (np.abs(done.velocity).max(axis=1) > 0)
    assert moving.sum() >= 3
    # A row that is violated may not be violated more, by the programme and as the robot moves.
    config = reach_preset("default").reach
    rate = np.einsum("wmj,wj->wm", problem.A, done.velocity)
    violated = before < safe
    tolerance = config.solver.feasible
    assert np.all(rate[violated & moving[:, None]] >= -tolerance)
    lost = np.where(violated & moving[:, None], before - after, -np.inf)
    assert lost.max() < config.controller.dt * tolerance
    # Where it escapes it gets out of something.
    gained = np.where(violated, after - before, -np.inf).max(axis=1)
    assert np.all(gained[moving] > 1e-3)
