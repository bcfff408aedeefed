"""How hard three contacts must press to hold a load: a friction-cone programme, batched in JAX.

With normal forces of at most 1 N, the wrenches that three contacts can exert are a convex set W; a
load w (the weight, say) is held at the force F if −w/F is in W. So

    F(w) = 1 / max {s : −s·w ∈ W},   W = {Σ A_i f_i : f_i in its friction cone, f_i·n_i ≤ 1}

is the least force that suffices when no finger presses harder than it: a programme over
second-order cones. Solved is its dual, small, always feasible, its value a sum of closed forms:

    1/F = min {Σ_i max(0, n_i·g_i + √(μ²|g_i tangential|² + μ_τ²(n_i·ω)²)) : u·(−w) = 1}

over twists u = (v, ω) of the object, with g_i = v + ω × r_i the velocity of contact i. There are
eight unknowns; a self-concordant barrier and a fixed number of damped Newton steps, which need no
line search, solve thousands at once. A library would not: jaxopt is no longer kept, qpax wants
polyhedral cones, conic solvers are not batched. Forces come out at most about 1 % too small.

Assumed of a contact: MuJoCo's ``condim`` 4 with an elliptic cone, as in the scene. It carries a
normal force, friction in the tangent plane, and a torque about its normal of at most μ_τ (a length)
times the normal force. The contact stays where it is: what a rounded fingertip gains or loses by
rolling over an edge is not seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_grasp.geometry.linear import full_precision, solve_spd
from mjx_grasp.geometry.vectors import dot, norm, unit
from mjx_grasp.records.settings import NonNegative, Positive, Settings

_LEAST_SCALE = 1e-4  # m: contacts that all lie on the centre of mass still have a length
_FARTHEST = 100.0  # bound on the scaled twist: without it a grasp that cannot hold has no minimum
_FIRST, _LAST, _ROUNDS, _STEPS = 1.0, 1e4, 12, 5  # weights of the objective; Newton steps at each
_FULL_STEP = 0.25  # Newton decrement below which a whole step is safe
_LEAST_HELD = 2e-3  # of the load by 1 N of each finger: below this it is the bound, not the grasp


@dataclass(frozen=True)
class ContactConfig(Settings):
    """What a fingertip's contact can carry."""

    friction: Positive = 0.8
    """μ, of tangential to normal force [-]"""
    torsion: NonNegative = 0.02
    """μ_τ, of the torque about the normal to the normal force [m]"""


class Load(NamedTuple):
    """A force on the object and the point it acts through; world or object frame."""

    force: Float[Array | np.ndarray, "*b 3"]
    """[N]"""
    point: Float[Array | np.ndarray, "*b 3"]
    """[m]"""


@full_precision
def holding_force(
    contact: Float[Array | np.ndarray, "3 3"],
    inward: Float[Array | np.ndarray, "3 3"],
    load: Load,
    config: ContactConfig,
) -> Float[Array, ""]:
    """The largest normal force of three contacts, at its least, that balances a load [N].

    Proportional to the load, and the same in every frame. +inf where no force suffices, as when the
    normals cannot oppose the load; for many grasps or loads ``vmap`` it.

    Args:
        contact: Points on the surface [m].
        inward: Unit normals there, into the object.
        load: What has to be balanced, in the frame of the contacts; not zero.
        config: Friction.
    """
    return holding_forces(contact, inward, load, (config,))[0]


@full_precision
def holding_forces(
    contact: Float[Array | np.ndarray, "3 3"],
    inward: Float[Array | np.ndarray, "3 3"],
    load: Load,
    configs: Sequence[ContactConfig],
) -> Float[Array, " k"]:
    """`holding_force` by contacts of several kinds: one programme for all is sooner compiled [N].

    Args:
        contact: Points on the surface [m].
        inward: Unit normals there, into the object.
        load: What has to be balanced, in the frame of the contacts; not zero.
        configs: Frictions, each kind's.
    """
    push, point = jnp.asarray(load.force), jnp.asarray(load.point)
    size = norm(push)
    against = -push / jnp.where(size > 0, size, 1.0)
    arm, inward = jnp.asarray(contact) - point, jnp.asarray(inward)
    friction = jnp.array([config.friction for config in configs], arm.dtype)
    torsion = jnp.array([config.torsion for config in configs], arm.dtype)
    held = jax.vmap(lambda *own: _held_load(arm, inward, against, *own))(friction, torsion)
    return jnp.where(size > 0, size / held, 0.0)


@full_precision
def about_holding_force(
    contact: Float[Array | np.ndarray, "*b 3 3"], load: Load, config: ContactConfig
) -> Float[Array, "*b"]:
    """A closed-form estimate of `holding_force`, thousands of times cheaper, to rank contacts [N].

    As if thumb and wraps opposed each other exactly: friction bears the load, and its torque about
    their middle is borne along each axis by what has a lever there. The three forces add up.

    Args:
        contact: Thumb, first and second wrap [m].
        load: What has to be balanced, in the frame of the contacts.
        config: Friction.
    """
    contact, push = jnp.asarray(contact), jnp.asarray(load.force)
    thumb, wraps = contact[..., 0, :], 0.5 * (contact[..., 1, :] + contact[..., 2, :])
    between = contact[..., 1, :] - contact[..., 2, :]
    width, spread = norm(wraps - thumb), 0.5 * norm(between)
    axis, along = unit(wraps - thumb), unit(between)
    torque = jnp.cross(jnp.asarray(load.point) - 0.5 * (thumb + wraps), push)
    straight = jnp.abs(dot(axis, push))
    across = norm(push - dot(axis, push)[..., None] * axis)
    turning = jnp.abs(dot(axis, torque)) / (2 * config.torsion + config.friction * spread)
    tilting = jnp.abs(dot(along, torque)) / jnp.maximum(config.friction * width, _LEAST_SCALE)
    rolling = jnp.abs(dot(jnp.cross(axis, along), torque)) / jnp.maximum(spread, _LEAST_SCALE)
    return across / (2 * config.friction) + straight + turning + tilting + rolling


