import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from mjx_grasp.geometry import so3

# In float32 the angle near a half turn is known to about this, rad.
ATOL = 3e-6

properties = settings(max_examples=100, deadline=None)
# Compiled once for the many examples: that jit changes nothing is a law of its own below.
exp, log, align_vectors = map(jax.jit, (so3.exp, so3.log, so3.align_vectors))
quat_mul, quat_rotate, quat_to_mat = map(jax.jit, (so3.quat_mul, so3.quat_rotate, so3.quat_to_mat))
mat_to_quat, quat_from_axis_angle = map(jax.jit, (so3.mat_to_quat, so3.quat_from_axis_angle))
slope_of_exp, slope_of_log = (jax.jit(jax.jacobian(f)) for f in (so3.exp, so3.log))
slope_of_both = jax.jit(jax.jacobian(lambda w: so3.log(so3.exp(w))))
slopes_of_align = jax.jit(jax.jacobian(so3.align_vectors, argnums=(0, 1)))


def floats(shape, bound=1.0):
    return arrays(np.float32, shape, elements=st.floats(-bound, bound, width=32))


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


units = floats(3).filter(lambda v: np.linalg.norm(v) > 1e-2).map(unit)
quats = floats(4).filter(lambda v: np.linalg.norm(v) > 1e-2).map(unit)
# Rotation vectors of every size, the ends of the range included.
angles = st.one_of(
    st.floats(0, np.pi), st.floats(0, 1e-3), st.floats(np.pi - 1e-3, np.pi), st.just(np.pi)
)


def scipy_of(q):
    return Rotation.from_quat(np.asarray(q, np.float64), scalar_first=True)


def is_rotation(R, atol=ATOL):
    R = np.asarray(R, np.float64)
    np.testing.assert_allclose(
        R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=atol
    )
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=atol)


@given(quats, quats, floats(3))
@properties
def test_quaternions_agree_with_scipy(a, b, v):
    A, B = scipy_of(a), scipy_of(b)
    a, b, v = map(jnp.asarray, (a, b, v))
    np.testing.assert_allclose(quat_to_mat(a), A.as_matrix(), atol=ATOL)
    np.testing.assert_allclose(quat_rotate(a, v), A.apply(v), atol=ATOL)
    product = quat_to_mat(quat_mul(a, b))
    np.testing.assert_allclose(product, (A * B).as_matrix(), atol=ATOL)


@given(quats)
@properties
def test_matrix_to_quaternion_and_back(q):
    back = np.asarray(mat_to_quat(quat_to_mat(jnp.asarray(q))))
    assert back[0] >= 0
    np.testing.assert_allclose(back * np.sign(back @ q), q, atol=ATOL)


@given(units, angles)
@properties
def test_exp_agrees_with_scipy_and_axis_angle(axis, angle):
    w = (axis * angle).astype(np.float32)
    expected = Rotation.from_rotvec(w.astype(np.float64)).as_matrix()
    np.testing.assert_allclose(exp(jnp.asarray(w)), expected, atol=ATOL)
    turned = quat_to_mat(quat_from_axis_angle(jnp.asarray(axis), angle))
    np.testing.assert_allclose(turned, expected, atol=ATOL)


@given(units, angles)
@properties
def test_log_inverts_exp(axis, angle):
    w = (axis * angle).astype(np.float32)
    R = exp(jnp.asarray(w))
    back = np.asarray(log(R))
    assert np.linalg.norm(back) <= np.pi + ATOL
    np.testing.assert_allclose(exp(jnp.asarray(back)), R, atol=ATOL)
    if angle < np.pi - 1e-3:  # beyond, rounding may choose the axis's other sign
        np.testing.assert_allclose(back, w, atol=ATOL)


@given(quats)
@properties
def test_log_agrees_with_scipy(q):
    R = scipy_of(q).as_matrix()
    angle = scipy_of(q).magnitude()
    found = np.asarray(log(jnp.asarray(R, jnp.float32)))
    assert np.linalg.norm(found) == pytest.approx(angle, abs=ATOL)
    np.testing.assert_allclose(Rotation.from_rotvec(found).as_matrix(), R, atol=ATOL)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-8, 1e-6, 1e-4, 9.99e-3, 1.001e-2])
