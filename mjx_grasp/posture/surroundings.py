"""What the robot must stay clear of, and how near it is (method §3, 'half-spaces')."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.loops import repeated
from mjx_grasp.geometry.segments import closest_between_segments
from mjx_grasp.geometry.signed_distance import Shape, distance_and_normal, signed_distance
from mjx_grasp.geometry.vectors import dot, norm, turned, turned_back, unit
from mjx_grasp.posture.body import Body
from mjx_grasp.posture.cover import Solids, merged
from mjx_grasp.robot.kinematics import Motion

# Points of a segment at which its distance is looked at, after both ends.
_STEPS = 5
# A distance that changes its slope along a segment by less is even, [m].
_FLAT = 1e-9


class Surroundings(NamedTuple):
    """The world at one tick."""

    shape: Shape
    """the object, in its own frame"""
    p_wo: Float[Array, " 3"]
    """object origin in world [m]"""
    R_wo: Float[Array, "3 3"]
    """object rotation"""
    v_wo: Float[Array, " 6"]
    """object twist, world: velocity of its origin [m/s], angular velocity [rad/s]"""
    obstacles: Float[Array, "k 4"]
    """spheres to avoid, none is ``k = 0``: centre in world and radius [m]"""
    obstacle_velocity: Float[Array, "k 3"]
    """of their centres [m/s]"""
    com: Float[Array, " 3"] | None = None
    """the object's centre of mass, in its own frame; its origin if None [m]"""
    weight: Float[Array, ""] | None = None
    """the object's, 0 or None where it is not known [N]"""

    @classmethod
    def still(
        cls,
        shape: Shape,
        p_wo: Float[Array, " 3"],
        R_wo: Float[Array, "3 3"],
        com: Float[Array, " 3"] | None = None,
        weight: Float[Array, ""] | None = None,
    ) -> Surroundings:
        """An object at rest and nothing else."""
        none = jnp.zeros((0, 4)), jnp.zeros((0, 3))
        return cls(shape, p_wo, R_wo, jnp.zeros(6), *none, com, weight)

    def after(self, dt: float) -> Surroundings:
        """The world that much later, if everything moves on as it does, [s]."""
        centres = self.obstacles[:, :3] + dt * self.obstacle_velocity
        return self._replace(
            p_wo=self.p_wo + dt * self.v_wo[:3],
            R_wo=so3.exp(dt * self.v_wo[3:]) @ self.R_wo,
            obstacles=jnp.concatenate([centres, self.obstacles[:, 3:]], axis=1),
        )


class Proximity(NamedTuple):
    """Distances of groups of the robot's shapes and how the joints change them."""

    distance: Float[Array, " n"]
    """of surfaces, negative where they overlap [m]"""
    slope: Float[Array, "n joints"]
    """change of the distance per joint velocity [m/rad]"""
    drift: Float[Array, " n"]
    """its change by the other's own motion [m/s]"""


