"""Open constants of reaching: what is tried, what is put together, and what the table says."""

import importlib
import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mjx_grasp.evaluation.reach.poses import draw_poses
from mjx_grasp.evaluation.reach.record import empty_record
from mjx_grasp.reaching.presets import PRESETS
from mjx_grasp.records.atomic import write_json
from mjx_grasp.records.settings import to_record

EXPERIMENTS = Path(__file__).resolve().parent.parent / "experiments"
PUBLISHED = {
    *("thumb_standoff", "wrap_standoff", "wrap_spread"),
    *("fine_distance", "fine_timeout", "late", "late_tips", "dt"),
}
"""Fields that have numbers of the publication (method §3)."""
HIGH = "selection.targets.min_goal_height"
SLOW = "reach.fields.slow_down"
SPEED = "reach.fields.speed"


@pytest.fixture
def constants(monkeypatch):
    monkeypatch.syspath_prepend(EXPERIMENTS)
    return importlib.import_module("reach_constants")


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(EXPERIMENTS)
    return importlib.import_module("reach_constants_tables")


def leaves(record, path=""):
    """Every value of settings by its path."""
    if not isinstance(record, dict):
        return {path: record}
    each = ((f"{path}.{name}" if path else name, of) for name, of in record.items())
    return {p: leaf for name, of in each for p, leaf in leaves(of, name).items()}


def test_every_value_differs_from_the_presets_and_changes_nothing_else(constants, robot):
    before = constants.with_changes(robot, {})
    assert before.preset == PRESETS["paper"]
    for path, values in constants.OPEN.items():
        assert path.split(".")[-1] not in PUBLISHED
        for value in values:
            after = constants.with_changes(robot, {path: value})
            old, new = leaves(to_record(before)), leaves(to_record(after))
            assert {p for p in old if old[p] != new[p]} == {path}


def test_what_helps_is_put_together_if_it_helps_the_rest(constants):
    gains = {(HIGH, 0.1): 20.0, (HIGH, 0.2): 10.0, (SLOW, 0.3): 15.0, (SPEED, 0.4): 5.0}
    asked = []

    def rate_of(changes):
        asked.append(changes)
        both = {HIGH, SLOW} <= set(changes)
        return 40.0 + sum(gains.get(item, -5.0) for item in changes.items()) - 18.0 * both

    singles = [{path: value} for path, value in (*gains, ("reach.fields.far", 0.5))]
    assert constants.put_together(singles, 3, rate_of) == {HIGH: 0.1, SPEED: 0.4}
    assert {HIGH: 0.1, SLOW: 0.3} in asked, "it was tried"
    assert not any("reach.fields.far" in changes for changes in asked if len(changes) > 1)
    assert constants.put_together(singles, 1, rate_of) == {HIGH: 0.1}
    assert constants.put_together(singles, 3, lambda changes: 40.0) == {}


def test_the_short_sweep_ends_soon_after_what_it_counts(constants):
    control = constants.until_3_s(PRESETS["paper"]).reach.controller
    assert 3.0 < control.fine_timeout < 3.1 < control.timeout
    assert not control.hands_off and not control.reselect_late


def test_halves_are_halves(constants):
    found = constants.halves(draw_poses(64, 1))
    assert all(which.sum() == 32 for which in found.values())
    assert np.array_equal(found["thin"], ~found["thick"])


@pytest.fixture
def sweeping(constants, body, monkeypatch):
    """A sweep takes no time, and the sooner a hand slows down the more is reached."""
    swept = []

    def run_sweep(robot, settings, count, seed, ends, **_):
        slow = settings.reach.fields.slow_down
        swept.append((count, seed, slow, settings.selection.targets.min_goal_height))
        record = empty_record(len(body.lower))
        record = type(record)(*(np.repeat(np.asarray(v)[None], count, 0) for v in record))
        record.last_table[0] = 0.0
        record = record._replace(q=np.tile(0.5 * (body.lower + body.upper), (count, 1)))
        rates = {t: dict.fromkeys(("1", "3", "7"), 50.0 + 100 * slow) for t in ("20", "10")}
        tips = {name: {"mean": 5.0} for name in ("thumb", "index", "middle", "midpoint")}
        result = {
            "rate_percent": rates,
            "at_20mm_3s": {"upright": 60.0, "lying": 40.0},
            "failures_percent": {"slow": 10.0, "collision": 25.0},
            "handoff_mm": tips,
            "limits": {"safe": {"least_object_distance_mm": 4.5}},
            "seconds": {},
        }
        classes = np.array([3, *[-1] * (count - 1)])
        return SimpleNamespace(
            result=result, classes=classes, record=record, poses=draw_poses(count, seed)
        )

    monkeypatch.setattr(constants, "run_sweep", run_sweep)
    monkeypatch.setattr(constants, "OPEN", {SLOW: (0.05, 0.2), HIGH: (0.012,)})
    return swept


