"""The joint-space quadratic programme and its solver, ADMM with a fixed number of iterations.

    minimise ½ xᵀPx + qᵀx   with   lower ≤ x ≤ upper,   A x ≥ b

ADMM needs one factorisation and then matrix-vector products alone, in a number that does not
depend on the data: all problems of a batch take the same time, and the last tick's solution and
multipliers start the next. Variables are scaled by diag(P)^−½ and rows to unit length, so that one
step size suits all of them.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_grasp.geometry.linear import full_precision
from mjx_grasp.reaching.admm import Splitting, iterated
from mjx_grasp.reaching.config import SolverConfig

_TINY = 1e-12


class QP(NamedTuple):
    """One problem."""

    P: Float[Array, "n n"]
    """symmetric, positive definite"""
    q: Float[Array, " n"]
    """the linear term"""
    A: Float[Array, "m n"]
    """half-spaces; a row of zeros with b ≤ 0 is none"""
    b: Float[Array, " m"]
    """their lower bounds"""
    lower: Float[Array, " n"]
    """the box, from here"""
    upper: Float[Array, " n"]
    """to here"""


class WarmStart(NamedTuple):
    """What one solution leaves to the next, in the units of the problem."""

    box: Float[Array, " n"]
    """copy of x within the box"""
    rows: Float[Array, " m"]
    """copy of Ax within the half-spaces"""
    box_dual: Float[Array, " n"]
    """multipliers of the box over its step size"""
    rows_dual: Float[Array, " m"]
    """multipliers of the half-spaces over theirs"""


class Solution(NamedTuple):
    """What the solver found."""

    x: Float[Array, " n"]
    """within the box"""
    violation: Float[Array, ""]
    """largest ``b − A x``, in the units of b; ≤ 0 where all rows hold"""
    warm: WarmStart
    """where the next solution starts"""


def cold_start(n: int, m: int) -> WarmStart:
    """Zeros, for the first tick."""
    return WarmStart(jnp.zeros(n), jnp.zeros(m), jnp.zeros(n), jnp.zeros(m))


def inverse_spd(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of a symmetric positive-definite matrix."""
    factor = jnp.linalg.cholesky(a)
    identity = jnp.eye(a.shape[-1], dtype=a.dtype)
    half = jax.scipy.linalg.solve_triangular(factor, identity, lower=True)
    return half.T @ half


def scales(problem: QP) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """Factors of variables, x = scale · y, and of rows, which make P's diagonal and rows unit."""
    scale = 1.0 / jnp.sqrt(jnp.diagonal(problem.P))
    return scale, 1.0 / jnp.sqrt(jnp.sum((problem.A * scale) ** 2, axis=1) + _TINY)


@full_precision
def solve_qp(problem: QP, warm: WarmStart, config: SolverConfig) -> Solution:
    """Solves one problem; batched by ``vmap``.

    Args:
        problem: The problem, of moderate accuracy in float32.
        warm: The last tick's, or :func:`cold_start`.
        config: Steps and iterations.
    """
    P, q, A, b, lower, upper = problem
    scale, row_scale = scales(problem)
    A_s = A * scale * row_scale[:, None]
    b_s = b * row_scale
    # A row without length binds nothing: its copy is free.
    b_s = jnp.where(row_scale > 1e5, jnp.minimum(b_s, 0.0), b_s)
    P_s = P * scale * scale[:, None]
    rho_b, rho_r = config.rho_box, config.rho_rows

    n = q.shape[0]
    K = P_s + rho_b * jnp.eye(n, dtype=P.dtype) + rho_r * (A_s.T @ A_s)
    # Box and rows are one vector from here on: both = (y, A y).
    both = jnp.concatenate([jnp.eye(n, dtype=P.dtype), A_s])
    back = both @ inverse_spd(K)
    splitting = Splitting(
        there=both.T * jnp.concatenate([jnp.full(n, rho_b), jnp.full(len(b), rho_r)]),
        back=back,
        begin=-back @ (q * scale),
        least=jnp.concatenate([lower / scale, b_s]),
        most=jnp.concatenate([upper / scale, jnp.full_like(b, jnp.inf)]),
    )
    copy, dual = iterated(
        splitting,
        jnp.concatenate([warm.box / scale, warm.rows * row_scale]),
        jnp.concatenate([warm.box_dual * scale, warm.rows_dual / row_scale]),
        config.relaxation,
        config.iterations,
    )
    box, rows, box_dual, rows_dual = copy[:n], copy[n:], dual[:n], dual[n:]
    x = jnp.clip(box * scale, lower, upper)
    warm = WarmStart(x, rows / row_scale, box_dual / scale, rows_dual * row_scale)
    return Solution(x, jnp.max(b - A @ x), warm)
