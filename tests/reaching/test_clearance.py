"""Clearances hold on every tick, whatever the guide asks for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.evaluation.reach.poses import draw_poses
from mjx_grasp.evaluation.reach.sweep import candidates_of, plan_all, sweep
from mjx_grasp.geometry.signed_distance import Cylinder
from mjx_grasp.posture.body import PALM
from mjx_grasp.posture.clearances import proximities
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.command import scaled_back
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.guide import Guide
from mjx_grasp.reaching.planning import Planner, start_library
from mjx_grasp.reaching.presets import for_sweep, reach_preset
from mjx_grasp.reaching.state import Plans

ROUNDING = 1e-6
WORLDS, TICKS = 48, 250


def _senseless_plan(reacher, p_wo, R_wo, seed):
    """Guides to random configurations around home, as if the object were not there."""
    body = reacher.body
    rng = np.random.default_rng(seed)
    spread = np.where(body.arm, 0.8, 1.2)
    q = body.home + rng.uniform(-spread, spread, (3, 2, len(body.home)))
    q = jnp.asarray(np.clip(q, body.lower + 0.1, body.upper - 0.1), jnp.float32)
    motion = jax.jit(jax.vmap(jax.vmap(body.kinematics.motion)))(q)
    guide = Guide(
        known=jnp.ones(3, bool),
        q=q,
        palm_pos=(motion.pos[:, :, PALM] - p_wo) @ R_wo,
        palm_mat=R_wo.T @ motion.mat[:, :, PALM],
        tip_shift=jnp.asarray(rng.uniform(-0.1, 0.1, (3, 3)), jnp.float32),
    )
    eye = jnp.eye(3)
    return Plans(jnp.asarray(rng.integers(0, 360, 3), jnp.int32), eye, eye, guide)


@pytest.mark.long
def test_no_guide_takes_the_hand_into_the_object(body):
    settings = for_sweep(reach_preset("default"))
    reacher = Reacher(body, settings.reach, settings.selection)
    poses = draw_poses(WORLDS, seed=5)
    plans = [_senseless_plan(reacher, poses.p_wo[k], poses.R_wo[k], k) for k in range(WORLDS)]
    plans = jax.tree.map(lambda *leaves: jnp.stack(leaves), *plans)

    def world(shape, p_wo, R_wo, plans):
        candidates, home = candidates_of(reacher, shape), jnp.asarray(body.home)
        state = reacher.start(home, candidates, p_wo, R_wo, plans)

        def tick(carry, _):
            state, q = carry
            state, done = reacher.tick(
                state, q, shape, candidates, p_wo, R_wo, jnp.zeros((0, 4)), plans
            )
            report = done.report
            kept = report.object_distance, report.table_margin, report.finger_distance
            return (state, q + reacher.config.controller.dt * done.velocity), jnp.stack(kept)

        return jax.lax.scan(tick, (state, home), length=TICKS)[1]

    shapes = Cylinder(poses.radius, poses.half_length)
    found = np.asarray(jax.jit(jax.vmap(world))(shapes, poses.p_wo, poses.R_wo, plans))
    to_object, over_table, of_fingers = np.moveaxis(found, 2, 0)
    limits = settings.reach.limits
    safe = to_object[:, 0] >= limits.clearances.object
    assert safe.sum() > 0.8 * WORLDS
    nearest = to_object[safe].min(axis=1)
    # It is driven against the object, and stops there.
    assert np.sum(nearest < limits.clearances.object + 0.001) > 0.2 * WORLDS
    assert nearest.min() >= limits.clearances.object - ROUNDING
    assert over_table[safe].min() >= -ROUNDING
    assert of_fingers[safe].min() >= limits.clearances.fingers - ROUNDING


def test_a_command_is_scaled_back_to_where_the_clearance_ends(body):
    config = reach_preset("default").reach
    limits, dt = config.limits, config.controller.dt
    shape = Cylinder(jnp.float32(0.03), jnp.float32(0.08))
    q = jnp.asarray(body.home)
    palm = body.kinematics.motion(q).pos[PALM]

    def beside(y):
        return Surroundings.still(shape, palm + jnp.asarray([0.0, y, 0.0]), jnp.eye(3))

    @jax.jit
    def distance(q, around):
        near, _ = proximities(body, body.kinematics.motion(q), around, limits.clearances)
        return jnp.min(near["object"].distance), near

    @jax.jit
    def scaled(x, around):
        return scaled_back(body, config, q, x, around, distance(q, around)[1])

    y = -0.3
    for _ in range(20):  # up to the hand
        y += float(distance(q, beside(y))[0]) - 0.0105
    assert float(distance(q, beside(y))[0]) == pytest.approx(0.0105, abs=2e-4)
    rng = np.random.default_rng(0)
    shortened = 0
    for _ in range(40):
        x = jnp.asarray(np.where(body.arm, rng.uniform(-1, 1, len(q)), 0.0), jnp.float32)
        np.testing.assert_array_equal(scaled(x, beside(-0.5)), x)
        taken = scaled(x, beside(y))
        end = float(distance(q + dt * taken, beside(y))[0])
        assert end >= limits.clearances.object - ROUNDING
        room = limits.clearances.object + limits.margin
        free = float(distance(q + dt * x, beside(y))[0]) >= room
        assert np.allclose(taken, x) or not free
        shortened += not np.allclose(taken, x)
    assert shortened > 5


@pytest.mark.long
def test_reaches_that_rocked_into_the_object(body):
    """Poses in which a link or the palm turned about its nearest point into the object."""
    settings = for_sweep(reach_preset("default"))
    reacher = Reacher(body, settings.reach, settings.selection)
    rows = np.array([424, 1832, 2504, 1550, 1290])
    poses = jax.tree.map(lambda leaf: leaf[rows], draw_poses(2752, 2752))
    library = start_library(body, settings.plan)
    plans = plan_all(Planner(reacher, settings.plan), library, poses, len(rows)).plans
    record = sweep(reacher, poses, plans, len(rows))
    assert record.object_distance.min() >= settings.reach.limits.clearances.object - ROUNDING
    # How many reach is measured by the sweep; which of these hard ones do changes with their plans.
    assert np.sum(record.fine_time[:, 2] <= 3.0) >= len(rows) - 1
