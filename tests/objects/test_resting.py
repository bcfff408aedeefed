"""Resting poses: solid angles and toppling by formula, and MuJoCo, in which they have to stay."""

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mjx_grasp.objects.convex import Piece
from mjx_grasp.objects.hulls import reduced_hull
from mjx_grasp.objects.inertia import mass_properties
from mjx_grasp.objects.parametric import stand_in
from mjx_grasp.objects.resting import RestingConfig, resting_poses, rotate

HALF = np.array([0.04, 0.03, 0.05])


def hull_of(mesh):
    vertices = reduced_hull(np.asarray(mesh.vertices))
    return Piece("hull", vertices.mean(axis=0), 0.0, vertices)


def sharp_box(half=HALF):
    return hull_of(trimesh.creation.box(extents=2 * np.asarray(half)))


def turned(pose, points):
    return Rotation.from_quat(pose.quat, scalar_first=True).apply(points)


def down(pose):
    """The body direction that points down."""
    return Rotation.from_quat(pose.quat, scalar_first=True).inv().apply([0.0, 0.0, -1.0])


def face_share(a, b, d):
    """Of the sphere of directions: a rectangle of sides a and b seen from d above its middle."""
    return np.arctan(a * b / (2 * d * np.sqrt(4 * d**2 + a**2 + b**2))) / np.pi


@pytest.mark.parametrize("half", [HALF, (0.03, 0.03, 0.03), (0.02, 0.045, 0.09)])
def test_a_box_rests_on_its_six_faces_by_solid_angle(half):
    half = np.asarray(half)
    config = RestingConfig(min_probability=0.0)
    poses = resting_poses((sharp_box(half),), np.zeros(3), config)
    assert len(poses) == 6
    for pose in poses:
        axis = int(np.argmax(np.abs(down(pose))))
        np.testing.assert_allclose(np.abs(down(pose)[axis]), 1.0, atol=1e-9)
        assert pose.height == pytest.approx(half[axis])
        a, b = 2 * np.delete(half, axis)
        assert pose.probability == pytest.approx(face_share(a, b, half[axis]), abs=1e-6)
    assert len({tuple(np.round(down(pose))) for pose in poses}) == 6


@pytest.mark.parametrize("name", ["foam_brick", "sugar_box", "pudding_box"])
def test_a_rounded_box_rests_on_opposite_faces_alike(name):
    # A hull of 64 vertices cuts corners of flat faces by tenths of a millimetre; the ridge that
    # this leaves must not make a face unstable.
    mesh = stand_in(name)
    poses = resting_poses((hull_of(mesh),), np.zeros(3))
    found = {tuple(np.round(down(pose))): pose.probability for pose in poses}
    assert len(found) == len(poses)
    broadest = int(np.argmin(mesh.extents))
    exact = face_share(*np.delete(mesh.extents, broadest), mesh.extents[broadest] / 2)
    for axis in np.argsort(mesh.extents)[:2]:
        up, low = found[tuple(np.eye(3)[axis])], found[tuple(-np.eye(3)[axis])]
        assert up == pytest.approx(low, rel=0.1)
        if axis == broadest:
            assert up == pytest.approx(exact, rel=0.1)


@pytest.mark.parametrize("name", ["tomato_soup_can", "master_chef_can", "tuna_fish_can"])
def test_a_can_stands_and_lies(name):
    # Its side makes many poses, most of them more probable than standing: they must not crowd it
    # out.
    mesh = stand_in(name)
    poses = resting_poses((hull_of(mesh),), np.zeros(3))
    radius, height = mesh.extents[0] / 2, mesh.extents[2]
    exact = 0.5 * (1.0 - 1.0 / np.hypot(1.0, 2 * radius / height))
    for direction in (-1.0, 1.0):
        standing = [p for p in poses if direction * down(p)[2] > 0.99]
        assert len(standing) == 1
        assert standing[0].probability == pytest.approx(exact, rel=0.15)
        assert standing[0].height == pytest.approx(height / 2, abs=0.0005)
    lying = [p for p in poses if abs(down(p)[2]) < 0.05]
    assert sum(p.probability for p in lying) == pytest.approx(1.0 - 2 * exact, abs=0.1)


@pytest.mark.parametrize("name", ["foam_brick", "tomato_soup_can", "mug", "banana", "apple"])
def test_every_pose_puts_the_lowest_point_on_the_table(name):
    mesh = stand_in(name)
    piece = hull_of(mesh)
    com, _ = mass_properties(mesh, 1.0)
    poses = resting_poses((piece,), com)
    assert poses
    for pose in poses:
        assert np.linalg.norm(pose.quat) == pytest.approx(1.0)
        assert turned(pose, piece.vertices)[:, 2].min() + pose.height == pytest.approx(0, abs=1e-9)
    shares = [pose.probability for pose in poses]
    assert shares == sorted(shares, reverse=True)
    assert min(shares) > 0 and sum(shares) <= 1.0 + 1e-9


def test_without_limits_the_probabilities_sum_to_one():
    mesh = stand_in("mug")
    com, _ = mass_properties(mesh, 1.0)
    everything = RestingConfig(min_probability=0.0, max_poses=1000)
    poses = resting_poses((hull_of(mesh),), com, everything)
    assert sum(pose.probability for pose in poses) == pytest.approx(1.0)


