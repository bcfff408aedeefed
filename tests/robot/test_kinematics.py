from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.robot.kinematics import Kinematics
from mjx_grasp.robot.mjcf import robot_mjspec
from mjx_grasp.robot.spec import load_robot

# Slides, several joints on a body, anchors off the origin, reference positions, a tilted fixed
# body, joints after a free body.
ODD = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="loose" pos="1 0 0"><freejoint/><geom size="0.1"/><site name="on_loose"/></body>
    <body name="cart" pos="0 0 0.3" euler="0.2 0.1 -0.4">
      <joint name="x" type="slide" axis="1 1 0" ref="0.1"/>
      <joint name="turn" axis="0 1 1" pos="0.1 0.2 0" ref="0.4"/>
      <joint name="y" type="slide" axis="0 1 0" pos="0.3 0 0"/>
      <geom size="0.1"/>
      <body name="plate" pos="0.1 0 0.2" euler="0 0.7 0">
        <geom size="0.1"/>
        <body name="arm" pos="0 0.3 0" euler="1 0 0">
          <joint name="elbow" axis="1 2 3" pos="-0.1 0 0.05"/>
          <geom size="0.1"/><site name="end" pos="0.1 0.2 0.3" euler="0.3 0 0"/>
        </body>
        <body name="other"><joint name="unused"/><geom size="0.1"/></body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def model():
    return robot_mjspec(load_robot()).compile()


def all_sites(model):
    return [model.site(i).name for i in range(model.nsite)]


def configurations(model, n, seed=0):
    low, high = model.jnt_range.T
    return np.random.default_rng(seed).uniform(low, high, (n, model.nq)).astype(np.float32)


def rotation_angles(A, B):
    """Angles between rotations, rad; from the chord, which is exact for small ones."""
    return 2 * np.arcsin(np.minimum(np.linalg.norm(A - B, axis=(-2, -1)) / np.sqrt(8), 1))


def test_frames_agree_with_mujoco_in_float32(model):
    sites, bodies = all_sites(model), [model.body(i).name for i in range(model.nbody)]
    kinematics = Kinematics.from_model(model, sites, bodies)
    assert kinematics.frames == (*sites, *bodies)
    q = configurations(model, 200)
    pos, mat = jax.jit(jax.vmap(kinematics.forward))(q)
    assert pos.dtype == mat.dtype == jnp.float32
    data = mujoco.MjData(model)
    for k in range(len(q)):
        data.qpos[:] = q[k]
        mujoco.mj_kinematics(model, data)
        expected_pos = np.concatenate([data.site_xpos, data.xpos])
        expected_mat = np.concatenate([data.site_xmat, data.xmat]).reshape(-1, 3, 3)
        assert np.linalg.norm(pos[k] - expected_pos, axis=-1).max() < 1e-5
        assert rotation_angles(np.asarray(mat[k]), expected_mat).max() < 1e-5


def jacobian_of(kinematics, q):
    """From joint velocities to twists of the frames, linear before angular, by the screws."""
    motion = kinematics.motion(q)
    angular, linear = motion.screws[:, :3], motion.screws[:, 3:]
    swept = jnp.cross(angular, motion.pos[:, None]) + linear
    twists = jnp.concatenate([swept, jnp.broadcast_to(angular, swept.shape)], axis=-1)
    return jnp.swapaxes(jnp.where(jnp.asarray(kinematics.moves)[:, :, None], twists, 0.0), 1, 2)


def test_jacobians_agree_with_mujoco(model):
    sites = all_sites(model)
    kinematics = Kinematics.from_model(model, sites)
    q = configurations(model, 200, seed=1)
    found = jax.jit(jax.vmap(partial(jacobian_of, kinematics)))(q)
    data = mujoco.MjData(model)
    expected = np.zeros((6, model.nv))
    for k in range(len(q)):
        data.qpos[:] = q[k]
        mujoco.mj_fwdPosition(model, data)
        for i in range(len(sites)):
            mujoco.mj_jacSite(model, data, expected[:3], expected[3:], i)
            np.testing.assert_allclose(found[k, i], expected, atol=1e-5)


