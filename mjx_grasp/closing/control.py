"""From a field and an action to joint position commands (method §5, the closing command)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.closing.config import ClosingConfig
from mjx_grasp.geometry.linear import damped_least_squares
from mjx_grasp.sim.physics import Readings
from mjx_grasp.sim.scene import Scene


class JointMap(NamedTuple):
    """Which joints move what, as indices into robot order. Static."""

    arm: np.ndarray  # [a] the arm's joints
    arm_policy: np.ndarray  # [6] those the policy moves
    fingers: np.ndarray  # [m] the policy's finger joints, finger by finger
    per_finger: np.ndarray  # [f, m/f] the same, by finger
    chains: np.ndarray  # [f, a + 4] all joints that move each pad
    limits: np.ndarray  # [n, 2] rad
    stiffness: np.ndarray  # [m] position gain of the policy's finger joints [N m/rad]
    dry_friction: np.ndarray  # [m] N m


def joint_map(scene: Scene) -> JointMap:
    """Reads the map off the robot's description and the compiled model."""
    robot, model = scene.robot, scene.model
    order = (*robot.arm.joints, *robot.hand.joints)
    index = {name: i for i, name in enumerate(order)}
    per_finger = np.array([[index[j] for j in f.policy_joints] for f in robot.hand.fingers])
    arm = np.array([index[j] for j in robot.arm.joints])
    chains = np.array([[*arm, *(index[j] for j in f.joints)] for f in robot.hand.fingers])
    fingers = per_finger.ravel()
    names = [order[i] for i in fingers]
    return JointMap(
        arm=arm,
        arm_policy=np.array([index[j] for j in robot.arm.policy_joints]),
        fingers=fingers,
        per_finger=per_finger,
        chains=chains,
        limits=np.array([model.joint(n).range for n in order], np.float32),
        stiffness=np.array([model.actuator(n).gainprm[0] for n in names], np.float32),
        dry_friction=np.array(
            [float(model.dof_frictionloss[model.joint(n).dofadr[0]]) for n in names], np.float32
        ),
    )


def point_jacobian(
    point: Float[Array, "*b 3"], axis: Float[Array, "*b j 3"], anchor: Float[Array, "*b j 3"]
) -> Float[Array, "*b 6 j"]:
    """World-aligned geometric Jacobian of a point: linear rows a × (p − o), angular rows a."""
    linear = jnp.cross(axis, point[..., None, :] - anchor)
    return jnp.swapaxes(jnp.concatenate([linear, axis], axis=-1), -1, -2)


def pad_jacobians(readings: Readings, joints: np.ndarray) -> Float[Array, "*b f 6 j"]:
    """Jacobians of the pads for joints [f, j] of each finger."""
    return point_jacobian(
        readings.pad_pos, readings.joint_axis[..., joints, :], readings.joint_anchor[..., joints, :]
    )


def pad_twists(readings: Readings, joint_map: JointMap) -> Float[Array, "*b f 6"]:
    """Measured pad twists J q̇, arm and finger joints [m/s, rad/s]."""
    jacobian = pad_jacobians(readings, joint_map.chains)
    return jnp.sum(jacobian * readings.qd[..., joint_map.chains][..., None, :], axis=-1)


def palm_jacobian(readings: Readings, joints: np.ndarray) -> Float[Array, "*b 6 j"]:
    """Jacobian of the palm frame for arm joints [j]."""
    return point_jacobian(
        readings.palm_pos,
        readings.joint_axis[..., joints, :],
        readings.joint_anchor[..., joints, :],
    )


def guided_rates(
    jacobian: Float[Array, "*b f 6 j"], field: Float[Array, "*b f 6"], config: ClosingConfig
) -> Float[Array, "*b f j"]:
    """Finger joint velocities that follow the field in the weighted least-squares sense [rad/s]."""
    angular = config.command_angular_weight**2
    weight = jnp.array([1.0, 1.0, 1.0, angular, angular, angular])
    rates = damped_least_squares(jacobian, field, weight, config.finger_damping)
    return jnp.clip(rates, -config.finger_rate_limit, config.finger_rate_limit)


def grip_torques(
    jacobian: Float[Array, "*b f 6 j"],
    inward: Float[Array, "*b f 3"],
    force: Float[Array, "*b f"],
) -> Float[Array, "*b f j"]:
    """Jᵀ·F along the inward normals [N m]."""
    return jnp.sum(jacobian[..., :3, :] * (force[..., None] * inward)[..., None], axis=-2)


def lift_rates(
    jacobian: Float[Array, "*b 6 j"], speed: Float[Array, "*b"], config: ClosingConfig
) -> Float[Array, "*b j"]:
    """Arm joint velocities that raise the palm without turning it [rad/s]."""
    zero = jnp.zeros_like(speed)
    twist = jnp.stack([zero, zero, speed, zero, zero, zero], axis=-1)
    return damped_least_squares(jacobian, twist, jnp.ones(6), config.arm_damping)


def update_residual(
    residual: Float[Array, "*b m"], action: Float[Array, "*b m"], config: ClosingConfig
) -> Float[Array, "*b m"]:
    """The finger residual after an action [rad]: a bounded leak, or the published integral."""
    step = config.finger_action_rate * config.control_dt * action
    if config.residual == "integrated":
        return residual + step
    kept = config.residual_keep * residual + step
    return jnp.clip(kept, -config.residual_limit, config.residual_limit)


def hold_until_landed(
    hold: Float[Array, "*b f j"],
    q: Float[Array, "*b f j"],
    rates: Float[Array, "*b f j"],
    landed: Bool[Array, "*b f"],
    config: ClosingConfig,
) -> Float[Array, "*b f j"]:
    """Guided joint targets [rad]: they follow the field until the finger lands, then stay."""
    lead = jnp.clip(hold + rates * config.control_dt - q, -config.hold_lead, config.hold_lead)
    return jnp.where(landed[..., None], hold, q + lead)
