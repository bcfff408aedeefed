"""Random postures about to grasp, and the spheres that stand for the hand."""

import jax
import mujoco
import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.posture.body import FINGERS, PALM
from mjx_grasp.posture.draw import draw_postures
from mjx_grasp.posture.surroundings import placed
from mjx_grasp.sim.scene import ObjectArea

COUNT, AREA = 96, ObjectArea()


@pytest.fixture(scope="module")
def postures(body):
    return draw_postures(body, COUNT, AREA, seed=1)


@pytest.fixture(scope="module")
def centres(body, postures):
    def at(q):
        return placed(body.hand_spheres, body.kinematics.motion(q))[0]

    return np.asarray(jax.jit(jax.vmap(at))(postures))


def test_the_hand_is_over_the_object_area_and_about_to_grasp(body, postures):
    pos, mat = jax.jit(jax.vmap(body.kinematics.forward))(postures)
    tips, pads = np.asarray(pos[:, :FINGERS]), np.asarray(mat[:, FINGERS:PALM, :, 0])
    assert tips[:, :, 2].min() > 0.02
    middle = tips.mean(axis=1)
    for axis, (low, high) in enumerate((AREA.x, AREA.y)):
        # Starts, not solutions: a hand's width around the area will do.
        assert middle[:, axis].min() > low - 0.13 and middle[:, axis].max() < high + 0.13
    assert np.all(np.sum(pads[:, :1] * pads[:, 1:], axis=-1) < -0.29)
    assert np.all(postures >= body.lower - 1e-6) and np.all(postures <= body.upper + 1e-6)


@pytest.mark.long
def test_they_depend_on_the_seed_alone(body, postures):
    assert np.array_equal(draw_postures(body, COUNT, AREA, seed=1), postures)
    assert not np.array_equal(draw_postures(body, COUNT, AREA, seed=2), postures)


def test_what_the_robot_does_not_reach_has_none(body, monkeypatch):
    monkeypatch.setattr("mjx_grasp.posture.draw._MAX_BATCHES", 8)
    with pytest.raises(InputError, match="arm postures over the object area"):
        draw_postures(body, COUNT, ObjectArea(x=(5.0, 6.0)), seed=1)


def test_spheres_lie_inside_the_hands_shapes(body, postures, centres):
    model = mujoco.MjModel.from_xml_path(str(body.robot.mjcf))
    data = mujoco.MjData(model)
    palm = model.body(body.robot.hand.palm_body).id
    radius = body.hand_spheres.radius
    for k in range(0, COUNT, 19):
        data.qpos[:] = postures[k]
        mujoco.mj_kinematics(model, data)
        best = np.full(len(radius), np.inf)
        for geom in range(model.ngeom):
            link = int(model.geom_bodyid[geom])
            while link not in (palm, 0):
                link = int(model.body_parentid[link])
            if link == 0:
                continue
            local = (centres[k] - data.geom_xpos[geom]) @ data.geom_xmat[geom].reshape(3, 3)
            size = model.geom_size[geom]
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
                beyond = np.maximum(np.abs(local[:, 2]) - size[1], 0)
                outside = np.hypot(np.linalg.norm(local[:, :2], axis=1), beyond) - size[0]
            else:
                outside = (np.abs(local) - size).max(axis=1)
            best = np.minimum(best, outside + radius)
        assert best.max() < 1e-5


def test_no_two_spheres_overlap_that_must_not(body, centres):
    radius, apart = body.hand_spheres.radius, body.apart
    assert np.array_equal(apart, apart.T) and apart.any() and not apart.diagonal().any()
    for centre in centres:
        gap = np.linalg.norm(centre[:, None] - centre, axis=-1) - radius - radius[:, None]
        assert gap[apart].min() > -1e-5
