"""Scenarios: what they do to objects, trackers and hands, and the command that runs them."""

import io
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from grasp_rows import row
from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.grasps import circumstances, job, problems, rollout, worlds
from mjx_grasp.evaluation.grasps import makers as grasp_makers
from mjx_grasp.evaluation.grasps.blocks import Block
from mjx_grasp.evaluation.grasps.config import ScenariosConfig, warn_without_gpu
from mjx_grasp.evaluation.grasps.hits import hits
from mjx_grasp.evaluation.grasps.job import run_scenarios
from mjx_grasp.evaluation.grasps.kept import GraspEnd
from mjx_grasp.evaluation.grasps.makers import Makers
from mjx_grasp.evaluation.grasps.results import grasp_rows
from mjx_grasp.evaluation.grasps.run import closing_policy
from mjx_grasp.evaluation.grasps.scenario import (
    BeltConfig,
    ObstacleConfig,
    PushConfig,
    Scenario,
    TrackerConfig,
    load_scenarios,
    scenario_names,
)
from mjx_grasp.evaluation.grasps.tables import scenario_table
from mjx_grasp.evaluation.grasps.tracker import Faults, start_track, track
from mjx_grasp.evaluation.grasps.trials import GraspProblem, trials_of
from mjx_grasp.geometry import so3
from mjx_grasp.geometry.signed_distance import Cylinder
from mjx_grasp.grasp.candidates import cylinder_candidates
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.objects.model import load_object
from mjx_grasp.pipeline.assemble import grasper_of, whole_grasps
from mjx_grasp.pipeline.phases import Failure, Phase
from mjx_grasp.pipeline.state import Known
from mjx_grasp.posture.body import PALM
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.physics import make_params
from mjx_grasp.sim.scene import build_scene
from mjx_grasp.tasks.success import initial_progress

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


@pytest.mark.wrong_types
def test_a_trial_is_over_once_it_has_ended_and_had_its_time():
    """Failed, or held for long enough: not before 9 s, and whatever the others do."""
    cases = [
        (Phase.FAILED, 8.99, np.nan, False),
        (Phase.FAILED, 9.0, np.nan, True),
        (Phase.REACHING, 15.0, np.nan, False),
        (Phase.LIFTING, 15.0, 3.0, False),
        (Phase.HOLDING, 9.0, 8.5, False),
        (Phase.HOLDING, 9.5, 8.5, True),
        (Phase.HOLDING, 6.0, 4.0, False),
        (Phase.HOLDING, 9.0, 4.0, True),
    ]
    phase, clock, top, over = (np.array(values) for values in zip(*cases, strict=True))
    entered = np.full((len(cases), len(Phase)), np.nan)
    entered[:, Phase.HOLDING] = top
    state = SimpleNamespace(phase=phase, clock=clock, entered=entered)
    whole = SimpleNamespace(grasp=state, broken=np.zeros(len(cases), bool))
    np.testing.assert_array_equal(worlds._over(whole, 1.0), over)
    whole.broken[2] = True
    assert worlds._over(whole, 1.0)[2], "and what is broken is over at once"


@pytest.mark.wrong_types
def test_the_force_is_that_until_a_trial_is_over():
    rise, force = np.full(1200, 0.12), np.full((1200, 1, 3), 2.0)
    force[900:] = 50.0
    over = np.arange(1200)[:, None] >= 900
    assert row_of(rise, force=force, over=over).force_mean_n == 2.0
    assert row_of(rise, force=force).force_mean_n > 10.0


@pytest.mark.wrong_types
def test_the_force_is_that_of_lift_and_hold_not_of_reaching_anew():
    rise, force = np.full(1200, 0.12), np.full((1200, 1, 3), 2.0)
    force[200:400], force[20:50] = 0.0, 30.0
    row = row_of(rise, force=force, lost=slice(200, 400))
    assert row.force_mean_n == 2.0 and row.force_peak_n == 30.0
    assert row_of(rise, force=force).force_mean_n < 1.9


