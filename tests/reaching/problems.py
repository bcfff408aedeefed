"""Quadratic programmes as they occur in reaches, to test and time solvers with."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from mjx_grasp.evaluation.reach.poses import CylinderPoses
from mjx_grasp.evaluation.reach.sweep import candidates_of
from mjx_grasp.geometry.signed_distance import Cylinder
from mjx_grasp.reaching.command import programme
from mjx_grasp.reaching.config import SolverConfig
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.qp import QP, WarmStart, scales
from mjx_grasp.reaching.state import Plans


def draw_problems(
    reacher: Reacher,
    poses: CylinderPoses,
    count: int,
    stride: int = 10,
    plans: Plans | None = None,
) -> tuple[QP, WarmStart]:
    """Every ``stride``-th problem of reaches from home, with the warm start it had.

    Args:
        reacher: The controller.
        poses: The cylinders, reached for together.
        count: Problems of each reach.
        stride: Ticks between them.
        plans: For every pose, or None.

    Returns:
        Problems and warm starts, ``[poses · count, …]``.
    """

    def reach(shape, p_wo, R_wo, plans):
        candidates = candidates_of(reacher, shape)
        q = jnp.asarray(reacher.body.home)
        state = reacher.start(q, candidates, p_wo, R_wo, plans)

        def tick(carry, _):
            state, q = carry
            situation = shape, candidates, p_wo, R_wo, jnp.zeros((0, 4)), plans
            aim = reacher.aim(state, q, *situation)
            built = programme(reacher.body, reacher.config, q, aim.goals, aim.around, state.memory)
            after, done = reacher.tick(state, q, *situation)
            q = q + reacher.config.controller.dt * done.velocity
            return (after, q), (built.problem, state.memory.warm)

        shapes = jax.eval_shape(tick, (state, q), None)[1]
        none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

        def stretch(moving, _):
            # The tick stands here once, as it is compiled as often as it does.
            after = jax.lax.scan(
                lambda carry, _: (tick(carry[0], None), None), (moving, none), length=stride
            )
            return after[0]

        return jax.lax.scan(stretch, (state, q), length=count)[1]

    shape = Cylinder(jnp.asarray(poses.radius), jnp.asarray(poses.half_length))
    found = jax.jit(jax.vmap(reach))(shape, poses.p_wo, poses.R_wo, plans)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found)


def solution_error(problem: QP, x: jax.Array, exact: jax.Array) -> dict[str, jax.Array]:
    """How far an answer is from the exact one, of one problem.

    Returns:
        ``velocity``: largest joint velocity error [rad/s]; ``objective``: relative gap;
        ``violation``: of the worst half-space [m/s].
    """

    def objective(v):
        return 0.5 * v @ problem.P @ v + problem.q @ v

    best = objective(exact)
    return {
        "velocity": jnp.max(jnp.abs(x - exact)),
        "objective": (objective(x) - best) / jnp.maximum(jnp.abs(best), 1e-6),
        "violation": jnp.maximum(jnp.max(problem.b - problem.A @ x), 0.0),
    }


def kkt_residual(
    problem: QP, x: jax.Array, warm: WarmStart, config: SolverConfig
) -> dict[str, jax.Array]:
    """Optimality of an answer with the multipliers that ADMM leaves, of one problem.

    In the solver's scaled units, relative to the length of the linear term.

    Args:
        problem: The problem.
        x: The answer.
        warm: What the solver returned with it.
        config: The solver's steps.

    Returns:
        ``stationarity``: of the Lagrangian's gradient the largest entry; ``complementarity``:
        largest product of a multiplier and its slack, of half-spaces and of the box, whose
        multipliers count against the bound that their sign names; ``sign``: largest multiplier of
        a half-space of the wrong sign.
    """
    scale, row_scale = scales(problem)
    box = config.rho_box * warm.box_dual * scale
    rows = config.rho_rows * warm.rows_dual / row_scale
    gradient = scale * (problem.P @ x + problem.q)
    residual = gradient + box + ((rows * row_scale) @ problem.A) * scale
    slack = (problem.A @ x - problem.b) * row_scale
    room = jnp.where(box > 0, problem.upper - x, x - problem.lower) / scale
    products = jnp.concatenate([rows * slack, box * room])
    size = jnp.linalg.norm(scale * problem.q)
    return {
        "stationarity": jnp.max(jnp.abs(residual)) / size,
        "complementarity": jnp.max(jnp.abs(products)) / size,
        "sign": jnp.maximum(jnp.max(rows), 0.0) / size,
    }


solution_errors = jax.jit(jax.vmap(solution_error))


@partial(jax.jit, static_argnames="config")
def kkt_residuals(
    problem: QP, x: jax.Array, warm: WarmStart, config: SolverConfig
) -> dict[str, jax.Array]:
    """:func:`kkt_residual` of a batch."""
    return jax.vmap(partial(kkt_residual, config=config))(problem, x, warm)
