"""The fixed-iteration ADMM against an interior-point solver, on problems of real reaches."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import qpax
from problems import draw_problems, kkt_residuals, solution_errors

from mjx_grasp.evaluation.reach.poses import draw_poses
from mjx_grasp.reaching.config import SolverConfig
from mjx_grasp.reaching.qp import QP, cold_start, scales, solve_qp


def _random_problem(seed, n=6, m=4):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    return QP(
        P=jnp.asarray(root @ root.T + 0.1 * np.eye(n), jnp.float32),
        q=jnp.asarray(rng.normal(size=n), jnp.float32),
        A=jnp.asarray(rng.normal(size=(m, n)), jnp.float32),
        b=jnp.asarray(-rng.uniform(0, 0.5, m), jnp.float32),
        lower=jnp.full(n, -0.7),
        upper=jnp.full(n, 0.7),
    )


def exact_solutions(problems):
    """By qpax in float64, in the solver's scaling; warm starts play no part."""

    def one(problem):
        scale, row_scale = scales(problem)
        n = len(problem.q)
        rows = problem.A * scale * row_scale[:, None]
        G = jnp.concatenate([-rows, jnp.eye(n), -jnp.eye(n)])
        h = jnp.concatenate([-problem.b * row_scale, problem.upper / scale, -problem.lower / scale])
        P = problem.P * scale * scale[:, None]
        none = jnp.zeros((0, n)), jnp.zeros(0)
        x = qpax.solve_qp(P, problem.q * scale, *none, G, h, solver_tol=1e-8)[0]
        return x * scale

    with jax.enable_x64(True):
        problems = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float64), problems)
        return np.asarray(jax.jit(jax.vmap(one))(problems))


@pytest.fixture(scope="module", params=[16, pytest.param(64, marks=pytest.mark.long)])
def drawn(request, reacher):
    """16 problems of each of so many reaches, and their warm starts."""
    return draw_problems(reacher, draw_poses(request.param, seed=11), count=16)


def test_unconstrained_minimum_is_exact():
    problem = _random_problem(0)
    free = problem._replace(b=jnp.full(4, -1e3), lower=jnp.full(6, -1e3), upper=jnp.full(6, 1e3))
    config = replace(SolverConfig(), iterations=2000)
    found = solve_qp(free, cold_start(6, 4), config)
    np.testing.assert_allclose(found.x, np.linalg.solve(free.P, -free.q), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_many_iterations_reach_the_exact_solution(seed):
    problem = _random_problem(seed)
    config = replace(SolverConfig(), iterations=3000)
    found = solve_qp(problem, cold_start(6, 4), config)
    exact = exact_solutions(jax.tree.map(lambda leaf: leaf[None], problem))[0]
    np.testing.assert_allclose(found.x, exact, atol=1e-4)
    assert found.violation < 1e-4


@pytest.mark.long
def test_real_problems_against_the_oracle(drawn):
    problems, warm = drawn
    exact = exact_solutions(problems)
    finite = np.isfinite(exact).all(axis=1)
    assert finite.mean() > 0.95
    exact = np.where(finite[:, None], exact, 0.0)
    solve = jax.jit(jax.vmap(lambda p, w: solve_qp(p, w, SolverConfig())))
    found = solve(problems, warm)
    solvable = finite & (
        np.asarray(jax.vmap(lambda p, x: jnp.max(p.b - p.A @ x))(problems, exact)) < 1e-4
    )
    assert solvable.mean() > 0.9
    errors = solution_errors(problems, found.x, jnp.asarray(exact, jnp.float32))
    errors = {name: np.asarray(value)[solvable] for name, value in errors.items()}
    assert np.percentile(errors["velocity"], 50) < 0.01
    assert np.percentile(errors["velocity"], 99) < 0.1
    assert np.percentile(np.abs(errors["objective"]), 99) < 0.01
    assert np.percentile(errors["violation"], 99) < 0.01
    kkt = kkt_residuals(problems, found.x, found.warm, SolverConfig())
    for name in ("stationarity", "complementarity", "sign"):
        assert np.percentile(np.asarray(kkt[name])[solvable], 99) < 0.02, name


def test_box_holds_exactly(drawn):
    problems, warm = drawn
    found = jax.vmap(lambda p, w: solve_qp(p, w, SolverConfig()))(problems, warm)
    assert np.all(found.x >= problems.lower) and np.all(found.x <= problems.upper)


def test_batched_is_looped_and_jit_is_eager(drawn):
    problems, warm = drawn
    config = SolverConfig()
    some = np.arange(0, len(problems.q), 75)[:4]
    few = jax.tree.map(lambda leaf: leaf[some], (problems, warm))
    together = jax.vmap(lambda p, w: solve_qp(p, w, config).x)(*few)
    # The order of sums differs, and iterations that have not ended amplify it: allowed is a tenth
    # of what the solver's own error may be in the median.
    for k in range(len(some)):
        alone = jax.tree.map(lambda leaf, k=k: leaf[k], few)
        np.testing.assert_allclose(solve_qp(*alone, config).x, together[k], atol=1e-3)
        jitted = jax.jit(lambda p, w: solve_qp(p, w, config).x)(*alone)
        np.testing.assert_allclose(jitted, together[k], atol=1e-3)


def test_infeasible_problem_says_so():
    problem = _random_problem(1)
    rows = problem.A.at[1].set(-problem.A[0])
    impossible = problem._replace(A=rows, b=problem.b.at[:2].set(1.0))
    found = solve_qp(impossible, cold_start(6, 4), SolverConfig())
    assert found.violation > 0.1 and np.isfinite(found.x).all()
