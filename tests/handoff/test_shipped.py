"""Start states that ship with the package."""

from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.handoff import make
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.report import read_report
from mjx_grasp.handoff.shipped import SHIPPED, take_shipped
from mjx_grasp.objects.model import stand_in_hash
from mjx_grasp.training import job
from mjx_grasp.training.config import settings_of


@pytest.fixture(scope="module")
def config():
    return settings_of("cpu")


def test_a_training_without_scans_begins_with_the_shipped_states_of_its_object(
    config, robot, tmp_path, monkeypatch
):
    monkeypatch.setattr(make, "make_handoffs", lambda *_: pytest.fail("they are there"))
    states = job._made_handoffs(config, robot, tmp_path, Console(quiet=True))
    assert states.counts() == {"rubiks_cube": config.handoffs_per_object}
    assert states.reached.all() and config.handoffs_kind == "reached"
    assert states.object_content_hash == (stand_in_hash("rubiks_cube"),), "of today's stand-in"
    shipped = asset_path(SHIPPED)
    assert (tmp_path / "handoffs.npz").read_bytes() == shipped.read_bytes()
    assert read_report(tmp_path / "handoffs.json") == read_report(shipped.with_suffix(".json"))
    assert load_handoffs(tmp_path / "handoffs.npz", robot=robot).counts() == states.counts()


@pytest.mark.parametrize(
    "other",
    [
        {"seed": 1},
        {"objects": ("rubiks_cube", "apple")},
        {"handoffs_per_object": 128},
        {"handoffs_kind": "ik"},
        {"objects_dir": Path("scans")},
        {"mass": 0.2},
    ],
)
def test_states_by_other_settings_are_made(config, robot, tmp_path, monkeypatch, other):
    class Made(Exception):
        """In place of what takes minutes."""

    def made(wanted, console):
        raise Made

    monkeypatch.setattr(make, "make_handoffs", made)
    changed = replace(config, **other)
    with pytest.raises(Made):
        job._made_handoffs(changed, robot, tmp_path, Console(quiet=True))
    assert not take_shipped(job._handoffs_wanted(changed, tmp_path))
    assert not list(tmp_path.iterdir()), "nothing is written"
