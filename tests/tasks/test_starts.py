from dataclasses import replace

import handmade
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scripted import draw_of

from mjx_grasp.closing.guidance import goal_frame
from mjx_grasp.errors import InputError
from mjx_grasp.geometry import so3
from mjx_grasp.sim.scene import build_scene
from mjx_grasp.tasks.config import StartNoise
from mjx_grasp.tasks.starts import (
    balanced_weights,
    build_starts,
    draw_params,
    draw_starts,
    placed_object,
)


def test_rows_hold_what_mujoco_says_of_the_state(scene, starts):
    data, at = mujoco.MjData(scene.model), scene.addresses
    for row in (0, 4, 8):
        data.qpos[:] = starts.qpos[row]
        mujoco.mj_forward(scene.model, data)
        r, truth = starts.measured, starts.truth
        np.testing.assert_allclose(r.palm_pos[row], data.site_xpos[at.palm_site], atol=1e-6)
        np.testing.assert_allclose(r.pad_pos[row], data.site_xpos[at.pad_sites], atol=1e-6)
        np.testing.assert_allclose(
            r.pad_mat[row].reshape(3, 9), data.site_xmat[at.pad_sites], atol=1e-6
        )
        body = data.xpos[at.object_body]
        np.testing.assert_allclose(truth.object_pos[row], body, atol=1e-6)
        # The command holds the posture.
        np.testing.assert_array_equal(
            starts.ctrl[row][at.robot_ctrl], starts.qpos[row][at.robot_qpos]
        )


def test_pads_oppose_across_the_object_and_goals_point_into_it(starts):
    inward = -np.asarray(starts.targets.normal)
    goal = goal_frame(starts.measured.pad_mat, starts.targets.normal)
    np.testing.assert_allclose(goal[..., :, 0], inward, atol=1e-5)
    way = np.asarray(starts.targets.position - starts.measured.pad_pos)
    assert ((way * inward).sum(-1) > 0.002).all()


def test_object_indices_follow_the_scene_and_not_the_file(handmade_objects, robot):
    reversed_scene = build_scene(handmade_objects[::-1], robot)
    handoffs = handmade.handoffs(handmade_objects[:2], turns=(0.0,))
    starts = build_starts(reversed_scene, handoffs, 5)
    names = [reversed_scene.object_names[k] for k in starts.object_index]
    assert names == ["box", "ball"]


def test_other_meshes_unknown_objects_and_empty_sets_are_refused(scene, handmade_objects):
    handoffs = handmade.handoffs(handmade_objects[:1])
    with pytest.raises(InputError, match=r"handoffs of box.*another mesh"):
        build_starts(scene, replace(handoffs, object_content_hash=("0" * 64,)), 5)
    with pytest.raises(InputError, match="teapot"):
        build_starts(scene, replace(handoffs, object_names=("teapot",)), 5)
    with pytest.raises(InputError, match="at least one start state"):
        build_starts(scene, handoffs.take(np.zeros(0, int)), 5)


def test_weights_make_objects_equally_likely():
    index = jnp.array([0, 0, 0, 2, 2, 3])
    weights = np.asarray(balanced_weights(index, 5))
    share = [weights[np.asarray(index) == k].sum() for k in range(5)]
    np.testing.assert_allclose(share, [1, 0, 1, 1, 0], rtol=1e-6)


def test_draws_follow_weights_and_stay_in_their_ranges(starts):
    weights = jnp.array([0, 1, 3, 0, 0, 0, 0, 0, 4.0])
    noise = StartNoise(0.004, 0.2, friction=(0.5, 0.9), mass_scale=(0.8, 1.3))
    draw = draw_starts(jax.random.PRNGKey(0), 20000, noise, weights)
    share = np.bincount(draw.row, minlength=9) / 20000
    np.testing.assert_allclose(share, np.asarray(weights) / 8, atol=0.015)
    angle = np.linalg.norm(draw.rotation, axis=-1)
    for values, low, high in (
        (np.asarray(draw.offset), -0.004, 0.004),
        (angle, 0.0, 0.2),
        (np.asarray(draw.friction), 0.5, 0.9),
        (np.asarray(draw.mass_scale), 0.8, 1.3),
    ):
        assert values.min() >= low - 1e-6 and values.max() <= high + 1e-6
        # Uniform: mean and spread of the whole range.
        np.testing.assert_allclose(values.mean(), (low + high) / 2, atol=0.02 * (high - low))
        np.testing.assert_allclose(values.std(), (high - low) / 12**0.5, rtol=0.03)
    assert abs(np.corrcoef(draw.offset[:, 0], draw.offset[:, 1])[0, 1]) < 0.03


def test_draws_are_a_function_of_the_key(starts):
    weights = balanced_weights(starts.object_index, 3)
    one, same, other = (
        draw_starts(jax.random.PRNGKey(k), 64, StartNoise(), weights) for k in (1, 1, 2)
    )
    jax.tree.map(np.testing.assert_array_equal, one, same)
    assert (one.offset != other.offset).any() and (one.row != other.row).any()


def test_offset_shifts_along_the_table_only(starts):
    draw = draw_of([0, 4])._replace(offset=jnp.array([[0.003, -0.004], [0.0, 0.0]]))
    pose = np.asarray(placed_object(starts, draw, turned=False))
    np.testing.assert_allclose(
        pose[0, :3] - np.asarray(starts.truth.object_pos[0]), [0.003, -0.004, 0], atol=1e-7
    )
    np.testing.assert_array_equal(pose[1, :3], starts.truth.object_pos[4])
    np.testing.assert_array_equal(pose[:, 3:], starts.truth.object_quat[jnp.array([0, 4])])


@pytest.mark.long
@given(seed=st.integers(0, 2**31))
def test_turned_objects_stand_on_the_table(starts, scene, seed):
    w = np.random.default_rng(seed).normal(size=(9, 3)) * 0.2
    draw = draw_of(range(9))._replace(rotation=jnp.asarray(w, jnp.float32))
    pose = placed_object(starts, draw, turned=True)
    for row in range(9):
        vertices = scene.objects[int(starts.object_index[row])].mesh.vertices
        R = np.asarray(so3.quat_to_mat(pose[row, 3:]))
        assert abs((vertices @ R.T)[:, 2].min() + float(pose[row, 2])) < 2e-6
        # Turned in the world by the drawn rotation.
        before = np.asarray(so3.quat_to_mat(starts.truth.object_quat[row]))
        turn = np.asarray(so3.log(jnp.asarray(R @ before.T)))
        np.testing.assert_allclose(turn, w[row], atol=1e-5)


def test_params_carry_object_friction_and_mass(starts):
    draw = draw_of([0, 3, 8])._replace(
        friction=jnp.array([0.5, 0.6, 0.7]), mass_scale=jnp.array([1.0, 2.0, 3.0])
    )
    params = draw_params(starts, draw)
    assert params.object_index.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(params.friction, draw.friction)
    np.testing.assert_array_equal(params.mass_scale, draw.mass_scale)
