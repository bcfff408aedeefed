import dataclasses
import json
import subprocess
import sys
from collections import Counter
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from typed import refusal, typed

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import InputError
from mjx_grasp.geometry import so3
from mjx_grasp.geometry.signed_distance import Sphere
from mjx_grasp.handoff.config import HandoffConfig, PostureConfig, SamplingConfig
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.generate import HandoffGenerator
from mjx_grasp.handoff.report import OUTCOMES, report_table
from mjx_grasp.objects.model import load_object
from mjx_grasp.posture.body import robot_body
from mjx_grasp.posture.lift import scripted_lift
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.posture.touch import touch_errors, touching
from mjx_grasp.reaching.holding import can_hold
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import build_scene

SMALL = {
    "sampling": SamplingConfig(poses_per_round=16, candidates_per_pose=2),
    "posture": PostureConfig(library=4000, starts=replace(PostureConfig().starts, count=3)),
}
WANTED = 12


def settings(tmp_path_factory, **changes):
    out = tmp_path_factory.mktemp("handoffs") / "set.npz"
    return HandoffConfig(out=out, per_object=WANTED, max_rounds=4, **(SMALL | changes))


@pytest.fixture(scope="module")
def brick():
    return load_object("foam_brick")


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return settings(tmp_path_factory)


@pytest.fixture(scope="module")
def generator(config):
    return HandoffGenerator(load_robot(), config)


@pytest.fixture(scope="module")
def generated(generator, brick):
    return generator.generate(brick)


def rotation(quat):
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.float64(quat))
    return matrix.reshape(3, 3)


def test_enough_states_in_the_object_area_at_rest(generated, config, brick):
    handoffs, report = generated
    assert len(handoffs) == report.kept == WANTED
    (x0, x1), (y0, y1) = config.sampling.area.x, config.sampling.area.y
    x, y, z = handoffs.object_pos.T
    assert np.all((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1))
    heights = np.array([pose.height for pose in brick.resting])
    assert np.abs(z[:, None] - heights).min(axis=1).max() < 1e-6


def test_tips_are_at_their_standoffs_by_native_mujoco(generated, brick):
    """Recomputed from q alone: 25 mm and 40 mm outside the contacts, within 5 mm."""
    handoffs, _ = generated
    robot = load_robot()
    scene = build_scene([brick], robot)
    data = mujoco.MjData(scene.model)
    distance = np.array([0.025, 0.040, 0.040])[:, None]
    for k in range(len(handoffs)):
        data.qpos[scene.addresses.robot_qpos] = handoffs.q[k]
        data.qpos[scene.addresses.object_qpos[:3]] = handoffs.object_pos[k]
        data.qpos[scene.addresses.object_qpos[3:]] = handoffs.object_quat[k]
        mujoco.mj_forward(scene.model, data)
        tips = np.array([data.site(finger.tip_site).xpos for finger in robot.hand.fingers])
        goal = handoffs.target_pos[k] + distance * handoffs.target_normal[k]
        error = np.linalg.norm(tips - goal, axis=1)
        assert error.max() <= 0.005
        assert np.allclose(error, handoffs.residual[k], atol=5e-6)
        # And nothing penetrates but the object's rest on the table.
        table = scene.model.geom("table").id
        for pair in data.contact.geom[data.contact.dist < 0]:
            assert table in pair and set(pair) - {table} <= set(scene.addresses.object_geoms)


def test_targets_belong_to_the_object_and_are_high_enough(generated, brick):
    handoffs, _ = generated
    assert handoffs.target_pos[:, :, 2].min() >= 0.015
    assert np.allclose(np.linalg.norm(handoffs.target_normal, axis=-1), 1, atol=1e-5)
    for k in range(len(handoffs)):
        turn = rotation(handoffs.object_quat[k])
        thumb, first, second = (handoffs.target_pos[k] - handoffs.object_pos[k]) @ turn
        vertex = np.linalg.norm(brick.mesh.vertices - thumb, axis=1).argmin()
        assert np.allclose(brick.mesh.vertices[vertex], thumb, atol=1e-5)
        assert np.linalg.norm(first - second) == pytest.approx(0.04, abs=1e-5)
        # The wraps oppose the thumb: across the object, normals against each other.
        across = 0.5 * (first + second) - thumb
        assert 0.01 < np.linalg.norm(across) < 0.12
        assert handoffs.target_normal[k, 0] @ handoffs.target_normal[k, 1] < -0.5


