"""Tables of whole grasps, from results files."""

import json

import pytest
from generated import make_readme, values

from mjx_grasp.errors import FileError


def test_whole_grasps_have_their_table(tmp_path):
    summed = {"trials": 8, "success_percent": 87.5, "ci95": [52.9, 97.8], "up_at_9s": 6}
    summed |= dict(not_reached=1, never_lifted=0, slipped=1, not_held=0, hit=2)
    summed |= dict(lifted_s=3.14, tip_error_mm=[7.0, 5.5, 5.0], midpoint_mm=4.4)
    summed["force_mean_n"] = 2.5
    nominal = {"settings": {"description": "nothing happens"}, "all": summed | {"trials": 80}}
    nominal["objects"] = {"rubiks_cube": summed}
    row = {"object": "rubiks_cube", "outcome": "success", "returns": 0}
    others = [row | {"returns": 2}, row | {"outcome": "slipped"}]
    nominal["rows"] = [*[row] * 6, *others]
    path, tables = tmp_path / "scenarios.json", make_readme.grasp_tables
    assert tables.whole_grasps(path) == tables.scenarios(path) == tables.NOTHING
    assert tables.grasps_by_split(path) == tables.NOTHING
    config = {"controller": "policy", "force_budget": 8.0}
    path.write_text(json.dumps({"scenarios": {"nominal": nominal}, "config": config}))
    said, _, _, _, cube, every = tables.whole_grasps(path).splitlines()
    assert said == "Closed by the policy, with a force budget of 8 N, in native MuJoCo:"
    path.write_text(path.read_text().replace("policy", "grip"))
    assert tables.whole_grasps(path).startswith("Closed by the untrained grip alone, in native")
    cells = ["8", "87.5 (53–98)", "75.0", "75.0", "3.1", "2.5", "1", "1"]
    assert values(cube) == ["rubiks cube", *cells, "7.0 / 5.5 / 5.0"]
    assert every.startswith("| **all** | **80** |")
    said, _, _, _, scenario = tables.scenarios(path).splitlines()
    assert said.startswith("Closed by the untrained grip alone, in native")
    assert values(scenario)[0] == "nominal: nothing happens" and values(scenario)[-1] == "2"


def test_objects_of_training_and_others_have_sums_of_their_own(tmp_path):
    summed = {"trials": 4, "success_percent": 50.0, "ci95": [15.0, 85.0], "up_at_9s": 1}
    summed |= dict(not_reached=1, never_lifted=0, slipped=1, not_held=0, hit=2)
    summed |= dict(lifted_s=3.14, tip_error_mm=[7.0, 5.5, 5.0], midpoint_mm=4.4, force_mean_n=2.5)
    came = {"S": ("success", "none", True), "s": ("success", "none", False)}
    came |= {"L": ("slipped", "dropped", False), "N": ("not_reached", "no_candidate", False)}
    rows = [
        {"object": name, "returns": 0}
        | dict(zip(("outcome", "failure", "up_at_9s"), came[c], strict=True))
        for name, outcomes in (("rubiks_cube", "SsNL"), ("bowl", "NN"), ("chips_can", "SS"))
        for c in outcomes
    ]
    nominal = {"settings": {"description": "nothing happens"}, "all": summed, "rows": rows}
    nominal["objects"] = dict.fromkeys(("rubiks_cube", "bowl", "chips_can"), summed)
    config = {"controller": "policy", "force_budget": 8.0}
    path = tmp_path / "all.json"
    path.write_text(json.dumps({"scenarios": {"nominal": nominal}, "config": config}))
    *_, training, others, refused = make_readme.grasp_tables.grasps_by_split(path).splitlines()
    assert "33.3 % lifted and held, 16.7 % up after 9 s" in training
    assert "of the 3 trials of 6 in which there was a way, 66.7 % and 33.3 %" in training
    assert "100.0 % lifted and held" in others and "of the 2 trials of 2" in others
    assert refused == "- Trials without a way: bowl 2, rubiks cube 1."


def test_whole_grasps_in_short_are_of_all_trials_of_their_kind(tmp_path):
    def trials(name, held, lost=0):
        won = {"object": name, "outcome": "success", "lifted_s": 4.0, "force_mean_n": 3.0}
        fell = {"object": name, "outcome": "slipped", "lifted_s": 9.0, "force_mean_n": None}
        again = [won | {"returns": 1}] * (held > 2)
        return [
            *again,
            *[won | {"returns": 0}] * (held - len(again)),
            *[fell | {"returns": 0}] * lost,
        ]

    def scenario(rows, says):
        names = dict.fromkeys(row["object"] for row in rows)
        return {"settings": {"description": says}, "objects": names, "rows": rows}

    tables, (eight, every) = (
        make_readme.grasp_tables,
        (tmp_path / n for n in ("8.json", "all.json")),
    )
    calm = scenario(trials("apple", 9, 1), "nothing happens")
    windy = scenario(trials("apple", 1, 1), "wind")
    breezy = scenario(trials("apple", 6), "a breeze")
    of_all = scenario(trials("apple", 3, 1) + trials("bowl", 0, 4) + trials("chips_can", 2), "-")
    found = {"nominal": calm, "w": windy, "b": breezy}
    eight.write_text(json.dumps({"scenarios": found, "config": {}}))
    assert tables.grasps_in_short(eight, every) == tables.NOTHING
    every.write_text(json.dumps({"scenarios": {"nominal": of_all}}))
    _, _, *lines = tables.grasps_in_short(eight, every).splitlines()
    assert [values(line) for line in lines] == [
        ["the eight", "10", "90.0", "80.0", "4.0", "3.0"],
        ["2 scenarios together", "8", "87.5", "75.0", "4.0", "3.0"],
        ["the hardest of these: wind", "2", "50.0", "50.0", "4.0", "3.0"],
        ["2 objects of training", "8", "37.5", "25.0", "4.0", "3.0"],
        ["1 objects kept out of it", "2", "100.0", "100.0", "4.0", "3.0"],
    ]
    eight.write_text(json.dumps({"scenarios": {"nominal": calm}, "config": {}}))
    assert len(tables.grasps_in_short(eight, every).splitlines()) == 5


