import hashlib
import importlib.util
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from test_imports import ORDER

import mjx_grasp
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.results import ResultRow, Results, ThroughputRow, write_results
from mjx_grasp.evaluation.statistics import wilson_interval
from mjx_grasp.robot.identity import FIRST_ROBOT

ROOT = Path(__file__).resolve().parent.parent
PROVENANCE = {
    "command": "python -m mjx_grasp.evaluate --out a.json",
    "git": "0123456789abcdef-dirty",
    "versions": {"jax": "0.10.2"},
    "device": "a card",
    "seed": 7,
}
CODE = PROVENANCE["git"][:7]
ALONE = "python -m mjx_grasp.evaluate"
DOCUMENTS = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "experiments/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
]
GENERATED = re.compile(r"<!-- generated:([\w-]+) -->.*?<!-- /generated:\1 -->", re.DOTALL)


def load_generator():
    path = ROOT / "experiments" / "make_readme.py"
    sys.path.insert(0, str(path.parent))  # as when it is run as a script
    spec = importlib.util.spec_from_file_location("make_readme", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_readme"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


make_readme = load_generator()


def result(name, successes, offset_mm):
    return ResultRow(
        object=name, controller="policy", engine="mujoco", episodes=64, successes=successes,
        never_lifted=64 - successes, not_held=0, slipped=0, ci95=wilson_interval(successes, 64),
        force_mean_n=4.25, force_peak_n=9.0, squeeze_force_n=None, offset_mm=offset_mm,
        angle_deg=0.0, friction=0.8, handoffs="ik",
    )  # fmt: skip


@pytest.fixture
def root(tmp_path):
    results = tmp_path / "experiments" / "results"
    results.mkdir(parents=True)
    shutil.copy(ROOT / "README.md", tmp_path)
    shutil.copy(ROOT / "experiments" / "README.md", tmp_path / "experiments")
    (tmp_path / "docs").mkdir()
    shutil.copy(ROOT / "docs" / "reproduction.md", tmp_path / "docs")
    write_results(results / "five.json", [result("apple", 61, 5.0)], PROVENANCE, FIRST_ROBOT)
    write_results(results / "ten.json", [result("apple", 57, 10.0)], PROVENANCE, FIRST_ROBOT)
    speed = ThroughputRow("ppo", "mjx", 1024, 24, 123_456.0, 7.5)
    write_results(results / "throughput_card.json", [speed], PROVENANCE, FIRST_ROBOT)
    (results / "other.json").write_text(json.dumps({"schema": "else/1", "provenance": PROVENANCE}))
    return tmp_path


def run(root, check=False):
    make_readme.main(make_readme.ReadmeConfig(check=check, root=root))


def test_the_readmes_of_this_repository_are_up_to_date():
    """In a process of its own: the checks of signatures here make it three times slower."""
    command = [sys.executable, ROOT / "experiments/make_readme.py", "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_readmes_show_what_the_files_hold(root):
    run(root)
    main = (root / "README.md").read_text()
    assert "1 object (parametric stand-ins), 64 trials each in native MuJoCo, ±5 mm" in main
    assert "| policy | 95.3 | 4.2 |" in main
    assert "publication: policy" not in main, "of one object its means say nothing"
    detail = (root / "experiments" / "README.md").read_text()
    for text in (
        "| policy | 95.3 (87–98), 4.2 N | 89.1 (79–95), 4.2 N |",
        "4.2 / 9.0",
        "123,456",
        "7.5",
        "results/five.json",
        "results/other.json",
        "0123456789ab-dirty",
        "a card",
    ):
        assert text in detail
    assert f"`{PROVENANCE['command']}`" in detail


def test_the_stages_before_closing_have_their_tables(root):
    results = root / "experiments" / "results"
    sweep = {
        "rate_percent": {"20": {"3": 91.25}},
        "paper_rate_percent": {"20": {"3": 78.3}},
        "rate_percent_since_start": {"20": {"1": 5.5, "2": 60.5, "3": 80.5}},
        "rate_percent_since_first_near": {"20": {"3": 85.5}},
        "solvable_percent": {"20": 97.5},
        "poses": 2752,
        "seconds": {"planning": 30.0, "reaching": 12.0},
        "handoff_mm": {
            name: {"mean": 6.5, "std": 2.5, "paper": [8.7, 3.5]}
            for name in ("thumb", "index", "middle", "midpoint")
        },
        "settings": {"reach": {"limits": {"object_clearance": 0.01}}},
        "limits": {
            kind: {
                "reaches": reaches,
                "ticks": 99000,
                "largest_speed_over_limit": 0.99,
                "farthest_beyond_joint_limit_rad": 0.0,
                "least_object_distance_mm": 10.3,
                "most_object_distance_lost_mm": 0.0,
                "deepest_start_mm": 12.0,
                "least_table_height_over_asked_mm": 0.4,
                "least_finger_distance_mm": 2.5,
                "least_arm_to_itself_mm": 21.0,
                "ticks_infeasible": 7,
            }
            for kind, reaches in (("safe", 1234), ("near", 56), ("in_contact", 78))
        },
        "provenance": PROVENANCE,
    }
    (results / "reach_sweep_cpu.json").write_text(json.dumps(sweep))
    part = {"object": "mug", "place": "handle", "kind": "part", "split": "train", "mesh": "scan"}
    part |= {"nearest_mm": 7.5, "quality": 0.25}
    side = part | {"place": "top", "kind": "side", "nearest_mm": 20.5, "on_part": None}
    off = {"on_part": False, "choice_on_part": 0.25, "outside_mm": [1.0, 8.5, 0.0]}
    on = {"on_part": True, "choice_on_part": 0.9}
    rows = [
        part | off | {"steering": "default", "contacts_mm": 51.4},
        part | on | {"steering": "contacts", "contacts_mm": 17.6, "outside_mm": [0.0, 0.0, 0.0]},
        side | {"steering": "default", "contacts_mm": 40.0, "outside_mm": [1.0, 1.0, 1.0]},
        side | {"steering": "contacts", "contacts_mm": 40.0, "outside_mm": [1.0, 1.0, 1.0]},
    ]
    numbers = {"rows": rows, "provenance": PROVENANCE, "settings": {"usable": 0.05}}
    (results / "steering_numbers.json").write_text(json.dumps(numbers))
    route = {"object": "golf_ball", "mesh": "scan", "asked": "“the top” (side: top)", "seed": 4}
    route |= {"scenario": {"name": "obstacle"}, "outcomes": ["slipped", "success"]}
    route |= {"provenance": PROVENANCE}
    (results / "route.json").write_text(json.dumps(route))
    first = {"setup_s": 60.0, "train_s": 420.0, "total_s": 480.0, "training_s": 300.0}
    first |= {"env_steps": 983040, "return_first_tenth": 862.0, "return_last_tenth": 1134.0}
    first |= {"success_first_tenth_percent": 34.0, "success_last_tenth_percent": 75.0}
    made = json.loads((results / "five.json").read_text())
    untrained = made["rows"][0] | {"controller": "squeeze", "squeeze_force_n": 1.0}
    made["rows"].append(untrained | {"successes": 20, "never_lifted": 44, "ci95": [20.0, 44.0]})
    made |= {"make_train": first, "label": "policy, preset cpu", "untrained_n": 1.0}
    (results / "make_train_cpu.json").write_text(json.dumps(made))
    sets = {"provenance": PROVENANCE, "earlier": [PROVENANCE | {"command": "the first of two"}]}
    sets |= {"objects": [{"eligible": True, "kept": 1234}, {"eligible": False, "kept": 0}]}
    (results / "handoffs_standins.json").write_text(
        json.dumps(sets | {"not_eligible": ["golf_ball"]})
    )
    run(root)
    detail = (root / "experiments" / "README.md").read_text()
    for text in (
        "91.2 / 78.3",
        "97.5 %",
        "80.5 %",
        "85.5 %",
        "6.5 ± 2.5 (paper 8.7",
        "1,234 reaches",
        "10.3 mm on any tick (10 mm are asked",
        "1,234 states of 1 object; no pre-grasp was found for golf ball. Made in 2 steps",
        "1. `the first of two` at 0123456789ab-dirty on a card, JAX 0.10.2\n2. `python -m",
    ):
        assert text in detail
    assert "| mug | handle | scan | 51 / 8 | 18 / 0 | 0.25 |" in detail
    assert "| parts | 1 | contacts | 17.6 | 100.0 | 100.0 | 90.0 | 0.25 |" in detail
    assert "| sides | 1 | contacts | 40.0 | 0.0 |  |  | 0.25 |" in detail
    assert "| all | 2 | default | 45.7 |  | 0.0 | 25.0 | 0.25 |" in detail
    assert "2 places on 1 object. " in detail and "are at 14.0 mm by" in detail
    assert "| nearer | 56 | 99,000 | 0.99 |" in detail
    assert "took 8.0 min" in detail
    assert "scenario obstacle: the first success in 2 random poses (seed 4)" in detail
    assert "went from 862 to 1134" in detail
    assert "61 of 64 objects are lifted, and 20 of 64 before" in detail


def test_settings_of_another_file_are_added_once_and_where_there_are_others():
    column = make_readme.closing_tables.Column
    policy, light, again, hard = (column(n, {}) for n in ("policy", "1 N", "1 N", "9 N"))
    groups, more = {"nominal": [policy, light], "hard": [policy]}, {"nominal": [again, hard]}
    found = make_readme.closing_tables.with_more(groups, more | {"slippery": [hard]})
    assert found == {"nominal": [policy, light, hard], "hard": [policy]}


def test_throughput_is_sorted_by_worlds():
    rows = tuple(ThroughputRow("ppo", "mjx", w, 24, 30.0 * w, 1.5) for w in (8192, 1024))
    table = make_readme.closing_tables.throughput_table([Results(rows, PROVENANCE, {})])
    assert [r[4:] for r in table.rows] == [("1,024", "30,720", "1.5"), ("8,192", "245,760", "1.5")]
    assert {r[:2] for r in table.rows} == {("a card", CODE)}


def test_a_mesh_of_one_device_stands_beside_the_training_and_loops_have_their_times(tmp_path):
    rows = [ThroughputRow(loop, "mjx", 8, 1, 50.0, None) for loop in ("ppo", "ppo_sharded")]
    names = ("warp", "mjx", "task", "rollout", "ppo")
    ticks = dict(zip(names, (1.0, 2.0, 3.0, 4.0, 5.0), strict=True))
    detail = {"worlds": 8, "unroll": 4, "ratio_ppo_to_warp": 0.2, "ms_per_control_tick": ticks}
    detail |= {"warp_step_trace_ms": {"step": 6.0}}
    path = tmp_path / "loops.json"
    write_results(path, rows, PROVENANCE, FIRST_ROBOT, details=[detail])
    said = make_readme.closing_tables.throughput([path])
    assert f"| a card | {CODE} | ppo, MJX | 1 | 8 × 4 | 50 |" in said
    assert f"| a card | {CODE} | ppo over a mesh of one device, MJX | 1 | 8 × 4 | 50 |" in said
    assert "| 8 | 1.00 | 2.00 | 3.00 | 4.00 | 5.00 | 6.00 |" in said and "| 0.20 |" in said


def test_policies_stand_beside_the_squeeze_of_the_same_force(root):
    results = root / "experiments" / "results"
    run = {"run": "many", "worlds": 8192, "unroll": 16, "env_steps": 31457280, "seed": 3}
    runs = {"schema": "mjx_grasp.training_runs/1", "provenance": PROVENANCE}
    told = ("preset", "engine", "privileged_critic", "seconds_with_compilation")
    told += ("steps_per_s", "training_success_percent", "training_force_n")
    told_too = {"provenance": PROVENANCE, "residual": "leaky", "objects": ["eight"]}
    row = dict.fromkeys(told, 1.0) | run | told_too
    (results / "training_runs.json").write_text(json.dumps(runs | {"rows": [row]}))
    squeezes = [
        replace(result("apple", n, 5.0), controller="squeeze", squeeze_force_n=c, force_mean_n=f)
        for n, c, f in ((16, 1.0, 1.0), (48, 3.0, 2.0))
    ]
    drawn = {"settings": {"states": "evaluation", "objects": ["apple"]}}
    alone = PROVENANCE | {"command": ALONE}
    starts = drawn | {"sha256": {"handoffs": "ab"}}
    write_results(results / "eight_native.json", squeezes, alone, FIRST_ROBOT, **starts)
    made = PROVENANCE | {"command": f"{ALONE} --policy runs/many/policy.npz"}
    (results / "seeds").mkdir()
    for name, force, states in (("soft", 1.5, "ab"), ("hard", 3.0, "ab"), ("else", 1.4, "cd")):
        policy = replace(result("apple", 32, 5.0), force_mean_n=force)
        starts = drawn | {"sha256": {"handoffs": states}}
        write_results(results / "seeds" / f"{name}.json", [policy], made, FIRST_ROBOT, **starts)
    before = replace(result("apple", 32, 5.0), force_mean_n=1.0)
    write_results(results / "seeds" / "many.json", [before], alone, FIRST_ROBOT, **starts)
    (results / "five.json").unlink()
    run_name = "| many | 8,192 × 16, 31 M steps | 3 | native MuJoCo, ±5 mm, friction 0.8 | 64 |"
    make_readme.main(make_readme.ReadmeConfig(root=root))
    detail = (root / "experiments" / "README.md").read_text()
    assert f"{run_name} 50.0 (38–62) | 1.5 | 50.0 |" in detail
    assert f"{run_name} 50.0 (38–62) | 1.4 |  |" in detail, "from other start states"
    assert f"{run_name} 50.0 (38–62) | 3.0 | 75.0 at 2.0 N |" in detail
    assert f"{run_name} 50.0 (38–62) | 1.0 |" in detail, "shipped when it was evaluated"


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


def test_a_claim_is_judged_by_what_the_files_hold(root):
    """The policy lifts more than the squeeze here, as published, and slips as often."""
    results = root / "experiments" / "results"
    claims = make_readme.paper_tables.claims
    assert "the policy lifts" not in claims(results)
    policy = replace(result("sugar_box", 60, 5.0), force_budget_n=3.0)
    squeeze = replace(
        result("sugar_box", 30, 5.0), controller="squeeze", squeeze_force_n=3.0, force_mean_n=1.5
    )
    write_results(results / "eight_native.json", [policy, squeeze], PROVENANCE, FIRST_ROBOT)
    text = claims(results)
    assert "| 91.9 % against 56.1 % | 93.8 % against 46.9 % | holds |" in text
    assert "largest on the sugar box | holds |" in text
    assert "| 8.3 % against 0.8 % | 0.0 % against 0.0 % | does not |" in text


@pytest.mark.parametrize(("trained", "said"), [((9.0, 8.0), "does not"), ((8.0, 9.0), "holds")])
def test_of_trainings_as_published_the_best_in_training_is_judged(root, trained, said):
    results = root / "experiments" / "results"
    (results / "seeds").mkdir(exist_ok=True)
    assert "as published the best" not in make_readme.paper_tables.claims(results)
    table = {"rows": []}
    for k, lifted in enumerate((32, 60)):
        name = f"published-{k}"
        rows = [result("apple", lifted, 5.0)]
        write_results(results / "seeds" / f"{name}.json", rows, PROVENANCE, FIRST_ROBOT)
        table["rows"].append({"run": name, "training_success_percent": trained[k]})
    (results / "training_runs.json").write_text(json.dumps(table))
    (line,) = [
        line
        for line in make_readme.paper_tables.claims(results).splitlines()
        if "as published the best" in line
    ]
    assert "of 2, which lift 50.0 to 93.8 %, the most of them at 4.2 N" in line and said in line


def test_stale_sections_fail_the_check_and_stay(root):
    with pytest.raises(InputError, match=r"README\.md.*make readme"):
        run(root, check=True)
    run(root)
    run(root, check=True)
    before = (root / "README.md").read_text()
    path = root / "experiments" / "results" / "five.json"
    write_results(path, [result("apple", 60, 5.0)], PROVENANCE, FIRST_ROBOT)
    with pytest.raises(InputError):
        run(root, check=True)
    assert (root / "README.md").read_text() == before
    run(root)
    assert "| policy | 93.8 |" in (root / "README.md").read_text()


def revisions(content):
    """Every revision that a results file names, of what it took over too."""
    if isinstance(content, dict):
        if isinstance(content.get("git"), str):
            yield content["git"].removesuffix("-dirty")
        content = list(content.values())
    for part in content if isinstance(content, list) else ():
        yield from revisions(part)


def test_the_revision_of_every_result_is_in_the_history():
    git = partial(subprocess.run, cwd=ROOT, capture_output=True, text=True)
    if git(["git", "rev-parse", "--is-shallow-repository"]).stdout.strip() != "false":
        pytest.skip("the history is not here")
    history = set(git(["git", "rev-list", "HEAD"]).stdout.split())
    for path in (ROOT / "experiments" / "results").rglob("*.json"):
        named = set(revisions(json.loads(path.read_text())))
        assert named <= history, path.name


def test_results_name_no_folder_of_the_machine_that_made_them():
    for path in (ROOT / "experiments" / "results").rglob("*.json"):
        found = re.search(r"(?:/home|/root|/Users|/work|\.\./)[/\w.-]*", path.read_text())
        assert found is None, f"{path.name}: {found[0]}"


WHOLE_GRASPS = sorted((ROOT / "experiments" / "results").glob("scenarios*.json"))
WHOLE_GRASPS += [ROOT / "experiments" / "results" / "grasps_all.json"]


@pytest.mark.parametrize("path", WHOLE_GRASPS, ids=lambda path: path.stem)
def test_what_a_results_file_calls_held_was_lifted_by_a_hand(path):
    scenarios = json.loads(path.read_text())["scenarios"]
    held = [r for s in scenarios.values() for r in s["rows"] if r["outcome"] == "success"]
    assert len(held) > 100
    for row in held:
        assert row["lift_s"] is not None and row["force_mean_n"] > 0.1, row
        assert row["peak_rise_m"] < 0.5, row


def test_what_is_written_by_hand_survives(root):
    before = {p: GENERATED.sub("", p.read_text()) for p in root.rglob("README.md")}
    run(root)
    run(root)
    assert len(before) == 2
    assert {p: GENERATED.sub("", p.read_text()) for p in before} == before


def test_a_readme_without_its_markers_is_refused(root):
    path = root / "README.md"
    path.write_text(path.read_text().replace("<!-- /generated:results -->", ""))
    with pytest.raises(FileError, match=r"README\.md.*results"):
        run(root)


def by_hand(path):
    """What is not generated of a document."""
    return GENERATED.sub("", path.read_text())


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_no_number_of_a_result_is_written_by_hand(path):
    assert not re.search(r"\d\s*(%|N\b|steps/s|GiB|episodes)", by_hand(path))


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_links_and_commands_exist(path):
    text = path.read_text()
    for link in re.findall(r"\]\(([^)]+)\)", text):
        if link.startswith("http"):
            continue
        file, _, anchor = link.partition("#")
        to = path.parent / file if file else path
        assert to.exists(), link
        if anchor:
            heads = re.findall(r"^#+ (.*)", to.read_text(), re.M)
            known = {re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads}
            assert anchor in known, link
    for module in re.findall(r"python -m (mjx_grasp\.[\w.]*)", text):
        assert (ROOT / (module.replace(".", "/") + ".py")).is_file(), module
    for script in re.findall(r"python ((?:experiments|benchmarks)/\S+\.py)", text):
        assert (ROOT / script).is_file(), script
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"(?:^|`)make ([a-z-]+)", text, re.M):
        assert re.search(rf"^{target}:", makefile, re.M), target


def test_the_readme_opens_with_the_three_commands():
    targets = re.findall(r"^make ([a-z-]+)", (ROOT / "README.md").read_text(), re.M)
    assert targets == ["train", "demo", "test"]


def test_every_picture_is_shown_somewhere_and_small():
    shown = {
        (path.parent / name).resolve()
        for path in DOCUMENTS
        for name in re.findall(r"!\[[^]]+\]\(([^)]+)\)", path.read_text())
    }
    pictures = [p for p in (ROOT / "docs").iterdir() if p.suffix in (".png", ".gif")]
    assert set(pictures) == shown
    for picture in pictures:
        most = 3_000_000 if picture.suffix == ".gif" else 600_000
        assert 0 < picture.stat().st_size <= most, picture


def test_the_map_shows_the_packages_in_their_order():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    shown = re.findall(r"^\| `(\w+)` \|", text, re.M)
    packages = {p.parent.name for p in (ROOT / "mjx_grasp").glob("*/__init__.py")}
    assert shown == [name for name in ORDER if name in packages]


def examples(path):
    return re.findall(r"```python\n(.*?)```", path.read_text(), re.DOTALL)


def example(path):
    """The first Python example of a document; those after it need a robot or a simulation."""
    code, *_ = examples(path)
    names: dict = {}
    exec(compile(code, str(path), "exec"), names)
    return names


def test_the_heatmap_example_runs_as_it_stands():
    names = example(ROOT / "README.md")
    assert names["scores"].shape == (1000, len(names["heatmap"].vertices))
    assert names["scores"].max() > 0


def test_examples_use_what_is_public():
    codes = [code for path in DOCUMENTS for code in examples(path)]
    used = {name for code in codes for name in re.findall(r"(?<!from )mjx_grasp\.(\w+)", code)}
    assert {"heatmap_of", "grasper_of"} <= used <= set(mjx_grasp.__all__)


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
    path, tables = tmp_path / "scenarios.json", make_readme.stage_tables
    assert tables.whole_grasps(path) == tables.scenarios([path]) == tables.NOTHING
    assert tables.grasps_by_split(path) == tables.NOTHING
    config = {"controller": "policy", "force_budget": 8.0}
    path.write_text(json.dumps({"scenarios": {"nominal": nominal}, "config": config}))
    said, _, _, _, cube, every = tables.whole_grasps(path).splitlines()
    assert said == "Closed by the policy, with a force budget of 8 N, in native MuJoCo:"
    in_mjx = json.loads(path.read_text())
    in_mjx["config"]["engine"] = "mjx"
    other = tmp_path / "other.json"
    other.write_text(json.dumps(in_mjx).replace('"nominal"', '"windy"'))
    with pytest.raises(FileError, match=r"other\.json: found mjx, expected as the others, mujoco"):
        tables.scenarios([path, other])
    path.write_text(path.read_text().replace("policy", "grip"))
    assert tables.whole_grasps(path).startswith("Closed by the untrained grip alone, in native")
    cells = ["8", "87.5 (53–98)", "75.0", "75.0", "3.1", "2.5", "1", "1"]
    assert values(cube) == ["rubiks cube", *cells, "7.0 / 5.5 / 5.0"]
    assert every.startswith("| **all** | **80** |")
    _, _, scenario = tables.scenarios([path]).splitlines()
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
    *_, training, others, refused = make_readme.stage_tables.grasps_by_split(path).splitlines()
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
        make_readme.stage_tables,
        (tmp_path / n for n in ("8.json", "all.json")),
    )
    calm = scenario(trials("apple", 9, 1), "nothing happens")
    windy = scenario(trials("apple", 1, 1), "wind")
    breezy = scenario(trials("apple", 6), "a breeze")
    of_all = scenario(trials("apple", 3, 1) + trials("bowl", 0, 4) + trials("chips_can", 2), "-")
    found = {"nominal": calm, "w": windy, "b": breezy}
    eight.write_text(json.dumps({"scenarios": found, "config": {}}))
    assert tables.grasps_in_short([eight], every) == tables.NOTHING
    every.write_text(json.dumps({"scenarios": {"nominal": of_all}}))
    _, _, *lines = tables.grasps_in_short([eight], every).splitlines()
    assert [values(line) for line in lines] == [
        ["the eight", "10", "90.0", "80.0", "4.0", "3.0"],
        ["2 scenarios together", "8", "87.5", "75.0", "4.0", "3.0"],
        ["the hardest of these: wind", "2", "50.0", "50.0", "4.0", "3.0"],
        ["2 objects of training", "8", "37.5", "25.0", "4.0", "3.0"],
        ["1 objects kept out of it", "2", "100.0", "100.0", "4.0", "3.0"],
    ]
    eight.write_text(json.dumps({"scenarios": {"nominal": calm}, "config": {}}))
    assert len(tables.grasps_in_short([eight], every).splitlines()) == 5
    more = tmp_path / "9.json"
    more.write_text(json.dumps({"scenarios": {"w": windy, "b": breezy}, "config": {}}))
    assert [
        values(line) for line in tables.grasps_in_short([more, eight], every).splitlines()[2:]
    ] == [values(line) for line in lines]
    more.write_text(json.dumps({"scenarios": {"nominal": calm}, "config": {}}))
    with pytest.raises(FileError, match="scenarios that no other file has"):
        tables.grasps_in_short([eight, more], every)


