"""Commands beside each other: one of each lane at a time, each after those whose files it needs."""

from __future__ import annotations

import shlex
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import NamedTuple

from paper_parts import Part

ROOT = Path(__file__).resolve().parent.parent


class Step(NamedTuple):
    """A command that is left to do."""

    command: str
    part: str
    """whose it is, or of several parts the first"""
    lane: str
    """what it keeps busy"""
    after: frozenset[str]
    """commands that have to be done before"""


def steps_of(
    parts: Sequence[Part], is_left: Callable[[str], bool], lane_of: Callable[[str], str]
) -> list[Step]:
    """What is left of some parts, in their order, and what reads what that makes.

    Two parts may share a command.

    Args:
        parts: All of them.
        is_left: Whether a command is still to be done.
        lane_of: Of a command.
    """
    found: dict[str, Step] = {}
    for part in parts:
        for k, command in enumerate(part.commands):
            after = frozenset(one for one in part.commands[:k] if needs(command, one))
            if command not in found and (is_left(command) or after & found.keys()):
                found[command] = Step(command, part.name, lane_of(command), after)
    return [step._replace(after=step.after & found.keys()) for step in found.values()]


def needs(command: str, before: str) -> bool:
    """Whether a command reads what one before it in its part has made.

    What names the other's file or folder does, by itself or in a plan of trainings; what has no
    `--out`, figures and sums, reads them all, but for figures, which nothing reads.
    """
    own, words = shlex.split(command), shlex.split(before)
    if words[0].endswith("_figure.py"):
        return False
    if "--out" not in own:
        return True
    plans = [(ROOT / word).read_text() for word in own if word.endswith(".yaml")]
    return "--out" in words and any(
        words[words.index("--out") + 1] in text for text in (command, *plans)
    )


def in_lanes(steps: Sequence[Step], run: Callable[[Step], bool]) -> list[Step]:
    """Runs all steps, one of each lane at a time; in a lane the first that can be run is next.

    Args:
        steps: None before one that it is to be after.
        run: Does a step, in a thread of its lane, and says whether that went well. Once it has
            raised an error none is begun, and what is under way in the other lanes ends first.

    Returns:
        What did not go well, and what was not begun as it is to be after that.
    """
    left, done, lost = list(steps), set[str](), list[Step]()
    turn, stopped = threading.Condition(), threading.Event()

    def give_up() -> None:
        """What waits in vain waits no longer."""
        for step in list(left):
            if step.after & {one.command for one in lost}:
                left.remove(step)
                lost.append(step)

    def following(lane: str) -> Step | None:
        with turn:
            while not stopped.is_set():
                own = [step for step in left if step.lane == lane]
                ready = [step for step in own if step.after <= done]
                if ready:
                    left.remove(ready[0])
                if ready or not own:
                    return ready[0] if ready else None
                turn.wait()
        return None

    def stop() -> None:
        stopped.set()
        with turn:
            turn.notify_all()

    def work(lane: str) -> None:
        while step := following(lane):
            try:
                well = run(step)
            except BaseException:
                stop()
                raise
            with turn:
                if well:
                    done.add(step.command)
                else:
                    lost.append(step)
                    give_up()
                turn.notify_all()

    lanes = list(dict.fromkeys(step.lane for step in steps))
    if len(lanes) < 2:
        for lane in lanes:
            work(lane)
        return lost
    with ThreadPoolExecutor(len(lanes)) as pool:
        try:
            for ended in as_completed([pool.submit(work, lane) for lane in lanes]):
                ended.result()
        except BaseException:  # an interrupt reaches this thread alone
            stop()
            raise
    return lost
