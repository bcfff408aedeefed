import dataclasses

import handmade
import mujoco
import numpy as np
import pytest
import six_axis

from mjx_grasp.errors import InputError
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import ObjectFields, SceneConfig, build_scene
from mjx_grasp.tasks.starts import build_starts


def with_object(scene, k):
    """A copy of the union model that holds object k, by the tables of the scene."""
    import copy

    model = copy.copy(scene.model)
    for name in ObjectFields.NAMES:
        getattr(model, name)[:] = getattr(scene.object_fields, name)[k]
    return model


def posed(model, scene, starts, row):
    data = mujoco.MjData(model)
    data.qpos[:] = starts.qpos[row]
    data.ctrl[:] = starts.ctrl[row]
    return data


def test_scene_has_what_the_rest_relies_on(scene, handmade_objects):
    m = scene.model
    assert scene.object_names == ("box", "ball", "dumbbell")
    assert scene.object_index("ball") == 1
    assert m.body("object").jntnum[0] == 1
    for obj in handmade_objects:
        for i in range(len(obj.pieces)):
            assert m.geom(f"{obj.name}_{i}").bodyid[0] == scene.addresses.object_body
    table = m.geom("table")
    assert m.geom_type[table.id] == mujoco.mjtGeom.mjGEOM_BOX
    assert np.isclose(table.pos[2] + table.size[2], 0.0)
    assert m.opt.timestep == 0.002 and m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert m.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # The whole object area lies on the table.
    for x, y in ((0.40, -0.25), (0.65, 0.25)):
        assert abs(x - table.pos[0]) < table.size[0] and abs(y - table.pos[1]) < table.size[1]


def test_addresses_name_the_robot_in_robot_order(scene, robot):
    m, at = scene.model, scene.addresses
    for i, name in enumerate((*robot.arm.joints, *robot.hand.joints)):
        assert m.jnt_qposadr[m.joint(name).id] == at.robot_qpos[i]
        assert m.jnt_dofadr[m.joint(name).id] == at.robot_dof[i]
        assert m.actuator_trnid[at.robot_ctrl[i], 0] == m.joint(name).id
    assert len(at.robot_qpos) == 27 and m.nq == 34
    assert not set(at.object_qpos) & set(at.robot_qpos)


def test_nothing_and_twins_are_refused(handmade_objects, robot, scene):
    with pytest.raises(InputError, match="one or more objects"):
        build_scene([], robot)
    with pytest.raises(InputError, match="different names"):
        build_scene([handmade_objects[0]] * 2, robot)
    with pytest.raises(InputError, match=r"teapot.*box, ball, dumbbell"):
        scene.object_index("teapot")
    with pytest.raises(InputError, match="physics_dt"):
        SceneConfig(physics_dt=0.1)
    with pytest.raises(InputError, match="friction"):
        SceneConfig(friction=(0.0, 0.1, 0.1))


def test_single_scene_carries_the_objects_own_inertia(robot):
    obj = handmade.dumbbell()
    single = build_scene([obj], robot)
    m, body = single.model, single.addresses.object_body
    assert np.isclose(m.body_mass[body], obj.mass)
    np.testing.assert_allclose(m.body_ipos[body], obj.com, atol=1e-9)
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, m.body_iquat[body])
    R = R.reshape(3, 3)
    np.testing.assert_allclose(R @ np.diag(m.body_inertia[body]) @ R.T, obj.inertia, atol=1e-9)


def test_fields_park_all_pieces_but_the_objects_own(scene, handmade_objects):
    names = [scene.model.geom(g).name for g in range(scene.model.ngeom)]
    for k, obj in enumerate(handmade_objects):
        lifted = scene.object_fields.geom_pos[k, :, 2] - scene.model.geom_pos[:, 2] > 10.0
        parked = {n for n, up in zip(names, lifted, strict=True) if up}
        others = [o for o in handmade_objects if o is not obj]
        assert parked == {f"{o.name}_{i}" for o in others for i in range(len(o.pieces))}
        assert scene.object_fields.body_mass[k, scene.addresses.object_body] == obj.mass


