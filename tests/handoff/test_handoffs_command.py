"""What the command says and writes, with made-up states in place of the search for them."""

import dataclasses
import json
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


def test_several_sets_become_one_and_the_last_of_an_object_counts(run, tmp_path):
    sets = [tmp_path / f"{k}.npz" for k in range(3)]
    run("--objects", "foam_brick", "apple", "--out", sets[0], states=2)
    run("--objects", "apple", "sugar_box", "--out", sets[1], states=4)
    said = run("--objects", "sugar_box", "--update", *sets[:2], "--out", sets[2])
    assert "9 states of 3 objects" in said
    assert load_handoffs(sets[2]).counts() == {"foam_brick": 2, "apple": 4, "sugar_box": 3}
    report = json.loads(sets[2].with_suffix(".json").read_text())
    rows = [(row["name"], row["kept"]) for row in report["objects"]]
    assert rows == [("foam_brick", 2), ("apple", 4), ("sugar_box", 3)]
    made = [json.loads(s.with_suffix(".json").read_text())["provenance"] for s in sets[:2]]
    assert report["earlier"] == made


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


@pytest.fixture
def mix(monkeypatch, capsys):
    """Makes a set with so many states of inverse kinematics and reached ones to choose from."""

    def with_arguments(*arguments, ik, reached):
        def maker(kind, most):
            class Generator:
                def __init__(self, robot, config):
                    self.wanted = config.per_object

                def generate(self, obj, progress):
                    count = min(self.wanted, most)
                    made = handmade.handoffs([obj], turns=(0.0,) * max(count, 1))
                    made = made.take(np.arange(count))
                    made = dataclasses.replace(made, reached=np.full(count, kind == "reached"))
                    report = ObjectReport(obj.name, kind)
                    report.keep(made, 1.0)
                    return made, report

            return Generator

        monkeypatch.setattr(module, "HandoffGenerator", maker("ik", ik))
        monkeypatch.setattr(module, "ReachedGenerator", maker("reached", reached))
        monkeypatch.setattr(sys, "argv", ["handoffs", *map(str, arguments)])
        command.main()
        return " ".join(capsys.readouterr().out.split())

    return with_arguments


@pytest.mark.parametrize(
    ("share", "ik", "reached", "kept"),
    [
        (0.5, 9, 9, (4, 4)),
        (0.25, 9, 9, (6, 2)),
        (0.5, 3, 9, (3, 4)),
        (0.5, 9, 1, (1, 1)),
        (0.25, 3, 9, (3, 1)),
    ],
)
def test_the_share_of_a_mixture_holds_for_every_object(mix, tmp_path, share, ik, reached, kept):
    out = tmp_path / "set.npz"
    said = mix(
        *("--kind", "mixed", "--reached-share", share, "--per-object", 8, "--out", out),
        *("--objects", "foam_brick", "sugar_box"),
        ik=ik,
        reached=reached,
    )
    found = load_handoffs(out)
    assert found.kind == "mixed"
    for name in found.object_names:
        states = found.select([name])
        assert (np.sum(~states.reached), np.sum(states.reached)) == kept
        assert abs(kept[1] - share * sum(kept)) <= 0.5
    assert f"{2 * sum(kept)} states of 2 objects, {2 * kept[1]} of them reached" in said
    assert "Tip errors of reached start states" in said and "published" in said
    report = json.loads(out.with_suffix(".json").read_text())
    rows = [(row["name"], row["kind"], row["kept"]) for row in report["objects"]]
    assert rows == [
        (name, kind, count)
        for name in ("foam_brick", "sugar_box")
        for kind, count in zip(("ik", "reached"), kept, strict=True)
    ]
    assert report["config"]["kind"] == "mixed" and report["not_eligible"] == []


def test_an_object_without_states_of_one_kind_has_none_in_a_mixture(mix, tmp_path):
    with pytest.raises(InputError, match=r"--objects: found 'foam_brick'"):
        mix(
            *("--kind", "mixed", "--objects", "foam_brick", "--out", tmp_path / "x.npz"),
            ik=9,
            reached=0,
        )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["ik", "reached"])
def test_one_kind_is_made_alone(mix, tmp_path, kind):
    out = tmp_path / "set.npz"
    said = mix(
        *("--kind", kind, "--per-object", 5, "--objects", "foam_brick", "--out", out),
        ik=9,
        reached=9,
    )
    found = load_handoffs(out)
    assert found.kind == kind and len(found) == 5
    assert ("Tip errors" in said) == (kind == "reached")


def test_an_update_may_be_of_another_kind(mix, tmp_path):
    out = tmp_path / "set.npz"
    mix("--objects", "foam_brick", "--per-object", 3, "--out", out, ik=9, reached=0)
    mix(
        *("--kind", "reached", "--objects", "sugar_box", "--per-object", 2),
        *("--update", out, "--out", out),
        ik=0,
        reached=9,
    )
    found = load_handoffs(out)
    assert found.kind == "mixed"
    assert found.select(["foam_brick"]).kind == "ik"
    assert found.select(["sugar_box"]).kind == "reached"
    report = json.loads(out.with_suffix(".json").read_text())
    assert [(row["name"], row["kind"]) for row in report["objects"]] == [
        ("foam_brick", "ik"),
        ("sugar_box", "reached"),
    ]
