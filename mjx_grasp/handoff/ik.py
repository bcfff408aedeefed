"""Batched inverse kinematics of three fingertips: Levenberg–Marquardt from many starts at once."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float

from mjx_grasp.handoff.config import IkConfig
from mjx_grasp.robot.kinematics import Kinematics
from mjx_grasp.robot.spec import RobotSpec

_FINGERS = 3
_DAMPING_START, _DAMPING_FALL, _DAMPING_RISE = 1e-3, 0.3, 5.0
# Added to the diagonal that the damping scales, so that a joint without a lever does not run off.
_DAMPING_FLOOR = 1e-3
_DAMPING_RANGE = (1e-7, 1e2)


class IkSolution(NamedTuple):
    """What the solver found for each problem.

    Attributes:
        q: ``[b, joints]`` configurations in [rad], within the limits.
        residual: ``[b, 3]`` distances of the tip frames from their targets in [m].
        pad_angle: ``[b, 3]`` angles between pad normals and inward directions in [rad].
        approach: ``[b, 3]`` the palm's approach direction, world.
        at_limit: ``[b]`` whether a solved joint is at its limit.
        cost: ``[b]`` the objective, [m²].
    """

    q: Float[Array, "b joints"]
    residual: Float[Array, "b 3"]
    pad_angle: Float[Array, "b 3"]
    approach: Float[Array, "b 3"]
    at_limit: Bool[Array, " b"]
    cost: Float[Array, " b"]


class RobotArrays(NamedTuple):
    """What the solver needs of a robot, in the robot's joint order.

    Attributes:
        kinematics: Frames: the three tips, the three pads, the palm.
        lower, upper: ``[joints]`` position limits in [rad].
        nominal: ``[joints]`` home with the hand open, [rad].
        solved: ``[joints]`` whether a joint is solved for; the others stay nominal.
        arm: ``[joints]`` whether a joint is the arm's.
        approach_axis: ``[3]`` the palm's approach direction in its frame.
    """

    kinematics: Kinematics
    lower: np.ndarray
    upper: np.ndarray
    nominal: np.ndarray
    solved: np.ndarray
    arm: np.ndarray
    approach_axis: np.ndarray


def robot_arrays(robot: RobotSpec) -> RobotArrays:
    """Limits, postures and kinematics of arm and grasping fingers, from the robot's MJCF."""
    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    fingers = robot.hand.fingers
    sites = [f.tip_site for f in fingers] + [f.pad_site for f in fingers]
    kinematics = Kinematics.from_model(model, [*sites, robot.hand.palm_site])
    joints = [model.joint(name) for name in robot.joints]
    driven = set(robot.arm.joints).union(*(f.joints for f in fingers))
    return RobotArrays(
        kinematics=kinematics,
        lower=np.array([j.range[0] for j in joints]),
        upper=np.array([j.range[1] for j in joints]),
        nominal=np.array(robot.home),
        solved=np.array([name in driven for name in robot.joints]),
        arm=np.array([name in robot.arm.joints for name in robot.joints]),
        approach_axis=np.array(robot.hand.approach_axis),
    )


def make_ik(arrays: RobotArrays, config: IkConfig) -> Callable[[Array, Array, Array], IkSolution]:
    """Compiles ``solve(targets[b, 3, 3], inward[b, 3, 3], start[b, joints]) -> IkSolution``.

    Minimises, over the arm and the three grasping fingers and within the joint limits,
    ``Σ |x_tip − target|² + (w_o |n_pad − inward|)² + (w_p |q − q_nominal|)²`` with a fixed number
    of Levenberg–Marquardt steps. Joints pushed against a limit leave the step, so that the others
    make up for them. Targets are standoff positions of the tip frames' origins and unit inward
    directions, world frame.

    Args:
        arrays: The robot.
        config: Weights and number of steps.
    """
    kin = arrays.kinematics
    columns = np.flatnonzero(arrays.solved)
    margin = np.minimum(config.limit_margin, 0.25 * (arrays.upper - arrays.lower))
    lower = np.float32(arrays.lower + margin)[columns]
    upper = np.float32(arrays.upper - margin)[columns]
    nominal = np.float32(arrays.nominal)
    w_o, w_p = config.orientation_weight, config.posture_weight

    def full(x):
        return jnp.asarray(nominal).at[columns].set(x)

    def errors(x, targets, inward):
        pos, mat = kin.forward(full(x))
        pads = mat[_FINGERS : 2 * _FINGERS, :, 0]
        return (pos[:_FINGERS] - targets), w_o * (pads - inward), pads

    def objective(x, targets, inward):
        position, orientation, _ = errors(x, targets, inward)
        posture = w_p * (x - nominal[columns])
        return jnp.sum(position**2) + jnp.sum(orientation**2) + jnp.sum(posture**2)

    def step(_, state, targets, inward):
        x, cost, damping = state
        position, orientation, pads = errors(x, targets, inward)
        jacobian = kin.jacobian(full(x))[:, :, columns]
        turning = jacobian[_FINGERS : 2 * _FINGERS, 3:]
        # d(n_pad) = ω × n_pad
        swing = w_o * jnp.cross(turning, pads[:, :, None], axisa=1, axisb=1, axisc=1)
        rows = jnp.concatenate(
            [jacobian[:_FINGERS, :3].reshape(9, -1), swing.reshape(9, -1)], axis=0
        )
        residual = jnp.concatenate([position.reshape(-1), orientation.reshape(-1)])
        gradient = rows.T @ residual + w_p**2 * (x - nominal[columns])
        stuck = ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
        free = jnp.where(stuck, 0.0, 1.0)
        rows = rows * free
        hessian = rows.T @ rows + w_p**2 * jnp.eye(len(columns))
        hessian = hessian + damping * jnp.diag(jnp.diag(hessian) + _DAMPING_FLOOR)
        move = cho_solve(cho_factor(hessian), gradient * free)
        trial = jnp.clip(x - move, lower, upper)
        trial_cost = objective(trial, targets, inward)
        better = trial_cost < cost
        damping = damping * jnp.where(better, _DAMPING_FALL, _DAMPING_RISE)
        return (
            jnp.where(better, trial, x),
            jnp.where(better, trial_cost, cost),
            jnp.clip(damping, *_DAMPING_RANGE),
        )

    def solve_one(targets, inward, start):
        x = jnp.clip(start[columns], lower, upper)
        state = (x, objective(x, targets, inward), jnp.float32(_DAMPING_START))
        body = partial(step, targets=targets, inward=inward)
        x, cost, _ = jax.lax.fori_loop(0, config.iterations, body, state)
        q = full(x)
        pos, mat = kin.forward(q)
        cosine = jnp.sum(mat[_FINGERS : 2 * _FINGERS, :, 0] * inward, axis=-1)
        return IkSolution(
            q=q,
            residual=jnp.sqrt(jnp.sum((pos[:_FINGERS] - targets) ** 2, axis=-1)),
            pad_angle=jnp.arccos(jnp.clip(cosine, -1.0, 1.0)),
            approach=mat[-1] @ jnp.float32(arrays.approach_axis),
            at_limit=jnp.any((x <= lower) | (x >= upper)),
            cost=cost,
        )

    @jax.jit
    def solve(targets, inward, start):
        with jax.default_matmul_precision("highest"):
            return jax.vmap(solve_one)(targets, inward, start)

    return solve