@pytest.mark.parametrize("k", range(3))
@pytest.mark.parametrize("squeezing", [False, True])
def test_union_world_follows_the_single_object_scene(
    scene, starts, robot, handmade_objects, k, squeezing
):
    """Native engine, 100 steps at a fixed command: dropped on the table, then squeezed."""
    union_model = with_object(scene, k)
    single_scene = build_scene([handmade_objects[k]], robot)
    row = 3 * k
    union = posed(union_model, scene, starts, row)
    single = posed(single_scene.model, single_scene, starts, row)
    if squeezing:
        # Thumb and wraps close: they hit the object within the 100 steps, if it is high enough.
        fingers = scene.addresses.robot_ctrl[7:19]
        for data in (union, single):
            data.ctrl[fingers[[3, 7, 11]]] += 0.6
            data.ctrl[fingers[[2, 6, 10]]] += 0.3
    else:
        for data in (union, single):
            data.qpos[scene.addresses.object_qpos[2]] += 0.01
            data.qvel[scene.addresses.object_dof[3:]] = [1.0, 2.0, -1.0]
    touched = 0
    for _ in range(100):
        mujoco.mj_step(union_model, union)
        mujoco.mj_step(single_scene.model, single)
        found = union.sensordata[scene.addresses.tip_force[:, 0]] > 0
        touched += found.any()
    assert union.ncon == single.ncon > 0  # on the table
    # Of the dumbbell the fingertips pass above: it is 36 mm high, and the pads are at 60 mm.
    high_enough = handmade_objects[k].name in ("box", "ball")
    assert (touched > 0) == (squeezing and high_enough)
    np.testing.assert_allclose(union.qpos, single.qpos, atol=1e-6)
    np.testing.assert_allclose(union.sensordata, single.sensordata, atol=1e-4)


def test_contact_sensors_see_the_weight_on_a_fingertip(scene, starts):
    """The box laid on a finger: net force against a sum over MuJoCo's contacts."""
    model = with_object(scene, 0)
    data = posed(model, scene, starts, 0)
    fingers = scene.addresses.robot_ctrl[7:19]
    data.ctrl[fingers[[3, 7, 11]]] += 0.6
    data.ctrl[fingers[[2, 6, 10]]] += 0.3
    seen = 0
    for _ in range(200):
        mujoco.mj_step(model, data)
        for f, finger in enumerate(scene.robot.hand.fingers):
            total = {"tip": np.zeros(3), "finger": np.zeros(3)}
            touches = False
            for c in range(data.ncon):
                contact = data.contact[c]
                bodies = [int(model.geom_bodyid[g]) for g in contact.geom]
                if scene.addresses.object_body not in bodies:
                    continue
                names = {model.geom(g).name for g in contact.geom}
                parts = {model.body(b).name for b in bodies}
                force = np.zeros(6)
                mujoco.mj_contactForce(model, data, c, force)
                world = contact.frame.reshape(3, 3).T @ force[:3]
                sign = 1.0 if bodies[1] == scene.addresses.object_body else -1.0
                if finger.tip_geom in names:
                    touches = True
                    total["tip"] += sign * world
                if parts & set(finger.bodies):
                    total["finger"] += sign * world
            at = scene.addresses
            assert (data.sensordata[at.tip_force[f, 0]] > 0) == touches
            for kind, adr in (("tip", at.tip_force), ("finger", at.finger_force)):
                size = np.linalg.norm(total[kind])
                np.testing.assert_allclose(
                    np.linalg.norm(data.sensordata[adr[f, 1:]]), size, atol=1e-5
                )
            seen += touches
    assert seen > 20