def test_how_many_trials_there_are_is_read_from_the_results(tmp_path):
    table = make_readme.closing_tables.trials
    assert table(tmp_path, ["a"]) == make_readme.stage_tables.NOTHING
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


def test_the_controllers_time_has_its_table(tmp_path):
    path, table = tmp_path / "grasper.json", make_readme.speed_tables.grasper_speed
    assert table([]) == make_readme.stage_tables.NOTHING
    tick = {"count": 500, "p50": 1.234, "p99": 2.5}
    of_phase = {"reaching": tick, "failed": tick | {"count": 0}}
    alone = dict.fromkeys(of_phase, tick | {"p50": 0.5, "p99": 0.75})
    record = {"tick_ms": of_phase, "tick_alone_ms": alone, "plan_ms": tick}
    path.write_text(json.dumps(record | {"provenance": PROVENANCE}))
    _, _, reaching, plans, *other = table([path, path]).splitlines()
    device = PROVENANCE["device"]
    assert values(reaching) == [device, "tick, reaching", "500", "1.23", "2.50", "0.50", "0.75"]
    assert values(plans) == [device, "search for plans", "500", "1", "2", "", ""]
    assert other == [reaching, plans]


def test_what_the_papers_parts_took_has_its_table(tmp_path):
    path, table = tmp_path / "times.json", make_readme.speed_tables.paper_times
    parts = [
        make_readme.speed_tables.Part("one", "the first", ("a", "b", "c")),
        make_readme.speed_tables.Part("two", "not timed", ("d",)),
    ]
    assert table(path, parts) == make_readme.stage_tables.NOTHING
    commands = {
        "a": {"git": "f" * 40, "seconds": 90.0, "machine": "a GPU, 16 cores"},
        "c": {"git": "0" * 40, "seconds": 33.0, "machine": "a GPU, 16 cores"},
        "gone": {"git": "0" * 40, "seconds": 1.0, "machine": "another"},
    }
    path.write_text(json.dumps({"commands": commands}))
    _, _, row = table(path, parts).splitlines()
    assert values(row) == ["one", "2 of 3", "2.0", "a GPU, 16 cores", f"{'f' * 12}, {'0' * 12}"]


