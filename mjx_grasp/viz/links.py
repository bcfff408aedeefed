"""The geoms of a MuJoCo model as triangles, body by body: what a browser can draw."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float, UInt8

from mjx_grasp.errors import InputError

_SIDES = 24
"""Of what is round."""


_LAST_SHOWN = 2
"""Group of geoms; those after it MuJoCo's own viewer hides too."""


class Link(NamedTuple):
    """A part of a body that has one colour."""

    body: int
    mesh: trimesh.Trimesh
    """in the frame of the body [m]"""
    colour: UInt8[np.ndarray, " 3"]


def links(model: mujoco.MjModel, bodies: Iterable[int]) -> list[Link]:
    """The visible geoms of some bodies, those of one colour joined.

    Args:
        model: The model.
        bodies: Their indices.

    Raises:
        InputError: A geom of a kind that has no surface of its own, such as a plane.
    """
    found = []
    for body in bodies:
        first = int(model.body_geomadr[body])
        shapes: dict[tuple[int, ...], list[trimesh.Trimesh]] = {}
        for geom in range(first, first + int(model.body_geomnum[body])):
            if model.geom_rgba[geom, 3] > 0 and model.geom_group[geom] <= _LAST_SHOWN:
                colour = np.round(255 * model.geom_rgba[geom, :3]).astype(int)
                shapes.setdefault(tuple(colour.tolist()), []).append(geom_mesh(model, geom))
        for colour_of, meshes in shapes.items():
            joined = trimesh.util.concatenate(meshes)
            assert isinstance(joined, trimesh.Trimesh)
            found.append(Link(body, joined, np.array(colour_of, np.uint8)))
    return found


def geom_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    """The surface of a geom in the frame of its body [m].

    Args:
        model: The model.
        geom: Its index.

    Raises:
        InputError: A kind that has no surface of its own.
    """
    kind = int(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = _of_asset(model, int(model.geom_dataid[geom]))
    elif kind in _PRIMITIVES:
        mesh = _PRIMITIVES[kind](np.asarray(model.geom_size[geom], float))
    else:
        name = f"geom {model.geom(geom).name or geom}"
        raise InputError(name, mujoco.mjtGeom(kind).name, "a solid or a mesh")
    pose, R = np.eye(4), np.zeros(9)
    mujoco.mju_quat2Mat(R, model.geom_quat[geom])
    pose[:3, :3], pose[:3, 3] = R.reshape(3, 3), model.geom_pos[geom]
    return mesh.apply_transform(pose)


def _of_asset(model: mujoco.MjModel, mesh: int) -> trimesh.Trimesh:
    v, f = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
    vertices = model.mesh_vert[v : v + int(model.mesh_vertnum[mesh])]
    faces = model.mesh_face[f : f + int(model.mesh_facenum[mesh])]
    return trimesh.Trimesh(vertices.copy(), faces.copy(), process=False)


def _ellipsoid(size: Float[np.ndarray, " 3"]) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=3).apply_scale(size)


_PRIMITIVES: dict[int, Callable[[Float[np.ndarray, " 3"]], trimesh.Trimesh]] = {
    int(mujoco.mjtGeom.mjGEOM_BOX): lambda size: trimesh.creation.box(extents=2 * size),
    int(mujoco.mjtGeom.mjGEOM_SPHERE): lambda size: _ellipsoid(np.repeat(size[:1], 3)),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): _ellipsoid,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): lambda size: trimesh.creation.cylinder(
        size[0], 2 * size[1], sections=_SIDES
    ),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): lambda size: trimesh.creation.capsule(
        2 * size[1], size[0], count=[_SIDES, _SIDES]
    ),
}
"""Of MuJoCo's sizes, around the geom's own centre."""
