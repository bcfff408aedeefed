import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.tasks.config import SuccessConfig
from mjx_grasp.tasks.success import (
    FAILURES,
    failure_classes,
    initial_progress,
    slipped,
    update_progress,
)

# Five ticks instead of fifty.
SHORT = SuccessConfig(hold_s=0.05)


def play(rises, displacements, config=SHORT, lifting=True):
    """Progress after sequences [t, ...]."""

    def tick(progress, now):
        return update_progress(progress, *now, config, control_dt=0.01), None

    rises = jnp.asarray(rises, jnp.float32)
    lifts = jnp.broadcast_to(jnp.asarray(lifting), rises.shape)
    sequence = (rises, jnp.asarray(displacements, jnp.float32), lifts)
    progress, _ = jax.lax.scan(tick, initial_progress(sequence[0].shape[1:]), sequence)
    return progress, failure_classes(progress)


def test_an_object_that_never_rises_is_no_success_however_short_the_hold():
    for hold_s in (0.0, 0.004):
        config = SuccessConfig(hold_s=hold_s)
        still, _ = play([0.0, 0.05], [0.0, 0.0], config)
        risen, _ = play([0.0, 0.11], [0.0, 0.0], config)
        assert not still.success and risen.success


def expected_class(rises, displacements, needed=5):
    """Method §7 read out loud."""
    good = [r >= 0.10 and d < 0.03 for r, d in zip(rises, displacements, strict=True)]
    if any(all(good[i : i + needed]) for i in range(len(good) - needed + 1)):
        return "success"
    reached = [i for i, r in enumerate(rises) if r >= 0.10]
    if not reached:
        return "never_lifted"
    if any(d >= 0.03 for d in displacements[reached[0] :]):
        return "slipped"
    return "not_held"


steps = st.lists(
    st.tuples(st.sampled_from([0.0, 0.05, 0.11, 0.2]), st.sampled_from([0.0, 0.02, 0.035])),
    min_size=5,
    max_size=25,
)


@given(steps)
def test_class_agrees_with_the_criterion_and_is_the_only_one(sequence):
    rises, displacements = zip(*sequence, strict=True)
    progress, classes = play(rises, displacements)
    found = [n for n in FAILURES if bool(classes[n])] + ["success"] * bool(progress.success)
    assert found == [expected_class(rises, displacements)]


def test_published_thresholds():
    config = SuccessConfig()
    high, low = np.full(50, 0.1001), np.full(50, 0.0999)
    assert play(high, 0 * high, config)[0].success
    assert not play(high[:49], 0 * high[:49], config)[0].success
    assert not play(low, 0 * low, config)[0].success
    assert not play(high, 0 * high + 0.0301, config)[0].success
    assert play(high, 0 * high + 0.0299, config)[0].success


def test_a_break_starts_the_count_anew():
    high = np.full(99, 0.12)
    high[49] = 0.05
    progress, classes = play(high, 0 * high, SuccessConfig())
    assert not progress.success and classes["not_held"]


def test_a_slip_before_the_height_is_no_slip_of_a_lifted_object():
    progress, classes = play([0.05, 0.05, 0.0], [0.05, 0.05, 0.05])
    assert classes["never_lifted"] and not classes["slipped"]
    assert np.isclose(progress.peak_rise, 0.05)


def test_what_rises_without_a_lift_is_not_lifted():
    progress, classes = play([100.0] * 20, [0.0] * 20, lifting=False)
    assert not progress.success and classes["never_lifted"]
    progress, classes = play([0.12] * 8, [0.0] * 8, lifting=[True] * 4 + [False] + [True] * 3)
    assert not progress.success and classes["not_held"]


def test_slip_counts_from_where_the_object_was_at_lift_onset():
    place = jnp.zeros((2, 3))
    moved = jnp.array([[0.03, 0.0, 0.04], [0.0, 0.01, 0.0]])
    no, yes = jnp.zeros(2, bool), jnp.ones(2, bool)
    reference, slip = slipped(place, no, no, moved)
    np.testing.assert_array_equal(reference, moved)
    np.testing.assert_array_equal(slip, 0.0)
    reference, slip = slipped(place, no, yes, moved)  # onset: from here on
    np.testing.assert_array_equal(reference, moved)
    np.testing.assert_array_equal(slip, 0.0)
    reference, slip = slipped(place, yes, yes, moved)
    np.testing.assert_array_equal(reference, place)
    np.testing.assert_allclose(slip, [0.05, 0.01], rtol=1e-6)


def test_dropping_it_after_success_stays_a_success():
    rises = [0.12] * 5 + [0.0] * 5
    progress, classes = play(rises, [0.0] * 5 + [0.5] * 5)
    assert progress.success and not any(bool(classes[n]) for n in FAILURES)


def test_numbers_that_are_none_never_count_as_lifted():
    progress, classes = play([np.nan] * 10, [np.nan] * 10)
    assert not progress.success and classes["never_lifted"]


def test_worlds_do_not_mix():
    rises = np.zeros((10, 3))
    rises[:, 1] = 0.2
    progress, _ = play(rises, 0 * rises)
    np.testing.assert_array_equal(progress.success, [False, True, False])
