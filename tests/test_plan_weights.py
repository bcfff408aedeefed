"""Other weights of plans: what a factor changes, and what the table says of the trials."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from types import ModuleType

import pytest

from mjx_grasp.reaching.plan_config import PlanConfig

EXPERIMENTS = Path(__file__).resolve().parent.parent / "experiments"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """Scripts by name."""
    monkeypatch.syspath_prepend(EXPERIMENTS)
    return importlib.import_module


def _differing(one: PlanConfig, other: PlanConfig) -> set[str]:
    return {f.name for f in fields(one) if getattr(one, f.name) != getattr(other, f.name)}


def test_a_factor_changes_its_setting_alone(script: Callable[[str], ModuleType]) -> None:
    plan = PlanConfig(edge_weight=200.0, hold_weight=3.0)
    changed = script("plan_weights").weighed(plan, {"edge_weight": 3.0})
    assert changed.edge_weight == pytest.approx(600.0)
    assert _differing(plan, changed) == {"edge_weight"}


def test_more_starts_are_as_many_times_more(script: Callable[[str], ModuleType]) -> None:
    plan = PlanConfig()
    changed = script("plan_weights").weighed(plan, {"starts": 3.0})
    assert changed.starts.count == 3 * plan.starts.count
    assert changed.starts.ranked == 3 * plan.starts.ranked
    assert _differing(plan, changed) == {"starts"}


def test_every_variant_but_the_first_changes_something_of_whole_grasps(
    script: Callable[[str], ModuleType],
) -> None:
    from mjx_grasp.pipeline.assemble import whole_grasps

    plan, module = whole_grasps().plan, script("plan_weights")
    assert plan is not None
    changed = [_differing(plan, module.weighed(plan, f)) for f in module.VARIANTS.values()]
    assert not changed[0]
    assert all(changed[1:])


def test_the_table_counts_successes_and_averages_the_forces_of_lifts(
    script: Callable[[str], ModuleType], tmp_path: Path
) -> None:
    rows = [
        {"controller": "squeeze 10 N", "outcomes": "SSLP", "forces_n": [4.0, 6.0, None, 2.0]},
    ]
    record = {
        "settings": {"episodes": 4, "object": "sugar_box"},
        "variants": {"as it is": {"factors": {"edge_weight": 3.0}, "states": 2, "rows": rows}},
    }
    path = tmp_path / "plan_weights.json"
    path.write_text(json.dumps(record))
    table = script("stage_tables").plan_weights(path)
    assert "| as it is | `edge_weight` × 3 | 2 | 50.0 at 4.00 |" in table
    assert "4 trials each, sugar box" in table
