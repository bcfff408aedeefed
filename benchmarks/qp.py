"""Quadratic programmes per second and their accuracy, on problems drawn from real reaches.

Of the published controller's reaches and of the default's, which follows plans. Side by side: the
fixed-iteration ADMM of this package (warm-started, float32, batched), qpax (interior point,
batched, both on whatever device JAX finds) and, where it is installed, OSQP (one problem after
another on one core). The exact answers are qpax's in float64. On a CPU as many problems are solved
at once as a sweep solves there: with more of them, those that are in work outgrow the cache.

  python benchmarks/qp.py --out FILE.json
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import qpax
import tyro

from mjx_grasp.cli import run_command
from mjx_grasp.evaluation.reach.poses import draw_poses
from mjx_grasp.evaluation.reach.sweep import plan_all
from mjx_grasp.posture.body import robot_body
from mjx_grasp.reaching.config import SolverConfig
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.planning import Planner, start_library
from mjx_grasp.reaching.presets import for_sweep, reach_preset
from mjx_grasp.reaching.qp import QP, WarmStart, scales, solve_qp
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Seed, Several
from mjx_grasp.robot.spec import load_robot

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "reaching"))
from problems import draw_problems, kkt_residuals, solution_errors

_PERCENTILES = (50, 90, 99, 100)
_ON_CPU = 128


@dataclass(frozen=True)
class QpBenchmarkConfig(CommandSettings):
    """What to measure."""

    out: Path
    """results file to write (.json)"""
    poses: Count = 40
    """reaches that each set of problems is drawn from [-]"""
    per_pose: Count = 30
    """problems of each, ten ticks apart [-]"""
    iterations: Annotated[tuple[Count, ...], Several()] = (25, 50, 100)
    """of ADMM [-]"""
    together: Count | None = None
    """problems at once; by default 128 on a CPU, all of them on an accelerator [-]"""
    repeats: Count = 7
    seed: Seed = 11


def exact_solutions(problems: QP) -> np.ndarray:
    """By qpax in float64, in the solver's scaling."""

    def one(problem):
        scale, row_scale = scales(problem)
        P, q, G, h = _inequalities(problem, scale, row_scale)
        none = jnp.zeros((0, len(q))), jnp.zeros(0)
        return qpax.solve_qp(P, q, *none, G, h, solver_tol=1e-8)[0] * scale

    with jax.enable_x64(True):
        doubled = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float64), problems)
        return np.asarray(jax.jit(jax.vmap(one))(doubled))


def _inequalities(problem, scale, row_scale):
    """The problem as ½yᵀPy + qᵀy with Gy ≤ h, scaled."""
    n = len(problem.q)
    rows = problem.A * scale * row_scale[:, None]
    G = jnp.concatenate([-rows, jnp.eye(n), -jnp.eye(n)])
    h = jnp.concatenate([-problem.b * row_scale, problem.upper / scale, -problem.lower / scale])
    return problem.P * scale * scale[:, None], problem.q * scale, G, h


def median_seconds(run: Callable[[], Any], repeats: int) -> float:
    """Median wall time of a run, after one that does not count."""
    jax.block_until_ready(run())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def batched(solve: Callable[[Any], Any], together: int) -> Callable[[Any], Any]:
    """Of stacked problems, so many at once."""
    return jax.jit(lambda given: jax.lax.map(solve, given, batch_size=together))


def accuracy(problems: QP, x, exact: np.ndarray, ok: np.ndarray) -> dict[str, dict[str, float]]:
    """Percentiles of the errors over the solvable problems."""
    errors = solution_errors(problems, jnp.asarray(x, jnp.float32), jnp.asarray(exact, jnp.float32))
    return {
        name: {f"p{p}": float(np.percentile(np.abs(np.asarray(e)[ok]), p)) for p in _PERCENTILES}
        for name, e in errors.items()
    }