def row_of(
    rise, hit=False, success=True, failure=Failure.NONE, force=None, over=None, lost=slice(0),
    broken=False,
):  # fmt: skip
    ticks = len(rise)
    force = np.ones((ticks, 1, 3)) if force is None else force
    over = np.zeros((ticks, 1), bool) if over is None else over
    phase = np.full((ticks, 1), Phase.HOLDING)
    phase[:50], phase[50:60], phase[60:100] = Phase.REACHING, Phase.CLOSING, Phase.LIFTING
    phase[lost] = Phase.REACHING
    handoff = SimpleNamespace(error=np.zeros((1, 3)), midpoint=np.zeros(1))
    state = SimpleNamespace(failure=np.array([failure]), handoff=handoff, returns=np.array([0]))
    progress = initial_progress((1,))._replace(success=jnp.array([success]))
    incidents = np.array([broken]), np.array([3])
    end = GraspEnd(state, progress, np.array([0]), np.zeros((1, 0, 4)), np.array([hit]), *incidents)
    trace = SimpleNamespace(phase=phase, force=force, rise=np.array(rise)[:, None], over=over)
    one = np.array([0])
    problem = GraspProblem(one, np.zeros((1, 3)), np.zeros((1, 4)), np.zeros((1, 2)), one)
    return grasp_rows(["box"], problem, end, trace, DT)[0]


@pytest.mark.wrong_types
def test_what_falls_before_its_trial_ends_is_not_held():
    up, fell, again = np.full((3, 1000), 0.12)
    fell[700:] = again[300:600] = 0.0
    assert row_of(up).outcome == "success" and row_of(up).up_at_9s
    assert row_of(fell).outcome == "not_held" and not row_of(fell).up_at_9s
    assert row_of(again).outcome == "success" and row_of(again).up_at_9s
    assert row_of(up, success=False).outcome != "success"
    assert row_of(up, hit=True).outcome == "hit"
    broken = row_of(up, broken=True)
    assert (broken.outcome, broken.broken, broken.overflow_ticks) == ("not_held", True, 3)
    row = row_of(up)
    assert (row.handoff_s, row.lift_s) == (0.5, 0.6)


@pytest.mark.wrong_types
@pytest.mark.parametrize("failure", [each for each in Failure if each != Failure.NONE])
def test_what_its_controller_gives_up_is_not_held(failure):
    row = row_of(np.full(1000, 0.12), failure=failure)
    assert row.outcome == "not_held" and row.failure == failure.name.lower()


def test_the_shipped_scenarios_are_read_and_do_something():
    shipped = load_scenarios(["all"])
    assert tuple(shipped) == scenario_names() and "nominal" in shipped
    assert shipped["nominal"] == Scenario()
    said = {one.description for one in shipped.values()}
    assert len(said) == len(shipped) == len(set(shipped.values()))


def test_files_of_ones_own(tmp_path):
    path = tmp_path / "windy.yaml"
    path.write_text("description: wind\npush: {force: 1.0}\nhold_s: 3\n")
    assert load_scenarios([str(path)])["windy"].push == PushConfig(force=1.0)
    with pytest.raises(InputError, match="each name once"):
        load_scenarios([str(path), str(path)])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("push: {force: -1}", r"windy.yaml: scenario.push.force: found -1"),
        ("tracker: {delay: 2}", r"scenario.tracker.delay: found 2"),
        ("pushes: 3", r"windy.yaml: scenario: found 'pushes'"),
        ("push: {force: 1}\nhold_s: 0.5", "it ends with a push until 1.0 s"),
        ("{", "no valid YAML"),
        ("- 1", "a mapping of some of description, objects"),
        ("pusch: {force: 1}", r"found 'pusch', expected some of .*\(push\?\)"),
        ("table_height: 1.5", r"scenario\.table_height: found 1\.5, expected -0\.2 .*to 0\.2"),
    ],
)
def test_a_wrong_scenario_is_refused_by_file_and_field(text, expected, tmp_path):
    path = tmp_path / "windy.yaml"
    path.write_text(text)
    with pytest.raises((InputError, FileError), match=expected):
        load_scenarios([str(path)])


