"""Tables with what is published beside ours and the published setting."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from loaded import script

from mjx_grasp.evaluation import paper
from mjx_grasp.evaluation.conditions import Column
from mjx_grasp.evaluation.results import OUTCOMES, ResultRow, write_results
from mjx_grasp.records.provenance import provenance
from mjx_grasp.robot.spec import load_robot

ROOT = Path(__file__).resolve().parent.parent
NAMES = tuple(paper.OBJECTS)


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    return script("paper_tables")


def row(name, controller, successes, force, offset=5.0, **more):
    return ResultRow(
        object=name, controller=controller, engine="mujoco", episodes=8, successes=successes,
        never_lifted=8 - successes, not_held=0, slipped=0, ci95=(0.0, 100.0), force_mean_n=2.0,
        force_peak_n=4.0, squeeze_force_n=force if controller == "squeeze" else None,
        squeeze_split="even" if controller == "squeeze" else None, offset_mm=offset, angle_deg=0.0,
        friction=0.8, handoffs="reached", **more,
    )  # fmt: skip


def written(path, *rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_results(path, list(rows), provenance(0), load_robot().identity)


def ours(names, lifted=8):
    rows = []
    for name in names:
        rows += [row(name, "policy", lifted, None, force_budget_n=3.0)]
        rows += [row(name, "policy", 1, None, force_budget_n=6.0)]
        rows += [row(name, "policy", 1, None, offset=10.0, force_budget_n=3.0)]
        rows += [row(name, "squeeze", 4, 3.0), row(name, "squeeze", 1, 5.0)]
    return rows


def preset(names):
    return [r for n in names for r in (row(n, "policy", 6, None), row(n, "squeeze", 2, 3.0))]


def cells(line):
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_eight_stand_beside_what_is_published(tables, tmp_path):
    assert tables.eight(tmp_path) == tables.NOTHING
    written(tmp_path / "beside" / "planned.json", *ours(NAMES))
    assert tables.eight(tmp_path) == tables.NOTHING, "the published setting is missing"
    written(tmp_path / "paper_preset" / "eight.json", *preset(NAMES))
    assert tables.eight(tmp_path) == tables.NOTHING
    written(tmp_path / "beside" / "gate.json", *ours(NAMES, lifted=7))
    lines = [cells(line) for line in tables.eight(tmp_path).splitlines()[2:]]
    by_name = {line[0]: line[1:] for line in lines}
    assert by_name["sugar_box"] == [
        "100.0",
        "87.5",
        "75.0",
        "93.9",
        "50.0",
        "50.0",
        "25.0",
        "14.3",
    ]
    mean = by_name["**mean**"]
    assert [cell.split()[0] for cell in mean] == [
        "**100.0**", "**87.5**", "**75.0**", "**91.9**",
        "**50.0**", "**50.0**", "**25.0**", "**56.1**",
    ]  # fmt: skip
    assert by_name["never lifted"] == ["0.0", "12.5", "25.0", "4.9", "50.0", "50.0", "75.0", "23.8"]
    assert by_name["force per finger"] == [*3 * ["2.0 N"], "", *3 * ["2.0 N"], ""]
    assert by_name["trials of each"] == [*3 * ["8"], "448", *3 * ["8"], "448"]
    assert list(by_name)[: len(NAMES)] == list(NAMES)


def test_all_training_objects_are_summed_up_without_held_out_ones(tables, tmp_path):
    names = ("apple", "mug", "chips_can")
    path = tmp_path / "objects" / "reached.json"
    written(path, *ours(names))
    written(tmp_path / "paper_preset" / "objects.json", *preset(names[:2]))
    lines = [cells(line) for line in tables.all_objects(tmp_path).splitlines()[2:]]
    by_name = {line[0]: line[1:] for line in lines}
    assert "apple" not in by_name
    assert by_name["objects"] == ["2", "2", "24", "2", "2", "24"]
    assert by_name["**mean**"][2] == "**40.3**" and by_name["**mean**"][5] == "**29.8**"
    record = json.loads(path.read_text())
    for each in record["rows"]:
        each["friction"] = 0.5
    path.write_text(json.dumps(record))
    assert tables.all_objects(tmp_path) == tables.NOTHING


def test_the_grip_is_swept_over_its_least_force_and_friction(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    table, rows = script("closing_tables").grip_sweep, []
    for force, friction, successes in ((2.5, 0.4, 6), (1.0, 0.4, 4), (1.0, 0.3, 8)):
        for offset, fewer in ((5.0, 0), (10.0, 4)):
            about = {"grip_force_n": force, "grip_friction": friction}
            rows.append(row("apple", "grip", successes - fewer, None, offset=offset, **about))
    written(tmp_path / "sweep.json", *rows)
    header, _, *lines = map(cells, table(tmp_path / "sweep.json").splitlines())
    assert header == ["least force N", "counts on friction", "±5 mm, friction 0.8",
                      "±10 mm, friction 0.8"]  # fmt: skip
    assert [line[:2] for line in lines] == [["1", "0.3"], ["1", "0.4"], ["2.5", "0.4"]]
    assert [line[2].split()[0] for line in lines] == ["100.0", "50.0", "75.0"]
    assert [line[3].split()[0] for line in lines] == ["50.0", "0.0", "25.0"]
    assert all(line[2].endswith("at 2.0") for line in lines)
    assert table(tmp_path / "none.json") == script("closing_tables").NOTHING


@pytest.mark.parametrize("states", [16, 128])
def test_the_interval_of_a_mean_is_that_of_its_start_states(states):
    """Trials of a start state that all end alike are worth one: the spread of their share."""
    trials = 128
    starts = tuple(np.repeat(np.arange(states), trials // states).tolist())
    outcomes = "".join(OUTCOMES[("successes", "never_lifted")[start % 2]] for start in starts)
    common = {"outcomes": outcomes, "starts": starts, "forces_n": trials * (2.0,)}
    held = replace(row("apple", "policy", 4, None), episodes=trials, successes=trials // 2,
                   never_lifted=trials // 2, ci95=(40.0, 60.0), **common)  # fmt: skip
    mean, (low, high) = Column("", {"apple": held}).mean()
    half = 1.96 * 100 * np.sqrt(0.25 / states)
    assert mean == 50.0
    assert (low, high) == pytest.approx((50 - half, 50 + half), abs=0.12 * half)
    unkept = replace(held, outcomes="", starts=(), forces_n=())
    assert Column("", {"apple": unkept}).mean()[1] == pytest.approx((41.4, 58.6), abs=0.5)
