import jax
import mujoco
import numpy as np
import pytest
from mjx_grasp.handoff.clearance import DistanceGrid, distance_and_gradient, distance_grid
from mjx_grasp.handoff.ik import make_ik
from mjx_grasp.handoff.starts import build_library, choose_starts, make_ranking
from mjx_grasp.robot.arrays import robot_arrays

from mjx_grasp.handoff.config import IkConfig, SamplingConfig
from mjx_grasp.objects.convex import Piece
from mjx_grasp.robot.spec import load_robot

PROBLEMS, RESTARTS = 96, 6
# Nothing but the tips: what is reachable must be reached.
PLAIN = IkConfig(clearance_weight=0.0, limit_margin=0.0, posture_weight=1e-4)


def no_object():
    return DistanceGrid(
        np.full((2, 2, 2), 10, np.float32), np.zeros(3, np.float32), np.ones(3, np.float32)
    )


@pytest.fixture(scope="module")
def arrays():
    return robot_arrays(load_robot())


@pytest.fixture(scope="module")
def library(arrays):
    return build_library(arrays, 3000, SamplingConfig(), seed=0)


@pytest.fixture(scope="module")
def reachable(arrays):
    """Targets that feasible configurations, unknown to the library, do reach."""
    q = build_library(arrays, PROBLEMS, SamplingConfig(), seed=1).q
    pos, mat = jax.vmap(arrays.kinematics.forward)(q)
    return np.asarray(pos[:, :3]), np.asarray(mat[:, 3:6, :, 0]), q


def here(n):
    return np.zeros((n, 3), np.float32), np.tile(np.eye(3, dtype=np.float32), (n, 1, 1))


@pytest.fixture(scope="module")
def solve(arrays):
    return make_ik(arrays, PLAIN)


@pytest.fixture(scope="module")
def starts(arrays, library, reachable):
    tips, inward, _ = reachable
    usable = np.ones((PROBLEMS, 1), bool)
    p_wo, R_wo = here(PROBLEMS)
    goals = tips[:, None], inward[:, None]
    rank = make_ranking(arrays, 0.0)
    _, entry = choose_starts(library, rank, *goals, usable, p_wo, R_wo, no_object(), RESTARTS)
    return library.q[entry]


@pytest.fixture(scope="module")
def solution(solve, starts, reachable):
    """All problems from all starts, restart by restart."""
    tips, inward, _ = reachable
    solved = [
        solve(tips, inward, starts[:, k], *here(PROBLEMS), no_object()) for k in range(RESTARTS)
    ]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *solved)


def test_reachable_targets_are_reached(solution):
    worst = np.asarray(solution.residual).max(axis=1).reshape(RESTARTS, PROBLEMS)
    assert np.mean(worst.min(axis=0) < 1e-3) >= 0.95
    assert np.mean(worst < 1e-3) >= 0.6


def test_pads_come_close_to_where_they_should_face(solution):
    angle = np.asarray(solution.pad_angle).max(axis=1).reshape(RESTARTS, PROBLEMS)
    assert np.median(angle.min(axis=0)) < np.radians(15)


def test_limits_are_respected_and_the_other_joints_stay(arrays, solution):
    q = np.asarray(solution.q)
    assert np.all(q >= arrays.lower - 1e-6) and np.all(q <= arrays.upper + 1e-6)
    still = ~arrays.solved
    assert still.sum() == 8
    assert np.allclose(q[:, still], arrays.nominal[still])
    # The flag says what the numbers say.
    slack = np.minimum(q - arrays.lower, arrays.upper - q)[:, arrays.solved].min(axis=1)
    flagged = np.asarray(solution.at_limit)
    assert np.all(slack[flagged] < 1e-6) and np.all(slack[~flagged] > 0)
    assert 0 < flagged.mean() < 1


def test_residuals_are_those_of_native_mujoco(arrays, reachable, solution):
    robot = load_robot()
    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    data = mujoco.MjData(model)
    targets = np.tile(reachable[0], (RESTARTS, 1, 1))
    palm = model.site(robot.hand.palm_site).id
    for k in range(0, len(targets), 37):
        data.qpos[:] = solution.q[k]
        mujoco.mj_kinematics(model, data)
        tips = np.array([data.site(f.tip_site).xpos for f in robot.hand.fingers])
        error = np.linalg.norm(tips - targets[k], axis=1)
        assert np.allclose(error, solution.residual[k], atol=2e-6)
        approach = data.site_xmat[palm].reshape(3, 3) @ robot.hand.approach_axis
        assert np.allclose(approach, solution.approach[k], atol=1e-5)


def test_a_start_at_the_solution_stays_and_an_unreachable_target_says_so(solve, reachable):
    tips, inward, q = reachable
    stay = solve(tips, inward, q, *here(PROBLEMS), no_object())
    assert np.asarray(stay.residual).max() < 1e-3
    far = solve(tips + np.float32([3, 0, 0]), inward, q, *here(PROBLEMS), no_object())
    assert np.asarray(far.residual).max(axis=1).min() > 1.0
    assert all(np.isfinite(np.asarray(leaf, float)).all() for leaf in far)


