"""How well forces and contacts are sensed: pure measures of series with ticks first.

`sensed_forces.py` takes them of whole grasps.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mjx_grasp.errors import InputError

PHASES = ("reaching", "pressing", "lifting", "holding")
"""Of one finger: before it grips, until the palm moves, while it rises, after."""


class Onsets(NamedTuple):
    """What became of the first lasting contact of each series that has one."""

    contacts: int
    early: int
    """signalled already in the tick before"""
    missed: int
    """never signalled while they lasted"""
    delay: Float[np.ndarray, " n"]
    """of the others [ticks]"""


def phase_masks(
    gripping: Bool[np.ndarray, "t n"], rising: Bool[np.ndarray, "t n"]
) -> dict[str, Bool[np.ndarray, "t n"]]:
    """The ticks of each phase.

    Args:
        gripping: Whether the finger has begun to press.
        rising: Whether the lift's script moves the palm.
    """
    begun = np.maximum.accumulate(rising, axis=0)
    masks = (~gripping & ~begun, gripping & ~begun, rising, begun & ~rising)
    return dict(zip(PHASES, masks, strict=True))


def spread(values: Float[np.ndarray, " n"]) -> list[float | None]:
    """Median and 95th percentile; None for both of nothing."""
    if not values.size:
        return [None, None]
    return [float(p) for p in np.percentile(values, (50, 95))]


def force_errors(
    estimated: Float[np.ndarray, "t n 3"],
    true: Float[np.ndarray, "t n 3"],
    where: Bool[np.ndarray, "t n"],
) -> dict[str, Any]:
    """Errors of the estimate over some ticks, each as median and 95th percentile [N].

    Args:
        estimated: Force by the estimator [N].
        true: Force by the solver [N].
        where: The ticks that count.
    """
    estimate, truth = estimated[where], true[where]
    sizes = np.linalg.norm(estimate, axis=-1), np.linalg.norm(truth, axis=-1)
    return {
        "ticks": int(where.sum()),
        "true_n": spread(sizes[1]),
        "norm_error_n": spread(np.abs(sizes[0] - sizes[1])),
        "vector_error_n": spread(np.linalg.norm(estimate - truth, axis=-1)),
    }


def flag_score(
    flag: Bool[np.ndarray, "t n"], contact: Bool[np.ndarray, "t n"], where: Bool[np.ndarray, "t n"]
) -> dict[str, Any]:
    """Precision, recall and F1 of a contact flag, tick by tick; None where there is nothing.

    Args:
        flag: What is signalled.
        contact: What is.
        where: The ticks that count.
    """
    both = int((flag & contact & where).sum())
    flagged, touching = int((flag & where).sum()), int((contact & where).sum())
    return {
        "precision": both / flagged if flagged else None,
        "recall": both / touching if touching else None,
        "f1": 2 * both / (flagged + touching) if flagged + touching else None,
    }


def first_onsets(
    flag: Bool[np.ndarray, "t n"], contact: Bool[np.ndarray, "t n"], lasting: int
) -> Onsets:
    """When the first lasting contact of each series is signalled.

    The delay is the number of ticks from the contact's first tick to the first flag within it; the
    same tick is 0.

    Args:
        flag: What is signalled.
        contact: What is.
        lasting: Ticks for which a contact must last.

    Raises:
        InputError: `lasting` is not positive, or the shapes differ.
    """
    if lasting < 1:
        raise InputError("lasting", lasting, "one tick or more")
    if flag.shape != contact.shape:
        raise InputError("flag", flag.shape, f"the shape of contact, {contact.shape}")
    early = missed = contacts = 0
    delays = []
    for signal, touch in zip(flag.T, contact.T, strict=True):
        steps = np.diff(np.concatenate([[0], touch.astype(np.int8), [0]]))
        runs = zip(np.flatnonzero(steps > 0), np.flatnonzero(steps < 0), strict=True)
        first = next(((a, b) for a, b in runs if b - a >= lasting), None)
        if first is None:
            continue
        contacts += 1
        begin, end = first
        within = np.flatnonzero(signal[begin:end])
        if begin > 0 and signal[begin - 1]:
            early += 1
        elif len(within):
            delays.append(float(within[0]))
        else:
            missed += 1
    return Onsets(contacts, early, missed, np.array(delays))


def onset_record(onsets: Onsets, dt: float) -> dict[str, Any]:
    """Onsets for a results file, the delay as median and 95th percentile [ms].

    Args:
        onsets: From `first_onsets`.
        dt: Length of a tick [s].
    """
    return {
        "contacts": onsets.contacts,
        "early": onsets.early,
        "missed": onsets.missed,
        "delay_ms": spread(1e3 * dt * onsets.delay),
    }