def osqp_row(problems: QP, exact: np.ndarray, ok: np.ndarray) -> dict[str, Any] | None:
    """OSQP at its default settings, one problem after another; None where it is not installed."""
    try:
        import osqp
        from scipy import sparse
    except ImportError:
        return None
    n = problems.q.shape[1]
    solvers, answers = [], []
    start = time.perf_counter()
    for k in range(len(problems.q)):
        p = jax.tree.map(lambda leaf, k=k: np.asarray(leaf[k], np.float64), problems)
        solver = osqp.OSQP()
        A = sparse.csc_matrix(np.vstack([np.eye(n), p.A]))
        low = np.concatenate([p.lower, p.b])
        high = np.concatenate([p.upper, np.full(len(p.b), np.inf)])
        solver.setup(sparse.csc_matrix(np.triu(p.P)), p.q, A, low, high, verbose=False)
        solvers.append(solver)
    setup = time.perf_counter() - start
    start = time.perf_counter()
    for solver in solvers:
        answers.append(solver.solve().x)
    seconds = time.perf_counter() - start
    x = np.array([np.zeros(n) if a is None or not np.isfinite(a).all() else a for a in answers])
    return {
        "solver": "OSQP",
        "version": osqp.__version__,
        "device": "CPU, one core",
        "problems_per_s": len(x) / seconds,
        "problems_per_s_with_setup": len(x) / (setup + seconds),
        "errors": accuracy(problems, x, exact, ok),
    }


def drawn(name: str, config: QpBenchmarkConfig) -> tuple[QP, WarmStart]:
    """Problems of a preset's reaches."""
    settings = for_sweep(reach_preset(name))
    reacher = Reacher(robot_body(load_robot()), settings.reach, settings.selection)
    poses = draw_poses(config.poses, config.seed)
    plans = None
    if settings.plan:
        library = start_library(reacher.body, settings.plan)
        plans = plan_all(
            Planner(reacher, settings.plan), library, poses, min(config.poses, 32)
        ).plans
    return draw_problems(reacher, poses, config.per_pose, plans=plans)


def measure(config: QpBenchmarkConfig, problems: QP, warm: WarmStart) -> dict[str, Any]:
    """All rows."""
    exact = exact_solutions(problems)
    violation = np.asarray(jax.vmap(lambda p, x: jnp.max(p.b - p.A @ x))(problems, exact))
    ok = np.isfinite(exact).all(axis=1) & (violation < 1e-4)
    count = len(ok)
    together = config.together or (count if jax.default_backend() != "cpu" else _ON_CPU)
    rows = []
    for iterations in config.iterations:
        settings = replace(SolverConfig(), iterations=iterations)
        solve = batched(lambda given, s=settings: solve_qp(*given, s), together)
        seconds = median_seconds(lambda f=solve: f((problems, warm)), config.repeats)
        found = solve((problems, warm))
        kkt = kkt_residuals(problems, found.x, found.warm, settings)
        rows.append(
            {
                "solver": f"ADMM, {iterations} iterations, warm",
                "problems_per_s": count / seconds,
                "errors": accuracy(problems, found.x, exact, ok),
                "kkt_p99": {k: float(np.percentile(np.asarray(v)[ok], 99)) for k, v in kkt.items()},
            }
        )

    def interior_point(problem):
        scale, row_scale = scales(problem)
        P, q, G, h = _inequalities(problem, scale, row_scale)
        none = jnp.zeros((0, len(q))), jnp.zeros(0)
        return qpax.solve_qp(P, q, *none, G, h, solver_tol=1e-4)[0] * scale

    solve = batched(interior_point, together)
    seconds = median_seconds(lambda: solve(problems), config.repeats)
    x = np.nan_to_num(np.asarray(solve(problems)))
    rows.append(
        {
            "solver": "qpax, float32, tolerance 1e-4",
            "problems_per_s": count / seconds,
            "errors": accuracy(problems, x, exact, ok),
        }
    )
    other = osqp_row(problems, exact, ok)
    if other:
        rows.append(other)
    return {
        "problems": count,
        "together": min(together, count),
        "solvable": int(ok.sum()),
        "variables": problems.A.shape[2],
        "half_spaces": problems.A.shape[1],
        "rows": rows,
    }


def main(config: QpBenchmarkConfig) -> None:
    """Measures, prints, writes."""
    check_writable("--out", config.out)
    result: dict[str, Any] = {"provenance": provenance(config.seed)}
    for name in ("paper", "default"):
        result[name] = measure(config, *drawn(name, config))
        print(name, json.dumps(result[name]["rows"], indent=1))
    write_json(config.out, result)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(QpBenchmarkConfig, description=__doc__)), keeps=False)
