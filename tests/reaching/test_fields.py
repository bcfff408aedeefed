"""The task-space fields: gates, straight ways, via-points, pads."""

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.geometry.signed_distance import Sphere
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching import fields
from mjx_grasp.reaching.config import FieldConfig

CONFIG = FieldConfig()


def _ball(radius=0.04):
    return Surroundings.still(Sphere(jnp.float32(radius)), jnp.zeros(3), jnp.eye(3))


def test_gate_is_half_at_its_threshold():
    assert float(fields.gate(jnp.float32(0.03), 0.03, 0.01)) == pytest.approx(0.5)
    assert float(fields.gate(jnp.float32(0.2), 0.03, 0.01)) == pytest.approx(1.0)
    assert float(fields.gate(jnp.float32(-0.1), 0.03, 0.01)) == pytest.approx(0.0, abs=1e-6)


def test_directions_cover_the_sphere_evenly():
    directions = fields.sphere_directions(100)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-6)
    assert np.linalg.norm(directions.mean(axis=0)) < 0.02
    gaps = np.linalg.norm(directions[:, None] - directions, axis=-1) + 10 * np.eye(100)
    assert gaps.min(axis=1).min() > 0.2 and gaps.min(axis=1).max() < 0.5


def test_a_free_way_is_straight_and_a_blocked_one_goes_round():
    tips = jnp.asarray([[0.2, 0.0, 0.0], [0.2, 0.2, 0.0], [-0.2, 0.0, 0.0]])
    goals = jnp.asarray([[0.08, 0.0, 0.0], [-0.05, 0.2, 0.0], [0.08, 0.0, 0.0]])
    heading, length = fields.way_points(tips, goals, _ball(), CONFIG)
    np.testing.assert_allclose(heading[:2], goals[:2])
    np.testing.assert_allclose(length[:2], [0.12, 0.25], atol=1e-6)
    # The third would go through the ball: its via-point is on the sphere around the goal, and
    # both legs are clear.
    via = np.asarray(heading[2])
    assert np.linalg.norm(via - goals[2]) == pytest.approx(CONFIG.via_radius, abs=1e-6)
    for a, b in ((tips[2], via), (via, goals[2])):
        points = np.asarray(a) + np.linspace(0, 1, 50)[:, None] * (np.asarray(b) - np.asarray(a))
        assert np.linalg.norm(points, axis=1).min() > 0.04
    assert length[2] == pytest.approx(np.linalg.norm(tips[2] - via) + CONFIG.via_radius, abs=1e-5)


def test_speed_law():
    tips = jnp.zeros((3, 3))
    goals = jnp.asarray([[0.3, 0.0, 0.0], [0.05, 0.0, 0.0], [0.001, 0.0, 0.0]])
    length = jnp.linalg.norm(goals, axis=1)
    v = fields.tip_velocities(tips, goals, length, CONFIG, dt=0.01)
    np.testing.assert_allclose(v[:, 0], [0.5, 0.25, 0.005], rtol=1e-5)
    fast = fields.tip_velocities(tips, goals, length, CONFIG, dt=1.0)
    np.testing.assert_allclose(fast[2, 0], 0.001, rtol=1e-5)
    still = fields.tip_velocities(tips, tips, jnp.zeros(3), CONFIG, dt=0.01)
    assert np.all(still == 0.0)


def test_pads_turn_towards_each_other_on_arrival_only():
    goals = jnp.asarray([[0.0, -0.05, 0.0], [0.02, 0.05, 0.0], [-0.02, 0.05, 0.0]])
    wanted = fields.pad_goals(goals)
    np.testing.assert_allclose(wanted[0], [0, 1, 0], atol=1e-6)
    assert wanted[1, 1] < -0.9 and wanted[1, 0] < 0
    normals = jnp.asarray([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    turn, weight = fields.pad_rotation(normals, wanted, jnp.float32(0.0), CONFIG)
    np.testing.assert_allclose(turn[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(
        turn[1], CONFIG.orientation_gain * np.cross(normals[1], wanted[1]), atol=1e-6
    )
    assert weight[0] < 1e-4 and weight[1] > 0.9 * CONFIG.orientation_weight
    _, away = fields.pad_rotation(normals, wanted, jnp.float32(0.2), CONFIG)
    assert np.all(away < 1e-6)
