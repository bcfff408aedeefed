import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from generated import ALONE, PROVENANCE, make_readme, result
from test_imports import ORDER

import mjx_grasp
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.results import ThroughputRow, write_results
from mjx_grasp.robot.identity import FIRST_ROBOT

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "experiments/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
]
GENERATED = re.compile(r"<!-- generated:([\w-]+) -->.*?<!-- /generated:\1 -->", re.DOTALL)


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
    assert re.search(r"\| policy \| 95.3 \| \d\d\.\d–\d\d\.\d \| 4.2 \|", main)
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
        "6.5 ± 2.5 / 8.7",
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


def test_a_claim_is_judged_by_what_the_files_hold(root):
    """The policy lifts more than the squeeze here, as published, and slips as often."""
    results = root / "experiments" / "results"
    claims = make_readme.paper_tables.claims
    assert "the policy lifts" not in claims(results)
    policy = replace(result("sugar_box", 60, 5.0), force_budget_n=3.0)
    told = {"squeeze_force_n": 3.0, "squeeze_split": "even", "force_mean_n": 1.5}
    squeeze = replace(result("sugar_box", 30, 5.0), controller="squeeze", **told)
    (results / "beside").mkdir()
    planned = results / "beside" / "planned.json"
    write_results(planned, [policy, squeeze], PROVENANCE, FIRST_ROBOT)
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


def test_what_the_repository_holds_of_json_is_what_any_reader_knows():
    """Python's own also takes numbers that are none."""

    def refuse(word):
        raise ValueError(word)

    files = [p for at in ("assets", "experiments/results") for p in (ROOT / at).rglob("*.json")]
    assert len(files) > 50
    for file in files:
        json.loads(file.read_text(), parse_constant=refuse)


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


WHOLE_GRASPS = [
    ROOT / "experiments" / "results" / name
    for name in ("scenarios.json", "grasps_all.json", "engines/scenarios.json")
]


@pytest.mark.parametrize("path", WHOLE_GRASPS, ids=lambda path: f"{path.parent.stem} {path.stem}")
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


SETTINGS = {
    *("2 ms", "5 ms", "10 ms", "20 ms", "1.6 s", "3 s", "9 s", "30 s", "100 Hz", "500 Hz"),
    *("2 mm", "5 mm", "6 mm", "15 mm", "1 m", "90°", "31 M steps"),
}
"""Numbers with a unit that documents say by themselves: steps, times, sizes that are asked for."""


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_no_number_of_a_result_is_written_by_hand(path):
    assert not re.search(r"\d\s*(%|N\b|steps/s|GiB|episodes)", by_hand(path))
    units = (
        r"[µm]?s|min|minutes?|seconds?|hours?|points?|k?Hz|[kMG]i?B|times|°|[cm]?m|m/s|k?g|M steps"
    )
    number = rf"(?<![\w.`/-])\d[\d.,]*[\s-]?(?:{units})(?![\w/])"
    found = {" ".join(text.split()) for text in re.findall(number, by_hand(path))}
    assert found <= SETTINGS, "results come from files; what is a setting is listed"


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
