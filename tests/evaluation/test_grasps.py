"""Whole grasps from home in native MuJoCo: reached, closed, lifted and held."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.grasps import worlds
from mjx_grasp.evaluation.grasps.kept import SEGMENT, Kept, Trace
from mjx_grasp.evaluation.grasps.problems import draw_problem
from mjx_grasp.evaluation.grasps.results import OUTCOMES, as_record, grasp_rows
from mjx_grasp.evaluation.grasps.rollout import grasp_all
from mjx_grasp.evaluation.grasps.scenario import Scenario, TrackerConfig
from mjx_grasp.evaluation.grasps.trials import GraspProblem
from mjx_grasp.evaluation.grasps.worlds import LEAST_S
from mjx_grasp.handoff.config import SamplingConfig
from mjx_grasp.handoff.sampling import poses_at_rest, sample_object_poses
from mjx_grasp.objects.model import load_object
from mjx_grasp.pipeline.assemble import grasper_of, whole_grasps
from mjx_grasp.pipeline.known import known_object
from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.posture.body import robot_body
from mjx_grasp.reaching.planning import start_library
from mjx_grasp.sim.collision import CollisionChecker
from mjx_grasp.sim.engines import make_physics
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.scene import ObjectArea, build_scene


@pytest.fixture(scope="module")
def cube():
    return load_object("rubiks_cube")


def test_problems_are_drawn_for_each_object_alone(cube, robot):
    can = load_object("tuna_fish_can")
    scene = build_scene([cube, can], robot)
    both, alone = draw_problem(scene, 5, 3), draw_problem(build_scene([can], robot), 5, 3)
    np.testing.assert_array_equal(both.object_index, [0] * 5 + [1] * 5)
    second = draw_problem(scene, 5, 3, objects=[1])
    np.testing.assert_array_equal(second.object_index, [1] * 5)
    np.testing.assert_array_equal(second.p_wo, alone.p_wo)
    np.testing.assert_array_equal(both.p_wo[5:], alone.p_wo)
    np.testing.assert_array_equal(both.seed[5:], alone.seed)
    assert len(np.unique(both.seed)) == 10
    np.testing.assert_array_equal(both.quat[5:], alone.quat)
    assert (both.p_wo[:, 2] > 0).all()


def test_nothing_lies_where_the_robot_stands_at_home(robot):
    """A tall pitcher; the others lie where they would have lain."""
    pitcher = load_object("pitcher_base")
    scene = build_scene([load_object("foam_brick"), pitcher], robot)
    checker, home = CollisionChecker(scene), np.asarray(robot.home)
    rng = np.random.default_rng([4, int(pitcher.content_hash[:8], 16)])
    config = SamplingConfig()
    p_wo, quat = sample_object_poses(poses_at_rest(pitcher, config.standing), 40, config, rng)
    clear = [checker.reason(home, p, q, 1) is None for p, q in zip(p_wo, quat, strict=True)]
    assert 20 < sum(clear) < 40
    problem = draw_problem(scene, 40, 4, objects=[1])
    np.testing.assert_allclose(problem.p_wo[: sum(clear)], p_wo[clear], atol=1e-6)
    for p, q in zip(problem.p_wo, problem.quat, strict=True):
        assert checker.reason(home, p, q, 1) is None
    tips = robot_body(robot).kinematics.motion(jnp.asarray(home)).pos[:3]
    x, y, _ = np.asarray(tips, float).mean(axis=0).tolist()
    there = ObjectArea(x=(x, x + 1e-3), y=(y, y + 1e-3))
    with pytest.raises(InputError, match=r"pitcher_base.*home"):
        draw_problem(scene, 2, 0, replace(config, area=there, standing=1.0), objects=[1])


class _Breaking(NativePhysics):
    """The second world's state stops being finite as its object rises."""

    def step(self, state, *rest):
        after, measured, truth = super().step(state, *rest)
        rises = (truth.object_pos[:, 2] > 0.08) & (jnp.arange(len(state.qpos)) == 1)
        return after._replace(qpos=jnp.where(rises[:, None], jnp.nan, after.qpos)), measured, truth


