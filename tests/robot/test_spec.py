import copy
import dataclasses
import shutil

import pytest
import yaml
from six_axis import MJCF, write_six_axis

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.robot.identity import FIRST_ROBOT, RobotIdentity, check_robot
from mjx_grasp.robot.spec import CheckConfig, load_robot, main


@pytest.fixture(scope="module")
def shipped():
    return yaml.safe_load(asset_path("robot", "rizon4_hx5d20.yaml").read_text())


@pytest.fixture
def write(tmp_path):
    """Writes a description beside a copy of the MJCF and returns its path."""
    shutil.copy(asset_path("robot", "rizon4_hx5d20.xml"), tmp_path)

    def write(content):
        path = tmp_path / "mine.yaml"
        path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
        return path

    return write


def test_the_shipped_robot():
    robot = load_robot()
    hand = robot.hand
    assert [finger.name for finger in hand.fingers] == ["thumb", "index", "middle"]
    numbers = [int(name.removeprefix("finger_r_joint")) for name in hand.policy_joints]
    assert numbers == [2, 3, 4, 6, 7, 8, 10, 11, 12]
    assert len(robot.joints) == len(robot.home) == len(robot.velocity_limits) == 27
    assert robot.arm.policy_joints == robot.arm.joints[:6]
    assert hand.span == (0.02, 0.09) and hand.scoring_friction == 0.5


def test_a_users_file_reads_like_the_shipped_one(write, shipped):
    path = write(shipped)
    mine, theirs = load_robot(path), load_robot()
    assert mine.mjcf.parent == path.parent
    assert dataclasses.replace(mine, mjcf=theirs.mjcf) == theirs


def test_the_digest_is_that_of_description_and_mjcf(write, shipped):
    """Of their content: neither comments, the order of keys nor ends of lines make another."""
    known = load_robot()
    path = write(yaml.safe_dump(dict(reversed(shipped.items())), sort_keys=False) + "# a comment\n")
    mjcf = path.parent / "rizon4_hx5d20.xml"
    text = mjcf.read_bytes()
    mjcf.write_bytes(text.replace(b"\n", b"\r\n"))
    assert load_robot(path).identity == known.identity == known.without_idle_fingers().identity
    assert known.identity == RobotIdentity("rizon4_hx5d20", known.digest)
    mjcf.write_bytes(text + b"\n")
    others = {known.digest, load_robot(path).digest}
    mjcf.write_bytes(text)
    for keys, value in ((("arm", "name"), "another"), (("hand", "span"), [0.02, 0.08])):
        others.add(load_robot(write(change(shipped, keys, value))).digest)
    assert len(others) == 4


def test_a_file_of_another_robot_is_refused():
    known = load_robot().identity
    for stored in (known, FIRST_ROBOT):
        check_robot("file.npz", stored, known)
    for stored in (dataclasses.replace(known, digest="a1" * 32), RobotIdentity("six_axis")):
        with pytest.raises(FileError) as error:
            check_robot("file.npz", stored, known)
        assert str(error.value) == f"file.npz: found the robot {stored}, expected {known}"


def change(content, path, value):
    """The content with the entry at a path of keys replaced, or removed for ``None``."""
    content = copy.deepcopy(content)
    place = content
    for key in path[:-1]:
        place = place[key]
    if value is None:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    return content


THUMB = ("hand", "fingers", 0)


