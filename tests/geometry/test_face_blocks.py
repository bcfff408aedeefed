"""Blocks of faces: every face is in them, boxes hold what is below, and the nearest are found."""

import numpy as np
import pytest
import trimesh

from mjx_grasp.geometry.closest import closest_on_mesh
from mjx_grasp.geometry.face_blocks import WIDTH, face_blocks


def mesh_of(faces, seed=0):
    """Scattered triangles, a few of them without an area."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-0.1, 0.1, (faces, 1, 3)) + rng.normal(0, 0.01, (faces, 3, 3))
    corners[::7, 2] = 0.5 * (corners[::7, 0] + corners[::7, 1])
    corners[::11] = corners[::11, :1]
    points = corners.reshape(-1, 3).astype(np.float32)
    return points, np.arange(3 * faces, dtype=np.int32).reshape(-1, 3)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 63, 64, 65, 513, 4800])
def test_every_face_is_in_a_slot_and_little_is_there_twice(count):
    found = face_blocks(*mesh_of(count))
    assert set(found.face) == set(range(count))
    assert len(found.face) == WIDTH * len(found.blocks) <= WIDTH + 1.25 * count


@pytest.mark.parametrize("count", [3, 70, 513, 4800])
def test_a_box_holds_what_is_below_it_and_each_block_is_below_one(count):
    points, faces = mesh_of(count)
    found = face_blocks(points, faces)
    seen = []

    def corners_below(node):
        below = []
        for k in range(WIDTH):
            lower, upper = found.boxes[node, :3, k], found.boxes[node, 3:, k]
            if lower[0] > upper[0]:
                continue
            child = found.first[node]
            if child >= 0:
                inside = corners_below(child + k)
            else:
                block = -1 - child + k
                seen.append(block)
                inside = points[faces[found.face[WIDTH * block : WIDTH * (block + 1)]]]
                inside = inside.reshape(-1, 3)
            assert np.all(inside >= lower) and np.all(inside <= upper)
            below.append(inside)
        return np.concatenate(below)

    corners_below(0)
    assert sorted(seen) == list(range(len(found.blocks)))


@pytest.mark.parametrize("count", [1, 9, 200, 3000])
@pytest.mark.parametrize("known", [True, False])
def test_the_nearest_face_is_as_near_as_any(count, known):
    from mjx_grasp.geometry.bvh import MeshTrees

    points, faces = mesh_of(count)
    trees = MeshTrees([points], [faces])
    rng = np.random.default_rng(1)
    queries = rng.uniform(-0.15, 0.15, (3, 2, 50, 3)).astype(np.float32).reshape(-1, 3)
    near = rng.integers(0, count, 50) if known else np.full(50, -1)
    owner = np.zeros(50, np.int32)
    found = trees.nearest_faces(*map(as_jax, (owner, queries, near.astype(np.int32))), 2, 50)
    triangles = points[faces][np.asarray(found)].astype(float)
    distance = np.linalg.norm(
        trimesh.triangles.closest_point(triangles + 1e-12, queries.astype(float)) - queries, axis=1
    )
    best = closest_on_mesh(as_jax(queries), as_jax(points[faces])).distance
    sound = np.linalg.norm(np.cross(*np.diff(triangles, axis=1).swapaxes(0, 1)), axis=1) > 1e-9
    assert np.allclose(distance[sound], best[sound], atol=2e-7)


def as_jax(array):
    import jax.numpy as jnp

    return jnp.asarray(array)


def test_several_meshes_keep_their_faces_apart():
    from mjx_grasp.geometry.bvh import MeshTrees

    meshes = [mesh_of(40, seed=1), mesh_of(300, seed=2), mesh_of(5, seed=3)]
    together = MeshTrees(*map(list, zip(*meshes, strict=True)))
    queries = np.random.default_rng(2).uniform(-0.1, 0.1, (60, 3)).astype(np.float32)
    owner = np.repeat(np.arange(3, dtype=np.int32), 20)
    none = as_jax(np.full(60, -1, np.int32))
    found = np.asarray(together.nearest_faces(as_jax(owner), as_jax(queries), none, 1, 60))
    for k, first in enumerate((0, 40, 340)):
        alone = MeshTrees([meshes[k][0]], [meshes[k][1]]).nearest_faces(
            *map(as_jax, (np.zeros(20, np.int32), queries[owner == k])), none[:20], 1, 20
        )
        assert np.array_equal(found[owner == k], first + np.asarray(alone))
