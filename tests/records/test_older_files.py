"""Files outlive code: what version 1 wrote is read, and says what it said.

The files of `tests/data/v1` were written by the package as it was before archives had one module.
"""

import hashlib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.trajectory import load_trajectory, save_trajectory
from mjx_grasp.handoff.dataset import UNKNOWN_M, load_handoffs
from mjx_grasp.handoff.shipped import SHIPPED
from mjx_grasp.heatmap.files import HeatmapInfo, load_heatmap, save_heatmap
from mjx_grasp.learning.policy import load_policy
from mjx_grasp.robot.identity import FIRST_ROBOT

V1 = Path(__file__).parent.parent / "data" / "v1"


def test_a_policy():
    policy = load_policy(V1 / "policy.npz")
    assert policy.robot == FIRST_ROBOT
    assert (policy.observation_size, policy.action_size) == (66, 15)
    assert [w.shape for w in policy.weights] == [(66, 128), (128, 128), (128, 15)]
    assert policy.meta.keys() == {"task", "objects", "env_steps", "provenance"}
    assert policy.meta["env_steps"] == 30_801_920 and policy.meta["task"]["grip_force"] == 1.0
    action = policy(jnp.linspace(-1, 1, 66))
    expected = [
        *(0.192, -0.729, -0.5465, -0.8268, -0.5272, -0.2351, -1.0, -1.0),
        *(-0.5756, -0.3036, 0.7346, -0.6214, -0.3353, -0.5218, -0.1546),
    ]
    np.testing.assert_allclose(action, expected, atol=1e-4)


@pytest.mark.parametrize("folder", [V1, V1.parent / "v2"], ids=lambda folder: folder.name)
def test_a_handoff_set(robot, folder):
    handoffs = load_handoffs(folder / "handoffs.npz", robot=robot)
    assert handoffs.robot == FIRST_ROBOT and handoffs.kind == "ik"
    assert handoffs.counts() == {"foam_brick": 3, "sugar_box": 2}
    assert [h[:8] for h in handoffs.object_content_hash] == ["ce2b3cad", "9d1f8be4"]
    assert handoffs.q.shape == (5, 27)
    # What these files do not say.
    assert not handoffs.reached.any() and np.all(handoffs.midpoint == UNKNOWN_M)
    np.testing.assert_allclose(
        handoffs.q[0, :4], [1.8879739, -2.2941012, -1.6343769, 1.8037711], rtol=1e-7
    )
    np.testing.assert_allclose(handoffs.object_pos[4], [0.50027984, -0.11951135, 0.019], rtol=1e-7)
    np.testing.assert_allclose(handoffs.target_normal[4, 0], [-0.9140224, -0.4056637, 0], rtol=1e-7)
    np.testing.assert_allclose(
        handoffs.score, [0.64479613, 0.8389527, 0.44444102, 0.82449085, 0.8503964], rtol=1e-7
    )


def test_a_heatmap():
    stored = load_heatmap(V1 / "heatmap.npz")
    assert stored.info == HeatmapInfo(
        "cube", (0.02, 0.09), 0.5, (0.0, 0.0, 0.0), (0.0, 0.0, 0.02), 0.03
    )
    heatmap = stored.heatmap
    assert stored.faces.shape == (192, 3) and heatmap.valid.sum() == len(heatmap.vertices) == 98
    np.testing.assert_allclose(
        heatmap.score[[0, 1, 8]], [0.00190713, 0.22577077, 0.66666657], rtol=1e-5
    )
    np.testing.assert_allclose(heatmap.wrap[0], [[0.025, 0.015, 0], [0.025, -0.015, 0]], atol=1e-8)
    sums = {name: float(column.sum()) for name, column in heatmap.terms.items()}
    assert sums == pytest.approx(
        {"width": 98.0, "thumb": 97.97681, "wrap": 61.6553, "coherence": 53.411346,
         "com": 81.96849, "separation": 69.0}, rel=1e-6,
    )  # fmt: skip


def test_a_trajectory():
    trajectory = load_trajectory(V1 / "trajectory.npz")
    assert trajectory.robot == FIRST_ROBOT
    assert (trajectory.mujoco_version, trajectory.dt, trajectory.focus) == (
        "3.17.0",
        0.02,
        "object",
    )
    start = np.array([0, 0, 0, 1, 0, 0, 0, 0])
    np.testing.assert_allclose(trajectory.qpos, start + 0.01 * np.arange(4)[:, None])
    assert hashlib.sha256(trajectory.model).hexdigest().startswith("99023ea805ad9ceb")


READERS = {
    "policy": load_policy,
    "handoffs": load_handoffs,
    "heatmap": load_heatmap,
    "trajectory": load_trajectory,
}


@pytest.mark.parametrize("name", READERS)
def test_damaged_ones_are_refused(name, tmp_path):
    path = tmp_path / f"{name}.npz"
    whole, refusals = (V1 / path.name).read_bytes(), 0
    with np.load(V1 / path.name) as file:
        arrays = dict(file)
    for start in np.linspace(0, len(whole) - 8, 41).astype(int):
        damaged = bytes(b ^ 0xFF for b in whole[start : start + 8])
        path.write_bytes(whole[:start] + damaged + whole[start + 8 :])
        try:
            READERS[name](path)
        except FileError as error:
            assert error.path == path
            refusals += 1
        else:  # a part of the zip file that says nothing
            with np.load(path) as file:
                assert all(np.array_equal(file[n], array) for n, array in arrays.items())
    assert refusals > 30
    changed = {"policy": "mean", "handoffs": "q", "heatmap": "terms"}.get(name)
    if changed is not None:
        np.savez(path, **(arrays | {changed: arrays[changed] * np.float32(0.5)}))
        with pytest.raises(FileError, match="checksum"):
            READERS[name](path)


def test_heatmap_terms_in_another_order_are_refused(tmp_path):
    """The checksum of version 1 leaves out their names."""
    with np.load(V1 / "heatmap.npz") as file:
        arrays = dict(file)
    np.savez(tmp_path / "h.npz", **(arrays | {"term_names": arrays["term_names"][::-1]}))
    with pytest.raises(FileError, match="checksum"):
        load_heatmap(tmp_path / "h.npz")


def test_what_is_read_can_be_written_anew(tmp_path):
    """As today's version, with the same content."""
    path = tmp_path / "new.npz"
    policy = load_policy(V1 / "policy.npz")
    policy.save(path)
    again = load_policy(path)
    assert again.meta == policy.meta
    for a, b in zip(again.weights + again.biases, policy.weights + policy.biases, strict=True):
        np.testing.assert_array_equal(a, b)
    handoffs = load_handoffs(V1 / "handoffs.npz")
    handoffs.save(path)
    np.testing.assert_array_equal(load_handoffs(path).q, handoffs.q)
    stored = load_heatmap(V1 / "heatmap.npz")
    save_heatmap(path, stored.heatmap, stored.faces, stored.info)
    np.testing.assert_array_equal(load_heatmap(path).heatmap.wrap, stored.heatmap.wrap)
    trajectory = load_trajectory(V1 / "trajectory.npz")
    save_trajectory(path, trajectory)
    assert load_trajectory(path).model == trajectory.model


def test_the_shipped_files_are_read(robot):
    for name in ("handoffs_standins", "handoffs_reached"):
        assert len(load_handoffs(asset_path(f"{name}.npz"), robot=robot)) > 500
    assert len(load_handoffs(SHIPPED[0].path, robot=robot)) > 200
    assert load_policy(asset_path("policy.npz")).robot.agrees(robot.identity)