@pytest.mark.parametrize(
    ("path", "value", "field", "says"),
    [
        (("hand", "colour"), "blue", "hand", "colour"),
        ((*THUMB, "nail"), "short", "hand.fingers[0]", "nail"),
        (("arm", "home"), None, "arm.home", "nothing"),
        (("arm", "home"), [0.0] * 6, "arm.home", "6 numbers"),
        (("arm", "home"), [0.0] * 6 + ["fast"], "arm.home", "fast"),
        (("arm", "home"), [3.0] + [0.0] * 6, "arm.home (joint1)", "2.8798"),
        (("arm", "velocity_limits"), [0.0] * 7, "arm.velocity_limits", "more than 0"),
        (("arm", "policy_joints"), ["joint2", "joint1"], "arm.policy_joints", "in this order"),
        (("hand", "open_posture"), [0.5] * 20, "hand.open_posture (finger_r_joint1)", "-2.3"),
        (("hand", "span"), [0.09, 0.02], "hand.span", "ascending"),
        (("hand", "span"), [0.02, float("nan")], "hand.span", "more than 0"),
        (("hand", "span"), [20.0, 90.0], "hand.span", "metres"),
        (("hand", "scoring_friction"), -0.5, "hand.scoring_friction", "more than 0"),
        (("hand", "opposing_axis"), [0, 1, 1], "hand.opposing_axis", "length 1"),
        (("hand", "palm_site"), "", "hand.palm_site", "1 or more"),
        ((*THUMB, "joints", 1), "finger_r_joint1", "hand.fingers[0].joints", "each once"),
        (("hand", "palm_site"), "palm", "hand.palm_site", "a site of rizon4_hx5d20.xml"),
        (("hand", "palm_body"), "wrist", "hand.palm_body", "a body of rizon4_hx5d20.xml"),
        (("hand", "fingers", 2), None, "hand.fingers", "three fingers"),
        ((*THUMB, "role"), "wrap", "hand.fingers", "thumb, wrap, wrap"),
        ((*THUMB, "role"), "pinky", "hand.fingers[0].role", "one of thumb, wrap"),
        ((*THUMB, "name"), "index", "hand.fingers", "another name"),
        ((*THUMB, "joints", 0), "finger_r_joint99", "hand.fingers[0].joints", "finger_r_joint99"),
        ((*THUMB, "tip_geom"), "thumb_medial", "hand.fingers[0].tip_geom", "on finger_r_link3"),
        ((*THUMB, "tip_site"), "palm_site", "hand.fingers[0].tip_site", "hx5_d20_right_base"),
        ((*THUMB, "pad_site"), "thumb_nail", "hand.fingers[0].pad_site", "thumb_nail"),
        ((*THUMB, "tip_body"), "finger_r_link8", "hand.fingers[0].tip_body", "finger_r_link4"),
        (("hand", "joints", 19), None, "hand.open_posture", "19 numbers"),
        (("arm", "joints", 0), "shoulder", "arm", "shoulder"),
    ],
)
def test_a_wrong_description_is_refused_by_field(write, shipped, path, value, field, says):
    file = write(change(shipped, path, value))
    with pytest.raises(InputError) as caught:
        load_robot(file)
    assert caught.value.field.startswith(f"{file}: {field}")
    assert says in str(caught.value)


def test_a_joint_without_limits_is_refused(tmp_path):
    path = write_six_axis(tmp_path)
    (tmp_path / "six_axis.xml").write_text(MJCF.replace(' range="-3.0 3.0"', ""))
    with pytest.raises(InputError, match=r"arm\.home \(flange\): found 'a joint without limits'"):
        load_robot(path)


@pytest.mark.parametrize(
    ("found", "instead", "says"),
    [
        ('<position name="wrist" joint="wrist" kp="50"/>', '<motor name="wrist" joint="wrist"/>',
         r"xml|yaml: wrist: found 'gain 1 and bias 0', expected a position servo"),
        ('name="thumb_inner" joint="thumb_inner"', 'name="thumb_inner" joint="thumb_outer"',
         r"thumb_inner: found 'an actuator of something else'"),
        ('<joint name="wrist"', '<joint type="slide" name="wrist"',
         r"arm\.home \(wrist\): found 'a slide joint', expected 'a hinge'|expected a hinge"),
    ],
)  # fmt: skip
def test_actuators_that_are_no_servos_of_their_joints_and_slides_are_refused(
    tmp_path, found, instead, says
):
    path = write_six_axis(tmp_path)
    assert found in MJCF
    (tmp_path / "six_axis.xml").write_text(MJCF.replace(found, instead, 1))
    with pytest.raises(InputError, match=says):
        load_robot(path)


