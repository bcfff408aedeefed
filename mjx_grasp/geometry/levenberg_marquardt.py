"""Nonlinear least squares in a box: a fixed number of Levenberg–Marquardt steps, for many at once.

Nothing in it is particular to a robot: the unknowns are lengths or angles, whatever the caller
uses, and the errors have one unit among them. It needs no line search, so that under `vmap` all
problems of a batch do the same work.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float, Int

# Of the damping: times this after a step that was taken, after one that was not.
_FALL, _RISE = 0.3, 5.0
_RANGE = (1e-7, 1e2)
# Added to the diagonal that the damping scales, so that an unknown without a lever does not run
# off; in squared errors per squared unknown.
_FLOOR = 1e-3


class Linearised(NamedTuple):
    """Errors at one place and how they change around it.

    Attributes:
        errors: ``[m]`` weighted, in one unit.
        rows: ``[m, n]`` their Jacobian.
        known: Whatever else the caller wants to know of the best place; floating-point arrays.
    """

    errors: Float[Array, " m"]
    rows: Float[Array, "m n"]
    known: Any


class Minimum(NamedTuple):
    """The best place found.

    Attributes:
        x: ``[n]`` within the box.
        cost: The objective there, in squared errors; +inf if no place could be evaluated, not even
            the start.
        known: What the errors told of it beside; all +inf with the cost.
        at_bound: Whether an unknown is at its bound.
    """

    x: Float[Array, " n"]
    cost: Float[Array, ""]
    known: Any
    at_bound: Bool[Array, ""]


class _Evaluation(NamedTuple):
    """A place, and the quadratic model of the objective around it."""

    x: Float[Array, " n"]
    cost: Float[Array, ""]
    gradient: Float[Array, " n"]  # half of the objective's
    normal: Float[Array, "n n"]  # of the errors, without the pull
    known: Any


def minimise(
    linearise: Callable[[Float[Array, " n"]], Linearised],
    start: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    pull: Float[Array, " n"],
    reference: Float[Array, " n"],
    iterations: int | Int[Array, ""],
    damping: float = 1e-3,
) -> Minimum:
    """Minimises ``|errors(x)|² + |pull · (x − reference)|²`` over ``lower ≤ x ≤ upper``.

    Unknowns pushed against a bound leave the step, so that the others make up for them; the rest
    of the step is clipped to the box, and taken if the objective falls. A place whose objective is
    not a number is never taken.

    Args:
        linearise: Errors and their Jacobian at a place; called once per step, and once before.
        start: Where the search begins; moved into the box.
        lower: Bounds, in the unit of the unknowns.
        upper: The same.
        pull: Weights towards the reference, in errors per unknown.
        reference: Where the pull is to.
        iterations: Steps; the same for all of a batch.
        damping: Of the first step, of the diagonal of the normal equations.
    """

    @jax.jit  # traced once: for its shapes and for the loop
    def evaluated(x: Float[Array, " n"]) -> _Evaluation:
        errors, rows, known = linearise(x)
        pulled = pull * (x - reference)
        return _Evaluation(
            x=x,
            cost=jnp.sum(errors**2) + jnp.sum(pulled**2),
            gradient=rows.T @ errors + pull * pulled,
            normal=rows.T @ rows,
            known=known,
        )

    def next_trial(at: _Evaluation, damping: Float[Array, ""]) -> Float[Array, " n"]:
        stuck = (at.x <= lower) & (at.gradient > 0) | (at.x >= upper) & (at.gradient < 0)
        free = jnp.where(stuck, 0.0, 1.0)
        normal = free[:, None] * at.normal * free + jnp.diag(pull**2)
        normal = normal + damping * jnp.diag(jnp.diag(normal) + _FLOOR)
        return jnp.clip(at.x - cho_solve(cho_factor(normal), at.gradient * free), lower, upper)

    def step(
        _: Int[Array, ""], state: tuple[_Evaluation, Float[Array, ""], Float[Array, " n"]]
    ) -> tuple[_Evaluation, Float[Array, ""], Float[Array, " n"]]:
        best, damping, trial = state
        new = evaluated(trial)
        better = new.cost < best.cost
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, best)
        damping = jnp.clip(damping * jnp.where(better, _FALL, _RISE), *_RANGE)
        return best, damping, next_trial(best, damping)

    # No accelerator shall round the normal equations to TF32.
    with jax.default_matmul_precision("highest"):
        # The start is the first trial, so that the errors, which are most of the work and of what
        # has to be compiled, are evaluated in one place and once a step.
        start = jnp.clip(start, lower, upper)
        unsolved = jax.tree.map(
            lambda a: jnp.full(a.shape, jnp.inf, a.dtype), jax.eval_shape(evaluated, start)
        )
        state = unsolved._replace(x=start), jnp.asarray(damping / _FALL, start.dtype), start
        best, _, _ = jax.lax.fori_loop(0, iterations + 1, step, state)
    at_bound = jnp.any((best.x <= lower) | (best.x >= upper))
    return Minimum(best.x, best.cost, best.known, at_bound)