def test_unknown_names_and_missing_files_are_refused():
    with pytest.raises(InputError, match="one of nominal"):
        load_scenarios(["storm"])
    with pytest.raises(FileError, match=r"storm\.yaml"):
        load_scenarios(["storm.yaml"])


def test_what_cannot_work_is_refused_before_anything_long_starts(tmp_path):
    out, console = tmp_path / "out.json", Console(quiet=True)
    with pytest.raises(InputError, match="one of nominal"):
        run_scenarios(ScenariosConfig(scenarios=("storm",), out=out), console)
    with pytest.raises(InputError, match="storm"):
        run_scenarios(ScenariosConfig(objects=("storm",), out=out), console)
    assert not out.exists()
    out.write_text("{}")
    with pytest.raises(FileError, match="no results of scenarios"):
        run_scenarios(ScenariosConfig(out=out), console)
    assert out.read_text() == "{}"


@pytest.mark.parametrize("wrong", ["away: 2.0", "objects: [slab.obj]", "objects: [mugg]"])
def test_a_later_scenario_that_cannot_work_is_refused_before_the_first_trial(
    wrong, tmp_path, monkeypatch
):
    monkeypatch.setattr(Makers, "run", lambda *_: pytest.fail("a trial began"))
    trimesh.creation.box(extents=(0.3, 0.3, 0.3)).export("slab.obj")
    Path("calm.yaml").write_text("hold_s: 1\n")
    Path("wrong.yaml").write_text(f"{wrong}\n")
    before = sorted(tmp_path.iterdir())
    config = ScenariosConfig(
        scenarios=("calm.yaml", "wrong.yaml"), objects=("rubiks_cube",), out=Path("out.json")
    )
    field, found = ("away", "2.0") if "away" in wrong else ("object", f"'{wrong[10:-1]}'")
    with pytest.raises(InputError, match=f"^wrong: {field}: found {found}, expected"):
        run_scenarios(config, Console(quiet=True))
    assert sorted(tmp_path.iterdir()) == before


def makers(robot, *objects, **settings):
    return Makers(ScenariosConfig(objects=objects, out=Path("out.json"), **settings), robot)


def test_an_object_that_cannot_be_grasped_is_refused_every_time(robot):
    trimesh.creation.box(extents=(0.3, 0.3, 0.3)).export("slab.obj")
    asked = makers(robot, "slab.obj")
    for _ in range(2):
        with pytest.raises(InputError, match=r"slab\.obj.*for thumb and fingers to oppose"):
            asked.known(Scenario())


def test_only_meshes_have_the_weight_that_is_asked_for(robot):
    trimesh.creation.box(extents=(0.05, 0.06, 0.09)).export("jug.obj")
    asked, can = makers(robot, "jug.obj", mass=0.3), Scenario(objects=("chips_can",))
    assert [obj.mass for obj in asked.objects(Scenario())] == [0.3]
    assert [obj.mass for obj in asked.objects(can)] == [load_catalogue()["chips_can"].mass]
    both = asked.objects(Scenario(objects=("chips_can", "jug.obj")))
    assert [obj.mass for obj in both] == [load_catalogue()["chips_can"].mass, 0.3]
    asked = makers(robot, "chips_can", mass=0.3)
    asked.objects(can)
    with pytest.raises(InputError, match="--mass or --density"):
        asked.objects(Scenario())


def test_worlds_are_of_the_engine_that_is_asked_for_and_made_once(robot):
    native, warp = (makers(robot, "rubiks_cube", engine=name) for name in ("mujoco", "mjx"))
    made = [native.physics(Scenario(), worlds, DT) for worlds in (3, 5)]
    assert isinstance(made[0], NativePhysics) and made[0] is made[1], "it takes any number"
    made = [warp.physics(Scenario(), worlds, DT) for worlds in (3, 5, 3)]
    assert [physics.num_worlds for physics in made] == [3, 5, 3] and made[0] is made[2]