def test_joints_are_within_their_limits_and_the_margin(generated, config):
    handoffs, _ = generated
    robot = load_robot()
    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    limits = np.array([model.joint(name).range for name in robot.joints])
    solved = set(robot.arm.joints).union(*(f.joints for f in robot.hand.fingers))
    kept = config.posture.clearances.joint_limits - 1e-6
    margin = np.where([n in solved for n in robot.joints], kept, -1e-6)
    assert np.all(handoffs.q >= limits[:, 0] + margin)
    assert np.all(handoffs.q <= limits[:, 1] - margin)


def test_from_every_state_the_arm_can_lift_straight_up_and_the_fingers_touch(generated, config):
    handoffs, _ = generated
    body, posture = robot_body(load_robot()), config.posture
    lift = jax.jit(jax.vmap(lambda q: scripted_lift(body, q, posture.lift_height)))(handoffs.q)
    assert np.all(lift.error <= posture.lift_error + 1e-4)
    errors = jax.jit(jax.vmap(lambda q, at: touch_errors(body, q, at)))
    touch = errors(handoffs.q, handoffs.target_pos)
    assert np.all(touch <= posture.touch_error + 1e-4)


def test_from_every_state_the_hand_can_hold_the_object(generated, config, brick):
    handoffs, _ = generated
    body, friction = robot_body(load_robot()), config.posture.must_hold

    def holds(q, contacts, normals, p_wo, quat):
        turn, com = so3.quat_to_mat(quat), jnp.float32(brick.com)
        anything = Sphere(jnp.float32(0.01))
        around = Surroundings.still(anything, p_wo, turn, com, jnp.float32(brick.weight))
        closed = touching(body, q, contacts).q
        return can_hold(body, friction, closed, contacts, normals, around)

    states = handoffs.q, handoffs.target_pos, handoffs.target_normal
    assert jax.jit(jax.vmap(holds))(*states, handoffs.object_pos, handoffs.object_quat).all()


def test_every_pair_is_accounted_for(generated):
    _, report = generated
    assert report.sampled == report.feasible + sum(report.rejected.values())
    assert set(report.rejected) <= set(OUTCOMES)
    late = sum(report.rejected[reason] for reason in OUTCOMES[OUTCOMES.index("reach-axis") :])
    assert report.converged == report.feasible + late
    assert report.feasible >= report.kept > 0 and report.eligible
    row = json.loads(json.dumps(report.as_row()))
    assert row["kept"] == WANTED and set(row["rejected"]) == set(OUTCOMES)


def test_states_are_spread_over_poses_and_candidates(generated, config):
    handoffs, _ = generated
    poses = np.unique(handoffs.object_pos, axis=0)
    assert len(poses) >= WANTED // 2
    thumbs = Counter()
    for k in range(len(handoffs)):
        local = (handoffs.target_pos[k, 0] - handoffs.object_pos[k]) @ rotation(
            handoffs.object_quat[k]
        )
        thumbs[tuple(np.round(local, 4))] += 1
    assert max(thumbs.values()) <= config.max_per_candidate
    assert len(thumbs) >= WANTED // 2


@pytest.mark.long
def test_the_seed_decides_everything_and_other_objects_nothing(generated, generator, brick):
    first, _ = generated
    other, _ = generator.generate(load_object("rubiks_cube"))
    again, _ = generator.generate(brick)
    assert len(other) > 0
    for field in dataclasses.fields(first):
        assert np.array_equal(getattr(first, field.name), getattr(again, field.name))


