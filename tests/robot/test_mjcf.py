import json
from dataclasses import replace
from importlib import import_module
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjx_grasp.robot.mjcf import joint_columns, robot_mjspec
from mjx_grasp.robot.spec import load_robot

ROOT = Path(__file__).resolve().parents[2]
VECTORS = ROOT / "tests" / "data" / "robot_fk_vectors.json"
# Reference postures of the laboratory's tutorial, rad.
CLOSED = [-1, -1.2, 0.8, 0.6, -0.2, 1.4, 0.9, 0.6, 0, 1.4, 0.9, 0.6, 0, 0, 0, 0, 0, 0, 0, 0]
CURLED = [-1, -1.5, 1, 0.5, -0.15, 1.2, 0.7, 0.5, 0, 1.2, 0.8, 0.5]
CURLED += [0, 1.2, 0.9, 0.5, 0, 1.2, 1, 0.5]


@pytest.fixture(scope="module")
def robot():
    return load_robot()


@pytest.fixture(scope="module")
def model(robot):
    spec = robot_mjspec(robot)
    spec.option.timestep = 0.002
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return spec.compile()


@pytest.fixture
def data(model):
    return mujoco.MjData(model)


def in_palm(data, robot, site):
    """Position and rotation of a site in the palm frame."""
    palm = data.site(robot.hand.palm_site)
    R = palm.xmat.reshape(3, 3)
    place = data.site(site)
    return R.T @ (place.xpos - palm.xpos), R.T @ place.xmat.reshape(3, 3)


def meets(model, geom1, geom2):
    """MuJoCo's contact filter by bits and excluded body pairs."""
    a, b = model.geom(geom1), model.geom(geom2)
    low, high = sorted((a.bodyid[0], b.bodyid[0]))
    if low == high or (low << 16) + high in model.exclude_signature:
        return False
    return bool(a.contype[0] & b.conaffinity[0] or b.contype[0] & a.conaffinity[0])


