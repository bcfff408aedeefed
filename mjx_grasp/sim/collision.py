"""Which pre-grasps touch what they must not, by native MuJoCo's collision detection."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.sim.scene import TABLE_GEOM, Scene

# Reasons, in the order in which they are reported when there are several.
REASONS = ("hand-object", "arm-object", "hand-table", "arm-table", "self")
_ARM, _HAND, _OBJECT, _TABLE = range(4)
_REASON_OF_PAIR = {
    (_HAND, _OBJECT): "hand-object",
    (_ARM, _OBJECT): "arm-object",
    (_HAND, _TABLE): "hand-table",
    (_ARM, _TABLE): "arm-table",
    (_ARM, _ARM): "self",
    (_ARM, _HAND): "self",
    (_HAND, _HAND): "self",
}
# Contact bits of hand and arm in the robot's MJCF.
_ROBOT_BITS = 1 | 2


class CollisionChecker:
    """Looks for penetrations of a robot and one object over the table.

    Beyond the contacts of the physics, which leave them out for speed, the arm is checked against
    itself and the hand. Pairs of those that overlap at home are neighbours whose simplified shapes
    overlap always; they do not count.
    """

    def __init__(self, scene: Scene):
        """Prepares the check.

        Args:
            scene: A scene; where it has several objects a state is of one of them, and the others
                count for nothing.
        """
        self._addresses = scene.addresses
        self._model = copy.deepcopy(scene.model)
        self._data = mujoco.MjData(self._model)
        self._kind = _geom_kinds(scene.model, scene.robot, scene.addresses.object_geoms)
        pieces = [len(obj.pieces) for obj in scene.objects]
        self._owner = np.repeat(np.arange(len(pieces)), pieces)
        geoms = scene.addresses.object_geoms
        self._bits = scene.model.geom_contype[geoms], scene.model.geom_conaffinity[geoms]
        model = self._model
        arm = self._kind == _ARM
        model.geom_conaffinity[arm] |= _ROBOT_BITS
        model.body_conaffinity[np.unique(model.geom_bodyid[arm])] |= _ROBOT_BITS
        away = np.array([10.0, 0.0, 1.0])
        home = np.array(scene.robot.home)
        pairs = self._penetrations(home, away, np.array([1.0, 0.0, 0.0, 0.0]))
        self._neighbours = {pair for pair in pairs if _ARM in self._kind[list(pair)]}

    def reason(
        self,
        q: Float[np.ndarray, " joints"],
        object_pos: Float[np.ndarray, " 3"],
        object_quat: Float[np.ndarray, " 4"],
        object_index: int = 0,
    ) -> str | None:
        """The first of :data:`REASONS` for which a state is refused, or None if it is clear.

        Any penetration counts, except that of the object and the table it rests on.

        Args:
            q: Configuration in robot order, [rad].
            object_pos: Object origin in world, [m].
            object_quat: Object rotation w-x-y-z.
            object_index: Which object of the scene.
        """
        self._hide_all_but(object_index)
        found = set()
        for pair in self._penetrations(q, object_pos, object_quat):
            kinds = tuple(sorted(self._kind[list(pair)]))
            if kinds in _REASON_OF_PAIR and pair not in self._neighbours:
                found.add(_REASON_OF_PAIR[kinds])
        return next((reason for reason in REASONS if reason in found), None)

    def _hide_all_but(self, object_index: int) -> None:
        geoms, here = self._addresses.object_geoms, self._owner == object_index
        for of_all, bits in zip(
            (self._model.geom_contype, self._model.geom_conaffinity), self._bits, strict=True
        ):
            of_all[geoms] = np.where(here, bits, 0)

    def _penetrations(
        self,
        q: Float[np.ndarray, " joints"],
        object_pos: Float[np.ndarray, " 3"],
        object_quat: Float[np.ndarray, " 4"],
    ) -> list[tuple[int, int]]:
        data = self._data
        data.qpos[self._addresses.robot_qpos] = q
        data.qpos[self._addresses.object_qpos[:3]] = object_pos
        data.qpos[self._addresses.object_qpos[3:]] = object_quat
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_collision(self._model, data)
        deep = data.contact.dist < 0
        return [(int(min(pair)), int(max(pair))) for pair in data.contact.geom[deep]]


def _geom_kinds(model: mujoco.MjModel, robot: RobotSpec, object_geoms: np.ndarray) -> np.ndarray:
    """What each geom is part of; −1 for what plays no part."""
    palm = model.body(robot.hand.palm_body).id
    arm_root = int(model.body_rootid[palm])
    kinds = np.full(model.ngeom, -1)
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if model.body_rootid[body] == arm_root and body != 0:
            while body not in (palm, arm_root):
                body = int(model.body_parentid[body])
            kinds[geom] = _HAND if body == palm else _ARM
    kinds[object_geoms] = _OBJECT
    kinds[model.geom(TABLE_GEOM).id] = _TABLE
    return kinds
