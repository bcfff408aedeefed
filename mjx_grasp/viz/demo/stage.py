"""The scene as it is filmed: the object's own mesh in its heatmap's colours, marks, a floor."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from mjx_grasp.heatmap.colours import score_colours
from mjx_grasp.sim.scene import OBJECT_BODY, TABLE_GEOM, Scene, scene_spec
from mjx_grasp.viz.heatmap import ANCHOR, THUMB, WRAP

FOCUS = "in_the_hand"
"""Body that a camera follows; it moves with the palm."""
_SHADES = 256
_AHEAD_M = 0.10  # of the palm, where the fingers are
_FLOOR_M = -0.35
_MARK_M, _ANCHOR_M = 0.0045, 0.0060
_OBSTACLE = [0.80, 0.33, 0.22, 0.85]
_TABLE, _FLOOR = [0.86, 0.83, 0.79, 1.0], [0.93, 0.94, 0.96, 1.0]


class Skin(NamedTuple):
    """The object's surface as it is coloured, and what is marked on it; object frame [m]."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    score: Float[np.ndarray, " v"]
    """in [0, 1]"""
    contacts: Float[np.ndarray, "3 3"]
    """of thumb, first and second wrap"""
    anchor: Float[np.ndarray, " 3"] | None
    obstacles: Float[np.ndarray, "k 4"] | None = None
    """spheres in the way, world frame: centre and radius [m]"""


def stage_model(scene: Scene, skin: Skin) -> mujoco.MjModel:
    """The scene's model with what is only seen; its coordinates are the same.

    Args:
        scene: Robot, table and one object.
        skin: How the object looks.
    """
    spec = scene_spec(scene.objects, scene.robot, scene.config)
    body = spec.body(OBJECT_BODY)
    for geom in body.geoms:
        geom.rgba = [*geom.rgba[:3], 0.0]
    _add_skin(spec, body, skin)
    for point, colour in zip(skin.contacts, (THUMB, WRAP, WRAP), strict=True):
        _add_ball(body, point, _opaque(colour), _MARK_M)
    if skin.anchor is not None:
        _add_ball(body, skin.anchor, _opaque(ANCHOR), _ANCHOR_M)
    for x, y, z, radius in [] if skin.obstacles is None else skin.obstacles.tolist():
        _add_ball(spec.worldbody, (x, y, z), _OBSTACLE, radius)
    spec.geom(TABLE_GEOM).rgba = _TABLE
    _add_floor(spec)
    palm = spec.body(scene.robot.hand.palm_body)
    palm.add_body(name=FOCUS, pos=[_AHEAD_M * float(x) for x in scene.robot.hand.approach_axis])
    return spec.compile()


def _add_skin(spec: mujoco.MjSpec, body: mujoco.MjsBody, skin: Skin) -> None:
    """Scores as coordinates of a texture that is the scale: colours vary as scores do."""
    scale = score_colours(np.linspace(0.0, 1.0, _SHADES))
    texture = spec.add_texture(
        name="scale", type=mujoco.mjtTexture.mjTEXTURE_2D, width=_SHADES, height=4, nchannel=3
    )
    texture.data = np.ascontiguousarray(np.tile(scale, (4, 1, 1))).tobytes()
    material = spec.add_material(name="scale", specular=0.25, shininess=0.35)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "scale"
    share = np.clip(skin.score, 0.0, 1.0) * (_SHADES - 1) / _SHADES + 0.5 / _SHADES
    coordinates = np.stack([share, np.full(len(share), 0.5)], axis=1)
    mesh = spec.add_mesh(
        name="skin",
        uservert=np.asarray(skin.vertices, float).ravel(),
        userface=np.asarray(skin.faces, np.int32).ravel(),
        usertexcoord=coordinates.ravel(),
    )
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="skin", material="scale", **_ONLY_SEEN)


def _opaque(colour: tuple[int, int, int]) -> list[float]:
    return [*(c / 255.0 for c in colour), 1.0]


def _add_ball(
    body: mujoco.MjsBody, centre: Iterable[float], rgba: list[float], radius: float
) -> None:
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[radius, 0, 0],
        pos=[float(x) for x in centre],
        rgba=rgba,
        **_ONLY_SEEN,
    )


def _add_floor(spec: mujoco.MjSpec) -> None:
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[6, 6, 0.1],
        pos=[0, 0, _FLOOR_M],
        rgba=_FLOOR,
        **_ONLY_SEEN,
    )


_ONLY_SEEN = {"contype": 0, "conaffinity": 0, "mass": 0.0, "group": 1}