def test_each_sweep_is_made_once_and_the_ablations_are_taken_over(
    constants, tables, sweeping, tmp_path, committed
):
    row = {
        "rate_percent": {t: dict.fromkeys(("1", "3", "7"), 47.5) for t in ("20", "10")},
        "at_20mm_3s": {"upright": 61.0, "lying": 33.0},
        "failures_percent": {"slow": 1.0, "collision": 2.0},
        "handoff_mm": {n: {"mean": 9.0} for n in ("thumb", "index", "middle", "midpoint")},
        "limits": {"safe": {"least_object_distance_mm": 9.0}},
    }
    ablation = tmp_path / "ablation.json"
    known = {"poses": 8, "provenance": {"seed": 20}, "rows": {"paper": row, "standoffs": row}}
    write_json(ablation, known)
    config = constants.ConstantsConfig(
        out=tmp_path / "out.json", ablation=ablation, tuning_poses=4, poses=8, singles=1
    )
    constants.main(config)
    low = -math.inf
    tuned = [(4, 1, 0.1, low), (4, 1, 0.05, low), (4, 1, 0.2, low), (4, 1, 0.1, 0.012)]
    assert sweeping == [*tuned, (8, 20, 0.2, low)]
    d = json.loads(config.out.read_text())
    assert [r["changes"] for r in d["judged"]] == [{}, {SLOW: 0.2}]
    assert d["paper"] == {SLOW: 0.1, HIGH: "-inf"}, "JSON knows no infinity"
    assert d["judged"][0] == {"changes": {}, **row}
    against = d["judged"][-1]["against_percent_of"]
    assert against["failed"]["table"] == 100.0 and against["converged"]["table"] == 0.0
    text = tables.constants(config.out)
    assert "| failed | 0.0 | 0.0 | 100.0 | 0.0 |" in text
    assert "from 47.5 to 70.0 %" in text and "| fields.slow_down 0.2 | 0.1 | 70.0 | +10.0 |" in text
    write_json(ablation, known | {"poses": 9})
    constants.main(config)
    assert sweeping[5:] == [*tuned, (8, 20, 0.2, low), (8, 20, 0.1, low)], "those are other poses"


def test_a_killed_search_makes_no_sweep_again(
    constants, sweeping, tmp_path, monkeypatch, committed
):
    config = constants.ConstantsConfig(
        out=tmp_path / "out.json", ablation=tmp_path / "none.json", tuning_poses=4, poses=8
    )
    sweep, left = constants.run_sweep, 3

    def killed(*given, **named):
        nonlocal left
        if left == 0:
            raise KeyboardInterrupt
        left -= 1
        return sweep(*given, **named)

    monkeypatch.setattr(constants, "run_sweep", killed)
    with pytest.raises(KeyboardInterrupt):
        constants.main(config)
    assert len(sweeping) == 3 and not config.out.exists(), "only what is whole is a result"
    left = 100
    constants.main(config)
    assert len(sweeping) == len(set(sweeping)) > 5
    assert config.out.exists() and len(list(tmp_path.iterdir())) == 1


def test_names_tell_constants_apart(tables):
    assert tables.name_of({}) == "paper"
    assert tables.name_of({HIGH: 0.012, SLOW: 0.3}) == "targets.min_goal_height 0.012, " + (
        "fields.slow_down 0.3"
    )
    assert tables.name_of({"robot.arm.home": (0.1, -0.25)}) == "arm.home (0.1, -0.25)"
