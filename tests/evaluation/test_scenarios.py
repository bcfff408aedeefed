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
from mjx_grasp.evaluation.grasps import job, worlds
from mjx_grasp.evaluation.grasps import makers as grasp_makers
from mjx_grasp.evaluation.grasps.blocks import Block
from mjx_grasp.evaluation.grasps.config import ScenariosConfig, warn_without_gpu
from mjx_grasp.evaluation.grasps.job import run_scenarios
from mjx_grasp.evaluation.grasps.kept import GraspEnd
from mjx_grasp.evaluation.grasps.makers import Makers
from mjx_grasp.evaluation.grasps.results import grasp_rows
from mjx_grasp.evaluation.grasps.run import closing_policy
from mjx_grasp.evaluation.grasps.scenario import (
    BeltConfig,
    PushConfig,
    Scenario,
    TrackerConfig,
    load_scenarios,
    scenario_names,
)
from mjx_grasp.evaluation.grasps.tables import scenario_table
from mjx_grasp.evaluation.grasps.trials import GraspProblem, trials_of
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.pipeline.assemble import grasper_of, whole_grasps
from mjx_grasp.pipeline.phases import Failure, Phase
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.tasks.success import initial_progress

DT = 0.01


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