def test_the_checked_in_file_is_what_the_builder_makes(robot, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    builder = import_module("robot_mjcf")
    builder.main(builder.RebuildConfig(tmp_path / "built.xml"))
    assert robot.mjcf.read_text() == (tmp_path / "built.xml").read_text()


def test_palm_and_tips_agree_with_the_vendors_models(robot, model, data):
    vectors = json.loads(VECTORS.read_text())
    assert robot.joints == tuple(vectors["joints"])
    for case in vectors["configurations"]:
        data.qpos[:] = case["q"]
        mujoco.mj_kinematics(model, data)
        expected = {robot.hand.palm_site: (case["palm_pos"], case["palm_mat"])}
        for finger, tip in case["tips"].items():
            expected[f"{finger}_tip_site"] = (tip["pos"], tip["mat"])
        for site, (pos, mat) in expected.items():
            found = data.site(site)
            np.testing.assert_allclose(found.xpos, pos, atol=1e-6, err_msg=site)
            np.testing.assert_allclose(found.xmat.reshape(3, 3), mat, atol=2e-6, err_msg=site)


def test_masses_are_the_arms_the_plates_and_the_hands(model):
    assert model.body_mass.sum() == pytest.approx(18.1699 + 0.15 + 0.972671, abs=2e-4)
    assert model.body("mount").mass[0] == pytest.approx(0.15)


def test_the_arm_carries_itself_and_the_hand_for_ten_seconds(robot, model, data):
    data.qpos[:] = data.ctrl[:] = robot.home
    mujoco.mj_forward(model, data)
    start = data.site(robot.hand.palm_site).xpos.copy()
    while data.time < 10.0:
        mujoco.mj_step(model, data)
        drift = np.linalg.norm(data.site(robot.hand.palm_site).xpos - start)
        assert drift < 1e-3
    np.testing.assert_allclose(data.qpos, robot.home, atol=2e-3)
    assert np.abs(data.qvel).max() < 1e-3


def test_the_arm_follows_a_step_without_ringing(robot, model, data):
    data.qpos[:] = data.ctrl[:] = robot.home
    data.ctrl[: len(robot.arm.joints)] += 0.02
    mujoco.mj_forward(model, data)
    goal = data.ctrl[: len(robot.arm.joints)].copy()
    overshoot = 0.0
    while data.time < 1.0:
        mujoco.mj_step(model, data)
        overshoot = max(overshoot, (data.qpos[: len(goal)] - goal).max())
    np.testing.assert_allclose(data.qpos[: len(goal)], goal, atol=1e-3)
    assert overshoot < 0.1 * 0.02


@pytest.mark.parametrize("hand", [None, CLOSED, CURLED], ids=["open", "closed", "curled"])
def test_reference_postures_touch_nothing(robot, model, data, hand):
    data.qpos[:] = robot.home
    if hand is not None:
        data.qpos[len(robot.arm.joints) :] = hand
    assert np.all(data.qpos >= model.jnt_range[:, 0]) and np.all(data.qpos <= model.jnt_range[:, 1])
    mujoco.mj_forward(model, data)
    touching = [(model.geom(c.geom1).name, model.geom(c.geom2).name) for c in data.contact]
    assert touching == []


def test_fingers_of_the_hand_can_touch_each_other(robot, model, data):
    data.qpos[:] = robot.home
    data.qpos[model.joint("finger_r_joint9").qposadr] = -0.8
    mujoco.mj_forward(model, data)
    touching = {model.geom(g).name.split("_")[0] for c in data.contact for g in c.geom}
    assert touching == {"index", "middle"}


def test_collision_bits_with_table_and_object(robot):
    spec = robot_mjspec(robot)
    box = mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(
        name="table", type=box, size=[1, 1, 0.02], pos=[0, 0, -0.02], contype=8, conaffinity=0
    )
    thing = spec.worldbody.add_body(name="object", pos=[0, 0, 2])
    thing.add_freejoint()
    thing.add_geom(name="thing", type=box, size=[0.02] * 3, contype=4, conaffinity=8)
    model = spec.compile()
    assert meets(model, "thing", "table")
    arm = ["base_hull", *(f"link{k}_hull" for k in range(1, 8))]
    fingers = ("thumb", "index", "middle", "ring", "little")
    tips = [f"{finger}_tip" for finger in fingers]
    hand = ["palm_0", "palm_1", *tips, *(f"{finger}_medial" for finger in fingers)]
    for geom in arm + hand:
        assert meets(model, geom, "thing"), geom
        assert meets(model, geom, "table") == (geom not in ("base_hull", "link1_hull")), geom
    assert not any(meets(model, *pair) for pair in combinations(arm, 2))
    assert not any(meets(model, a, h) for a in arm for h in hand)
    assert all(meets(model, *pair) for pair in combinations(tips, 2))
    assert all(meets(model, "palm_0", tip) for tip in tips)
    assert not any(meets(model, "palm_0", f"{f}_medial") for f in fingers)
    assert not any(meets(model, f"{f}_tip", f"{f}_medial") for f in fingers)


def test_every_distal_link_has_one_geom_and_its_pad_lies_on_it(robot, model, data):
    mujoco.mj_forward(model, data)
    for finger in robot.hand.fingers:
        geom = model.geom(finger.tip_geom)
        assert model.body(finger.tip_body).geomnum[0] == 1
        # Distance of the pad's centre from the capsule's surface.
        pad = data.site(finger.pad_site).xpos - data.geom(finger.tip_geom).xpos
        axis = data.geom(finger.tip_geom).xmat.reshape(3, 3)[:, 2]
        along = np.clip(pad @ axis, -geom.size[1], geom.size[1])
        assert abs(np.linalg.norm(pad - along * axis) - geom.size[0]) < 1e-3


def test_palm_axes(robot, model, data):
    """+x leaves the palm where the fingers close, +y is the thumb's side, +z the fingers'."""
    np.testing.assert_array_equal(robot.hand.approach_axis, [1, 0, 0])
    data.qpos[:] = 0
    mujoco.mj_kinematics(model, data)
    straight = {f.name: in_palm(data, robot, f.tip_site)[0] for f in robot.hand.fingers}
    little = in_palm(data, robot, "little_tip_site")[0]
    assert straight["index"][1] > straight["middle"][1] > little[1]
    assert straight["thumb"][1] > straight["middle"][1]
    assert straight["middle"][2] > 0.1
    for finger in robot.hand.fingers[1:]:
        for joint in finger.policy_joints:
            data.qpos[:] = 0
            data.qpos[model.joint(joint).qposadr] = 0.3
            mujoco.mj_kinematics(model, data)
            moved = in_palm(data, robot, finger.tip_site)[0] - straight[finger.name]
            assert moved @ robot.hand.approach_axis > 0.005
    # A pad's normal is its site's +x: on straight fingers it is the palm's.
    data.qpos[:] = 0
    mujoco.mj_kinematics(model, data)
    for finger in robot.hand.fingers[1:]:
        normal = in_palm(data, robot, finger.pad_site)[1][:, 0]
        np.testing.assert_allclose(normal, [1, 0, 0], atol=1e-6)


def test_drives_are_in_joint_order_with_the_joints_range(robot, model):
    assert tuple(model.actuator(i).name for i in range(model.nu)) == robot.joints
    np.testing.assert_array_equal(model.actuator_trnid[:, 0], np.arange(model.nu))
    np.testing.assert_array_equal(model.actuator_ctrlrange, model.jnt_range)
    assert np.all(np.diff(model.actuator_gainprm[: len(robot.arm.joints), 0]) <= 0)


def test_joints_that_the_description_leaves_out_are_fixed_and_the_others_keep_their_columns(robot):
    fewer = replace(robot, hand=replace(robot.hand, joints=robot.hand.joints[1:]))
    left_out = robot.hand.joints[0]
    model = robot_mjspec(fewer).compile()
    assert model.njnt == model.nu == len(robot.joints) - 1
    assert left_out not in {model.joint(i).name for i in range(model.njnt)}
    columns = joint_columns(fewer)
    assert [robot.joints[k] for k in columns] == list(fewer.joints)
