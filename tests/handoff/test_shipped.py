"""Start states that ship with the package."""

from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import FileError
from mjx_grasp.handoff import make
from mjx_grasp.handoff import shipped as module
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.report import read_report
from mjx_grasp.handoff.shipped import SHIPPED, shipped_for
from mjx_grasp.objects.model import stand_in_hash
from mjx_grasp.records.atomic import read_json
from mjx_grasp.records.provenance import file_digests
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


def test_a_run_says_by_their_digest_that_it_began_with_the_shipped_states(config, tmp_path):
    def digests(config):
        folder = tmp_path / str(config.seed)
        folder.mkdir()
        job._open_run(config, folder, None, None, ())
        return read_json(folder / "provenance.json", "provenance")["sha256"]

    assert digests(config)["shipped_handoffs"] == file_digests(x=asset_path(SHIPPED))["x"]
    assert "shipped_handoffs" not in digests(replace(config, seed=1))


@pytest.mark.parametrize("report", ["{", "{}"])
def test_a_damaged_report_is_named_and_one_that_says_nothing_fits_nothing(
    config, tmp_path, monkeypatch, report
):
    (tmp_path / SHIPPED).write_bytes(b"")
    path = (tmp_path / SHIPPED).with_suffix(".json")
    path.write_text(report)
    monkeypatch.setattr(module, "asset_path", lambda name: tmp_path / name)
    wanted = job._handoffs_wanted(config, tmp_path)
    if report == "{}":
        assert shipped_for(wanted) is None
    else:
        with pytest.raises(FileError, match=path.name):
            shipped_for(wanted)


@pytest.mark.parametrize(
    "other",
    [
        {"seed": 1},
        {"objects": ("rubiks_cube", "apple")},
        {"handoffs_per_object": 128},
        {"handoffs_kind": "ik"},
        {"objects_dir": Path("scans")},
        {"mass": 0.2},
        {"handoffs_gate": "paper"},
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
    assert shipped_for(job._handoffs_wanted(changed, tmp_path)) is None
    assert not list(tmp_path.iterdir()), "nothing is written"