def box_piece(half):
    corners = np.stack(np.meshgrid(*[[-1, 1]] * 3), axis=-1).reshape(-1, 3) * half
    return Piece("hull", corners.mean(axis=0), 0.0, corners)


def test_grid_distances_of_sphere_and_box():
    rng = np.random.default_rng(0)
    centre = np.array([0.01, -0.02, 0.03])
    ball = distance_grid([Piece("sphere", centre, 0.04)])
    points = np.float32(centre + rng.uniform(-0.06, 0.06, (200, 3)))
    distance, slope = map(np.asarray, distance_and_gradient(ball, points))
    expected = np.linalg.norm(points - centre, axis=1) - 0.04
    away = np.abs(expected) < 0.03
    assert np.abs(distance - expected)[away].max() < 1e-3
    radial = (points - centre) / np.linalg.norm(points - centre, axis=1, keepdims=True)
    assert np.median(np.sum(slope * radial, axis=1)[away]) > 0.95
    half = np.array([0.03, 0.05, 0.02])
    box = distance_grid([box_piece(half)])
    points = np.float32(rng.uniform(-1, 1, (200, 3)) * (half + 0.03))
    distance, _ = map(np.asarray, distance_and_gradient(box, points))
    expected = (np.abs(points) - half).max(axis=1)
    # Linear interpolation rounds the creases off by up to a part of the spacing.
    assert np.abs(distance - expected).max() < box.spacing.max()
    assert np.median(np.abs(distance - expected)) < 5e-4


def penetration(arrays, q, p_wo, grid):
    centre = jax.vmap(arrays.sphere_centres)(*jax.vmap(arrays.kinematics.forward)(q))
    found = []
    for points, origin in zip(np.asarray(centre), p_wo, strict=True):
        distance, _ = distance_and_gradient(grid, np.float32(points - origin))
        distance = np.minimum(distance, points[:, 2])
        found.append(np.maximum(arrays.spheres.radius - distance, 0).max())
    return np.array(found)


def test_the_clearance_term_moves_the_hand_out_of_an_object(arrays, solve, reachable):
    tips, inward, q = reachable
    # A ball between palm and tips: in the way, though the tips are clear of it.
    grid = distance_grid([Piece("sphere", np.zeros(3), 0.03)])
    pos = np.asarray(jax.vmap(arrays.kinematics.forward)(q)[0])
    p_wo = 0.35 * tips.mean(axis=1) + 0.65 * pos[:, 6]
    _, R_wo = here(PROBLEMS)
    careful = make_ik(arrays, IkConfig())
    arguments = tips, inward, q, np.float32(p_wo), R_wo, grid
    before = penetration(arrays, np.asarray(solve(*arguments).q), p_wo, grid)
    after = penetration(arrays, np.asarray(careful(*arguments).q), p_wo, grid)
    blocked = before > 0.01
    assert blocked.sum() > 20
    assert np.median(after[blocked]) < 0.4 * np.median(before[blocked])


def test_problems_of_a_batch_do_not_touch_each_other(solve, starts, reachable):
    tips, inward, _ = reachable
    order = np.random.default_rng(0).permutation(PROBLEMS)
    arguments = tips, inward, starts[:, 0]
    straight = solve(*arguments, *here(PROBLEMS), no_object())
    shuffled = solve(*(x[order] for x in arguments), *here(PROBLEMS), no_object())
    same = np.abs(np.asarray(straight.q)[order] - shuffled.q).max(axis=1) < 1e-4
    assert same.mean() > 0.95


def test_the_library_knows_where_its_configurations_put_tips_and_pads(arrays, library):
    pos, mat = map(np.asarray, jax.vmap(arrays.kinematics.forward)(library.q))
    tips, pads = library.features[:, :9], library.features[:, 9:]
    assert np.allclose(tips, pos[:, :3].reshape(-1, 9), atol=1e-5)
    directions = mat[:, 3:6, :, 0].reshape(-1, 9)
    assert np.allclose(pads, pads[0] @ directions[0] / 3 * directions, atol=1e-5)
    assert np.allclose(2 * library.half_squares, np.sum(library.features**2, axis=1), atol=1e-5)


def test_a_problem_that_cannot_be_evaluated_is_not_taken_for_solved(solve, reachable):
    tips, inward, q = reachable
    p_wo, R_wo = here(PROBLEMS)
    start, nowhere = q.copy(), p_wo.copy()
    start[0, 0], nowhere[1] = np.nan, np.nan
    found = solve(tips, inward, start, nowhere, R_wo, no_object())
    assert np.all(np.isinf(found.residual[:2])) and np.all(np.isinf(found.cost[:2]))
    assert np.asarray(found.residual[2:]).max() < 1e-3
