"""Small dense solves, unrolled so that a batch of them compiles to one elementwise kernel."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

P = ParamSpec("P")
R = TypeVar("R")


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """A function whose products of matrices no accelerator rounds to TF32."""

    @wraps(function)
    def exact(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return exact


def solve_spd(a: Float[Array, "*b n n"], rhs: Float[Array, "*b n"]) -> Float[Array, "*b n"]:
    """Solves A x = b for small symmetric positive-definite matrices by unrolled LDLᵀ.

    A batched library call launches several kernels per solve; for n ≤ 8 the unrolled form is one.

    Args:
        a: Matrices; only the lower triangle is read.
        rhs: Right-hand sides.

    Returns:
        Solutions. Not finite where a matrix is singular: damp it first.
    """
    n = rhs.shape[-1]
    low = [[a[..., i, j] for j in range(i + 1)] for i in range(n)]
    diag: list[Array] = []
    for j in range(n):
        d = low[j][j]
        for k in range(j):
            d = d - low[j][k] ** 2 * diag[k]
        diag.append(d)
        for i in range(j + 1, n):
            v = low[i][j]
            for k in range(j):
                v = v - low[i][k] * low[j][k] * diag[k]
            low[i][j] = v / d
    x = [rhs[..., i] for i in range(n)]
    for i in range(n):
        for k in range(i):
            x[i] = x[i] - low[i][k] * x[k]
    x = [x[i] / diag[i] for i in range(n)]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            x[i] = x[i] - low[k][i] * x[k]
    return jnp.stack(x, axis=-1)


def damped_least_squares(
    jacobian: Float[Array, "*b m n"],
    target: Float[Array, "*b m"],
    weight: Float[Array, " m"],
    damping: float,
) -> Float[Array, "*b n"]:
    """argmin_x Σ_i w_i (J x − v)_i² + λ|x|².

    Args:
        jacobian: J.
        target: v.
        weight: w, one per row.
        damping: λ > 0.
    """
    weighted = jacobian * weight[:, None]
    normal = jnp.sum(weighted[..., :, :, None] * jacobian[..., :, None, :], axis=-3)
    normal = normal + damping * jnp.eye(jacobian.shape[-1], dtype=jacobian.dtype)
    return solve_spd(normal, jnp.sum(weighted * target[..., :, None], axis=-2))
