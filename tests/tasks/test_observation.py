import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.closing.learned import proprioception
from mjx_grasp.tasks.observation import privileged

SCALARS = (0.0, 0.25, 0.1, 0.5, 0.2, 0.8, 1.0)
"""Stage, times, rise, slip, friction and mass."""


def critic(measured, truth, targets, landed=False, scalars=SCALARS):
    w = len(measured.q)
    return np.asarray(
        privileged(
            jnp.arange(w * 66, dtype=jnp.float32).reshape(w, 66),
            measured,
            truth,
            targets,
            landed=jnp.full((w, 3), landed),
            scalars=tuple(jnp.full(w, x) for x in scalars),
        )
    )


def rows(starts, which):
    """Measured, truth and targets of some states."""
    return jax.tree.map(lambda x: x[which], (starts.measured, starts.truth, starts.targets))


def test_proprioception_keeps_its_order():
    q, qd, a = jnp.arange(9.0), 10 + jnp.arange(9.0), 20 + jnp.arange(15.0)
    expected = [*range(9), *range(10, 19), *range(20, 35)]
    np.testing.assert_array_equal(proprioception(q, qd, a), expected)


def test_critic_sees_what_the_actor_sees_first_and_all_is_finite(starts):
    seen = critic(*rows(starts, slice(0, 3)))
    np.testing.assert_array_equal(seen[:, :66], np.arange(3 * 66).reshape(3, 66))
    assert np.isfinite(seen).all()


def test_critic_is_told_of_the_object_the_stage_and_the_forces(starts):
    measured, truth, targets = rows(starts, slice(0, 1))
    seen = critic(measured, truth, targets)
    for change in (
        {"object_pos": truth.object_pos + 0.01},
        {"object_vel": truth.object_vel + 0.1},
        {"object_quat": jnp.roll(truth.object_quat, 1, axis=-1)},
        {"tip_found": ~truth.tip_found},
        {"tip_force": truth.tip_force + 1.0},
    ):
        assert (critic(measured, truth._replace(**change), targets) != seen).any(), change
    assert (critic(measured, truth, targets, landed=True) != seen).any()
    for k in range(len(SCALARS)):
        changed = [x + (i == k) for i, x in enumerate(SCALARS)]
        assert (critic(measured, truth, targets, scalars=changed) != seen).sum() == 1


@given(shift=st.tuples(*[st.floats(-2, 2)] * 3))
def test_critic_does_not_see_where_in_the_world_it_all_is(starts, shift):
    by, (measured, truth, targets) = jnp.asarray(shift, jnp.float32), rows(starts, slice(0, 1))
    found = critic(
        measured._replace(palm_pos=measured.palm_pos + by, pad_pos=measured.pad_pos + by),
        truth._replace(object_pos=truth.object_pos + by),
        targets._replace(position=targets.position + by),
    )
    np.testing.assert_allclose(found, critic(measured, truth, targets), atol=2e-4)


@given(angle=st.floats(-3, 3))
def test_critic_sees_vectors_relative_to_the_palm(starts, angle):
    """Turning the world about the vertical changes only the object's own quaternion."""
    c, s = np.cos(angle), np.sin(angle)
    T = jnp.asarray([[c, -s, 0], [s, c, 0], [0, 0, 1]], jnp.float32)
    measured, truth, targets = rows(starts, slice(0, 1))
    truth = truth._replace(
        object_vel=jnp.array([[0.1, -0.2, 0.3, 1, 2, 3]]),
        tip_force=jnp.arange(9.0).reshape(1, 3, 3),
    )
    found = critic(
        measured._replace(
            palm_pos=measured.palm_pos @ T.T,
            palm_mat=T @ measured.palm_mat,
            pad_pos=measured.pad_pos @ T.T,
        ),
        truth._replace(
            object_pos=truth.object_pos @ T.T,
            object_vel=jnp.concatenate(
                [truth.object_vel[:, :3] @ T.T, truth.object_vel[:, 3:]], -1
            ),
            tip_force=truth.tip_force @ T.T,
        ),
        targets._replace(position=targets.position @ T.T, normal=targets.normal @ T.T),
    )
    np.testing.assert_allclose(found, critic(measured, truth, targets), atol=2e-4)
