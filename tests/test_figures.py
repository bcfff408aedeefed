"""The scripts of figures and tables, each on few stand-ins."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import handmade
import jax
import mujoco
import numpy as np
import pytest
import trimesh
from loaded import script
from PIL import Image

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.trials import Trials
from mjx_grasp.heatmap.compute import heatmap_of
from mjx_grasp.objects.model import load_objects
from mjx_grasp.pipeline.assemble import whole_grasps
from mjx_grasp.pipeline.known import known_object
from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.posture.body import robot_body
from mjx_grasp.records.atomic import write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.scene import build_scene
from mjx_grasp.training.config import settings_of
from mjx_grasp.viz.rendering import RenderError

ROOT = Path(__file__).resolve().parent.parent
IDENTITY = np.float32([1.0, 0.0, 0.0, 0.0])


def test_the_sheet_of_heatmaps(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    figure = script("heatmap_figure")
    out, results = tmp_path / "sheet.png", tmp_path / "sheet.json"
    figure.main(figure.FigureConfig(objects=("gelatin_box",), out=out, results=results))
    assert out.stat().st_size < 400_000
    (row,) = json.loads(results.read_text())["rows"]
    assert row["name"] == "gelatin_box" and 0.5 < row["best_score"] <= 1.0


def test_steering_brings_the_contacts_nearer(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    figure = script("steering_figure")
    monkeypatch.setattr(figure, "CASES", (("sugar_box", "the top"),))
    out, results = tmp_path / "steering.png", tmp_path / "steering.json"
    figure.main(figure.FigureConfig(out=out, results=results))
    content = json.loads(results.read_text())
    by_name = {r["steering"]: r["contacts_mm"] for r in content["rows"]}
    assert set(by_name) == {"default", "contacts", "axis", "between"}
    assert max(by_name["axis"], by_name["contacts"]) < by_name["default"] - 30
    assert content["provenance"]["git"] and Image.open(out).width > 400


def test_the_table_of_short_trainings_names_what_each_run_changed(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    changes = script("policy_ablation").changes
    preset = settings_of("gpu")
    assert changes(replace(preset, seed=3, out=Path("runs/a"), evaluation_episodes=0)) == {}
    reward = replace(preset.task.reward, held=0.0)
    ppo = replace(preset.ppo, iterations=240)
    unheld = changes(replace(preset, task=replace(preset.task, reward=reward), ppo=ppo))
    assert unheld == {"task.reward.held": 0.0, "ppo.iterations": 240}

    def row(name, seed, changes, of):
        each = [
            {"trials": 8, "condition": "hard", "budget_n": b, "success_percent": s}
            | {"force_mean_n": f, "within_3n_percent": 75.0}
            for b, s, f in of
        ]
        return {
            "run": f"{name}-seed{seed}",
            "seed": seed,
            "changes": {"ppo.iterations": 120} | changes,
            "env_steps": 15_728_640,
            "evaluations": each,
        }

    changed = {"task.reward.held": 0.0, "seen": [0, 1, 10], "drawn": [0.5, 2.0]}
    rows = [
        row("preset", 0, {}, [(1.5, 50.0, 1.0), (8.0, 87.5, 3.0)]),
        row("preset", 1, {}, [(1.5, 75.0, 1.0), (8.0, 87.5, 3.0)]),
        row("unheld", 0, changed, [(1.5, 87.5, 1.5), (8.0, 100.0, 3.5)]),
        row("unheld", 1, changed, [(1.5, 62.5, 2.5), (8.0, 75.0, 3.5)]),
    ]
    path = tmp_path / "ablation.json"
    path.write_text(json.dumps({"rows": rows[::-1]}))
    *said, header, _, first, second = script("policy_tables").ablation(path).splitlines()
    assert header == "| setting | hard, 1.5 N | hard, 8 N |"
    assert first == "| `preset` | 62.5 (75, 50) at 1.0 | 87.5 (88, 88) at 3.0 |"
    # Half way between the preset's two budgets: 75 at 2 N; beyond the larger it says nothing.
    assert second == (
        "| `unheld`: `task.reward.held` 0, `seen` 0, 1, 10, `drawn` 0.5 to 2 | "
        "75.0 (88, 62) at 2.0: +0.0 | 87.5 (100, 75) at 3.5 |"
    )
    assert "with 15.7 M steps" in said[0] and "2 seeds of each" in said[0]
    assert "differ by 18.8 points" in said[0]
    path.write_text(json.dumps({"rows": rows[:3]}))
    with pytest.raises(FileError, match="as many seeds of each"):
        script("policy_tables").ablation(path)
    path.write_text(json.dumps({"rows": rows[2:]}))
    with pytest.raises(FileError, match="runs of unheld, expected some of `preset`"):
        script("policy_tables").ablation(path)
    rows[0]["env_steps"] = 1
    path.write_text(json.dumps({"rows": rows}))
    with pytest.raises(FileError, match="all of the same length"):
        script("policy_tables").ablation(path)


def test_a_figure_of_films_asks_for_a_renderer_before_the_first_grasp(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    module, asked = script("steered_trials_figure"), []
    monkeypatch.setattr(sys.modules["renderer"], "BACKENDS", ("none",))
    monkeypatch.setattr(module, "run_demo", lambda *of: asked.append(of))
    config = module.TrialsConfig(out=tmp_path / "t.png", results=tmp_path / "t.json")
    with pytest.raises(RenderError, match="no renderer works here"):
        module.main(config)
    assert not asked and not list(tmp_path.iterdir())


def test_steered_grasps_are_shown_from_home_to_the_hold(tmp_path, monkeypatch):
    """Poses are tried until one succeeds, and what came of each is said."""
    monkeypatch.syspath_prepend(ROOT / "experiments")
    module, asked = script("steered_trials_figure"), []
    phases = [
        {"name": "reaching", "start": 0.0, "end": 2.0},
        {"name": "closing", "start": 2.0, "end": 2.4},
        {"name": "reaching", "start": 2.4, "end": 2.8},
        {"name": "lifting", "start": 3.2, "end": 5.0},
    ]

    def run_demo(demo, console):
        asked.append((demo.object, demo.objects_dir, demo.seed))
        success = demo.seed == 1 or demo.object == "mug"
        about = {"object": demo.object, "mesh": "scan", "asked": f"“{demo.instruction}” (part)"}
        about |= {"from_anchor_mm": 12.3, "at_best_mm": 9.1, "success": success, "phases": phases}
        return about | {"grasp": {"outcome": "success" if success else "not_held"}}

    film = [np.full((48, 64, 3), k, np.uint8) for k in range(100)]
    monkeypatch.setattr(module, "check_films", lambda: None)
    monkeypatch.setattr(module, "run_demo", run_demo)
    monkeypatch.setattr(module.iio, "imiter", lambda path: iter(film))
    monkeypatch.setattr(module, "CASES", (("mug", "by the handle"), ("wine_glass", "by the stem")))
    config = module.TrialsConfig(
        objects_dir=tmp_path, out=tmp_path / "t.png", results=tmp_path / "t.json", cell_pixels=64
    )
    module.main(config)
    assert asked == [("mug", tmp_path, 0), ("wine_glass", None, 0), ("wine_glass", None, 1)]
    rows = json.loads(config.results.read_text())["rows"]
    assert [row["outcomes"] for row in rows] == [["success"], ["not_held", "success"]]
    assert rows[1]["seed"] == 1 and rows[1]["at_best_mm"] == 9.1
    assert module.moments(phases, 100) == [0, 67, 80, 99], "the last reach counts"
    picture = np.asarray(Image.open(config.out))
    left, top = module._LEFT, module._HEAD
    shown = [int(picture[top + 20, left + k * (64 + module._GAP) + 30, 0]) for k in range(4)]
    assert shown == pytest.approx([0, 67, 80, 99], abs=8)
    failed = module.moments([{"name": "reaching", "start": 0.0, "end": 2.0}], 60)
    assert failed == [0, 37, 50, 59], "a hand that never lifts is shown where the reach ended"


def test_settings_of_the_published_preset_stand_beside_each_other(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    table = script("paper_ablation_tables").paper_ablation

    def row(name, seed, nominal, changes, states="own.npz"):
        judged = {"trials": 8, "force_mean_n": 2.0 + seed}
        return {
            "run": f"{name}-seed{seed}",
            "seed": seed,
            "trained": {
                "command": f"train --handoffs {states} --seed {seed}",
                "sha256": {"handoffs": states},
            },
            "env_steps": 30_801_920,
            "changes": {"engine": "mjx", "scene.physics_dt": 0.005} | changes,
            "evaluations": [
                judged | {"condition": "nominal", "success_percent": nominal},
                judged | {"condition": "hard", "success_percent": 25.0},
            ],
            "squeezes": [judged | {"squeeze_n": 3.0, "success_percent": 62.5}],
        }

    rows = [
        row("reference", 0, 50.0, {}),
        row("reference", 1, 75.0, {}),
        row("lift", 0, 87.5, {"task.lift.delay_s": 0.5, "task.action.residual": "leaky"}),
        row("lift", 1, 100.0, {"task.lift.delay_s": 0.5, "task.action.residual": "leaky"}),
    ]
    path = tmp_path / "paper_ablation.json"
    path.write_text(json.dumps({"rows": rows}))
    said, _, header, _, reference, lift = table(path).splitlines()
    assert "2 seeds of 30.8 M steps each" in said and "91.9 %" in said
    assert header.split(" | ")[1:] == ["nominal", "hard", "squeezes in the same task, nominal |"]
    assert reference.startswith("| `reference` | 62.5 (75, 50) at 2.5 | 25.0 (25, 25) at 2.5 |")
    assert reference.endswith("| 62.5 at 2.0 of 3 |")
    words = "`task.lift.delay_s` 0.5, `task.action.residual` leaky"
    assert lift.startswith(f"| `lift`: {words} | 93.8 (100, 88) at 2.5 |")
    much = {f"ppo.{k}": k for k in range(4)}
    further = [row("much", s, 50.0, much) for s in (0, 1)]
    further += [row("more", s, 50.0, much | {"seen": "all"}, "near.npz") for s in (0, 1)]
    path.write_text(json.dumps({"rows": [*further, *rows]}))
    *_, much, more = table(path).splitlines()
    assert much.startswith("| `much`: `ppo.0` 0, `ppo.1` 1, `ppo.2` 2, `ppo.3` 3 |")
    assert more.startswith("| `more`: as `much`, `handoffs` `near.npz`, `seen` all |")
    path.write_text(json.dumps({"rows": rows[:3]}))
    with pytest.raises(FileError, match="as many seeds of each"):
        table(path)
    assert table(tmp_path / "none.json") == "_No results file yet._"


def test_an_ablation_takes_folders_of_runs_and_judges_none_twice(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    module, judged = script("policy_ablation"), []
    plan = tmp_path / "plan"
    for name in ("a-seed0", "a-seed1", "unfinished"):
        (plan / name).mkdir(parents=True)
        write_json(plan / name / "provenance.json", {"command": name})
    for name in ("a-seed0", "a-seed1"):
        (plan / name / "policy.npz").touch()
    one, two = plan / "a-seed0", plan / "a-seed1"
    assert module.finished_runs(plan) == [one, two] and module.finished_runs(two) == [two]
    with pytest.raises(FileError, match="a finished run, or a folder of some"):
        module.finished_runs(plan / "unfinished")
    made = provenance(0) | {"git": "0" * 40}

    def evaluated(world, policy, conditions, *_):
        judged.append((policy.parent.name, tuple(conditions)))
        return []

    squeezed = []

    def nothing(*_, **__):
        return SimpleNamespace(object_names=())

    for name in ("load_robot", "load_handoffs", "build_scene_of", "states_of", "build_world"):
        monkeypatch.setattr(module, name, nothing)
    monkeypatch.setattr(module, "eligible", lambda *_: ((), ()))
    monkeypatch.setattr(module, "evaluated", evaluated)
    monkeypatch.setattr(module, "squeezed", lambda w, task, force, c: squeezed.append(force) or {})
    monkeypatch.setattr(module, "provenance", lambda seed: made)
    monkeypatch.setattr("mjx_grasp.records.journal.is_committed", lambda git: True)
    monkeypatch.setattr(module, "stored_config", lambda folder: settings_of("paper"))
    config = module.AblationConfig(
        (one,), out=tmp_path / "out.json", as_trained=True, squeezes=(1.0, 3.0)
    )
    module.main(config)
    module.main(replace(config, runs=(plan,)))
    conditions = ("nominal", "hard", "other robot", "as trained")
    assert judged == [("a-seed0", conditions), ("a-seed1", conditions)]
    assert squeezed == [1.0, 3.0, 1.0, 3.0], "once for a task in each call"
    assert len(json.loads(config.out.read_text())["rows"]) == 2
    judged.clear()
    module.main(replace(config, runs=(plan,), episodes=8))
    write_json(one / "provenance.json", {"command": "another training"})
    module.main(replace(config, runs=(plan,), episodes=8))
    assert [name for name, _ in judged] == ["a-seed0", "a-seed1", "a-seed0"]
    # Killed after the first row of another revision: the rows of the old one are made again.
    judged.clear()
    made["git"] = "1" * 40
    stops = {"a-seed1"}

    def killed(world, policy, *more):
        if policy.parent.name in stops:
            raise KeyboardInterrupt
        return evaluated(world, policy, *more)

    monkeypatch.setattr(module, "evaluated", killed)
    with pytest.raises(KeyboardInterrupt):
        module.main(replace(config, runs=(plan,), episodes=8))
    stops.clear()
    module.main(replace(config, runs=(plan,), episodes=8))
    assert [name for name, _ in judged] == ["a-seed0", "a-seed1"]
    module.main(replace(config, runs=(two,), episodes=4))
    (left,) = json.loads(config.out.read_text())["rows"]
    assert left["run"] == "a-seed1", "what was judged otherwise does not stand beside it"
    turned = replace(settings_of("paper").noise, angle_rad=0.1)
    assert module._felt(turned) is turned
    assert module._felt(settings_of("paper").noise) is module.CONDITIONS["other robot"]


def test_the_table_of_steered_grasps_pairs_them(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")

    def row(way, kind, outcome, achieved, easy=9.0, chosen=10.0):
        named = {"object": "mug", "kind": kind, "place": "rim", "steering": way}
        named |= {"height_mm": 60.0 if kind == "part" else 3.0}
        return named | {"outcome": outcome, "force_mean_n": 2.0} | {
            "nearest_mm": 8.0, "nearest_easy_mm": easy,
            "first_mm": achieved, "chosen_mm": chosen, "achieved_mm": achieved,
        }  # fmt: skip

    rows = [
        row("default", "part", "success", 40.0), row("default", "side", "success", 20.0),
        row("contacts", "part", "success", 12.0, chosen=11.9),
        row("contacts", "side", "slipped", None, 11.0, chosen=12.1),
    ]  # fmt: skip
    path = tmp_path / "grasps.json"
    path.write_text(json.dumps({"schema": "mjx_grasp.steered_grasps/4", "rows": rows}))
    lines = script("steering_tables").executed(path).splitlines()[2:]
    default = "8.0 | 9.0 | 40.0 | 10.0 | 40.0 |  |  |  |  | 100.0 | 2.0"
    assert lines[0] == f"| parts | 1 | default | {default} |"
    alone = "8.0 | 9.0 | 12.0 | 11.9 | 12.0 | 100 | 100 / 0 | 0 / 0 | 100 / 0 | 100.0 | 2.0"
    assert lines[1] == f"| parts | 1 | contacts | {alone} |"
    both = "8.0 | 10.0 | 12.0 | 12.0 | 12.0 | 50 | 100 / 0 | 0 / 50 | 100 / 0 | 50.0 | 2.0"
    assert lines[5] == f"| all | 2 | contacts | {both} |"
    only = f"| all that do not lie on the table | 1 | contacts | {alone} |"
    assert lines[-1] == only


@pytest.mark.long
def test_the_nearest_usable_contacts_are_the_nearest_of_all_high_in_the_air(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    module = script("steered_grasps")
    (can,), robot = load_objects(("tuna_fish_can",)), load_robot()
    heatmap = heatmap_of(can, robot.hand)
    known = known_object(can, robot, heatmap)
    contacts = np.concatenate([heatmap.thumb[:, None], heatmap.wrap], axis=1)
    good = heatmap.valid & (heatmap.score_without_com >= whole_grasps().selection.min_score)
    for place in module.places_of(0, can)[:2]:
        apart = np.linalg.norm(contacts[good] - place.anchor.point, axis=2).mean(axis=1)

        def nearest(height, place=place):
            return module.nearest_contacts(
                known, heatmap, place, np.float32([0.5, 0.0, height]), IDENTITY
            )

        high, easy = nearest(0.5)
        assert high == pytest.approx(1e3 * apart.min(), abs=6.0)  # wraps turn with the reach axis
        assert high <= easy <= 1e3 * apart.max() + 6.0
        low = float(can.mesh.vertices[:, 2].min())
        assert nearest(-low).usable >= high
        assert nearest(-0.5) == (None, None)


@pytest.mark.long
def test_the_end_of_what_lies_is_held_less_easily_than_its_middle(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    module, robot = script("steered_grasps"), load_robot()
    (can,) = load_objects(("chips_can",))
    heatmap = heatmap_of(can, robot.hand)
    known = known_object(can, robot, heatmap)
    lying = np.float32([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
    p_wo = np.float32([0.5, 0.0, can.mesh.vertices[:, 0].max()])
    places = {place.name: place for place in module.places_of(0, can)}
    usable, easy = module.nearest_contacts(known, heatmap, places["top"], p_wo, lying)
    assert easy > usable + 20.0


def test_what_a_grasp_achieves_is_where_the_pads_are_as_the_lift_begins(monkeypatch):
    """By MuJoCo's own sites, in the object's frame; without a lift it is nothing."""
    monkeypatch.syspath_prepend(ROOT / "experiments")
    module, robot = script("steered_grasps"), load_robot()
    scene = build_scene(load_objects(("mug",)), robot)
    body = robot_body(robot)
    data = mujoco.MjData(scene.model)
    data.qpos[scene.addresses.robot_qpos] = body.home
    data.qpos[scene.addresses.object_qpos] = [0.5, 0.1, 0.2, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
    mujoco.mj_forward(scene.model, data)
    pads = np.stack([data.site(f.pad_site).xpos for f in robot.hand.fingers])
    turned_back = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # by 90° about z
    expected = (pads - [0.5, 0.1, 0.2]) @ turned_back.T
    phases = [[Phase.REACHING] * 2, [Phase.CLOSING] * 2, [Phase.LIFTING, Phase.FAILED]]
    trace = SimpleNamespace(
        phase=np.array(phases), qpos=np.tile(data.qpos, (3, 2, 1)), contacts=np.ones((3, 2, 3, 3))
    )
    grasper = SimpleNamespace(reacher=SimpleNamespace(body=body))
    first, chosen, achieved = module.contacts_in_object(
        grasper, SimpleNamespace(scene=scene), trace
    )
    assert achieved[0] == pytest.approx(expected, abs=1e-5) and np.isnan(achieved[1]).all()
    assert first == pytest.approx(chosen) and first[0, 0] == pytest.approx([0.9, -0.5, 0.8])


def test_every_place_is_steered_to_from_as_many_poses_as_asked_for(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    module = script("steered_grasps")
    one, three = (
        module.Steered(module.SteeredConfig(objects=("pear", "mug"), poses=n)) for n in (1, 3)
    )
    asked = [[(place.index, place.name) for place in each._places] for each in (one, three)]
    assert [place for place in asked[0] for _ in range(3)] == asked[1]
    assert list(three._problem.object_index) == [place.index for place in three._places]
    assert len(np.unique(three._problem.p_wo, axis=0)) == len(three._places)
    assert len(np.unique(three._problem.seed)) == len(three._places)


def test_the_table_of_foreign_meshes_has_outcomes_and_refusals(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    held = {"refused": None, "outcome": "never_lifted", "lifted_s": None, "force_mean_n": 1.0}
    meshes = {"cone": held, "crate": {"refused": "too large"}}
    meshes |= {"ring": held | {"outcome": "success", "lifted_s": 4.24}}
    path = tmp_path / "foreign.json"
    path.write_text(json.dumps({"schema": "mjx_grasp.foreign_meshes/1", "meshes": meshes}))
    assert script("grasp_tables").foreign_meshes(path).splitlines()[2:] == [
        "| cone | never lifted, not lifted |",
        "| crate | too large |",
        "| ring | success, lifted after 4.2 s |",
    ]


def test_steering_by_numbers_on_one_object(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    numbers = script("steering_numbers")
    out = tmp_path / "numbers.json"
    numbers.main(numbers.NumbersConfig(objects=("wine_glass",), out=out))
    rows = json.loads(out.read_text())["rows"]
    assert len(rows) == (3 + 6) * 4
    assert {r["place"] for r in rows if r["kind"] == "part"} == {"stem", "rim", "foot"}
    stem = {r["steering"]: r for r in rows if r["place"] == "stem"}
    assert stem["contacts"]["on_part"] and not stem["axis"]["on_part"]
    assert stem["contacts"]["contacts_mm"] < 20 < stem["axis"]["contacts_mm"]
    for row in rows:
        assert row["contacts_mm"] == pytest.approx(np.mean(row["apart_mm"]), abs=0.01)
        assert (row["on_part"] is None) == (row["kind"] == "side")
        assert row["contacts_mm"] >= row["nearest_mm"] - 0.01 or row["quality"] < 0.05


def test_steering_by_numbers_goes_on_with_the_object_that_it_was_stopped_at(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    numbers, looked_at, fails = script("steering_numbers"), [], {"mug"}

    def seen(name, *_):
        looked_at.append(name)
        if name in fails:
            raise KeyboardInterrupt
        return name

    monkeypatch.setattr(numbers, "seen", seen)
    monkeypatch.setattr(numbers, "rows_of", lambda obj: iter([{"object": obj}]))
    monkeypatch.setattr(numbers, "provenance", lambda seed: provenance(seed) | {"git": "0" * 40})
    monkeypatch.setattr("mjx_grasp.records.journal.is_committed", lambda git: True)
    config = numbers.NumbersConfig(objects=("apple", "mug"), out=tmp_path / "numbers.json")
    with pytest.raises(KeyboardInterrupt):
        numbers.main(config)
    fails.clear()
    numbers.main(config)
    assert looked_at == ["apple", "mug", "mug"]
    assert [r["object"] for r in json.loads(config.out.read_text())["rows"]] == ["apple", "mug"]
    assert [path.name for path in tmp_path.iterdir()] == ["numbers.json"]


def test_the_table_of_convex_pieces(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")  # as when it is run as a script
    scans, out = tmp_path / "scans", tmp_path / "pieces.json"
    scans.mkdir()
    trimesh.creation.icosphere(subdivisions=3, radius=0.02).export(scans / "058_golf_ball.obj")
    cubes = [trimesh.creation.box(extents=(0.04,) * 3) for _ in range(2)]
    cubes[0].export(scans / "061_foam_brick.obj")
    cubes[1].apply_translation((0.1, 0.0, 0.0))
    trimesh.util.concatenate(cubes).export(scans / "025_mug.obj")
    pieces = script("convex_pieces")
    names = ("golf_ball", "wine_glass", "foam_brick", "mug")
    pieces.main(pieces.PiecesConfig(out, scans, objects=names, cache_dir=tmp_path))
    content = json.loads(out.read_text())
    assert content["schema"] == "mjx_grasp.convex_pieces/1" and content["provenance"]["git"]
    assert content["without_scan"] == ["wine_glass"]
    found = {r.pop("object"): tuple(r.values()) for r in content["rows"]}
    assert found["golf_ball"][:3] == ("sphere", 1, 0)
    assert found["foam_brick"][:3] == ("hull", 1, 8)
    assert found["mug"][:3] == ("pieces", 2, 8)
    assert found["foam_brick"][3:] == pytest.approx((0.0, 0.0), abs=1e-3)
    # The gap is 60 mm wide; 5 % of a common hull's surface lie within 4 mm of its middle.
    assert found["mug"][3:] == (pytest.approx(0.0, abs=1e-3), pytest.approx(26.0, abs=0.5))
    text = sys.modules["simulation_tables"].convex_pieces(out)
    assert "Of 3 objects 1 are spheres, 1 one hull" in text and "scan: wine glass" in text
    assert "| mug | pieces | 2 | 8 | 0.00 | 2" in text
    assert "at most 2 (12 are allowed, 24 where these are off by more), of at most 8" in text


def test_a_training_is_summed_up_by_the_iterations_in_which_episodes_ended(tmp_path):
    """In the first ones none has: they say nothing of return and success."""
    module = script("time_make_train")
    path = tmp_path / "metrics.csv"
    early = [f"{k},{10 * k},{k},nan,nan" for k in range(1, 4)]
    later = [f"{k},{10 * k},{k},{100 + k},0.5" for k in range(4, 14)]
    head = "iteration,env_steps,seconds,return,success"
    path.write_text("\n".join((head, *early, *later)))
    found = module.curve(path)
    assert (found["return_first_tenth"], found["return_last_tenth"]) == (104.0, 113.0)
    assert (found["iterations"], found["env_steps"], found["training_s"]) == (13, 130, 13.0)
    assert found["success_last_tenth_percent"] == 50.0
    path.write_text("\n".join((head, *early)))
    with pytest.raises(FileError, match="0 iterations with episodes"):
        module.curve(path)


def test_a_folder_without_scans_is_refused(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    pieces = script("convex_pieces")
    with pytest.raises(FileError, match="no scan of these objects"):
        pieces.main(pieces.PiecesConfig(tmp_path / "out.json", objects_dir=tmp_path))


@pytest.mark.long
def test_the_engines_are_timed_and_compared(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    benchmark, out = script("engines", "benchmarks"), tmp_path / "engines.json"
    benchmark.main(
        benchmark.EnginesConfig(out, worlds=(2,), engines=("mujoco",), warm_up=2, ticks=1)
    )
    content = json.loads(out.read_text())
    (native,) = content["rows"]
    assert content["schema"] == "mjx_grasp.engines/1" and content["substeps"] == 5
    assert native["control_steps_per_s"] == pytest.approx(2e3 / native["ms_per_control_tick"])
    slow = native | {"engine": "mjx", "control_steps_per_s": native["control_steps_per_s"] / 40}
    out.write_text(json.dumps(content | {"rows": [slow, native]}))
    assert "| 40 × |" in script("simulation_tables").engines(out)


def test_the_ablation_goes_on_where_it_stopped(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    ablation = script("reach_ablation")
    swept = []

    names = {id(settings): name for name, settings in ablation.PRESETS.items()}

    def run_sweep(robot, settings, count, seed, **_):
        assert (count, seed) == (8, 4)
        swept.append(names[id(settings)])
        if len(swept) == 3:
            raise KeyboardInterrupt
        values = {t: dict.fromkeys(("1", "3", "7"), 50.0) for t in ("20", "10")}
        wrap = {"median": 5.0, "mean": 6.0}
        made = {"rate_percent": values, "handoff_mm": {"index": wrap, "middle": wrap}}
        return SimpleNamespace(result=made | {"seconds_to_20mm": {"50": 1.5}, "poses": 8})

    monkeypatch.setattr(ablation, "run_sweep", run_sweep)
    config = ablation.AblationConfig(out=tmp_path / "ablation.json", poses=8, seed=4)
    with pytest.raises(KeyboardInterrupt):
        ablation.main(config)
    presets = list(ablation.PRESETS)
    sweep = json.loads(config.out.read_text()) | {"preset": "default"}
    sweep |= sweep.pop("rows")["paper"]
    (tmp_path / "sweep.json").write_text(json.dumps(sweep))
    ablation.main(replace(config, resume=True, sweeps=(tmp_path / "sweep.json",)))
    assert swept == presets[:3] + presets[2:-1]
    rows = json.loads(config.out.read_text())["rows"]
    assert list(rows) == presets and all(row["provenance"]["git"] for row in rows.values())
    with pytest.raises(InputError, match="'seed': 5"):
        ablation.main(replace(config, seed=5, resume=True))
    with pytest.raises(FileError, match=r"nothing\.json"):
        ablation.main(replace(config, sweeps=(tmp_path / "nothing.json",)))


def test_a_suite_that_failed_keeps_its_row_too(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    timing = script("time_tests")
    report, out = tmp_path / "tests.xml", tmp_path / "tests.json"
    report.write_text(
        "<testsuites><testsuite>"
        "<testcase classname='tests.a' name='passes'/>"
        "<testcase classname='tests.a' name='fails'><failure>no</failure></testcase>"
        "<testcase classname='tests.b' name='breaks'><error>oh</error></testcase>"
        "<testcase classname='tests.b' name='waits'><skipped/></testcase>"
        "</testsuite></testsuites>"
    )
    found = timing.counts(report)
    assert found == {"passed": 1, "failed": ["tests.a.fails", "tests.b.breaks"]} | {
        "skipped": ["tests.b.waits"]
    }
    made = {"device": "a card", "git": "0123456789abcdef", "versions": {}}

    def row(python, seconds):
        versions = {"versions": {"python": python, "jax": "1.0"}}
        return found | {"setup_s": 60.0, "test_s": seconds, "provenance": made | versions}

    for python, seconds in (("3.12.1", 90.0), ("3.11.7", 600.0), ("3.12.1", 630.0)):
        timing.write(out, row(python, seconds))
    assert [r["test_s"] for r in json.loads(out.read_text())["rows"]] == [600.0, 630.0]
    table = script("speed_tables").tests(out)
    assert "| 3.12.1 | 1.0 | a card | 1 | 2 | 1 | 10.5 | 1.0 | 0123456789ab |" in table
    with pytest.raises(FileError, match=r"none\.xml"):
        timing.counts(tmp_path / "none.xml")


def test_a_png_is_reduced_to_the_size_asked_for_or_refused(tmp_path):
    write_png = script("small_png").write_png
    noise = np.asarray(jax.random.randint(jax.random.key(0), (90, 90, 3), 0, 256), np.uint8)
    sheet = Image.fromarray(noise)
    write_png(tmp_path / "all.png", sheet, 1_000_000)
    full = (tmp_path / "all.png").stat().st_size
    assert np.array_equal(np.asarray(Image.open(tmp_path / "all.png")), noise)
    write_png(tmp_path / "less.png", sheet, 3 * full // 4)
    assert (tmp_path / "less.png").stat().st_size <= 3 * full // 4
    less = np.asarray(Image.open(tmp_path / "less.png"))
    assert 0 < np.abs(less.astype(int) - noise).max() <= 4
    assert np.all(less[noise == 255] == 255)
    with pytest.raises(InputError, match="max_bytes"):
        write_png(tmp_path / "none.png", sheet, 200)
    assert not (tmp_path / "none.png").exists()


def test_the_table_and_the_picture_of_pose_errors(tmp_path, monkeypatch):
    """One line per error with the published figure where there is one."""
    monkeypatch.syspath_prepend(ROOT / "experiments")

    def cell(offset, angle, outcomes):
        named = {"offset_mm": offset, "angle_deg": angle, "object": "mug", "outcomes": outcomes}
        return named | {"starts": [0, 1, 2, 3], "forces_n": [2.0, 2.0, None, 2.0]}

    rows = [cell(0.0, 0.0, "SSSS"), cell(10.0, 5.0, "SLLL")]
    path = tmp_path / "pose_error.json"
    path.write_text(json.dumps({"controllers": {"policy": rows, "grip": rows}}))
    tables = script("paper_tables")
    first, second = tables.pose_errors(path).splitlines()[2:]
    assert first.startswith("| ±0 mm | 0° | 100.0 (100–100), 2.0 N |") and "| 89.3 |" in first
    assert second.startswith("| ±10 mm | 5° | 25.0 (0–75), 2.0 N |") and "| 80.4 |" in second
    figure = script("pose_error_figure")
    figure.main(figure.FigureConfig(results=path, out=tmp_path / "pose_error.png"))
    assert Image.open(tmp_path / "pose_error.png").width > 400


def test_pose_error_goes_on_where_it_stopped_but_only_with_its_own_settings(
    tmp_path, monkeypatch, committed
):
    """A controller that is in the file is not run again."""
    monkeypatch.syspath_prepend(ROOT / "experiments")
    pose_error, ran = script("pose_error"), []

    class Counting:
        def __init__(self, found, episodes, seed, engine, angle_rad, beside):
            self.found = found
            assert beside == 1

        def rows(self, name, conditions):
            (_,) = conditions
            ran.append(self.found.contestants[name].force)
            if len(ran) == 3:
                raise KeyboardInterrupt
            return [[{"outcomes": "S"}]]

    monkeypatch.setattr(pose_error, "Runner", Counting)
    config = pose_error.PoseErrorConfig(
        out=tmp_path / "errors.json", objects=("rubiks_cube",), budgets=(3.0,), squeezes=(3.0,),
        offsets_mm=(5.0, 10.0), angles_deg=(0.0,),
    )  # fmt: skip
    with pytest.raises(KeyboardInterrupt):
        pose_error.main(config)
    ran.append(None)
    pose_error.main(config)
    assert ran == [3.0, 3.0, 3.0, None, 3.0, 3.0, 2.5, 2.5]
    found = json.loads(config.out.read_text())["controllers"]
    assert list(found) == ["policy, budget 3 N", "squeeze 3 N", "grip"]
    pose_error.main(replace(config, episodes=3))
    assert ran[8:] == [3.0, 3.0, 3.0, 3.0, 2.5, 2.5]


@pytest.fixture
def sensitivity(tmp_path, monkeypatch, committed):
    """The script with trials that are only noted, and settings with few values."""
    monkeypatch.syspath_prepend(ROOT / "experiments")
    module, noted = script("sensitivity"), []

    def trials(task, controller, draw, worlds):
        noted.append((task.physics.scene.config.finger_torque, jax.device_get(draw)))
        module.batches_of.append(worlds)
        if len(noted) == module.stop_at:
            raise KeyboardInterrupt
        yes, no = np.ones(len(draw.row), bool), np.zeros(len(draw.row), bool)
        shown = dict.fromkeys(Trials._fields, no) | {"row": np.asarray(draw.row), "success": yes}
        return Trials(**shown | {"force_mean": 2.0 * yes})

    module.stop_at, module.batches_of = 0, []
    monkeypatch.setattr(sys.modules["compared"], "run_trials", trials)
    config = module.SensitivityConfig(
        out=tmp_path / "sensitivity.json",
        objects=("rubiks_cube", "sugar_box"),
        budgets=(3.0,),
        squeezes=(3.0,),
        episodes=3,
        frictions=(0.4, 0.8),
        masses=(0.5, 2.0),
        stiffnesses=(1.0,),
        torques=(0.25, 0.5, 1.0),
    )
    return SimpleNamespace(module=module, noted=noted, config=config)


@pytest.mark.long
def test_sensitivity_changes_one_thing_at_a_time_under_the_same_draws(sensitivity):
    sensitivity.module.main(sensitivity.config)
    seen, numbers = [], ("friction", "mass_scale", "stiffness", "torque")
    usual = dict.fromkeys(numbers, 1.0) | {"friction": 0.8}
    for torque, draw in sensitivity.noted:
        shared = sensitivity.noted[0][1]
        np.testing.assert_array_equal(draw.offset, shared.offset)
        np.testing.assert_array_equal(draw.row, shared.row)
        values = (draw.friction, draw.mass_scale, draw.robot.stiffness, np.full(6, torque))
        found = {n: float(x[0]) for n, x in zip(numbers, values, strict=True)}
        assert all(np.ptp(x) == 0 for x in values)
        seen.append({n: x for n, x in found.items() if not np.isclose(x, usual[n])})
    assert 0.004 < np.abs(shared.offset).max() <= 0.005
    weak = [{"torque": 0.25}, {"torque": 0.5}]
    changed = [{}, {"friction": pytest.approx(0.4)}, {"mass_scale": 0.5}, {"mass_scale": 2.0}]
    scenes = [three for limit in weak for three in 3 * [limit]]
    assert seen == 3 * changed + scenes, "one scene after the other"
    content = json.loads(sensitivity.config.out.read_text())
    assert content["schema"] == "mjx_grasp.sensitivity/1" and content["provenance"]["git"]
    assert set(content["sha256"]) == {"policy", "handoffs"}
    grip = content["controllers"]["grip"]
    assert [(r["object"], r["value"], r["outcomes"]) for r in grip["torque"]] == [
        (name, value, "SSS") for value in (0.25, 0.5) for name in ("rubiks_cube", "sugar_box")
    ]
    assert len(grip["nominal"]) == 2 and "stiffness" not in grip


@pytest.mark.long
def test_sensitivity_goes_on_where_it_stopped_but_only_with_its_own_settings(sensitivity):
    module, noted, config = sensitivity.module, sensitivity.noted, sensitivity.config
    module.stop_at = 8  # the second value of the second controller's masses
    with pytest.raises(KeyboardInterrupt):
        module.main(config)
    done = json.loads(config.out.read_text())["controllers"]
    assert [list(of) for of in done.values()] == [
        ["nominal", "friction", "mass"],
        ["nominal", "friction"],
    ]
    module.main(config)
    assert len(noted) == 8 + (3 * 6 - 7)
    module.main(config)
    assert len(noted) == 19, "nothing is left"
    module.main(replace(config, seed=3))
    assert len(noted) == 19 + 18


def test_conditions_that_share_a_batch_in_mjx_have_the_rows_of_those_alone(sensitivity):
    """With room for all of a scene there is one batch for each controller and scene."""
    module, noted, config = sensitivity.module, sensitivity.noted, sensitivity.config
    module.main(replace(config, engine="mjx", episodes=1200))  # no room for two conditions
    assert [len(draw.row) for _, draw in noted] == 18 * [2 * 1200]
    noted.clear()
    module.main(replace(config, engine="mjx"))
    assert [len(draw.row) for _, draw in noted] == 3 * [4 * 6] + 6 * [6]
    assert module.batches_of[-9:] == 3 * [4 * 6] + 6 * [6]
    rows = json.loads(config.out.read_text())["controllers"]
    assert list(rows) == ["policy, budget 3 N", "squeeze 3 N", "grip"]
    frictions = [draw.friction for _, draw in noted[:3]]
    assert all(np.allclose(of, np.repeat([0.8, 0.4, 0.8, 0.8], 6)) for of in frictions)
    assert [(r["object"], r["value"]) for r in rows["grip"]["mass"]] == [
        (name, value) for value in (0.5, 2.0) for name in ("rubiks_cube", "sugar_box")
    ]


def test_errors_of_the_pose_share_batches_as_even_as_can_be(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    module = script("pose_error")
    found = SimpleNamespace(names=["one", "two"])
    for engine, episodes, sizes in (
        ("mjx", 200, [8, 7]),
        ("mjx", 2, [15]),
        ("mujoco", 2, 15 * [1]),
    ):
        config = module.PoseErrorConfig(engine=engine, episodes=episodes)
        batches = module.batches(config, found)
        assert [len(some) for some in batches] == sizes
        assert [each for some in batches for each in some] == module.conditions(config)


@pytest.mark.parametrize("bad", [(), (0.0,), (0.8, 0.4), (0.8, 0.8), (float("inf"),)])
def test_values_of_sensitivity_are_positive_and_ascend(sensitivity, bad):
    for name in ("frictions", "masses", "stiffnesses", "torques"):
        with pytest.raises(InputError, match=f"^--{name}: "):
            replace(sensitivity.config, **{name: bad})


def test_the_comparisons_need_an_object_with_start_states(sensitivity):
    with pytest.raises(InputError, match=r"--objects: .*wine_glass.*some of "):
        sensitivity.module.main(replace(sensitivity.config, objects=("wine_glass",)))


def test_the_table_and_the_picture_of_sensitivity(tmp_path, monkeypatch):
    """Nominal trials are in every curve; what was not run yet is empty, as is a force of nobody."""
    monkeypatch.syspath_prepend(ROOT / "experiments")

    def row(outcomes, value=None, force=2.0):
        named = {"object": "mug", "outcomes": outcomes, "starts": [0, 1, 2, 3]}
        named |= {} if value is None else {"value": value}
        return named | {"forces_n": [force] * 4}

    one = {"nominal": [row("SSSS")], "mass": [row("SSLL", 2.0), row("SSSS", 0.5)]}
    parts = {"policy": one | {"torque": [row("NNNN", 0.25, None)]}, "grip": one}
    nominal = {"friction": 0.8, "mass": 1.0, "stiffness": 1.0, "torque": 1.0}
    path = tmp_path / "sensitivity.json"
    table = script("sensitivity_tables").sensitivity
    assert table(path) == script("markdown_tables").NOTHING
    path.write_text(json.dumps({"controllers": parts, "nominal": nominal}))
    full = "100.0 (100–100), 2.0 N"
    assert table(path).splitlines()[2:] == [
        f"| object's mass | 0.5 × | {full} | {full} |",
        f"| object's mass | 1 × (nominal) | {full} | {full} |",
        "| object's mass | 2 × | 50.0 (0–100), 2.0 N | 50.0 (0–100), 2.0 N |",
        "| torque limit | 0.25 × | 0.0 (0–0) |  |",
        f"| torque limit | 1 × (nominal) | {full} |  |",
    ]
    figure = script("sensitivity_figure")
    figure.main(figure.FigureConfig(results=path, out=tmp_path / "sensitivity.png"))
    assert Image.open(tmp_path / "sensitivity.png").width > 400


def test_a_hold_lasts_from_a_rise_of_5_cm_until_the_object_is_lower():
    """Clock and duration of three objects: held to the end, dropped, never lifted."""
    stability = script("lift_stability")
    rise = np.zeros((100, 3))
    rise[20:, 0] = rise[30:70, 1] = 0.1
    curves = stability.Curves(rise, *[np.zeros((100, 3))] * 3)
    clock = stability.since_risen(curves, 0.05, 0.01)
    np.testing.assert_allclose(clock[[0, 20, 99], 0], [-0.2, 0.0, 0.79], atol=1e-9)
    assert np.isnan(clock[:, 2]).all()
    np.testing.assert_allclose(stability.held_for(curves, 0.05, 0.01), [0.8, 0.4, 0.0], atol=1e-9)


def test_a_falling_object_lacks_its_weight_and_a_spinning_one_nothing():
    """Newton and Euler: free fall, then steady spin about an axis of inertia."""
    stability = script("lift_stability")
    box, ticks, dt = handmade.box(), 50, 0.01
    still = np.broadcast_to(np.array([1.0, 0, 0, 0], np.float32), (ticks, 1, 4))
    vel = np.zeros((ticks, 1, 6))
    vel[:, 0, 2] = -9.81 * dt * np.arange(ticks)
    vel[:, 0, 5] = 2.0
    nothing = np.zeros((ticks, 1)), np.zeros((ticks, 1, 3))
    curves = stability.curves_of((*nothing, still, vel), box, dt)
    np.testing.assert_allclose(curves.net_force, 9.81 * box.mass, rtol=1e-4)
    np.testing.assert_allclose(curves.net_moment, 0.0, atol=1e-9)
