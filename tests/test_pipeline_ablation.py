"""Whole grasps without one part of the method each: the variants, the script, its table."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from grasp_rows import row
from loaded import script
from on_cores import run_on_cores

from mjx_grasp.closing.config import CloserConfig, GripConfig
from mjx_grasp.closing.learned import LearnedPolicy, ObservationConfig
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.grasps.makers import Makers
from mjx_grasp.evaluation.grasps.results import OUTCOMES, as_record
from mjx_grasp.evaluation.grasps.scenario import Scenario
from mjx_grasp.records.provenance import versions
from mjx_grasp.records.settings import to_record

ROOT = Path(__file__).resolve().parent.parent
EXPERIMENTS = ROOT / "experiments"


@pytest.fixture
def ablation(monkeypatch):
    monkeypatch.syspath_prepend(EXPERIMENTS)
    return script("pipeline_ablation")


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(EXPERIMENTS)
    return script("pipeline_tables")


def leaves(record, path=""):
    """Every number of settings by its path."""
    if not isinstance(record, dict):
        return {path: record}
    each = ((f"{path}.{name}" if path else name, of) for name, of in record.items())
    return {p: leaf for name, of in each for p, leaf in leaves(of, name).items()}


def test_a_field_of_a_field_is_changed_and_nothing_else(ablation):
    before = CloserConfig()
    after = ablation.changed(before, "grip.force", 4.0)
    assert after == replace(before, grip=GripConfig(force=4.0))
    with pytest.raises(TypeError, match="strength"):
        ablation.changed(before, "grip.strength", 4.0)


def test_each_variant_leaves_out_what_it_says_and_no_other_does_the_same(ablation):
    full = ablation.System(CloserConfig(grip=GripConfig(force=1.5, friction=0.4)))
    found = {}
    for name, variant in ablation.VARIANTS.items():
        system = ablation.system_of(variant, full.closing)
        scenario = replace(Scenario(), **variant.scenario)
        found[name] = system, scenario
        old, new = leaves(to_record(full)), leaves(to_record(system))
        other = {path for path in old.keys() | new.keys() if old.get(path) != new.get(path)}
        for path in variant.system:
            assert any(p.startswith(path) for p in other), f"{name}: {path} changes nothing"
        assert all(p.startswith(tuple(variant.system)) for p in other), name
        said = ablation.about(variant, scenario, [])["changes"]
        assert set(said) == {*variant.system, *variant.scenario}
    assert found["full"] == (full, Scenario())
    assert len(set(found.values())) == len(found)
    assert found["paper-reaching"][0].reaching.plan is None
    assert found["squeeze-5"][0].closing.grip.force == 5.0
    assert found["budget-3"][0].budget == 3.0
    assert not found["observer-alone"][1].told and not found["weight-unknown"][1].weighed


def test_every_variant_has_a_controller_that_comes_from_where_it_is_told(ablation, robot):
    learned = LearnedPolicy(lambda observation: observation, ObservationConfig(), budget=8.0)
    for name, variant in ablation.VARIANTS.items():
        system = ablation.system_of(variant, CloserConfig())
        grasper = ablation.maker(system, learned)(robot, "side")
        given = learned if system.budget is None else replace(learned, budget=system.budget)
        if system.policy:
            assert vars(grasper.policy) == vars(given)
        else:
            assert grasper.policy is None
        assert grasper.config == system.grasper
        most = max(system.closing.grip.most, system.grasper.most)
        grip = replace(system.closing.grip, most=most)
        assert grasper.closer.config == replace(system.closing, grip=grip)
        assert grasper.reacher.config == system.reaching.reach
        if name == "paper-reaching":
            assert grasper.planner is None
        else:
            assert grasper.planner.config == replace(system.reaching.plan, approach="side")


def test_variants_come_in_their_order_and_unknown_ones_are_refused(ablation):
    assert ablation.chosen(("grip", "full", "grip")) == ["full", "grip"]
    assert ablation.chosen(("all",)) == list(ablation.VARIANTS)
    with pytest.raises(InputError, match="--variants: found 'storm', expected all, or"):
        ablation.chosen(("full", "storm"))


@pytest.fixture
def quick(ablation, tmp_path, monkeypatch):
    """The script without a single grasp: what it would have run, and one that is interrupted."""
    ran, made = [], {"git": "abc", "versions": versions(), "command": "python", "seed": 0}
    after = SimpleNamespace(runs=None)

    def counted(self, scenarios, make, part, progress):
        if len(ran) == after.runs:
            raise KeyboardInterrupt
        ran.extend((each.description, each.told, each.weighed, make, part) for each in scenarios)
        progress(0.5)
        return [[row(), row("slipped" if each.told else "hit")] for each in scenarios]

    monkeypatch.setattr(Makers, "run", counted)
    policy = LearnedPolicy(lambda observation: observation, ObservationConfig())
    monkeypatch.setattr(ablation, "loaded_policy", lambda *_: (CloserConfig(), policy))
    monkeypatch.setattr(ablation, "provenance", lambda seed: made)
    config = ablation.PipelineAblationConfig(
        out=tmp_path / "ablation.json",
        objects=("rubiks_cube",),
        scenarios=("nominal", "noisy_pose"),
        variants=("full", "grip"),
    )
    return SimpleNamespace(main=ablation.main, config=config, ran=ran, after=after, made=made)


def test_it_goes_on_where_it_stopped(quick):
    quick.after.runs = 3
    with pytest.raises(KeyboardInterrupt):
        quick.main(quick.config)
    left = json.loads(quick.config.out.read_text())
    assert {name: list(of) for name, of in left["results"].items()} == {
        "full": ["nominal", "noisy_pose"],
        "grip": ["nominal"],
    }
    quick.after.runs = None
    quick.main(replace(quick.config, variants=("weight-unknown", "full", "grip")))
    assert len(quick.ran) == 3 + 3
    found = json.loads(quick.config.out.read_text())
    assert list(found["results"]) == ["full", "weight-unknown", "grip"]
    assert (
        found["schema"] == "mjx_grasp.pipeline_ablation/1" and found["provenance"]["git"] == "abc"
    )
    cell = found["results"]["grip"]["noisy_pose"]
    assert (cell["all"]["success"], cell["all"]["slipped"]) == (1, 1)
    assert cell["changes"]["policy"] is False and len(cell["rows"]) == 2
    assert found["results"]["weight-unknown"]["nominal"]["changes"] == {"weighed": False}
    quick.main(quick.config)
    assert len(quick.ran) == 6
    assert "weight-unknown" in json.loads(quick.config.out.read_text())["results"]


def test_in_mjx_what_is_told_something_else_shares_the_batch_of_its_controller(quick):
    variants = ("full", "observer-alone", "grip")
    config = replace(quick.config, engine="mjx", variants=variants)
    quick.main(config)
    makers = [make for *_, make, _ in quick.ran]
    assert len(makers) == 6 and len(set(map(id, makers[:4]))) == len(set(map(id, makers[4:]))) == 1
    told = [told for _, told, *_ in quick.ran]
    assert told == [True, False, True, False, True, True]
    found = json.loads(config.out.read_text())["results"]
    assert list(found) == list(variants) and {*found["full"]} == {"nominal", "noisy_pose"}
    for name, of in found.items():
        assert all(each["all"]["hit"] == (name == "observer-alone") for each in of.values())


def test_a_variant_that_was_cut_short_loses_no_part_of_the_trials(quick):
    config = replace(quick.config, episodes=3 * 64, variants=("full",), scenarios=("nominal",))
    quick.after.runs = 2
    with pytest.raises(KeyboardInterrupt):
        quick.main(config)
    assert not config.out.exists(), "only what is whole is a result"
    quick.after.runs = None
    quick.main(replace(config, variants=("full", "grip")))
    assert [part[0].number for *_, part in quick.ran] == [0, 1, 2, 0, 1, 2]
    assert len({part[0].seed for *_, part in quick.ran}) == 3
    found = json.loads(config.out.read_text())
    assert len(found["results"]["full"]["nominal"]["rows"]) == 6
    assert list(config.out.parent.iterdir()) == [config.out]


@pytest.mark.parametrize("other", ["revision", "uncommitted", "scenario"])
def test_parts_of_other_settings_or_code_are_run_again(quick, other, tmp_path):
    windy = tmp_path / "windy.yaml"
    windy.write_text("push: {force: 1.0}\nhold_s: 3\n")
    config = replace(quick.config, episodes=2 * 64, variants=("full",), scenarios=(str(windy),))
    if other == "uncommitted":
        quick.made["git"] = "abc-dirty"
    quick.after.runs = 1
    with pytest.raises(KeyboardInterrupt):
        quick.main(config)
    quick.after.runs = None
    if other == "scenario":
        windy.write_text("push: {force: 2.0}\nhold_s: 3\n")
    elif other == "revision":
        quick.made["git"] = "abd"
    quick.main(config)
    assert [part[0].number for *_, part in quick.ran] == [0, 0, 1]


@pytest.mark.parametrize("other", ["episodes", "revision", "uncommitted", "policy", "scenario"])
def test_what_is_of_other_settings_files_or_code_is_run_again(quick, other, tmp_path):
    windy = tmp_path / "windy.yaml"
    windy.write_text("push: {force: 1.0}\nhold_s: 3\n")
    config = replace(quick.config, scenarios=(str(windy),), variants=("full",))
    quick.main(config)
    quick.main(config)
    assert len(quick.ran) == 1
    if other == "episodes":
        config = replace(config, episodes=3)
    elif other == "policy":
        (tmp_path / "policy.npz").write_bytes(b"another")
        config = replace(config, policy=tmp_path / "policy.npz")
    elif other == "scenario":
        windy.write_text("push: {force: 2.0}\nhold_s: 3\n")
    else:
        quick.made["git"] = "abd" if other == "revision" else "abc-dirty"
    quick.main(config)
    assert len(quick.ran) == 2
    quick.main(config)
    assert len(quick.ran) == 2 + (other == "uncommitted")


def test_variants_that_are_told_something_else_have_the_controller_of_the_full_system(quick):
    """Each controller compiles for itself."""
    names = ("full", "observer-alone", "weight-unknown", "grip")
    quick.main(replace(quick.config, variants=names, scenarios=("nominal",)))
    *full, (*_, grip) = quick.ran
    assert {ran[1:3] for ran in full} == {(True, True), (False, True), (True, False)}
    assert len({ran[3] for ran in full}) == 1 and grip not in {ran[3] for ran in full}


def test_what_cannot_work_is_refused_before_anything_long_starts(quick):
    for wrong, said in (
        ({"variants": ("storm",)}, "--variants"),
        ({"scenarios": ("storm",)}, "--scenarios"),
        ({"objects": ("storm",)}, "storm"),
        ({"variants": ("all",), "scenarios": ("from_above",)}, "paper-reaching does not plan"),
    ):
        with pytest.raises(InputError, match=said):
            quick.main(replace(quick.config, **wrong))
    assert not quick.ran and not quick.config.out.exists()
    quick.config.out.write_text('{"schema": "else/1"}')
    with pytest.raises(FileError, match="schema 'else/1'"):
        quick.main(quick.config)
    assert not quick.ran


def results(tmp_path, **variants):
    """A file with outcomes of two objects: S succeeds, N is not reached."""
    said = {"S": "success", "N": "not_reached"}

    def cell(outcomes):
        n = len(outcomes) // 2
        names = ["box"] * n + ["can"] * n
        return as_record([row(said[o], name) for o, name in zip(outcomes, names, strict=True)])

    content = {
        "config": {"objects_dir": "SCANS"},
        "variants": {name: f"without {name}" for name in variants},
        "results": {
            name: {at: cell(of) for at, of in cells.items()} for name, cells in variants.items()
        },
    }
    path = tmp_path / "ablation.json"
    path.write_text(json.dumps(content))
    return path


def test_the_table_has_differences_in_pairs(tables, tmp_path):
    path = results(
        tmp_path,
        full={"nominal": "SSSSSSSN", "noisy_pose": "SSSSSSSS"},
        same={"nominal": "SSSSSSSN"},
        worse={"nominal": "SSNNSSSN", "noisy_pose": "NNNNNNNN"},
    )
    text = tables.pipeline_ablation(path)
    assert text.startswith("8 trials per cell, real scans.")
    assert "| `full`: without full | 87.5 | 100.0 |" in text
    assert "| `same`: without same | 87.5, +0.0 (+0.0 to +0.0) |  |" in text
    assert "| 0.0, -100.0 (-100.0 to -100.0) |" in text
    assert "| `worse` | nominal | 4.0 | 2.5 | 3 | 0 | 0 | 0 | 0 |" in text
    content = json.loads(path.read_text())["results"]
    gain = tables.difference(content["full"]["nominal"], content["worse"]["nominal"])
    assert gain.value == pytest.approx(-25.0)
    # Both failures beside the full system's are the box's: the can, in pairs, adds no doubt.
    assert -50.0 <= gain.ci95[0] < -25.0 < gain.ci95[1] <= 0.0


def test_a_table_without_results_or_without_pairs(tables, tmp_path):
    assert tables.pipeline_ablation(tmp_path / "none.json") == "_No results file yet._"
    alone = tables.pipeline_ablation(results(tmp_path, grip={"nominal": "SN"}))
    assert "| `grip`: without grip | 50.0 |" in alone
    path = results(tmp_path, full={"nominal": "SSSS"}, grip={"nominal": "SS"})
    with pytest.raises(FileError, match="in pairs"):
        tables.pipeline_ablation(path)


@pytest.mark.long
def test_what_steering_brings_is_told_in_pairs(tables, tmp_path):
    def trial(way, name, apart, outcome="success"):
        trial = {"object": name, "outcome": outcome, "force_mean_n": 2.0}
        return trial | {"steering": way, "achieved_mm": apart}

    rows = [
        *(trial("default", "can", 80.0) for _ in range(4)),
        *(trial("default", "box", apart) for apart in (60.0, None)),
        *(trial("contacts", "can", 20.0, "slipped" if k == 0 else "success") for k in range(4)),
        *(trial("contacts", "box", 30.0) for _ in range(2)),
    ]
    path = tmp_path / "steered.json"
    path.write_text(json.dumps({"rows": rows}))
    said = tables.steering_adds(path)
    assert "6 pairs of 2 objects" in said
    assert "20.0 mm from it" in said and "instead of 80.0 mm" in said
    assert "-12.5 (" in said  # a quarter of one of two objects
    path.write_text(json.dumps({"rows": rows[:-1]}))
    with pytest.raises(FileError, match=r"steered\.json.*pairs"):
        tables.steering_adds(path)


def test_planned_and_published_reaching_are_compared_on_one_object(ablation, tmp_path):
    out = tmp_path / "ablation.json"
    config = ablation.PipelineAblationConfig(
        out=out,
        objects=("rubiks_cube",),
        episodes=1,
        scenarios=("nominal",),
        variants=("full", "paper-reaching"),
    )
    ablation.main(config)
    found = json.loads(out.read_text())["results"]
    assert found["full"]["nominal"]["all"]["success"] == 1
    (published,) = found["paper-reaching"]["nominal"]["rows"]
    assert published["outcome"] in OUTCOMES


@pytest.mark.long
def test_two_processes_write_what_one_does(tmp_path):
    """A core each."""
    found = []
    for n in (1, 2):
        out = tmp_path / f"{n}.json"
        words = "--objects foam_brick --episodes 1 --scenarios nominal --variants grip squeeze-5"
        command = [sys.executable, EXPERIMENTS / "pipeline_ablation.py", *words.split()]
        command += ["--processes", str(n), "--out", out]
        run_on_cores(command, n)
        content = json.loads(out.read_text())
        assert content["config"]["processes"] == 1
        results = content["results"]
        found.append({name: of["nominal"]["rows"] for name, of in results.items()})
    assert found[0] == found[1] and list(found[0]) == ["grip", "squeeze-5"]
