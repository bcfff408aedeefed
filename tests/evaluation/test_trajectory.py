import mujoco
import numpy as np
import pytest
from forging import rewrite
from handmade import ball, dumbbell

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.trajectory import load_trajectory, record, record_world, save_trajectory
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import build_scene

XML = """
<mujoco><worldbody><body name="object"><freejoint/><geom size="0.03"/></body>
<body name="arm"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 0.2" size="0.02"/>
</body></worldbody></mujoco>
"""


@pytest.fixture
def model():
    return mujoco.MjModel.from_xml_string(XML)


def poses(model, n=4):
    return np.tile(model.qpos0, (n, 1)) + np.arange(n)[:, None] * 0.01


def test_a_trajectory_survives_the_file(model, tmp_path):
    path = tmp_path / "t.npz"
    trajectory = record(model, poses(model), 0.02)
    save_trajectory(path, trajectory)
    found = load_trajectory(path)
    assert found.model == trajectory.model
    assert np.array_equal(found.qpos, poses(model))
    assert (found.dt, found.focus, found.seconds) == (0.02, "object", pytest.approx(0.06))
    assert found.robot is None and found.mujoco_version == mujoco.__version__
    (tmp_path / "m.mjb").write_bytes(found.model)
    again = mujoco.MjModel.from_binary_path(str(tmp_path / "m.mjb"))
    assert again.nq == model.nq and again.body("arm").id == model.body("arm").id


@pytest.mark.wrong_types
def test_poses_that_do_not_fit_are_refused(model):
    good = poses(model)
    for qpos, dt, focus, field in (
        (good[:, :-1], 0.1, "object", "qpos"),
        (good[0], 0.1, "object", "qpos"),
        (good[:0], 0.1, "object", "qpos"),
        (np.where(good == good[1, 0], np.nan, good), 0.1, "object", "qpos"),
        (good, 0.0, "object", "dt"),
        (good, 0.1, "cup", "focus"),
    ):
        with pytest.raises(InputError, match=field):
            record(model, qpos, dt, focus)


def test_a_damaged_or_foreign_file_is_refused_by_name(model, tmp_path):
    path = tmp_path / "t.npz"
    with pytest.raises(FileError, match=r"t\.npz.*no such file"):
        load_trajectory(path)
    save_trajectory(path, record(model, poses(model), 0.02))
    whole = path.read_bytes()
    for damaged in (b"", b"no archive", whole[: len(whole) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(FileError, match=r"t\.npz"):
            load_trajectory(path)
    np.savez(path, qpos=poses(model))
    with pytest.raises(FileError, match="another kind of file"):
        load_trajectory(path)
    for change, message in (
        (lambda arrays, header: header.update(version=99), "version 99"),
        (lambda arrays, header: header.update(dt=-1.0), "dt"),
        (lambda arrays, header: arrays.update(qpos=arrays["qpos"][:0]), "one pose or more"),
        (lambda arrays, header: arrays.update(qpos=arrays["qpos"] * np.nan), "not finite"),
    ):
        save_trajectory(path, record(model, poses(model), 0.02))
        rewrite(path, change, sign=True)
        with pytest.raises(FileError, match=message):
            load_trajectory(path)


def test_a_world_of_a_scene_shows_its_own_object_only(tmp_path):
    scene = build_scene([ball(), dumbbell()], load_robot())
    trajectory = record_world(scene, "dumbbell", poses(scene.model), 0.02)
    assert trajectory.robot == scene.robot.identity
    save_trajectory(tmp_path / "t.npz", trajectory)
    assert load_trajectory(tmp_path / "t.npz").robot == trajectory.robot
    (tmp_path / "m.mjb").write_bytes(trajectory.model)
    model = mujoco.MjModel.from_binary_path(str(tmp_path / "m.mjb"))
    visible = {
        model.geom(g).name
        for g in scene.addresses.object_geoms
        if model.geom_rgba[g, 3] > 0 and model.geom_pos[g, 2] < 1.0
    }
    assert visible == {"dumbbell_0", "dumbbell_1", "dumbbell_2"}
    assert scene.model.geom_rgba[scene.addresses.object_geoms, 3].min() == 1.0  # a copy was changed
    with pytest.raises(InputError, match="cup"):
        record_world(scene, "cup", poses(scene.model), 0.02)
