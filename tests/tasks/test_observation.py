import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.tasks.observation import privileged, proprioception


def critic(readings, contacts, normals, lifting=0.0):
    w = len(readings.q)
    return np.asarray(
        privileged(
            jnp.arange(w * 66, dtype=jnp.float32).reshape(w, 66),
            readings,
            contacts,
            normals,
            landed=jnp.zeros((w, 3), bool),
            lifting=jnp.full(w, lifting),
            time=jnp.full(w, 0.25),
            lift_time=jnp.full(w, 0.1),
            rise=jnp.full(w, 0.05),
            displacement=jnp.full(w, 0.01),
            physics=jnp.array([[0.8, 1.0]] * w),
        )
    )


def rows(starts, which):
    return starts.readings._replace(
        **{n: getattr(starts.readings, n)[which] for n in starts.readings._fields}
    )


def test_proprioception_keeps_its_order():
    q, qd, a = jnp.arange(9.0), 10 + jnp.arange(9.0), 20 + jnp.arange(15.0)
    expected = [*range(9), *range(10, 19), *range(20, 35)]
    np.testing.assert_array_equal(proprioception(q, qd, a), expected)


def test_critic_sees_what_the_actor_sees_first_and_all_is_finite(starts):
    seen = critic(rows(starts, slice(0, 3)), starts.contacts[:3], starts.normals[:3])
    np.testing.assert_array_equal(seen[:, :66], np.arange(3 * 66).reshape(3, 66))
    assert np.isfinite(seen).all()


def test_critic_is_told_of_the_object_the_stage_and_the_forces(starts):
    base, contacts, normals = rows(starts, slice(0, 1)), starts.contacts[:1], starts.normals[:1]
    seen = critic(base, contacts, normals)
    for change in (
        {"object_pos": base.object_pos + 0.01},
        {"object_vel": base.object_vel + 0.1},
        {"object_quat": jnp.roll(base.object_quat, 1, axis=-1)},
        {"tip_found": ~base.tip_found},
        {"tip_force": base.tip_force + 1.0},
    ):
        assert (critic(base._replace(**change), contacts, normals) != seen).any(), change
    assert (critic(base, contacts, normals, lifting=1.0) != seen).any()


@given(shift=st.tuples(*[st.floats(-2, 2)] * 3))
def test_critic_does_not_see_where_in_the_world_it_all_is(starts, shift):
    base, by = rows(starts, slice(0, 1)), jnp.asarray(shift, jnp.float32)
    places = ("object_pos", "palm_pos", "pad_pos")
    moved = base._replace(**{name: getattr(base, name) + by for name in places})
    found = critic(moved, starts.contacts[:1] + by, starts.normals[:1])
    straight = critic(base, starts.contacts[:1], starts.normals[:1])
    np.testing.assert_allclose(found, straight, atol=2e-4)


@given(angle=st.floats(-3, 3))
def test_critic_sees_vectors_relative_to_the_palm(starts, angle):
    """Turning the world about the vertical changes only the object's own quaternion."""
    c, s = np.cos(angle), np.sin(angle)
    T = jnp.asarray([[c, -s, 0], [s, c, 0], [0, 0, 1]], jnp.float32)
    base = rows(starts, slice(0, 1))
    base = base._replace(
        object_vel=jnp.array([[0.1, -0.2, 0.3, 1, 2, 3]]),
        tip_force=jnp.arange(9.0).reshape(1, 3, 3),
    )
    turned = base._replace(
        object_pos=base.object_pos @ T.T,
        object_vel=jnp.concatenate([base.object_vel[:, :3] @ T.T, base.object_vel[:, 3:]], -1),
        palm_pos=base.palm_pos @ T.T,
        palm_mat=T @ base.palm_mat,
        pad_pos=base.pad_pos @ T.T,
        tip_force=base.tip_force @ T.T,
    )
    straight = critic(base, starts.contacts[:1], starts.normals[:1])
    found = critic(turned, starts.contacts[:1] @ T.T, starts.normals[:1] @ T.T)
    np.testing.assert_allclose(found, straight, atol=2e-4)
