"""Jobs over processes: order, cores, errors, lost processes; one comparison by one and by two."""

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.errors import FileError, InputError, MjxGraspError
from mjx_grasp.records import spread as module
from mjx_grasp.records.spread import (
    Left,
    Place,
    Spread,
    as_done,
    cores_of,
    places_on,
    spread,
    unspread,
)

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"


@pytest.fixture
def two_cores():
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        pytest.skip("two processes need two cores")
    return cores


def test_one_process_does_its_jobs_itself_after_what_comes_before():
    log = []

    def setup():
        log.append("setup")
        return 100

    def work(context, job):
        log.append(job)
        return context + job

    results = spread(Spread(), work, [1, 2], setup)
    assert log == [], "nothing is done before it is asked for"
    assert next(results) == 101 and log == ["setup", 1]
    assert list(results) == [102] and log == ["setup", 1, 2]
    assert list(spread(Spread(), work, [], setup)) == []


@pytest.mark.parametrize("count", [1, 2, 3, 5, 7])
def test_every_core_is_in_one_share(count):
    shares = [cores_of(Place(k, count), range(7)) for k in range(count)]
    assert sorted(core for share in shares for core in share) == list(range(7))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_more_processes_than_cores_of_a_machine_share_them():
    assert [cores_of(Place(k, 3), [4, 5]) for k in range(3)] == [[4], [5], [4]]


@pytest.mark.parametrize(
    ("named", "there", "each"),
    [
        ("4,6", 8, ["4", "6", "4"]),
        (None, 2, ["0", "1", "0"]),
        ("GPU-1", 2, ["GPU-1"] * 3),
        ("", 2, [""] * 3),
        (None, 0, [None] * 3),
    ],
)
def test_processes_share_the_gpus_that_they_may_use(named, there, each, monkeypatch):
    monkeypatch.setattr(os, "sched_setaffinity", lambda *_: None)
    monkeypatch.setattr(module, "glob", lambda _: [f"/dev/nvidia{k}" for k in range(there)])
    found = []

    def seen(context, job):
        return os.environ.get("CUDA_VISIBLE_DEVICES")

    for k in range(3):
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
        if named is not None:
            monkeypatch.setenv("CUDA_VISIBLE_DEVICES", named)
        found.append(module._Worker(seen, lambda: None).run(Place(k, 3), 0, None)[1])
    assert found == each


def test_places_are_counted_on_each_machine():
    assert places_on("aba") == [Place(0, 2), Place(0, 1), Place(1, 2)]


def test_all_jobs_are_dealt_out_once_in_their_order():
    left = Left([None] * 5, processes=2)
    assert [left.next(k % 2) for k in range(7)] == [0, 1, 2, 3, 4, None, None]


@given(
    kinds=st.lists(st.sampled_from("abcd"), max_size=20),
    asking=st.lists(st.integers(0, 2), min_size=60, max_size=60),
)
def test_whatever_the_kinds_none_is_lost_or_done_twice(kinds, asking):
    left = Left(kinds, processes=3)
    dealt = [number for number in map(left.next, asking) if number is not None]
    assert sorted(dealt) == list(range(len(kinds)))


def test_a_process_keeps_to_a_kind_while_there_are_jobs_of_it():
    left = Left("abcabc", processes=3)
    first = [left.next(process) for process in (0, 1, 2)]
    assert ["abcabc"[number] for number in first] == ["a", "b", "c"], "each another one"
    again = [left.next(process) for process in (2, 0, 1)]
    assert ["abcabc"[number] for number in again] == ["c", "a", "b"], "and its own again"
    assert left.next(0) is None


def test_who_has_nothing_left_of_its_kinds_helps_with_what_the_fewest_are_at():
    left = Left("aabbbb", processes=3)
    assert [left.next(0), left.next(1)] == [2, 0], "of what most is left first"
    assert left.next(2) == 3, "of two that one has, the one of which most is left"
    assert left.next(1) == 1
    assert left.next(1) == 4, "nothing is left of its own"
    assert [left.next(0), left.next(2)] == [5, None]


def test_who_shares_the_work_is_not_of_the_results():
    config = Spread(processes=1, address="ray://somewhere")
    assert not config.alone and unspread(config) == Spread() and Spread().alone


def test_what_cannot_be_shared_is_refused(monkeypatch):
    cores = len(os.sched_getaffinity(0))
    with pytest.raises(InputError, match=rf"--processes.*{cores + 1}.*at most {cores}"):
        Spread(processes=cores + 1)
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"mjx_grasp\[ray\]"):
        Spread(address="auto")


@pytest.mark.long
def test_results_of_several_come_in_order_from_cores_of_their_own_and_none_is_lost(
    two_cores, tmp_path
):
    """One process is killed at its first job, and another takes its place."""

    def setup(folder):
        (folder / f"setup-{os.getpid()}").touch()
        return 100

    def work(context, job):
        if job == 9:
            raise ValueError("nine")
        if job == 1 and not (tmp_path / "killed").exists():
            (tmp_path / "killed").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.05 * (3 - job))
        return context + job, sorted(os.sched_getaffinity(0)), os.getpid()

    over, begin = Spread(processes=2), partial(setup, tmp_path)
    results = list(spread(over, work, range(4), begin))
    assert [value for value, _, _ in results] == [100, 101, 102, 103]
    shares = {tuple(cores) for _, cores, _ in results}
    assert sorted(core for share in shares for core in share) == two_cores[: sum(map(len, shares))]
    assert all(pid != os.getpid() for _, _, pid in results)
    assert len(list(tmp_path.glob("setup-*"))) == 3, "once in each process"
    with pytest.raises(ValueError, match="nine"):
        list(spread(over, work, [0, 9], begin))


