import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares, lsq_linear

from mjx_grasp.geometry.levenberg_marquardt import Linearised, Minimum, minimise

BATCH, ROWS, UNKNOWNS, STEPS = 40, 9, 5, 60
WIDE = jnp.full(UNKNOWNS, 1e3)


def linear(A, b):
    """A linear problem, which also tells where it was evaluated."""
    return lambda x: Linearised(A @ x - b, A, x)


def valley(x):
    """Rosenbrock's, as errors: a curved valley down to (1, 1)."""
    errors = jnp.stack([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])
    rows = jnp.stack(
        [jnp.stack([-20.0 * x[0], jnp.float32(10.0)]), jnp.array([-1.0, 0.0], jnp.float32)]
    )
    return Linearised(errors, rows, errors)


def descend(linearise, start, lower, upper, steps=STEPS) -> Minimum:
    none = jnp.zeros_like(start)
    return minimise(linearise, start, jnp.asarray(lower), jnp.asarray(upper), none, none, steps)


@pytest.fixture(scope="module")
def boxed():
    """Linear problems whose free minimum is outside the box in about half of the unknowns."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(BATCH, ROWS, UNKNOWNS)) * np.geomspace(0.3, 3.0, UNKNOWNS)
    b = np.einsum("bij,bj->bi", A, rng.normal(size=(BATCH, UNKNOWNS)))
    b += 0.3 * rng.normal(size=b.shape)
    lower, upper = -rng.uniform(0.2, 1.2, (2, BATCH, UNKNOWNS)) * [[[1]], [[-1]]]
    start = rng.uniform(lower, upper)
    return tuple(np.float32(x) for x in (A, b, start, lower, upper))


def solve(A, b, start, lower, upper):
    return descend(linear(A, b), start, lower, upper)


@pytest.fixture(scope="module")
def found(boxed):
    return jax.jit(jax.vmap(solve))(*boxed)


def test_linear_problems_end_where_scipy_ends_at_the_same_bounds(boxed, found):
    active = 0
    for k, (A, b, _, lower, upper) in enumerate(zip(*map(np.float64, boxed), strict=True)):
        exact = lsq_linear(A, b, (lower, upper), method="bvls", tol=1e-12)
        # The objective in single precision tells places no farther apart than this.
        np.testing.assert_allclose(found.x[k], exact.x, atol=1e-3)
        np.testing.assert_allclose(found.cost[k], 2 * exact.cost, rtol=1e-4)
        at = np.float32(lower) == found.x[k], np.float32(upper) == found.x[k]
        np.testing.assert_array_equal(np.subtract(*at[::-1], dtype=int), exact.active_mask)
        assert found.at_bound[k] == bool(exact.active_mask.any())
        active += np.count_nonzero(exact.active_mask)
    assert 0.2 < active / (BATCH * UNKNOWNS) < 0.8


def test_bounds_hold_at_every_step_and_the_objective_never_rises(boxed):
    _, _, start, lower, upper = boxed
    # From outside the box, too.
    outside = *boxed[:2], start + np.float32(3.0), lower, upper
    costs = []
    for steps in range(8):
        at = jax.vmap(lambda *p, n=steps: descend(linear(*p[:2]), *p[2:], steps=n))(*outside)
        assert np.all(at.x >= lower) and np.all(at.x <= upper)
        np.testing.assert_array_equal(at.known, at.x)
        costs.append(np.asarray(at.cost))
    assert np.all(np.diff(costs, axis=0) <= 0) and np.all(costs[-1] < costs[0])


def test_without_steps_it_tells_the_objective_of_the_start(boxed):
    A, b, start, lower, upper = (x[0] for x in boxed)
    at = descend(linear(A, b), jnp.asarray(start), lower, upper, steps=0)
    np.testing.assert_array_equal(at.x, start)
    np.testing.assert_allclose(at.cost, np.sum((A @ start - b) ** 2), rtol=1e-5)


def test_the_pull_is_that_of_the_normal_equations(boxed):
    A, b, start, *_ = (x[0] for x in boxed)
    rng = np.random.default_rng(1)
    pull = jnp.float32(rng.uniform(0.1, 3.0, UNKNOWNS))
    reference = jnp.float32(rng.normal(size=UNKNOWNS))
    at = minimise(linear(A, b), jnp.asarray(start), -WIDE, WIDE, pull, reference, STEPS)
    weight = np.diag(np.float64(pull) ** 2)
    exact = np.linalg.solve(A.T @ A + weight, A.T @ b + weight @ reference)
    np.testing.assert_allclose(at.x, exact, atol=1e-5)
    cost = np.sum((A @ exact - b) ** 2) + np.sum((pull * (exact - reference)) ** 2)
    np.testing.assert_allclose(at.cost, cost, rtol=1e-5)
    assert not at.at_bound


def test_an_unknown_without_a_lever_stays():
    A = np.float32([[1.0, 0.0], [1.0, 0.0]])
    at = descend(linear(A, np.float32([1.0, 3.0])), jnp.float32([0.0, 0.7]), -WIDE[:2], WIDE[:2])
    np.testing.assert_allclose(at.x, [2.0, 0.7], atol=1e-5)


@pytest.mark.parametrize("upper", [(2.0, 2.0), (0.5, 2.0), (2.0, 0.3)])
def test_a_curved_valley_is_followed_down_to_its_end_or_to_the_bound(upper):
    start, lower = np.float32([-1.2, 0.2]), np.float32([-2.0, -2.0])
    at = descend(valley, jnp.asarray(start), lower, np.float32(upper), steps=100)
    exact = least_squares(
        lambda x: [10 * (x[1] - x[0] ** 2), 1 - x[0]], start, bounds=(lower, upper), xtol=1e-12
    )
    np.testing.assert_allclose(at.x, exact.x, atol=1e-3)
    np.testing.assert_allclose(at.cost, 2 * exact.cost, atol=1e-5)


def test_a_start_that_cannot_be_evaluated_is_no_solution(boxed):
    A, b, start, lower, upper = (x[0] for x in boxed)
    spoilt = descend(linear(A, b * np.float32(np.nan)), jnp.asarray(start), lower, upper)
    assert spoilt.cost == np.inf and np.all(np.isinf(spoilt.known))
    np.testing.assert_array_equal(spoilt.x, start)
    nowhere = jnp.asarray(start).at[2].set(np.nan)
    assert descend(linear(A, b), nowhere, lower, upper).cost == np.inf


def test_a_place_that_cannot_be_evaluated_is_not_taken():
    def short_of_one(x):
        errors = jnp.where(x < 1.0, x - 2.0, jnp.nan)
        return Linearised(errors, jnp.eye(1), x)

    at = descend(short_of_one, jnp.zeros(1), -WIDE[:1], WIDE[:1])
    assert np.isfinite(at.cost) and 0.9 < at.x[0] < 1.0


def test_problems_of_a_batch_are_solved_as_one_by_one_and_compiled_as_eager(boxed, found):
    compiled = jax.jit(solve)
    for k in range(0, BATCH, 7):
        one = [jnp.asarray(x[k]) for x in boxed]
        for alone in (compiled(*one), solve(*one)):
            np.testing.assert_allclose(alone.x, found.x[k], atol=2e-5)
            np.testing.assert_allclose(alone.cost, found.cost[k], rtol=1e-5)
            assert alone.at_bound == found.at_bound[k]


def test_a_spoilt_problem_leaves_the_others_of_its_batch_alone(boxed, found):
    A, b, *rest = boxed
    spoilt = b.copy()
    spoilt[3] = np.nan
    at = jax.jit(jax.vmap(solve))(A, spoilt, *rest)
    others = np.arange(BATCH) != 3
    np.testing.assert_array_equal(np.isinf(at.cost), ~others)
    np.testing.assert_allclose(at.x[others], found.x[others], atol=1e-6)
