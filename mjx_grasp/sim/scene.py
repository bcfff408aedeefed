"""The scene: robot, table, and one free body that carries the convex pieces of every object.

All objects of a scene are geoms of one *union body*, so that one compiled model serves them all:
a world uses the pieces of its own object and parks the others far above, and swaps the body's
inertial fields. `Scene.object_fields` holds what has to be swapped, one row per object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import mujoco
import numpy as np
from jaxtyping import Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.objects.model import ObjectModel
from mjx_grasp.records.settings import (
    Count,
    Finite,
    Interval,
    NonNegative,
    Positive,
    Range,
    Settings,
    Share,
)
from mjx_grasp.robot.description import RobotSpec
from mjx_grasp.robot.mjcf import robot_mjspec

OBJECT_BODY = "object"
OBJECT_JOINT = "object_free"
TABLE_GEOM = "table"

# The bit plan of the robot's MJCF: 1 hand, 2 arm, 4 object, 8 table.
_OBJECT_BIT, _TABLE_BIT, _ROBOT_BITS = 4, 8, 1 | 2
_PARK_HEIGHT_M = 50.0
_NUM_FORCE_FIELDS = 4  # a contact sensor's "found" (1) and "force" (3)


@dataclass(frozen=True)
class SceneConfig(Settings):
    """Physics of the scene (method §0 and §5)."""

    physics_dt: Annotated[float, Range(0, 0.01, above=True)] = 0.002
    """physics step [s]"""
    friction: tuple[Positive, NonNegative, NonNegative] = (0.8, 0.02, 1e-4)
    """sliding [-], torsional [m] and rolling [m] friction of every contact with the object; the
    sliding one where a world is given none of its own, as trainings do (`StartNoise.friction`)"""
    solref: tuple[Positive, Positive] = (0.005, 1.0)
    """contact time constant [s] and damping ratio [-]"""
    solimp: tuple[Share, Share, Positive] = (0.95, 0.99, 0.001)
    """contact impedance: two levels [-] and the width between them [m]"""
    impratio: Positive = 1.0
    """how much stiffer friction is than the normal force; friction gives way a little for as long
    as it bears a load, the less the larger this is [-]"""
    solver_iterations: Count = 20
    """most Newton iterations of a step; on a GPU all worlds wait for the one that needs most [-]"""
    line_search_iterations: Count = 20
    """most line-search steps of a Newton iteration [-]"""
    finger_torque: Positive = 1.0
    """factor on the torque limits of the finger actuators [-]"""
    fix_idle_fingers: bool = False
    """whether fingers that take no part in a grasp are rigid: faster, and for training only;
    evaluation moves every joint"""
    table_centre: tuple[Finite, Finite] = (0.35, 0.0)
    """centre of the table top in the arm's base frame [m]"""
    table_half_size: tuple[Positive, Positive, Positive] = (0.65, 0.70, 0.02)
    """half extents of the table, a finite box: a plane would be hit by parked pieces [m]"""


@dataclass(frozen=True)
class ObjectArea(Settings):
    """Where on the table objects lie (method §0), in the arm's base frame."""

    x: Interval = (0.40, 0.65)
    """in front of the arm [m]"""
    y: Interval = (-0.25, 0.25)
    """to its sides [m]"""


@dataclass(frozen=True)
class ObjectFields:
    """Model fields that differ between worlds, one row per object of the scene."""

    geom_pos: Float[np.ndarray, "k geom 3"]
    """unused pieces are parked [m]"""
    body_mass: Float[np.ndarray, "k body"]
    """[kg]"""
    body_subtreemass: Float[np.ndarray, "k body"]
    """[kg]"""
    body_ipos: Float[np.ndarray, "k body 3"]
    """[m]"""
    body_iquat: Float[np.ndarray, "k body 4"]
    """[-]"""
    body_inertia: Float[np.ndarray, "k body 3"]
    """[kg m²]"""
    body_invweight0: Float[np.ndarray, "k body 2"]
    """[1/kg] and [1/(kg m²)]"""

    NAMES = (
        "geom_pos",
        "body_mass",
        "body_subtreemass",
        "body_ipos",
        "body_iquat",
        "body_inertia",
        "body_invweight0",
    )


@dataclass(frozen=True)
class Addresses:
    """Where the compiled model keeps what the rest of the package reads."""

    robot_qpos: Int[np.ndarray, " joint"]
    """in robot order: arm, then hand"""
    robot_dof: Int[np.ndarray, " joint"]
    robot_ctrl: Int[np.ndarray, " joint"]
    object_qpos: Int[np.ndarray, "7"]
    object_dof: Int[np.ndarray, "6"]
    object_body: int
    object_geoms: Int[np.ndarray, " piece"]
    palm_site: int
    pad_sites: Int[np.ndarray, " finger"]
    tip_force: Int[np.ndarray, "finger 4"]
    """in the sensor data: found, then the force along x, y, z"""
    finger_force: Int[np.ndarray, "finger 4"]
    """the same, of whole fingers"""


