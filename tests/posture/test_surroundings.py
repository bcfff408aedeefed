"""Distances and their slopes against MuJoCo's collision detection and finite differences."""

from itertools import combinations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.signed_distance import Box, Cylinder, signed_distance
from mjx_grasp.posture.surroundings import (
    Proximity,
    Surroundings,
    finger_proximity,
    nearest_on_segments,
    object_proximity,
    obstacle_proximity,
    stacked,
    table_proximity,
)
from mjx_grasp.reaching.command import half_spaces
from mjx_grasp.reaching.config import ReachConfig

RADIUS, HALF = 0.035, 0.06


def _configurations(body, count, seed=0):
    rng = np.random.default_rng(seed)
    low = np.maximum(body.lower, body.home - 0.5)
    high = np.minimum(body.upper, body.home + 0.5)
    return rng.uniform(low, high, (count, len(low))).astype(np.float32)


def _around(obstacles=()):
    R = so3.exp(jnp.asarray([0.4, 1.2, -0.3]))
    return Surroundings(
        Cylinder(jnp.float32(RADIUS), jnp.float32(HALF)),
        jnp.asarray([0.52, 0.1, 0.09]),
        R,
        jnp.zeros(6),
        jnp.asarray(np.reshape(obstacles, (-1, 4)), jnp.float32),
        jnp.zeros((len(obstacles), 3)),
    )


@pytest.fixture(scope="module")
def oracle(body):
    """MuJoCo's robot with a cylinder, and the distance between two sets of its geoms."""
    around = _around()
    spec = mujoco.MjSpec.from_file(str(body.robot.mjcf))
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.asarray(around.R_wo, float).ravel())
    spec.worldbody.add_geom(
        name="cylinder",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        pos=np.asarray(around.p_wo, float).tolist(),
        quat=quat.tolist(),
        size=[RADIUS, HALF, 0],
    )
    model = spec.compile()
    data = mujoco.MjData(model)

    def distance(q, first, second):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        return min(
            mujoco.mj_geomDistance(model, data, a, b, 1.0, None) for a in first for b in second
        )

    def geoms(*bodies):
        ids = [model.body(name).id for name in bodies]
        return [g for g in range(model.ngeom) if model.geom_bodyid[g] in ids]

    return distance, geoms, model.geom("cylinder").id


@pytest.mark.parametrize("kind", [Cylinder, Box])
def test_nearest_points_of_segments_against_dense_sampling(kind):
    shape = {
        Cylinder: Cylinder(jnp.float32(RADIUS), jnp.float32(HALF)),
        Box: Box(jnp.array([0.02, 0.03, 0.06], jnp.float32)),
    }[kind]
    rng = np.random.default_rng(4)
    start = rng.uniform(-0.12, 0.12, (600, 3)).astype(np.float32)
    end = start + rng.uniform(-0.04, 0.04, start.shape).astype(np.float32)
    end[:10] = start[:10]
    share = np.linspace(0, 1, 301, dtype=np.float32)[:, None, None]
    along = signed_distance(shape, jnp.asarray(start + share * (end - start)))
    exact = np.asarray(along).min(axis=0)
    outside = exact > 0
    t, found, low, high = nearest_on_segments(shape, jnp.asarray(start), jnp.asarray(end))
    at_t = signed_distance(shape, jnp.asarray(start) + t[:, None] * (end - start))
    np.testing.assert_allclose(found, at_t, atol=1e-6)
    np.testing.assert_allclose([low, high], along[np.array([0, -1])], atol=1e-6)
    excess = (np.asarray(found) - exact)[outside]
    assert excess.max() < 3e-4 and np.percentile(excess, 95) < 1e-5
    # The ends and the middle alone would not do.
    assert np.percentile(np.asarray(along)[[0, 150, 300]].min(axis=0) - exact, 95) > 3e-4


def test_distance_to_the_object_is_that_of_mujoco(body, oracle):
    distance, geoms, cylinder = oracle
    frames = body.kinematics.frames
    for solids, tolerance in ((body.hand_capsules, 2e-4), (body.palm_points, 7e-3)):
        bodies = geoms(*{frames[f] for f in solids.frame})

        @jax.jit
        def ours(q, solids=solids):
            near = object_proximity(body, [solids], body.kinematics.motion(q), _around())
            return near.distance.min()

        for q in _configurations(body, 12):
            exact = distance(q, bodies, [cylinder])
            if exact > 1e-3:  # MuJoCo's depth of penetration is another notion
                assert float(ours(q)) == pytest.approx(exact, abs=tolerance)


