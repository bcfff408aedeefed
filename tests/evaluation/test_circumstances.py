"""What happens in trials: trackers, belts, pushes, obstacles, and what the controller is told."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.grasps import circumstances, problems, rollout, worlds
from mjx_grasp.evaluation.grasps.hits import hits
from mjx_grasp.evaluation.grasps.scenario import (
    BeltConfig,
    ObstacleConfig,
    PushConfig,
    Scenario,
    TrackerConfig,
)
from mjx_grasp.evaluation.grasps.tracker import Faults, start_track, track
from mjx_grasp.evaluation.grasps.trials import GraspProblem
from mjx_grasp.geometry import so3
from mjx_grasp.geometry.signed_distance import Cylinder
from mjx_grasp.grasp.candidates import cylinder_candidates
from mjx_grasp.objects.model import load_object
from mjx_grasp.pipeline.assemble import grasper_of, whole_grasps
from mjx_grasp.pipeline.state import Known
from mjx_grasp.posture.body import PALM
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.physics import make_params
from mjx_grasp.sim.scene import build_scene

DT = 0.01
TIPS = np.array([0.5, 0.0, 0.3])


def tracked(config, steps=30, worlds=2):
    """Readings of an object that moves 1 mm per tick along x and turns by 0.01 rad about z."""
    p = np.zeros((steps + 1, worlds, 3), np.float32)
    p[..., 0] = 0.001 * np.arange(steps + 1)[:, None]
    turns = np.zeros((steps + 1, worlds, 3), np.float32)
    turns[..., 2] = 0.01 * np.arange(steps + 1)[:, None]
    R = np.asarray(jax.jit(jax.vmap(jax.vmap(so3.exp)))(jnp.asarray(turns)))
    before, faults = start_track(jnp.asarray(p[0]), jnp.asarray(R[0]), DT), Faults.of(config, DT)
    read = jax.jit(track)
    readings = []
    for k in range(1, steps + 1):
        keys = jax.random.split(jax.random.fold_in(jax.random.key(0), k), worlds)
        before = read(before, jnp.asarray(p[k]), jnp.asarray(R[k]), keys, faults)
        readings.append((before.p_wo, before.R_wo))
    return p[1:], R[1:], *map(np.asarray, zip(*readings, strict=True))


def test_a_tracker_without_faults_tells_the_truth():
    p, R, read_p, read_R = tracked(TrackerConfig())
    np.testing.assert_array_equal(read_p, p)
    np.testing.assert_array_equal(read_R, R)


def test_a_late_tracker_tells_what_was():
    p, R, read_p, read_R = tracked(TrackerConfig(delay=0.1))
    np.testing.assert_array_equal(read_p[10:], p[:-10])
    np.testing.assert_array_equal(read_R[10:], R[:-10])
    np.testing.assert_array_equal(read_p[:9], 0.0 * p[:9])


def test_noise_has_its_deviation_and_rotations_stay_rotations():
    p, R, read_p, read_R = tracked(TrackerConfig(position=0.005, rotation=0.05), 50, 100)
    np.testing.assert_allclose((read_p - p).std(axis=(0, 1)), 0.005, rtol=0.05)
    off = jax.jit(jax.vmap(so3.log))(jnp.asarray((R.swapaxes(-1, -2) @ read_R).reshape(-1, 3, 3)))
    np.testing.assert_allclose(np.asarray(off).std(axis=0), 0.05, rtol=0.05)
    np.testing.assert_allclose(read_R @ read_R.swapaxes(-1, -2) - np.eye(3), 0.0, atol=1e-5)


def test_what_is_lost_leaves_the_last_reading():
    _, _, read_p, _ = tracked(TrackerConfig(dropout=1.0))
    np.testing.assert_array_equal(read_p, 0.0 * read_p)
    _, _, read_p, _ = tracked(TrackerConfig(dropout=0.2), 50, 100)
    still = (np.diff(read_p[..., 0], axis=0) == 0).mean()
    assert 0.17 < still < 0.23


def test_a_slow_tracker_has_a_reading_now_and_then():
    p, R, read_p, read_R = tracked(TrackerConfig(period=0.03))
    for k in range(3):
        np.testing.assert_array_equal(read_p[k::3], p[0::3])
        np.testing.assert_array_equal(read_R[k::3], R[0::3])


def drawn(settings, worlds=4, mass=0.5):
    p_wo = np.tile([0.5, -0.2, 0.05], (worlds, 1))
    masses = np.full(worlds, mass)
    headings = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, (worlds, 2))
    return circumstances.circumstances(settings, p_wo, headings, masses, 0.8, TIPS, DT)


@pytest.fixture(scope="module")
def box_world(robot):
    return NativePhysics(build_scene([load_object("rubiks_cube")], robot), threads=1)


def slid(physics, force_of, seconds, z):
    """Object positions and velocities of one world in which the robot stays at home."""
    at = physics.scene.addresses
    home = np.asarray(physics.scene.robot.home, np.float32)
    qpos = np.zeros((1, physics.scene.model.nq), np.float32)
    qpos[:, at.robot_qpos] = home
    qpos[:, at.object_qpos] = [0.55, -0.25, z, 1, 0, 0, 0]
    ctrl = jnp.asarray(home[np.argsort(at.robot_ctrl)])[None]
    params = make_params(jnp.zeros(1, int), 0.8)

    @jax.jit
    def run(state):
        def tick(carry, k):
            state, velocity = carry
            push = force_of(velocity, k * DT)
            state, _, truth = physics.step(state, params, ctrl, push)
            return (state, truth.object_vel[:, :3]), (truth.object_pos[0], truth.object_vel[0, :3])

        return jax.lax.scan(tick, (state, jnp.zeros((1, 3))), jnp.arange(round(seconds / DT)))[1]

    return map(np.asarray, run(physics.init(jnp.asarray(qpos), ctrl)))


def test_a_push_changes_momentum_by_its_impulse(box_world):
    mass, force = box_world.scene.objects[0].mass, jnp.array([[0.6, -0.3, 0, 0, 0, 0]])
    _, velocity = slid(box_world, lambda v, t: force, 0.1, z=0.6)  # it falls freely
    expected = [0.6 * 0.1 / mass, -0.3 * 0.1 / mass, -9.81 * 0.1]
    np.testing.assert_allclose(velocity[-1], expected, rtol=1e-3)


def test_a_belt_takes_the_object_along_and_stops_with_it(box_world):
    height = float(box_world.scene.objects[0].resting[0].height)
    belt = BeltConfig(speed=0.1, heading="across", lasts_s=1.0)
    given = drawn(Scenario(belt=belt), 1, box_world.scene.objects[0].mass)

    def force(velocity, t):
        rise, high = jnp.zeros(1), jnp.full(1, height)
        return circumstances.belt_wrench(given, velocity, rise, high, t[None])

    pos, velocity = slid(box_world, force, 1.5, height)
    np.testing.assert_allclose(velocity[50:100, 1].mean(), 0.1, atol=0.01)
    np.testing.assert_allclose(velocity[120:], 0.0, atol=0.005)
    np.testing.assert_allclose(pos[-1, 1] - pos[0, 1], 0.1, atol=0.012)


def test_a_belt_drags_with_no_more_than_friction_gives_and_only_on_the_table():
    given = drawn(Scenario(belt=BeltConfig(speed=0.3)))
    velocity = jax.random.normal(jax.random.key(0), (4, 3))
    high = jnp.full(4, 0.03)
    wrench = circumstances.belt_wrench(given, velocity, jnp.zeros(4), high, jnp.ones(4))
    force, torque = np.split(np.asarray(wrench), 2, axis=1)
    np.testing.assert_allclose(torque, np.cross([0, 0, -0.03], force), atol=1e-6)
    most = 2 * 0.8 * 0.5 * 9.81
    assert (np.linalg.norm(force, axis=1) <= most * (1 + 1e-5)).all() and (force[:, 2] == 0).all()
    fallen = high - 1.0
    for rise, height, since in ((0.01, high, 1.0), (0.0, high, -1.0), (-1.0, fallen, 1.0)):
        up, when = jnp.full(4, rise), jnp.full(4, since)
        assert not circumstances.belt_wrench(given, velocity, up, height, when).any()
    nothing = drawn(Scenario())
    assert not circumstances.belt_wrench(nothing, velocity, jnp.zeros(4), high, jnp.ones(4)).any()


def test_a_belt_waits_for_its_time_and_for_the_tips():
    belt = drawn(Scenario(belt=BeltConfig(0.1, starts_s=1.0, when_near=0.03))).belt
    never, error = jnp.full(4, jnp.inf), jnp.full((4, 3), 0.02).at[1, 2].set(0.04)
    assert np.isinf(circumstances.belt_start(never, jnp.full(4, 0.5), error, belt)).all()
    began = circumstances.belt_start(never, jnp.full(4, 1.5), error, belt)
    np.testing.assert_array_equal(began, [1.5, np.inf, 1.5, 1.5])
    later = circumstances.belt_start(began, jnp.full(4, 2.0), 0.0 * error, belt)
    np.testing.assert_array_equal(later, [1.5, 2.0, 1.5, 1.5])


def test_a_push_in_the_hand_is_level_and_has_its_time():
    given = drawn(Scenario(hold_s=2.0, push=PushConfig(force=3.0, after_s=0.5, lasts_s=0.5)))
    force = circumstances.push_wrench(given, jnp.array([0.4, 0.6, 1.1, jnp.nan]))
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), [0, 3, 0, 0], rtol=1e-5)
    assert (np.asarray(force)[:, 2:] == 0).all()


def test_obstacles_hang_between_hand_and_object():
    balls = (ObstacleConfig(radius=0.04), ObstacleConfig(along=1.0, clear=0.1))
    given = np.asarray(drawn(Scenario(obstacles=balls)).obstacles, np.float64)
    way = np.array([0.5, -0.2, 0.05]) - TIPS
    np.testing.assert_allclose(given[:, 0], [[*(TIPS + 0.5 * way), 0.04]] * 4, atol=1e-6)
    last = np.linalg.norm(given[:, 1, :3] - [0.5, -0.2, 0.05], axis=1)
    np.testing.assert_allclose(last, 0.1, atol=1e-6)


def test_a_ball_that_a_link_touches_is_a_hit(robot, body):
    q = np.tile(np.asarray(body.home, np.float64), (3, 2, 1))
    palm = np.asarray(body.kinematics.motion(jnp.asarray(body.home)).pos[PALM], np.float64)
    balls = np.array([[[*palm, 0.02]], [[*palm[:2], palm[2] + 1.0, 0.02]]])
    joints, all_of_them = np.arange(q.shape[2]), np.full(2, len(q))
    about = robot, q, joints, all_of_them
    np.testing.assert_array_equal(hits(*about, balls), [True, False])
    np.testing.assert_array_equal(hits(*about, balls[::-1]), [False, True])
    assert not hits(robot, q, joints, 0 * all_of_them, balls).any(), "the trials were over before"
    q[..., 0] += 1.0  # the whole robot turns away from the ball
    assert not hits(*about, balls).any()
    assert not hits(*about, np.zeros((2, 0, 4))).any()


def test_objects_keep_away_from_where_they_are_told(robot):
    cube = build_scene([load_object("rubiks_cube")], robot)
    away = problems.Away(np.array([0.5, 0.0, 0.0]), 0.2)
    problem = problems.draw_problem(cube, 20, 0, away=away)
    assert (np.linalg.norm(problem.p_wo - away.point, axis=1) >= 0.2).all()
    assert len(problem.p_wo) == 20
    with pytest.raises(InputError, match="away"):
        problems.draw_problem(cube, 2, 0, away=away._replace(distance=3.0))


def test_what_the_controller_begins_with(box_world, robot, monkeypatch):
    """Without a planner no ways; of an object that is not weighed no weight."""

    class BegunError(Exception):
        pass

    def begun(grasper, measured, known, seen, ways):
        raise BegunError(float(known.weight[0]), ways)

    monkeypatch.setattr(worlds, "_start", begun)
    grasper = grasper_of(robot, reaching=whole_grasps("paper"))
    shape = Cylinder(jnp.float32(0.03), jnp.float32(0.06))
    candidates = cylinder_candidates(*shape, robot.hand.span, around=8, along=3)
    problem = GraspProblem(
        np.array([0]), np.float32([[0.5, 0, 0.03]]), np.float32([[1, 0, 0, 0]]),
        np.zeros((1, 2)), np.zeros(1, int),
    )  # fmt: skip
    known = [Known(shape, candidates, jnp.float32(2.0), jnp.zeros(3))]
    for weighed, weight in ((True, 2.0), (False, 0.0)):
        with pytest.raises(BegunError) as begins:
            scenario = Scenario(weighed=weighed)
            rollout.grasp_all(grasper, None, box_world, known, problem, [scenario])
        assert begins.value.args == (weight, None)
