"""Tables of closing, from results files."""

import hashlib
import json
from dataclasses import replace

from generated import PROVENANCE, make_readme, result, values

from mjx_grasp.evaluation.results import write_results
from mjx_grasp.evaluation.statistics import wilson_interval
from mjx_grasp.robot.identity import FIRST_ROBOT


def test_settings_of_another_file_are_added_once_and_where_there_are_others():
    column = make_readme.closing_tables.Column
    policy, light, again, hard = (column(n, {}) for n in ("policy", "1 N", "1 N", "9 N"))
    groups, more = {"nominal": [policy, light], "hard": [policy]}, {"nominal": [again, hard]}
    found = make_readme.closing_tables.with_more(groups, more | {"slippery": [hard]})
    assert found == {"nominal": [policy, light, hard], "hard": [policy]}


def test_what_was_chosen_among_stands_in_the_order_of_the_runs(tmp_path):
    command = (
        "python -m mjx_grasp.train --preset gpu --task.reward.spent -1 --seed {} --out runs/{}"
    )
    rows = [
        {"run": name, "seed": seed, "provenance": {"command": command.format(seed, name)}}
        for seed, name in enumerate(("second", "first"))
    ]
    runs = {"schema": "mjx_grasp.training_runs/1", "provenance": PROVENANCE, "rows": rows}
    (tmp_path / "training_runs.json").write_text(json.dumps(runs))
    (tmp_path / "choice").mkdir()
    for name, successes in (("first", 48), ("second", 16)):
        tried = replace(result("apple", successes, 5.0), force_budget_n=3.0)
        hard = replace(result("apple", 0, 10.0), friction=0.5, force_budget_n=3.0)
        path = tmp_path / "choice" / f"{name}.json"
        write_results(path, [tried, hard], PROVENANCE, FIRST_ROBOT)
    _, _, *lines = make_readme.policy_tables.choice(
        tmp_path / "choice", tmp_path / "training_runs.json"
    ).splitlines()
    flag = "`task.reward.spent -1`"
    assert [values(line) for line in lines] == [
        ["second", flag, "0", "3", "25.0 at 4.25", "0.0 at 4.25"],
        ["first", flag, "1", "3", "75.0 at 4.25", "0.0 at 4.25"],
    ]


def test_a_policy_that_knows_more_stands_beside_one_trained_alike_with_the_same_budget(tmp_path):
    def row(outcomes, forces, **settings):
        lifted = outcomes.count("S")
        found = {"episodes": 4, "never_lifted": 4 - lifted, "ci95": wilson_interval(lifted, 4)}
        found |= {"outcomes": outcomes, "forces_n": forces, "starts": (0, 1, 2, 3)}
        return replace(result("apple", lifted, 5.0), **found, force_budget_n=3.0, **settings)

    (tmp_path / "told").mkdir()
    (tmp_path / "seeds").mkdir()
    knowing = row("SSSL", (1.0, 3.5, 2.0, 0.5), force_mean_n=1.75)
    sensing = row("SLSL", (4.5, 3.5, 2.0, 0.5), force_mean_n=2.6)
    squeeze = replace(sensing, controller="squeeze", squeeze_force_n=3.0, force_budget_n=None)
    other = replace(sensing, force_budget_n=8.0)
    assert make_readme.policy_tables.told(tmp_path) == make_readme.closing_tables.NOTHING
    write_results(tmp_path / "told" / "native.json", [knowing], PROVENANCE, FIRST_ROBOT)
    rows = [sensing, squeeze, other]
    write_results(tmp_path / "seeds" / "longer.json", rows, PROVENANCE, FIRST_ROBOT)
    _, _, *lines = make_readme.policy_tables.told(tmp_path).splitlines()
    condition = "native MuJoCo, ±5 mm, friction 0.8"
    assert [values(line) for line in lines] == [
        [condition, "3", "told", "4", "75.0 at 1.75", "50.0", "75.0"],
        [condition, "3", "longer", "4", "50.0 at 2.60", "25.0", "25.0"],
    ]