@pytest.mark.long
def test_parts_asked_about_together_are_as_near_as_each_alone(body):
    parts = [body.hand_capsules, body.palm_points, body.arm_capsules]
    motion = body.kinematics.motion(jnp.asarray(_configurations(body, 1, seed=3)[0]))
    around = _around()._replace(v_wo=jnp.asarray([0.1, 0.0, 0.2, 0.0, 0.3, 0.0]))
    together = object_proximity(body, parts, motion, around)
    assert len(together.distance) == sum(solids.rows for solids in parts)
    hand, palm, arm = (object_proximity(body, [solids], motion, around) for solids in parts)

    def thirds(near):
        leaves = zip(*(jnp.split(leaf, 3) for leaf in near), strict=True)
        return [Proximity(*part) for part in leaves]

    of_segments = [part for both in zip(thirds(hand), thirds(arm), strict=True) for part in both]
    for one, other in zip(together, stacked([*of_segments, palm]), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_distance_between_fingers_is_that_of_mujoco(body, oracle):
    distance, geoms, _ = oracle
    for q in _configurations(body, 6, seed=1):
        near = finger_proximity(body, body.kinematics.motion(jnp.asarray(q)))
        a = geoms(*body.robot.hand.fingers[1].bodies)
        b = geoms(*body.robot.hand.fingers[2].bodies)
        row = list(combinations(range(len(body.fingers)), 2)).index((1, 2))
        exact = distance(q, a, b)
        if exact > 0:
            assert float(near.distance[row]) == pytest.approx(exact, abs=1e-5)


def test_slopes_are_derivatives_of_distances(body):
    around = _around(obstacles=[(0.45, 0.2, 0.2, 0.03)])
    q = jnp.asarray(_configurations(body, 1, seed=2)[0])
    groups = body.hand_capsules.groups

    @jax.jit
    def distances(q):
        motion = body.kinematics.motion(q)
        parts = [
            object_proximity(body, [body.hand_capsules, body.palm_points], motion, around),
            obstacle_proximity(body, body.hand_capsules, motion, around),
            table_proximity(body, body.hand_capsules, groups, motion),
            finger_proximity(body, motion),
        ]
        return jnp.concatenate([p.distance for p in parts]), jnp.concatenate(
            [p.slope for p in parts]
        )

    _, slope = distances(q)
    step, columns = 1e-3, []  # wide enough for float32
    for direction in np.eye(len(q), dtype=np.float32):
        ahead, behind = distances(q + step * direction)[0], distances(q - step * direction)[0]
        columns.append((ahead - behind) / (2 * step))
    error = np.abs(np.stack(columns, axis=1) - np.asarray(slope)).max(axis=1)
    # A row may change its nearest member within the step.
    assert np.mean(error < 5e-4) > 0.95


def test_rows_ask_for_what_is_missing(body):
    config = ReachConfig()

    @jax.jit
    def rows(q, around):
        return half_spaces(body, body.kinematics.motion(q), around, config)

    slope, bound, near = rows(jnp.asarray(body.home), _around())
    distance = near["object"].distance
    asked = np.minimum((0.010 - np.asarray(distance)) / config.limits.horizon, 0.35)
    np.testing.assert_allclose(bound[: len(distance)], asked, rtol=1e-5, atol=1e-6)
    assert slope.shape == (len(bound), len(body.lower))


@pytest.mark.long
def test_moving_obstacles_and_objects_drift(body):
    around = _around(obstacles=[(0.45, 0.2, 0.2, 0.03)])
    moving = around._replace(
        v_wo=jnp.asarray([0.1, 0.0, 0.0, 0.0, 0.0, 0.5]),
        obstacle_velocity=jnp.asarray([[0.0, -0.2, 0.0]]),
    )
    motion = body.kinematics.motion(jnp.asarray(body.home))
    dt = 1e-3
    later = moving._replace(
        p_wo=moving.p_wo + dt * moving.v_wo[:3],
        R_wo=so3.exp(dt * moving.v_wo[3:]) @ moving.R_wo,
        obstacles=moving.obstacles.at[:, :3].add(dt * moving.obstacle_velocity),
    )
    for measure, solids in (
        (object_proximity, [body.hand_capsules]),
        (obstacle_proximity, body.hand_capsules),
    ):
        now = measure(body, solids, motion, moving)
        then = measure(body, solids, motion, later)
        change = (then.distance - now.distance) / dt
        np.testing.assert_allclose(now.drift, change, atol=0.01)