def test_many_grasps_at_once_have_their_table(tmp_path):
    path, table = tmp_path / "worlds.json", make_readme.speed_tables.grasper_worlds
    assert table([]) == make_readme.stage_tables.NOTHING
    times = {"physics": 1.234, "ticks": 0.9, "with plans": 0.8}
    record = {
        "worlds": 4096, "objects": ["a", "b"], "physics_dt": 0.005, "plan_s": 40.96,
        "times_real_time": times, "lifted_percent": 99.0, "compile_s": {"a": 20.0, "b": 1.0},
        "solver_iterations": 6,
    }  # fmt: skip
    path.write_text(json.dumps(record | {"provenance": PROVENANCE}))
    _, _, row = table([path]).splitlines()
    assert values(row)[1:] == ["4,096", "2", "5", "6", "1.23", "0.90", "0.80", "10.0", "99.0", "21"]


def test_several_gpus_are_compared_with_one_that_has_as_many_worlds(tmp_path):
    table = make_readme.speed_tables.devices
    assert table([]) == make_readme.stage_tables.NOTHING
    row = {
        "worlds": 4096,
        "outcome": "finished",
        "env_steps": 2_500_000,
        "success_percent": 84.56,
        "force_n": 2.04,
        "seconds": 70.4,
    }
    rows = [
        row | {"devices": 2, "way": "donate", "steps_per_s": 190_000.0},
        row | {"devices": 1, "way": "sharded", "steps_per_s": 100_000.0},
        row | dict.fromkeys(("steps_per_s", "success_percent", "force_n"))
        | {"devices": 2, "way": "processes", "outcome": "failed (-11): and why", "env_steps": 0},
        row | {"devices": 2, "worlds": 8192, "way": "sharded", "steps_per_s": 1e6},
    ]  # fmt: skip
    path = tmp_path / "devices.json"
    made = {"settings": {"seed": 3}, "rows": rows, "provenance": PROVENANCE}
    path.write_text(json.dumps(made))
    one, donating, processes, more = map(values, table([path]).splitlines()[2:])
    assert one[1:7] == ["1", "one", "4,096", "finished", "2.5", "70"]
    assert one[7:] == ["100,000", "", "84.6", "2.0", "3"]
    assert donating[1:3] == ["2", "one, donating"] and donating[7:9] == ["190,000", "1.90"]
    assert processes[2:] == ["one each", "4,096", "failed (-11)", "0.0", "70", "", "", "", "", "3"]
    assert more[7:9] == ["1,000,000", ""]