def test_jacobian_is_the_derivative_of_forward(model):
    kinematics = Kinematics.from_model(model, all_sites(model))
    step = 1e-6
    with jax.enable_x64(True):
        forward = jax.jit(jax.vmap(kinematics.forward))
        many = jnp.asarray(configurations(model, 20, seed=2), jnp.float64)
        jacobians = np.asarray(jax.jit(jax.vmap(partial(jacobian_of, kinematics)))(many))
        rotations = np.asarray(forward(many)[1])
        steps = step * jnp.concatenate([jnp.eye(model.nq), -jnp.eye(model.nq)])
        moved = [tuple(map(np.asarray, forward(q + steps))) for q in many]
    for jacobian, R, (pos, mat) in zip(jacobians, rotations, moved, strict=True):
        linear = (pos[: model.nq] - pos[model.nq :]) / (2 * step)
        # Ṙ Rᵀ is the angular velocity's cross-product matrix.
        spin = (mat[: model.nq] - mat[model.nq :]) / (2 * step) @ np.swapaxes(R, 1, 2)
        angular = np.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], axis=-1)
        np.testing.assert_allclose(jacobian[:, :3], np.moveaxis(linear, 0, -1), atol=1e-8)
        np.testing.assert_allclose(jacobian[:, 3:], np.moveaxis(angular, 0, -1), atol=1e-8)


def test_batched_equals_looped_and_jitted_equals_eager(model):
    kinematics = Kinematics.from_model(model, ["thumb_pad_site", "little_tip_site"])
    q = jnp.asarray(configurations(model, 2, seed=3))
    for function in (kinematics.forward, kinematics.motion):
        batched = jax.tree.leaves(jax.jit(jax.vmap(function))(q))
        looped = [jax.tree.leaves(function(one)) for one in q]
        for k, leaf in enumerate(batched):
            np.testing.assert_allclose(leaf, np.stack([one[k] for one in looped]), atol=1e-6)


def test_kinematics_is_static_under_jit(model):
    kinematics = Kinematics.from_model(model, ["palm_site"])
    q = jnp.zeros(model.nq)
    pos, _ = jax.jit(lambda k, q: k.forward(q))(kinematics, q)
    np.testing.assert_allclose(pos, kinematics.forward(q)[0], atol=1e-6)


def test_slides_offset_anchors_and_several_joints_on_a_body():
    model = mujoco.MjModel.from_xml_string(ODD)
    data = mujoco.MjData(model)
    kinematics = Kinematics.from_model(model, ["end"], ["plate", "cart", "world"])
    assert kinematics.joints == ("x", "turn", "y", "elbow", "unused")
    for q in np.random.default_rng(4).uniform(-1, 1, (20, 5)):
        data.qpos[7:] = q
        mujoco.mj_fwdPosition(model, data)
        pos, mat = kinematics.forward(jnp.asarray(q, jnp.float32))
        jacobian = jacobian_of(kinematics, jnp.asarray(q, jnp.float32))
        for i, frame in enumerate(
            (data.site("end"), data.body("plate"), data.body("cart"), data.body("world"))
        ):
            np.testing.assert_allclose(pos[i], frame.xpos, atol=2e-6)
            np.testing.assert_allclose(mat[i], frame.xmat.reshape(3, 3), atol=2e-6)
        expected = np.zeros((6, model.nv))
        mujoco.mj_jacSite(model, data, expected[:3], expected[3:], model.site("end").id)
        np.testing.assert_allclose(jacobian[0], expected[:, 6:], atol=5e-6)
        assert not jacobian[3].any()


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"sites": ["nowhere"]}, "nowhere"),
        ({"bodies": ["nobody"]}, "nobody"),
        ({}, "at least one"),
        ({"sites": ["on_loose"]}, "on_loose.*free or ball"),
    ],
)
def test_requests_that_cannot_be_met_are_refused(request_, message):
    with pytest.raises(InputError, match=message):
        Kinematics.from_model(mujoco.MjModel.from_xml_string(ODD), **request_)
