"""Jobs over processes: order, shares of the cores, errors; one comparison by one and by two."""

import importlib
import json
import os
import sys
from pathlib import Path

import pytest

from mjx_grasp.errors import InputError

EXPERIMENTS = Path(__file__).resolve().parent.parent / "experiments"
JOBS = """
import os, time
base = []
def setup(n):
    assert not base
    base.append(n)
def work(k):
    if k == 9:
        raise ValueError("nine")
    time.sleep(0.05 * (3 - k))
    return base[0] + k, sorted(os.sched_getaffinity(0))
"""


@pytest.fixture
def processes(monkeypatch, tmp_path):
    """The module, and one of jobs that other processes can import too."""
    (tmp_path / "some_jobs.py").write_text(JOBS)
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "processes", raising=False)
    return importlib.import_module("processes"), importlib.import_module("some_jobs")


@pytest.fixture
def two_cores():
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        pytest.skip("two processes need two cores")
    return cores


def test_results_come_in_the_order_of_the_jobs_on_shares_that_are_disjoint(processes, two_cores):
    module, jobs = processes
    results = list(module.spread(jobs.work, range(4), 2, jobs.setup, 100))
    assert [value for value, _ in results] == [100, 101, 102, 103]
    shares = {tuple(cores) for _, cores in results}
    assert sorted(core for share in shares for core in share) == two_cores[: sum(map(len, shares))]
    assert not jobs.base  # set up in the others alone


def test_an_error_of_a_job_is_not_lost(processes, two_cores):
    module, jobs = processes
    with pytest.raises(ValueError, match="nine"):
        list(module.spread(jobs.work, [0, 9], 2, jobs.setup, 1))


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_every_core_is_in_one_share(processes, monkeypatch, count):
    module, _ = processes
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(7)))
    shares = module.core_shares(count)
    assert len(shares) == count and sorted(core for share in shares for core in share) == list(
        range(7)
    )
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_more_processes_than_cores_are_refused(processes):
    module, _ = processes
    cores = len(os.sched_getaffinity(0))
    with pytest.raises(InputError, match=rf"--processes.*{cores + 1}.*at most {cores}"):
        module.core_shares(cores + 1)


@pytest.mark.long
def test_a_comparison_by_two_processes_is_that_of_one(processes, two_cores, tmp_path):
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