def test_rows_of_a_batch_are_those_of_each_scenario(robot, monkeypatch):
    """The trials of one after those of the other, each with its own circumstances."""
    asked, given = makers(robot, "rubiks_cube", "apple", episodes=3), []

    def grasped(grasper, library, physics, known, problem, scenarios, worlds, progress):
        given.append(trials_of(grasper, physics, problem, scenarios))
        return problem, scenarios

    monkeypatch.setattr(grasp_makers, "grasp_all", grasped)
    monkeypatch.setattr(grasp_makers, "grasp_rows", lambda names, problem, *_: list(problem.seed))

    def make(robot, approach):
        return grasper_of(robot, reaching=whole_grasps("paper"))

    windy = Scenario(
        push=PushConfig(force=2.0), hold_s=3.0, mass_scale=2.0, weighed=False, told=False,
        tracker=TrackerConfig(position=0.01, delay=0.05), belt=BeltConfig(speed=0.1),
    )  # fmt: skip
    part = (Block(0, 3, 0),)
    rows = asked.run([Scenario(), windy], make, part)
    alone = asked.run([windy], make, part)
    assert len(rows) == 2 and rows[0] == rows[1] == alone[0] and len(set(rows[0])) == 6
    both = given[0]
    for whole, own in zip(*map(jax.tree.leaves, given), strict=True):
        np.testing.assert_array_equal(_plain(whole)[6:], _plain(own))
    np.testing.assert_array_equal(both.given.weighed, [True] * 6 + [False] * 6)
    np.testing.assert_array_equal(both.given.hold_s, [1.0] * 6 + [3.0] * 6)
    np.testing.assert_array_equal(both.params.mass_scale, [1.0] * 6 + [2.0] * 6)
    np.testing.assert_array_equal(both.params.object_index, [0, 0, 0, 1, 1, 1] * 2)
    assert (both.given.faults.age[:6] == 0).all() and (both.given.faults.age[6:] == 5).all()
    assert not both.given.push.force[:6].any() and both.given.push.force[6:].any()


def _plain(leaf):
    """An array, of keys their numbers."""
    keys = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if keys else leaf)


def test_mjx_without_a_gpu_is_warned_of():
    console = Console(file=io.StringIO(), width=200)
    warn_without_gpu("mujoco", console)
    assert not console.file.getvalue()
    warn_without_gpu("mjx", console)
    assert "no GPU" in console.file.getvalue()


def test_own_objects_of_a_scenario_share_its_trials_and_have_one_each(robot):
    def trials(episodes, *own):
        problem = asked.problem(Scenario(objects=own), grasper_of, (Block(0, episodes, 0),))
        return np.bincount(problem.object_index).tolist()

    asked = makers(robot, "rubiks_cube", "foam_brick")
    assert trials(4) == [4, 4]
    assert trials(4, "apple") == [8]
    assert trials(4, "apple", "orange", "pear") == [2, 2, 2]
    assert trials(1, "apple", "orange", "pear") == [1, 1, 1]


def test_the_included_policy_closes_unless_something_else_is_named():
    robot, file = load_robot(), Path("own.npz")
    assert closing_policy("policy", None, robot) == asset_path("policy.npz")
    assert closing_policy("policy", file, robot) == file
    assert closing_policy("grip", None, robot) is None
    with pytest.raises(InputError, match=r"own\.npz.*none beside --controller grip"):
        ScenariosConfig(controller="grip", policy=file, out=Path("out.json"))
    with pytest.raises(InputError, match=r"--force-budget: found 4.0, expected none beside"):
        ScenariosConfig(controller="grip", force_budget=4.0, out=Path("out.json"))


def test_a_robot_without_a_policy_is_told_what_to_do():
    other = load_robot(Path(__file__).resolve().parents[2] / "examples/robot/six_axis.yaml")
    assert closing_policy("grip", None, other) is None
    with pytest.raises(InputError, match=r"--robot: found 'six_axis.*--controller grip"):
        closing_policy("policy", None, other)


def command(*arguments):
    line = [sys.executable, "-m", "mjx_grasp.scenarios", *arguments]
    return subprocess.run(line, capture_output=True, text=True, timeout=900)


