"""What comparisons take from an earlier file: controllers without a policy, of the same trials."""

from __future__ import annotations

import copy
import importlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError
from mjx_grasp.learning.policy import load_policy
from mjx_grasp.robot.spec import load_robot

EXPERIMENTS = Path(__file__).resolve().parent.parent / "experiments"

EARLIER: dict[str, Any] = {
    "schema": "s/1",
    "settings": {"episodes": 4, "seed": 0, "policy": "old.npz", "budgets": [3.0]},
    "sha256": {"handoffs": "abc", "policy": "old"},
    "controllers": {"policy, budget 3 N": ["old policy"], "squeeze 3 N": ["s"], "grip": ["g"]},
    "provenance": {"git": "earlier"},
}


def asked() -> dict[str, Any]:
    """A record that has nothing yet, of another policy and budgets."""
    record = copy.deepcopy(EARLIER) | {"controllers": {}, "provenance": {"git": "now"}}
    record["settings"] |= {"policy": None, "budgets": [8.0], "known": "earlier.json"}
    record["sha256"]["policy"] = "new"
    return record


@pytest.fixture
def take_known(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """The function of the scripts."""
    monkeypatch.syspath_prepend(EXPERIMENTS)
    taken: Callable[..., None] = importlib.import_module("compared").take_known
    return taken


@pytest.fixture
def earlier(tmp_path: Path) -> Path:
    """A file of earlier results."""
    path = tmp_path / "earlier.json"
    path.write_text(json.dumps(EARLIER))
    return path


def test_a_policy_of_another_control_period_stands_beside_no_squeeze(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(EXPERIMENTS)
    load_comparable = importlib.import_module("compared").load_comparable
    shipped = load_policy(asset_path("policy.npz"))
    assert load_comparable(asset_path("policy.npz"), load_robot()).meta == shipped.meta
    meta = copy.deepcopy(shipped.meta)
    meta["task"]["control_dt"] = 0.02
    replace(shipped, meta=meta).save(tmp_path / "slow.npz")
    with pytest.raises(FileError, match=r"slow\.npz: found a control period of 20 ms, expected 10"):
        load_comparable(tmp_path / "slow.npz", load_robot())


def test_controllers_without_a_policy_are_taken_with_their_origin(
    take_known: Callable[..., None], earlier: Path
) -> None:
    record = asked()
    take_known(record, earlier, ["squeeze 3 N", "squeeze 5 N", "grip"], "results")
    assert record["controllers"] == {"squeeze 3 N": ["s"], "grip": ["g"]}
    assert record["provenance"] == {"git": "now"} and record["known"] == [{"git": "earlier"}]
    earlier.write_text(json.dumps(record | {"controllers": {"grip": ["h"]}}))
    record = asked()
    take_known(record, earlier, ["grip"], "results")
    assert record["known"] == [{"git": "now", "known": [{"git": "earlier"}]}]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"settings": {"episodes": 5}}, "episodes 4"),
        ({"settings": {"seed": 1}}, "seed 0"),
        ({"sha256": {"handoffs": "def"}}, "'abc'"),
    ],
)
def test_other_trials_are_refused(
    take_known: Callable[..., None], earlier: Path, change: dict[str, Any], named: str
) -> None:
    record = asked()
    for part, values in change.items():
        record[part] |= values
    with pytest.raises(FileError, match=named):
        take_known(record, earlier, ["squeeze 3 N"], "results")
    assert record["controllers"] == {}
