"""`experiments/paper.py`: parts by name, what counts as done, and what its commands are."""

import importlib
import shlex
from pathlib import Path

import pytest

from mjx_grasp.errors import InputError

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def paper(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    return importlib.import_module("paper")


def test_parts_are_asked_for_by_name(paper):
    assert [part.name for part in paper.chosen(("eight", "reach"))] == ["reach", "eight"]
    assert paper.chosen(()) == list(paper.PARTS)
    with pytest.raises(InputError, match="parts: found 'eigth', expected some of heatmaps"):
        paper.chosen(("eigth",))


def test_every_command_is_of_this_repository_and_no_two_write_the_same_file(paper):
    commands = [shlex.split(c) for c in {c for part in paper.PARTS for c in part.commands}]
    made = [words[words.index("--out") + 1] for words in commands if "--out" in words]
    assert len(set(made)) == len(made) > 20
    for words in commands:
        module = words[0] == "-m"
        file = ROOT / (f"{words[1].replace('.', '/')}.py" if module else words[0])
        assert file.is_file(), file


def test_trainings_that_are_made_again_take_the_place_of_their_rows(paper):
    collects = [c for part in paper.PARTS for c in part.commands if "collect_runs" in c]
    assert len(collects) == 2 and all("--replace" in command for command in collects)


def test_done_is_what_this_revision_made_of_these_scans_and_is_still_there(
    paper, tmp_path, monkeypatch
):
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "a.obj").write_text("v 0 0 0")
    monkeypatch.setattr(paper, "ROOT", tmp_path)
    monkeypatch.setattr(paper, "git_revision", lambda: "abc")
    monkeypatch.setattr(paper, "is_committed", lambda git: git == "abc")
    command, scans = "experiments/x.py --out results/x.json", tmp_path / "scans"
    entry = {"git": "abc", "scans": paper.digest_of(scans), "seconds": 1.0}
    assert not paper.done({command: entry}, command, scans), "nothing was made"
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "x.json").write_text("{}")
    assert paper.done({command: entry}, command, scans)
    assert not paper.done({}, command, scans)
    assert not paper.done({command: entry | {"git": "abd"}}, command, scans)
    (scans / "a.obj").write_text("v 0 0 0 # more")
    assert not paper.done({command: entry}, command, scans)
    figure = "experiments/figure.py"
    assert paper.done({figure: entry | {"scans": paper.digest_of(scans)}}, figure, scans)
