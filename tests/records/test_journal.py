"""Work that is killed: what was finished is kept, in whatever order it ended, and nothing else."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest

from mjx_grasp.records import journal as module
from mjx_grasp.records.archive import packed, unpacked
from mjx_grasp.records.journal import Journal, goes_on, journaled
from mjx_grasp.records.provenance import versions
from mjx_grasp.records.spread import Spread


@pytest.fixture
def results(tmp_path):
    return tmp_path / "results.json"


@pytest.fixture
def backwards(monkeypatch):
    """Jobs that end in the reverse of their order."""

    def as_done(over, work, jobs, setup, kind):
        context = setup()
        for k in reversed(range(len(jobs))):
            yield k, work(context, jobs[k])

    monkeypatch.setattr(module, "as_done", as_done)


def _run(results, jobs, until=None, identity=None, git="abc"):
    """Results of jobs, and which of them were done; stopped where it gets to a job."""
    done = []

    def work(context, job):
        if job == until:
            raise KeyboardInterrupt
        done.append(job)
        return {"twice": 2 * job, "context": context}

    journal, got = Journal(results, identity or {"seed": 1}, git), []
    named = [(f"job {job}", job) for job in jobs]
    try:
        for result in journaled(Spread(), work, named, lambda: "set up", journal):
            got.append(result["twice"])
        journal.close()
    except KeyboardInterrupt:
        pass
    return got, done


@pytest.mark.parametrize("until", range(5))
def test_what_ended_before_its_turn_is_kept(results, backwards, until):
    got, done = _run(results, [0, 1, 2, 3, 4], until)
    assert got == [] and done == list(range(4, until, -1))
    got, done = _run(results, [0, 1, 2, 3, 4])
    assert got == [0, 2, 4, 6, 8] and sorted(done) == list(range(until + 1))
    assert list(results.parent.iterdir()) == [], "the journal goes once all is in the results"


def test_results_come_in_order_as_soon_as_they_can(results):
    got, done = _run(results, [3, 1, 2], until=2)
    assert got == [6, 2] and done == [3, 1]
    got, done = _run(results, [5, 1, 2, 3])
    assert got == [10, 2, 4, 6] and done == [5, 2], "told apart by their names, not by their place"


def test_nothing_is_left_of_work_of_which_nothing_was_finished(results):
    """What cannot begin at all does not say that it has begun."""
    assert _run(results, [1, 2, 3], until=1) == ([], [])
    assert list(results.parent.iterdir()) == []


def test_a_job_that_is_done_here_is_done_once(results):
    """Also by who was killed before."""
    done = []

    def work(*given):
        done.append(given)
        return [sum(given), None]

    assert Journal(results, {}, "abc").once("three", work, 1, 2) == [3, None]
    journal = Journal(results, {}, "abc")
    assert journal.once("three", work, 1, 2) == [3, None] and done == [(1, 2)]
    assert journal.once("none", work) == [0, None] and done == [(1, 2), ()]


def test_what_is_finished_is_told_at_once(results, backwards):
    journal, told = Journal(results, {}, "abc"), []
    named = [(f"job {job}", job) for job in range(3)]
    got = journaled(Spread(), lambda c, job: job, named, lambda: None, journal, told.append)
    assert next(got) == 0 and told == [2, 1, 0]
    journal.close()


def test_what_has_the_same_name_is_done_once(results):
    assert _run(results, [1, 2, 1]) == ([2, 4, 2], [1, 2])


@pytest.mark.parametrize("cut", range(1, 12))
def test_a_line_that_was_being_written_counts_for_nothing(results, cut):
    _run(results, [1, 2, 3], until=3)
    path = Journal(results, {"seed": 1}, "abc").path
    path.write_bytes(path.read_bytes()[:-cut])
    got, done = _run(results, [1, 2, 3], until=3)
    assert got == [2, 4] and done == ([] if cut == 1 else [2])
    got, done = _run(results, [1, 2, 3])
    assert got == [2, 4, 6] and done == [3], "what came after it is whole"


@pytest.mark.parametrize("other", [{"identity": {"seed": 2}}, {"git": "abd"}])
def test_another_runs_journal_is_not_used(results, other):
    _run(results, [1, 2, 3], until=3)
    assert _run(results, [1, 2, 3], **other) == ([2, 4, 6], [1, 2, 3])


def test_what_uncommitted_code_has_done_is_done_again(results):
    """It may be other code than before."""
    _run(results, [1, 2, 3], until=3, git="abc-dirty")
    assert _run(results, [1, 2, 3], git="abc-dirty") == ([2, 4, 6], [1, 2, 3])


def test_a_file_of_other_settings_or_code_is_not_gone_on_with():
    made = {"git": "abc", "versions": {"python": "3"} | versions()}
    before = {"config": {"seed": 1}, "sha256": {}, "rows": [], "provenance": made}
    same = {"config": {"seed": 1}, "sha256": {}}
    assert goes_on(before, same, "abc")
    assert not goes_on(before, same | {"config": {"seed": 2}}, "abc")
    assert not goes_on(before, same | {"known": {}}, "abc")
    assert not goes_on(before, same, "abd")
    assert not goes_on(before | {"provenance": made | {"git": "abc-dirty"}}, same, "abc-dirty")
    newer = made | {"versions": versions() | {"mujoco": "99.0"}}
    assert not goes_on(before | {"provenance": newer}, same, "abc")
    assert not goes_on(before | {"provenance": {"git": "abc"}}, same, "abc")


def test_what_other_versions_have_done_is_done_again(results, monkeypatch):
    _run(results, [1, 2, 3], until=3)
    monkeypatch.setattr("mjx_grasp.records.journal.versions", lambda: {"mujoco": "99.0"})
    assert _run(results, [1, 2, 3]) == ([2, 4, 6], [1, 2, 3])


def test_what_is_not_json_is_refused_at_once(results):
    journal = Journal(results, {}, "abc")
    with pytest.raises(TypeError, match="JSON"):
        next(journaled(Spread(), lambda c, j: object(), [("one", 1)], lambda: None, journal))
    assert not journal.done and not journal.path.exists()


def test_a_killed_process_loses_nothing_that_was_finished(tmp_path):
    """Two processes' worth of jobs in one, killed without notice; the next does what is left."""
    script = tmp_path / "work.py"
    script.write_text(
        textwrap.dedent(
            """
            import sys, time
            from pathlib import Path
            from mjx_grasp.records.journal import Journal, journaled
            from mjx_grasp.records.spread import Spread

            def work(context, job):
                if job == 5 and sys.argv[1] == "waits":
                    time.sleep(600)
                print(job, flush=True)
                return job

            journal, jobs = Journal(Path("out.json"), {}, "abc"), [(str(k), k) for k in range(8)]
            print(list(journaled(Spread(), work, jobs, lambda: None, journal)), flush=True)
            """
        )
    )
    command = [sys.executable, str(script)]
    first = subprocess.Popen(
        [*command, "waits"], cwd=tmp_path, stdout=subprocess.PIPE, text=True, env=os.environ
    )
    read = [first.stdout.readline().strip() for _ in range(5)]
    journal = tmp_path / ".out.json.begun"
    for _ in range(600):
        if len(journal.read_text().splitlines()) == 6:
            break
        time.sleep(0.05)
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert read == ["0", "1", "2", "3", "4"]
    again = subprocess.run([*command, "on"], cwd=tmp_path, capture_output=True, text=True)
    *did, said = again.stdout.splitlines()
    assert did == ["5", "6", "7"] and json.loads(said) == list(range(8))


def test_arrays_go_into_a_line_of_json_to_the_bit():
    arrays = {
        "half": np.array([1 / 3, np.nan, -np.inf, -0.0], np.float32),
        "none": np.zeros((0, 3)),
        "flags": np.array([[True, False]]),
        "one": np.array(7, np.int32),
    }
    found = unpacked(json.loads(json.dumps(packed(arrays))))
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype and found[name].shape == array.shape
        assert found[name].tobytes() == array.tobytes()
    with pytest.raises(ValueError, match="pickle"):
        unpacked(packed({"object": np.array([{}], dtype=object)}))