def placed(solids: Solids, motion: Motion) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Both ends of the segments in world, [m]."""
    mat, pos = motion.mat[solids.frame], motion.pos[solids.frame]
    start = pos + turned(mat, jnp.asarray(solids.start))
    return start, pos + turned(mat, jnp.asarray(solids.end))


def to_object(around: Surroundings, points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """World points in the object frame."""
    return turned_back(around.R_wo, points - around.p_wo)


def slopes(
    motion: Motion,
    moves: Float[Array, "n joints"],
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
) -> Float[Array, "n joints"]:
    """Velocity along ``normals`` of points fixed to a link, per joint velocity [m/rad].

    Args:
        motion: The robot.
        moves: 1 where a joint moves the point's link, else 0.
        points: World, [m].
        normals: Unit directions, world.
    """
    wrench = jnp.concatenate([jnp.cross(points, normals), normals], axis=-1)
    return moves * (wrench @ motion.screws.T)


def obstacle_distance(obstacles: Float[Array, "k 4"], points: Float[Array, "*n 3"]) -> Array:
    """Distance in [m] of world points to the nearest obstacle; none is infinitely far."""
    distance = jnp.full(points.shape[:-1], jnp.inf, points.dtype)
    for k in range(obstacles.shape[0]):
        to_surface = norm(points - obstacles[k, :3]) - obstacles[k, 3]
        distance = jnp.minimum(distance, to_surface)
    return distance


def nearest_on_segments(
    shape: Shape, start: Float[Array, "n 3"], end: Float[Array, "n 3"]
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
    """Parameters in [0, 1] of the points of segments nearest to a shape; distances in [m] there, of
    the starts and of the ends.

    Where the distance, convex about a convex shape, neither falls nor rises: false position of its
    slope (the Illinois method), exact to 0.3 mm. Of points merely near the nearest ones the
    distance would also change as they slide along, which no half-space bounds.

    Args:
        shape: In whose frame the segments are.
        start: Of the segments, [m].
        end: Theirs, [m].
    """
    along = end - start

    def at(t: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        distance, normal = distance_and_normal(shape, start + t[:, None] * along)
        return distance, dot(normal, along)

    zero = jnp.zeros(start.shape[0], start.dtype)
    (low, high), (falls, rises) = jax.vmap(at)(jnp.stack([zero, zero + 1.0]))

    def step(state: _Bracket) -> _Bracket:
        t_low, t_high, falls, rises, between, side, t, best = state
        trial = t_low + between * (t_high - t_low)
        distance, slope = at(trial)
        up = slope > 0
        # A side that stays twice counts half.
        rises = jnp.where(up, slope, jnp.where(side < 0, 0.5 * rises, rises))
        falls = jnp.where(up, jnp.where(side > 0, 0.5 * falls, falls), slope)
        share = falls / jnp.minimum(falls - rises, -_FLAT)
        return _Bracket(
            t_low=jnp.where(up, t_low, trial),
            t_high=jnp.where(up, trial, t_high),
            falls=falls,
            rises=rises,
            between=jnp.clip(share, 0.0, 1.0),
            side=jnp.where(up, 1.0, -1.0),
            t=jnp.where(distance < best, trial, t),
            best=jnp.minimum(distance, best),
        )

    # The middle first, for shapes that are not convex.
    nearer = jnp.where(low <= high, zero, 1.0)
    begin = _Bracket(
        zero, zero + 1.0, falls, rises, zero + 0.5, zero, nearer, jnp.minimum(low, high)
    )
    found = repeated(_STEPS, step, begin)
    return found.t, found.best, low, high


class _Bracket(NamedTuple):
    """Of false position: between which parameters the slope changes its sign, and the best one."""

    t_low: Float[Array, " n"]
    t_high: Float[Array, " n"]
    falls: Float[Array, " n"]
    """slope at the lower end"""
    rises: Float[Array, " n"]
    """and at the upper"""
    between: Float[Array, " n"]
    """where the next one is tried, from 0 to 1"""
    side: Float[Array, " n"]
    """which end was moved last: 1 the upper one, -1 the lower, 0 none"""
    t: Float[Array, " n"]
    best: Float[Array, " n"]
    """least distance so far [m]"""


def _picked(groups: Int[np.ndarray, "g k"], distance: Float[Array, "*b n"]) -> Int[Array, "*b g"]:
    """Of each group the member that is nearest."""
    choice = jnp.argmin(distance[..., groups], axis=-1)
    return jnp.asarray(groups)[np.arange(len(groups)), choice]


def object_proximity(
    body: Body, parts: Sequence[Solids], motion: Motion, around: Surroundings
) -> Proximity:
    """Distances of every group of ``parts`` to the object: :attr:`Solids.rows` of each.

    Of segments first those of the nearest points, then of the starts, then of the ends; points come
    last. The shape is asked about all parts at once, as each question has its price, however small.
    """
    centres, radii, moves = [], [], []

    def keep(solids: Solids, at: Float[Array, "k n 3"], distance: Float[Array, "k n"]) -> None:
        pick = _picked(solids.groups, distance - solids.radius)
        centres.append(jnp.concatenate([p[k] for p, k in zip(at, pick, strict=True)]))
        radii.append(jnp.asarray(solids.radius)[pick].reshape(-1))
        moves.append(jnp.asarray(body.moves[solids.frame], at.dtype)[pick.reshape(-1)])

    if spans := [solids for solids in parts if not solids.are_points]:
        solids = merged(spans)
        start, end = placed(solids, motion)
        inside = to_object(around, start), to_object(around, end)
        t, *distances = nearest_on_segments(around.shape, *inside)
        nearest = start + t[:, None] * (end - start)
        keep(solids, jnp.stack([nearest, start, end]), jnp.stack(distances))
    if points := [solids for solids in parts if solids.are_points]:
        solids = merged(points)
        at, _ = placed(solids, motion)
        keep(solids, at[None], signed_distance(around.shape, to_object(around, at))[None])
    centre = jnp.concatenate(centres)
    exact, normal = distance_and_normal(around.shape, to_object(around, centre))
    normal = turned(around.R_wo, normal)
    surface = around.v_wo[:3] + jnp.cross(around.v_wo[3:], centre - around.p_wo)
    slope = slopes(motion, jnp.concatenate(moves), centre, normal)
    return Proximity(exact - jnp.concatenate(radii), slope, -dot(normal, surface))


def obstacle_proximity(
    body: Body, solids: Solids, motion: Motion, around: Surroundings
) -> Proximity:
    """Distances of every group of ``solids`` to the nearest obstacle: :attr:`Solids.rows`."""
    start, end = placed(solids, motion)
    along = end - start
    squared = jnp.maximum(dot(along, along), 1e-12)
    centres, size = around.obstacles[:, :3], around.obstacles[:, 3]

    def rows(share: float | Array | None) -> Proximity:
        """At the nearest points, or at one end, of all solids."""
        if share is None:
            offset = centres[:, None] - start
            share = jnp.clip(dot(offset, along) / squared, 0.0, 1.0)
        points = start + jnp.asarray(share)[..., None] * along
        points = jnp.broadcast_to(points, (len(centres), *start.shape))
        gap = norm(points - centres[:, None]) - size[:, None]
        which, each = jnp.argmin(gap, axis=0), np.arange(len(solids.frame))
        distance, at = gap[which, each] - solids.radius, points[which, each]
        pick = _picked(solids.groups, distance)
        at, which = at[pick], which[pick]
        normal = unit(at - centres[which])
        moves = jnp.asarray(body.moves[solids.frame], at.dtype)[pick]
        drift = -dot(normal, around.obstacle_velocity[which])
        return Proximity(distance[pick], slopes(motion, moves, at, normal), drift)

    return stacked([rows(share) for share in ((None,) if solids.are_points else (None, 0.0, 1.0))])


def table_proximity(
    body: Body, solids: Solids, groups: Int[np.ndarray, "g k"], motion: Motion
) -> Proximity:
    """Heights of the lowest points of groups of ``solids`` above the table top z = 0."""
    start, end = placed(solids, motion)
    lower = jnp.where((start[:, 2] < end[:, 2])[:, None], start, end)
    height = lower[:, 2] - solids.radius
    pick = _picked(groups, height)
    up = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0], start.dtype), (len(groups), 3))
    moves = jnp.asarray(body.moves[solids.frame], start.dtype)[pick]
    slope = slopes(motion, moves, lower[pick], up)
    return Proximity(height[pick], slope, jnp.zeros(len(groups), start.dtype))


def finger_proximity(body: Body, motion: Motion) -> Proximity:
    """Distances of every two fingers."""
    return _between(body, body.hand_capsules, body.pairs, motion)


def arm_proximity(body: Body, motion: Motion) -> Proximity:
    """Distances of the arm's outer links to its base and inner links."""
    return _between(body, body.arm_capsules, body.arm_pairs, motion)


def _between(
    body: Body, solids: Solids, pairs: Int[np.ndarray, "rows k 2"], motion: Motion
) -> Proximity:
    """Of each row of pairs of ``solids`` the nearest."""
    start, end = placed(solids, motion)
    a, b = jnp.asarray(pairs[..., 0]), jnp.asarray(pairs[..., 1])
    radius = jnp.asarray(solids.radius)
    on_a, on_b = closest_between_segments(start[a], end[a], start[b], end[b])
    gap = norm(on_a - on_b) - radius[a] - radius[b]
    best = jnp.argmin(gap, axis=-1)
    rows = jnp.arange(len(a))
    a, b = a[rows, best], b[rows, best]
    on_a, on_b = on_a[rows, best], on_b[rows, best]
    normal = unit(on_a - on_b)
    moves = jnp.asarray(body.moves[solids.frame], start.dtype)
    slope = slopes(motion, moves[a], on_a, normal) - slopes(motion, moves[b], on_b, normal)
    return Proximity(gap[rows, best], slope, jnp.zeros(len(rows), start.dtype))


def stacked(parts: list[Proximity]) -> Proximity:
    """Several sets of distances as one."""
    return Proximity(*(jnp.concatenate(leaves) for leaves in zip(*parts, strict=True)))
