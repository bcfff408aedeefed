"""What shared work has done so far, line by line beside its results file.

Jobs end in any order, and a results file has one. What is done before its turn is kept here, so
that a run which is killed loses nothing that was finished.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from mjx_grasp.evaluation.spread import Spread, as_done
from mjx_grasp.records.atomic import replacing

Context = TypeVar("Context")
Job = TypeVar("Job")


class Journal:
    """Finished jobs in a file of lines of JSON, a line each, after one that says what they are of.

    Args:
        results: The results file; the journal is the hidden file `.NAME.begun` beside it.
        identity: What the results depend on: settings, inputs, revision. A journal of another
            one is begun anew.
    """

    def __init__(self, results: Path, identity: dict[str, Any]):
        self.path = results.with_name(f".{results.name}.begun")
        self._identity = json.dumps(identity, sort_keys=True, default=str)
        self.done: dict[str, Any] = dict(self._kept())
        """of each finished job, by its text, what it gave"""

    def _kept(self) -> Iterator[tuple[str, Any]]:
        if not self.path.exists():
            return
        first, *lines = self.path.read_text().split("\n")
        if first != self._identity:
            return
        for line in lines:
            try:
                text, result = json.loads(line)
            except ValueError:  # the line that it was at when it was killed
                return
            yield text, result

    def open(self) -> None:
        """Writes what is kept, without a line that is incomplete; only then can be added to it."""
        with replacing(self.path) as temporary:
            lines = (json.dumps(item) for item in self.done.items())
            temporary.write_text("".join(f"{line}\n" for line in (self._identity, *lines)))

    def add(self, text: str, result: Any) -> None:
        """Keeps what a job gave, for good before it returns."""
        self.done[text] = result
        with self.path.open("a") as file:
            file.write(json.dumps([text, result]) + "\n")
            file.flush()
            os.fsync(file.fileno())

    def close(self) -> None:
        """Removes the file: all is in the results now."""
        self.path.unlink(missing_ok=True)


def journaled(
    over: Spread,
    work: Callable[[Context, Job], Any],
    jobs: Sequence[Job],
    setup: Callable[[], Context],
    journal: Journal,
) -> Iterator[Any]:
    """The results of jobs in their order; none that is finished is lost, or done twice.

    Args:
        over: Who shares them.
        work: Does one job, with what `setup` has made; what it gives has to be JSON.
        jobs: One after the other; told apart by their `repr`.
        setup: Called once in every process before its first job.
        journal: Where results are until it is closed.
    """
    texts = [repr(job) for job in jobs]
    left = [k for k, text in enumerate(texts) if text not in journal.done]
    if left:
        journal.open()
    given = 0

    def ready() -> Iterator[Any]:
        nonlocal given
        while given < len(texts) and texts[given] in journal.done:
            given += 1
            yield journal.done[texts[given - 1]]

    yield from ready()
    for k, result in as_done(over, work, [jobs[k] for k in left], setup):
        journal.add(texts[left[k]], result)
        yield from ready()
