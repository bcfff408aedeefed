"""Inverse kinematics: what it reaches, what it keeps, and the laws of its batches and rows."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_grasp.geometry.signed_distance import Sphere
from mjx_grasp.posture.body import FINGERS, PALM
from mjx_grasp.posture.config import ClearanceConfig, IkConfig
from mjx_grasp.posture.draw import draw_postures
from mjx_grasp.posture.ik import TipGoals, linearised, solve_ik
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.sim.scene import ObjectArea

PROBLEMS, RESTARTS = 48, 4
NOWHERE = np.float32([0.0, 0.0, 9.0])
# Nothing but the tips: what is reachable must be reached.
NONE = ClearanceConfig(**dict.fromkeys(("object", "obstacles", "hand_table", "arm_table"), 0.0),
                       fingers=0.0, arm=0.0, joint_limits=0.0)  # fmt: skip
PLAIN = IkConfig(clearance_weight=0.0, posture_weight=1e-4, idle_weight=None)
CLOSE = replace(NONE, object=0.003, hand_table=0.003, fingers=0.003)


def around_ball(p_wo, radius=0.03):
    return Surroundings.still(Sphere(jnp.float32(radius)), jnp.asarray(p_wo), jnp.eye(3))


def solver(body, config=PLAIN, clearances=NONE):
    """Solves problems stacked in front; the object is a ball at a place of each."""

    def solve(tips, pads, start, p_wo):
        home = jnp.asarray(body.home)
        goals, around = TipGoals(tips, pads), around_ball(p_wo)
        return solve_ik(body, config, clearances, goals, around, start, home)

    return jax.jit(jax.vmap(solve))


@pytest.fixture(scope="module")
def reachable(body):
    """Targets that feasible configurations, unknown to the solver, do reach."""
    q = jnp.asarray(draw_postures(body, PROBLEMS, ObjectArea(), seed=1))
    motion = jax.jit(jax.vmap(body.kinematics.motion))(q)
    return np.asarray(motion.pos[:, :FINGERS]), np.asarray(motion.mat[:, FINGERS:PALM, :, 0]), q


@pytest.fixture(scope="module")
def starts(body, reachable):
    """Of each problem the nearest of some other configurations."""
    q = draw_postures(body, 3000, ObjectArea(), seed=0)
    pos, mat = map(np.asarray, jax.jit(jax.vmap(body.kinematics.forward))(q))
    ends = (reachable[0], pos[:, :FINGERS]), (reachable[1], mat[:, FINGERS:PALM, :, 0])
    tips, pads = (np.sum((have - want[:, None]) ** 2, axis=(2, 3)) for want, have in ends)
    gap = tips + 0.05**2 * pads
    return q[np.argsort(gap, axis=1)[:, :RESTARTS]]


@pytest.fixture(scope="module")
def solve(body):
    return solver(body)


@pytest.fixture(scope="module")
def solution(solve, starts, reachable):
    """All problems from all starts, restart by restart."""
    tips, pads, _ = reachable
    far = np.tile(NOWHERE, (PROBLEMS, 1))
    solved = [solve(tips, pads, starts[:, k], far) for k in range(RESTARTS)]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *solved)


def test_reachable_targets_are_reached(solution):
    worst = solution.error.max(axis=1).reshape(RESTARTS, PROBLEMS)
    assert np.mean(worst.min(axis=0) < 1e-3) >= 0.9
    assert np.mean(worst < 1e-3) >= 0.5


def test_pads_come_close_to_where_they_should_face(body, reachable, solution):
    mat = np.asarray(jax.jit(jax.vmap(body.kinematics.forward))(solution.q)[1])
    mat = mat[:, FINGERS:PALM, :, 0]
    wanted = np.tile(reachable[1], (RESTARTS, 1, 1))
    angle = np.arccos(np.clip(np.sum(mat * wanted, axis=-1), -1, 1)).max(axis=1)
    assert np.median(angle.reshape(RESTARTS, PROBLEMS).min(axis=0)) < np.radians(15)


def test_limits_are_respected_and_idle_joints_stay(body, solution):
    q, solved = solution.q, body.arm | body.grasping
    assert np.all(q >= body.lower - 1e-6) and np.all(q <= body.upper + 1e-6)
    assert (~solved).sum() == 8
    np.testing.assert_array_equal(q[:, ~solved], np.tile(body.home[~solved], (len(q), 1)))
    # The flag says what the numbers say.
    slack = np.minimum(q - body.lower, body.upper - q)[:, solved].min(axis=1)
    flagged = solution.at_limit
    assert np.all(slack[flagged] < 1e-6) and np.all(slack[~flagged] > 0)
    assert 0 < flagged.mean() < 1


def test_errors_are_those_of_native_mujoco(body, reachable, solution):
    model = mujoco.MjModel.from_xml_path(str(body.robot.mjcf))
    data = mujoco.MjData(model)
    targets = np.tile(reachable[0], (RESTARTS, 1, 1))
    for k in range(0, len(targets), 37):
        data.qpos[:] = solution.q[k]
        mujoco.mj_kinematics(model, data)
        tips = np.array([data.site(f.tip_site).xpos for f in body.robot.hand.fingers])
        error = np.linalg.norm(tips - targets[k], axis=1)
        np.testing.assert_allclose(error, solution.error[k], atol=2e-6)


def test_a_start_at_the_solution_stays_and_an_unreachable_target_says_so(solve, reachable):
    tips, pads, q = reachable
    away = np.tile(NOWHERE, (PROBLEMS, 1))
    assert np.asarray(solve(tips, pads, q, away).error).max() < 1e-3
    far = solve(tips + np.float32([3, 0, 0]), pads, q, away)
    assert np.asarray(far.error).max(axis=1).min() > 1.0
    assert all(np.isfinite(np.asarray(leaf, float)).all() for leaf in far)


def test_a_problem_that_cannot_be_evaluated_is_not_taken_for_solved(solve, reachable):
    tips, pads, q = reachable
    start, tips = np.array(q), tips.copy()
    start[0, 0], tips[1, 2] = np.nan, np.nan
    found = solve(tips, pads, start, np.tile(NOWHERE, (PROBLEMS, 1)))
    assert np.all(np.isinf(found.error[:2])) and np.all(np.isinf(found.cost[:2]))
    assert np.asarray(found.error[2:]).max() < 1e-3


def test_clearances_move_the_hand_out_of_an_object(body, solve, reachable):
    tips, pads, q = reachable
    # A ball between palm and tips: in the way, though the tips are clear of it.
    palm = np.asarray(jax.jit(jax.vmap(lambda q: body.kinematics.forward(q)[0][PALM]))(q))
    p_wo = np.float32(0.35 * tips.mean(axis=1) + 0.65 * palm)
    careful = solver(body, IkConfig(idle_weight=None, clearance_weight=1.0), CLOSE)
    before = np.asarray(solve(tips, pads, q, p_wo).penetration)
    found = careful(tips, pads, q, p_wo)
    blocked = before > 0.01
    assert blocked.sum() > 10
    assert np.median(np.asarray(found.penetration)[blocked]) < 0.2 * np.median(before[blocked])
    # What lacks a clearance overlaps by less.
    assert np.all(found.missing >= found.penetration)


@pytest.mark.long
def test_batched_is_looped_and_jit_is_eager(body, reachable, starts):
    tips, pads, _ = reachable
    arguments = tips[:3], pads[:3], jnp.asarray(starts[:3, 0]), np.tile(NOWHERE, (3, 1))
    config = replace(PLAIN, iterations=6)
    batched = solver(body, config, CLOSE)(*arguments)
    home = jnp.asarray(body.home)
    for k in range(3):
        t, p, start, p_wo = (x[k] for x in arguments)
        goals = TipGoals(jnp.asarray(t), jnp.asarray(p))
        one = solve_ik(body, config, CLOSE, goals, around_ball(p_wo), start, home)
        np.testing.assert_allclose(batched.q[k], one.q, atol=1e-3)
        np.testing.assert_allclose(batched.error[k], one.error, atol=1e-4)


@pytest.mark.parametrize("clearances", [CLOSE, ClearanceConfig().wider(0.03)])
def test_rows_are_derivatives_of_the_errors(body, reachable, clearances):
    tips, pads, q = reachable
    goals = TipGoals(jnp.asarray(tips[0]) + 0.01, jnp.asarray(pads[1]))
    around = around_ball(tips[2].mean(axis=0) + np.float32([0, 0.02, 0]))
    at = jax.jit(partial(linearised, body, IkConfig(), clearances, goals, around))
    found, step, columns = at(q[2]), 1e-3, []  # wide enough for float32
    for direction in np.eye(len(body.lower), dtype=np.float32):
        ahead, behind = at(q[2] + step * direction).errors, at(q[2] - step * direction).errors
        columns.append((ahead - behind) / (2 * step))
    error = np.abs(np.stack(columns, axis=1) - np.asarray(found.rows)).max(axis=1)
    assert np.all(error[: 6 * FINGERS] < 1e-3)
    # Of the clearances some are missing; a row may change its nearest member within the step.
    missing = np.asarray(found.errors[6 * FINGERS :]) > 0
    assert missing.sum() >= 3
    assert np.mean(error[6 * FINGERS :] < 2e-3) > 0.95


@pytest.mark.long
def test_what_is_held_is_held_at_the_reference(body, reachable):
    tips, pads, q = reachable
    free = IkConfig(iterations=5, idle_weight=0.0)
    goals = TipGoals(jnp.asarray(tips[0]), jnp.asarray(pads[0]))
    idle = ~(body.arm | body.grasping)
    reference = jnp.asarray(body.home).at[np.flatnonzero(idle)[0]].add(0.1)
    for config, held in ((replace(free, idle_weight=None), True), (free, False)):
        found = solve_ik(body, config, CLOSE, goals, around_ball(tips[0].mean(0)), q[0], reference)
        assert np.array_equal(found.q[idle], reference[idle]) == held