@dataclass(frozen=True)
class Scene:
    """A compiled scene and the tables that turn it into a scene of one of its objects."""

    model: mujoco.MjModel
    robot: RobotSpec
    objects: tuple[ObjectModel, ...]
    config: SceneConfig
    addresses: Addresses
    object_fields: ObjectFields = field(repr=False)

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of the objects, in the order of the object index."""
        return tuple(o.name for o in self.objects)

    def object_index(self, name: str) -> int:
        """The index of an object in this scene.

        Raises:
            InputError: The scene has no such object.
        """
        if name not in self.object_names:
            raise InputError("object", name, f"one of {', '.join(self.object_names)}")
        return self.object_names.index(name)


def build_scene(
    objects: Sequence[ObjectModel], robot: RobotSpec, config: SceneConfig | None = None
) -> Scene:
    """Compiles robot, table and objects into one model.

    With one object the free body carries that object's own inertia. With several it carries a
    template that `Scene.object_fields` replaces per world.

    Raises:
        InputError: No object, two of the same name, or a factor on a torque limit where there is
            none.
    """
    config = config or SceneConfig()
    if config.fix_idle_fingers:
        robot = robot.without_idle_fingers()
    names = [o.name for o in objects]
    if not names or len(set(names)) != len(names):
        raise InputError("objects", names, "one or more objects of different names")
    model = scene_spec(objects, robot, config).compile()
    # MuJoCo would take a piece compiled at the body's origin to be there in every world.
    pieces = model.geom_bodyid == model.body(OBJECT_BODY).id
    model.geom_sameframe[pieces] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    return Scene(
        model=model,
        robot=robot,
        objects=tuple(objects),
        config=config,
        addresses=_addresses(model, robot),
        object_fields=_object_fields(model, objects, robot, config),
    )


def scene_spec(
    objects: Sequence[ObjectModel], robot: RobotSpec, config: SceneConfig
) -> mujoco.MjSpec:
    """Robot, table and objects before they are compiled, to add things to that are only seen.

    Args:
        objects: What the free body holds; of several it has a template's inertia.
        robot: What grasps.
        config: Physics.

    Raises:
        InputError: The torque limits of fingers are to differ, and one has none.
    """
    template = len(objects) > 1
    spec = robot_mjspec(robot)
    spec.modelname = "mjx_grasp"
    _limit_fingers(spec, robot, config.finger_torque)
    _set_options(spec, config)
    _add_table(spec, config)
    _add_object_body(spec, objects, config, template)
    _add_force_sensors(spec, robot)
    return spec


def _set_options(spec: mujoco.MjSpec, config: SceneConfig) -> None:
    spec.option.timestep = config.physics_dt
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.iterations = config.solver_iterations
    spec.option.ls_iterations = config.line_search_iterations
    spec.option.impratio = config.impratio


def _limit_fingers(spec: mujoco.MjSpec, robot: RobotSpec, factor: float) -> None:
    """Scales the torque limits of all the hand's actuators; the arm keeps its own."""
    for name in robot.hand.joints:
        actuator = spec.actuator(name)
        if factor != 1.0 and not np.any(actuator.forcerange):
            limit = f"1, as the MJCF gives {name} no torque limit"
            raise InputError("SceneConfig.finger_torque", factor, limit)
        actuator.forcerange *= factor


def _add_table(spec: mujoco.MjSpec, config: SceneConfig) -> None:
    x, y = config.table_centre
    spec.worldbody.add_geom(
        name=TABLE_GEOM,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[x, y, -config.table_half_size[2]],
        size=list(config.table_half_size),
        contype=_TABLE_BIT,
        conaffinity=_ROBOT_BITS | _OBJECT_BIT,
        condim=4,
        friction=list(config.friction),
        solref=list(config.solref),
        solimp=[*config.solimp, 0.5, 2.0],
        rgba=[0.55, 0.50, 0.45, 1.0],
    )