def test_idle_fingers_can_be_fixed(scene, handmade_objects, robot):
    fixed = build_scene(handmade_objects, robot, SceneConfig(fix_idle_fingers=True))
    idle = set(robot.hand.joints) - {j for f in robot.hand.fingers for j in f.joints}
    assert idle and fixed.model.nv == scene.model.nv - len(idle)
    assert fixed.model.nu == fixed.model.nv - 6
    assert fixed.robot.joints == tuple(j for j in robot.joints if j not in idle)
    # Bodies and geoms stay: the idle fingers are still there to be touched.
    assert fixed.model.nbody == scene.model.nbody and fixed.model.ngeom == scene.model.ngeom
    np.testing.assert_allclose(fixed.model.body_mass, scene.model.body_mass)


def test_fixed_idle_fingers_move_the_others_alike(scene, handmade_objects, robot):
    """A scripted closing in both. The middle finger leans on the ring finger, which gives way."""
    handoffs = handmade.handoffs(handmade_objects)
    fixed = build_scene(handmade_objects, robot, SceneConfig(fix_idle_fingers=True))
    driven = [robot.joints.index(j) for j in fixed.robot.joints]
    seen = []
    for one in (scene, fixed):
        starts, at = build_starts(one, handoffs, 5), one.addresses
        model = with_object(one, int(starts.object_index[0]))
        data = posed(model, one, starts, 0)
        for _ in range(200):
            for f in robot.hand.fingers:
                data.ctrl[model.actuator(f.joints[-1]).id] += 0.0008
            mujoco.mj_step(model, data)
        q = data.qpos[at.robot_qpos]
        seen.append((q[driven] if one is scene else q, data.qpos[at.object_qpos]))
    np.testing.assert_allclose(seen[0][0], seen[1][0], atol=0.015)
    np.testing.assert_allclose(seen[0][1], seen[1][1], atol=5e-4)


def test_torque_limits_of_the_fingers_scale_and_no_others(handmade_objects, robot):
    """The compiled limits, and what the actuators then give when they are asked for the most."""
    box, fingers = handmade_objects[:1], set(robot.hand.joints)
    usual, weak = build_scene(box, robot), build_scene(box, robot, SceneConfig(finger_torque=0.25))
    names = [usual.model.actuator(i).name for i in range(usual.model.nu)]
    factor = np.array([0.25 if name in fingers else 1.0 for name in names])
    assert set(factor) == {0.25, 1.0}
    limits = [one.model.actuator_forcerange for one in (usual, weak)]
    np.testing.assert_allclose(limits[1], factor[:, None] * limits[0])
    np.testing.assert_array_equal(usual.model.actuator_gainprm, weak.model.actuator_gainprm)
    for one, limit in zip((usual, weak), limits, strict=True):
        data = mujoco.MjData(one.model)
        low, high = one.model.actuator_ctrlrange.T
        data.ctrl[:] = np.where(high > -low, high, low)
        mujoco.mj_forward(one.model, data)
        full = np.abs(data.actuator_force) >= limit[:, 1] - 1e-9
        assert full.all() and np.all(np.abs(data.actuator_force) <= limit[:, 1] + 1e-9)


def test_no_torque_limit_cannot_be_scaled(handmade_objects, tmp_path):
    other, box = load_robot(six_axis.write_six_axis(tmp_path)), handmade_objects[:1]
    assert not build_scene(box, other).model.actuator_forcerange.any()
    with pytest.raises(InputError, match=r"finger_torque: found 0\.5.*no torque limit"):
        build_scene(box, other, SceneConfig(finger_torque=0.5))


def test_bent_idle_fingers_are_refused(handmade_objects, robot):
    handoffs = handmade.handoffs(handmade_objects)
    bent = dataclasses.replace(handoffs, q=np.where(np.arange(27) == 26, 0.3, handoffs.q))
    fixed = build_scene(handmade_objects, robot, SceneConfig(fix_idle_fingers=True))
    with pytest.raises(InputError, match="fix_idle_fingers"):
        build_starts(fixed, bent, 5)
    posture = (*robot.hand.open_posture[:-1], 0.2)
    crooked = dataclasses.replace(robot, hand=dataclasses.replace(robot.hand, open_posture=posture))
    with pytest.raises(InputError, match="open_posture"):
        build_scene(handmade_objects, crooked, SceneConfig(fix_idle_fingers=True))
