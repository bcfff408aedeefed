"""Random postures about to grasp, and the spheres that stand for the hand."""

import jax
import mujoco
import numpy as np
import pytest
from mjx_grasp.robot.arrays import robot_arrays
from mjx_grasp.robot.postures import draw_postures
from mjx_grasp.robot.spheres import own_clearance

from mjx_grasp.robot.spec import load_robot

COUNT = 96
AREA = (0.40, 0.65), (-0.25, 0.25)


@pytest.fixture(scope="module")
def arrays():
    return robot_arrays(load_robot())


@pytest.fixture(scope="module")
def postures(arrays):
    return draw_postures(arrays, COUNT, *AREA, seed=1)


@pytest.fixture(scope="module")
def centres(arrays, postures):
    frames = jax.vmap(arrays.kinematics.forward)(postures)
    return np.asarray(jax.vmap(arrays.sphere_centres)(*frames))


def test_the_hand_is_over_the_object_area_and_about_to_grasp(arrays, postures):
    pos, mat = jax.vmap(arrays.kinematics.forward)(postures)
    tips, pads = np.asarray(pos[:, :3]), np.asarray(mat[:, 3:6, :, 0])
    assert tips[:, :, 2].min() > 0.02
    middle = tips.mean(axis=1)
    for axis, (low, high) in enumerate(AREA):
        # Starts, not solutions: a hand's width around the area will do.
        assert middle[:, axis].min() > low - 0.13 and middle[:, axis].max() < high + 0.13
    assert np.all(np.sum(pads[:, :1] * pads[:, 1:], axis=-1) < -0.29)
    assert np.all(postures >= arrays.lower - 1e-6) and np.all(postures <= arrays.upper + 1e-6)


def test_they_depend_on_the_seed_alone(arrays, postures):
    assert np.array_equal(draw_postures(arrays, COUNT, *AREA, seed=1), postures)
    assert not np.array_equal(draw_postures(arrays, COUNT, *AREA, seed=2), postures)


def test_they_lie_inside_the_hands_shapes(arrays, postures, centres):
    robot = load_robot()
    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    data = mujoco.MjData(model)
    palm = model.body(robot.hand.palm_body).id
    for k in range(0, COUNT, 19):
        data.qpos[:] = postures[k]
        mujoco.mj_kinematics(model, data)
        best = np.full(len(arrays.spheres.radius), np.inf)
        for geom in range(model.ngeom):
            body = int(model.geom_bodyid[geom])
            while body not in (palm, 0):
                body = int(model.body_parentid[body])
            if body == 0:
                continue
            local = (centres[k] - data.geom_xpos[geom]) @ data.geom_xmat[geom].reshape(3, 3)
            size = model.geom_size[geom]
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
                beyond = np.maximum(np.abs(local[:, 2]) - size[1], 0)
                outside = np.hypot(np.linalg.norm(local[:, :2], axis=1), beyond) - size[0]
            else:
                outside = (np.abs(local) - size).max(axis=1)
            best = np.minimum(best, outside + arrays.spheres.radius)
        assert best.max() < 1e-5


def test_own_clearance_is_the_distance_to_the_nearest_foreign_sphere(arrays, centres):
    spheres = arrays.spheres
    for centre in centres[:5]:
        distance, away = map(np.asarray, own_clearance(spheres, np.float32(centre)))
        gap = np.linalg.norm(centre[:, None] - centre, axis=-1) - spheres.radius
        gap[~spheres.apart] = np.inf
        assert np.allclose(distance, np.minimum(gap.min(axis=1), 1.0), atol=1e-5)
        nearest = gap.argmin(axis=1)
        direction = centre - centre[nearest]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        known = np.isfinite(gap.min(axis=1))
        assert known.sum() > 30
        assert np.allclose(away[known], direction[known], atol=1e-3)