def _add_object_body(
    spec: mujoco.MjSpec, objects: Sequence[ObjectModel], config: SceneConfig, template: bool
) -> None:
    body = spec.worldbody.add_body(name=OBJECT_BODY, pos=[0.5, 0.0, 0.3])
    body.add_joint(name=OBJECT_JOINT, type=mujoco.mjtJoint.mjJNT_FREE)
    body.explicitinertial = True
    if template:
        # Off-centre and rotated, so that the mass matrix is compiled with its off-diagonals.
        body.mass = 0.3
        body.ipos = [0.001, 0.002, 0.003]
        body.fullinertia = [5e-4, 6e-4, 7e-4, 5e-5, 4e-5, 3e-5]
    else:
        inertia = objects[0].inertia
        body.mass = objects[0].mass
        body.ipos = list(objects[0].com)
        body.fullinertia = [
            inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        ]
    # Apart from the fingertips' red, green and blue.
    colours = np.array([[0.95, 0.76, 0.30, 1], [0.62, 0.48, 0.78, 1], [0.85, 0.72, 0.58, 1]])
    for k, obj in enumerate(objects):
        for i, piece in enumerate(obj.pieces):
            common = dict(
                name=f"{obj.name}_{i}",
                contype=_OBJECT_BIT,
                conaffinity=_ROBOT_BITS | _TABLE_BIT,
                # The object's contact settings rule: one number per world sets the friction.
                priority=1,
                condim=4,
                friction=list(config.friction),
                solref=list(config.solref),
                solimp=[*config.solimp, 0.5, 2.0],
                mass=0.0,
                rgba=list(colours[k % len(colours)]),
            )
            if piece.kind == "sphere":
                body.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_SPHERE,
                    size=[piece.radius, 0, 0],
                    pos=list(piece.pos),
                    **common,
                )
            else:
                mesh = f"{obj.name}_{i}"
                spec.add_mesh(name=mesh, uservert=np.asarray(piece.vertices, float).ravel())
                body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, **common)


def _add_force_sensors(spec: mujoco.MjSpec, robot: RobotSpec) -> None:
    """Net contact force with the object, world frame, per fingertip and per whole finger."""
    data = mujoco.mjtConDataField
    found_and_force = 1 << int(data.mjCONDATA_FOUND) | 1 << int(data.mjCONDATA_FORCE)
    net_force = 3  # reduce="netforce"
    for finger in robot.hand.fingers:
        for name, kind, target in (
            (f"{finger.name}_tip_force", mujoco.mjtObj.mjOBJ_GEOM, finger.tip_geom),
            (f"{finger.name}_force", mujoco.mjtObj.mjOBJ_XBODY, finger.bodies[0]),
        ):
            spec.add_sensor(
                name=name,
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=kind,
                objname=target,
                reftype=mujoco.mjtObj.mjOBJ_BODY,
                refname=OBJECT_BODY,
                intprm=[found_and_force, net_force, 1],
            )


def _addresses(model: mujoco.MjModel, robot: RobotSpec) -> Addresses:
    joints = [model.joint(n) for n in robot.joints]
    actuators = [model.actuator(n).id for n in robot.joints]
    free = model.joint(OBJECT_JOINT)
    body = model.body(OBJECT_BODY)

    def sensor(name: str) -> np.ndarray:
        return int(model.sensor(name).adr[0]) + np.arange(_NUM_FORCE_FIELDS)

    fingers = robot.hand.fingers
    return Addresses(
        robot_qpos=np.array([int(j.qposadr[0]) for j in joints]),
        robot_dof=np.array([int(j.dofadr[0]) for j in joints]),
        robot_ctrl=np.array(actuators),
        object_qpos=int(free.qposadr[0]) + np.arange(7),
        object_dof=int(free.dofadr[0]) + np.arange(6),
        object_body=int(body.id),
        object_geoms=int(body.geomadr[0]) + np.arange(int(body.geomnum[0])),
        palm_site=model.site(robot.hand.palm_site).id,
        pad_sites=np.array([model.site(f.pad_site).id for f in fingers]),
        tip_force=np.stack([sensor(f"{f.name}_tip_force") for f in fingers]),
        finger_force=np.stack([sensor(f"{f.name}_force") for f in fingers]),
    )


def _object_fields(
    model: mujoco.MjModel, objects: Sequence[ObjectModel], robot: RobotSpec, config: SceneConfig
) -> ObjectFields:
    """Body fields from each object's own compiled scene, piece positions from the union's."""
    singles = [scene_spec([o], robot, config).compile() for o in objects]
    owner = np.concatenate([np.full(len(o.pieces), k) for k, o in enumerate(objects)])
    pieces = int(model.body(OBJECT_BODY).geomadr[0]) + np.arange(len(owner))
    geom_pos = np.repeat(model.geom_pos[None], len(objects), axis=0)
    for k in range(len(objects)):
        # Added to the compiled position: a mesh geom has an offset of its own.
        geom_pos[k, pieces[owner != k], 2] += _PARK_HEIGHT_M
    body = {
        name: np.stack([getattr(single, name) for single in singles])
        for name in ObjectFields.NAMES
        if name.startswith("body_")
    }
    return ObjectFields(geom_pos=geom_pos, **body)
