"""The robot as the reaching controller sees it: joints, frames, capsules and points on its links.

Everything is read from the robot's description and its compiled MJCF. Fingers are the subtrees
below the palm, those of the grasp first; links with boxes are covered by small spheres.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.robot.kinematics import Kinematics
from mjx_grasp.robot.spec import RobotSpec

FINGERS = 3
# Of the frames: the three tip sites, then the three pad sites, then the palm site.
PALM = 2 * FINGERS
# Spheres that cover a box cut its corners by 0.73 of their radius at most.
_BOX_SPHERE_RADIUS = 0.008
# Palm spheres within a cube of this edge share a constraint, [m].
_PALM_CELL = 0.020
# An arm link with fewer joints than this above it cannot come near table or object.
_FEWEST_ARM_JOINTS = 4
# Arm links with this many joints between them can meet.
_APART = 4


@dataclass(frozen=True, eq=False)
class Solids:
    """Spheres swept along segments that are fixed to frames; a point has no length.

    The members of a group share constraints: one for the nearest point of all, and for segments
    one more for the nearest of either end. With the nearest point alone, a link beside a surface
    could rock: while one end is held back, a turn takes the other one in unchecked.
    """

    frame: Int[np.ndarray, " n"]
    start: Float[np.ndarray, "n 3"]  # m, in the frame
    end: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, " n"]  # m
    groups: Int[np.ndarray, "g k"]  # members, padded by repetition
    names: tuple[str, ...]  # of the groups

    @property
    def are_points(self) -> bool:
        """Whether no segment has a length."""
        return np.array_equal(self.start, self.end)

    @property
    def rows(self) -> int:
        """How many constraints they get against object or obstacles."""
        return len(self.groups) * (1 if self.are_points else 3)


@jax.tree_util.register_static
@dataclass(frozen=True, eq=False)
class ReachBody:
    """Static under jit. Joints are in the robot's order, the arm's before the hand's."""

    robot: RobotSpec
    kinematics: Kinematics
    moves: Bool[np.ndarray, "frames joints"]
    lower: Float[np.ndarray, " joints"]  # rad
    upper: Float[np.ndarray, " joints"]
    velocity_limit: Float[np.ndarray, " joints"]  # rad/s
    home: Float[np.ndarray, " joints"]  # rad
    arm: Bool[np.ndarray, " joints"]
    approach_axis: Float[np.ndarray, " 3"]  # palm frame
    opposing_axis: Float[np.ndarray, " 3"]
    grasping: Bool[np.ndarray, " joints"]  # of the three fingers
    hand_capsules: Solids
    palm_points: Solids
    arm_capsules: Solids
    # Pairs of hand capsules of different fingers, one row per pair of fingers.
    pairs: Int[np.ndarray, "rows k 2"]
    pair_names: tuple[str, ...]
    # Pairs of arm capsules that are not neighbours, one row per outer link.
    arm_pairs: Int[np.ndarray, "rows k 2"]


