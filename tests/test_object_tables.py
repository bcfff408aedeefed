"""The table of all objects: parts, means that weigh objects alike, what has no start states."""

import importlib
import json
from pathlib import Path

import pytest

from mjx_grasp.errors import FileError, InputError

EXPERIMENTS = Path(__file__).resolve().parent.parent / "experiments"
ASSETS = EXPERIMENTS.parent / "assets"
SHIPPED = EXPERIMENTS / "results" / "eight_native.json"


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    return importlib.import_module("object_tables")


@pytest.fixture
def results(tmp_path):
    """Rows of a policy and a squeeze on two training objects and one that is held out."""
    content = json.loads(SHIPPED.read_text())
    rows = {row["controller"]: row for row in content["rows"]}
    plan = [("chips_can", 5, 3.0), ("mug", 10, 2.0), ("pear", 0, None)]
    letters = {  # of the can each lifts five others, two of them the same
        name: {
            "policy": "S" * good + "L" * (10 - good),
            "squeeze": "LLL" + "S" * good + "L" * (7 - good),
        }
        for name, good in (("chips_can", 5), ("pear", 0))
    } | {"mug": {"policy": "S" * 10, "squeeze": "S" * 10}}
    content["rows"] = [
        rows[kind]
        | {
            "object": name, "episodes": 10, "successes": good, "never_lifted": 10 - good,
            "not_held": 0, "slipped": 0, "outcomes": letters[name][kind], "forces_n": [],
            "starts": [], "force_mean_n": force, "ci95": [0.0, 100.0],
        }
        for kind in ("policy", "squeeze")
        for name, good, force in plan
    ]  # fmt: skip
    content["not_eligible"] = ["bowl"]
    path = tmp_path / "reached.json"
    path.write_text(json.dumps(content))
    return path


def test_objects_of_training_come_first_and_each_part_has_its_mean(tables, results):
    lines = [[c.strip(" *") for c in line.split("|")[1:-1]] for line in
             tables.objects(results).splitlines() if line.startswith("|")]  # fmt: skip
    assert [line[0] for line in lines[2:]] == ["mug", "pear", "chips can", "mean of 2", "mean of 1"]
    assert [line[1] for line in lines[2:5]] == ["training", "training", "held out"]
    mug, pear, can, training, held_out = lines[2:]
    assert mug[3] == "100 (0–100), 2.0 N" and pear[3] == "0 (0–100)"
    assert training[3] == "50.0, 2.0 N" and held_out[3] == can[3].replace("50 (0–100)", "50.0")
    assert training[-1] == "40.3 / 29.8" and held_out[-1] == ""
    assert [line[-2] for line in lines[2:]] == ["100", "0", "80", "50.0", "80.0"]
    assert lines[0][-2] == "any of these"
    assert lines[0][3].startswith("policy, budget") and lines[0][4].startswith("squeeze")


def test_policies_trained_on_all_objects_stand_beside_the_shipped_one(tables, results, tmp_path):
    assert tables.trained(tmp_path / "none.json", [results]) == "_No results file yet._"
    content = json.loads(results.read_text())
    content["rows"] = [row for row in content["rows"] if row["controller"] == "policy"]
    shipped, other = tmp_path / "shipped.json", tmp_path / "all-2.json"
    shipped.write_text(json.dumps(content))
    for row in content["rows"]:
        row |= {"successes": 10, "never_lifted": 0, "outcomes": 10 * "S"}
    other.write_text(json.dumps(content))
    lines = [[c.strip(" *") for c in line.split("|")[1:-1]] for line in
             tables.trained(shipped, [other]).splitlines()]  # fmt: skip
    assert lines[0] == ["controller", "training objects", "held out objects"]
    (budget,) = {row["force_budget_n"] for row in content["rows"]}
    assert lines[2:] == [
        [f"shipped: policy, budget {budget:g} N", "50.0 at 2.0 N", "50.0 at 3.0 N"],
        [f"all-2: policy, budget {budget:g} N", "100.0 at 2.0 N", "100.0 at 3.0 N"],
    ]
    content["sha256"]["handoffs"] = "0" * 64
    other.write_text(json.dumps(content))
    with pytest.raises(FileError, match=r"start states 0{8}.*those of shipped"):
        tables.trained(shipped, [other])


def test_objects_without_start_states_are_named(tables, results, tmp_path):
    assert tables.objects(results).endswith("Without start states: bowl.")
    assert tables.objects(tmp_path / "none.json") == "_No results file yet._"


def test_states_that_no_force_holds_are_counted(tables, tmp_path):
    path = tmp_path / "least_force.json"
    assert tables.statics(path) == "_No results file yet._"
    rows = [("mug", [1.0, 3.0, 2.0, None]), ("bowl", [None, None])]
    path.write_text(json.dumps({"rows": [{"object": n, "forces_n": f} for n, f in rows]}))
    lines = [[c.strip(" *") for c in line.split("|")[1:-1]] for line in
             tables.statics(path).splitlines()[2:]]  # fmt: skip
    assert lines == [["mug", "2.0", "75"], ["bowl", "", "0"], ["mean", "", "37.5"]]


@pytest.mark.long
def test_heavy_objects_are_gripped_harder_and_by_stronger_fingers(tables, tmp_path):
    script, out = importlib.import_module("heavy_objects"), tmp_path / "heavy.json"
    script.main(
        script.HeavyConfig(
            objects=("foam_brick",), handoffs=ASSETS / "handoffs_standins.npz", most=(8.0, 9.0),
            finger_torque=(1.0,), episodes=2, out=out,
        )
    )  # fmt: skip
    rows = json.loads(out.read_text())["rows"]
    assert [(row["most_n"], row["episodes"]) for row in rows] == [(8.0, 2), (9.0, 2)]
    assert all(row["successes"] == 2 and row["mass_kg"] == 0.028 for row in rows)
    header, _, line = tables.heavy(out).splitlines()
    assert header.split("|")[3:5] == [" up to 8 N, torque × 1 ", " up to 9 N, torque × 1 "]
    assert line.startswith("| foam brick | 0.03 | 100 at ")


def test_heavy_objects_without_states_are_refused(tables, tmp_path):
    script = importlib.import_module("heavy_objects")
    config = script.HeavyConfig(handoffs=ASSETS / "handoffs_standins.npz", out=tmp_path / "x.json")
    with pytest.raises(InputError, match=r"--objects.*bleach_cleanser"):
        script.main(config)