def test_the_same_trials_in_both_engines_stand_side_by_side(tmp_path):
    def row(engine, outcomes, forces):
        lifted = outcomes.count("S")
        found = {"episodes": 4, "never_lifted": 4 - lifted, "ci95": wilson_interval(lifted, 4)}
        found |= {"outcomes": outcomes, "forces_n": forces, "starts": (0, 1, 2, 3)}
        return replace(result("apple", lifted, 5.0), **found, engine=engine)

    native, mjx = tmp_path / "native.json", tmp_path / "mjx.json"
    table = make_readme.closing_tables.engines_agree
    given = PROVENANCE, FIRST_ROBOT
    write_results(native, [row("mujoco", "SSLL", (1.0, 2.0, 3.0, 2.0))], *given)
    assert table([native, mjx]) == make_readme.closing_tables.NOTHING
    write_results(mjx, [row("mjx", "SLSS", (2.0, 2.0, 4.0, 4.0))], *given)
    said, *_, line = (x for x in table([native, mjx]).splitlines() if x and "details" not in x)
    assert said.startswith("Success differs by +25.0 to +25.0 points, +25.00 in the mean of 1")
    assert "25.0 to 25.0 % of their trials have the same outcome" in said
    _, _, native_percent, mjx_percent, _, same, *forces = values(line)
    assert [native_percent, mjx_percent, same] == ["50.0", "75.0", "25.0"]
    assert forces == ["2.00", "3.00"]


def test_a_policy_that_is_held_to_its_budget_stands_beside_itself(tmp_path):
    def row(outcomes, forces, **settings):
        lifted = outcomes.count("S")
        found = {"episodes": 4, "never_lifted": 4 - lifted, "ci95": wilson_interval(lifted, 4)}
        found |= {"outcomes": outcomes, "forces_n": forces, "starts": (0, 1, 2, 3)}
        found |= {"force_mean_n": sum(forces) / 4, "force_budget_n": 3.0}
        return replace(result("apple", lifted, 5.0), **found | settings)

    (tmp_path / "not_kept").mkdir()
    told = row("SSSL", (4.0, 3.5, 2.0, 0.5))
    kept = row("SSSL", (2.8, 3.5, 2.7, 1.0), keeping_gain=3.0)
    squeeze = replace(told, controller="squeeze", squeeze_force_n=3.0, force_budget_n=None)
    more = row("SSSS", (2.8, 3.5, 2.7, 1.0), keeping_gain=3.0, force_budget_n=8.0)
    table = make_readme.policy_tables.keeping
    write_results(tmp_path / "not_kept" / "eight.json", [told, squeeze], PROVENANCE, FIRST_ROBOT)
    assert table(tmp_path) == make_readme.closing_tables.NOTHING
    write_results(tmp_path / "eight_native.json", [kept, squeeze, more], PROVENANCE, FIRST_ROBOT)
    _, _, *lines = table(tmp_path).splitlines()
    (line,) = (values(line) for line in lines)
    assert line[0] == "native MuJoCo, ±5 mm, friction 0.8"
    assert line[1:7] == ["3", "4", "75.0 at 2.50", "25.0", "75.0 at 2.50", "50.0"]
    assert line[7].startswith("+25.0 (")


def test_results_of_a_policy_that_was_shipped_before_are_named(tmp_path):
    """By the hash of its file; a file that knows of no policy, or of today's, is not."""
    shipped = tmp_path / "policy.npz"
    shipped.write_bytes(b"now")
    now = hashlib.sha256(b"now").hexdigest()
    for name, digest in (
        ("seeds/first", "ab"),
        ("seeds/other", None),
        ("today", now),
        ("parts/old", "ab"),
        ("older", "cd"),
        ("none", None),
        ("choice/tried", "cd"),
        ("told/native", "cd"),
    ):
        path = tmp_path / "results" / f"{name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"sha256": {"policy": digest} if digest else {}}))
    said = make_readme.policy_tables.earlier(tmp_path / "results", shipped)
    old, older = (f"[{n}.json](results/{n}.json)" for n in ("parts/old", "older"))
    assert said == (
        f"Still of policies that were shipped before: {older} of an earlier one; {old} of `first`."
    )
    for name in ("parts/old", "older"):
        (tmp_path / "results" / f"{name}.json").unlink()
    assert "All results" in make_readme.policy_tables.earlier(tmp_path / "results", shipped)