def test_a_face_beside_the_centre_of_mass_topples_to_its_neighbour():
    # A wedge whose small bottom lies beside its centre of mass: it falls onto its long side.
    outline = ((0.0, 0.0), (0.01, 0.0), (0.1, 0.1))
    points = np.array([[x, y, z] for x, z in outline for y in (-0.03, 0.03)])
    com = points.mean(axis=0)
    assert com[0] > 0.01  # beyond the edge of the bottom
    poses = resting_poses((Piece("hull", com, 0.0, points),), com)
    assert all(down(pose)[2] > -0.99 for pose in poses)
    assert sum(pose.probability for pose in poses) == pytest.approx(1.0, abs=0.1)


def test_what_stands_firmly_nowhere_rests_where_it_is_firmest():
    half = np.array([0.4, 0.9, 0.8]) * RestingConfig().min_margin
    poses = resting_poses((sharp_box(half),), np.zeros(3))
    assert {tuple(np.abs(np.round(down(pose)))) for pose in poses} == {(1.0, 0.0, 0.0)}
    assert sum(pose.probability for pose in poses) == pytest.approx(1.0)


def test_a_low_centre_of_mass_makes_standing_more_probable():
    standing = []
    for offset in (0.0, -0.02):
        poses = resting_poses((sharp_box(),), np.array([0.0, 0.0, offset]))
        standing.append(next(p.probability for p in poses if down(p)[2] < -0.99))
    assert standing[1] > 1.5 * standing[0]


def test_a_ball_rests_with_its_centre_of_mass_below_its_centre():
    ball = Piece("sphere", np.array([0.01, 0.0, 0.0]), 0.03)
    (pose,) = resting_poses((ball,), np.array([0.01, 0.004, 0.0]))
    np.testing.assert_allclose(down(pose), [0.0, 1.0, 0.0], atol=1e-9)
    assert pose.probability == 1.0
    assert turned(pose, ball.pos)[2] + pose.height == pytest.approx(ball.radius)


def test_several_pieces_rest_like_their_common_hull():
    mesh = trimesh.creation.box(extents=2 * HALF)
    halves = tuple(
        hull_of(mesh.slice_plane((0, 0, 0), (s, 0, 0), cap=True, engine="manifold"))
        for s in (1.0, -1.0)
    )
    one = resting_poses((sharp_box(),), np.zeros(3))
    two = resting_poses(halves, np.zeros(3))
    for a, b in zip(one, two, strict=True):
        assert (a.height, a.probability) == pytest.approx((b.height, b.probability))


def test_rotate_is_a_rotation_by_the_quaternion():
    rng = np.random.default_rng(0)
    quat, points = rng.normal(size=4), rng.normal(size=(5, 3))
    quat /= np.linalg.norm(quat)
    exact = Rotation.from_quat(quat, scalar_first=True).apply(points)
    np.testing.assert_allclose(rotate(quat, points), exact, atol=1e-12)


def _rests(piece, com, inertia, mass, pose):
    """Position and angle [deg] lost in a second on MuJoCo's own plane."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.002
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1])
    spec.add_mesh(name="hull", uservert=piece.vertices.ravel().tolist())
    body = spec.worldbody.add_body(pos=[0, 0, pose.height], quat=pose.quat)
    body.add_freejoint()
    body.explicitinertial = True
    body.mass, body.ipos = mass, com
    i = inertia
    body.fullinertia = [i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]]
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hull")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetData(model, data)
    start = data.qpos.copy()
    mujoco.mj_step(model, data, nstep=500)
    a = Rotation.from_quat(start[3:], scalar_first=True)
    b = Rotation.from_quat(data.qpos[3:], scalar_first=True)
    return np.linalg.norm(data.qpos[:3] - start[:3]), np.degrees((a.inv() * b).magnitude())


@pytest.mark.parametrize(
    "name", ["foam_brick", "sugar_box", "tomato_soup_can", "tuna_fish_can", "mug", "mustard_bottle"]
)
def test_resting_poses_stay_put_in_mujoco(name):
    mesh, mass = stand_in(name), 0.2
    com, inertia = mass_properties(mesh, mass)
    piece = hull_of(mesh)
    for pose in resting_poses((piece,), com):
        drift, angle = _rests(piece, com, inertia, mass, pose)
        assert drift < 0.003 and angle < 3.0, (pose, drift, angle)


def test_mujoco_tells_a_pose_that_is_none():
    mesh, mass = stand_in("foam_brick"), 0.2
    com, inertia = mass_properties(mesh, mass)
    piece = hull_of(mesh)
    pose = resting_poses((piece,), com)[0]
    tilt = Rotation.from_euler("x", 30, degrees=True)
    quat = (tilt * Rotation.from_quat(pose.quat, scalar_first=True)).as_quat(scalar_first=True)
    tilted = type(pose)(quat, pose.height + 0.02, 1.0)
    drift, angle = _rests(piece, com, inertia, mass, tilted)
    assert angle > 20.0 and drift > 0.003
