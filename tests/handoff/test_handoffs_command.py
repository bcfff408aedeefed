"""What the command says and writes, with made-up states in place of the search for them."""

import dataclasses
import sys

import handmade
import numpy as np
import pytest

from mjx_grasp import handoffs as command
from mjx_grasp.errors import InputError
from mjx_grasp.handoff import make as module
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.report import ObjectReport


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs the command in this process; every object gets `states` states."""

    def with_arguments(*arguments, states=3):
        class Generator:
            def __init__(self, robot, config):
                pass

            def generate(self, obj, progress):
                made = handmade.handoffs([obj], turns=(0.0,) * states or (0.0,))
                made = made.take(np.arange(states))
                return made, ObjectReport(obj.name, kept=states)

        monkeypatch.setattr(module, "HandoffGenerator", Generator)
        monkeypatch.setattr(sys, "argv", ["handoffs", *map(str, arguments)])
        command.main()
        return " ".join(capsys.readouterr().out.split())

    return with_arguments


def test_no_state_at_all_is_an_error_and_no_file(run, tmp_path):
    with pytest.raises(InputError, match=r"--objects: found 'foam_brick, sugar_box'.*1 round"):
        run(
            *("--objects", "foam_brick", "sugar_box", "--max-rounds", 1),
            *("--out", tmp_path / "x.npz"),
            states=0,
        )
    assert list(tmp_path.iterdir()) == []


def test_an_update_counts_and_keeps_the_whole_set(run, tmp_path):
    out = tmp_path / "set.npz"
    assert "3 states of 1 objects" in run("--objects", "foam_brick", "--out", out)
    said = run("--objects", "sugar_box", "--update", out, "--out", out, states=2)
    assert "5 states of 2 objects" in said and "warning" not in said
    assert load_handoffs(out).counts() == {"foam_brick": 3, "sugar_box": 2}


def test_an_update_warns_of_scans_among_stand_ins(run, tmp_path):
    out = tmp_path / "set.npz"
    run("--objects", "foam_brick", "--out", out)
    scanned = dataclasses.replace(load_handoffs(out), object_content_hash=("of-a-scan",))
    scanned.save(out)
    said = run("--objects", "sugar_box", "--update", out, "--out", out)
    assert "warning: the set's foam_brick are scans and the new objects stand-ins" in said


def test_a_set_that_git_knows_does_not_make_its_own_revision_dirty(run, tmp_path, monkeypatch):
    out = tmp_path / "set.npz"
    before = module.provenance

    def provenance(seed):
        assert not out.exists()
        return before(seed)

    monkeypatch.setattr(module, "provenance", provenance)
    run("--objects", "foam_brick", "--out", out)
    assert out.exists()
