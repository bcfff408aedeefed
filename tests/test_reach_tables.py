"""Tables of reaching say what their results files hold."""

import json
from pathlib import Path

import pytest
from loaded import script

ROOT = Path(__file__).resolve().parent.parent
SWEEP, ABLATION = (
    ROOT / "experiments" / "results" / f"reach_{name}.json" for name in ("sweep_cpu", "ablation")
)


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    return script("reach_tables")


def test_reaches_stand_beside_those_of_the_preset_and_the_published_ones(tables):
    sweep, preset = (json.loads(path.read_text()) for path in (SWEEP, ABLATION))
    preset = preset["rows"]["paper"]
    shown = tables.reach_rates(SWEEP, ABLATION)
    row = next(line for line in shown.splitlines() if line.startswith("| 20 mm"))
    columns = sweep["rate_percent"], preset["rate_percent"], sweep["paper_rate_percent"]
    expected = [" / ".join(f"{c['20'][b]:.1f}" for c in columns) for b in ("0.5", "3", "7")]
    cells = [cell.strip() for cell in row.split("|")]
    assert [cells[2], cells[5], cells[7]] == expected
    tip = preset["handoff_mm"]["index"]
    assert f"/ {tip['mean']:.1f} ± {tip['std']:.1f} / 14.2 ± 5.0" in shown
    assert "(preset:" not in shown


def test_a_preset_of_other_poses_says_so(tables, tmp_path):
    other = json.loads(ABLATION.read_text()) | {"poses": 12345}
    (tmp_path / "ablation.json").write_text(json.dumps(other))
    assert "(preset: 12,345)" in tables.reach_rates(SWEEP, tmp_path / "ablation.json")


def test_without_the_preset_there_are_two_columns_and_without_a_sweep_no_table(tables, tmp_path):
    shown = tables.reach_rates(SWEEP, tmp_path / "no.json")
    assert "(ours / published)" in shown and "/ 14.2 ± 5.0" in shown
    assert tables.reach_rates(tmp_path / "no.json", ABLATION) == tables.NOTHING
