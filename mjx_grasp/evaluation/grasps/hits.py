"""Whether a robot touched an obstacle: MuJoCo's own geoms, not those that the controller avoids."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.mjcf import robot_mjspec


def hits(
    robot: RobotSpec,
    qpos: Float[np.ndarray, "t w nq"],
    joints: Int[np.ndarray, " n"],
    ticks: Int[np.ndarray, " w"],
    obstacles: Float[np.ndarray, "w k 4"],
) -> Bool[np.ndarray, " w"]:
    """Whether any link that collides comes in touch with a sphere at any time.

    Args:
        robot: Its MJCF says which geoms collide.
        qpos: Of the trials, tick by tick.
        joints: The robot's joints in it, in the robot's order.
        ticks: That each trial had; what is behind them is not looked at.
        obstacles: Centre and radius [m].
    """
    touched = np.zeros(qpos.shape[1], bool)
    if not obstacles.size:
        return touched
    spec = robot_mjspec(robot)
    sphere, names = mujoco.mjtGeom.mjGEOM_SPHERE, [f"ball{k}" for k in range(obstacles.shape[1])]
    for name in names:  # not at the origin: MuJoCo would take them to stay there
        spec.worldbody.add_geom(type=sphere, size=[1, 0, 0], pos=[1, 1, 1], name=name)
    model = spec.compile()
    data, ids = mujoco.MjData(model), [model.geom(name).id for name in names]
    links = [
        g
        for g in range(model.ngeom)
        if g not in ids and model.geom_contype[g] | model.geom_conaffinity[g]
    ]
    nearest = np.zeros(6)
    for w in range(qpos.shape[1]):
        for ball, at in zip(ids, obstacles[w], strict=True):
            model.geom_pos[ball], model.geom_size[ball, 0] = at[:3], at[3]
            model.geom_rbound[ball] = at[3]
        for row in qpos[: ticks[w], w, joints]:
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            touched[w] = any(
                mujoco.mj_geomDistance(model, data, ball, link, 1e-3, nearest) <= 0
                for ball in ids
                for link in links
            )
            if touched[w]:
                break
    return touched