@pytest.fixture(scope="module")
def planning(robot):
    """A controller that plans from a small library."""
    settings = whole_grasps()
    plan = replace(settings.plan, library=4000)
    grasper = grasper_of(robot, reaching=replace(settings, plan=plan))
    return grasper, start_library(grasper.reacher.body, plan)


@pytest.mark.long
def test_in_mjx_a_cube_is_grasped_as_in_the_native_engine(cube, robot, planning):
    """The same up to the first touch, and a success then."""
    grasper, library = planning
    height = cube.resting[0].height
    problem = GraspProblem(
        np.array([0, 0]),
        np.float32([[0.5, 0.1, height], [0.55, -0.15, height]]),
        np.repeat(np.float32([cube.resting[0].quat]), 2, axis=0),
        np.zeros((2, 2)),
        np.arange(2),
    )
    known, scene = [known_object(cube, robot)], build_scene([cube], robot)
    engines = [make_physics(engine, scene, 2, grasper.dt) for engine in ("mujoco", "mjx")]
    ran = [grasp_all(grasper, library, physics, known, problem) for physics in engines]
    rows = [grasp_rows([cube.name], problem, *each, grasper.dt) for each in ran]
    touched = ran[0][1].touching.any((1, 2)).argmax()
    assert touched > 50
    np.testing.assert_allclose(*(trace.qpos[:touched] for _, trace in ran), atol=1e-3)
    for native, warp in zip(*rows, strict=True):
        assert native.outcome == warp.outcome == "success" and not warp.overflow_ticks
        assert native.handoff_s == pytest.approx(warp.handoff_s, abs=0.05)


@pytest.mark.long
def test_a_cube_is_lifted_from_home_and_held(cube, robot, planning):
    grasper, library = planning
    height = cube.resting[0].height
    problem = GraspProblem(
        np.array([0, 0, 0]),
        np.float32([[0.5, 0.1, height], [0.55, -0.15, height], [0.96, 0.66, height]]),
        np.repeat(np.float32([cube.resting[0].quat]), 3, axis=0),
        np.zeros((3, 2)),
        np.arange(3),
    )
    physics = NativePhysics(build_scene([cube], robot), grasper.dt)
    known = [known_object(cube, robot)]
    end, trace = grasp_all(grasper, library, physics, known, problem)
    np.testing.assert_array_equal(end.progress.success, [True, True, False])
    assert (end.state.phase[:2] == Phase.HOLDING).all(), "the third is out of reach"
    # Each trial ends for itself: nothing moves afterwards, however long another one takes.
    ended = np.argmax(trace.over, axis=0)
    assert ended[0] == ended[1] == round(LEAST_S / grasper.dt) and len(trace.over) > 1500
    assert trace.over[900:, :2].all() and not trace.over[:900].any()
    for part in (trace.qpos, trace.force, trace.phase, trace.rise):
        assert (part[901:, :2] == part[900, :2]).all() and (part[899, :2] == part[900, :2]).all()
    assert np.all(end.state.clock[:2] == end.state.clock[0]) and end.state.clock[2] > 15
    order = trace.phase[np.diff(trace.phase, axis=0, prepend=-1).nonzero()[0][:4], 0]
    assert set(order) <= {Phase.REACHING, Phase.CLOSING, Phase.LIFTING, Phase.HOLDING}
    rows = grasp_rows([cube.name], problem, end, trace, grasper.dt)
    assert rows.pop().outcome == "not_reached"
    for row in rows:
        assert row.outcome == "success" and row.failure == "none"
        assert 0.3 < row.handoff_s < row.lift_s < row.lifted_s < 10
        assert max(row.tip_error_mm) < 15 and row.midpoint_mm < 10
        assert 0.5 < row.force_mean_n <= row.force_peak_n
    record = as_record(rows)
    assert record["all"]["success_percent"] == 100.0 and record["all"]["broken"] == 0
    assert sum(record["objects"][cube.name][name] for name in OUTCOMES) == 2

    # In two worlds the third begins where the first has ended, and nothing else is another one's.
    noisy = Scenario(tracker=TrackerConfig(position=0.003, delay=0.05, dropout=0.2))
    for scenario in (Scenario(), noisy):
        if scenario == noisy:
            end, trace = grasp_all(grasper, library, physics, known, problem, [scenario])
        again, other = grasp_all(grasper, library, physics, known, problem, [scenario], worlds=2)
        np.testing.assert_array_equal(other.over, trace.over)
        np.testing.assert_allclose(other.qpos, trace.qpos, atol=1e-3)
        np.testing.assert_array_equal(again.replans, end.replans)
        np.testing.assert_array_equal(again.state.phase, end.state.phase)

    # A world that breaks while it lifts ends there, with numbers, and the others do not notice.
    physics = _Breaking(build_scene([cube], robot), grasper.dt)
    both = known, jax.tree.map(lambda x: x[:2], problem)
    end, trace = grasp_all(grasper, library, physics, *both)
    assert end.broken.tolist() == [False, True] and np.isfinite(trace.qpos).all()
    first, second = grasp_rows([cube.name], both[1], end, trace, grasper.dt)
    assert first.outcome == "success" and not first.broken
    assert second.broken and second.outcome == "never_lifted" and 0.02 < second.peak_rise_m < 0.06
    assert as_record([first, second])["all"]["broken"] == 1