def _held_load(
    arm: Float[Array, "3 3"],
    inward: Float[Array, "3 3"],
    against: Float[Array, " 3"],
    friction: Float[Array, ""],
    torsion: Float[Array, ""],
) -> Float[Array, ""]:
    """How much of a unit force through the origin is held by 1 N of each finger; 0 if none."""
    scale = jnp.maximum(jnp.sqrt(jnp.mean(dot(arm, arm))), _LEAST_SCALE)  # torques become forces
    arm, torsion = arm / scale, torsion / scale
    first = jnp.concatenate([against, jnp.zeros(3)])
    free = _complement(first)

    # Of each contact, by the twist u = first + free y: along its normal, and what friction bears.
    eye = jnp.broadcast_to(jnp.eye(3), (3, 3, 3))
    velocity = jnp.concatenate([eye, -jnp.cross(eye, arm[:, None, :])], axis=-1)
    along = jnp.einsum("ia,iab->ib", inward, velocity)
    across = friction * (velocity - inward[:, :, None] * along[:, None, :])
    turn = jnp.concatenate([jnp.zeros((3, 3)), torsion * inward], axis=-1)
    slides = jnp.concatenate([across, turn[:, None, :]], axis=1)
    along_first, slides_first = along @ first, slides @ first
    along, slides = along @ free, slides @ free
    # Of the unknowns x = (y, v): how v_i - along_i changes, and half the second derivative of what
    # is inside a cone, (v_i - along_i)² - |slides_i|².
    lever = jnp.concatenate([-along, jnp.eye(3)], axis=1)
    bent = jnp.einsum("iab,iac->ibc", slides, slides)
    curve = lever[:, :, None] * lever[:, None, :] - jnp.pad(bent, [(0, 0), (0, 3), (0, 3)])

    def cones(x: Float[Array, " 8"]) -> _Cones:
        gap = lever @ x - along_first
        slide = slides_first + slides @ x[:5]
        borne = jnp.sqrt(jnp.sum(slide * slide, axis=1) + 1e-12)
        down = jnp.einsum("ia,iab->ib", slide, slides)
        return _Cones(
            inside=(gap - borne) * (gap + borne),
            slope=gap[:, None] * lever - jnp.pad(down, [(0, 0), (0, 3)]),
            needed=x[5:] - gap + borne,
            # The first twist is perpendicular to the others.
            room=_FARTHEST**2 - 1.0 - jnp.sum(x[:5] ** 2),
        )

    def newton(x: Float[Array, " 8"], weight: Float[Array, ""]) -> tuple[Float[Array, " 8"], None]:
        """Of weight·Σv − Σ log inside − Σ log v − log room."""
        inside, slope, _, room = cones(x)
        over_v = jnp.concatenate([jnp.zeros(5), 1.0 / x[5:]])
        bound = jnp.concatenate([x[:5], jnp.zeros(3)]) * (2.0 / room)
        slope = slope * (2.0 / inside)[:, None]
        g = jnp.where(jnp.arange(8) < 5, 0.0, weight) - jnp.sum(slope, axis=0) - over_v + bound
        h = slope.T @ slope - jnp.einsum("i,iab->ab", 2.0 / inside, curve) + jnp.outer(bound, bound)
        h = h + jnp.diag(over_v**2 + jnp.where(jnp.arange(8) < 5, 2.0 / room, 0.0))
        unit = jax.lax.rsqrt(jnp.diagonal(h))  # a diagonal of ones is what float32 solves best
        step = unit * solve_spd(h * unit * unit[:, None] + 1e-6 * jnp.eye(8), unit * g)
        decrement = jnp.sqrt(jnp.maximum(jnp.sum(step * g), 0.0))
        moved = x - step / jnp.where(decrement > _FULL_STEP, 1.0 + decrement, 1.0)
        # Rounding may carry it over the barrier.
        there = cones(moved)
        least = jnp.minimum(jnp.min(there.inside), jnp.minimum(jnp.min(moved[5:]), there.room))
        return jnp.where(least > 0, moved, x), None

    begin = jnp.maximum(cones(jnp.zeros(8)).needed, 0.0) + 1.0
    weights = np.repeat(np.geomspace(_FIRST, _LAST, _ROUNDS), _STEPS)
    start = jnp.concatenate([jnp.zeros(5), begin])
    x, _ = jax.lax.scan(newton, start, jnp.asarray(weights, arm.dtype))
    held = jnp.sum(jnp.maximum(cones(x).needed, 0.0))
    return jnp.where(held > _LEAST_HELD, held, 0.0)


class _Cones(NamedTuple):
    """Of the programme's constraints at some unknowns."""

    inside: Float[Array, " 3"]
    """(v - along)² - friction² of each contact, positive within the cone"""
    slope: Float[Array, "3 8"]
    """half of its gradient"""
    needed: Float[Array, " 3"]
    """along + friction: the least v"""
    room: Float[Array, ""]
    """to the bound on the twist"""


def _complement(direction: Float[Array, " 6"]) -> Float[Array, "6 5"]:
    """Orthonormal columns that span all that is perpendicular to a unit vector (Householder)."""
    sign = jnp.where(direction[0] >= 0, 1.0, -1.0)
    mirror = direction + sign * jnp.eye(6)[0]
    reflection = jnp.eye(6) - 2.0 * jnp.outer(mirror, mirror) / jnp.sum(mirror**2)
    return reflection[:, 1:]
