import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.geometry.linear import damped_least_squares, solve_spd


def spd(rng, n, batch=(), spread=100.0):
    """Random symmetric positive-definite matrices with eigenvalues in 1..spread."""
    q, _ = np.linalg.qr(rng.normal(size=(*batch, n, n)))
    values = spread ** rng.uniform(size=(*batch, n))
    return np.einsum("...ij,...j,...kj->...ik", q, values, q)


@given(n=st.integers(1, 8), seed=st.integers(0, 2**31))
def test_solution_agrees_with_lapack(n, seed):
    rng = np.random.default_rng(seed)
    a, b = spd(rng, n, (3, 2)), rng.normal(size=(3, 2, n))
    found = solve_spd(jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32))
    expected = np.linalg.solve(a, b[..., None])[..., 0]
    np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())


def test_only_the_lower_triangle_is_read():
    rng = np.random.default_rng(0)
    a, b = spd(rng, 6), rng.normal(size=6)
    spoiled = np.tril(a) + np.triu(np.full((6, 6), np.nan), 1)
    found = solve_spd(jnp.asarray(spoiled, jnp.float32), jnp.asarray(b, jnp.float32))
    np.testing.assert_allclose(found, np.linalg.solve(a, b), rtol=1e-3, atol=1e-5)


def test_singular_matrix_is_not_answered_with_a_number():
    assert not np.isfinite(solve_spd(jnp.ones((2, 2)), jnp.array([1.0, 2.0]))).all()


@given(rows=st.integers(1, 6), cols=st.integers(1, 6), seed=st.integers(0, 2**31))
def test_damped_least_squares_agrees_with_the_stacked_problem(rows, cols, seed):
    rng = np.random.default_rng(seed)
    jac, v = rng.normal(size=(rows, cols)), rng.normal(size=rows)
    w, damping = rng.uniform(0.1, 2.0, size=rows), 0.05
    # ‖√w (J x − v)‖² + λ‖x‖² as one least-squares problem.
    stacked = np.concatenate([np.sqrt(w)[:, None] * jac, np.sqrt(damping) * np.eye(cols)])
    expected = np.linalg.lstsq(stacked, np.concatenate([np.sqrt(w) * v, np.zeros(cols)]))[0]
    f32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    found = damped_least_squares(f32(jac), f32(v), f32(w), damping)
    np.testing.assert_allclose(found, expected, atol=1e-3 * max(1.0, np.abs(expected).max()))


@pytest.mark.parametrize("singular", [np.zeros((6, 3)), np.ones((6, 3))])
def test_damping_keeps_singular_jacobians_finite(singular):
    jac = jnp.asarray(singular, jnp.float32)
    assert np.isfinite(damped_least_squares(jac, jnp.ones(6), jnp.ones(6), 1e-4)).all()


def test_more_damping_gives_shorter_answers():
    rng = np.random.default_rng(1)
    jac, v = jnp.asarray(rng.normal(size=(6, 3)), jnp.float32), jnp.ones(6)
    norms = [
        float(jnp.linalg.norm(damped_least_squares(jac, v, jnp.ones(6), d)))
        for d in (1e-4, 1e-2, 1.0, 100.0)
    ]
    assert norms == sorted(norms, reverse=True) and norms[-1] < 0.2 * norms[0]


def test_jit_and_vmap_agree_with_the_batch():
    rng = np.random.default_rng(2)
    a = jnp.asarray(spd(rng, 4, (5,)), jnp.float32)
    b = jnp.asarray(rng.normal(size=(5, 4)), jnp.float32)
    batch = solve_spd(a, b)
    np.testing.assert_allclose(jax.jit(jax.vmap(solve_spd))(a, b), batch, rtol=1e-4, atol=1e-6)
