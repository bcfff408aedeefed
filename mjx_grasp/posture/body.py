"""The robot as the search for postures and the reaching controller see it.

Joints, frames, capsules and points on its links: all is read from the robot's description and its
compiled MJCF. Fingers are the subtrees below the palm, those of the grasp first; links with boxes
are covered by small spheres.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, product

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.posture.cover import Part, Solids, cells, covered, filled, may_touch, padded, solids
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.indices import robot_indices
from mjx_grasp.robot.kinematics import Kinematics, Motion
from mjx_grasp.robot.mjcf import robot_mjspec

FINGERS = 3
# Of the frames: the three tip sites, then the three pad sites, then the palm site.
PALM = 2 * FINGERS
# An arm link with fewer joints than this above it cannot come near table or object.
_FEWEST_ARM_JOINTS = 4
# Arm links with this many joints between them can meet.
_APART = 4


@jax.tree_util.register_static
@dataclass(frozen=True, eq=False)
class Body:
    """Static under jit. Joints are in the robot's order, the arm's before the hand's."""

    robot: RobotSpec
    kinematics: Kinematics
    palm: Kinematics
    """of the palm's frame alone"""
    moves: Bool[np.ndarray, "frames joints"]
    lower: Float[np.ndarray, " joints"]
    """position limits [rad]"""
    upper: Float[np.ndarray, " joints"]
    """position limits [rad]"""
    velocity_limit: Float[np.ndarray, " joints"]
    """[rad/s]"""
    torque_limit: Float[np.ndarray, " joints"]
    """of its motor [N m]"""
    home: Float[np.ndarray, " joints"]
    """the arm at home with the hand open [rad]"""
    arm: Bool[np.ndarray, " joints"]
    """whether a joint is the arm's"""
    grasping: Bool[np.ndarray, " joints"]
    """whether it is one of the three fingers'"""
    approach_axis: Float[np.ndarray, " 3"]
    """out of the palm, in its frame"""
    opposing_axis: Float[np.ndarray, " 3"]
    """whose angle to the grasp axis is weighed, in the palm's frame"""
    hand_capsules: Solids
    fingers: Int[np.ndarray, "fingers links"]
    """hand capsules of each finger, padded by repetition"""
    palm_points: Solids
    arm_capsules: Solids
    pairs: Int[np.ndarray, "finger_pairs link_pairs 2"]
    """pairs of hand capsules of different fingers, one row per pair of fingers"""
    arm_pairs: Int[np.ndarray, "arm_links arm_pairs 2"]
    """pairs of arm capsules that are not neighbours, one row per outer link"""
    hand_spheres: Solids
    """points that fill the hand, few and inside its shapes"""
    apart: Bool[np.ndarray, "s s"]
    """which two of them must not overlap"""

    def within(
        self, margin: float
    ) -> tuple[Float[np.ndarray, " joints"], Float[np.ndarray, " joints"]]:
        """Position limits less a margin, at most a quarter of a joint's range, [rad]."""
        kept = np.minimum(margin, 0.25 * (self.upper - self.lower))
        return self.lower + kept, self.upper - kept

    def point_jacobians(
        self, motion: Motion, frames: Int[np.ndarray, " n"], points: Float[Array, "n 3"]
    ) -> Float[Array, "n 3 joints"]:
        """Velocities of world points fixed to frames, per joint velocity."""
        angular, linear = motion.screws[:, :3], motion.screws[:, 3:]
        swept = jnp.cross(angular[None], points[:, None]) + linear
        moves = jnp.asarray(self.moves[frames], points.dtype)
        return jnp.swapaxes(swept * moves[:, :, None], 1, 2)

    def angular_jacobians(
        self, motion: Motion, frames: Int[np.ndarray, " n"]
    ) -> Float[Array, "n 3 joints"]:
        """Angular velocities of frames, per joint velocity."""
        moves = jnp.asarray(self.moves[frames], motion.screws.dtype)
        return moves[:, None, :] * motion.screws[:, :3].T


