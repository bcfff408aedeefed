"""An arm and a hand that the package has never seen are enough to reach: MJCF and description."""

from dataclasses import replace

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from six_axis import MJCF, write_six_axis

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.reach.run import run_sweep
from mjx_grasp.posture.body import robot_body
from mjx_grasp.posture.surroundings import placed
from mjx_grasp.reaching.presets import reach_preset
from mjx_grasp.robot.spec import load_robot

POSES = 8


@pytest.fixture(scope="module")
def description(tmp_path_factory):
    return write_six_axis(tmp_path_factory.mktemp("robot"))


@pytest.mark.long
def test_it_reaches_and_stays_clear(description):
    settings = reach_preset("default")
    settings = replace(settings, plan=replace(settings.plan, library=10_000))
    run = run_sweep(load_robot(description), settings, POSES, seed=5, chunk=POSES)
    assert run.result["rate_percent"]["20"]["3"] >= 75.0
    assert run.record.speed_ratio.max() <= 1.0 and run.record.limit_excess.max() == 0.0
    limits, clear = settings.reach.limits, run.record.start_distance >= 0.01
    assert clear.sum() > POSES / 2
    assert run.record.object_distance[clear].min() >= limits.clearances.object - 1e-6
    assert run.record.finger_distance[clear].min() >= limits.clearances.fingers - 1e-6
    assert run.record.table_margin[clear].min() >= -1e-6


def test_boxes_of_links_are_covered(description):
    """No corner of a box sticks out of its spheres by more than their radius allows."""
    body = robot_body(load_robot(description))
    model = mujoco.MjModel.from_xml_path(str(body.robot.mjcf))
    data = mujoco.MjData(model)
    data.qpos[:] = body.home
    mujoco.mj_forward(model, data)
    motion = body.kinematics.motion(jnp.asarray(body.home))
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    boxes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_BOX)
    assert len(boxes) == 5
    parts = [body.hand_capsules, body.palm_points, body.arm_capsules]
    centres = np.concatenate([np.asarray(placed(part, motion)[0]) for part in parts])
    radii = np.concatenate([part.radius for part in parts])
    for box in boxes:
        local = corners * model.geom_size[box]
        points = data.geom_xpos[box] + local @ data.geom_xmat[box].reshape(3, 3).T
        gap = np.linalg.norm(points[:, None] - centres, axis=-1) - radii
        assert gap.min(axis=1).max() < 0.75 * 0.008


def _variant(description, name, *removed):
    """The same robot without some of its shapes."""
    mjcf = MJCF
    for shape in removed:
        assert mjcf.count(shape) == 1
        mjcf = mjcf.replace(shape, "")
    other = description.with_name(f"{name}.yaml")
    other.write_text(description.read_text().replace("six_axis.xml", f"{name}.xml"))
    other.with_name(f"{name}.xml").write_text(mjcf)
    return load_robot(other)


def test_a_palm_without_a_shape_is_refused(description):
    bare = _variant(description, "bare", '<geom type="box" size="0.055 0.05 0.02"/>')
    with pytest.raises(InputError, match="palm"):
        robot_body(bare)


def test_an_arm_that_cannot_meet_itself_has_no_pairs(description):
    column = '<geom type="cylinder" size="0.06 0.06" pos="0 0 0.06"/>'
    upper = '<geom type="capsule" fromto="0 0 0.05 0 0 0.42" size="0.05"/>'
    thin = _variant(description, "thin", column, '<geom type="sphere" size="0.06"/>', upper)
    assert len(robot_body(thin).arm_pairs) == 0
