"""From a mesh to its grasp-affordance heatmap (method §1)."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mjx_grasp.errors import InputError
from mjx_grasp.geometry.closest import closest_on_mesh
from mjx_grasp.geometry.curvature import long_axes
from mjx_grasp.geometry.mesh import (
    face_normals_and_areas,
    interpolate_normals,
    mass_properties,
    vertex_normals,
)
from mjx_grasp.geometry.rays import farthest_hit
from mjx_grasp.geometry.vectors import norm, unit
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.heatmap.scores import (
    anchor_score,
    coherence_score,
    friction_score,
    separation_score,
    width_score,
)
from mjx_grasp.heatmap.steering import Heatmap, weigh

if TYPE_CHECKING:
    from mjx_grasp.objects.model import ObjectModel
    from mjx_grasp.robot.spec import HandSpec

# Arrays are padded to multiples of this, so that meshes of similar size share one compilation.
_BUCKET = 512


@partial(jax.jit, static_argnames="config")
def _candidates(vertices, faces, face_count, com, axes, diagonal, span, friction, config):
    """Steps 1–5 for all vertices, except the final product with S_COM."""
    triangles = vertices[faces]
    face_normals, areas = face_normals_and_areas(triangles)
    # Padding faces repeat a real one: harmless to rays and nearest points, but they must not
    # count twice in the normals and the curvature.
    areas = jnp.where(jnp.arange(faces.shape[0]) < face_count, areas, 0.0)
    normals = vertex_normals(face_normals, areas, faces, vertices.shape[0])
    has_normal = jnp.any(normals != 0.0, axis=-1)

    hits = farthest_hit(
        vertices, -normals, triangles, config.min_ray_fraction * diagonal, config.tile
    )
    corners = triangles[hits.face] * hits.barycentric[:, :, None]
    opposing = corners[:, 0] + corners[:, 1] + corners[:, 2]
    opposing_normals = interpolate_normals(normals, faces, hits.face, hits.barycentric)
    axis_l = long_axes(
        opposing,
        opposing_normals,
        (triangles[:, 0] + triangles[:, 1] + triangles[:, 2]) / 3.0,
        face_normals,
        areas,
        axes,
        radius=config.curvature_radius,
        min_faces=config.curvature_min_faces,
        isotropy=config.curvature_isotropy,
        flatness=config.curvature_flatness,
        parallel_angle=config.parallel_angle,
        tile=config.tile,
    )

    # [h, side, v, 3]: every offset on both sides, projected to the mesh in one go.
    offsets = jnp.asarray(config.wrap_offsets, vertices.dtype)
    sides = jnp.asarray([1.0, -1.0], vertices.dtype)
    seeds = opposing + (offsets[:, None] * sides)[:, :, None, None] * axis_l
    nearest = closest_on_mesh(seeds.reshape(-1, 3), triangles, config.tile)
    contacts = nearest.point.reshape(seeds.shape)
    contact_normals = interpolate_normals(
        normals, faces, nearest.face, nearest.barycentric
    ).reshape(seeds.shape)

    centre = 0.5 * (contacts[:, 0] + contacts[:, 1])
    reach = centre - vertices
    width = norm(reach)
    axis_g = unit(reach)
    pushes = friction_score(-axis_g[:, None], -contact_normals, friction)
    terms = {
        "width": width_score(width, span, config.width_sigma),
        "thumb": friction_score(axis_g, -normals, friction),
        "wrap": 0.5 * (pushes[:, 0] + pushes[:, 1]),
        "coherence": coherence_score(
            contact_normals[:, 0], contact_normals[:, 1], config.coherence_angle
        ),
        "com": anchor_score(com, vertices, axis_g, config.com_sigma),
        "separation": separation_score(contacts[:, 0], contacts[:, 1], config.full_separation),
    }
    without_com = (
        terms["width"] * terms["thumb"] * terms["wrap"] * terms["coherence"] * terms["separation"]
    )
    valid = hits.hit & has_normal & (width > config.min_ray_fraction * diagonal)
    valid &= jnp.all(jnp.any(contact_normals != 0.0, axis=-1), axis=1)
    without_com = jnp.where(valid, without_com, 0.0)

    # argmax takes the first: the smallest h among those that tie with the best.
    scores = without_com * terms["com"]
    ties = scores >= (1.0 - config.tie_tolerance) * jnp.max(scores, axis=0)
    best = jnp.argmax(ties, axis=0)
    rows = jnp.arange(vertices.shape[0])
    kept = valid[best, rows]
    up = jnp.asarray([0.0, 0.0, 1.0], vertices.dtype)
    return Heatmap(
        vertices=vertices,
        normals=jnp.where(has_normal[:, None], normals, up),
        score=jnp.zeros_like(width[0]),
        score_without_com=without_com[best, rows],
        thumb=vertices,
        opposing=opposing,
        long_axis=axis_l,
        offset=offsets[best],
        wrap=jnp.moveaxis(contacts, 2, 1)[best, rows],
        wrap_normals=jnp.moveaxis(contact_normals, 2, 1)[best, rows],
        centre=centre[best, rows],
        axis=axis_g[best, rows],
        width=width[best, rows],
        valid=kept,
        terms={name: jnp.where(kept, term[best, rows], 0.0) for name, term in terms.items()},
    )


def _checked(vertices, faces):
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
        raise InputError("vertices", f"shape {vertices.shape}", "finite numbers [v, 3] in m")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise InputError("faces", f"{faces.dtype} {faces.shape}", "integers [f, 3]")
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError("faces", "no faces, or a vertex that is not there", "indices of vertices")
    return vertices, faces.astype(np.int32)


def _padded(array: np.ndarray, fill: np.ndarray) -> np.ndarray:
    short = -len(array) % _BUCKET
    return np.concatenate([array, np.repeat(fill[None], short, axis=0)])


def compute_heatmap(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    com: Float[np.ndarray, " 3"] | None,
    span: tuple[float, float],
    scoring_friction: float,
    config: HeatmapConfig | None = None,
) -> Heatmap:
    """The grasp-affordance heatmap of a mesh (method §1).

    Args:
        vertices: Mesh vertices in [m].
        faces: Their indices, wound so that normals point outwards.
        com: Centre of mass in the mesh's frame, [m]; None takes that of uniform density.
        span: Narrowest and widest grasp of the hand, [m].
        scoring_friction: μ of the hand description, separate from the scene's.
        config: Settings; the defaults if None.

    Returns:
        One candidate per vertex, in the frame of the mesh.

    Raises:
        InputError: The mesh is not one, or a setting cannot work.
    """
    config = config or HeatmapConfig()
    vertices, faces = _checked(vertices, faces)
    if not 0 < span[0] < span[1]:
        raise InputError("span", span, "two lengths in ascending order [m]")
    if not scoring_friction > 0:
        raise InputError("scoring_friction", scoring_friction, "a positive number")
    properties = mass_properties(vertices, faces)
    com = properties.centre if com is None else np.asarray(com, np.float64)

    # Worked on around its own centre: float32 keeps its digits wherever the mesh lies.
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    origin = 0.5 * (low + high)
    f32 = partial(np.asarray, dtype=np.float32)
    heatmap = _candidates(
        _padded(f32(vertices - origin), f32(low - origin)),
        _padded(faces, faces[-1]),
        np.int32(len(faces)),
        f32(com - origin),
        f32(properties.axes),
        f32(np.linalg.norm(high - low)),
        f32(span),
        f32(scoring_friction),
        config,
    )
    heatmap = jax.tree.map(lambda x: x[: len(vertices)], heatmap)
    shift = {
        name: getattr(heatmap, name) + f32(origin)
        for name in ("vertices", "thumb", "opposing", "wrap", "centre")
    }
    heatmap = heatmap._replace(**shift)
    score = weigh(
        heatmap.score_without_com,
        heatmap.thumb,
        heatmap.axis,
        f32(com),
        f32(config.com_sigma),
    )
    return heatmap._replace(score=score)


def heatmap_of(obj: ObjectModel, hand: HandSpec, config: HeatmapConfig | None = None) -> Heatmap:
    """The heatmap of an object for a hand, in the object frame; see :func:`compute_heatmap`."""
    mesh = obj.mesh
    return compute_heatmap(
        np.asarray(mesh.vertices),
        np.asarray(mesh.faces),
        obj.com,
        hand.span,
        hand.scoring_friction,
        config,
    )
