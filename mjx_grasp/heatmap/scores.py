"""The six terms of the grasp-affordance score (method §1, step 5), one function per equation."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_grasp.geometry.vectors import angle_between, distance_to_line, norm


def width_score(
    width: Float[Array, "*batch"], span: Float[Array, " 2"], narrow: float, wide: float
) -> Float[Array, "*batch"]:
    """S_w: 1 on the hand's span [m], Gaussian tails ``exp(−(Δ/σ)²)`` with a σ for either side."""
    below, above = jnp.maximum(span[0] - width, 0.0), jnp.maximum(width - span[1], 0.0)
    return jnp.exp(-((below / narrow) ** 2 + (above / wide) ** 2))


def friction_score(
    force: Float[Array, "*#batch 3"],
    inward: Float[Array, "*#batch 3"],
    friction: Float[Array, ""],
    width: float,
) -> Float[Array, "*batch"]:
    """S_t, S_k: ``exp(−(θ/(k·arctan μ))²)``, θ between the pushing direction and inward normal.

    With a width k of ½ a contact on the friction cone's edge scores e⁻⁴.
    """
    return jnp.exp(-((angle_between(force, inward) / (width * jnp.arctan(friction))) ** 2))


def coherence_score(
    normal_1: Float[Array, "*batch 3"], normal_2: Float[Array, "*batch 3"], scale: float
) -> Float[Array, "*batch"]:
    """S_coh: ``exp(−(∠(n_1, n_2)/scale)²)``: the wrap contacts face the same way."""
    return jnp.exp(-((angle_between(normal_1, normal_2) / scale) ** 2))


def separation_score(
    contact_1: Float[Array, "*batch 3"], contact_2: Float[Array, "*batch 3"], full: float
) -> Float[Array, "*batch"]:
    """S_sep: ``clip(|c_1 − c_2|/full, 0, 1)``: the wrap fingers have room side by side."""
    return jnp.clip(norm(contact_1 - contact_2) / full, 0.0, 1.0)


def anchor_score(
    anchor: Float[Array, "*#batch 3"],
    thumb: Float[Array, "*#batch 3"],
    axis: Float[Array, "*#batch 3"],
    sigma: Float[Array, ""] | float,
) -> Float[Array, "*batch"]:
    """S_COM, and the steering factor: ``exp(−(d⊥/σ)²)``, d⊥ from the anchor to the grasp axis."""
    return jnp.exp(-((distance_to_line(anchor, thumb, axis) / sigma) ** 2))