def test_small_rotations_keep_their_relative_accuracy(size):
    w = jnp.asarray([0.6, -0.8, 0.0], jnp.float32) * size
    np.testing.assert_allclose(log(exp(w)), w, rtol=2e-6)


@pytest.mark.parametrize(
    "w", [(0, 0, 0), (1e-20, 0, 0), (0, 1e-4, 0), (0, 0, 0.01), (np.pi, 0, 0), (2.2, 0, -2.2)]
)
def test_gradients_are_finite_and_right_at_both_ends(w):
    w = jnp.asarray(w, jnp.float32)
    assert np.isfinite(slope_of_exp(w)).all()
    R = exp(w)
    assert np.isfinite(slope_of_log(R)).all()
    if np.linalg.norm(w) < 1:
        # log ∘ exp is the identity: so is its derivative.
        np.testing.assert_allclose(slope_of_both(w), np.eye(3), atol=1e-5)


@given(units, units)
@properties
def test_align_is_the_least_rotation(a, b):
    R = np.asarray(align_vectors(jnp.asarray(a), jnp.asarray(b)), np.float64)
    is_rotation(R)
    np.testing.assert_allclose(R @ a, b, atol=ATOL)
    between = np.arctan2(np.linalg.norm(np.cross(a, b)), a.astype(np.float64) @ b)
    assert Rotation.from_matrix(R).magnitude() == pytest.approx(between, abs=1e-5)


@given(
    units, floats(3), st.sampled_from([0.0, 1e-7, 1e-6, 1e-5, 1e-3, 1e-2]), st.sampled_from([-1, 1])
)
@properties
def test_align_near_parallel_and_opposite(a, noise, size, sign):
    b = unit(sign * a + size * noise).astype(np.float32)
    R = np.asarray(align_vectors(jnp.asarray(a), jnp.asarray(b)), np.float64)
    is_rotation(R)
    np.testing.assert_allclose(R @ a, b, atol=ATOL)
    if sign == 1:
        assert Rotation.from_matrix(R).magnitude() < 2 * np.linalg.norm(a - b) + ATOL


@pytest.mark.parametrize("axis", np.concatenate([np.eye(3), -np.eye(3)]))
def test_align_has_finite_gradients_at_equal_and_opposite_vectors(axis):
    a = jnp.asarray(axis, jnp.float32)
    for b in (a, -a):
        for gradient in slopes_of_align(a, b):
            assert np.isfinite(gradient).all()


def test_leading_batches_equal_loops_and_jit_equals_eager():
    rng = np.random.default_rng(0)
    q, p = (jnp.asarray(unit(rng.normal(size=(2, 5, 4))), jnp.float32) for _ in range(2))
    v, a, b = (jnp.asarray(unit(rng.normal(size=(2, 5, 3))), jnp.float32) for _ in range(3))
    R = so3.quat_to_mat(q)
    calls = [
        (so3.quat_to_mat, q),
        (so3.mat_to_quat, R),
        (so3.quat_mul, q, p),
        (so3.quat_rotate, q, v),
        (so3.quat_from_axis_angle, v, q[..., 0]),
        (so3.exp, v),
        (so3.log, R),
        (so3.align_vectors, a, b),
    ]
    for function, *arguments in calls:
        whole = jax.jit(function)(*arguments)
        for i in np.ndindex(2, 5):
            one = function(*(argument[i] for argument in arguments))
            np.testing.assert_allclose(whole[i], one, atol=1e-6, err_msg=function.__name__)


def test_one_argument_may_be_a_single_vector():
    q = jnp.asarray(unit(np.random.default_rng(1).normal(size=(7, 4))), jnp.float32)
    x = jnp.asarray([1.0, 0.0, 0.0])
    np.testing.assert_allclose(so3.quat_rotate(q, x), so3.quat_to_mat(q)[..., 0], atol=1e-6)
    columns = so3.quat_to_mat(q)[..., 0]
    turned = (so3.align_vectors(x, columns) @ x[:, None])[..., 0]
    np.testing.assert_allclose(turned, columns, atol=1e-5)
    assert so3.quat_from_axis_angle(x, jnp.linspace(0, 1, 5)).shape == (5, 4)
    assert so3.quat_mul(q, q[0]).shape == (7, 4)