def test_several_gpus_are_compared_with_one_of_their_own_revision(tmp_path):
    row = {
        "worlds": 64, "outcome": "finished", "env_steps": 0, "way": "sharded",
        "success_percent": None, "force_n": None, "seconds": 9.0,
    }  # fmt: skip

    def written(name, git, **speeds):
        rows = [row | {"devices": int(n[1:]), "steps_per_s": s} for n, s in speeds.items()]
        record = {"settings": {"seed": 0}, "rows": rows, "provenance": PROVENANCE | {"git": git}}
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps(record))
        return path

    paths = [
        written("a", "old", x1=100.0, x2=150.0),
        written("b", "new", x1=200.0, x2=380.0),
        written("c", "other", x4=400.0),
    ]
    lines = make_readme.speed_tables.devices(paths).splitlines()[2:]
    times = {values(line)[7]: values(line)[8] for line in lines}
    assert times == {"100": "", "200": "", "150": "1.50", "380": "1.90", "400": "2.00"}


def test_trainings_side_by_side_say_what_each_took_and_all(tmp_path):
    rows = [
        {"setting": "cpu", "trained_percent": p, "seconds": s}
        for p, s in ((80.0, 10.0), (90.0, 30.0), (85.0, 20.0))
    ]
    record = {
        "settings": {"gpus": None, "cpus": 1.0}, "rows": rows,
        "took_s": 41.6, "provenance": PROVENANCE,
    }  # fmt: skip
    path = tmp_path / "tune.json"
    path.write_text(json.dumps(record))
    _, _, row = make_readme.speed_tables.tuned([path]).splitlines()
    assert values(row)[1:] == ["cpu", "3", "1", "", "20", "42", "", "85.0 (80.0–90.0)"]
    alone = {
        "worlds": 512, "iterations": 9, "devices": 1, "outcome": "finished", "seconds": 25.0
    }  # fmt: skip
    others = ({"worlds": 256}, {"outcome": "hung"}, {"devices": 2}, {"iterations": 8})
    rows = [alone, *(alone | other | {"seconds": 1.0} for other in others)]
    devices = tmp_path / "devices.json"
    devices.write_text(json.dumps({"rows": rows, "provenance": PROVENANCE}))
    plan = {"flags": {"ppo.worlds": 512, "ppo.iterations": 9}}
    path.write_text(json.dumps(record | {"plan": plan}))
    _, _, row = make_readme.speed_tables.tuned([path], [devices]).splitlines()
    assert values(row)[1] == "cpu, 512 worlds × 9" and values(row)[6:8] == ["42", "75"]


def values(line):
    return [cell.strip() for cell in line.strip("|").split("|")]