@pytest.mark.long
def test_a_job_that_always_loses_its_process_is_named(two_cores, tmp_path):
    def work(context, job):
        if job == "deadly":
            (tmp_path / f"killed-{os.getpid()}").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return job

    with pytest.raises(MjxGraspError, match="deadly: its process was lost 3 times"):
        list(spread(Spread(processes=2), work, ["safe", "deadly"], lambda: None))
    assert len(list(tmp_path.glob("killed-*"))) == module.TRIES


_SHARED = """
import jax.numpy as jnp
from mjx_grasp.records.spread import Spread, as_done

jnp.ones(3).block_until_ready()  # threads, of which forks are warned
done = as_done(Spread(processes=2), lambda one, job: one + job, [1, 2, 3], lambda: 1)
print(sorted(value for _, value in done))
"""


@pytest.mark.long
def test_nothing_is_said_of_ray(two_cores):
    done = subprocess.run(
        [sys.executable, "-c", _SHARED], capture_output=True, text=True, check=True
    )
    assert (done.stdout, done.stderr) == ("[2, 3, 4]\n", "")


@pytest.mark.long
def test_what_a_process_refuses_is_said_as_by_one(two_cores):
    def work(context, job):
        raise FileError("scan.obj", "nothing", "a mesh")

    with pytest.raises(FileError) as error:
        list(spread(Spread(processes=2), work, range(4), lambda: 100))
    assert type(error.value) is FileError and error.value.path == Path("scan.obj")
    assert str(error.value) == "scan.obj: found nothing, expected a mesh"


@pytest.mark.long
def test_what_is_done_is_there_although_an_earlier_job_is_not(two_cores, tmp_path):
    def work(context, job):
        if job == 0:
            while not (tmp_path / "others").exists():
                time.sleep(0.02)
        return context + job

    found = []
    for k, result in as_done(Spread(processes=2), work, range(4), lambda: 100):
        found.append((k, result))
        if len(found) == 3:
            (tmp_path / "others").touch()
    assert sorted(found[:3]) == [(1, 101), (2, 102), (3, 103)] and found[3] == (0, 100)


@pytest.mark.long
def test_jobs_of_a_kind_are_done_by_one_process(two_cores):
    def work(context, job):
        time.sleep(0.1)
        return job, os.getpid()

    jobs = [(kind, k) for k in range(4) for kind in "ab"]
    done = as_done(Spread(processes=2), work, jobs, lambda: None, kind=lambda job: job[0])
    by = {job: pid for _, (job, pid) in done}
    assert sorted(by) == sorted(jobs)
    assert len({by["a", k] for k in range(3)}) == len({by["b", k] for k in range(3)}) == 1


@pytest.mark.long
def test_a_comparison_by_two_processes_is_that_of_one(two_cores, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    sys.modules.pop("evaluate_controllers", None)
    script = importlib.import_module("evaluate_controllers")
    files = {n: tmp_path / f"{n}.json" for n in (1, 2)}
    for n, out in files.items():
        script.main(
            script.ComparisonConfig(
                out=out, objects=("foam_brick",), force_budgets=(3.0,), squeeze_forces=(3.0,),
                episodes=2, processes=n,
            )
        )  # fmt: skip
    one, two = (json.loads(files[n].read_text()) for n in (1, 2))
    assert one["rows"] == two["rows"] and len(one["rows"]) == 2
    assert one["settings"]["processes"] == two["settings"]["processes"] == 1


@pytest.mark.long
@pytest.mark.parametrize(
    "command",
    [
        "evaluate --controller squeeze --objects foam_brick sugar_box --episodes 2",
        "scenarios --scenarios nominal --objects foam_brick apple --episodes 1 --controller grip",
        "sweep_reach --preset straight --no-bound --poses 6 --chunk 3",
    ],
)
def test_a_command_by_two_processes_writes_what_it_writes_alone(two_cores, tmp_path, command):
    files = [tmp_path / f"{n}.json" for n in (1, 2)]
    for n, out in enumerate(files, start=1):
        words = f"-m mjx_grasp.{command} --processes {n} --out {out}".split()
        done = subprocess.run(
            [sys.executable, *words], capture_output=True, text=True, timeout=500, check=False
        )
        assert done.returncode == 0, done.stderr
    one, two = (json.loads(out.read_text()) for out in files)
    for of_one in (*one.get("scenarios", {}).values(), *two.get("scenarios", {}).values()):
        assert of_one.pop("seconds") > 0.0
    said = {"evaluate": {"settings"}, "scenarios": {"config"}}.get(command.split()[0], set())
    different = {"provenance", "seconds"} | said
    assert {name for name in one if one[name] != two[name]} <= different
