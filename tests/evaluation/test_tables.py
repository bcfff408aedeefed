from dataclasses import replace
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation import paper
from mjx_grasp.evaluation.conditions import read_groups
from mjx_grasp.evaluation.results import ResultRow, write_results
from mjx_grasp.evaluation.statistics import wilson_interval
from mjx_grasp.evaluation.tables import condition_table, failure_table, force_table, success_table
from mjx_grasp.records.table import Table
from mjx_grasp.robot.identity import FIRST_ROBOT

PROVENANCE = {"command": "c", "git": "g", "versions": {}, "device": "a card", "seed": 0}


def row(name, successes, force=None, n=10, **changes):
    values = dict(
        object=name, controller="policy" if force is None else "squeeze", engine="mujoco",
        episodes=n, successes=successes, never_lifted=n - successes, not_held=0, slipped=0,
        ci95=wilson_interval(successes, n), force_mean_n=2.0, force_peak_n=5.0,
        squeeze_force_n=force, offset_mm=5.0, angle_deg=0.0, friction=0.8, handoffs="ik",
    )  # fmt: skip
    return ResultRow(**(values | changes))


def eight(successes, force=None, **changes):
    return [row(name, successes, force, **changes) for name in paper.OBJECTS]


def cells(table: Table, name: str) -> tuple[str, ...]:
    return next(r for r in table.rows if r[0] == name)


def test_the_papers_means_follow_from_its_rows():
    rows = paper.OBJECTS.values()
    for i in range(2):
        assert np.mean([r[i] for r in rows]) == pytest.approx(paper.MEAN[i], abs=0.05)
    assert np.mean([r.reach_mm[0] for r in rows]) == pytest.approx(paper.MEAN.reach_mm[0], abs=0.9)
    for who, mean in (("ours", paper.MEAN.ours), ("squeeze", paper.MEAN.squeeze)):
        assert sum(paper.FAILURES[who].values()) == pytest.approx(100 - mean, abs=0.5)


def test_controllers_are_columns_beside_the_papers():
    table = success_table([*eight(9), *eight(6, 5.0), *eight(5, 3.0)])
    assert table.header == (
        "object", "policy", "squeeze 3 N", "squeeze 5 N", "paper: policy", "paper: squeeze 3 N",
    )  # fmt: skip
    assert [r[0] for r in table.rows[:8]] == [n.replace("_", " ") for n in paper.OBJECTS]
    assert cells(table, "sugar box")[1:] == (
        "90.0 (60–98)", "50.0 (24–76)", "60.0 (31–83)", "93.9", "14.3"
    )  # fmt: skip
    assert cells(table, "mean %")[1].startswith("90.0 (")
    assert cells(table, "mean %")[-2:] == ("91.9", "56.1")
    assert cells(table, "force mean / peak N")[1] == "2.0 / 5.0"
    assert "10 episodes per object" in table.title


def test_a_friction_that_differs_from_trial_to_trial_is_said():
    assert "friction 0.8 ± 0.3" in success_table(eight(9, friction_spread=0.3)).title
    assert "±" not in success_table(eight(9)).title.partition("friction")[2]


def test_other_objects_have_no_figures_of_the_paper():
    only_others = success_table([row("pear", 3), row("mug", 4)])
    assert only_others.header == ("object", "policy")
    mixed = success_table([row("pear", 3), row("apple", 4)])
    assert [r[0] for r in mixed.rows] == ["apple", "pear", "mean %", "force mean / peak N"]
    assert cells(mixed, "pear")[-2:] == ("", "")
    assert cells(mixed, "mean %")[-2:] == ("", "")  # the paper's mean is over its eight


def test_forces_average_over_objects_and_peaks_do_not():
    rows = [
        row("apple", 3, force_mean_n=1.0, force_peak_n=4.0),
        row("pear", 3, force_mean_n=2.0, force_peak_n=9.0),
        row("mug", 0, force_mean_n=None, force_peak_n=None),
    ]
    assert cells(success_table(rows), "force mean / peak N")[1] == "1.5 / 9.0"


