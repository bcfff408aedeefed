"""Which policy is shipped: the rule's points, and the ranking at the command line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.statistics import wilson_interval

EXPERIMENTS = Path(__file__).resolve().parent.parent / "experiments"
PLANNED = EXPERIMENTS / "results" / "choice" / "planned"


@pytest.fixture
def rule(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(EXPERIMENTS)
    import choose_policy

    return choose_policy


def _made(path: Path, outcome: str, force: float) -> Path:
    """A file in which all trials came out alike, with the same mean force."""
    record = json.loads((PLANNED / "longer.json").read_text())
    names = {"S": "successes", "L": "never_lifted", "H": "not_held", "P": "slipped"}
    for row in record["rows"]:
        row |= dict.fromkeys(names.values(), 0) | {names[outcome]: row["episodes"]}
        row["outcomes"] = outcome * row["episodes"]
        row["forces_n"] = [force] * row["episodes"]
        row["ci95"] = wilson_interval(row["successes"], row["episodes"])
    path.write_text(json.dumps(record))
    return path


@pytest.mark.parametrize(
    ("outcome", "force", "expected"),
    [("S", 1.0, 100.0), ("S", 2.5, 75.0), ("S", 3.5, 50.0), ("S", 9.0, 25.0), ("L", 1.0, 0.0)],
)
def test_all_trials_alike(
    rule: Any, tmp_path: Path, outcome: str, force: float, expected: float
) -> None:
    assert rule.points(_made(tmp_path / "a.json", outcome, force)) == pytest.approx(expected)


def test_points_are_those_of_a_count_trial_by_trial(rule: Any) -> None:
    path = PLANNED / "planned-3.json"
    shares: dict[tuple[float, float, float], list[float]] = {}
    for row in json.loads(path.read_text())["rows"]:
        if row["controller"] != "policy":
            continue
        for most in (2, 3, 4, 1e9):
            ok = [
                o == "S" and (f or 0) <= most
                for o, f in zip(row["outcomes"], row["forces_n"], strict=True)
            ]
            shares.setdefault((row["friction"], most, row["force_budget_n"]), []).append(
                float(np.mean(ok))
            )
    best: dict[tuple[float, float], float] = {}
    for (friction, most, _), of in shares.items():
        best[friction, most] = max(best.get((friction, most), 0.0), float(np.mean(of)))
    assert rule.points(path) == pytest.approx(100 * np.mean(list(best.values())))


def test_what_differs_in_the_robot_or_the_mass_alone_is_a_condition_too(
    rule: Any, tmp_path: Path
) -> None:
    light, heavy = (
        json.loads(_made(tmp_path / f"{force}.json", "S", force).read_text())
        for force in (1.0, 3.5)
    )
    for row in heavy["rows"]:
        row["robot_errors"] = row["robot_errors"] | {"stiffness": [0.5, 0.5]}
    light["rows"] += heavy["rows"]
    (tmp_path / "both.json").write_text(json.dumps(light))
    assert rule.points(tmp_path / "both.json") == pytest.approx((100.0 + 50.0) / 2)


def test_a_gentler_policy_is_ranked_higher_and_the_last_line_names_it(tmp_path: Path) -> None:
    _made(tmp_path / "hard.json", "S", 3.5)
    _made(tmp_path / "gentle.json", "S", 1.5)
    done = subprocess.run(
        [sys.executable, EXPERIMENTS / "choose_policy.py", tmp_path],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split()[-1] == "gentle"


def test_folders_without_a_common_policy_are_refused(rule: Any, tmp_path: Path) -> None:
    folders = tuple(tmp_path / name for name in ("a", "b"))
    for folder in folders:
        folder.mkdir()
        _made(folder / f"{folder.name}.json", "S", 1.0)
    with pytest.raises(FileError, match="no policy that is in all folders"):
        rule.main(rule.ChooseConfig(folders))