def test_what_is_kept_of_trials_is_each_ones_own_whenever_it_ran():
    """Five trials in two worlds, of one to four segments: each as if it had run alone."""
    segments, ticks = (2, 1, 4, 1, 2), SEGMENT
    kept, at, following = Kept(5, 4 * ticks - 3), np.arange(2), 2
    while (at < 5).any():
        # Each tick says whose it is and the how manieth; a world without a trial says -1.
        first = np.where(at < 5, kept.ticks[np.minimum(at, 4)], -1)
        number = first + np.arange(ticks)[:, None]
        whose = np.broadcast_to(np.where(at < 5, at, -1), number.shape)
        marks = np.stack([whose, number], axis=-1).astype(float)
        kept.add(at, Trace(*[marks] * (len(Trace._fields) - 1), over=number < 0))
        over = [w for w in (0, 1) if at[w] < 5 and kept.ticks[at[w]] == ticks * segments[at[w]]]
        for w in over:
            kept.end(at[[w]], (at[[w]] * 10.0, at[[w], None]))
            at[w], following = (following, following + 1) if following < 5 else (5, 5)
    assert kept.share() == 1.0 and kept.most == 4 * ticks
    np.testing.assert_array_equal(kept.ended[0], np.arange(5) * 10.0)
    trace, longest = kept.trace(), 4 * ticks
    ran = np.array(segments) * ticks
    expected = np.minimum(np.arange(longest)[:, None], ran - 1)
    np.testing.assert_array_equal(trace.qpos[..., 0], np.tile(np.arange(5), (longest, 1)))
    np.testing.assert_array_equal(trace.qpos[..., 1], expected)
    np.testing.assert_array_equal(trace.over, np.arange(longest)[:, None] >= ran)


@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 200])
def test_parts_are_all_rows_and_of_one_size(count):
    rows = np.arange(count) + 7
    parts = worlds._parts(rows)
    assert all(len(part) == worlds._PART for part in parts)
    assert len(parts) == -(-count // worlds._PART)
    if count:
        found = np.concatenate(parts)
        np.testing.assert_array_equal(found[:count], rows)
        assert (found[count:] == rows[-1]).all()


def test_what_acts_on_trials_has_headings_all_around_as_drawn(cube, robot):
    scene = build_scene([cube], robot)
    first, again, other = (draw_problem(scene, 40, seed).headings for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert first.shape == (40, 2) and not np.isin(first, other).any()
    for of in first.T:
        assert np.histogram(of, bins=4, range=(0, 2 * np.pi))[0].min() > 3
