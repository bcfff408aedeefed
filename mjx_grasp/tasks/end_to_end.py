"""The end-to-end task: from home to a lifted object by one policy (method §6).

The baseline beside reaching and closing by parts. Scene, rewards, success, stages and lift are the
closing task's. What differs: an episode may begin anywhere on the way from home to a handoff, the
contacts go with the object, and before the lift the policy moves the fingers alone.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.closing.closer import Closer
from mjx_grasp.closing.end_to_end import EndToEndCloser
from mjx_grasp.closing.joints import driven_joints
from mjx_grasp.geometry import so3
from mjx_grasp.geometry.vectors import norm
from mjx_grasp.grasp.points import ThreePoints
from mjx_grasp.robot.interface import Measured
from mjx_grasp.sim.physics import Physics, Truth
from mjx_grasp.tasks.closing import ClosingState, ClosingTask, Standing
from mjx_grasp.tasks.config import EndToEndConfig, StartNoise
from mjx_grasp.tasks.curriculum import Learnt, Pace, first_pace, next_pace
from mjx_grasp.tasks.rewards import RewardTerm
from mjx_grasp.tasks.starts import StartDraw, StartTable
from mjx_grasp.tasks.success import in_palm
from mjx_grasp.tasks.task import Observations
from mjx_grasp.tasks.way_home import WayHome, build_way_home


class EndToEndTask(ClosingTask):
    """Reaching, closing and lifting on one engine; a `PacedTask`.

    A drawn start says how far away it is, within what the curriculum's level allows, which the
    state knows (`Pace`). Draws that say nothing of it, as those of evaluations, begin at home.

    Args:
        physics: The engine.
        starts: Start states.
        config: The task.
        noise: What resets draw.
        with_privileged: Whether observations hold `privileged_state` for the critic.
        extra_terms: Reward terms beside those of the publication.

    Raises:
        InputError: Two reward terms have one name.
    """

    config: EndToEndConfig
    pace_names = ("reach_level",)

    def __init__(
        self,
        physics: Physics,
        starts: StartTable,
        config: EndToEndConfig | None = None,
        noise: StartNoise | None = None,
        with_privileged: bool = True,
        extra_terms: tuple[RewardTerm, ...] = (),
    ):
        config = config or EndToEndConfig()
        self.way: WayHome = build_way_home(physics.scene, starts, config.postures, config.raised)
        self._in_object = in_object(starts.targets, starts.truth)
        super().__init__(physics, starts, config, noise, with_privileged, extra_terms)

    def draw(self, key: Array, worlds: int) -> StartDraw:
        """See `Task.draw`; the same starts as the closing task's for the same key."""
        way = jax.random.uniform(jax.random.fold_in(key, 2), (worlds,))
        return super().draw(key, worlds)._replace(way=way)

    def start(self, draw: StartDraw) -> tuple[ClosingState, Observations]:
        """See `Task.start`."""
        level = first_pace(len(draw.row), self.config.curriculum).level
        return super().start(self._placed(draw, level))

    def reset(
        self, state: ClosingState, mask: Bool[Array, " w"], draw: StartDraw
    ) -> tuple[ClosingState, Observations]:
        """See `Task.reset`."""
        pace: Pace = state.beside
        return super().reset(state, mask, self._placed(draw, pace.level))

    def paced(
        self, state: ClosingState, learnt: Learnt
    ) -> tuple[ClosingState, dict[str, Float[Array, ""]]]:
        """See `PacedTask.paced`: the level of the curriculum."""
        pace = next_pace(state.beside, learnt, self.config.curriculum)
        return state._replace(beside=pace), {"reach_level": pace.level[0]}

    def _controller(self) -> Closer:
        config, joints = self.config, driven_joints(self.physics.scene.robot)
        own = config.assisted, config.within, config.reach_rate
        return EndToEndCloser(config.controller, joints, *own)

    def _placed(self, draw: StartDraw, level: Float[Array, " w"]) -> StartDraw:
        """The draw with its share of the whole way: within the level, at its end, or home."""
        if draw.way is None:
            return draw._replace(way=jnp.ones(len(draw.row)))
        frontier = self.config.curriculum.frontier
        within = (draw.way - frontier) / max(1.0 - frontier, 1e-6)
        return draw._replace(way=jnp.where(draw.way < frontier, 1.0, within) * level)

    def _homing(
        self, before: Measured, after: Measured, row: Int[Array, " w"]
    ) -> Float[Array, " w"]:
        """By how much the joints with actions have come nearer along the way from home [rad]."""
        if not self.config.reward.posture:
            return super()._homing(before, after, row)
        at, near = self.closer.joints.at, self.config.reward.posture_near
        moving = np.concatenate([at.arm_policy, at.fingers])
        if self.config.action.others:
            moving = np.concatenate([moving, at.others])
        left = (jnp.maximum(self.way.left(m.q, row, moving), near) for m in (before, after))
        return next(left) - next(left)

    def _over(self, state: ClosingState) -> Bool[Array, " w"]:
        """Where the object was pushed away before the lift, or slips in it before any success."""
        if math.isinf(self.config.given_up):
            return super()._over(state)
        episode, truth = state.episode, state.truth
        pushed = norm(truth.object_pos - self.starts.truth.object_pos[episode.row])
        drawn = math.sqrt(2.0) * self.noise.offset_m  # lay beside its start state from the first
        slip = norm(in_palm(state.measured, truth) - episode.object_in_palm)
        slipped = slip > self.config.success.slip
        lost = jnp.where(state.closer.lifting, slipped, pushed > self.config.given_up + drawn)
        return lost & ~episode.progress.success

    def _table(self) -> Standing:
        postures = self.config.postures
        targets = jax.tree.map(lambda x: jnp.repeat(x, postures, axis=0), self.starts.targets)
        closer = self.closer.start(self.way.measured, targets)
        return Standing(self.way.qpos, self.way.ctrl, self.way.measured, closer)

    def _beginning(self, draw: StartDraw) -> Int[Array, " w"]:
        assert draw.way is not None  # placed by `start` and `reset`
        return self.way.row(draw.row, draw.way)

    def _beside(self, worlds: int) -> Pace:
        return first_pace(worlds, self.config.curriculum)

    def _targets(self, row: Int[Array, " w"], truth: Truth) -> ThreePoints:
        """The contacts where the object carries them."""
        return carried(jax.tree.map(lambda rows: rows[row], self._in_object), truth)


def in_object(targets: ThreePoints, truth: Truth) -> ThreePoints:
    """Contacts and normals of the world in the frame of the object that has them."""
    inverse = truth.object_quat * jnp.array([1.0, -1.0, -1.0, -1.0])
    back = inverse[..., None, :]
    position = so3.quat_rotate(back, targets.position - truth.object_pos[..., None, :])
    return ThreePoints(position, so3.quat_rotate(back, targets.normal))


def carried(local: ThreePoints, truth: Truth) -> ThreePoints:
    """The reverse: contacts of the object where it is now, in the world."""
    turn = truth.object_quat[..., None, :]
    position = so3.quat_rotate(turn, local.position) + truth.object_pos[..., None, :]
    return ThreePoints(position, so3.quat_rotate(turn, local.normal))
