"""Jobs over processes of one machine or several, their results in order, by Ray (extra `ray`).

One evaluation alone does not use many cores: its physics does, its controller hardly. So several
run beside each other, each on cores of its own, and on one of the GPUs if there are any.
"""

from __future__ import annotations

import os
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from glob import glob
from importlib.util import find_spec
from textwrap import shorten
from typing import Any, NamedTuple, TypeVar

from mjx_grasp.errors import InputError, MjxGraspError
from mjx_grasp.records.cluster import connected
from mjx_grasp.records.provenance import usable_cores
from mjx_grasp.records.settings import CommandSettings, Count

Job = TypeVar("Job")
Result = TypeVar("Result")
Context = TypeVar("Context")
Kind = Callable[[Job], Hashable]
"""What jobs have in common that a process makes for the first of them and has for the others, such
as compiled functions."""
S = TypeVar("S", bound="Spread")
_GPUS = "CUDA_VISIBLE_DEVICES"
TRIES = 3
"""Of a job whose process is lost, by a kill for want of memory say."""


@dataclass(frozen=True, kw_only=True)
class Spread(CommandSettings):
    """Who shares the work. It makes no difference to the results."""

    processes: Count = 1
    """that share the work, each with cores of its own; more than one needs the extra `ray`"""
    address: str | None = None
    """of a Ray cluster over whose machines the processes are spread, or `auto` for the one that
    this machine belongs to; paths have to be the same on all of them. None: this machine alone"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.address is None and self.processes > usable_cores():
            expected = f"at most {usable_cores()}, a core each"
            raise InputError(self.name_of("processes"), self.processes, expected)
        if not self.alone and find_spec("ray") is None:
            what = f"{self.processes}, but no Ray"
            expected = "the extra 'ray' (pip install 'mjx_grasp[ray]')"
            raise InputError(self.name_of("processes"), what, expected)

    @property
    def alone(self) -> bool:
        """Whether this process does everything."""
        return self.processes == 1 and self.address is None


def unspread(config: S) -> S:
    """Settings as they would be of one process: what results are made of."""
    return replace(config, processes=1, address=None)


class Place(NamedTuple):
    """Which process of its machine one is."""

    rank: int
    """from 0"""
    processes: int
    """of the machine"""


def spread(
    over: Spread,
    work: Callable[[Context, Job], Result],
    jobs: Sequence[Job],
    setup: Callable[[], Context],
) -> Iterator[Result]:
    """The results of jobs, in their order; arguments as of `as_done`."""
    waiting: dict[int, Result] = {}
    first = 0
    for k, result in as_done(over, work, jobs, setup):
        waiting[k] = result
        while first in waiting:
            yield waiting.pop(first)
            first += 1


def as_done(
    over: Spread,
    work: Callable[[Context, Job], Result],
    jobs: Sequence[Job],
    setup: Callable[[], Context],
    kind: Kind[Job] = lambda job: None,
) -> Iterator[tuple[int, Result]]:
    """The results of jobs as soon as they are there, each with its job's place in the list.

    A process that is lost is begun anew, and what it was at is done again, a few times.

    Args:
        over: Who shares them.
        work: Does one job, with what `setup` has made.
        jobs: One after the other.
        setup: Called once in every process before its first job; in this one if it is alone.
        kind: A process keeps to the kinds of jobs that it has begun with while there are any.

    Raises:
        MjxGraspError: A job's process was lost every time.
    """
    if not jobs:
        return
    if over.alone:
        context = setup()
        yield from ((k, work(context, job)) for k, job in enumerate(jobs))
        return
    import ray

    with connected(over.address, over.processes):
        remote: Any = ray.remote(
            num_cpus=1,
            max_restarts=-1,
            max_task_retries=TRIES - 1,
            scheduling_strategy="SPREAD",
        )(_Worker)
        workers = [remote.remote(work, setup) for _ in range(min(over.processes, len(jobs)))]
        machines = ray.get([worker.machine.remote() for worker in workers])
        places = places_on(machines)
        left = Left([kind(job) for job in jobs], len(workers))
        at = dict[Any, tuple[int, int]]()

        def begin(which: int) -> None:
            number = left.next(which)
            if number is not None:
                task = workers[which].run.remote(places[which], number, jobs[number])
                at[task] = which, number

        for which in range(len(workers)):
            begin(which)
        try:
            while at:
                (ended,), _ = ray.wait(list(at))
                which, number = at.pop(ended)
                begin(which)
                yield ray.get(ended)
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, MjxGraspError):  # for people: without the traceback there
                raise error.cause from None
            raise
        except ray.exceptions.RayActorError as error:
            why = f"its process was lost {TRIES} times; short of memory?"
            raise MjxGraspError(f"{what_of(jobs[number])}: {why}") from error


def what_of(job: Any) -> str:
    """A job in words that fit a line."""
    return shorten(str(job), 200)


class Left:
    """Jobs that are left, dealt out so that a process seldom meets a kind of jobs anew.

    Args:
        kinds: Of every job, in their order.
        processes: How many share them.
    """

    def __init__(self, kinds: Sequence[Hashable], processes: int):
        self._left: dict[Hashable, deque[int]] = {}
        for number, kind in enumerate(kinds):
            self._left.setdefault(kind, deque()).append(number)
        self._met: list[set[Hashable]] = [set() for _ in range(processes)]

    def next(self, process: int) -> int | None:
        """A job for a process that has none; None if nothing is left.

        Of a kind that it has met, else of one that the fewest have; of several such that of which
        most is left.
        """
        left = [kind for kind, numbers in self._left.items() if numbers]
        if not left:
            return None
        mine = [kind for kind in left if kind in self._met[process]]

        def rank(kind: Hashable) -> tuple[int, int]:
            return sum(kind in met for met in self._met), -len(self._left[kind])

        chosen = min(mine or left, key=rank)
        self._met[process].add(chosen)
        return self._left[chosen].popleft()


def places_on(machines: Sequence[str]) -> list[Place]:
    """Of each process its place among those on the same machine."""
    counts, seen = Counter(machines), Counter[str]()
    places = []
    for machine in machines:
        places.append(Place(seen[machine], counts[machine]))
        seen[machine] += 1
    return places


def cores_of(place: Place, cores: Sequence[int]) -> list[int]:
    """The cores of a place when a machine's are dealt out evenly; one at least."""
    own = list(cores[place.rank :: place.processes])
    return own or [cores[place.rank % len(cores)]]


def gpus() -> list[str]:
    """The GPUs that this process may use, as CUDA names them; JAX is not asked, as it would begin.

    CUDA's own variable says which; without it they are all.
    """
    named = os.environ.get(_GPUS)
    if named is not None:
        return [gpu for gpu in named.split(",") if gpu]
    return [str(k) for k in range(len(glob("/dev/nvidia[0-9]*")))]


class _Worker:
    """One process."""

    def __init__(self, work: Callable[[Any, Any], Any], setup: Callable[[], Any]):
        self._work, self._setup = work, setup
        self._context: list[Any] = []

    def machine(self) -> str:
        """Where it is."""
        import ray

        return ray.get_runtime_context().get_node_id()

    def run(self, place: Place, number: int, job: Any) -> tuple[int, Any]:
        """Does a job, after what comes before the first one."""
        if not self._context:
            if hasattr(os, "sched_setaffinity"):  # not on macOS
                os.sched_setaffinity(0, cores_of(place, sorted(os.sched_getaffinity(0))))
            if found := gpus():  # one each, shared in turn where there are fewer
                os.environ[_GPUS] = found[place.rank % len(found)]
            self._context.append(self._setup())
        return number, self._work(self._context[0], job)
