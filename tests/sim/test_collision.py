import mujoco
import numpy as np
import pytest

from mjx_grasp.objects.model import load_object
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.collision import REASONS, CollisionChecker
from mjx_grasp.sim.scene import build_scene

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
AWAY = np.array([0.5, -0.6, 0.05])


@pytest.fixture(scope="module")
def scene():
    return build_scene([load_object("foam_brick")], load_robot())


@pytest.fixture(scope="module")
def checker(scene):
    return CollisionChecker(scene)


def home(scene):
    return np.array(scene.robot.home)


def posed(scene, q, position):
    data = mujoco.MjData(scene.model)
    data.qpos[scene.addresses.robot_qpos] = q
    data.qpos[scene.addresses.object_qpos] = [*position, *UPRIGHT]
    mujoco.mj_forward(scene.model, data)
    return data


def tip_at(scene, q, finger):
    """Where a fingertip is [m]."""
    return posed(scene, q, AWAY).site(scene.robot.hand.fingers[finger].tip_site).xpos


def test_home_with_the_object_at_rest_is_clear(scene, checker):
    rest = scene.objects[0].resting[0]
    assert checker.reason(home(scene), np.array([0.5, -0.2, rest.height]), rest.quat) is None
    # Pressed into the table by its rounding, the object still only touches what it rests on.
    sunk = np.array([0.5, -0.2, rest.height - 1e-3])
    assert checker.reason(home(scene), sunk, rest.quat) is None


@pytest.mark.parametrize("finger", [0, 1, 2])
def test_an_object_planted_at_a_fingertip_is_found(scene, checker, finger):
    tip = tip_at(scene, home(scene), finger)
    assert checker.reason(home(scene), tip, UPRIGHT) == "hand-object"
    assert checker.reason(home(scene), AWAY, UPRIGHT) is None


def test_an_object_planted_in_the_forearm_is_found(scene, checker):
    data = posed(scene, home(scene), AWAY)
    centre = data.geom_xpos[scene.model.geom("link5_hull").id]
    assert checker.reason(home(scene), centre, UPRIGHT) == "arm-object"


def found(scene, wanted):
    """The first of random arm postures that is as wanted, with the hand open."""
    rng = np.random.default_rng(0)
    low, high = np.array([scene.model.joint(name).range for name in scene.robot.arm.joints]).T
    for _ in range(20_000):
        q = home(scene)
        q[: len(low)] = rng.uniform(low, high)
        if wanted(posed(scene, q, AWAY)):
            return q
    raise AssertionError("no such posture")


def geoms(scene, *bodies):
    return [
        g
        for g in range(scene.model.ngeom)
        if scene.model.body(scene.model.geom_bodyid[g]).name in bodies
    ]


def hand_in_the_table(scene):
    tips = [scene.model.geom(f.tip_geom).id for f in scene.robot.hand.fingers]
    arm = geoms(scene, "link2", "link3", "link4", "link5", "link6", "link7")

    def wanted(d):
        x, y, z = d.geom_xpos[tips].T
        over = np.all((x > -0.2) & (x < 0.9) & (np.abs(y) < 0.6))
        return over and -0.01 < z.min() < -0.002 and d.geom_xpos[arm, 2].min() > 0.15

    return found(scene, wanted)


def test_fingers_in_the_table_are_found(scene, checker):
    assert checker.reason(hand_in_the_table(scene), AWAY, UPRIGHT) == "hand-table"


def test_an_arm_in_the_table_is_found(scene, checker):
    arm = geoms(scene, "link4", "link5", "link6")
    hand = geoms(scene, *(body for f in scene.robot.hand.fingers for body in f.bodies))
    hand += geoms(scene, scene.robot.hand.palm_body)

    def wanted(d):
        x, y, z = d.geom_xpos[arm].T
        over = np.all((x > 0.1) & (x < 0.9) & (np.abs(y) < 0.6))
        return over and -0.02 < z.min() < 0.03 and d.geom_xpos[hand, 2].min() > 0.08

    assert checker.reason(found(scene, wanted), AWAY, UPRIGHT) == "arm-table"


def test_collisions_of_the_hand_with_itself_agree_with_the_physics(scene, checker):
    rng = np.random.default_rng(0)
    model = scene.model
    joints = [model.joint(name) for name in scene.robot.hand.joints]
    low, high = np.array([j.range for j in joints]).T
    agreed = {True: 0, False: 0}
    for _ in range(80):
        q = home(scene)
        q[7:] = rng.uniform(low, high) * rng.random()
        data = posed(scene, q, AWAY)
        table = model.geom("table").id
        pairs = data.contact.geom[data.contact.dist < 0]
        own = [pair for pair in pairs if table not in pair]
        touching = bool(own)
        reason = checker.reason(q, AWAY, UPRIGHT)
        assert reason in (None, "self")
        assert reason == "self" or not touching
        agreed[touching] += (reason == "self") == touching
    assert agreed[True] > 10 and agreed[False] > 10


def test_a_hand_in_the_arm_is_found_which_the_physics_does_not_mind(scene, checker):
    palm, arm = geoms(scene, scene.robot.hand.palm_body), geoms(scene, "link3", "link4")

    def wanted(d):
        if d.geom_xpos[palm, 2].min() < 0.3 or d.geom_xpos[arm, 2].min() < 0.3:
            return False
        gap = min(
            mujoco.mj_geomDistance(scene.model, d, a, b, 0.1, None) for a in palm for b in arm
        )
        return gap < -0.005

    q = found(scene, wanted)
    assert not np.any(posed(scene, q, AWAY).contact.dist < 0)
    assert checker.reason(q, AWAY, UPRIGHT) == "self"


def test_the_first_of_several_reasons_is_told_and_the_scene_is_untouched(scene, checker):
    before = scene.model.geom_conaffinity.copy()
    q = hand_in_the_table(scene)
    tip = tip_at(scene, q, 0)
    assert checker.reason(q, tip, UPRIGHT) == REASONS[0] == "hand-object"
    again = CollisionChecker(scene)
    assert again.reason(q, tip, UPRIGHT) == "hand-object"
    assert np.array_equal(scene.model.geom_conaffinity, before)


def test_of_several_objects_a_state_is_of_one(handmade_objects):
    """As in scenes of each object alone, for objects anywhere around the hand."""
    robot = load_robot()
    together = build_scene(handmade_objects, robot)
    union, q = CollisionChecker(together), np.array(robot.home)
    palm = posed(together, q, AWAY).site_xpos[together.addresses.palm_site]
    rng, reasons = np.random.default_rng(0), set()
    for k, obj in enumerate(handmade_objects):
        alone = CollisionChecker(build_scene([obj], robot))
        for position in palm + rng.uniform(-0.15, 0.15, (20, 3)):
            quat = rng.normal(size=4)
            pose = position, quat / np.linalg.norm(quat)
            found = union.reason(q, *pose, object_index=k)
            assert found == alone.reason(q, *pose), (obj.name, pose)
            reasons.add(found)
    assert reasons >= {None, "hand-object"}