def test_the_table_has_whole_names_in_a_narrow_terminal():
    root = Path(__file__).resolve().parents[2]
    kept = json.loads((root / "experiments/results/scenarios.json").read_text())["scenarios"]
    console = Console(width=80, file=io.StringIO())
    console.print(scenario_table(kept))
    shown = console.file.getvalue()
    assert {"moved_before_closing", "pushed_while_reaching"} <= set(kept)
    assert all(name in shown for name in kept) and "…" not in shown


@pytest.fixture
def quick(tmp_path, monkeypatch, committed):
    """Two scenarios of two parts each without a single grasp, and a run that is killed."""
    ran, batches, after = [], [], SimpleNamespace(runs=None)

    def counted(self, scenarios, make, part, progress):
        if len(ran) == after.runs:
            raise KeyboardInterrupt
        ((number, _, _),) = part
        ran.extend((scenario.hold_s, number) for scenario in scenarios)
        batches.append(len(scenarios))
        progress(0.5)
        return [[row(), row("slipped" if each.hold_s > 1 else "hit")] for each in scenarios]

    monkeypatch.setattr(Makers, "run", counted)
    monkeypatch.setattr(Makers, "check", lambda *_: None)
    files = tmp_path / "calm.yaml", tmp_path / "windy.yaml"
    files[0].write_text("hold_s: 1\n")
    files[1].write_text("push: {force: 1.0}\nhold_s: 3\n")
    config = ScenariosConfig(
        scenarios=tuple(map(str, files)),
        objects=("rubiks_cube",),
        episodes=2 * 64,
        out=tmp_path / "results" / "out.json",
    )
    config.out.parent.mkdir()

    def run(config=config):
        console = Console(file=io.StringIO(), width=200)
        run_scenarios(config, console)
        return console.file.getvalue()

    return SimpleNamespace(
        run=run, config=config, ran=ran, batches=batches, after=after, windy=files[1]
    )


@pytest.mark.parametrize("runs", [1, 2, 3])
def test_scenarios_that_were_killed_lose_no_part_and_the_file_holds_whole_ones(quick, runs):
    quick.after.runs, out = runs, quick.config.out
    with pytest.raises(KeyboardInterrupt):
        quick.run()
    left = json.loads(out.read_text()) if out.exists() else {"scenarios": {}}
    assert list(left["scenarios"]) == (["calm"] if runs > 1 else [])
    quick.after.runs = None
    said = quick.run()
    assert ("goes on after calm" in said) == (runs > 1)
    assert ("1 parts of the trials" in said) == (runs != 2)
    assert quick.ran == [(1.0, 0), (1.0, 1), (3.0, 0), (3.0, 1)], "none twice"
    found = json.loads(out.read_text())
    made = {"config", "sha256", "device", "robot", "provenance"}
    assert set(found) == {"schema", "scenarios"} | made
    for of in found["scenarios"].values():
        assert set(of) == {"settings", "meshes", "seconds", "all", "objects", "rows"}
        assert of["all"]["trials"] == len(of["rows"]) == 4
    assert list(out.parent.iterdir()) == [out]
    quick.run()
    assert len(quick.ran) == 4, "nothing is left"


def test_in_mjx_scenarios_of_a_kind_share_a_batch_and_each_has_its_own_rows(quick, tmp_path):
    """One with an obstacle is another one's batch: it is compiled anew."""
    ball = tmp_path / "ball.yaml"
    ball.write_text("obstacles: [{radius: 0.04}]\nhold_s: 2\n")
    calm, windy = quick.config.scenarios
    config = replace(quick.config, engine="mjx", scenarios=(calm, str(ball), windy))
    quick.after.runs = 2
    with pytest.raises(KeyboardInterrupt):
        quick.run(config)
    assert quick.batches == [2] and not config.out.exists()
    quick.after.runs = None
    quick.run(config)
    assert quick.batches == [2, 2, 1, 1]
    assert quick.ran == [(1.0, 0), (3.0, 0), (1.0, 1), (3.0, 1), (2.0, 0), (2.0, 1)], "none twice"
    found = json.loads(config.out.read_text())["scenarios"]
    assert list(found) == ["calm", "ball", "windy"], "as they are asked for"
    for name, of in found.items():
        assert [each["outcome"] for each in of["rows"]][1::2] == (
            ["hit", "hit"] if name == "calm" else ["slipped", "slipped"]
        )


