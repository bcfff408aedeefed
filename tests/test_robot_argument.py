"""The robot is an argument of every command, and an unknown or foreign one is refused early."""

from pathlib import Path

import pytest
from six_axis import write_six_axis
from typed import refusal

from mjx_grasp.assets import asset_path

SQUEEZE = ("--controller", "squeeze", "--objects", "foam_brick", "--out", "new.json")
TRAINING = ("--preset", "cpu", "--objects", "foam_brick", "--out", "new")
ROBOTS = {
    "nobody": "robot: found 'nobody', expected rizon4_hx5d20, or a description's file",
    "none.yaml": "none.yaml: found No such file",
    "empty.yaml": "empty.yaml: ",
}
"""Robots that there are not, and what is said of them."""


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize(
    ("module", "arguments"),
    [
        ("evaluate", SQUEEZE),
        ("train", TRAINING),
        ("handoffs", ("--objects", "foam_brick", "--per-object", "2", "--out", "new.npz")),
        ("sweep_reach", ("--poses", "8", "--out", "new.json")),
    ],
)
def test_an_unknown_robot_is_refused_before_anything_is_made(
    tmp_path, monkeypatch, capsys, module, arguments, robot
):
    (tmp_path / "empty.yaml").write_text("")
    status, error = refusal(monkeypatch, capsys, module, *arguments, "--robot", robot)
    assert status == 2
    assert ROBOTS[robot] in error
    assert [p.name for p in Path().iterdir()] == ["empty.yaml"]


@pytest.mark.parametrize(
    ("module", "arguments"),
    [
        ("evaluate", SQUEEZE[2:]),
        ("evaluate", SQUEEZE),
        ("train", (*TRAINING, "--handoffs", asset_path("handoffs_standins.npz"))),
    ],
    ids=["policy", "handoffs", "training"],
)
def test_files_of_one_robot_are_refused_for_another(
    tmp_path_factory, monkeypatch, capsys, module, arguments
):
    other = write_six_axis(tmp_path_factory.mktemp("robot"))
    status, error = refusal(monkeypatch, capsys, module, *arguments, "--robot", other)
    assert status == 2
    assert "rizon4_hx5d20" in error and "six_axis" in error
    assert list(Path().iterdir()) == []
