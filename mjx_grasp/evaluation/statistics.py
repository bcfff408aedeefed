"""Intervals of success rates and means. Rates and their intervals are in percent."""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from mjx_grasp.errors import InputError

Interval = tuple[float, float]


def wilson_interval(successes: int, n: int, confidence: float = 0.95) -> Interval:
    """Wilson's score interval of a success rate [%].

    Args:
        successes: Trials that succeeded.
        n: Trials.
        confidence: Coverage, between 0 and 1.

    Raises:
        InputError: No trials, or not 0 <= successes <= n.
    """
    _check_confidence(confidence)
    if n < 1:
        raise InputError("n", n, "one trial or more")
    if not 0 <= successes <= n:
        raise InputError("successes", successes, f"0 to {n}")
    z = _quantile(confidence)
    rate = successes / n
    centre = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * np.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    # The ends are exactly the rate when nothing, or everything, succeeded.
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == n else centre + half
    return 100.0 * float(low), 100.0 * float(high)


@functools.cache
def _quantile(confidence: float) -> float:
    """Half the width of the normal distribution's interval, in standard deviations."""
    return float(stats.norm.ppf(0.5 + confidence / 2))


def mean_rate_interval(successes: Int[np.ndarray, " k"], n: Int[np.ndarray, " k"]) -> Interval:
    """95 % interval of the unweighted mean of K independent success rates [%].

    The Wilson limits of the rates are combined by recovered variances (Zou and Donner 2008): the
    distances of the limits from their rates add as squares. For K = 1 it is Wilson's interval.
    It describes the spread of trials on these K objects, not that over other objects.
    """
    successes, n = np.asarray(successes), np.asarray(n)
    if successes.shape != n.shape or successes.ndim != 1 or not len(n):
        raise InputError("successes and n", (successes.shape, n.shape), "two equal shapes [k]")
    rates = 100.0 * successes / n
    pairs = zip(successes, n, strict=True)
    limits = np.array([wilson_interval(int(s), int(m)) for s, m in pairs])
    below, above = rates - limits[:, 0], limits[:, 1] - rates
    mean, k = rates.mean(), len(rates)
    return (
        float(max(0.0, mean - np.sqrt(np.sum(below**2)) / k)),
        float(min(100.0, mean + np.sqrt(np.sum(above**2)) / k)),
    )


def bootstrap_mean_interval(
    values: Float[np.ndarray, " n"], seed: int, confidence: float = 0.95, resamples: int = 10_000
) -> Interval:
    """Percentile bootstrap interval of a mean, in the values' own unit.

    Args:
        values: One number per independent unit: an episode, an object, a training seed.
        seed: Of the resampling.
        confidence: Coverage, between 0 and 1.
        resamples: How often the values are drawn anew.

    Raises:
        InputError: No values, or one that is not finite.
    """
    _check_confidence(confidence)
    values = np.asarray(values, float)
    if values.ndim != 1 or not len(values) or not np.isfinite(values).all():
        raise InputError("values", values.shape, "one or more finite numbers of shape [n]")
    rng = np.random.default_rng(seed)
    means = np.empty(resamples)
    block = max(1, 1_000_000 // len(values))  # bounds the memory of the drawn indices
    for start in range(0, resamples, block):
        size = min(block, resamples - start)
        means[start : start + size] = values[
            rng.integers(len(values), size=(size, len(values)))
        ].mean(1)
    low, high = np.quantile(means, [0.5 - confidence / 2, 0.5 + confidence / 2])
    return float(low), float(high)


def _check_confidence(confidence: float) -> None:
    if not 0 < confidence < 1:
        raise InputError("confidence", confidence, "a number between 0 and 1")
