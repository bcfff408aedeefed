"""What the command says and writes, with made-up states in place of the search for them."""

import dataclasses
import json
import sys
from collections import Counter
from dataclasses import replace

import handmade
import numpy as np
import pytest
from on_cores import run_on_cores

from mjx_grasp import handoffs as command
from mjx_grasp.errors import InputError
from mjx_grasp.handoff import make as module
from mjx_grasp.handoff.dataset import ARRAYS, load_handoffs
from mjx_grasp.handoff.record import as_record, from_record
from mjx_grasp.handoff.report import ObjectReport
from mjx_grasp.objects.model import load_object


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


def test_a_killed_run_goes_on_after_the_objects_that_were_finished(
    run, tmp_path, monkeypatch, committed
):
    """And gives what it had given without that; other settings begin anew."""
    arguments = "--objects", "foam_brick", "apple", "sugar_box", "--out"
    run(*arguments, tmp_path / "whole.npz")
    states_of, tried, deadly = module._Making.states_of, [], ["apple"]

    def state(self, obj):
        tried.append(obj.name)
        if obj.name in deadly:
            raise KeyboardInterrupt
        return states_of(self, obj)

    monkeypatch.setattr(module._Making, "states_of", state)
    out = tmp_path / "set.npz"
    with pytest.raises(KeyboardInterrupt):
        run(*arguments, out)
    assert not out.exists(), "only what is whole is a set"
    deadly.clear()
    assert "goes on after foam_brick" in run(*arguments, out)
    assert tried == ["foam_brick", "apple", "apple", "sugar_box"]
    assert out.read_bytes() == (tmp_path / "whole.npz").read_bytes()
    reports = [json.loads((tmp_path / f"{n}.json").read_text()) for n in ("set", "whole")]
    assert reports[0]["objects"] == reports[1]["objects"]
    assert not list(tmp_path.glob(".*")), "no journal is left"

    def on_gpu():
        monkeypatch.setattr(module.jax, "default_backend", lambda: "gpu")

    def other_robot():
        load = module.load_robot
        another = replace(load(), name="another")
        monkeypatch.setattr(module, "load_robot", lambda name: another)

    def other_scan():
        load = module.load_objects

        def changed(*given, **named):
            return [replace(obj, content_hash="other") for obj in load(*given, **named)]

        monkeypatch.setattr(module, "load_objects", changed)

    for change, flags in ((None, ("--seed", 1)), (on_gpu, ()), (other_robot, ()), (other_scan, ())):
        deadly.append("sugar_box")
        with pytest.raises(KeyboardInterrupt):
            run(*arguments, out)
        deadly.clear()
        if change:
            change()
        assert "goes on" not in run(*arguments, out, *flags), change


def test_processes_take_the_largest_objects_first():
    small, large, middle = (load_object(n) for n in ("golf_ball", "cracker_box", "apple"))
    assert module.largest_first([small, large, middle]) == [large, middle, small]


def test_an_object_is_kept_to_the_bit(robot):
    """Without any state, too, and with what was said of it."""
    brick = load_object("foam_brick")
    made = handmade.handoffs([brick], turns=(0.3, 1.1))
    report = ObjectReport("foam_brick", "reached", rejected=Counter({"lift": 3, "hold": 1}))
    report.reach_seconds = [1.3, 2.1]
    report.keep(made, 0.1 + 0.2)
    for states in (made, made.take(np.arange(0))):
        record = json.loads(json.dumps(as_record(states, report)))
        found, said = from_record(record, brick, robot)
        for name in ARRAYS:
            wanted = getattr(states, name)
            assert getattr(found, name).dtype == wanted.dtype
            np.testing.assert_array_equal(getattr(found, name), wanted)
        assert (found.object_names, found.object_content_hash) == (
            states.object_names,
            states.object_content_hash,
        )
        assert found.robot.agrees(states.robot)
        assert said == report and said.rejected["lift"] == 3 and said.rejected["self"] == 0


@pytest.mark.long
@pytest.mark.parametrize("kind", ["ik", "mixed"])
def test_two_processes_write_what_one_does(kind, tmp_path):
    found = []
    for n in (1, 2):
        out = tmp_path / f"{n}.npz"
        command = [sys.executable, "-m", "mjx_grasp.handoffs", "--objects", "foam_brick", "apple"]
        command += ["--kind", kind, "--per-object", 4, "--max-rounds", 1]
        command += ["--sampling.poses-per-round", 16, "--processes", n, "--out", out]
        run_on_cores(command, n)
        report = json.loads(out.with_suffix(".json").read_text())
        assert report["config"]["processes"] == 1, "it makes no difference to the results"
        found.append([{**row, "seconds": None} for row in report["objects"]])
    assert found[0] == found[1]
    assert (tmp_path / "1.npz").read_bytes() == (tmp_path / "2.npz").read_bytes()


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