def reach_body(robot: RobotSpec) -> ReachBody:
    """Reads shapes, limits and kinematics of a robot.

    Raises:
        InputError: A link has a shape that is neither capsule, sphere, box nor cylinder, or the
            arm has a joint that is no hinge or slide.
    """
    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
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

    capsules = [(frame_of[b], *part) for b in finger_bodies for part in _cover(model, b)]
    capsule_body = [b for b in finger_bodies for _ in _cover(model, b)]
    links = [[n for n, b in enumerate(capsule_body) if b in finger] for finger in fingers]
    groups, names = [], []
    for finger, members in zip(fingers, links, strict=True):
        # The links next to the palm hardly move against it: they share a row with the next.
        outer = finger[2:]
        inner = [n for n in members if capsule_body[n] not in outer]
        parts = [inner, *([n for n in members if capsule_body[n] == b] for b in outer)]
        groups += [part for part in parts if part]
        names += [model.body(finger[-1]).name] * sum(bool(part) for part in parts)
    pairs, pair_names = [], []
    for i in range(len(fingers)):
        for j in range(i + 1, len(fingers)):
            pairs.append([(a, b) for a in links[i] for b in links[j]])
            pair_names.append(
                f"{model.body(fingers[i][-1]).name}/{model.body(fingers[j][-1]).name}"
            )

    points = [(frame_of[palm], *part) for part in _cover(model, palm)]
    if not points:
        raise InputError(
            "hand.palm_body", robot.hand.palm_body, "a body with a shape to keep clear"
        )
    cells = _cells(points)
    arm = [(frame_of[b], *part) for b in arm_bodies for part in _cover(model, b)]
    arm_body = [b for b in arm_bodies for _ in _cover(model, b)]
    depth = _joints_above(model, arm_body)
    far = [n for n in range(len(arm)) if depth[n] >= _FEWEST_ARM_JOINTS]
    if not far:
        raise InputError("arm.joints", robot.arm.joints, "an arm whose outer links have a shape")
    arm_pairs = [[(n, m) for m in range(len(arm)) if depth[m] <= depth[n] - _APART] for n in far]
    arm_pairs = [pairs for pairs in arm_pairs if pairs]
    joints = [model.joint(name) for name in robot.joints]
    return ReachBody(
        robot=robot,
        kinematics=kinematics,
        moves=kinematics.moves,
        lower=np.array([j.range[0] for j in joints], np.float32),
        upper=np.array([j.range[1] for j in joints], np.float32),
        velocity_limit=np.array(robot.velocity_limits, np.float32),
        home=np.array(robot.home, np.float32),
        arm=np.array([name in robot.arm.joints for name in robot.joints]),
        approach_axis=np.array(robot.hand.approach_axis, np.float32),
        opposing_axis=np.array(robot.hand.opposing_axis, np.float32),
        grasping=np.array([any(n in f.joints for f in robot.hand.fingers) for n in robot.joints]),
        hand_capsules=_solids(capsules, groups, tuple(names)),
        palm_points=_solids(points, cells, ("palm",) * len(cells)),
        arm_capsules=_solids(
            arm, [[n] for n in far], tuple(model.body(arm_body[n]).name for n in far)
        ),
        pairs=_padded(pairs),
        pair_names=tuple(pair_names),
        arm_pairs=_padded(arm_pairs) if arm_pairs else np.zeros((0, 1, 2), int),
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
    return [b for b in chain if _cover(model, b)]


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


def _touching(model: mujoco.MjModel, body: int) -> list[int]:
    """Shapes of a body that can touch something."""
    first = int(model.body_geomadr[body])
    geoms = range(first, first + int(model.body_geomnum[body]))
    return [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]


def _capsules(model: mujoco.MjModel, body: int) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Segments and radius of a body's round shapes; a cylinder by the capsule that encloses it."""
    found = []
    for geom in _touching(model, body):
        kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
        if kind == mujoco.mjtGeom.mjGEOM_BOX:  # see `_cover`
            continue
        if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            half, radius = 0.0, size[0]
        elif kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
            half, radius = size[1], size[0]
        else:
            name = model.geom(geom).name
            raise InputError("robot", f"geom {name} of another type", "capsules, spheres, boxes")
        along = half * _matrix(model.geom_quat[geom])[:, 2]
        found.append((model.geom_pos[geom] - along, model.geom_pos[geom] + along, float(radius)))
    return found


def _cover(model: mujoco.MjModel, body: int) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Small spheres just inside the surface of a body's boxes, and its round shapes."""
    found = _capsules(model, body)
    for geom in _touching(model, body):
        if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_BOX:
            continue
        size = model.geom_size[geom]
        radius = min(_BOX_SPHERE_RADIUS, float(size.min()))
        inner = size - radius
        steps = [np.linspace(-s, s, max(int(np.ceil(s / radius)), 1) + 1) for s in inner]
        grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
        grid = grid[np.any(np.abs(grid) >= inner - 1e-9, axis=1)]
        placed = model.geom_pos[geom] + grid @ _matrix(model.geom_quat[geom]).T
        found += [(p, p, radius) for p in placed]
    return found


def _cells(points: list) -> list[list[int]]:
    """The palm's points in groups of nearby ones, the cells of a grid.

    Were the members of a group far apart, the nearest one could change to one that a turn of the
    palm sweeps towards the object unchecked.
    """
    at = np.array([p[1] for p in points])
    extent = np.ptp(at, axis=0)
    parts = np.maximum(np.ceil(extent / _PALM_CELL), 1).astype(int)
    cell = np.minimum((parts * (at - at.min(axis=0)) / extent).astype(int), parts - 1)
    index = np.ravel_multi_index(tuple(cell.T), tuple(parts))
    return [list(np.flatnonzero(index == k)) for k in np.unique(index)]


def _padded(groups: list[list]) -> np.ndarray:
    longest = max(len(g) for g in groups)
    return np.array([[*g, *([g[0]] * (longest - len(g)))] for g in groups])


def _solids(parts: list, groups: list[list[int]], names: tuple[str, ...]) -> Solids:
    frame, start, end, radius = zip(*parts, strict=True)
    return Solids(
        frame=np.array(frame),
        start=np.array(start, np.float32),
        end=np.array(end, np.float32),
        radius=np.array(radius, np.float32),
        groups=_padded(groups),
        names=names,
    )


def _matrix(quat: np.ndarray) -> np.ndarray:
    mat = np.zeros(9)
    mujoco.mju_quat2Mat(mat, quat)
    return mat.reshape(3, 3)