@pytest.mark.parametrize(
    ("file", "found", "instead", "says"),
    [
        ("xml", '<site name="palm_centre"/>', '<site name="palm_centre" pos="0 0 0.02"/>',
         r"hand\.palm_site: found 'pos \[0\.0, 0\.0, 0\.02\].*, expected the frame of palm"),
        ("xml", '<site name="palm_centre"/>', '<site name="palm_centre" euler="0 0 90"/>',
         r"hand\.palm_site: found 'pos .* quat .*, expected the frame of palm"),
        ("yaml", "palm_site: palm_centre", "palm_site: thumb_tip",
         r"hand\.palm_site: found 'thumb_tip on thumb_outer', expected one on palm"),
        ("yaml", "[thumb_root, thumb_inner, thumb_outer]", "[left_root, thumb_inner, thumb_outer]",
         r"hand\.fingers\[0\]\.bodies: found 'thumb_inner', expected a link beyond left_root"),
        ("yaml", "[thumb_root, thumb_inner, thumb_outer]", "[thumb_inner, thumb_root, thumb_outer]",
         r"hand\.fingers\[0\]\.bodies: found 'thumb_root', expected a link beyond thumb_inner"),
        ("yaml", "[thumb_root, thumb_inner, thumb_outer]", "[thumb_inner, thumb_outer]",
         r"hand\.fingers\[0\]\.joints: found 'thumb_spread of thumb_root', expected a joint of"),
        ("xml", '<geom name="thumb_end"', '<geom size="0.01"/><geom name="thumb_end"',
         r"hand\.fingers\[0\]\.tip_geom: found 'geom \d+, thumb_end to touch with on thumb_outer'"),
    ],
)  # fmt: skip
def test_a_hand_that_is_not_as_it_is_described_is_refused(tmp_path, file, found, instead, says):
    path = write_six_axis(tmp_path)
    changed = tmp_path / f"six_axis.{file}"
    assert found in changed.read_text()
    changed.write_text(changed.read_text().replace(found, instead, 1))
    with pytest.raises(InputError, match=says):
        load_robot(path)


def test_what_touches_nothing_may_be_beside_the_geom_of_a_tip(tmp_path):
    path, end = write_six_axis(tmp_path), '<geom name="thumb_end"'
    drawn = f'<geom size="0.01" contype="0" conaffinity="0"/>{end}'
    (tmp_path / "six_axis.xml").write_text(MJCF.replace(end, drawn, 1))
    assert load_robot(path).hand.fingers[0].tip_geom == "thumb_end"


def test_a_key_that_stands_twice_in_a_description_is_refused(tmp_path):
    path = write_six_axis(tmp_path)
    path.write_text(path.read_text() + "\nname: other\n")
    with pytest.raises(FileError, match="'name' stands twice"):
        load_robot(path)


def test_a_joint_that_the_model_has_and_the_description_lacks(write, shipped):
    content = change(shipped, ("hand", "joints", 19), None)
    content["hand"]["open_posture"].pop()
    with pytest.raises(InputError, match="finger_r_joint20"):
        load_robot(write(content))


def test_files_that_cannot_be_read_are_refused(write, shipped, tmp_path):
    with pytest.raises(FileError, match=r"missing\.yaml"):
        load_robot(tmp_path / "missing.yaml")
    with pytest.raises(FileError, match="no valid YAML"):
        load_robot(write("arm: [1, 2"))
    with pytest.raises(InputError, match="some of name"):
        load_robot(write("just text"))
    with pytest.raises(FileError, match=r"hand\.xml.*no such file"):
        load_robot(write(change(shipped, ("mjcf",), "hand.xml")))
    (tmp_path / "broken.xml").write_text("<mujoco><worldbody>")
    with pytest.raises(FileError, match=r"broken\.xml.*no MJCF that compiles"):
        load_robot(write(change(shipped, ("mjcf",), "broken.xml")))
    with pytest.raises(InputError, match=r"'no_such_robot', expected rizon4_hx5d20, or"):
        load_robot("no_such_robot")


def test_the_command_reports_what_it_read(write, shipped, capsys):
    main(CheckConfig(str(write(shipped))))
    assert "20 joints" in capsys.readouterr().out