def test_files_are_sorted_into_conditions(tmp_path):
    write_results(tmp_path / "policy.json", eight(9), PROVENANCE, FIRST_ROBOT)
    write_results(tmp_path / "squeeze.json", eight(5, 3.0), PROVENANCE, FIRST_ROBOT)
    write_results(tmp_path / "mjx.json", eight(8, engine="mjx"), PROVENANCE, FIRST_ROBOT)
    write_results(
        tmp_path / "paper.json", eight(7), PROVENANCE, FIRST_ROBOT, label="policy, paper's preset"
    )
    groups = read_groups(sorted(tmp_path.iterdir()))
    assert [[c.label for c in columns] for columns in groups.values()] == [
        ["policy", "policy, paper's preset", "squeeze 3 N"],
        ["policy"],
    ]
    means = [[f"{c.mean()[0]:.1f}" for c in columns] for columns in groups.values()]
    assert means == [["90.0", "70.0", "50.0"], ["80.0"]]
    (first, columns), *_ = groups.items()
    assert condition_table(first, columns).header[1:4] == tuple(c.label for c in columns)
    assert len(force_table(first, columns).rows) == 8
    failures = failure_table(first, columns)
    assert cells(failures, "never lifted")[1:] == ("10.0", "30.0", "50.0", "4.9", "23.8")


@pytest.mark.parametrize(
    ("command", "extra", "meshes"),
    [
        ("train --resume runs/a", {"scans": True}, "real scans"),
        ("train --objects_dir=SCANS", {"settings": {"objects_dir": "SCANS"}}, "real scans"),
        ("a script of --objects-dir", {"scans": False}, "parametric stand-ins"),
        ("evaluate --objects-dir SCANS", {}, "real scans"),
    ],
)
def test_what_objects_were_made_of_is_in_the_file(tmp_path, command, extra, meshes):
    made = PROVENANCE | {"command": f"python -m mjx_grasp.{command}"}
    write_results(tmp_path / "a.json", eight(9), made, FIRST_ROBOT, **extra)
    (condition,) = read_groups([tmp_path / "a.json"])
    assert condition.meshes == meshes


def test_two_files_may_not_claim_the_same_outcome(tmp_path):
    write_results(tmp_path / "a.json", eight(9), PROVENANCE, FIRST_ROBOT)
    write_results(tmp_path / "b.json", eight(5), PROVENANCE, FIRST_ROBOT)
    with pytest.raises(FileError, match=r"b\.json.*a\.json"):
        read_groups([tmp_path / "a.json", tmp_path / "b.json"])
    write_results(tmp_path / "c.json", [row("apple", 3), row("apple", 3)], PROVENANCE, FIRST_ROBOT)
    with pytest.raises(FileError, match=r"c\.json.*apple"):
        read_groups([tmp_path / "c.json"])


def test_one_table_shows_one_condition():
    with pytest.raises(InputError, match="2 conditions"):
        success_table([*eight(9), *eight(9, offset_mm=10.0)])


def test_the_three_layouts_hold_the_same_cells(monkeypatch):
    table = replace(success_table([*eight(9), *eight(5, 3.0)]), title="a < b & c")

    monkeypatch.syspath_prepend(Path(__file__).resolve().parents[2] / "experiments")
    lines = import_module("markdown_tables").markdown(table).splitlines()
    found = [[c.strip(" *") for c in line.strip("|").split("|")] for line in lines]
    assert tuple(found[0]) == table.header
    assert [tuple(r) for r in found[2:]] == list(table.rows)

    class Cells(HTMLParser):
        def __init__(self):
            super().__init__()
            self.text, self.caption, self.tag = [], "", ""

        def handle_starttag(self, tag, attrs):
            self.tag = self.tag if tag == "span" else tag
            if tag in ("td", "th"):
                self.text.append("")

        def handle_data(self, data):
            if self.tag == "figcaption":
                self.caption += data
            elif self.tag in ("td", "th"):
                self.text[-1] += data

    parser = Cells()
    parser.feed(table.html())
    assert parser.text == [*table.header, *(c for r in table.rows for c in r)]
    assert parser.caption == "a < b & c"

    text = "".join(segment.text for segment in Console(width=200).render(table))
    assert all(cell in text for r in table.rows for cell in r)
