"""The wrench on an object, from what its momentum does."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mjx_grasp.geometry import so3
from mjx_grasp.objects.model import ObjectModel


def net_wrench(
    obj: ObjectModel,
    quat: Float[np.ndarray, "t *n 4"],
    vel: Float[np.ndarray, "t *n 6"],
    dt: float,
) -> tuple[Float[np.ndarray, "t *n 3"], Float[np.ndarray, "t *n 3"]]:
    """All contacts and the weight together: zero while an object rests or hangs still.

    Args:
        obj: Its mass, centre of mass and inertia.
        quat: Orientations of the object frame, tick by tick.
        vel: Velocities of its origin [m/s] in the world, then angular [rad/s] in the object frame.
        dt: Between two ticks [s].

    Returns:
        Mass times acceleration of the centre of mass [N], and change of angular momentum about it
        [N m], world frame.
    """
    turn = np.asarray(so3.quat_to_mat(jnp.asarray(quat)))
    spin, lever = np.einsum("...ij,...j->...i", turn, vel[..., 3:]), turn @ obj.com
    momentum = obj.mass * (vel[..., :3] + np.cross(spin, lever))
    angular = np.einsum("...ij,jk,...k->...i", turn, obj.inertia, vel[..., 3:])
    return np.gradient(momentum, dt, axis=0), np.gradient(angular, dt, axis=0)
