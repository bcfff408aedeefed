"""What work has done so far, line by line beside its results file.

A results file holds what is whole, in its order; jobs are parts of that and end in any order. What
is done before its turn is kept here, so that a run which is killed loses nothing that was finished.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from mjx_grasp.records.atomic import replacing
from mjx_grasp.records.provenance import is_committed, versions
from mjx_grasp.records.spread import Kind, Spread, as_done

Context = TypeVar("Context")
Job = TypeVar("Job")


def goes_on(before: dict[str, Any], identity: dict[str, Any], git: str) -> bool:
    """Whether what a results file holds is of the same work, and need not be done again.

    Args:
        before: The file.
        identity: What it has to hold of settings and inputs.
        git: Revision of the code now. With uncommitted changes it says nothing of the code: they
            may be others than before. Versions of the packages have to be the same too.
    """
    same = all(before.get(name) == value for name, value in identity.items())
    made = before["provenance"]
    made_by = {name: made.get("versions", {}).get(name) for name in versions()}
    return same and made["git"] == git and made_by == versions() and is_committed(git)


class Journal:
    """Finished jobs in a file of lines of JSON, a line each, after one that says what they are of.

    Args:
        results: The results file; the journal is the hidden file `.NAME.begun` beside it.
        identity: What the results depend on: settings, inputs.
        git: Revision of the code. A journal of another one, of another identity or of other
            versions of packages is begun anew, and so is one of uncommitted changes.
    """

    def __init__(self, results: Path, identity: dict[str, Any], git: str):
        self.path = results.with_name(f".{results.name}.begun")
        made_by = {"git": git, "versions": versions()}
        self._first = json.dumps(identity | made_by, sort_keys=True, default=str)
        self.done: dict[str, Any] = dict(self._kept()) if is_committed(git) else {}
        """of each finished job, by its name, what it gave"""
        self._begun = False

    def _kept(self) -> Iterator[tuple[str, Any]]:
        if not self.path.exists():
            return
        first, *lines = self.path.read_text().split("\n")
        if first != self._first:
            return
        for line in lines:
            try:
                name, result = json.loads(line)
            except ValueError:  # the line that it was at when it was killed
                return
            yield name, result

    def add(self, name: str, result: Any) -> None:
        """Keeps what a job gave, for good before it returns."""
        line = json.dumps([name, result])
        if not self._begun:
            self._begin()
        with self.path.open("a") as file:
            file.write(f"{line}\n")
            file.flush()
            os.fsync(file.fileno())
        self.done[name] = json.loads(line)[1]  # as it is when read again

    def once(self, name: str, work: Callable[..., Any], *given: Any) -> Any:
        """What a job gave; it is done, and kept, if it was not before.

        Args:
            name: Of the job.
            work: Does it; what it gives has to be JSON.
            given: What it is called with.
        """
        if name not in self.done:
            self.add(name, work(*given))
        return self.done[name]

    def _begin(self) -> None:
        """Writes what is kept, without a line that is incomplete; only then can be added to it."""
        with replacing(self.path) as temporary:
            lines = (json.dumps(item) for item in self.done.items())
            temporary.write_text("".join(f"{line}\n" for line in (self._first, *lines)))
        self._begun = True

    def close(self) -> None:
        """Removes the file: all is in the results now."""
        self.path.unlink(missing_ok=True)


def journaled(
    over: Spread,
    work: Callable[[Context, Job], Any],
    jobs: Sequence[tuple[str, Job]],
    setup: Callable[[], Context],
    journal: Journal,
    told: Callable[[Job], None] = lambda job: None,
    kind: Kind[Job] = lambda job: None,
) -> Iterator[Any]:
    """The results of jobs in their order; none that is finished is lost, or done twice.

    Args:
        over: Who shares them.
        work: Does one job, with what `setup` has made; what it gives has to be JSON.
        jobs: One after the other, each with its name. What has the same name is the same.
        setup: Called once in every process before its first job.
        journal: Where results are until it is closed.
        told: Of every job that is finished, when it is, be it before its turn.
        kind: See `as_done`.
    """
    left = {name: job for name, job in jobs if name not in journal.done}
    given = 0

    def ready() -> Iterator[Any]:
        nonlocal given
        while given < len(jobs) and jobs[given][0] in journal.done:
            given += 1
            yield journal.done[jobs[given - 1][0]]

    yield from ready()
    names = list(left)
    for k, result in as_done(over, work, list(left.values()), setup, kind):
        journal.add(names[k], result)
        told(left[names[k]])
        yield from ready()