def test_batches_are_all_cases_in_mjx_those_of_a_kind_together(robot):
    cases = list(range(40))
    native, warp = (
        makers(robot, "rubiks_cube", "apple", engine=engine) for engine in ("mujoco", "mjx")
    )
    assert native.batches(cases, lambda case: case % 2) == [[case] for case in cases]
    found = warp.batches(cases, lambda case: case % 2)
    assert found == [cases[::2], cases[1::2]]


@pytest.mark.parametrize("other", ["seed", "policy", "scenario", "mesh", "revision", "uncommitted"])
def test_scenarios_of_other_settings_files_or_code_are_run_again(
    quick, other, tmp_path, monkeypatch
):
    config, again = quick.config, [(1.0, 0), (1.0, 1), (3.0, 0), (3.0, 1)]
    revision = "abc-dirty" if other == "uncommitted" else "abc"
    monkeypatch.setattr("mjx_grasp.records.provenance.git_revision", lambda: revision)
    own = tmp_path / "policy.npz"
    own.write_bytes(asset_path("policy.npz").read_bytes())
    config = replace(config, policy=own)
    quick.after.runs = 3
    with pytest.raises(KeyboardInterrupt):
        quick.run(config)
    quick.after.runs = None
    if other == "seed":
        config = replace(config, seed=1)
    elif other == "policy":
        digests = {"policy": "0" * 64}
        monkeypatch.setattr(job, "file_digests", lambda **_: digests)
    elif other == "scenario":
        quick.windy.write_text("push: {force: 2.0}\nhold_s: 3\n")
        again = again[2:]
    elif other == "mesh":
        monkeypatch.setattr(job._Grasps, "meshes", lambda *_: {"rubiks_cube": "other"})
    elif other == "revision":
        revision = "abd"
    quick.run(config)
    assert quick.ran[3:] == again


@pytest.mark.long
def test_scenarios_run_are_told_of_and_go_on_where_they_stopped(tmp_path):
    out = tmp_path / "out.json"
    flags = ("--objects", "rubiks_cube", "--episodes", "2", "--out", str(out))
    done = command("--scenarios", "nominal", "pushed_in_hand", *flags)
    assert done.returncode == 0, done.stderr
    assert "pushed_in_hand" in done.stdout and str(out) in done.stderr
    written = json.loads(out.read_text())
    assert list(written["scenarios"]) == ["nominal", "pushed_in_hand"]
    for result in written["scenarios"].values():
        assert result["all"]["trials"] == len(result["rows"]) == 2
    assert written["scenarios"]["nominal"]["all"]["success"] == 2
    del written["scenarios"]["pushed_in_hand"]
    written["scenarios"]["nominal"]["seconds"] = 12345.0
    out.write_text(json.dumps(written))
    again = command("--scenarios", "nominal", "pushed_in_hand", *flags)
    assert "goes on after nominal" in " ".join(again.stderr.split())
    assert json.loads(out.read_text())["scenarios"]["nominal"]["seconds"] == 12345.0


def test_a_part_has_the_poses_and_headings_of_its_blocks_one_after_the_other(robot):
    asked = makers(robot, "rubiks_cube", "foam_brick")
    blocks = Block(0, 3, 5), Block(1, 2, 8)
    whole = asked.problem(Scenario(), grasper_of, blocks)
    alone = [asked.problem(Scenario(), grasper_of, (block,)) for block in blocks]
    for values, *parts in zip(whole, *alone, strict=True):
        np.testing.assert_array_equal(values, np.concatenate(parts))
    assert whole.object_index.tolist() == [0] * 3 + [1] * 3 + [0] * 2 + [1] * 2
