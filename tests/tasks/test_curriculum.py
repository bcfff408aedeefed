"""How far away episodes begin, as a training goes on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.tasks.curriculum import CurriculumConfig, Learnt, first_pace, next_pace


def levels(config, lessons):
    """After each (share, episodes, successes), in two worlds."""
    pace, step = first_pace(2, config), jax.jit(next_pace, static_argnums=2)
    found = [pace.level]
    for lesson in lessons:
        pace = step(pace, Learnt(*map(jnp.float32, lesson)), config)
        found.append(pace.level)
    found = np.array(found)
    assert (found[:, 0] == found[:, 1]).all(), "one level for all worlds"
    return found[:, 0]


def test_forced_it_rises_evenly_and_stays_at_one():
    config = CurriculumConfig("forced", start=0.2, until=0.5)
    found = levels(config, [(share, 0, 0) for share in (0.125, 0.25, 0.5, 0.51, 1.0)])
    np.testing.assert_allclose(found, [0.2, 0.4, 0.6, 1.0, 1.0, 1.0], atol=1e-6)
    assert found.max() == 1.0


@pytest.mark.parametrize("until", [0.0, 1.0])
def test_it_may_be_forced_at_once_or_at_the_very_end(until):
    found = levels(CurriculumConfig("forced", start=0.1, until=until), [(0.01, 0, 0), (1.0, 0, 0)])
    assert found[1] == (1.0 if until == 0 else pytest.approx(0.109)) and found[2] == 1.0


def test_measured_it_rises_by_a_step_where_enough_of_a_window_succeed():
    config = CurriculumConfig("measured", 0.1, until=1.0, step=0.3, success=0.5, window=10)
    lessons = [
        (0.1, 6, 6),  # the window is not full
        (0.2, 6, 0),  # half of 12: rises
        (0.3, 12, 5),  # too few
        (0.4, 0, 0),  # nothing ended
        (0.5, 100, 60),
        (0.6, 10, 10),
        (0.7, 10, 10),
    ]
    np.testing.assert_allclose(
        levels(config, lessons), [0.1, 0.1, 0.4, 0.4, 0.4, 0.7, 1.0, 1.0], atol=1e-6
    )


def test_measured_it_is_forced_in_the_end():
    config = CurriculumConfig("measured", until=0.8)
    found = levels(config, [(0.5, 5000, 0), (0.79, 5000, 0), (0.8, 5000, 0), (0.9, 1, 0)])
    np.testing.assert_allclose(found, [0.1, 0.1, 0.1, 1.0, 1.0], atol=1e-6)


def test_without_one_it_is_the_whole_way_from_the_beginning():
    assert (levels(CurriculumConfig("none"), [(0.1, 10, 0)]) == 1.0).all()


def test_steps_of_a_tenth_end_at_exactly_one():
    config = CurriculumConfig("measured", until=1.0, window=1)
    assert levels(config, [(0.01, 1, 1)] * 30)[-1] == 1.0


@pytest.mark.parametrize(("name", "value"), [("start", 1.5), ("step", 0.0), ("window", 0)])
def test_impossible_ones_are_refused_by_name(name, value):
    with pytest.raises(InputError, match=rf"^CurriculumConfig\.{name}: "):
        CurriculumConfig(**{name: value})