def robot_body(robot: RobotSpec) -> Body:
    """Reads shapes, limits and kinematics of a robot.

    Raises:
        InputError: A link has a shape that is neither capsule, sphere, box nor cylinder, or the
            arm has a joint that is no hinge or slide.
    """
    model = robot_mjspec(robot).compile()
    palm = model.body(robot.hand.palm_body).id
    fingers = _fingers(model, robot, palm)
    finger_bodies = [body for finger in fingers for body in finger]
    arm_bodies = _arm_bodies(model, palm)
    bodies = [palm, *finger_bodies, *arm_bodies]
    sites = [f.tip_site for f in robot.hand.fingers] + [f.pad_site for f in robot.hand.fingers]
    kinematics = Kinematics.from_model(
        model, [*sites, robot.hand.palm_site], [model.body(b).name for b in bodies]
    )
    if kinematics.joints != robot.joints:
        raise InputError("robot", kinematics.joints, "the joints of the description alone")
    frame_of = {body: PALM + 1 + k for k, body in enumerate(bodies)}

    capsules = [part for b in finger_bodies for part in covered(model, b)]
    links = [[n for n, c in enumerate(capsules) if c.body in finger] for finger in fingers]
    groups, names = [], []
    for finger, members in zip(fingers, links, strict=True):
        # The links next to the palm hardly move against it: they share a row with the next.
        outer = finger[2:]
        inner = [n for n in members if capsules[n].body not in outer]
        parts = [inner, *([n for n in members if capsules[n].body == b] for b in outer)]
        groups += [part for part in parts if part]
        names += [model.body(finger[-1]).name] * sum(bool(part) for part in parts)
    pairs = [list(product(*two)) for two in combinations(links, 2)]

    points = covered(model, palm)
    if not points:
        raise InputError(
            "hand.palm_body", robot.hand.palm_body, "a body with a shape to keep clear"
        )
    near = cells(points)
    arm = [part for b in arm_bodies for part in covered(model, b)]
    depth = _joints_above(model, [part.body for part in arm])
    far = [n for n in range(len(arm)) if depth[n] >= _FEWEST_ARM_JOINTS]
    if not far:
        raise InputError("arm.joints", robot.arm.joints, "an arm whose outer links have a shape")
    arm_pairs = [[(n, m) for m in range(len(arm)) if depth[m] <= depth[n] - _APART] for n in far]
    arm_pairs = [pairs for pairs in arm_pairs if pairs]
    far_names = tuple(model.body(arm[n].body).name for n in far)
    spheres = [part for b in (palm, *finger_bodies) for part in filled(model, b)]
    joints = [model.joint(name) for name in robot.joints]
    motors = [model.actuator(name).id for name in robot.joints]
    torque = np.abs(model.actuator_forcerange[motors]).min(axis=1)
    indices = robot_indices(robot)
    return Body(
        robot=robot,
        kinematics=kinematics,
        palm=Kinematics.from_model(model, [robot.hand.palm_site]),
        moves=kinematics.moves,
        lower=np.array([j.range[0] for j in joints], np.float32),
        upper=np.array([j.range[1] for j in joints], np.float32),
        velocity_limit=np.array(robot.velocity_limits, np.float32),
        torque_limit=np.where(model.actuator_forcelimited[motors], torque, np.inf).astype(
            np.float32
        ),
        home=np.array(robot.home, np.float32),
        arm=indices.mask(indices.arm),
        grasping=indices.mask(indices.grasping),
        approach_axis=np.array(robot.hand.approach_axis, np.float32),
        opposing_axis=np.array(robot.hand.opposing_axis, np.float32),
        hand_capsules=solids(capsules, frame_of, groups, tuple(names)),
        fingers=padded([sorted(members) for members in links if members]),
        palm_points=solids(points, frame_of, near, ("palm",) * len(near)),
        arm_capsules=solids(arm, frame_of, [[n] for n in far], far_names),
        pairs=padded(pairs),
        arm_pairs=padded(arm_pairs) if arm_pairs else np.zeros((0, 1, 2), int),
        hand_spheres=solids(spheres, frame_of, [list(range(len(spheres)))], ("hand",)),
        apart=_apart(model, robot, spheres),
    )


def _fingers(model: mujoco.MjModel, robot: RobotSpec, palm: int) -> list[list[int]]:
    """Bodies of each finger from root to tip; the grasping fingers first, in their order."""
    roots = [b for b in range(model.nbody) if model.body_parentid[b] == palm]
    trees = []
    for root in roots:
        tree = [root]
        for body in range(root + 1, model.nbody):
            if model.body_parentid[body] in tree:
                tree.append(body)
        trees.append(tree)
    tips = [model.body(f.tip_body).id for f in robot.hand.fingers]
    first = [next(tree for tree in trees if tip in tree) for tip in tips]
    return first + [tree for tree in trees if tree not in first]


def _arm_bodies(model: mujoco.MjModel, palm: int) -> list[int]:
    """Bodies between world and palm that carry shapes, the base first."""
    chain: list[int] = []
    body = int(model.body_parentid[palm])
    while body != 0:
        chain.insert(0, body)
        body = int(model.body_parentid[body])
    return [b for b in chain if covered(model, b)]


def _joints_above(model: mujoco.MjModel, bodies: list[int]) -> list[int]:
    """How many joints carry each body."""
    counts = []
    for body in bodies:
        count = 0
        while body != 0:
            count += int(model.body_jntnum[body])
            body = int(model.body_parentid[body])
        counts.append(count)
    return counts


def _apart(model: mujoco.MjModel, robot: RobotSpec, spheres: list[Part]) -> Bool[np.ndarray, "s s"]:
    """Which spheres must not overlap.

    Those that do in the open posture are neighbours whose simplified shapes overlap always.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = robot.home
    mujoco.mj_kinematics(model, data)
    owner = np.array([sphere.body for sphere in spheres])
    local = np.array([sphere.start for sphere in spheres])
    at = data.xpos[owner] + np.einsum("sij,sj->si", data.xmat[owner].reshape(-1, 3, 3), local)
    radius = np.array([sphere.radius for sphere in spheres])
    gap = np.linalg.norm(at[:, None] - at, axis=-1) - radius[:, None] - radius
    return may_touch(model)[np.ix_(owner, owner)] & (gap > 0)