def test_the_same_whole_grasps_on_two_engines_are_compared_trial_by_trial(tmp_path):
    native, mjx = tmp_path / "native.json", tmp_path / "mjx.json"
    tables = make_readme.grasp_tables

    def scenario(outcomes, lifted_s):
        came = {"S": "success", "L": "slipped"}
        rows = [{"outcome": came[c], "lifted_s": lifted_s, "force_mean_n": 3.0} for c in outcomes]
        return {"rows": rows, "settings": {}, "meshes": {}}

    config = {"objects": ["eight"], "episodes": 1, "seed": 9, "controller": "policy"}
    config |= {"force_budget": 8.0}
    found = {"nominal": scenario("SSSS", 3.0), "side_grasp": scenario("SLLS", 5.0)}
    sha256 = {"policy": "1"}
    native.write_text(json.dumps({"config": config, "scenarios": found, "sha256": sha256}))
    assert tables.scenarios_by_engine(native, mjx) == tables.NOTHING
    other = {"nominal": scenario("SSSL", 4.0), "side_grasp": scenario("SLSS", 5.0)}
    in_mjx = config | {"engine": "mjx"}
    record = {"config": in_mjx, "scenarios": other | {"windy": other["nominal"]}, "sha256": sha256}
    mjx.write_text(json.dumps(record))
    _, _, *lines = tables.scenarios_by_engine(native, mjx).splitlines()
    nominal, side, every = ([cell.strip("*") for cell in values(line)] for line in lines)
    assert nominal == ["nominal", "4", "100.0", "75.0", "-25.0 (-75.0 to +0.0)", "75.0",
                       "3.0", "4.0", "3.0", "3.0"]  # fmt: skip
    assert side[:4] == ["side grasp", "4", "50.0", "75.0"] and side[5] == "75.0"
    assert every[:4] == ["all", "8", "75.0", "75.0"] and every[5] == "75.0"
    moved = other | {"side_grasp": other["side_grasp"] | {"meshes": {"mug": "other"}}}
    for change, message in (
        ({"config": in_mjx | {"seed": 8}}, r"seed 8, expected 9, as in .*native"),
        ({"sha256": {"policy": "2"}}, "another policy, expected that of"),
        ({"scenarios": moved}, "side_grasp of other meshes, expected those of"),
    ):
        mjx.write_text(json.dumps(record | change))
        with pytest.raises(FileError, match=message):
            tables.scenarios_by_engine(native, mjx)
    with pytest.raises(FileError, match=r"found mujoco, expected another engine than that of"):
        tables.scenarios_by_engine(native, native)
    # Of runs in blocks of 8 episodes one may have more of them than the other, but only whole ones.
    longer = {name: scenario("SSSSLL", 3.0) for name in found}
    for few, many, good in ((8, 16, True), (16, 64, True), (4, 8, False), (12, 64, False)):
        for one, other, seen in ((few, many, found), (many, few, longer)):
            says = {"config": config | {"episodes": one}, "scenarios": seen, "sha256": sha256}
            native.write_text(json.dumps(says))
            mjx.write_text(json.dumps(record | {"config": in_mjx | {"episodes": other}}))
            if not good:
                with pytest.raises(FileError, match=f"episodes {other}, expected {one}, as in"):
                    tables.scenarios_by_engine(native, mjx)
            else:
                line = values(tables.scenarios_by_engine(native, mjx).splitlines()[2])
                assert line[:4] == ["nominal", "4", "100.0", "75.0"], "those that both have"


def test_how_many_trials_there_are_is_read_from_the_results(tmp_path):
    table = make_readme.closing_tables.trials
    assert table(tmp_path, ["a"]) == make_readme.grasp_tables.NOTHING
    rows = [{"object": "mug", "episodes": n, "successes": 1} for n in (8, 8)]
    (tmp_path / "a.json").write_text(json.dumps({"rows": rows}))
    of_both = {"controllers": [{"cells": [rows, [{"object": "mug", "outcomes": "SSSSNLLSSSSS"}]]}]}
    (tmp_path / "b.json").write_text(json.dumps(of_both))
    grasps = {"scenarios": {"x": {"objects": {"mug": {"trials": 64}}, "rows": [{"object": "mug"}]}}}
    (tmp_path / "c.json").write_text(json.dumps(grasps))
    lines = table(tmp_path, ["a", "b", "c"]).splitlines()[2:]
    assert [values(line) for line in lines] == [
        ["a.json", "8", "448"],
        ["b.json", "8–12", "448"],
        ["c.json", "64", "448"],
    ]
