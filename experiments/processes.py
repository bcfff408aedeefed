"""Jobs spread over processes, each with its own share of the cores, their results in order.

One evaluation alone does not use many cores: its physics does, its controller hardly.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeVar

from mjx_grasp.errors import InputError

Job = TypeVar("Job")
Result = TypeVar("Result")


def spread(
    work: Callable[[Job], Result],
    jobs: Sequence[Job],
    processes: int,
    setup: Callable[..., None],
    *given: Any,
) -> Iterator[Result]:
    """The results of jobs, in their order, as they come.

    Args:
        work: Does one job; a function of a module.
        jobs: What it is given, one after the other.
        processes: How many to use; with 1 everything happens in this one.
        setup: Called once in every process before its first job.
        given: What `setup` is given.

    Raises:
        InputError: More processes than cores.
    """
    shares = core_shares(processes)
    spawn = multiprocessing.get_context("spawn")
    left: Any = spawn.SimpleQueue()
    for share in shares:
        left.put(share)
    begin = (left, setup, given)
    with ProcessPoolExecutor(processes, spawn, initializer=_begin, initargs=begin) as pool:
        yield from pool.map(work, jobs)


def core_shares(processes: int) -> list[list[int]]:
    """The cores that this process may use, dealt out evenly.

    Raises:
        InputError: There are fewer of them than processes.
    """
    cores = sorted(os.sched_getaffinity(0))
    if processes > len(cores):
        raise InputError("--processes", processes, f"at most {len(cores)}, a core each")
    return [cores[k::processes] for k in range(processes)]


def _begin(left: Any, setup: Callable[..., None], given: tuple[Any, ...]) -> None:
    os.sched_setaffinity(0, left.get())
    setup(*given)
