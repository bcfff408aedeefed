"""Start states that ship with the package."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from mjx_grasp.errors import FileError
from mjx_grasp.handoff import make
from mjx_grasp.handoff import shipped as module
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.shipped import SHIPPED, shipped_for
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.objects.model import stand_in_hash
from mjx_grasp.records.atomic import read_json, write_json
from mjx_grasp.records.provenance import file_digests
from mjx_grasp.training.config import settings_of
from mjx_grasp.training.folder import as_begun, note_resumed, open_run
from mjx_grasp.training.start import handoffs_wanted, made_handoffs

CUBE, STAND_INS, SCANS = (each.path for each in SHIPPED)


def stand_ins(config):
    """As much of the objects as shows whose states would do."""
    return [SimpleNamespace(name=n, content_hash=stand_in_hash(n)) for n in resolve(config.objects)]


def shipped(config, objects=None):
    return shipped_for(handoffs_wanted(config, Path()), objects or stand_ins(config))


@pytest.fixture
def cpu():
    return settings_of("cpu")


@pytest.mark.parametrize("preset, path", [("cpu", CUBE), ("gpu", STAND_INS)])
def test_a_training_without_scans_begins_with_the_shipped_states_of_its_objects(
    preset, path, robot, tmp_path, monkeypatch
):
    monkeypatch.setattr(make, "make_handoffs", lambda *_: pytest.fail("they are there"))
    config = settings_of(preset)
    wanted = handoffs_wanted(config, tmp_path)
    assert shipped(config) == path
    states = made_handoffs(wanted, path, robot, Console(quiet=True))
    assert states.reached.all() and wanted.kind == "reached"
    counts = states.counts()
    assert all(counts[name] >= wanted.per_object for name in resolve(config.objects))
    assert (tmp_path / "handoffs.npz").read_bytes() == path.read_bytes()


def test_scans_begin_with_states_of_the_very_same_scans(robot):
    config = replace(settings_of("gpu"), objects_dir=Path("scans"))
    stored = load_handoffs(SCANS, robot=robot)
    there = dict(zip(stored.object_names, stored.object_content_hash, strict=True))
    objects = [SimpleNamespace(name=n, content_hash=there[n]) for n in resolve(config.objects)]
    assert shipped(config, objects) == SCANS
    assert shipped(replace(settings_of("cpu"), objects_dir=Path("scans")), [objects[2]]) == SCANS
    few = SimpleNamespace(name="bowl", content_hash=there["bowl"])
    assert shipped(config, [few]) == SCANS, "all that were found"
    none = SimpleNamespace(name="mini_soccer_ball", content_hash=there["mini_soccer_ball"])
    assert shipped(config, [few, none]) is None, "none were found"
    objects[-1].content_hash = "another"
    assert shipped(config, objects) is None
    assert shipped(replace(config, objects_dir=None), objects) is None


@pytest.mark.parametrize("each", SHIPPED, ids=lambda each: each.file)
def test_a_shipped_set_has_as_many_states_as_it_says_and_all_of_them_reached(each, robot):
    stored = load_handoffs(each.path, robot=robot)
    counts = [count for count in stored.counts().values() if count]
    full = [count for count in counts if count >= each.per_object]
    assert stored.reached.all() and len(full) >= 0.9 * len(counts)


def test_a_run_says_by_their_digest_that_it_began_with_the_shipped_states(cpu, tmp_path):
    def digests(file):
        folder = tmp_path / str(file is None)
        folder.mkdir()
        open_run(cpu, folder, None, file, None, ())
        return read_json(folder / "provenance.json", "provenance")["sha256"]

    assert digests(CUBE)["shipped_handoffs"] == file_digests(x=CUBE)["x"]
    assert "shipped_handoffs" not in digests(None)


def test_of_two_runs_begun_in_one_folder_the_first_has_it(cpu, tmp_path):
    open_run(cpu, tmp_path / "run", None, CUBE, None, ())
    files = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    assert {"config.json", "provenance.json"} <= set(files)
    with pytest.raises(FileError, match="run: found a run that was begun there at the same time"):
        open_run(replace(cpu, seed=7), tmp_path / "run", None, CUBE, None, ())
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()} == files


def test_a_run_that_cannot_be_opened_leaves_nothing(cpu, tmp_path, monkeypatch):
    monkeypatch.setattr("mjx_grasp.training.folder.copy_file", _full_disk)
    with pytest.raises(OSError, match="no space left"):
        open_run(cpu, tmp_path / "run", None, CUBE, None, ())
    assert not list(tmp_path.iterdir())


def _full_disk(*_):
    raise OSError("no space left")


@pytest.mark.parametrize("resumed", ["twice", [3], {}])
def test_a_provenance_that_says_strange_things_of_resuming_is_refused(cpu, tmp_path, resumed):
    open_run(cpu, tmp_path, None, CUBE, None, ())
    path = tmp_path / "provenance.json"
    began = read_json(path, "provenance")
    made = {name: began[name] for name in ("git", "versions", "device")}
    note_resumed(tmp_path, made | {"device": "another"})
    assert read_json(path, "provenance")["resumed"] == [made | {"device": "another"}]
    write_json(path, began | {"resumed": resumed})
    with pytest.raises(FileError, match=r"provenance\.json: found resumed = "):
        note_resumed(tmp_path, made)


def test_a_resumed_run_copies_only_what_it_began_with(cpu, tmp_path):
    began, made = tmp_path / "began", tmp_path / "made"
    for folder, file in ((began, CUBE), (made, None)):
        folder.mkdir()
        open_run(cpu, folder, None, file, None, ())
    resumed = replace(cpu, resume=began)
    assert as_begun(cpu, CUBE) == CUBE == as_begun(resumed, CUBE)
    with pytest.raises(FileError, match="began: found no copy of the start states"):
        as_begun(resumed, STAND_INS)
    (began / "handoffs.npz").touch()
    assert as_begun(resumed, STAND_INS) is None, "it has its copy"
    assert as_begun(replace(cpu, resume=made), CUBE) is None, "it was making its own"


def test_a_damaged_set_is_named(cpu, tmp_path, monkeypatch):
    (tmp_path / CUBE.name).write_bytes(b"damaged")
    monkeypatch.setattr(module, "asset_path", lambda name: tmp_path / name)
    with pytest.raises(FileError, match=CUBE.name):
        shipped(cpu)


def test_the_seed_of_a_training_changes_nothing_about_shipped_states(cpu):
    assert shipped(replace(cpu, seed=1)) == CUBE


@pytest.mark.parametrize(
    "other",
    [
        {"objects": ("rubiks_cube", "power_drill")},
        {"handoffs_per_object": 512},
        {"handoffs_kind": "ik"},
        {"objects_dir": Path("scans")},
        {"mass": 0.2},
        {"handoffs_gate": "paper"},
    ],
)
def test_states_by_other_settings_are_made(cpu, robot, tmp_path, monkeypatch, other):
    class Made(Exception):
        """In place of what takes minutes."""

    def made(wanted, console):
        raise Made

    monkeypatch.setattr(make, "make_handoffs", made)
    changed = replace(cpu, **other)
    assert shipped(changed) is None
    with pytest.raises(Made):
        made_handoffs(
            handoffs_wanted(changed, tmp_path), shipped(changed), robot, Console(quiet=True)
        )
    assert not list(tmp_path.iterdir()), "nothing is written"
