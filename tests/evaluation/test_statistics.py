import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.statistics import (
    bootstrap_mean_interval,
    mean_rate_interval,
    wilson_interval,
)

trials = st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))


@given(trials, st.sampled_from([0.5, 0.9, 0.95, 0.99]))
def test_wilson_agrees_with_scipy(counts, confidence):
    k, n = counts
    expected = stats.binomtest(k, n).proportion_ci(confidence, method="wilson")
    low, high = wilson_interval(k, n, confidence)
    assert low == pytest.approx(100 * expected.low, abs=1e-9)
    assert high == pytest.approx(100 * expected.high, abs=1e-9)
    assert 0 <= low <= 100 * k / n <= high <= 100


def test_wilson_of_a_published_example():
    # Newcombe (1998), table I: 81 of 263.
    assert wilson_interval(81, 263) == pytest.approx((25.53, 36.62), abs=0.005)


@given(trials)
def test_the_mean_of_one_rate_has_its_own_interval(counts):
    k, n = counts
    assert mean_rate_interval(np.array([k]), np.array([n])) == pytest.approx(wilson_interval(k, n))


def test_the_mean_rate_interval_covers_the_true_mean_as_often_as_it_says():
    rng = np.random.default_rng(1)
    rates = np.array([0.99, 0.95, 0.9, 0.85, 0.8, 0.6, 0.4, 1.0])
    n = np.full(8, 64)
    found = np.array([mean_rate_interval(rng.binomial(64, rates), n) for _ in range(1500)])
    # It misses about as often on either side, one time in forty.
    for misses in (found[:, 0] > 100 * rates.mean(), found[:, 1] < 100 * rates.mean()):
        assert 0.005 < misses.mean() < 0.05


def test_the_bootstrap_agrees_with_scipy_and_with_its_seed():
    values = np.random.default_rng(2).gamma(2.0, size=60)
    expected = stats.bootstrap(
        (values,), np.mean, method="percentile", n_resamples=20_000, rng=3
    ).confidence_interval
    found = bootstrap_mean_interval(values, seed=0, resamples=20_000)
    assert found == pytest.approx((expected.low, expected.high), rel=0.01)
    assert found == bootstrap_mean_interval(values, seed=0, resamples=20_000)
    assert found != bootstrap_mean_interval(values, seed=1, resamples=20_000)


def test_the_bootstrap_of_a_constant_has_no_width():
    assert bootstrap_mean_interval(np.full(9, 4.0), seed=0) == (4.0, 4.0)


@pytest.mark.wrong_types
@pytest.mark.parametrize(
    "call",
    [
        lambda: wilson_interval(1, 0),
        lambda: wilson_interval(3, 2),
        lambda: wilson_interval(1, 2, confidence=95),
        lambda: mean_rate_interval(np.array([], int), np.array([], int)),
        lambda: bootstrap_mean_interval(np.array([1.0, np.nan]), seed=0),
    ],
)
def test_what_cannot_be_an_input_is_refused(call):
    with pytest.raises(InputError):
        call()