def test_an_object_without_any_is_not_eligible(generator):
    handoffs, report = generator.generate(load_object("mini_soccer_ball"))
    assert len(handoffs) == report.kept == 0 and not report.eligible
    assert handoffs.q.shape == (0, 27)
    cells = [cell for column in report_table([report]).columns for cell in column.cells]
    assert "not eligible" in cells


@pytest.mark.parametrize(
    ("change", "field"), [({"per_object": 0}, "--per-object"), ({"out": "set.txt"}, "--out")]
)
def test_bad_settings_are_refused_by_name(config, change, field):
    from pathlib import Path

    change = {k: Path(v) if k == "out" else v for k, v in change.items()}
    with pytest.raises(InputError) as error:
        dataclasses.replace(config, **change)
    assert error.value.field == field


def command(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "mjx_grasp.handoffs", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=300,
    )


TYPED = (
    *("--sampling.poses-per-round", 16, "--sampling.candidates-per-pose", 3),
    *("--posture.library", 3000, "--posture.starts.count", 2, "--max-rounds", 4),
)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A set as the command writes it, and what the command said."""
    out = tmp_path_factory.mktemp("sets") / "brick.npz"
    done = command("--objects", "foam_brick", "--per-object", 6, "--seed", 2, "--out", out, *TYPED)
    assert done.returncode == 0, done.stderr
    return out, done.stdout


@pytest.mark.long
def test_the_command_writes_a_set_and_its_report(written):
    out, said = written
    assert load_handoffs(out, [load_object("foam_brick")]).counts() == {"foam_brick": 6}
    report = json.loads(out.with_suffix(".json").read_text())
    assert report["objects"][0]["kept"] == 6 and report["not_eligible"] == []
    assert report["config"]["posture"]["library"] == 3000
    assert report["provenance"]["seed"] == 2
    assert "foam_brick" in said and "6 states of 1 objects" in said


MORE = ("--objects", "gelatin_box", "--per-object", 4)


@pytest.mark.long
def test_a_set_is_added_to(written, tmp_path):
    before, _ = written
    first = json.loads(before.with_suffix(".json").read_text())
    out = tmp_path / "both.npz"
    for end in (".npz", ".json"):
        out.with_suffix(end).write_bytes(before.with_suffix(end).read_bytes())
    done = command(*MORE, "--update", out, "--out", out, *TYPED)
    assert done.returncode == 0, done.stderr
    assert "10 states of 2 objects" in done.stdout
    updated = load_handoffs(out)
    assert updated.counts() == {"foam_brick": 6, "gelatin_box": 4}
    same = updated.select(("foam_brick",)).q
    np.testing.assert_array_equal(same, load_handoffs(before).q)
    report = json.loads(out.with_suffix(".json").read_text())
    assert [row["name"] for row in report["objects"]] == ["foam_brick", "gelatin_box"]
    assert report["earlier"] == [first["provenance"]]


def test_a_set_without_its_report_is_not_added_to(tmp_path, monkeypatch, capsys):
    alone = tmp_path / "alone.npz"
    alone.write_bytes(asset_path("handoffs_cube.npz").read_bytes())
    update = ("--update", alone, "--out", alone)
    status, error = refusal(monkeypatch, capsys, "handoffs", *MORE, *update)
    assert status == 2 and "alone.json" in error


def test_the_command_refuses_what_it_does_not_know(tmp_path):
    done = typed("handoffs", "--objects", "foam_brik", "--out", tmp_path / "x.npz")
    assert done.returncode == 2
    assert "foam_brick" in done.stderr and "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["x.npz", "x.json"])
def test_what_is_no_set_or_report_is_not_replaced(tmp_path, name):
    (tmp_path / name).write_text('{"something": "else"}')
    done = typed("handoffs", "--objects", "foam_brick", "--out", tmp_path / "x.npz")
    assert done.returncode == 2 and name in done.stderr
    assert (tmp_path / name).read_text() == '{"something": "else"}'
    assert [file.name for file in tmp_path.iterdir()] == [name]
